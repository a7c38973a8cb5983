"""List of all hypotheses on a run and the estimator that is bound to it.

Hypotheses on initial states, origins, stamps and swapped numbers or topics are made here.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.altering.changes import bare
from fuselog.pipeline.diagnosing.advice import Advice, number, precise
from fuselog.pipeline.diagnosing.hypotheses.components import of_components
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import (
    Hypothesis,
    in_sense,
    in_topic,
    supposed,
    value_of,
)
from fuselog.pipeline.diagnosing.hypotheses.parameters import (
    of_augmentable,
    of_covariances,
    of_declared,
    of_gate,
    of_noises,
)
from fuselog.pipeline.runs.trials import Trial
from fuselog.recorders.checks.finding import Kind
from fuselog.recorders.log import Stream
from fuselog.recorders.log.planes import Origin, stated_in
from fuselog.recorders.models.geodesy import out_of_tangent_plane
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.replaying.estimator import Bound, Reading
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.engine.vectors.components import components_of, stated_components
from fuselog.replay.judging.errors.evaluation import Floats, split_topic

FEWEST = 20  # fewest messages from which a topic's errors can be found

SIGMAS = (-1.0, 1.0, -4.0, 4.0)  # limit in standard deviations of a prior

STEP_M = 1.0
Metres = tuple[float, float]

DELAYS_S = (-0.02, 0.02, -0.1, 0.1, -0.4, 0.4, -2.0, 2.0, -8.0, 8.0)
SPECIAL_S = {18.0: "the leap seconds between GPS and UTC", -18.0: "the leap seconds from UTC to GPS"}
RATES = (-1e-4, 1e-4, -1e-3, 1e-3, -0.01, 0.01, -0.03, 0.03, -0.1, 0.1)
LONGEST_DELAY_S, LARGEST_RATE = 30.0, 0.2
LAGS_S = np.arange(-30.0, 30.05, 0.1)
FEWEST_SPEEDS = 20  # fewest speeds from which a lag can be estimated
MOST_CELLS = 1_000_000  # largest product of lags and speeds in memory

SUSPECT = 2.0  # mean NIS per component above which numbers may be swapped
SUSPECTS = 12  # number of suspects; all pairs of them are tried


def hypotheses(
    bound: Sequence[Bound],
    base: Trial,
    innovations: Mapping[str, Stream],
    readings: Mapping[str, Reading],
) -> list[Hypothesis]:
    """List all hypotheses.

    Args:
        bound: the bound estimators.
        base: the unaltered run, and the settings.
        innovations: the innovations of the unaltered run, with an open gate.
        readings: functions that read the measured numbers, by the name of the estimate.
    """
    source, parameters = base.source, bound[0].parameters
    streamed = list(dict.fromkeys(topic for each in bound for topic in each.streams))
    of_topic = {topic: readings.get(each.name) for each in bound for topic in each.streams}
    first_ns = source.extent("publish_time")[0]
    stated = (topic for each in bound for topic in each.priors if topic in source.streams)
    found = [*of_noises(bound, source, readings), *of_gate(parameters)]
    found += of_augmentable(bound, readings) if readings else of_declared(bound, source)
    for topic in streamed:
        stream, reading = source.streams[topic], of_topic[topic]
        if len(stream) < FEWEST:
            continue
        found += of_covariances(stream)
        found += of_origin(stream, reading)
        found += of_components(stream, reading, parameters, first_ns)
        if len(streamed) > 1:
            controls = reading.controls if reading else ()
            lags_s = lag_of(stream, [source.streams[each] for each in controls if each != topic])
            hold_s = hold_of(source.streams, controls)
            found += of_stamps(stream, reading, parameters, first_ns, hold_s, lags_s)
    for topic in dict.fromkeys(stated):
        found += of_start(source.streams[topic])
    return [*found, *of_numbers(bound, source, innovations)]


def of_start(prior: Stream) -> Iterator[Hypothesis]:
    """Yield hypotheses that a component of the initial state is different."""
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
            # a quaternion has three tangent components
            column += kinds[: place + 1].count("quaternion") < 4
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
        is_so, at, low, high = in_sense(at, low, high)
        size = f"{at:.3g} ({low:.3g} to {high:.3g}){' ' if unit else ''}{unit}"
        return f"{topic}: {name} at the start is {is_so} by {size}, {at / sigma:.2g} of its sigmas"

    def remedy(at: float) -> Advice:
        wider = f"a prior whose sigma of {name} is at least {abs(at):.2g}"
        return Advice(f"{topic}.{bare(name)}_bias", precise(at), otherwise=wider)

    tried = tuple(sigma * each for each in SIGMAS if sigma * abs(each) < limit)
    return Hypothesis("start", topic, name, tried, limit, in_topic(topic, alteration), words, remedy)


def of_origin(stream: Stream, reading: Reading | None) -> Iterator[Hypothesis]:
    """Yield the hypothesis that the origin of a topic's positions or geodetic fixes is different."""
    if "latitude_deg" in stream.columns:
        yield from _of_geodetic(stream)
    elif "position_m" in stream.columns and reading and stream.topic not in reading.controls:
        yield _of_positions(stream)


