"""Defines an estimator as a replay sees it: its parameters, its topics, and how it is called.

An estimator is bound to topics and turns ragged streams into ragged streams. A recursive one is handed
the blocks of its topics one after another and carries a state from block to block; a batch one gets
whole streams and is done. The same call serves one run and many, so an ensemble's results are those of
the runs replayed one by one, bit for bit.
"""

import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, Generic, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.kernels.program import DoesNotCompile
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, Stream, Topic
from fuselog.recorders.parameters import Parameters, ParametersType, build, merge, nested
from fuselog.recorders.registry import foreign_code, load
from fuselog.replay.engine.renamed import renamed
from fuselog.replay.engine.replaying.truth import refuse_truths, truths_among
from fuselog.replay.engine.streams.blocks import Block, Ragged
from fuselog.replay.engine.streams.ensembles import Ensemble, ensemble_of
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.engine.vectors.components import Components


class Initialized(NamedTuple):
    """Holds what the first messages of a log give: static topics to start from, and output streams."""

    static: dict[str, Ragged]
    outputs: list[Ragged]


@dataclass(frozen=True)
class Initialization:
    """Describes how an estimator finds what a log does not state, such as where to begin.

    Attributes:
        topics: those whose first messages it is handed.
        find: (first messages, the static topics, clock) -> what there is to start
            from; by the clock by which the replay stamps estimates.
        find_broad: (first messages, the static topics, clock, a stamp for each run) -> the equally
            likely starts of all runs there, so broad that no parameter counts: likelihoods with other
            parameters, or of the log without a fault, are compared over these. None for what `find`
            finds.
    """

    topics: tuple[str, ...]
    find: Callable[[Mapping[str, Ragged], Mapping[str, Ragged], Clock], Initialized]
    find_broad: (
        Callable[[Mapping[str, Ragged], Mapping[str, Ragged], Clock, Sequence[int]], list[Initialized]]
        | None
    ) = None


NEEDED_MESSAGES = 4096  # that are read at once, until one has a value that is needed


@dataclass(frozen=True)
class Reading:
    """Describes what an estimator reads of its topics and parameters, as its model's functions do.

    Attributes:
        controls: the topics that drive it.
        kinds: by topic, the kinds of the numbers that it reads of a message: controls, or what is
            measured.
        measured: by topic of a sensor, the names of these numbers, as innovations have them.
        numbers: stream of one of these topics -> these numbers (n, m); NaN where one is missing.
        noises: parameters that are standard deviations of noise, with the topic of the sensor whose it
            is; "" for that of the motion.
        augmentable: parameters that may be estimated beside the state, each with its kind and the
            topics of what reads it, "" for the motion.
        biases, factors: by topic and the place of a number, the parameter that is added to it, or that
            it is multiplied by: to a control, or to what is measured.
        delays: by topic, the parameter that says how late its messages are.
        calibration: parameters that say how its sensors are mounted, scaled, biased and delayed, each
            with a useful standard deviation.
        control_noise: how long a message of a control holds, in s -> by topic and the place of a number,
            the variance that the model states of it; nothing if it states none.
    """

    controls: tuple[str, ...]
    kinds: Mapping[str, tuple[str, ...]]
    measured: Mapping[str, tuple[str, ...]]
    numbers: Callable[[Stream], NDArray[np.float64]]
    noises: Mapping[str, str]
    augmentable: Mapping[str, tuple[str, tuple[str, ...]]]
    biases: Mapping[tuple[str, int], str]
    factors: Mapping[tuple[str, int], str]
    delays: Mapping[str, str]
    calibration: Mapping[str, float]
    control_noise: Callable[[float], Mapping[tuple[str, int], float]]


# What a recursion carries from block to block: its own.
Carried = Any  # type: ignore[explicit-any]
# What a parameter is set to: a number, a text, a list or a table.
Setting = Any  # type: ignore[explicit-any]


class Needed(NamedTuple):
    """States that a field needs a value in some message of a topic, which its layout does not tell.

    Attributes:
        field: its name.
        refusal: the sentence if no message has a value of it.
    """

    field: str
    refusal: str


