"""Estimators as the replay uses them: their parameters, their topics, and how they are called.

An estimator is bound to topics and turns ragged streams into ragged streams. A recursive estimator gets
the blocks of its topics one after another and carries a state from block to block; a batch estimator
gets whole streams. A single run and an ensemble use the same call, so an ensemble gives exactly the same
results, bit for bit, as its runs replayed one by one.
"""

import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
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
    """Result of an initialization: static topics to start from, and output streams."""

    static: dict[str, Ragged]
    outputs: list[Ragged]


@dataclass(frozen=True)
class Initialization:
    """Method for finding values that a log does not state, such as the initial state.

    Attributes:
        topics: topics whose first messages are passed to `find` or `find_broad`.
        find: find(first messages, static topics, clock) -> the static topics to start from, and output
            streams; `clock` is the clock by which the replay stamps estimates.
        find_broad: find_broad(first messages, static topics, clock, a stamp for each run) -> equally
            likely starts of all runs at these stamps, so broad that the parameters do not influence
            them. Likelihoods that are to be compared, for example for different parameters or for a log
            and an altered copy of it, are computed from these starts. None if `find` is used instead.
    """

    topics: tuple[str, ...]
    find: Callable[[Mapping[str, Ragged], Mapping[str, Ragged], Clock], Initialized]
    find_broad: (
        Callable[[Mapping[str, Ragged], Mapping[str, Ragged], Clock, Sequence[int]], list[Initialized]]
        | None
    ) = None


NEEDED_MESSAGES = 4096  # to read at a time, until a message has a needed value


