"""What may be wrong: alternatives to a log and the settings it is replayed with, of one number each.

Every alternative is a trial as it would be without the fault; what that gains in log-likelihood says
how likely the fault is. Some cannot be told apart, and are one kind: a bearing's bias and its sensor's
turned frame. One topic that is late and all others that are early are one fault too: messages come
late. Of two clocks nothing says which of them drifts.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np

from pipeline.altering import alterations as alter
from pipeline.altering.changes import bare, entry_of
from pipeline.diagnosing.advice import Advice, precise, rounded
from pipeline.diagnosing.likelihood import Trial
from pipeline.diagnosing.numbers import number
from pipeline.tuning.objective import with_values
from recorders.log import Stream, Topic
from recorders.parameters import Parameters
from replay.engine.replaying.estimator import Bound
from replay.engine.streams.channels import stated
from replay.engine.streams.sources import MemorySource
from replay.engine.vectors.components import components_of, stated_components
from replay.judging.errors.evaluation import split_topic

Kind = Literal[
    "measurement noise",
    "process noise",
    "bias or turned frame",
    "delay",
    "clock drift",
    "exchanged numbers",
    "start",
    "outliers",
    "lost messages",
    "stamps",
    "values",
    "gate",
    "covariance floor",
    "divergence",
    "unseen error",
    "unnamed",
]
NOISE = re.compile(r"(^|_)(sigma|density)(_|$)")
BEGINNING = re.compile(
    r"^(start|tilt|heading|unmeasured|gyro_bias|force_bias)_.*sigma|_bias_sigma_|^start_"
)
SCALES = (-0.7, 0.7, -2.0, 2.0)  # logarithms
DELAYS_S = (0.005, 0.02, 0.08)
RATES = (-1e-5, 1e-5, -1e-4, 1e-4, -1e-3, 1e-3)
ANGLES_RAD = (-0.03, 0.03, -0.3, 0.3)
SHARES = (-0.001, 0.001, -0.01, 0.01, -0.1, 0.1)  # of how much what is measured varies
SIGMAS = (-1.0, 1.0, -4.0, 4.0)  # of a prior
LONGEST_DELAY_S, LARGEST_RATE = 1.0, 0.01
SUSPECT = 2.0  # a mean NIS per component, above which numbers may be exchanged
SUSPECTS = 12  # of which all pairs are tried
GATE = 0.999
FEWEST = 20  # messages of which a topic's errors can be told


@dataclass(frozen=True)
class Hypothesis:
    """One way in which a log or its settings may be wrong.

    Attributes:
        kind: what those that cannot be told apart have in common.
        topic: the topic that it is of, or the parameter.
        part: the component of the topic, if it is of one.
        tried: numbers to begin the search with, see `peak`; a single one where it is so, or is not.
        limit: of the number's magnitude.
        without: the trial without the fault of this number.
        words: what is wrong, from the number and the ends of its 95 % interval.
        mend: what to try against this number; None where it is done already.
    """

    kind: Kind
    topic: str
    part: str
    tried: tuple[float, ...]
    limit: float
    without: Callable[[Trial, float], Trial]
    words: Callable[[float, float, float], str]
    mend: Callable[[float], Advice | None]

    @property
    def has_end(self) -> bool:
        """Whether what lies beyond the limit is not searched; an angle is, where it comes round."""
        return len(self.tried) > 1 and self.limit not in (np.pi, np.inf)


def hypotheses(
    bound: Sequence[Bound], base: Trial, innovations: Mapping[str, Stream]
) -> list[Hypothesis]:
    """All that may be wrong of a run and the estimator that is bound to it.

    `innovations` are those of the run as it is, without a gate.
    """
    source, parameters = base.source, bound[0].parameters
    streamed = list(dict.fromkeys(topic for each in bound for topic in each.streams))
    stated = (topic for each in bound for topic in each.priors if topic in source.streams)
    priors = list(dict.fromkeys(stated))
    found = [*_noises(bound, source), *_outliers(parameters)]
    stamps = [source.streams[topic].publish_time_ns for topic in streamed if len(source.streams[topic])]
    first_ns = min(int(each[0]) for each in stamps)
    last_ns = max(int(each[-1]) for each in stamps)
    begins_ns = [source.streams[topic].publish_time_ns[:1] for topic in priors]
    first_ns = min([first_ns, *(int(each[0]) for each in begins_ns if len(each))])
    timing = alter.delayed(first_ns, last_ns), alter.drifted(first_ns, last_ns)
    for topic in streamed:
        stream = source.streams[topic]
        if len(stream) >= FEWEST:
            found += _spreads(stream)
            found += _biases(stream, parameters)
            if len(streamed) > 1:
                found += _clocks(stream, *timing, parameters)
    for topic in priors:
        found += _starts(source.streams[topic])
    return [*found, *_exchanges(bound, source, innovations)]


def _in_topic(topic: str, alteration: alter.Alteration) -> Callable[[Trial, float], Trial]:
    """The trial with the opposite of an alteration."""
    return lambda trial, value: trial._replace(
        source=alter.altered(trial.source, topic, alteration, -value)
    )


def _noises(bound: Sequence[Bound], source: MemorySource) -> Iterator[Hypothesis]:
    """The noise that the estimator's parameters state, or channels for them."""
    parameters = bound[0].parameters
    if parameters is None:
        return
    read = [source.topics[topic] for each in bound for topic in (*each.streams, *each.static)]
    for name in type(parameters).model_fields:
        value = _noise_of(parameters, name, read)
        if value is None:
            continue
        kind: Kind = "measurement noise" if name.startswith("sigma_") else "process noise"
        letter = "R" if kind == "measurement noise" else "Q"

        def without(trial: Trial, logarithm: float, name: str = name, value: float = value) -> Trial:
            settings = with_values(trial.settings, [name], np.array([value * np.exp(logarithm)]))
            return trial._replace(settings=settings)

        def words(at: float, low: float, high: float, name: str = name, letter: str = letter) -> str:
            return f"{name}: {_times(at, low, high)}, so that {letter} is too {_size(at)}"

        def mend(at: float, name: str = name, value: float = value) -> Advice:
            return Advice(name, rounded(value * np.exp(at)), free=name)

        yield Hypothesis(kind, name, "", SCALES, 12.0, without, words, mend)


