"""Hypotheses on the origin of positions or of geodetic fixes."""

from collections.abc import Callable, Iterator

import numpy as np

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.diagnosing.advice import Advice, number, precise
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import Hypothesis
from fuselog.pipeline.runs.trials import Trial
from fuselog.recorders.checks.finding import Kind
from fuselog.recorders.log import Stream
from fuselog.recorders.log.planes import Origin, stated_in
from fuselog.recorders.models.geodesy import out_of_tangent_plane
from fuselog.replay.engine.replaying.estimator import Reading

STEP_M = 1.0
Metres = tuple[float, float]


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
