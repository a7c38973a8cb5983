"""Alignment of estimates with the truth by a least-squares transform of their positions.

Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE
Transactions on Pattern Analysis and Machine Intelligence 13(4), 1991; about the vertical axis only:
Zhang, Scaramuzza, "A tutorial on quantitative trajectory evaluation for visual(-inertial) odometry",
IROS 2018.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, Stream
from fuselog.recorders.trajectories import Trajectory
from fuselog.replay.engine.streams.planes import HEADING, VECTORS, Movement, moved_states
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.engine.vectors.components import in_body_axes, stated_components
from fuselog.replay.judging.errors.planes import ALIGNED

Floats = NDArray[np.float64]
Align = Literal["none", "yaw", "se2", "se3", "sim3"]

# Smallest squared ratio of the two largest extents of a path; straight lines, up to rounding, are below
# it.
LEAST_WIDTH = 1e-10
# The cosine of 1e-6 rad, an angle that is zero up to rounding.
LEAST_COSINE = 1 - 1e-12


class Alignment(Movement):
    """Transform p -> scale rotation p + translation_m from the estimate's frame to the truth's."""


def alignment_of(estimate_m: Floats, truth_m: Floats, align: Align, where: str) -> Alignment:
    """Compute the transform that minimises the distances of estimated from true positions, (n, 3) each.

    Args:
        estimate_m: positions of the estimate in m.
        truth_m: true positions in m.
        align: "none"; "yaw" rotates about the vertical axis and shifts; "se2" does the same but does
            not change the height; "se3" rotates and shifts; "sim3" also scales.
        where: name of the estimate in messages.

    Raises BadInput if the positions do not determine the rotation, because they are too few or on one
    line.
    """
    if align == "none":
        return Alignment()
    estimate_mean, truth_mean = estimate_m.mean(axis=0), truth_m.mean(axis=0)
    of_estimate, of_truth = estimate_m - estimate_mean, truth_m - truth_mean
    cross = of_truth.T @ of_estimate  # (38), times n
    if align in ("yaw", "se2"):
        cosine, sine = cross[0, 0] + cross[1, 1], cross[1, 0] - cross[0, 1]
        extent = np.linalg.norm(of_estimate[:, :2]) * np.linalg.norm(of_truth[:, :2])
        is_determined = np.hypot(cosine, sine) > LEAST_WIDTH * extent
        rotation = Rotation.from_rotvec([0.0, 0.0, np.arctan2(sine, cosine)]).as_matrix()
    else:
        left, widths, right = np.linalg.svd(cross)
        is_determined = widths[1] > LEAST_WIDTH * widths[0]
        proper = np.sign(np.linalg.det(left) * np.linalg.det(right))
        rotation = left * [1.0, 1.0, proper] @ right  # (40), (43)
    if not is_determined:
        needed = (
            "two different horizontal positions" if align in ("yaw", "se2") else "three not on one line"
        )
        raise BadInput(
            f"{where}: {len(estimate_m)} poses do not determine the {align} alignment, which needs "
            f"{needed}; add poses, or give another alignment"
        )
    scale = 1.0
    if align == "sim3":  # (42): trace(D S) is the scalar product of the truth and the rotated estimate
        scale = float(np.sum(of_truth * (of_estimate @ rotation.T)) / np.sum(of_estimate**2))
    translation_m = truth_mean - scale * rotation @ estimate_mean  # (41)
    if align == "se2":
        translation_m[2] = 0.0
    return Alignment(rotation, translation_m, scale)


def rotation_error_rad(estimate_m: Floats, truth_m: Floats, align: Align) -> float:
    """Compute half the width of the 95 % interval of the rotation about its least certain axis.

    With errors of variance s^2 per axis, the information on a rotation about a unit vector u is sum |u x
    p|^2 / s^2 over the centred positions p, so its variance is s^2 divided by the sum of squared
    distances from the axis (Sturm et al. 2012 and evo compute no such error). Neighbouring errors are
    correlated, so only the number of independent positions counts: n divided by the errors' correlation
    time (Bayley and Hammersley, "The effective number of independent observations in an autocorrelated
    time series", Supplement to JRSS 8(2), 1946).

    Args:
        estimate_m: (n, 3), aligned positions in m.
        truth_m: (n, 3), true positions in m.
        align: the alignment that was used; with "none", the result is zero.

    Returns:
        The error in rad; infinite if all positions are on the axis.
    """
    if align == "none":
        return 0.0
    error, centred = estimate_m - truth_m, truth_m - truth_m.mean(axis=0)
    axes = slice(0, 2) if align in ("yaw", "se2") else slice(0, 3)
    around = float(np.sum(centred[:, :2] ** 2))
    if align not in ("yaw", "se2"):
        squares = np.linalg.eigvalsh(centred.T @ centred)
        around = float(squares[0] + squares[1])  # about the axis of the largest extent of the path
    variance = float(np.mean(error[:, axes] ** 2))
    with np.errstate(divide="ignore"):
        sigma_rad = np.sqrt(variance * _correlation_time(error[:, axes]) / np.float64(around))
    return float(1.96 * sigma_rad) if variance > 0.0 else 0.0


def _correlation_time(error: Floats) -> float:
    """Compute the correlation time of errors (n, m) in rows: 1 plus twice the sum of correlations."""
    total = float(np.sum(error**2))
    found = 1.0
    for lag in range(1, len(error) // 2):
        likeness = float(np.sum(error[lag:] * error[:-lag])) / total if total else 0.0
        if likeness <= 0.0:
            break
        found += 2.0 * likeness
    return min(found, float(len(error)))


def aligned(trajectory: Trajectory, alignment: Alignment) -> Trajectory:
    """Transform the trajectory into the frame of the truth."""
    turned = alignment.scale * trajectory.position_m @ alignment.rotation.T
    rotation = trajectory.rotation
    return replace(
        trajectory,
        position_m=turned + alignment.translation_m,
        rotation=None if rotation is None else alignment.rotation @ rotation,
    )


def aligned_estimates(estimates: Stream, alignment: Alignment) -> Stream:
    """Transform Gaussian estimates and their covariances into the frame of the truth.

    The NEES is then computed from aligned errors. Positions, velocities, headings and orientations are
    rotated; the covariance of an orientation is in the body's frame and does not change. All other
    components are assumed to be in the body's frame.

    Raises BadInput if a planar state would be rotated out of its plane.
    """
    estimates = in_body_axes(estimates)
    components = stated_components(estimates.metadata, {}, f"topic {estimates.topic}")
    is_flat = components.get(HEADING) == "angle" or any(
        0 < len(components.keys() & set(vector)) < len(vector) for vector in VECTORS
    )
    if is_flat and alignment.rotation[2, 2] < LEAST_COSINE:
        raise BadInput(
            f"topic {estimates.topic}: is planar, and the alignment would rotate it out of its plane; "
            "give --align se2"
        )
    mean, jacobian = moved_states(components, estimates["mean"], alignment)
    size = len(jacobian)
    covariance = jacobian @ estimates["covariance"].reshape(-1, size, size) @ jacobian.T
    changed = {"mean": mean, "covariance": covariance.reshape(len(mean), size * size)}
    metadata = {**estimates.metadata, ALIGNED: "truth"}
    return replace(estimates, columns={**estimates.columns, **changed}, metadata=metadata)


@dataclass(frozen=True, repr=False)
class AlignedEstimates(LogSource):
    """Log in which the estimates on some topics are transformed into the frame of the truth."""

    alignments: Mapping[str, Alignment] = field(default_factory=dict)

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Yield blocks of the log with aligned estimates."""
        for block in super().blocks(topics, order, block_messages):
            yield {
                topic: aligned_estimates(stream, self.alignments[topic])
                if topic in self.alignments
                else stream
                for topic, stream in block.items()
            }