def _noise_of(parameters: Parameters, name: str, read: Sequence[Topic]) -> float | None:
    """The value of a parameter that is a noise: given, or as a channel states it."""
    if not NOISE.search(name) or BEGINNING.search(name):
        return None
    value = getattr(parameters, name)
    if value is None:
        value = stated(read, name, type(parameters), needed=False)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and 0.0 < value < np.inf else None


def _times(at: float, low: float, high: float) -> str:
    least, most = (
        number(np.exp(abs(end)) if at * end > 0 else 1.0) for end in sorted((low, high), key=abs)
    )
    factor = number(np.exp(abs(at)))
    return f"the standard deviation is {factor} times ({least} to {most}) too {_size(at)}"


def _size(at: float) -> str:
    return "small" if at > 0.0 else "large"


def _spreads(stream: Stream) -> Iterator[Hypothesis]:
    """The covariances that messages state."""
    for field in ("covariance_m2", "covariance_m2ps2", "covariance"):
        if field not in stream.columns or not np.isfinite(stream[field]).any():
            continue

        def words(at: float, low: float, high: float, field: str = field) -> str:
            return f"{stream.topic}: of {field} {_times(at, low, high)}, so that R is too {_size(at)}"

        def mend(at: float) -> Advice:
            return Advice(f"{stream.topic}.covariance_scale", precise(np.exp(2.0 * at)))

        def without(trial: Trial, logarithm: float, field: str = field) -> Trial:
            source = alter.altered(trial.source, stream.topic, alter.spread(field), logarithm)
            return trial._replace(source=source)

        yield Hypothesis("measurement noise", stream.topic, "", SCALES, 12.0, without, words, mend)


def _biases(stream: Stream, parameters: Parameters | None) -> Iterator[Hypothesis]:
    """What is measured is too large, or its frame is turned; biases of inertial units are states."""
    for entry in stream.schema:
        column = stream.columns.get(entry.name)
        if column is None or entry.name.startswith("covariance"):
            continue
        if entry.kind == "real":
            yield from _bias(stream, entry.name, None, parameters)
        elif entry.kind == "vector" and entry.name in ("position_m", "velocity_mps"):
            for place in range(column.shape[1]):
                yield from _bias(stream, entry.name, place, parameters)
            yield _turn(stream, entry.name)


