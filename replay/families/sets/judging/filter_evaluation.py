"""Evaluation of guaranteed sets over time, which must contain the robot if the bounds hold."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.families.sets.judging.evaluation import JudgedSets, judge_sets, premises_hold
from fuselog.replay.families.sets.regions.frames import (
    NOT_CUT,
    STATED,
    Bearings,
    Bounds,
    Known,
    frames_with_bearings,
)
from fuselog.replay.families.sets.regions.moving_sets import Odometry, odometry_of, relative_pose
from fuselog.replay.judging.errors.evaluation import reference
from fuselog.replay.judging.errors.truths import Truths

Booleans = NDArray[np.bool_]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

POSE: Components = {"x_m": "linear", "y_m": "linear", "heading_rad": "angle"}


@dataclass(frozen=True)
class JudgedFilter:
    """Sets of one robot over time, with one row per frame of all runs.

    Attributes:
        sets: area, and whether the truth is inside.
        pose: the true pose (n, 3), NaN if it is unknown.
        frame_holds: whether bearings and arena satisfy their bounds at the truth.
        odometry_holds: whether the odometry's errors were within their bounds since the stamp of the set
            from which this set was moved.
        guaranteed: whether the set must contain the truth, because an earlier set contained it and no
            bound has been violated since then.
        growth: factor by which the enclosing pseudo-ellipsoid with L = 8 enlarges the set.
        finding: indices in `frames.FINDINGS`, or -1 without a finding.
    """

    sets: JudgedSets
    pose: Floats
    frame_holds: Booleans
    odometry_holds: Booleans
    guaranteed: Booleans
    growth: Floats
    finding: Integers

    @property
    def violations(self) -> int:
        """Count the sets that must contain the truth but do not; 0 for guaranteed sets."""
        return int((self.guaranteed & ~self.sets.inside).sum())


def judge_filter(
    outputs: Mapping[str, Ragged], sources: Sequence[Source], gap_limit_s: float
) -> list[JudgedFilter]:
    """Judge all outputs of set filters against the truth that their channels name."""
    found = []
    for topic in outputs:
        base = topic.removesuffix("step")
        if outputs[topic].stream.schema.full_name == schemas.SET_STEP.full_name:
            of_robot = {leaf: outputs[f"{base}{leaf}"] for leaf in ("set", "size", "fault", "step")}
            [sets] = judge_sets(
                {f"{base}{leaf}": of_robot[leaf] for leaf in of_robot}, sources, gap_limit_s
            )
            parts = [
                _judge(
                    outputs[topic].of_run(run),
                    outputs[f"{base}diagnosed"].of_run(run),
                    source,
                    sets.inside[sets.run == run],
                    gap_limit_s,
                )
                for run, source in enumerate(sources)
            ]
            found.append(
                JudgedFilter(sets, *(np.concatenate(each) for each in zip(*parts, strict=True)))
            )
    return found


def _judge(
    steps: Stream, diagnosed: Stream, source: Source, inside: Booleans, gap_limit_s: float
) -> tuple[NDArray, ...]:
    """Compute the columns of JudgedFilter for one run, starting with `pose`."""
    pose = reference(Truths(source), steps.metadata["truth"], POSE, steps, gap_limit_s)
    stamps = steps.publish_time_ns
    anchor = np.searchsorted(stamps, steps["anchor_time_ns"])
    bounds = Bounds.of([float(steps.metadata[name]) for name in STATED])
    frame_holds = premises_hold(steps, source, pose[:, :2]).all(axis=0)
    frame_holds &= _bearings_hold(steps, source, pose, bounds.bearing_rad)
    driven = source.read([steps.metadata["odometry"]])[steps.metadata["odometry"]]
    velocity = np.stack([driven["forward_mps"], driven["turn_radps"]], axis=1)
    odometry = odometry_of(driven.publish_time_ns, velocity)
    error = odometry_error(odometry, stamps[anchor], stamps, pose[anchor], pose)
    span_s = (stamps - stamps[anchor]) * 1e-9
    odometry_holds = (error[:, 0] <= bounds.position.over(span_s)) & (
        error[:, 1] <= bounds.heading.over(span_s)
    )
    finding = np.full(len(steps), -1)
    finding[np.searchsorted(stamps, diagnosed.publish_time_ns)] = diagnosed["reason"]
    apart = np.abs(wrap_angle(pose[:, 2] - steps["heading_rad"]))
    holds_pose = inside & (apart <= steps["heading_half_width_rad"] + 1e-9)
    guaranteed = np.zeros(len(steps), bool)
    sound = False  # whether the anchor, cut by the frames since then, must contain the robot
    for step, origin in enumerate(anchor.tolist()):
        if origin == step:
            guaranteed[step] = frame_holds[step]
            continue
        if origin != anchor[step - 1] or anchor[step - 1] == step - 1:
            sound = bool(holds_pose[origin])
        moved = sound and bool(odometry_holds[step])
        if finding[step] in NOT_CUT:
            both = finding[step] > 0  # the set of the frame is kept as well
            guaranteed[step] = moved or (both and frame_holds[step])
        else:
            sound = moved and bool(frame_holds[step])
            guaranteed[step] = sound
    return pose, frame_holds, odometry_holds, guaranteed, steps["area_growth"], finding


def odometry_error(
    odometry: Odometry, first_ns: Integers, last_ns: Integers, first: Floats, last: Floats
) -> Floats:
    """Compute the odometry's errors of displacement (m) and rotation (rad) between true poses, (n, 2).

    Args:
        odometry: odometry of the robot.
        first_ns: (n,), start of each span.
        last_ns: (n,), end of each span.
        first: (n, 3), true pose at the start.
        last: (n, 3), true pose at the end.
    """
    true = relative_pose(first, last)
    stated = relative_pose(odometry.pose_at(first_ns), odometry.pose_at(last_ns))
    away = np.hypot(*(true - stated)[:, :2].T)
    return np.stack([away, np.abs(wrap_angle((true - stated)[:, 2]))], axis=1)


def bearing_errors(seen: Bearings, pose: Floats) -> Floats:
    """Compute the absolute errors of single bearings at a true pose, (n,) in rad.

    Args:
        seen: n bearings, and the positions of their landmarks.
        pose: (3,), x, y in m, heading in rad.
    """
    away = seen.place_m - pose[:2]
    return np.abs(wrap_angle(np.arctan2(away[:, 1], away[:, 0]) - pose[2] - seen.bearing_rad))


def _bearings_hold(steps: Stream, source: Source, pose: Floats, bound_rad: float) -> Booleans:
    """Test whether the errors of the single bearings of each frame are within their bound."""
    measured = steps.metadata["measured"]
    streams = source.read(["/landmarks", measured])
    row_of = {time_ns: row for row, time_ns in enumerate(steps.publish_time_ns.tolist())}
    hold = np.zeros(len(steps), bool)
    found = frames_with_bearings(streams[measured], streams["/landmarks"], Known.of(steps.metadata))
    for frame, seen in found:
        row = row_of.get(frame.time_ns)
        if row is not None:
            hold[row] = bool(np.all(bearing_errors(seen, pose[row]) <= bound_rad))
    return hold