def _of_positions(stream: Stream) -> Hypothesis:
    def without(trial: Trial, by_m: Metres) -> Trial:
        for entry, by in enumerate(by_m):
            trial = trial.altered(stream.topic, alter.shifted("position_m", entry), -by)
        return trial

    def words(at: Metres, low: Metres, high: Metres) -> str:
        x, y = _too_far(at, low, high)
        return f"{stream.topic}: its positions are {x} along x and {y} along y: its origin is different"

    def remedy(at: Metres) -> Advice:
        place = ",".join(f"{precise(-each)}" for each in at)
        return Advice(f"{stream.topic}.origin", place, is_moved=True)

    return _origin(stream, "x_m, y_m", without, words, remedy)


def _of_geodetic(stream: Stream) -> Iterator[Hypothesis]:
    """Yield the hypothesis that geodetic fixes state a wrong origin, if they state one."""
    stated = stated_in(stream.topic, stream.metadata)
    if stated is None:
        return
    origin = stated

    def right(by_m: Metres) -> Origin:
        """Compute the origin from the eastward and northward errors of fixes."""
        latitude, longitude, _ = out_of_tangent_plane(by_m, origin)
        return origin._replace(latitude_deg=float(latitude), longitude_deg=float(longitude))

    def without(trial: Trial, by_m: Metres) -> Trial:
        apart = np.subtract(right(by_m), origin)
        for field, degrees in zip(("latitude_deg", "longitude_deg"), apart, strict=False):
            trial = trial.altered(stream.topic, alter.shifted(field), -float(degrees))
        return trial

    def words(at: Metres, low: Metres, high: Metres) -> str:
        east, north = _too_far(at, low, high)
        return (
            f"{stream.topic}: its fixes are {east} east and {north} north: the origin of the tangent "
            "plane is different"
        )

    def remedy(at: Metres) -> Advice:
        mended = right(at)
        return Advice(f"{stream.topic}.origin", f"{mended.latitude_deg:.8f},{mended.longitude_deg:.8f}")

    yield _origin(stream, "east_m, north_m", without, words, remedy)


def _too_far(at: Metres, low: Metres, high: Metres) -> list[str]:
    return [
        f"{number(value)} ({number(least)} to {number(most)}) m too far"
        for value, least, most in zip(at, low, high, strict=True)
    ]


def _origin(
    stream: Stream,
    part: str,
    without: Callable[[Trial, Metres], Trial],
    words: Callable[[Metres, Metres, Metres], str],
    remedy: Callable[[Metres], Advice],
) -> Hypothesis:
    kind: Kind = "bias or turned frame"
    tried = ((STEP_M, STEP_M),)
    return Hypothesis(kind, stream.topic, part, tried, np.inf, without, words, remedy, size=2)


def of_stamps(
    stream: Stream,
    reading: Reading | None,
    parameters: Parameters | None,
    first_ns: int,
    hold_s: float,
    lags_s: tuple[float, ...],
) -> Iterator[Hypothesis]:
    """Yield the hypotheses that a topic is delayed, and that its clock drifts.

    Args:
        stream: the topic's messages.
        reading: function that reads the measured numbers of the estimated object.
        parameters: the estimator's parameters, one of which may be the topic's delay.
        first_ns: the first stamp of the run.
        hold_s: half of the time for which a control applies; a smaller delay is no fault.
        lags_s: further delays to try.
    """
    topic = stream.topic
    own = reading.delays.get(topic, "") if reading else ""
    set_s = value_of(parameters, own, stream)

    def late(at: float, low: float, high: float) -> str:
        about = f", {SPECIAL_S[at]}" if at in SPECIAL_S else ""
        sense, at, low, high = in_sense(at, low, high, ("late", "early"))
        size, least, most = (f"{number(1e3 * each)} ms" for each in (at, low, high))
        if at >= 1.0:
            size, least, most = (f"{number(each, 4)} s" for each in (at, low, high))
        if sense == "early":
            return f"{topic}: its stamps are {size} early ({least} to {most}){about}"
        return f"{topic}: comes {size} late ({least} to {most}) by its stamps{about}"

    def mend_late(at: float) -> Advice:
        return Advice(own, precise(set_s + at)) if own else Advice(f"{topic}.delay_s", precise(at))

    def gaining(at: float, low: float, high: float) -> str:
        does, at, low, high = in_sense(at, low, high, ("gains", "loses"))
        return f"{topic}: its clock {does} {at:.3g} s a second ({low:.3g} to {high:.3g})"

    def mend_gaining(at: float) -> Advice:
        return Advice(f"{topic}.clock_gain", precise(at))

    yield Hypothesis(
        "delay",
        topic,
        "",
        tuple(dict.fromkeys((*DELAYS_S, *lags_s))),
        LONGEST_DELAY_S,
        in_topic(topic, alter.delayed),
        late,
        mend_late,
        tuple(SPECIAL_S),
        floor=hold_s,
        already=set_s,
    )
    clock = in_topic(topic, alter.drifted(first_ns))
    yield Hypothesis("clock drift", topic, "", RATES, LARGEST_RATE, clock, gaining, mend_gaining)