def _bias(
    stream: Stream, field: str, place: int | None, parameters: Parameters | None
) -> Iterator[Hypothesis]:
    column = stream[field] if place is None else stream[field][:, place]
    known = column[np.isfinite(column)]
    if not len(known):
        return
    name, varies = field, float(np.std(known)) or 1.0
    if place is not None:
        name = entry_of(field, place)
    own = next(
        (each for each in (f"bias_{name}", name.replace("_", "_bias_", 1)) if _has(parameters, each)), ""
    )
    is_angle = field == "bearing_rad"

    def words(at: float, low: float, high: float) -> str:
        size = f"{stream.topic}: {name} is too large by {number(at)} ({number(low)} to {number(high)})"
        if not is_angle:
            return size
        return f"{size}, or the sensor's frame is turned by {np.degrees(-at):.2g} deg, which is the same"

    def mend(at: float) -> Advice:
        if own:
            return Advice(own, rounded(at if own.startswith("bias_") else -at), free=own)
        return Advice(f"{stream.topic}.{bare(name)}_bias", precise(at))

    yield Hypothesis(
        "bias or turned frame",
        stream.topic,
        name,
        tuple(varies * share for share in SHARES),
        np.pi if is_angle else np.inf,
        _in_topic(stream.topic, alter.shifted(field, place)),
        words,
        mend,
    )


def _has(parameters: Parameters | None, name: str) -> bool:
    return parameters is not None and name in type(parameters).model_fields


def _turn(stream: Stream, field: str) -> Hypothesis:
    def words(at: float, low: float, high: float) -> str:
        at, low, high = (float(np.degrees(each)) for each in (at, low, high))
        size = f"{at:.3g} ({low:.3g} to {high:.3g}) deg"
        return f"{stream.topic}: {field} is turned about the vertical by {size}"

    def mend(at: float) -> Advice:
        return Advice(f"{stream.topic}.{bare(field)}_turn", precise(at))

    without = _in_topic(stream.topic, alter.turned(field))
    return Hypothesis(
        "bias or turned frame", stream.topic, field, ANGLES_RAD, np.pi, without, words, mend
    )


def _clocks(
    stream: Stream, delay: alter.Alteration, drift: alter.Alteration, parameters: Parameters | None
) -> Iterator[Hypothesis]:
    """The stamps are later than what was measured, or their clock gains."""
    topic = stream.topic
    own = f"{topic.rpartition('/')[2]}_delay_s"

    def late(at: float, low: float, high: float) -> str:
        return (
            f"{topic}: comes {number(1e3 * at)} ms late ({number(1e3 * low)} to {number(1e3 * high)}) "
            "by its stamps"
        )

    def mend_late(at: float) -> Advice:
        return Advice(own if _has(parameters, own) else f"{topic}.delay_s", precise(at))

    def gaining(at: float, low: float, high: float) -> str:
        return f"{topic}: its clock gains {at:.3g} s a second ({low:.3g} to {high:.3g})"

    def mend_gaining(at: float) -> Advice:
        return Advice(f"{topic}.clock_gain", precise(at))

    yield Hypothesis(
        "delay", topic, "", DELAYS_S, LONGEST_DELAY_S, _in_topic(topic, delay), late, mend_late
    )
    yield Hypothesis(
        "clock drift", topic, "", RATES, LARGEST_RATE, _in_topic(topic, drift), gaining, mend_gaining
    )


def _starts(prior: Stream) -> Iterator[Hypothesis]:
    """The state at the start is another one."""
    if len(prior) != 1 or not prior.components:
        return
    covariance = prior["covariance"][0]
    size = round(len(covariance) ** 0.5)
    names = components_of(prior.components)
    kinds = list(stated_components(prior.metadata, names, f"topic {prior.topic}").values())
    variances = np.diagonal(covariance.reshape(size, size))
    has_rotation = "quaternion" in kinds
    column = 0
    for place, (name, kind) in enumerate(zip(prior.components, kinds, strict=True)):
        if kind == "quaternion" and place and kinds[place - 1] == "quaternion":
            column += kinds[: place + 1].count("quaternion") < 4  # three of four are tangent
            continue
        sigma = float(np.sqrt(variances[min(column, size - 1)]))
        column += 1
        if kind == "quaternion":
            yield _start(prior.topic, "heading", alter.heading_turned, sigma, "rad", np.pi)
        elif sigma > 0.0 and not (has_rotation and place > kinds.index("quaternion")):
            limit = np.pi if kind == "angle" else np.inf
            yield _start(prior.topic, name, alter.shifted("mean", place), sigma, "", limit)


