"""Declarations of all messages of a log.

A schema is a flat protobuf message whose fields have a fixed width and are `optional`; a vector is a
packed list of doubles whose length is the same in all messages of a stream. All messages of a stream
thus share one byte layout (see `layout`), and any protobuf reader can read the file. Field numbers
follow the order of declaration, so new fields are added at the end. The first field of every message is
the time of the sensor's own clock.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory

Kind = Literal["time_ns", "identifier", "real", "vector"]

_PROTOBUF = descriptor_pb2.FieldDescriptorProto
PROTOBUF_TYPES = {
    "time_ns": _PROTOBUF.TYPE_SFIXED64,
    "identifier": _PROTOBUF.TYPE_FIXED32,
    "real": _PROTOBUF.TYPE_DOUBLE,
    "vector": _PROTOBUF.TYPE_DOUBLE,
}
NUMPY_TYPES: dict[Kind, np.dtype] = {
    "time_ns": np.dtype("<i8"),
    "identifier": np.dtype("<u4"),
    "real": np.dtype("<f8"),
    "vector": np.dtype("<f8"),
}


@dataclass(frozen=True)
class Field:
    """One field of a message.

    Attributes:
        name: name, with its unit.
        kind: type of the values.
        may_be_nan: whether NaN may mark a missing value.
        may_be_absent: whether older logs lack the field, so that readers must test for the column.
        may_be_partial: whether NaN may mark a single component that was not measured.
    """

    name: str
    kind: Kind
    may_be_nan: bool = False
    may_be_absent: bool = False
    may_be_partial: bool = False

    @property
    def dtype(self) -> np.dtype:
        """Return the NumPy type of this field's elements."""
        return NUMPY_TYPES[self.kind]


@dataclass(frozen=True)
class Schema:
    """A message type.

    Attributes:
        name: name of the protobuf message, without the package.
        purpose: what a message contains.
        fields: fields in their order.
        package: package of the protobuf message.
    """

    name: str
    purpose: str
    fields: tuple[Field, ...]
    package: str = "fuselog"

    def __iter__(self) -> Iterator[Field]:
        return iter(self.fields)

    @cached_property
    def full_name(self) -> str:
        """Return the protobuf name, such as `fuselog.Bearing`."""
        return f"{self.package}.{self.name}" if self.package else self.name

    @cached_property
    def descriptor_set(self) -> bytes:
        """Return the serialised FileDescriptorSet that describes this message in a file."""
        file = descriptor_pb2.FileDescriptorProto(
            name=f"{self.package}/{self.name}.proto", package=self.package, syntax="proto3"
        )
        declared = file.message_type.add(name=self.name)
        for number, field in enumerate(self.fields, start=1):
            entry = declared.field.add(name=field.name, number=number, type=PROTOBUF_TYPES[field.kind])
            if field.kind == "vector":
                entry.label = _PROTOBUF.LABEL_REPEATED
            else:
                entry.label = _PROTOBUF.LABEL_OPTIONAL
                entry.proto3_optional = True
                entry.oneof_index = len(declared.oneof_decl)
                declared.oneof_decl.add(name=f"_{field.name}")
        return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()

    @property
    def message_class(self) -> type[message.Message]:
        """Return the protobuf class of this message, as any program would build it from a file."""
        return message_class(self.descriptor_set, self.full_name)


@lru_cache(maxsize=256)
def message_class(descriptor_set: bytes, full_name: str) -> type[message.Message]:
    """Build the class `full_name` from a serialised FileDescriptorSet.

    Raises KeyError, TypeError or a protobuf DecodeError if the set is damaged or lacks the name.
    """
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptor_set).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(full_name))


