"""Comparison of trajectories with the truth: absolute and relative pose errors (APE, RPE).

Sturm, Engelhard, Endres, Burgard, Cremers, "A benchmark for the evaluation of RGB-D SLAM systems", IROS
2012. Conventions and names follow evo (https://github.com/MichaelGrupp/evo), and the results agree with
  evo's.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.trajectories import Trajectory
from fuselog.replay.engine.vectors.tangent import states_at
from fuselog.replay.judging.errors.alignment import Align, Alignment, aligned, alignment_of
from fuselog.replay.judging.errors.pose_doubts import UNTURNED, doubts_of_alignment, lacks_rotations

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
DeltaUnit = Literal["m", "frames", "s"]
Association = Literal["nearest", "interpolated"]
POSE_KINDS = ("linear",) * 3 + ("quaternion",) * 4
# Largest number of grid points for the time offset.
MOST_STEPS = 1 << 20
# Number of offsets on the grid, and number of the best ones from which the search continues.
GRID, STARTS = 65, 4
# Maximum number of steps from the peak of the correlation to the best offset; usually a few suffice.
MOST_MOVES = 50


@dataclass(frozen=True)
class Comparison:
    """Settings of the comparison of an estimated trajectory with the true one.

    Attributes:
        align: see `alignment_of`.
        delta: length of the parts of the path over which relative errors are computed.
        delta_unit: unit of `delta`: "m" along the estimated path, "frames" (poses) or "s".
        association: "nearest" pairs each pose of the shorter trajectory with the nearest pose in time of
            the longer one, as evo does; "interpolated" interpolates the truth at the stamps of the
            estimate.
        max_difference_s: largest difference in s of paired stamps, for "nearest".
        gap_limit_s: longest gap in s over which the truth is interpolated.
        time_offset_s: offset in s added to the estimate's stamps; "estimate" estimates it.

    Raises BadInput if a number is out of range.
    """

    align: Align = "none"
    delta: float = 1.0
    delta_unit: DeltaUnit = "frames"
    association: Association = "nearest"
    max_difference_s: float = 0.01
    gap_limit_s: float = 0.2
    time_offset_s: float | Literal["estimate"] = 0.0

    def __post_init__(self) -> None:
        known = {"align": Align, "delta_unit": DeltaUnit, "association": Association}
        for name, kind in known.items():
            value, names = getattr(self, name), get_args(kind)
            if value not in names:
                raise BadInput(f"{name} is '{value}'; {choices(str(value), names)}")
        if not 0 < self.delta < np.inf:
            raise BadInput(f"delta is {self.delta:g}; give a positive number, such as 10 with unit m")
        if self.delta_unit == "frames" and self.delta != round(self.delta):
            raise BadInput(f"delta is {self.delta:g} frames; give a whole number, or the unit m or s")
        for name in ("max_difference_s", "gap_limit_s"):
            if not 0 <= getattr(self, name) < np.inf:
                raise BadInput(f"{name} is {getattr(self, name):g}; give seconds, such as 0.01")
        offset_s = self.time_offset_s
        if offset_s != "estimate" and not (isinstance(offset_s, int | float) and abs(offset_s) <= 1e9):
            raise BadInput(f"time_offset_s is {offset_s}; give seconds, or 'estimate'")


class Compared(NamedTuple):
    """Estimated trajectory compared with the true one, pose by pose.

    Attributes:
        estimate: the poses with a truth, aligned with the truth.
        truth: the truth at these poses.
        alignment: the alignment that was applied.
        time_offset_s: the offset that was added to the estimate's stamps.
        without_truth: number of the estimate's poses without truth.
        absolute_m, absolute_deg: (n,) APE; degrees are None if a trajectory has no orientations.
        last: (k,) indices of the last poses of the RPE pairs.
        relative_m, relative_deg: (k,) RPE.
        doubts: sentences about the limitations of these errors.
    """

    estimate: Trajectory
    truth: Trajectory
    alignment: Alignment
    time_offset_s: float
    without_truth: int
    absolute_m: Floats
    absolute_deg: Floats | None
    last: Integers
    relative_m: Floats
    relative_deg: Floats | None
    doubts: tuple[str, ...] = ()


def compare(estimate: Trajectory, truth: Trajectory, comparison: Comparison) -> Compared:
    """Associate and align two trajectories and compute their errors.

    An estimated time offset is applied only if it reduces the error. Raises BadInput if no poses can be
    paired, if the pairs do not determine the alignment, or if the path is shorter than the delta.
    """
    for each in (estimate, truth):
        if not len(each):
            raise BadInput(f"{each.name}: has no poses; give a trajectory with poses")
    offset_s = comparison.time_offset_s
    if offset_s == "estimate":
        offset_s = estimated_offset_s(estimate, truth, comparison.align)
        shifted = compare(estimate, truth, replace(comparison, time_offset_s=offset_s))
        with suppress(BadInput):  # for example, stamps are far apart without the offset
            as_it_is = compare(estimate, truth, replace(comparison, time_offset_s=0.0))
            if np.mean(as_it_is.absolute_m**2) <= np.mean(shifted.absolute_m**2):
                return as_it_is
        return shifted
    if offset_s:
        _stamps(truth)  # without stamps, the offset would be silently ignored
        estimate = replace(estimate, time_ns=_stamps(estimate) + round(offset_s * 1e9))
    matched, true = associate(estimate, truth, comparison)
    doubts = [f"{true.name}: {UNTURNED}"] if lacks_rotations(true, matched) else []
    if matched.rotation is None or true.rotation is None or doubts:
        matched, true = replace(matched, rotation=None), replace(true, rotation=None)
    alignment = alignment_of(matched.position_m, true.position_m, comparison.align, estimate.name)
    matched = aligned(matched, alignment)
    first, last = _pairs(matched, true, comparison)
    doubts += doubts_of_alignment(matched, true, comparison.align)
    return Compared(
        matched,
        true,
        alignment,
        offset_s,
        len(estimate) - len(matched),
        np.linalg.norm(matched.position_m - true.position_m, axis=1),
        _angle_deg(matched.rotation, true.rotation),
        last,
        np.linalg.norm(_way(matched, first, last) - _way(true, first, last), axis=1),
        _angle_deg(_turn(matched, first, last), _turn(true, first, last)),
        tuple(doubts),
    )


def associate(
    estimate: Trajectory, truth: Trajectory, comparison: Comparison
) -> tuple[Trajectory, Trajectory]:
    """Return the paired poses of both trajectories; if one has no stamps, poses are paired in order."""
    times, true_times = estimate.time_ns, truth.time_ns
    if times is None or true_times is None:
        if len(estimate) != len(truth):
            raise BadInput(
                f"{(estimate if times is None else truth).name}: has no stamps, so poses are paired by "
                f"their order, but {estimate.name} has {len(estimate)} poses and {truth.name} "
                f"{len(truth)}; give both with stamps"
            )
        return estimate, truth
    limit_s = comparison.max_difference_s
    if comparison.association == "interpolated":
        limit_s = comparison.gap_limit_s
        at, known = _interpolated(truth, times, limit_s)
        found = estimate.take(known), at
    elif len(estimate) <= len(truth):
        rows, true_rows = _nearest(times, true_times, round(limit_s * 1e9))
        found = estimate.take(rows), truth.take(true_rows)
    else:
        true_rows, rows = _nearest(true_times, times, round(limit_s * 1e9))
        found = estimate.take(rows), truth.take(true_rows)
    if not len(found[0]):
        first, last = times[[0, -1]] * 1e-9
        true_first, true_last = true_times[[0, -1]] * 1e-9
        raise BadInput(
            f"{estimate.name}: has no stamps within {limit_s:g} s of those of {truth.name}: it is from "
            f"{first:.3f} to {last:.3f} s, the truth from {true_first:.3f} to {true_last:.3f} s; give "
            "files of the same run, a larger limit, or a time offset"
        )
    return found


def _nearest(times: Integers, among: Integers, most_ns: int) -> tuple[Integers, Integers]:
    """Pair each time with the nearest time in `among`, within a limit; return the indices of both."""
    right = np.searchsorted(among, times, side="right").clip(0, len(among) - 1)
    left = (right - 1).clip(0)
    nearest = np.where(np.abs(times - among[left]) <= np.abs(among[right] - times), left, right)
    rows = np.flatnonzero(np.abs(among[nearest] - times) <= most_ns)
    return rows, nearest[rows]


def _interpolated(
    truth: Trajectory, time_ns: Integers, gap_limit_s: float
) -> tuple[Trajectory, NDArray[np.bool_]]:
    """Interpolate the truth at stamps; return the known poses, and whether each stamp has one."""
    poses = truth.position_m
    if truth.rotation is not None:
        quaternion = Rotation.from_matrix(truth.rotation).as_quat(scalar_first=True)
        poses = np.hstack([poses, quaternion])
    kinds = POSE_KINDS[: poses.shape[1]]
    poses = states_at(_stamps(truth), poses, time_ns, kinds, gap_limit_s)
    known = np.asarray(np.isfinite(poses).all(axis=1))
    rotation = None
    if truth.rotation is not None:
        rotation = Rotation.from_quat(poses[known, 3:], scalar_first=True).as_matrix()
    return Trajectory(truth.name, poses[known, :3], rotation, time_ns[known]), known


def _stamps(trajectory: Trajectory) -> Integers:
    """Return the stamps of a trajectory; raise BadInput if it has no stamps."""
    if trajectory.time_ns is None:
        raise BadInput(f"{trajectory.name}: has no stamps; give a trajectory with stamps, such as TUM")
    return trajectory.time_ns


def _pairs(estimate: Trajectory, truth: Trajectory, comparison: Comparison) -> tuple[Integers, Integers]:
    """Find the first and last poses of consecutive parts of the path, each at least `delta` long."""
    unit, delta = comparison.delta_unit, comparison.delta
    steps: NDArray = np.ones(len(estimate) - 1)
    if unit == "m":
        steps = np.linalg.norm(np.diff(estimate.position_m, axis=0), axis=1)
    elif unit == "s":
        steps = np.diff(_stamps(truth if estimate.time_ns is None else estimate))
        delta = round(delta * 1e9)
    ends, gone = [0], 0.0
    for row, step in enumerate(steps.tolist(), 1):
        gone += step
        if gone >= delta:
            ends.append(row)
            gone = 0.0
    if len(ends) < 2:
        length = steps.sum() * (1e-9 if unit == "s" else 1.0)
        raise BadInput(
            f"{estimate.name}: the part with truth is {length:.6g} {unit} long; give a delta smaller "
            f"than {comparison.delta:g}"
        )
    return np.array(ends[:-1]), np.array(ends[1:])


def _way(trajectory: Trajectory, first: Integers, last: Integers) -> Floats:
    """Compute the displacements (k, 3) of pairs, in the first pose's frame if orientations are known."""
    way = trajectory.position_m[last] - trajectory.position_m[first]
    rotation = trajectory.rotation
    return way if rotation is None else np.einsum("kji,kj->ki", rotation[first], way)


