"""Detection of a unit's initial stationary period from gyro, specific force and magnetic field.

The mean of the gyro during this period is the gyro's bias. Means over short windows are compared with
the mean of all previous windows: the period ends when a window differs by more than its noise explains.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, Stream
from fuselog.replay.engine.arrays import Booleans, Floats
from fuselog.replay.engine.replaying.estimator import (
    Bound,
    Estimator,
    Initialization,
    Initialized,
    Recursive,
)
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.families.directional.orientation.magnetometers import with_magnetometer
from fuselog.replay.inference.run.first_messages import Fact, started

REST = "rest"  # the key under which `start` finds the samples of the rest
LONGEST_S, LEAST_S = 20.0, 1.0  # longest and shortest rest to use; a shorter one cannot determine a bias
WINDOW_S = 0.25
SIGMAS = 6.0  # of the noise; above this, the mean of a window counts as different
LEAST_RATE_RADPS, LEAST_ANGLE_RAD = 0.02, np.radians(2.0)  # smaller values are not motion
LARGEST_BIAS_RADPS = 0.35


def resting(stream: Stream) -> int:
    """Count the samples before a unit first moves, for at most `LONGEST_S`; 0 if it moves immediately.

    Args:
        stream: inertial samples in time order.
    """
    since_s = 1e-9 * (stream.publish_time_ns - stream.publish_time_ns[:1])
    stream = stream.take(since_s < LONGEST_S)
    since_s = since_s[: len(stream)]
    of_window = np.floor(since_s / WINDOW_S).astype(np.int64)
    columns = ("turn_rate_radps", "specific_force_mps2", "magnetic_field_ut")
    moves = np.zeros(int(of_window.max(initial=-1)) + 1, bool)
    for name, is_rate in zip(columns, (True, False, False), strict=True):
        values = stream.columns.get(name)
        if values is not None and np.isfinite(values).all(axis=1).any():
            moves |= _differing(values, of_window, len(moves), is_rate=is_rate)
    if not moves.any():
        return len(stream)
    last = int(np.argmax(moves)) - 1  # the motion may already begin slowly in this window
    return int(np.count_nonzero(of_window < last))


def _differing(values: Floats, of_window: Any, count: int, *, is_rate: bool) -> Booleans:
    """Find the windows (count,) whose mean differs from that of all previous windows."""
    known = np.isfinite(values).all(axis=1)
    values, of_window = values[known], of_window[known]
    sizes = np.bincount(of_window, minlength=count)
    sums, squares = (
        np.stack([np.bincount(of_window, each, count) for each in (values**power).T], axis=1)
        for power in (1, 2)
    )
    before, of_before = np.cumsum(sizes) - sizes, np.cumsum(sums, axis=0) - sums
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, usual = sums / sizes[:, None], of_before / before[:, None]
        within = np.maximum(squares / sizes[:, None] - mean**2, 0.0).sum(axis=1)
        # the noise at rest is the noise of the quietest window so far
        variance = np.minimum.accumulate(np.where(sizes > 1, within, np.inf))
        noise = SIGMAS * np.sqrt(variance * (1.0 / sizes + 1.0 / before))
        apart = np.linalg.norm(mean - usual, axis=1)
        if is_rate:
            found = (apart > np.maximum(noise, LEAST_RATE_RADPS)) | (
                np.linalg.norm(mean, axis=1) > LARGEST_BIAS_RADPS
            )
        else:
            found = apart > np.maximum(noise, LEAST_ANGLE_RAD * np.linalg.norm(usual, axis=1))
    return np.asarray(found)


def of_nine_axes(estimator: Estimator[Any]) -> Estimator[Any]:
    """Return the estimator with automatic detection of its unit's initial stationary period.

    The period is detected if the estimator has a parameter `rest_s` that is not set. The samples of the
    period are passed to the estimator's `start` under the name `REST`.
    """

    def bind(name: str, topics: Mapping[str, Any], values: Any) -> list[Bound]:
        seeks_rest = getattr(values, "rest_s", 0.0) is None
        found = list[Bound]()
        for each in estimator.bind(name, topics, values):
            assert isinstance(each, Recursive)
            rest = Initialization(each.streams, partial(_find, each.name)) if seeks_rest else None
            found.append(replace(each, initialization=rest))
        return found

    return with_magnetometer(replace(estimator, bind=bind))


def _find(
    name: str,
    first: Mapping[str, Ragged],
    static: Mapping[str, Ragged],
    clock: Clock,
) -> Initialized:
    """Find the initial stationary period of every run.

    Raises BadInput if a unit moves within `LEAST_S` of its first sample.
    """
    [(topic, samples)] = first.items()
    counts, rests_s, facts = [], [], list[Fact]()
    for run in range(samples.runs):
        own = samples.of_run(run)
        counts.append(resting(own) if len(own) else 0)
        stamps_ns = own.publish_time_ns[: counts[-1] + 1]
        rests_s.append(1e-9 * float(np.ptp(stamps_ns)) if len(stamps_ns) else 0.0)
        if len(own) and rests_s[-1] < LEAST_S:
            raise BadInput(
                f"topic {topic}: the unit moves within {LEAST_S:g} s of its first sample, but the bias "
                "of the gyro is estimated at rest; cut the log so that it begins at rest, or give the "
                "duration of the rest with --set rest_s=SECONDS"
            )
    firsts_ns = np.array([_first_ns(samples.of_run(run)) for run in range(samples.runs)], np.int64)
    for rest_s in dict.fromkeys(round(each, 2) for each in rests_s if each):
        is_so = np.array([round(each, 2) == rest_s for each in rests_s])
        facts.append(Fact(f"the unit rests for its first {rest_s:.4g} s (rest_s)", firsts_ns, is_so))
    rows = [samples.offsets[run] + np.arange(count) for run, count in enumerate(counts)]
    rest = samples.stream.take(np.concatenate(rows).astype(np.int64))
    return Initialized({REST: Ragged(rest, np.append(0, np.cumsum(counts)))}, started(name, facts))


def _first_ns(samples: Stream) -> int:
    return int(samples.publish_time_ns[0]) if len(samples) else 0


def rests_of(given: Mapping[str, Ragged], runs: int) -> Floats:
    """Return the duration (runs,) in s of each stationary period, or infinity if none was detected."""
    if REST not in given:
        return np.full(runs, np.inf)
    rest = given[REST]
    stamps = [rest.of_run(run).publish_time_ns for run in range(runs)]
    return np.array([1e-9 * (float(np.ptp(each)) + 1.0) if len(each) else 0.0 for each in stamps])
