"""The streams of each type of ROS message, their columns, and the metadata of their channels.

The types are those of common_interfaces and vision_msgs. As in sensor_msgs, a covariance is unknown if
it is zero, or if its first number is -1.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.importers.ros.layouts import Messages
from fuselog.recorders.importers.stamps import to_ns
from fuselog.recorders.log import Schema, schemas
from fuselog.recorders.models.orientation import heading

Floats = NDArray[np.float64]
STAMP, FRAME, CHILD_FRAME = "header.stamp", "header.frame_id", "child_frame_id"
_NO_FIX = -1  # sensor_msgs/NavSatStatus
# Motion counts as planar if its other components are below this, in m/s and rad/s.
_PLANAR = 1e-6
_DIAGONAL = [0, 4, 8]
# Plausible standard deviations of readings and their unit, by the noise density stated for them: drivers
# write variances such as 1e-9 and 1e6 if they do not know any.
SIGMAS = {
    "forward_noise_density": (1e-4, 10.0, "m/s"),
    "turn_noise_density": (1e-5, 10.0, "rad/s"),
    "force_noise_density": (1e-4, 10.0, "m/s2"),
    "gyro_noise_density": (1e-6, 1.0, "rad/s"),
}


@dataclass(frozen=True)
class Part:
    """The part of one stream that comes from some messages (n,).

    Attributes:
        kind: last part of the stream's name.
        columns: fields (k,) or (k, width) of the stream's schema.
        metadata: metadata of the channel.
        constants: columns (k, width) whose first row becomes metadata, by the name of the metadata.
        noise: variances (k,) of readings, by the name of the noise density that the channel states for
            them.
        rows: index of each row's message; None if there is one row for each message.
        dropped: rows (k,) to leave out, by reason.
        doubtful: rows (k,) that are kept but counted, by reason.
        lacking: rows (k,) that state that a field has no data, by field; the field is NaN in these rows.
    """

    kind: str
    schema: Schema
    columns: Mapping[str, NDArray]
    metadata: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, Floats] = field(default_factory=dict)
    noise: Mapping[str, Floats] = field(default_factory=dict)
    rows: NDArray[np.int64] | None = None
    dropped: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    doubtful: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    lacking: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)


class Taken(NamedTuple):
    """How messages of a type are imported.

    Attributes:
        kinds: kinds of the streams made from them.
        parts: function that reads the messages.
        is_doubtful: whether, according to the type, the messages may be a measurement, a goal or the
            truth. If so, streams are named after the whole topic, and no model uses them by default.
    """

    kinds: tuple[str, ...]
    parts: Callable[[Messages], Iterator[Part]]
    is_doubtful: bool = False


def stamps_ns(messages: Messages, path: str = STAMP, where: str = "") -> NDArray[np.int64] | None:
    """Read stamps (n,) in ns from a field with times or whole ns; return None if it is missing."""
    numbers = messages.layout.numbers
    if path in numbers:
        return to_ns(messages.numbers(path), 1, where=where + path)
    if f"{path}.sec" not in numbers:
        return None
    seconds, part_ns = messages.numbers(f"{path}.sec"), messages.numbers(f"{path}.nanosec")
    return to_ns(seconds, 10**9, part_ns, where=where + path)


def vector(messages: Messages, path: str, names: str = "xyz") -> Floats:
    """Read the members `names` of a field such as a Vector3, (n, d)."""
    return np.stack([messages.numbers(f"{path}.{name}") for name in names], axis=1).astype(float)


def quaternion(messages: Messages, path: str) -> Floats:
    """Read a quaternion (n, 4): w, x, y, z."""
    return vector(messages, path, "wxyz")


def covariance(messages: Messages, path: str) -> Floats:
    """Read a covariance (n, d * d), row-major; NaN if it is unknown."""
    found = messages.numbers(path).astype(float, copy=False)
    unknown = found[:, 0] == -1.0
    may_be_zeros = np.flatnonzero(found[:, 0] == 0.0)
    unknown[may_be_zeros] = ~found[may_be_zeros].any(axis=1)
    return np.where(unknown[:, None], np.nan, found) if unknown.any() else found


def has_none(messages: Messages, path: str) -> NDArray[np.bool_]:
    """Test which messages (n,) have a covariance that begins with -1, which marks missing data."""
    return np.asarray(messages.numbers(path)[:, 0] == -1.0)


def _denied(messages: Messages, what: str, path: str) -> dict[str, NDArray[np.bool_]]:
    """Return the messages to drop because their covariance marks the data as missing; see `Part`."""
    return {f"without {what}: {path}[0] is -1": has_none(messages, path)} if path else {}


def _unknown(messages: Messages, width: int) -> Floats:
    return np.full((len(messages), width), np.nan)


def _fix(messages: Messages) -> Iterator[Part]:
    yield Part(
        "fix",
        schemas.GEODETIC_FIX,
        {
            "latitude_deg": messages.numbers("latitude"),
            "longitude_deg": messages.numbers("longitude"),
            "altitude_m": messages.numbers("altitude"),
            "covariance_m2": np.where(
                (messages.numbers("position_covariance_type") == 0)[:, None],
                np.nan,
                covariance(messages, "position_covariance"),
            ),
        },
        dropped={"without a fix": messages.numbers("status.status") == _NO_FIX},
    )


def _inertial(messages: Messages) -> Iterator[Part]:
    force = covariance(messages, "linear_acceleration_covariance")
    rate = covariance(messages, "angular_velocity_covariance")
    no_force = has_none(messages, "linear_acceleration_covariance")
    no_rate = has_none(messages, "angular_velocity_covariance")
    yield Part(
        "inertial",
        schemas.INERTIAL_SAMPLE,
        {
            "specific_force_mps2": _where_known(no_force, vector(messages, "linear_acceleration")),
            "turn_rate_radps": _where_known(no_rate, vector(messages, "angular_velocity")),
            "magnetic_field_ut": _unknown(messages, 3),
        },
        constants={
            "specific_force_covariance_m2ps4": force,
            "turn_rate_covariance_rad2ps2": rate,
        },
        noise={
            "force_noise_density": force[:, _DIAGONAL].mean(axis=1),
            "gyro_noise_density": rate[:, _DIAGONAL].mean(axis=1),
        },
        dropped={"without specific forces and turn rates": no_force & no_rate},
        doubtful={
            "without specific forces: linear_acceleration_covariance[0] is -1": no_force,
            "without turn rates: angular_velocity_covariance[0] is -1": no_rate,
        },
        lacking={"specific_force_mps2": no_force, "turn_rate_radps": no_rate},
    )
    orientation = quaternion(messages, "orientation")
    yield Part(
        "orientation",
        schemas.ORIENTATION,
        {"quaternion": orientation},
        constants={"covariance_rad2": covariance(messages, "orientation_covariance")},
        dropped={
            **_denied(messages, "an orientation", "orientation_covariance"),
            "without an orientation: its quaternion is zero": (orientation == 0.0).all(axis=1),
        },
    )


def _where_known(lacks: NDArray[np.bool_], vectors: Floats) -> Floats:
    return np.where(lacks[:, None], np.nan, vectors) if lacks.any() else vectors


def _magnetic(messages: Messages) -> Iterator[Part]:
    yield Part(
        "magnetic_field",
        schemas.MAGNETIC_FIELD,
        {
            "magnetic_field_ut": 1e6 * vector(messages, "magnetic_field"),
            "covariance_ut2": 1e12 * covariance(messages, "magnetic_field_covariance"),
        },
        dropped=_denied(messages, "a magnetic field", "magnetic_field_covariance"),
    )


def _odometry(messages: Messages) -> Iterator[Part]:
    """Yield the twist, in the plane and in space, and the pose that the robot integrated from it."""
    velocity, turn = vector(messages, "twist.twist.linear"), vector(messages, "twist.twist.angular")
    beside = np.abs(np.concatenate([velocity[:, 1:], turn[:, :2]], axis=1)).max(axis=1)
    spread = covariance(messages, "twist.covariance")
    yield Part(
        "odometry",
        schemas.ODOMETRY,
        {"forward_mps": velocity[:, 0], "turn_radps": turn[:, 2]},
        noise={"forward_noise_density": spread[:, 0], "turn_noise_density": spread[:, 35]},
        dropped=_denied(messages, "a twist", "twist.covariance"),
        doubtful={
            "with motion sideways, up or down, in roll or pitch, which is ignored": beside > _PLANAR
        },
    )
    yield _twist("odometry_twist", messages, "twist.twist", "twist.covariance")
    yield _pose(
        "odometry_pose", messages, "pose.pose.position", "pose.pose.orientation", "pose.covariance"
    )


def _twist(kind: str, messages: Messages, path: str, uncertainty: str = "") -> Part:
    return Part(
        kind,
        schemas.TWIST,
        {
            "velocity_mps": vector(messages, f"{path}.linear" if path else "linear"),
            "turn_rate_radps": vector(messages, f"{path}.angular" if path else "angular"),
            "covariance": covariance(messages, uncertainty) if uncertainty else _unknown(messages, 36),
        },
        dropped=_denied(messages, "a twist", uncertainty),
    )


def _pose(kind: str, messages: Messages, position: str, orientation: str, uncertainty: str = "") -> Part:
    return Part(
        kind,
        schemas.POSE,
        {
            "position_m": vector(messages, position),
            "quaternion": quaternion(messages, orientation),
            "covariance": covariance(messages, uncertainty) if uncertainty else _unknown(messages, 36),
        },
        dropped=_denied(messages, "a pose", uncertainty),
    )


TRUTH: Mapping[str, str] = {
    **dict.fromkeys(("x_m", "y_m", "z_m"), "linear"),
    "heading_rad": "angle",
    **{f"orientation_{name}": "quaternion" for name in "wxyz"},
}


def as_truth(part: Part) -> Part:
    """Convert poses to the truth that estimates are compared with, in the plane and in space."""
    orientation = part.columns["quaternion"]
    state = np.column_stack([part.columns["position_m"], heading(orientation), orientation])
    metadata = {"components": ",".join(TRUTH), "kinds": ",".join(TRUTH.values())}
    return Part("truth", schemas.TRUTH_STATE, {"state": state}, metadata, dropped=part.dropped)


def as_estimate(part: Part, truth: str) -> Part:
    """Convert poses to the estimates of another filter, which are compared with the topic `truth`.

    The covariance of a pose is of x, y, z and the rotations about the fixed axes. An unknown covariance
    becomes zero, so that the estimates have no NEES.
    """
    components = {name: kind for name, kind in TRUTH.items() if kind != "angle"}
    metadata = {"components": ",".join(components), "kinds": ",".join(components.values())}
    is_unknown = np.isnan(part.columns["covariance"]).all(axis=1)
    columns = {
        "mean": np.column_stack([part.columns["position_m"], part.columns["quaternion"]]),
        "covariance": np.where(is_unknown[:, None], 0.0, part.columns["covariance"]),
    }
    metadata |= {"rotation_axes": "world", "truth": truth}
    doubtful = {"without a covariance, so without NEES": is_unknown}
    schema = schemas.GAUSSIAN_ESTIMATE
    return Part("estimate", schema, columns, metadata, dropped=part.dropped, doubtful=doubtful)


def _twists(path: str, uncertainty: str = "") -> Taken:
    return Taken(("twist",), lambda messages: iter([_twist("twist", messages, path, uncertainty)]))


def _poses(position: str, orientation: str, uncertainty: str = "") -> Taken:
    return Taken(
        ("pose",),
        lambda messages: iter([_pose("pose", messages, position, orientation, uncertainty)]),
        is_doubtful=not uncertainty,
    )


def _point(messages: Messages) -> Iterator[Part]:
    columns = {"position_m": vector(messages, "point"), "covariance_m2": _unknown(messages, 9)}
    yield Part("position", schemas.POSITION_FIX, columns)


def _orientation(messages: Messages) -> Iterator[Part]:
    yield Part("orientation", schemas.ORIENTATION, {"quaternion": quaternion(messages, "quaternion")})


def _range(messages: Messages) -> Iterator[Part]:
    """Yield ranges as in REP 117: values beyond the limits are not measurements."""
    distance = messages.numbers("range").astype(float)
    least, most = messages.numbers("min_range"), messages.numbers("max_range")
    yield Part(
        "range",
        schemas.RANGE,
        {"target_id": np.zeros(len(messages), np.uint32), "range_m": distance},
        constants={
            "field_of_view_rad": messages.numbers("field_of_view")[:, None].astype(float),
            "least_range_m": least[:, None].astype(float),
            "most_range_m": most[:, None].astype(float),
        },
        dropped={"outside the sensor's limits": ~((distance >= least) & (distance <= most))},
    )


def _detections(names: str, unit: str) -> Taken:
    """Read a scan from each message, and its detections: the centres of the boxes."""

    def parts(messages: Messages) -> Iterator[Part]:
        count, size = messages.layout.counts["detections"], len(messages)
        scan_id = messages.rows.astype(np.uint32)
        yield Part(
            "scan", schemas.SCAN, {"scan_id": scan_id, "detections": np.full(size, count, np.uint32)}
        )
        centres = []
        for number in range(count):
            centre = f"detections.{number}.bbox.center"
            is_nested = f"{centre}.position.x" in messages.layout.numbers
            centres.append(vector(messages, f"{centre}.position" if is_nested else centre, names))
        if not count:
            return
        yield Part(
            "detections",
            schemas.DETECTION,
            {
                "scan_id": np.repeat(scan_id, count),
                "position_m": np.stack(centres, axis=1).reshape(size * count, len(names)),
            },
            metadata={"components": ",".join(f"{name}_{unit}" for name in names)},
            rows=np.repeat(np.arange(size), count),
            doubtful={
                "without the sizes, turns, classes and ids of their boxes": np.ones(size * count, bool)
            },
        )

    return Taken(("scan", "detections"), parts)


def _measured(components: Mapping[str, str]) -> Taken:
    """Make a reader of numbers whose meaning the type does not define: `components` names the fields."""
    metadata = {"components": ",".join(components), "kinds": ",".join(["linear"] * len(components))}

    def parts(messages: Messages) -> Iterator[Part]:
        value = np.stack([messages.numbers(path) for path in components.values()], axis=1).astype(float)
        yield Part("value", schemas.VECTOR_MEASUREMENT, {"value": value}, metadata)

    return Taken(("value",), parts)


def _array(messages: Messages) -> Iterator[Part]:
    yield Part("value", schemas.VECTOR_MEASUREMENT, {"value": messages.numbers("data").astype(float)})


def _xyz(path: str) -> dict[str, str]:
    return {name: f"{path}{name}" for name in "xyz"}


_NUMBERS = ["Bool", "Float32", "Float64"]
_NUMBERS += [f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)]

TYPES: dict[str, Taken] = {
    "sensor_msgs/msg/NavSatFix": Taken(("fix",), _fix),
    "sensor_msgs/msg/Imu": Taken(("inertial", "orientation"), _inertial),
    "sensor_msgs/msg/MagneticField": Taken(("magnetic_field",), _magnetic),
    "sensor_msgs/msg/Range": Taken(("range",), _range),
    "nav_msgs/msg/Odometry": Taken(("odometry", "odometry_twist", "odometry_pose"), _odometry),
    "geometry_msgs/msg/Twist": _twists(""),
    "geometry_msgs/msg/TwistStamped": _twists("twist"),
    "geometry_msgs/msg/TwistWithCovariance": _twists("twist", "covariance"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twists("twist.twist", "twist.covariance"),
    "geometry_msgs/msg/Pose": _poses("position", "orientation"),
    "geometry_msgs/msg/PoseStamped": _poses("pose.position", "pose.orientation"),
    "geometry_msgs/msg/PoseWithCovariance": _poses("pose.position", "pose.orientation", "covariance"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _poses(
        "pose.pose.position", "pose.pose.orientation", "pose.covariance"
    ),
    "geometry_msgs/msg/TransformStamped": _poses("transform.translation", "transform.rotation"),
    "geometry_msgs/msg/PointStamped": Taken(("position",), _point),
    "geometry_msgs/msg/QuaternionStamped": Taken(("orientation",), _orientation),
    "geometry_msgs/msg/Vector3": _measured(_xyz("")),
    "geometry_msgs/msg/Vector3Stamped": _measured(_xyz("vector.")),
    "sensor_msgs/msg/Temperature": _measured({"temperature_degc": "temperature"}),
    "sensor_msgs/msg/FluidPressure": _measured({"pressure_pa": "fluid_pressure"}),
    "sensor_msgs/msg/RelativeHumidity": _measured({"humidity": "relative_humidity"}),
    "sensor_msgs/msg/Illuminance": _measured({"illuminance_lx": "illuminance"}),
    "std_msgs/msg/Float32MultiArray": Taken(("value",), _array),
    "std_msgs/msg/Float64MultiArray": Taken(("value",), _array),
    "vision_msgs/msg/Detection2DArray": _detections("xy", "px"),
    "vision_msgs/msg/Detection3DArray": _detections("xyz", "m"),
    **{f"std_msgs/msg/{name}": _measured({"data": "data"}) for name in _NUMBERS},
}
TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