def _turn(trajectory: Trajectory, first: Integers, last: Integers) -> Floats | None:
    """Compute the rotations (k, 3, 3) of pairs, in the frame of the first pose."""
    rotation = trajectory.rotation
    return None if rotation is None else rotation[first].transpose(0, 2, 1) @ rotation[last]


def _angle_deg(left: Floats | None, right: Floats | None) -> Floats | None:
    """Compute the angles (n,) of the rotations between matrices (n, 3, 3)."""
    if left is None or right is None:
        return None
    return np.degrees(Rotation.from_matrix(left.transpose(0, 2, 1) @ right).magnitude())


def statistics(error: Floats) -> dict[str, float]:
    """Compute the statistics that evo prints for errors (n,), which are not negative."""
    return {
        "rmse": float(np.sqrt(np.mean(error**2))),
        "mean": float(np.mean(error)),
        "median": float(np.median(error)),
        "std": float(np.std(error)),
        "min": float(np.min(error)),
        "max": float(np.max(error)),
    }


def trajectory_metrics(runs: Sequence[Compared]) -> dict[str, float]:
    """Compute APE and RPE over all poses of runs, such as `ape_translation_rmse_m`, and count poses."""
    errors: dict[tuple[str, str], list] = {
        ("ape_translation", "m"): [run.absolute_m for run in runs],
        ("ape_rotation", "deg"): [run.absolute_deg for run in runs],
        ("rpe_translation", "m"): [run.relative_m for run in runs],
        ("rpe_rotation", "deg"): [run.relative_deg for run in runs],
    }
    values: dict[str, float] = {}
    for (what, unit), parts in errors.items():
        known = [part for part in parts if part is not None]
        if len(known) == len(parts):
            found = statistics(np.concatenate(known))
            values |= {f"{what}_{name}_{unit}": value for name, value in found.items()}
    return values | {
        "poses": sum(len(run.absolute_m) for run in runs),
        "poses_without_truth": sum(run.without_truth for run in runs),
        "rpe_pairs": sum(len(run.relative_m) for run in runs),
    }


