"""Transformation of positions between local tangent planes (ENU) with different origins.

The two planes are rotated and shifted relative to each other because the earth is curved. A position
without a height is assumed to have the ellipsoidal height of its origin; if its true height is 100 m
more and the other origin is 1 km away, the result has an error of 2 cm.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.log.planes import Origin, stated_in
from fuselog.recorders.models.geodesy import SEMI_MAJOR_M, into_tangent_plane, tangent_axes
from fuselog.recorders.models.orientation import compose
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.vectors.components import in_body_axes, stated_components
from fuselog.replay.engine.vectors.tangent import manifold_blocks, tangent_components

# Components of each vector in the log's frame; they rotate together. The first vector is the position.
VECTORS = [tuple(f"{of}{axis}_{unit}" for axis in "xyz") for of, unit in (("", "m"), ("v", "mps"))]
HEADING = "heading_rad"
# Fields that are vectors in the axes of the plane, and their covariances; positions are also shifted.
_FIELDS = {
    schemas.POSITION_FIX.full_name: ("position_m", "covariance_m2"),
    schemas.VELOCITY_FIX.full_name: ("velocity_mps", "covariance_m2ps2"),
    schemas.POSE.full_name: ("position_m", "covariance"),
    schemas.LANDMARK.full_name: ("position_m", ""),
    schemas.COURSE_FIX.full_name: ("position_m", ""),
}
_STATES = {schemas.TRUTH_STATE.full_name: "state", schemas.GAUSSIAN_ESTIMATE.full_name: "mean"}


class Movement(NamedTuple):
    """Transform p -> scale rotation p + translation_m from one frame to another."""

    rotation: Floats = np.eye(3)
    translation_m: Floats = np.zeros(3)
    scale: float = 1.0

    @property
    def yaw_rad(self) -> float:
        """Return the rotation about the vertical axis, in rad."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))

    @property
    def quaternion(self) -> Floats:
        """Return the rotation as a quaternion (4,): w, x, y, z."""
        from scipy.spatial.transform import Rotation  # slow to import

        return np.asarray(Rotation.from_matrix(self.rotation).as_quat(scalar_first=True))


def between(origin: Origin, other: Origin) -> Movement:
    """Compute the transform between the local tangent planes of two origins."""
    axes, others = (tangent_axes(*each[:2]) for each in (origin, other))
    return Movement(others @ axes.T, np.array(into_tangent_plane(origin, other), float))


def moved_states(
    components: Mapping[str, str], mean: Floats, movement: Movement
) -> tuple[Floats, Floats]:
    """Transform states (n, d) into another frame, and compute the Jacobian (t, t) in the tangent space.

    Positions, velocities, headings and orientations are rotated. The covariance of an orientation is in
    the body's frame and does not change. All other components are assumed to be in the body's frame.

    Args:
        components: components of the state by name, with their kinds.
        mean: (n, d).
        movement: transform from the frame of the states to the other frame.

    Returns:
        The states (n, d), and the Jacobian (t, t).
    """
    names, kinds = list(components), list(components.values())
    tangent = [name for name, _ in tangent_components(names, kinds)]
    mean, jacobian = mean.copy(), np.eye(len(tangent))
    for vector in VECTORS:
        there = [axis for axis, name in enumerate(vector) if name in components]
        if not there:
            continue
        turn = movement.scale * movement.rotation[np.ix_(there, there)]
        columns = [names.index(vector[axis]) for axis in there]
        rows = [tangent.index(vector[axis]) for axis in there]
        shift = movement.translation_m[there] if vector == VECTORS[0] else 0.0
        mean[:, columns] = mean[:, columns] @ turn.T + shift
        jacobian[np.ix_(rows, rows)] = turn
    if components.get(HEADING) == "angle":
        column = names.index(HEADING)
        mean[:, column] = wrap_angle(mean[:, column] + movement.yaw_rad)
    for kind, columns_of in manifold_blocks(kinds):
        if kind == "quaternion":
            mean[:, columns_of] = compose(movement.quaternion, mean[:, columns_of])
    return mean, jacobian


def into_plane_of(stream: Stream, origin: Origin) -> Stream:
    """Transform a stream from its stated local tangent plane to the plane of another origin.

    Latitudes and longitudes do not change; only the stated origin does. Raises BadInput if messages of
    this type cannot be transformed.
    """
    own = stated_in(stream.topic, stream.metadata)
    if own is None or own == origin:
        return stream
    stream = in_body_axes(stream)
    movement, schema = between(own, origin), stream.schema.full_name
    columns = dict(stream.columns)
    if schema in _STATES and len(stream):
        field = _STATES[schema]
        components = stated_components(stream.metadata, {}, f"topic {stream.topic}")
        mean = stream[field].reshape(len(stream), len(components))
        columns[field], jacobian = moved_states(components, mean, movement)
        if VECTORS[0][2] not in components:
            place = [list(components).index(name) for name in VECTORS[0][:2]]
            columns[field][:, place] += _below(mean[:, place], movement)
        if "covariance" in columns:
            columns["covariance"] = _turned(columns["covariance"], jacobian)
    elif schema in _FIELDS:
        columns |= _moved_fields(stream, movement)
    elif schema not in (*_STATES, schemas.GEODETIC_FIX.full_name):
        raise BadInput(
            f"topic {stream.topic} states the origin {own} of its tangent plane, but other topics state "
            f"{origin}; messages of type {schema} cannot be transformed between planes, so record them "
            "with the same origin as the others"
        )
    return replace(stream, columns=columns, metadata={**stream.metadata, **origin.metadata})


def _moved_fields(stream: Stream, movement: Movement) -> dict[str, Floats]:
    """Transform the fields that are vectors or directions in the axes of the tangent plane."""
    field, covariance = _FIELDS[stream.schema.full_name]
    if not len(stream):  # the width of vectors is unknown here
        return {}
    size = stream[field].shape[1]
    turn = movement.rotation[:size, :size]
    shift = movement.translation_m[:size] if field == "position_m" else 0.0
    moved = {field: stream[field] @ turn.T + shift}
    if field == "position_m" and size == 2:
        moved[field] += _below(stream[field], movement)
    if covariance in stream.columns:
        given = stream[covariance]
        axes = np.asarray(np.kron(np.eye(2), turn) if covariance == "covariance" else turn, float)
        is_diagonal = given.shape[1] == len(axes)
        full = given[:, :, None] * np.eye(size) if is_diagonal else given
        moved[covariance] = _turned(np.reshape(full, (len(stream), -1)), axes)
    if "quaternion" in stream.columns:
        moved["quaternion"] = compose(movement.quaternion, stream["quaternion"])
    if "course_rad" in stream.columns:  # clockwise from north
        moved["course_rad"] = np.mod(stream["course_rad"] - movement.yaw_rad, 2.0 * np.pi)
    return moved


def _below(place_m: Floats, movement: Movement) -> Floats:
    """Compute how far 2D positions (n, 2) shift because the earth's surface is below their plane."""
    fall_m = np.sum(place_m**2, axis=1) / (2.0 * SEMI_MAJOR_M)
    moved_m: Floats = -fall_m[:, None] * movement.rotation[:2, 2]
    return moved_m


def _turned(covariance: Floats, jacobian: Floats) -> Floats:
    """Rotate covariances (n, d d) to other axes; unknown entries stay NaN."""
    size, unknown = len(jacobian), np.isnan(covariance)
    known = np.where(unknown, 0.0, covariance).reshape(-1, size, size)
    turned = (jacobian @ known @ jacobian.T).reshape(len(covariance), size * size)
    return np.where(unknown, np.nan, turned)