def _start(
    topic: str, name: str, alteration: alter.Alteration, sigma: float, unit: str, limit: float
) -> Hypothesis:
    def words(at: float, low: float, high: float) -> str:
        size = f"{at:.3g} ({low:.3g} to {high:.3g}){' ' if unit else ''}{unit}"
        return (
            f"{topic}: {name} at the start is too large by {size}, {abs(at) / sigma:.2g} of its sigmas"
        )

    def mend(at: float) -> Advice:
        wider = f"a prior whose sigma of {name} is at least {abs(at):.2g}"
        return Advice(f"{topic}.{bare(name)}_bias", precise(at), otherwise=wider)

    tried = tuple(sigma * each for each in SIGMAS if sigma * abs(each) < limit)
    return Hypothesis("start", topic, name, tried, limit, _in_topic(topic, alteration), words, mend)


def _outliers(parameters: Parameters | None) -> Iterator[Hypothesis]:
    """Some measurements are of something else; a gate keeps these out."""
    if not _has(parameters, "gate_probability"):
        return

    def without(trial: Trial, _: float) -> Trial:
        settings = {**trial.settings, "gate_probability": GATE, **_reopens(parameters)}
        return trial._replace(settings=settings)

    is_closed = getattr(parameters, "gate_probability", 1.0) <= GATE
    yield Hypothesis(
        "outliers",
        "gate_probability",
        "",
        (1.0,),
        1.0,
        without,
        lambda *_: "some measurements are outliers: of something else, or false",
        lambda _: None if is_closed else Advice("gate_probability", GATE),
    )


def _reopens(parameters: Parameters | None) -> dict[str, Any]:
    return {"gate_reopens_s": 1.0} if _has(parameters, "gate_reopens_s") else {}


def _exchanges(
    bound: Sequence[Bound], source: MemorySource, innovations: Mapping[str, Stream]
) -> Iterator[Hypothesis]:
    """Two numbers of a map, or two topics, stand for each other."""
    maps = {
        topic: field.name
        for each in bound
        for topic in each.static
        if topic in source.streams
        for field in source.streams[topic].schema
        if field.kind == "identifier" and topic not in each.priors
    }
    targets = _suspects(
        (int(target), stream.take(stream["target_id"] == target))
        for stream in innovations.values()
        for target in np.unique(stream["target_id"])
    )
    for topic, field in maps.items():
        known = set(source.streams[topic][field].tolist())
        for first, second in combinations(sorted(each for each in targets if each in known), 2):
            without = _in_topic(topic, alter.renumbered(field, first, second))
            words = f"{topic}: {field} {first} and {second} are exchanged"
            advice = Advice(f"{topic}.exchanged", f"{first},{second}")
            yield _exchange(topic, f"{first} {second}", words, advice, without)
    of_case = {split_topic(each.name + "/_")[1]: each.streams for each in bound}
    cases = _suspects((split_topic(topic)[1], stream) for topic, stream in innovations.items())
    for one, other in combinations(sorted(each for each in cases if each in of_case), 2):
        for here, there in zip(of_case[one], of_case[other], strict=False):
            if source.topics[here].schema_name == source.topics[there].schema_name:
                words = f"{here} and {there} are exchanged"
                advice = Advice(f"{here}.exchanged", there)
                yield _exchange(here, there, words, advice, _back(here, there))


def _back(first: str, second: str) -> Callable[[Trial, float], Trial]:
    """The trial with the messages of two topics exchanged."""
    return lambda trial, _: trial._replace(source=alter.exchanged(trial.source, first, second))


def _suspects(parts: Iterable[tuple[Any, Stream]]) -> list[Any]:
    """Those with the largest mean NIS, if that is too large at all."""
    means: dict[Any, float] = {}
    for name, stream in parts:
        degrees = np.isfinite(stream["innovation"]).sum()
        if degrees:
            nis = np.nansum(stream["normalised_innovation_squared"]) / degrees
            means[name] = max(means.get(name, 0.0), float(nis))
    worst = sorted(means, key=lambda name: -means[name])[:SUSPECTS]
    return worst if worst and means[worst[0]] > SUSPECT else []


def _exchange(
    topic: str, part: str, words: str, advice: Advice, without: Callable[[Trial, float], Trial]
) -> Hypothesis:
    return Hypothesis(
        "exchanged numbers",
        topic,
        part,
        (1.0,),
        1.0,
        without,
        lambda *_: words,
        lambda _: advice,
    )