def estimated_offset_s(estimate: Trajectory, truth: Trajectory, align: Align) -> float:
    """Estimate the offset, in s, of the estimate's stamps that minimises the distance to the truth.

    The offset is added to the stamps and minimises the RMSE of aligned positions. The local search
    starts from the best of these candidates: the offsets with the highest correlation between the speeds
    of both trajectories, which no alignment changes; a grid of the offsets at which at least half of the
    shorter time span overlaps the other; and zero.

    Raises BadInput if a trajectory has no stamps, or if its speed never changes.
    """
    from scipy.optimize import minimize_scalar  # slow to import

    trajectories = [estimate, truth]
    times: list[Floats] = [_stamps(each).astype(float) * 1e-9 for each in trajectories]
    step_s = max(float(np.median(np.diff(each))) if len(each) > 2 else 0.0 for each in times)
    spans = [each[-1] - each[0] for each in times]
    step_s = max(step_s, *(span / MOST_STEPS for span in spans))
    speeds = []
    for trajectory, time_s, span_s in zip(trajectories, times, spans, strict=True):
        grid = np.arange(span_s // step_s + 1 if step_s else 1, dtype=float)
        position_m = _positions_at(trajectory, time_s, time_s[0] + step_s * grid)
        speed = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
        if len(speed) < 2 or np.ptp(speed) <= 1e-6 * speed.max():
            raise BadInput(
                f"{trajectory.name}: its speed never changes, so the time offset cannot be estimated; "
                "give the offset in s"
            )
        speeds.append(speed - speed.mean())
    begin_s = times[1][0] - times[0][0]
    shorter = 0.5 * min(spans)
    grid = np.linspace(begin_s - spans[0] + shorter, begin_s + spans[1] - shorter, GRID)
    candidates = [0.0, *(begin_s + _best_lags(*speeds) * step_s), *grid]

    def covered(offset_s: float) -> NDArray[np.bool_]:
        return (times[1][0] <= times[0] + offset_s) & (times[0] + offset_s <= times[1][-1])

    # with few poses, the RMSE is small at any offset
    least = max(int(covered(offset_s).sum()) for offset_s in candidates) / 2

    def rmse_m(offset_s: float) -> float:
        inside = covered(offset_s)
        if inside.sum() < least:
            return np.inf
        there = estimate.position_m[inside]
        true = _positions_at(truth, times[1], times[0][inside] + offset_s)
        try:
            found = alignment_of(there, true, align, estimate.name)
        except BadInput:  # this part of the path may be straight
            return np.inf
        error = found.scale * there @ found.rotation.T + found.translation_m - true
        return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))

    def least_near(offset_s: float) -> float:
        for _ in range(MOST_MOVES):
            around = offset_s - 2 * step_s, offset_s + 2 * step_s
            before_s = offset_s
            offset_s = float(minimize_scalar(rmse_m, bounds=around, options={"xatol": 1e-6}).x)
            if abs(offset_s - before_s) < step_s:
                break
        return offset_s

    starts = sorted(candidates, key=rmse_m)[:STARTS]
    return min([0.0, *map(least_near, starts)], key=rmse_m)


