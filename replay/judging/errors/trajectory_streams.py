"""Conversion between trajectories and streams of estimates or truths in a log."""

import numpy as np
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.trajectories import Trajectory
from fuselog.replay.engine.streams.planes import HEADING
from fuselog.replay.engine.vectors.components import stated_components
from fuselog.replay.engine.vectors.tangent import manifold_blocks, tangent_components
from fuselog.replay.judging.errors.evaluation import POSITION
from fuselog.replay.judging.errors.trajectories import POSE_KINDS


def trajectory_of(stream: Stream) -> Trajectory | None:
    """Extract the poses of a truth, estimate or Pose stream; None if the stream has no position.

    Missing components of the position are zero, such as the height of a planar robot; a heading is a
    rotation about the vertical axis. Poses that are not finite are left out.
    """
    if stream.schema.full_name == schemas.POSE.full_name:
        return _of_poses(stream)
    components = stated_components(stream.metadata, {}, f"topic {stream.topic}")
    names, kinds = list(components), list(components.values())
    if POSITION[0] not in names or len(set(names).intersection(POSITION)) < 2:
        return None
    column = "mean" if "mean" in stream.columns else "state"
    state = stream[column].reshape(len(stream), len(names))
    state, stamps = state[known := np.isfinite(state).all(axis=1)], stream.publish_time_ns[known]
    position_m = np.zeros((len(state), 3))
    for axis, name in enumerate(POSITION):
        if name in names:
            position_m[:, axis] = state[:, names.index(name)]
    rotation = None
    turns = [columns for kind, columns in manifold_blocks(kinds) if kind == "quaternion"]
    if len(turns) == 1:
        rotation = Rotation.from_quat(state[:, turns[0]], scalar_first=True).as_matrix()
    elif components.get(HEADING) == "angle":
        rotation = Rotation.from_euler("z", state[:, [names.index(HEADING)]]).as_matrix()
    return Trajectory(stream.topic, position_m, rotation, stamps)


def _of_poses(stream: Stream) -> Trajectory:
    """Extract positions and orientations; poses that are not finite are left out."""
    position_m, quaternion = (
        stream[name].reshape(len(stream), width)
        for name, width in (("position_m", 3), ("quaternion", 4))
    )
    known = np.isfinite(np.hstack([position_m, quaternion])).all(axis=1)
    rotation = Rotation.from_quat(quaternion[known], scalar_first=True).as_matrix()
    return Trajectory(stream.topic, position_m[known], rotation, stream.publish_time_ns[known])


def estimates_of(trajectory: Trajectory, topic: str, truth: Stream) -> Stream:
    """Convert a trajectory to a stream of estimates with the components that the truth also has.

    Its covariance is zero, so it has no NEES.

    Raises BadInput if the trajectory has no stamps, or the truth has none of its components.
    """
    if trajectory.time_ns is None:
        raise BadInput(f"{trajectory.name}: its poses have no stamps; give a TUM or EuRoC trajectory")
    stated = stated_components(truth.metadata, {}, f"topic {truth.topic}")
    columns = {
        name: trajectory.position_m[:, axis] for axis, name in enumerate(POSITION) if name in stated
    }
    if trajectory.rotation is not None:
        turned = Rotation.from_matrix(trajectory.rotation)
        quaternion = [name for name, kind in stated.items() if kind == "quaternion"]
        if len(quaternion) == 4:
            columns |= zip(quaternion, turned.as_quat(scalar_first=True).T, strict=True)
        elif stated.get(HEADING) == "angle":
            columns[HEADING] = turned.as_euler("ZYX")[:, 0]
    if not columns:
        raise BadInput(f"{trajectory.name}: topic {truth.topic} has no position to compare it with")
    kinds = [stated[name] for name in columns]
    width = len(tangent_components(list(columns), kinds))
    count = len(trajectory)
    return make_stream(
        topic,
        schemas.GAUSSIAN_ESTIMATE,
        trajectory.time_ns,
        metadata={"components": ",".join(columns), "kinds": ",".join(kinds), "truth": truth.topic},
        mean=np.stack(list(columns.values()), axis=1),
        covariance=np.zeros((count, width * width)),
    )


def truth_of(trajectory: Trajectory, topic: str) -> Stream:
    """Convert a trajectory to a truth stream; raise BadInput if it has no stamps."""
    if trajectory.time_ns is None:
        raise BadInput(f"{trajectory.name}: its poses have no stamps; give a TUM or EuRoC trajectory")
    names, state = [*POSITION], trajectory.position_m
    if trajectory.rotation is not None:
        turned = Rotation.from_matrix(trajectory.rotation).as_quat(scalar_first=True)
        names, state = [*names, "qw", "qx", "qy", "qz"], np.hstack([state, turned])
    metadata = {"components": ",".join(names), "kinds": ",".join(POSE_KINDS[: len(names)])}
    return make_stream(topic, schemas.TRUTH_STATE, trajectory.time_ns, metadata=metadata, state=state)
