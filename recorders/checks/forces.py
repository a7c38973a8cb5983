"""Checks of inertial samples: quantities that were never measured, and the axis that points up."""

from collections.abc import Iterator, Mapping

import numpy as np

from fuselog.recorders.checks.body import FEWEST, Series
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.checks.turns import quietest
from fuselog.recorders.log import Stream, schemas

LARGEST_SHARE = 0.9
UNITS = {each.full_name for each in (schemas.INERTIAL_SAMPLE, schemas.MAGNETIC_FIELD)}
MEASURED = {
    "specific_force_mps2": "specific forces",
    "turn_rate_radps": "turn rates",
    "magnetic_field_ut": "magnetic fields",
}
# For each axis that points up, and its sign: roll, pitch, yaw that rotate it to z.
UPRIGHT = {
    (0, 1): (0, -90, 0),
    (0, -1): (0, 90, 0),
    (1, 1): (90, 0, 0),
    (1, -1): (-90, 0, 0),
    (2, -1): (180, 0, 0),
}


def unmeasured(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find sensors whose forces, turn rates or fields are always zero, and thus were not measured."""
    if stream.schema.full_name not in UNITS or len(stream) < FEWEST:
        return
    for field, what in MEASURED.items():
        column = stream.columns.get(field, np.empty(0))
        if column.size and not column.any():
            yield Finding(
                "values",
                stream.topic,
                field,
                float(len(stream)),
                f"{stream.topic}: its {what} are exactly zero in all {len(stream)} messages: they were "
                "not measured, but a filter driven by this topic uses them as measurements",
                otherwise="import only what was measured; import a part of a unit as a "
                "VectorMeasurement",
            )


def upright(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find inertial units whose z axis is not up at rest, unless the log contains orientations."""
    if stream.schema.full_name != schemas.INERTIAL_SAMPLE.full_name or len(stream) < FEWEST:
        return
    if any(_turns(each) for each in streams.values()):
        return
    known = np.isfinite(stream["specific_force_mps2"]).all(axis=1)
    if known.sum() < FEWEST:
        return
    times_s = 1e-9 * (stream.publish_time_ns - stream.publish_time_ns[0])[known]
    forces = stream["specific_force_mps2"][known]
    mean = quietest(Series(stream.topic, "specific_force_mps2", times_s, forces))
    norm = 0.0 if mean is None else float(np.linalg.norm(mean))
    if mean is None or not norm:
        return
    axis = int(np.argmax(np.abs(mean)))
    mounting = UPRIGHT.get((axis, int(np.sign(mean[axis]))))
    is_so = np.sign(np.median(forces[:, axis])) == np.sign(mean[axis])
    if mounting is None or abs(mean[axis]) < LARGEST_SHARE * norm or not is_so:
        return
    is_down = axis == 2
    what = (
        "its z axis is down (FRD), or its forces have the wrong sign"
        if is_down
        else f"it is mounted upright, its {'xy'[axis]} axis {'up' if mean[axis] > 0 else 'down'}"
    )
    roll, pitch, yaw = mounting
    yield Finding(
        "gravity" if is_down else "mounting",
        stream.topic,
        "specific_force_mps2",
        -1.0 if is_down else float(np.radians(roll or pitch)),
        f"{stream.topic}: {what}: at rest the force along {'xyz'[axis]} is {mean[axis]:.4g} of "
        f"{norm:.4g}, but specific force should point up along z",
        f"{stream.topic}.specific_force_z_scale=-1" if is_down else "",
        f"mounting_deg = [{roll}, {pitch}, {yaw}] in the mapping",
        "likely" if is_down else "hint",
    )


def _turns(stream: Stream) -> bool:
    """Test whether a topic states the orientation of a body in space."""
    return "quaternion" in stream.columns or "quaternion" in stream.metadata.get("kinds", "")