def _best_lags(estimate: Floats, truth: Floats) -> Integers:
    """Find the lags at the highest peaks of the correlation of two signals.

    The correlation is Pearson's, over an overlap of at least half of the shorter signal.
    """
    from scipy.signal import correlate, correlation_lags  # slow to import

    everywhere = np.ones_like(estimate), np.ones_like(truth)
    count = np.rint(correlate(everywhere[1], everywhere[0]))
    sums = correlate(everywhere[1], estimate), correlate(truth, everywhere[0])
    squares = correlate(everywhere[1], estimate**2), correlate(truth**2, everywhere[0])
    variances = [count * square - each**2 for each, square in zip(sums, squares, strict=True)]
    least = [1e-9 * variance.max() for variance in variances]
    product = np.maximum(variances[0], least[0]) * np.maximum(variances[1], least[1])
    correlation = (count * correlate(truth, estimate) - sums[0] * sums[1]) / np.sqrt(product)
    correlation[2 * count < min(len(estimate), len(truth))] = -np.inf
    beside = np.pad(correlation, 1, constant_values=-np.inf)
    peaks = np.flatnonzero((correlation >= beside[:-2]) & (correlation >= beside[2:]))
    highest = peaks[np.argsort(-correlation[peaks], kind="stable")[:STARTS]]
    return correlation_lags(len(truth), len(estimate))[highest]


def _positions_at(trajectory: Trajectory, time_s: Floats, at_s: Floats) -> Floats:
    return np.stack([np.interp(at_s, time_s, axis) for axis in trajectory.position_m.T], axis=1)