def schema_of(message_type: type[message.Message]) -> Schema:
    """Return a schema with the numeric fields of any message type, without its other fields.

    For messages of fuselog, the declaration here decides which fields may be NaN; in other messages, all
    fields may be NaN.
    """
    descriptor = message_type.DESCRIPTOR
    ours = {field.name: field for field in SCHEMAS.get(descriptor.full_name, ())}
    fields = tuple(
        Field(
            entry.name,
            _KINDS[entry.type, entry.is_repeated],
            entry.name not in ours or ours[entry.name].may_be_nan,
            may_be_partial=entry.name in ours and ours[entry.name].may_be_partial,
        )
        for entry in descriptor.fields
        if (entry.type, entry.is_repeated) in _KINDS
    )
    package, _, name = descriptor.full_name.rpartition(".")
    return Schema(name, "", fields, package)


_KINDS: dict[tuple[int, bool], Kind] = {
    (_PROTOBUF.TYPE_DOUBLE, False): "real",
    (_PROTOBUF.TYPE_FLOAT, False): "real",
    (_PROTOBUF.TYPE_SFIXED64, False): "time_ns",
    (_PROTOBUF.TYPE_INT64, False): "time_ns",
    (_PROTOBUF.TYPE_FIXED32, False): "identifier",
    (_PROTOBUF.TYPE_UINT32, False): "identifier",
    (_PROTOBUF.TYPE_BOOL, False): "identifier",
    (_PROTOBUF.TYPE_DOUBLE, True): "vector",
    (_PROTOBUF.TYPE_FLOAT, True): "vector",
}


def _declare(name: str, purpose: str, *fields: Field) -> Schema:
    return Schema(name, purpose, (Field("sensor_time_ns", "time_ns"), *fields))


def _identifier(name: str) -> Field:
    return Field(name, "identifier")


def _real(name: str, *, may_be_nan: bool = False, may_be_partial: bool = False) -> Field:
    return Field(name, "real", may_be_nan, may_be_partial=may_be_partial)


def _vector(name: str, *, may_be_nan: bool = False, may_be_partial: bool = False) -> Field:
    return Field(name, "vector", may_be_nan, may_be_partial=may_be_partial)


# Messages of sensors.