class Alike(NamedTuple):
    """Describes bound estimators that differ only in numbers, which may go through runs together.

    Attributes:
        key: equal for those that may.
        numbers: those of this estimator.
        together: the numbers of each run -> the estimator in which each run has numbers of its own. An
            initialization must not depend on them.
    """

    key: Hashable
    numbers: NDArray[np.float64]
    together: "Callable[[NDArray[np.float64]], Recursive]"


@renamed(whole="static", rewinding="out_of_sequence", opening="initialization")
@dataclass(frozen=True, eq=False)
class Recursive:
    """Describes an estimator that goes through its topics in time.

    Attributes:
        name: what its output topics begin with, `/estimates/` + name.
        streams: the topics that `run` is handed, in the order its `Events.topic` counts them.
        static: the topics that `start` needs from beginning to end, such as a map or a prior.
        start: static topics -> the state before the first block.
        run: state and block -> the state after it, and the output streams. States are values: `run`
            never changes the one it is handed.
        priors: the static topics that are Gaussian priors, and the components that are wanted of each.
            `start` gets one message of these for every run, as wanted, NaN where the run cannot start;
            see `fuselog.replay.engine.streams.priors`.
        given: static topics that are not read from the runs, see `fuselog.pipeline.runs.initial_states`.
        finish: the state after the last block -> the outputs that waited for messages which did not
            come any more.
        parameters: those that it was bound with, defaults included.
        out_of_sequence: the same estimator for a block's messages in the order in which they came, whose
            stamps go back by up to so many nanoseconds; None where it cannot go back. Raises BadInput
            where its parameters do not let it.
        initialization: how it finds what a log does not state; None where that states all.
        assumed: the parameters that are assumed, since the log does not state them.
        is_random: whether it draws random numbers, so that its likelihood is no smooth function of its
            parameters.
        offers: by topic that it does not take, the setting with which it would.
        reading: what it reads; None where that is not known.
        needed: by topic, a field without which it does not fit a log.
        truth: the topic by which its estimates are judged, which it must not read.
        is_bound: whether it is a bound of estimates, which may read the truth.
        alike: how it goes through runs together with others that differ only in numbers; None if it
            cannot.
    """

    name: str
    streams: tuple[str, ...]
    static: tuple[str, ...]
    start: Callable[[dict[str, Ragged]], Carried]
    run: Callable[[Carried, Block], tuple[Carried, list[Ragged]]]
    priors: Mapping[str, Components] = field(default_factory=dict)
    given: Mapping[str, Ragged] = field(default_factory=dict)
    finish: Callable[[Carried], list[Ragged]] | None = None
    parameters: Parameters | None = None
    out_of_sequence: "Callable[[int], Recursive] | None" = None
    initialization: Initialization | None = None
    assumed: Mapping[str, float] = field(default_factory=dict)
    is_random: bool = False
    offers: Mapping[str, str] = field(default_factory=dict)
    reading: Callable[[], Reading] | None = None
    needed: Mapping[str, Needed] = field(default_factory=dict)
    truth: str = ""
    is_bound: bool = False
    alike: Alike | None = None


@renamed(whole="static")
@dataclass(frozen=True, eq=False)
class Batch:
    """Describes an estimator that needs everything at once: `solve` turns its topics into outputs.

    `streams` are the measurements, within the span that is replayed; all else as for `Recursive`.

    Attributes:
        name: the label, and what is estimated.
        streams: topics of measurements.
        static: topics that are read whole.
        solve: streams by topic, of all runs -> outputs.
        priors: topics of priors, with their components.
        given: streams that the replay hands it beside those of the log.
        parameters: as it was bound with.
        needed: by topic, a field without which it does not fit a log.
        truth: the topic by which its estimates are judged, which it must not read.
    """

    name: str
    streams: tuple[str, ...]
    static: tuple[str, ...]
    solve: Callable[[dict[str, Ragged]], list[Ragged]]
    priors: Mapping[str, Components] = field(default_factory=dict)
    given: Mapping[str, Ragged] = field(default_factory=dict)
    parameters: Parameters | None = None
    needed: Mapping[str, Needed] = field(default_factory=dict)
    truth: str = ""