@dataclass(frozen=True)
class Reading:
    """The fields of topics and the parameters that the functions of an estimator's model read.

    Attributes:
        controls: topics that drive the motion.
        kinds: by topic, the kinds of the components that the model reads from a message: controls or
            measurements.
        measured: by topic of a sensor, the names that innovations use for these components.
        numbers: numbers(stream of one of these topics) -> the values (n, m) of these components; missing
            values are NaN.
        noises: parameters that are standard deviations of noise, each with the topic of its sensor, or
            "" for the motion.
        augmentable: parameters that can be estimated together with the state, each with its kind and
            the topics of the sensors that read it ("" for the motion).
        biases, factors: by topic and index of a component, the parameter that is added to the component,
            or that multiplies it.
        delays: by topic, the parameter with the delay of the topic's messages.
        calibration: parameters of the mounting, scale, bias and delay of the model's sensors, each with
            the largest standard deviation at which its estimate is useful.
        control_noise: control_noise(time in s for which a control message applies) -> by topic and index
            of a component, the variance that the model states; empty if the model states no variance.
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


# The state that a recursion carries from block to block; the recursion defines its type.
Carried = Any  # type: ignore[explicit-any]
# The value of a setting: a number, a string, a list or a table.
Setting = Any  # type: ignore[explicit-any]


class Needed(NamedTuple):
    """Requirement that at least one message of a topic has a value in a field.

    Attributes:
        field: name of the field.
        refusal: error message if no message has such a value.
    """

    field: str
    refusal: str


class Alike(NamedTuple):
    """Description of bound estimators that can process runs together if only numerical settings differ.

    Attributes:
        key: equal for estimators that can be combined.
        numbers: the numerical settings of this estimator.
        together: together(settings of each run) -> an estimator in which each run has its own settings.
            The initialization must not depend on the settings.
        again: again(values of parameters) -> the estimator bound with these values in place of its own,
            or None if that needs more than other numbers. It raises BadInput if a value is invalid. None
            if the estimator always has to be bound from the start.
    """

    key: Hashable
    numbers: NDArray[np.float64]
    together: "Callable[[NDArray[np.float64]], Recursive]"
    again: "Callable[[Mapping[str, float]], Recursive | None] | None" = None


@renamed(whole="static", rewinding="out_of_sequence", opening="initialization")
@dataclass(frozen=True, eq=False)
class Recursive:
    """Bound estimator that processes its topics in time order.

    Attributes:
        name: name of the estimator; its output topics begin with `/estimates/` + name.
        streams: topics that `run` gets, in the order of the indices in `Events.topic`.
        static: topics that `start` needs as a whole, such as a map or a prior.
        start: start(static topics) -> the state before the first block.
        run: run(state, block) -> the state after the block, and the output streams. `run` never
            modifies the state that it is given.
        priors: static topics that are Gaussian priors, and the components wanted from each. For every
            run, `start` gets one message of each prior, with these components, or with NaN if the run
            cannot start; see `fuselog.replay.engine.streams.priors`.
        given: static topics that are not read from the runs; see `fuselog.pipeline.runs.initial_states`.
        finish: finish(state after the last block) -> the outputs that were still waiting for further
            messages.
        parameters: its parameters, including defaults.
        out_of_sequence: out_of_sequence(nanoseconds) -> the same estimator for messages in order of
            arrival whose stamps go back by at most this time. The function is None if the estimator
            cannot reprocess messages. It raises BadInput if the parameters do not allow reprocessing.
        initialization: how the estimator finds initial values that the log does not state; None if the
            log states them all.
        assumed: values of the parameters that are assumed, because the log does not state them.
        is_random: whether it draws random numbers, so that its likelihood is not a smooth function of
            its parameters.
        offers: for each topic that the estimator does not use but could, the setting that makes it use
            the topic.
        reading: what the estimator reads; None if this is unknown.
        needed: by topic, a field that a log must have for the estimator to fit it.
        truth: topic with the truth to which the estimates are compared; the estimator must not read it.
        is_bound: whether it computes a bound instead of estimates; a bound may read the truth.
        alike: how the estimator processes runs together with others that differ only in numerical
            settings, or None if it cannot.
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
    """Bound estimator that needs its topics as a whole.

    `streams` are the measurements within the replayed span; everything else is as for `Recursive`.

    Attributes:
        name: the label, followed by the name of the estimated object.
        streams: topics of measurements.
        static: topics that are read as a whole.
        solve: solve(streams of all runs by topic) -> the output streams.
        priors: topics of priors, with their components.
        given: streams that the replay passes in addition to the log's streams.
        parameters: its parameters, including defaults.
        needed: by topic, a field that a log must have for the estimator to fit it.
        truth: topic with the truth to which the estimates are compared; the estimator must not read it.
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
    """Registered estimator: its description, its parameters, and how it binds to the topics of a log.

    Attributes:
        summary: one-line description.
        requirements: what a log must contain, in one line.
        parameters: type of its parameters.
        bind: bind(name, topics, parameters) -> a list with one bound estimator for each object that it
            can estimate in a log with these topics (for each robot, say). The list is empty if the log
            does not fit.
        variant: the parameter that is set by the part after the colon in a name such as `lrkf:s2kf-50`.
        label: label of the estimator if the user gives none.
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
        """Return the estimator for `label` and `settings`: `self`, unless the filter is foreign."""
        return self

    # an estimator of any model overrides these two: `_OfAnyModel`
    def parameters_with(self, name: str, variant: Mapping[str, Setting]) -> type[Parameters]:  # noqa: ARG002
        """Return the parameters of `name` with `variant`, such as those of `smoother:iterated`."""
        return self.parameters

    def parameters_by_model(
        self,
        name: str,  # noqa: ARG002
        variant: Mapping[str, Setting],  # noqa: ARG002
    ) -> dict[str, type[Parameters]]:
        """Return the parameters of `name` with `variant`, by model, or {} if it uses no models."""
        return {}


# An estimator with any parameters, as registered under a name.
AnyEstimator = Estimator[Any]  # type: ignore[explicit-any]


def find_estimator(name: str) -> tuple[AnyEstimator, dict[str, Setting]]:
    """Look up the registered estimator of `name`, and the parameter that `name:variant` sets.

    Raises BadInput if no such estimator is registered, or if it has no variants.
    """
    kind, _, variant = name.partition(":")
    estimator: AnyEstimator = load("estimators", kind, Estimator)
    return estimator, set_by_variant("estimator", kind, variant, estimator.variant)


def set_by_variant(what: str, kind: str, variant: str, parameter: str | None) -> dict[str, Setting]:
    """Return the parameter that a name's variant sets, or an empty dict if the name has no variant.

    Raises BadInput if the named estimator or method has no variants.
    """
    if not variant:
        return {}
    if parameter is None:
        raise BadInput(f"{what} {kind} has no variants; give '{kind}' without ':{variant}'")
    return {parameter: variant}