def hold_of(streams: Mapping[str, Stream], controls: tuple[str, ...]) -> float:
    """Return half of the longest median step of the controls, in s."""
    steps = [
        np.median(np.diff(streams[topic].publish_time_ns))
        for topic in controls
        if len(streams[topic]) > 1
    ]
    return 0.5e-9 * float(max(steps, default=0.0))


def lag_of(stream: Stream, controls: list[Stream]) -> tuple[float, ...]:
    """Estimate how far speeds from positions lag behind a control that correlates with them, in s.

    The lag with the best correlation is found on a grid of a tenth of a second, which is accurate enough
    for the start of a search.
    """
    if "position_m" not in stream.columns or len(stream) < FEWEST_SPEEDS:
        return ()
    times_s = 1e-9 * stream.publish_time_ns
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = np.linalg.norm(np.diff(stream["position_m"], axis=0), axis=1) / np.diff(times_s)
    known = np.isfinite(speed)
    middle_s, speed = 0.5 * (times_s[1:] + times_s[:-1])[known], speed[known]
    best = 0.0, 0.0
    for control in controls:
        for name, column in control.columns.items():
            if column.ndim != 1 or column.dtype.kind != "f" or name == "sensor_time_ns":
                continue
            driven_s = 1e-9 * control.publish_time_ns
            for lags_s in np.array_split(LAGS_S, 1 + len(LAGS_S) * len(speed) // MOST_CELLS):
                at_s = middle_s - lags_s[:, None]
                is_in = (at_s >= driven_s[0]) & (at_s <= driven_s[-1])
                alike = _correlations(np.abs(np.interp(at_s, driven_s, column)), speed, is_in)
                best = max([best, *zip(alike.tolist(), lags_s.tolist(), strict=True)])
    lag_s = round(best[1], 1)
    return (lag_s,) if best[0] > 0.5 and lag_s else ()


def _correlations(rows: Floats, column: Floats, is_in: NDArray[np.bool_]) -> Floats:
    """Correlate each row (k, n) with a column (n,) over common values; return -1 if unknown."""
    count = np.maximum(is_in.sum(axis=1, keepdims=True), 1)
    rows, columns = (
        np.where(is_in, each - np.where(is_in, each, 0.0).sum(axis=1, keepdims=True) / count, 0.0)
        for each in (rows, column)
    )
    size = np.sqrt((rows**2).sum(axis=1) * (columns**2).sum(axis=1))
    is_known = (count[:, 0] >= FEWEST_SPEEDS) & (size > 0.0)  # false if one of them is NaN
    return np.where(is_known, (rows * columns).sum(axis=1) / np.where(is_known, size, 1.0), -1.0)


def of_numbers(
    bound: Sequence[Bound], source: MemorySource, innovations: Mapping[str, Stream]
) -> Iterator[Hypothesis]:
    """Yield hypotheses that two identifiers in a map, or two topics, are swapped."""
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
            without = in_topic(topic, alter.renumbered(field, first, second))
            words = f"{topic}: {field} {first} and {second} are swapped"
            advice = Advice(f"{topic}.exchanged", f"{first},{second}")
            yield supposed("exchanged numbers", topic, f"{first} {second}", without, words, advice)
    of_case = {split_topic(each.name + "/_")[1]: each.streams for each in bound}
    cases = _suspects((split_topic(topic)[1], stream) for topic, stream in innovations.items())
    for one, other in combinations(sorted(each for each in cases if each in of_case), 2):
        for here, there in zip(of_case[one], of_case[other], strict=False):
            if source.topics[here].schema_name == source.topics[there].schema_name:
                words = f"{here} and {there} are swapped"
                advice = Advice(f"{here}.exchanged", there)
                without = _back(here, there)
                yield supposed("exchanged numbers", here, there, without, words, advice)


def _back(first: str, second: str) -> Callable[[Trial, float], Trial]:
    """Make a function that swaps the messages of two topics back in a trial."""
    return lambda trial, _: replace(trial, runs=[alter.exchanged(trial.source, first, second)])


def _suspects(parts: Iterable[tuple[Any, Stream]]) -> list[Any]:
    """Choose the parts with the largest mean NIS, or no parts if even the largest mean is acceptable."""
    means: dict[Any, float] = {}
    for name, stream in parts:
        degrees = np.isfinite(stream["innovation"]).sum()
        if degrees:
            nis = np.nansum(stream["normalised_innovation_squared"]) / degrees
            means[name] = max(means.get(name, 0.0), float(nis))
    worst = sorted(means, key=lambda name: -means[name])[:SUSPECTS]
    return worst if worst and means[worst[0]] > SUSPECT else []