Bound = Recursive | Batch


@renamed(needs="requirements")
@dataclass(frozen=True)
class Estimator(Generic[ParametersType]):
    """Describes an estimator: what it is, its parameters, and how it binds to the topics of a log.

    Attributes:
        summary: what it is, in a line.
        requirements: what it needs of a log, in a line.
        parameters: the type of its parameters.
        bind: (name, topics, parameters) -> one bound estimator for everything that it can estimate in a
            log of these topics (each robot, say); none where the log does not fit.
        variant: the parameter that the rest of a name such as `lrkf:s2kf-50` sets.
        label: what it is called where it is given without one.
    """

    summary: str
    requirements: str
    parameters: type[ParametersType]
    bind: Callable[[str, Mapping[str, Topic], ParametersType], list[Bound]]
    variant: str | None = None
    label: str = "own"

    def __str__(self) -> str:
        return self.summary

    def specified(self, label: str, settings: Mapping[str, Setting]) -> "AnyEstimator":  # noqa: ARG002
        """Return what `settings` of `label` make of it: another where they name a foreign filter."""
        return self

    # one of any model has these by what the name says: `_OfAnyModel`
    def parameters_with(self, name: str, variant: Mapping[str, Setting]) -> type[Parameters]:  # noqa: ARG002
        """Return the parameters that count under `name` with `variant`, as `smoother:iterated`."""
        return self.parameters

    def parameters_by_model(
        self,
        name: str,  # noqa: ARG002
        variant: Mapping[str, Setting],  # noqa: ARG002
    ) -> dict[str, type[Parameters]]:
        """Return by model the parameters under `name` with `variant`; none where it is of no model."""
        return {}


# An estimator of any parameters, which a registry has by its name.
AnyEstimator = Estimator[Any]  # type: ignore[explicit-any]


def find_estimator(name: str) -> tuple[AnyEstimator, dict[str, Setting]]:
    """Return the registered estimator of `name`, and the parameter that a `name:variant` sets.

    Raises BadInput where there is none, or it has no variants.
    """
    kind, _, variant = name.partition(":")
    estimator: AnyEstimator = load("estimators", kind, Estimator)
    return estimator, set_by_variant("estimator", kind, variant, estimator.variant)


def set_by_variant(what: str, kind: str, variant: str, parameter: str | None) -> dict[str, Setting]:
    """Return the parameter that the variant of a name sets; nothing where the name has none.

    Raises BadInput where what is named, an estimator or a method of this kind, has no variants.
    """
    if not variant:
        return {}
    if parameter is None:
        raise BadInput(f"{what} {kind} has no variants; give '{kind}' without ':{variant}'")
    return {parameter: variant}


def configure(label: str, settings: Mapping[str, Setting]) -> tuple[AnyEstimator, Parameters]:
    """Make the estimator of a label, and its parameters.

    `label` is its name, or any word where an entry `kind` of the settings gives the name: so one
    estimator can be replayed with several settings at once. A `kind` may be an `Estimator` too, which
    needs no name. The other settings are its parameters.

    Raises BadInput where the name or a parameter is unknown, or the label is not fit for a topic's name.

    Args:
        label: see above.
        settings: by name, with `kind` perhaps among them.
    """
    if not re.fullmatch(r"[\w:=-]+", label):
        raise BadInput(
            f"estimator '{label}': a label may have letters, digits and '-', '_', ':', '=' alone; "
            "choose another"
        )
    estimator, values = specified(label, settings)
    return estimator, build(estimator.parameters, values, f"estimator {label}")