BEARING = _declare(
    "Bearing",
    "The angle to one target in the sensor's frame, anticlockwise from its x axis.",
    _identifier("target_id"),
    _real("bearing_rad"),
)
RELATIVE_BEARING = _declare(
    "RelativeBearing",
    "The angle from the second target to the first as the sensor sees them: bearing 1 - bearing 2.",
    _identifier("first_id"),
    _identifier("second_id"),
    _real("angle_rad"),
)
RANGE = _declare("Range", "The distance to one target.", _identifier("target_id"), _real("range_m"))
ANCHOR_RANGE = _declare(
    "AnchorRange",
    "The distance from a tag on the body (a BodyPoint) to an anchor (a Landmark).",
    _identifier("anchor_id"),
    _identifier("tag_id"),
    _real("range_m"),
)
RANGE_BEARING = _declare(
    "RangeBearing",
    "Distance and angle to one target in the sensor's frame.",
    _identifier("target_id"),
    _real("range_m", may_be_partial=True),
    _real("bearing_rad", may_be_partial=True),
)
LINE_OF_SIGHT = _declare(
    "LineOfSight",
    "Azimuth and elevation of one target in the sensor's frame.",
    _identifier("target_id"),
    _real("azimuth_rad"),
    _real("elevation_rad"),
)
MOVING_LINE_OF_SIGHT = _declare(
    "MovingLineOfSight",
    "Azimuth and elevation of one target in the frame of a moving sensor, and the sensor's pose.",
    _identifier("target_id"),
    _real("azimuth_rad"),
    _real("elevation_rad"),
    _vector("position_m"),
    _vector("quaternion"),
)
SHOT_DETECTION = _declare(
    "ShotDetection",
    "One shot heard by one sensor; the shockwave is missing if the sensor cannot hear it.",
    _identifier("shot_id"),
    _real("muzzle_blast_azimuth_rad"),
    _real("shockwave_azimuth_rad", may_be_nan=True),
    _real("time_difference_s", may_be_nan=True),
)
SHOT_REPORT = _declare(
    "ShotReport",
    "Report of one of several sensors on a shot: the direction of the muzzle blast, the direction of "
    "the bullet, and the time by which the shockwave arrived earlier. This time is in `left_lead_s` or "
    "`right_lead_s`, by the side of the muzzle blast from which the shockwave came.",
    _identifier("sensor_id"),
    _real("muzzle_blast_azimuth_rad"),
    _real("trajectory_rad", may_be_nan=True),
    _real("left_lead_s", may_be_nan=True),
    _real("right_lead_s", may_be_nan=True),
)
ARRIVAL_DIFFERENCE = _declare(
    "ArrivalDifference",
    "The time by which a sound arrived later at one microphone (a Landmark) than at a reference, and "
    "the variances of both arrivals. All differences with one stamp share the error of the reference.",
    _identifier("microphone_id"),
    _identifier("reference_id"),
    _real("difference_s"),
    _real("variance_s2"),
    _real("reference_variance_s2"),
    _real("likeness"),
)
POSITION_FIX = _declare(
    "PositionFix",
    "A position in the log's Cartesian frame, of two or three numbers, with its covariance, row-major "
    "or diagonal.",
    _vector("position_m", may_be_partial=True),
    _vector("covariance_m2", may_be_nan=True),
)
VELOCITY_FIX = _declare(
    "VelocityFix",
    "A velocity in the log's Cartesian frame with its covariance, row-major.",
    _vector("velocity_mps", may_be_partial=True),
    _vector("covariance_m2ps2", may_be_nan=True),
)
GEODETIC_FIX = _declare(
    "GeodeticFix",
    "A position on the WGS 84 ellipsoid; its covariance, row-major or diagonal, in m^2 east, north and "
    "perhaps up. Channels may state the origin of the tangent plane: origin_latitude_deg, "
    "origin_longitude_deg and origin_altitude_m above the ellipsoid.",
    _real("latitude_deg"),
    _real("longitude_deg"),
    _real("altitude_m", may_be_nan=True),
    Field("covariance_m2", "vector", may_be_nan=True, may_be_absent=True),
)
POSE = _declare(
    "Pose",
    "The pose of a body in a frame: its position, and the rotation from the body's frame to this frame "
    "as a unit quaternion w, x, y, z. The covariance, row-major, is that of x, y, z in m and of small "
    "rotations about the frame's x, y, z in rad. The channel's metadata names the frames.",
    _vector("position_m", may_be_partial=True),
    _vector("quaternion"),
    _vector("covariance", may_be_nan=True),
)
TWIST = _declare(
    "Twist",
    "Velocity and turn rate of a body in its own frame, along x, y, z; their covariance, row-major.",
    _vector("velocity_mps", may_be_partial=True),
    _vector("turn_rate_radps", may_be_partial=True),
    _vector("covariance", may_be_nan=True),
)
DETECTION = _declare(
    "Detection",
    "One element of an unordered scan, in the frame that the channel names, else in the log's plane.",
    _identifier("scan_id"),
    _vector("position_m"),
)
SCAN_BEARING = _declare(
    "ScanBearing",
    "One bearing of an unordered scan, in the sensor's frame, anticlockwise from its x axis.",
    _identifier("scan_id"),
    _real("bearing_rad"),
)
SCAN_RANGE_BEARING = _declare(
    "ScanRangeBearing",
    "One distance and angle of an unordered scan, in the sensor's frame, as measured by a radar.",
    _identifier("scan_id"),
    _real("range_m"),
    _real("bearing_rad"),
)
SCAN = _declare(
    "Scan",
    "One sweep of a sensor and its number of detections, which may be 0.",
    _identifier("scan_id"),
    _identifier("detections"),
)
ORIENTATION = _declare(
    "Orientation",
    "A rotation from the body frame to the log's frame: unit quaternion w, x, y, z.",
    _vector("quaternion"),
)
AXIS = _declare("Axis", "An undirected axis: a unit vector equal to its negative.", _vector("axis"))
INERTIAL_SAMPLE = _declare(
    "InertialSample",
    "Specific force, turn rate and, with a magnetometer, the magnetic field; body frame.",
    _vector("specific_force_mps2", may_be_partial=True),
    _vector("turn_rate_radps", may_be_partial=True),
    _vector("magnetic_field_ut", may_be_nan=True),
)
MAGNETIC_FIELD = _declare(
    "MagneticField",
    "The magnetic field in the body frame with its covariance, row-major.",
    _vector("magnetic_field_ut"),
    _vector("covariance_ut2", may_be_nan=True),
)
ODOMETRY = _declare(
    "Odometry",
    "Forward velocity and turn rate that are valid from this message to the next.",
    _real("forward_mps"),
    _real("turn_radps"),
)
SCORE_VECTOR = _declare(
    "ScoreVector",
    "Similarity scores of one probe against one gallery entry, one score per matcher.",
    _identifier("probe_id"),
    _identifier("gallery_id"),
    _vector("scores", may_be_nan=True),
)
VECTOR_MEASUREMENT = _declare(
    "VectorMeasurement", "A measurement of any other kind.", _vector("value", may_be_partial=True)
)
COURSE_FIX = _declare(
    "CourseFix",
    "A position in the log's plane (east, north), course over ground clockwise from north, and speed.",
    _vector("position_m"),
    _real("course_rad", may_be_nan=True),
    _real("speed_mps", may_be_nan=True),
)