def configure(label: str, settings: Mapping[str, Setting]) -> tuple[AnyEstimator, Parameters]:
    """Create the estimator that a label names, together with its parameters.

    `label` is the estimator's name. If the settings have an entry `kind`, that entry gives the name, and
    the label can be any word; one estimator can therefore be replayed with several settings in one pass.
    A `kind` may also be an `Estimator`, which needs no name. The other settings are parameters.

    Raises BadInput if the name or a parameter is unknown, or if the label cannot be part of a topic
    name.

    Args:
        label: see above.
        settings: values by name, optionally with `kind`.
    """
    if not re.fullmatch(r"[\w:=-]+", label):
        raise BadInput(
            f"estimator '{label}': a label can only have letters, digits, '-', '_', ':' and '='; "
            "choose another"
        )
    estimator, values = specified(label, settings)
    return estimator, build(estimator.parameters, values, f"estimator {label}")


def specified(label: str, settings: Mapping[str, Setting]) -> tuple[AnyEstimator, dict[str, Setting]]:
    """Return the estimator that a label names, and its parameters' values, which are not yet checked.

    Raises BadInput if the name is unknown, if it conflicts with a setting, or if a foreign filter may
    not be run or does not answer.
    """
    values = {name: value for name, value in settings.items() if not name.startswith("/")}
    for name, value in settings.items():
        if name.startswith("/"):  # a parameter of a topic, or a table of all its parameters
            own = value if isinstance(value, Mapping) else None
            table = {name: own} if own is not None else nested(name, value)
            values["of_topics"] = merge(values.get("of_topics", {}), table)
    kind = values.pop("kind", label)
    estimator, variant = (kind, {}) if isinstance(kind, Estimator) else find_estimator(str(kind))
    for name, value in variant.items():
        if str(values.get(name, value)) != value:
            raise BadInput(
                f"estimator {label}: {kind} sets {name} = {value}, but a setting says {values[name]}; "
                "give only one of them"
            )
    return estimator.specified(label, values), {**values, **variant}


@contextmanager
def code_of(name: str) -> Iterator[None]:
    """Add the estimator's name to exceptions that its code raises and to compilation errors."""
    try:
        yield
    except DoesNotCompile as error:
        raise BadInput(f"estimator {name}: {error}") from error
    except Exception:
        with foreign_code(f"estimator {name}"):
            raise


def bound_to(
    estimator: AnyEstimator, label: str, topics: Mapping[str, Topic], parameters: Parameters
) -> list[Bound]:
    """Bind an estimator to topics; raise BadInput if it would read a truth."""
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

    The ensemble caches the estimators last bound to it, so binding with the same settings again is free,
    and binding with other numbers is faster.

    Raises BadInput if the estimator does not fit the log, or if its topics differ from run to run.

    Args:
        label: label of the estimator, see `configure`.
        sources: the runs.
        settings: its parameters by name, optionally with `kind`.
    """
    ensemble = ensemble_of(sources)
    key = "bound", label, *((name, type(value), value) for name, value in settings.items())
    try:
        hash(key)
    except TypeError:  # a list or a table among the settings
        return _bound(label, ensemble, settings)
    return list(ensemble.findings.once(key, lambda: _bound_again(label, ensemble, settings)))


def _bound_again(label: str, ensemble: Ensemble[Source], settings: Mapping[str, Setting]) -> list[Bound]:
    """Bind an estimator; if it is known with other numbers, only these change."""
    others = ((name, value) for name, value in settings.items() if not isinstance(value, float))
    numbers = tuple(name for name, value in settings.items() if isinstance(value, float))
    key = label, numbers, *((name, type(value), value) for name, value in others)
    known, bound = ensemble.bound.once(key, lambda: (dict(settings), _bound(label, ensemble, settings)))
    changed = {name: settings[name] for name in numbers if settings[name] != known[name]}
    if not changed:
        return bound
    made = [again for each in bound if (again := _with_numbers(label, each, changed)) is not None]
    return made if len(made) == len(bound) else _bound(label, ensemble, settings)


def _with_numbers(label: str, bound: Bound, numbers: Mapping[str, float]) -> Bound | None:
    """Bind an estimator with other numbers; None if it has to be bound from the start."""
    again = bound.alike.again if isinstance(bound, Recursive) and bound.alike else None
    if again is not None:
        with suppress(BadInput), code_of(label):
            return again(numbers)
    return None


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