def specified(label: str, settings: Mapping[str, Setting]) -> tuple[AnyEstimator, dict[str, Setting]]:
    """Return the estimator of a label and the values of its parameters, which are not checked yet.

    Raises BadInput where the name is unknown or sets what a setting sets otherwise, or a foreign filter
    may not be run or does not answer.
    """
    values = {name: value for name, value in settings.items() if not name.startswith("/")}
    for name, value in settings.items():
        if name.startswith("/"):  # a parameter of a topic, or all of its own
            own = value if isinstance(value, Mapping) else None
            table = {name: own} if own is not None else nested(name, value)
            values["of_topics"] = merge(values.get("of_topics", {}), table)
    kind = values.pop("kind", label)
    estimator, variant = (kind, {}) if isinstance(kind, Estimator) else find_estimator(str(kind))
    for name, value in variant.items():
        if str(values.get(name, value)) != value:
            raise BadInput(
                f"estimator {label}: {kind} says {name} = {value}, and a setting {values[name]}; "
                "give one of them"
            )
    return estimator.specified(label, values), {**values, **variant}


@contextmanager
def code_of(name: str) -> Iterator[None]:
    """Name the estimator in what its code raises, and what does not compile, while this is entered."""
    try:
        with foreign_code(f"estimator {name}"):
            yield
    except DoesNotCompile as error:
        raise BadInput(f"estimator {name}: {error}") from error


def bound_to(
    estimator: AnyEstimator, label: str, topics: Mapping[str, Topic], parameters: Parameters
) -> list[Bound]:
    """Bind an estimator to topics; raises BadInput where it would read a truth."""
    bound = estimator.bind(label, topics, parameters)
    truths = truths_among(topics)
    for each in bound:
        if not (isinstance(each, Recursive) and each.is_bound):
            refuse_truths(label, (*each.static, *each.streams), {*truths, each.truth})
    return bound


def require_values(sources: Iterable[Source], bound: Bound) -> None:
    """Raise BadInput if no message of the runs has a value of a field that an estimator needs."""
    for topic, needed in bound.needed.items():
        runs = (source.whole().blocks([topic], "publish_time", NEEDED_MESSAGES) for source in sources)
        streams = (block[topic] for block in chain.from_iterable(runs) if topic in block)
        values = (stream.columns.get(needed.field) for stream in streams)
        if not any(of is not None and np.isfinite(of).all(axis=-1).any() for of in values):
            raise BadInput(f"topic {topic}: {needed.refusal}")


def bind(label: str, sources: Sequence[Source], settings: Mapping[str, Setting]) -> list[Bound]:
    """Bind an estimator to an ensemble; see `configure`.

    An ensemble keeps what was bound to it last, which is bound with the same settings again.

    Raises BadInput where it does not fit the log, or the runs are no ensemble: what the estimator reads
    of them must be stated alike.

    Args:
        label: of the estimator, see `configure`.
        sources: the runs.
        settings: its parameters by name, with `kind` perhaps among them.
    """
    ensemble = ensemble_of(sources)
    key = "bound", label, *((name, type(value), value) for name, value in settings.items())
    try:
        hash(key)
    except TypeError:  # a list or a table among the settings
        return _bound(label, ensemble, settings)
    return list(ensemble.findings.once(key, lambda: _bound(label, ensemble, settings)))


def _bound(label: str, ensemble: Ensemble[Source], settings: Mapping[str, Setting]) -> list[Bound]:
    estimator, parameters = configure(label, settings)
    first = ensemble[0]
    try:
        with code_of(label):
            bound = bound_to(estimator, label, first.topics, parameters)
    except BadInput as error:
        raise BadInput(f"{first.name}: {error}") from error
    if not bound:
        raise BadInput(
            f"{first.name}: estimator {label} does not fit this log: it needs {estimator.requirements}; "
            f"the log has {', '.join(first.topics) or 'no topics'}"
        )
    for each in bound:
        require_values(ensemble, each)
    read = dict.fromkeys(topic for each in bound for topic in (*each.static, *each.streams))
    ensemble.require_alike(read)
    return [
        each if each.parameters is not None else replace(each, parameters=parameters) for each in bound
    ]
