"""Bounds of a robot's errors, computed from the errors of the other robots in its log.

Therefore no bound depends on the truth of the evaluated robot. The bounds are written to the channels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.engine.vectors.tangent import truth_at
from fuselog.replay.families.sets.judging.filter_evaluation import POSE, odometry_error
from fuselog.replay.families.sets.regions.frames import ERRORS
from fuselog.replay.families.sets.regions.moving_sets import Growth, odometry_of

Floats = NDArray[np.float64]

# Time spans over which odometry is compared with the truth; spans up to SHORT_S determine the offset.
SPANS_S = (0.25, 1.0, 2.0, 5.0, 10.0, 20.0)
SHORT_S = 2.0
SPAN_STEP_S = 0.5


class BoundOptions(Parameters):
    """The rules by which bounds are computed from errors.

    Attributes:
        margin: ratio of the odometry bound to the largest odometry error.
        bearing_quantile: quantile of bearing errors that is used as the bound, because a misidentified
            landmark may cause any error.
    """

    margin: PositiveFloat = 1.2
    bearing_quantile: Annotated[float, Field(gt=0, le=1)] = 0.999


@dataclass(frozen=True)
class RobotErrors:
    """The errors (n,) of a robot's bearings, and its largest odometry errors (spans, 2)."""

    bearing_rad: Floats
    relative_rad: Floats
    odometry: Floats


def state_bounds(
    sources: Sequence[MemorySource], options: BoundOptions, gap_limit_s: float
) -> list[MemorySource]:
    """Write to each robot's channels the bounds of the other robots' errors over all runs.

    Raises BadInput if fewer than two robots have odometry, bearings and truth.
    """
    leaves = ("odometry", "range_bearing", "truth")
    first = sources[0].streams
    prefixes = [topic.removesuffix("/odometry") for topic in first if topic.endswith("/odometry")]
    prefixes = [each for each in prefixes if all(f"{each}/{leaf}" in first for leaf in leaves)]
    if len(prefixes) < 2 or "/landmarks" not in first:
        raise BadInput(
            f"{sources[0].name}: the bounds of each robot come from the other robots, so the log needs "
            "/landmarks and at least two robots with odometry, range_bearing and truth; "
            f"there are {len(prefixes)} such robots"
        )
    found = {each: [robot_errors(source, each, gap_limit_s) for source in sources] for each in prefixes}
    stated: dict[str, dict[str, str]] = {}
    for prefix in prefixes:
        others = [errors for each, runs in found.items() if each != prefix for errors in runs]
        for leaf, bounds in zip(leaves, _bounds(others, options), strict=False):
            stated[f"{prefix}/{leaf}"] = {name: repr(value) for name, value in bounds.items()}
    return [
        replace(
            source,
            streams={
                topic: replace(stream, metadata={**stream.metadata, **stated.get(topic, {})})
                for topic, stream in source.streams.items()
            },
        )
        for source in sources
    ]


def _bounds(
    others: Sequence[RobotErrors], options: BoundOptions
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the bounds for the channels of odometry and of bearings."""
    largest = options.margin * np.max([errors.odometry for errors in others], axis=0)
    spans_s = np.array(SPANS_S)
    offset = largest[spans_s <= SHORT_S].max(axis=0)
    rate = ((largest - offset) / spans_s[:, None]).max(axis=0).clip(min=0.0)
    position, heading = (Growth(float(offset[k]), float(rate[k])) for k in range(2))

    def quantile(parts: Sequence[Floats]) -> float:
        return float(np.quantile(np.concatenate(parts), options.bearing_quantile))

    return dict(zip(ERRORS, (*position, *heading), strict=True)), {
        "bound_rad": quantile([errors.relative_rad for errors in others]),
        "bearing_bound_rad": quantile([errors.bearing_rad for errors in others]),
    }


def robot_errors(source: MemorySource, prefix: str, gap_limit_s: float) -> RobotErrors:
    """Compute one robot's errors of bearings and odometry while its truth is known."""
    seen, truth = source.streams[f"{prefix}/range_bearing"], source.streams[f"{prefix}/truth"]
    landmarks, driven = source.streams["/landmarks"], source.streams[f"{prefix}/odometry"]
    error, look = _bearing_errors(seen, landmarks, truth, gap_limit_s)
    first, second = np.nonzero(np.triu(look[:, None] == look[None, :], 1))
    odometry = odometry_of(
        driven.publish_time_ns, np.stack([driven["forward_mps"], driven["turn_radps"]], axis=1)
    )
    largest = []
    for span_s in SPANS_S:
        begin = np.arange(
            driven.publish_time_ns[0], driven.publish_time_ns[-1] - span_s * 1e9, SPAN_STEP_S * 1e9
        ).astype(np.int64)
        end = begin + round(span_s * 1e9)
        poses = [truth_at(truth, stamps, list(POSE.values()), gap_limit_s) for stamps in (begin, end)]
        largest.append(np.nanmax(odometry_error(odometry, begin, end, *poses), axis=0, initial=0.0))
    relative = np.abs(wrap_angle(error[first] - error[second]))
    return RobotErrors(np.abs(error), relative, np.array(largest))


def _bearing_errors(
    seen: Stream, landmarks: Stream, truth: Stream, gap_limit_s: float
) -> tuple[Floats, NDArray[np.int64]]:
    """Compute errors (n,) of bearings to mapped landmarks while the truth is known, and their stamps."""
    numbers = landmarks["landmark_id"]
    order = np.argsort(numbers)
    row = np.searchsorted(numbers, seen["target_id"], sorter=order).clip(max=len(numbers) - 1)
    pose = truth_at(truth, seen.publish_time_ns, list(POSE.values()), gap_limit_s)
    away = landmarks["position_m"][order[row]][:, :2] - pose[:, :2]
    error = wrap_angle(np.arctan2(away[:, 1], away[:, 0]) - pose[:, 2] - seen["bearing_rad"])
    known = (numbers[order[row]] == seen["target_id"]) & np.isfinite(error)
    return error[known], seen.publish_time_ns[known]