# Messages about the world.

LANDMARK = _declare(
    "Landmark", "A fixed point of the map.", _identifier("landmark_id"), _vector("position_m")
)
BODY_POINT = _declare(
    "BodyPoint",
    "The position of a sensor, antenna or tag in the body's frame: its lever arm.",
    _identifier("point_id"),
    _vector("position_m"),
)
TRUTH_STATE = _declare(
    "TruthState",
    "The reference state; the channel's metadata names the components.",
    _vector("state", may_be_nan=True),
)
OUTAGE = _declare(
    "Outage",
    "A span in which a sensor was silent.",
    Field("end_time_ns", "time_ns"),
)
LINK_EVENT = _declare(
    "LinkEvent",
    "One message of a network link; `arrival_time_ns` is the time at which it arrived or was lost.",
    _identifier("sender_id"),
    _identifier("receiver_id"),
    Field("arrival_time_ns", "time_ns"),
    _identifier("lost"),
)
IDENTITY = _declare(
    "Identity",
    "The target of the message in the same row of another topic, if that message does not state it.",
    _identifier("thing_id"),
)

# Messages of estimators; covariances are full, row-major, in the tangent space.

GAUSSIAN_ESTIMATE = _declare(
    "GaussianEstimate", "Mean and covariance of a state.", _vector("mean"), _vector("covariance")
)
ESTIMATE_SIZE = _declare(
    "EstimateSize",
    "Number of elements in the set or density estimate at this time, which may be 0.",
    _identifier("elements"),
)
SET_ESTIMATE = _declare(
    "SetEstimate",
    "One element of a set: a vertex of ring `ring_id`, in order.",
    _identifier("ring_id"),
    _vector("vertex"),
)
SET_STEP = _declare(
    "SetStep",
    "The origin of the set at this time: the time of the earlier set that was moved, the interval of "
    "the heading, and the factor by which a simpler form enlarged the set.",
    Field("anchor_time_ns", "time_ns"),
    _real("heading_rad"),
    _real("heading_half_width_rad"),
    _real("area_growth"),
)
DENSITY_ESTIMATE = _declare(
    "DensityEstimate",
    "One component of a mixture, or one weighted sample if the covariance is zero.",
    _real("weight"),
    _vector("mean"),
    _vector("covariance"),
)
EFFECTIVE_PARTICLES = _declare(
    "EffectiveParticles",
    "The number of particles of an estimate, and their effective number.",
    _identifier("particles"),
    _real("effective"),
)
INNOVATION = _declare(
    "Innovation",
    "The difference of one measurement from its prediction, and whether the gate accepted it.",
    _identifier("target_id"),
    _identifier("accepted"),
    _vector("innovation", may_be_nan=True),
    _vector("covariance", may_be_nan=True),
    _real("normalised_innovation_squared"),
    Field("log_likelihood", "real", may_be_nan=True, may_be_absent=True),
)
FAILURE = _declare(
    "Failure",
    "A run ended here; the channel's metadata lists the reasons by number, as JSON.",
    _identifier("reason"),
)
SKIPPED = _declare(
    "Skipped",
    "A measurement was not used; the channel's metadata lists the reasons by number, as JSON.",
    _identifier("reason"),
)
STARTED = _declare(
    "Started",
    "The estimator assumed a fact that the log does not state, such as the initial state; the channel's "
    "metadata lists the assumptions by number, as JSON.",
    _identifier("reason"),
)
DIAGNOSED = _declare(
    "Diagnosed",
    "A diagnosis found a fault that begins here; the channel's metadata lists the faults by number, as "
    "JSON.",
    _identifier("reason"),
)
REWOUND = _declare(
    "Rewound",
    "A late measurement was used, and this number of later messages was reprocessed.",
    _identifier("repeated"),
)
WAITED = _declare(
    "Waited",
    "A late measurement was used in its order, because newer ones waited for it. `behind_s` states how "
    "much newer they are.",
    _real("behind_s"),
)
COVERAGE = _declare(
    "Coverage",
    "The span from this stamp to the end of a run, and the part of it with estimates.",
    Field("end_time_ns", "time_ns"),
    _real("estimated_s"),
)
SOLUTION = _declare(
    "Solution",
    "The outcome of one batch solution.",
    _identifier("iterations"),
    _identifier("converged"),
    _identifier("rank"),
    _real("cost"),
)
MODE_PROBABILITIES = _declare(
    "ModeProbabilities",
    "The probability of each mode of motion; the channel's metadata names the modes as components.",
    _vector("probability"),
)
BOUND_STEP = _declare(
    "BoundStep",
    "The linearised motion from the previous true state to this one, its noise, and the information of "
    "the measurements; row-major.",
    _vector("transition"),
    _vector("noise"),
    _vector("information", may_be_nan=True),
)
ITERATION = _declare(
    "Iteration",
    "One step of an iterated solution: the cost before it, its damping, and its largest step.",
    _identifier("iteration"),
    _real("cost"),
    _real("damping"),
    _real("largest_step"),
)
OBSERVABILITY = _declare(
    "Observability",
    "The information of the measurements since an earlier stamp about the state at that stamp: rank and "
    "eigenvalues (ascending) of the local Gramian in units of the prior, and the weakest direction.",
    Field("begin_time_ns", "time_ns"),
    _identifier("rank"),
    _identifier("measurements"),
    _vector("eigenvalues"),
    _vector("direction"),
)
TRACK_ESTIMATE = _declare(
    "TrackEstimate",
    "Mean and covariance of one of several states, identified by its number.",
    _identifier("track_id"),
    _vector("mean"),
    _vector("covariance"),
)

EXISTENCE = _declare(
    "Existence",
    "The probability that the track in the same row of another topic is that of a target.",
    _real("existence"),
)
ASSOCIATION = _declare(
    "Association",
    "The probability that a detection belongs to a track; the metadata lists the sensors by number. "
    "Detections of a scan that were merged, because they are of one hull, count as one.",
    _identifier("track_id"),
    _identifier("sensor_id"),
    _identifier("scan_id"),
    _identifier("detection"),
    _real("probability"),
)
APPROXIMATION = _declare(
    "Approximation",
    "The number of tracks that share detections of a scan, for which association probabilities were "
    "approximated.",
    _identifier("tracks"),
)

SCHEMAS: dict[str, Schema] = {
    schema.full_name: schema for schema in list(globals().values()) if isinstance(schema, Schema)
}
