"""Limits of trajectory metrics due to a truth without orientations or an imprecise alignment."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fuselog.recorders.trajectories import Trajectory
from fuselog.replay.judging.errors.alignment import Align, rotation_error_rad

Floats = NDArray[np.float64]
# Orientations within STILL_RAD count as constant; if the path or the estimate turns by more than
# TURNS_RAD, constant orientations are not real.
STILL_RAD, TURNS_RAD = 1e-6, np.radians(20.0)
# An alignment whose rotation is less precise is reported.
LOOSE_DEG = 1.0
# If the interval is wider than this, its linearisation at the best rotation is meaningless.
UNKNOWN_DEG = 60.0
UNTURNED = (
    "its orientations are constant although its path or the estimate turns; it is treated as positions "
    "without orientations, so no rotation errors are given"
)


def lacks_rotations(truth: Trajectory, estimate: Trajectory) -> bool:
    """Test whether a truth consists of positions only, with constant orientations as placeholders.

    The test is positive if the orientations are constant and either the path turns, or the estimate
    turns and the path does not follow the constant direction.
    """
    if truth.rotation is None or estimate.rotation is None or len(truth) < 2:
        return False
    if _turned_rad(truth.rotation).max() > STILL_RAD:
        return False
    course = _courses(truth)
    bends = _angle_rad(course, course[:1]) > TURNS_RAD
    leads_away = _angle_rad(course, truth.rotation[0][None, :, 0]) > TURNS_RAD
    return bends or (leads_away and bool(_turned_rad(estimate.rotation).max() > TURNS_RAD))


def _turned_rad(rotation: Floats) -> Floats:
    """Compute the angles between rotations (n, 3, 3) and the first of them."""
    return np.asarray(Rotation.from_matrix(rotation[0].T @ rotation).magnitude())


def _courses(trajectory: Trajectory) -> Floats:
    """Compute the directions (k, 3) of a path, each over a tenth of its extent; empty without motion.

    Over this distance, errors of single positions are negligible.
    """
    place = trajectory.position_m
    step_m, ends = 0.1 * float(np.linalg.norm(place - place[0], axis=1).max()), [0]
    for row in range(1, len(place)):
        if np.linalg.norm(place[row] - place[ends[-1]]) > step_m:
            ends.append(row)
    way = np.diff(place[ends], axis=0)
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))


def _angle_rad(course: Floats, direction: Floats) -> float:
    """Compute the largest angle between directions (k, 3) and one direction (1, 3); zero if k is 0."""
    cosines = np.clip(np.sum(course * direction, axis=1), -1.0, 1.0)
    return float(np.arccos(cosines).max(initial=0.0))


def doubts_of_alignment(estimate: Trajectory, truth: Trajectory, align: Align) -> list[str]:
    """Return a sentence if the positions do not determine the rotation of the alignment precisely."""
    known_deg = np.degrees(rotation_error_rad(estimate.position_m, truth.position_m, align))
    if known_deg <= LOOSE_DEG:
        return []
    within = f"within {known_deg:.2g} deg (95 %)" if known_deg < UNKNOWN_DEG else "not at all"
    has_figures = estimate.rotation is not None
    figures = "; absolute rotation errors (APE) are equally uncertain" if has_figures else ""
    return [
        f"{estimate.name}: its path is nearly straight, or short compared with its errors, so positions "
        f"determine the rotation of the {align} alignment {within}{figures}"
    ]
