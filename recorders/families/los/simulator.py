"""Optical sensors with biased attitudes that see targets: lines of sight, truth.

Belfadel, Osborne and Bar-Shalom, JAIF 2014. Sensors are at known positions; their true attitude is the
nominal attitude plus a bias. Targets are points, seen one after another (as the points of one
trajectory) or all at the same time. The frame is the paper's: y points up.
"""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat, PositiveInt
from scipy.spatial.transform import Rotation

from fuselog.recorders.common_streams import fix_stream, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.los.models import bias_components, line_of_sight, target_components
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording, Simulator, simulation_stamps_ns

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Triples = Annotated[list[Triple], Field(min_length=1)]


class OpticalParameters(Parameters):
    """Sensors, targets and sightings.

    Attributes:
        sensor_position_m: positions of the sensors (x, y, z).
        target_position_m: positions of the targets (x, y, z).
        nominal_attitude_deg: nominal yaw, pitch and roll of each sensor, one row per sensor or one row
            for all; 0 if not set.
        bias_deg: yaw, pitch and roll by which each sensor's true attitude differs from the nominal one,
            one row per sensor or one row for all; 0 if not set.
        sigma_rad: standard deviation of azimuth and elevation.
        interval_s: time between sightings.
        passes: number of passes over all targets.
        all_at_once: whether all targets are seen at the same time; otherwise one after another.
        field_of_view_deg: full opening angle of a sensor's cone of view, whose axis is the mean
            direction to all targets.
        dropout_probability: probability that a sighting is lost.
    """

    sensor_position_m: Triples = [(-5500, 950, 15), (-230, 2720, 45), (5900, 50, 20)]
    target_position_m: Triples = [(-2860, 6820, 0), (-235.9, 8152, 0), (2413, 6451, 0)]
    nominal_attitude_deg: Triples | None = None
    bias_deg: Triples | None = [(1.0, 1.0, 1.0)]
    sigma_rad: PositiveFloat = 0.34e-3
    interval_s: PositiveFloat = 1.0
    passes: PositiveInt = 10
    all_at_once: bool = False
    field_of_view_deg: Annotated[float, Field(gt=0, le=360)] = 360.0
    dropout_probability: Annotated[float, Field(ge=0, lt=1)] = 0.0

    @property
    def nominal_attitude_rad(self) -> Array:
        """Return the nominal attitudes of the sensors, (sensors, 3)."""
        return self._per_sensor("nominal_attitude_deg", self.nominal_attitude_deg)

    @property
    def bias_rad(self) -> Array:
        """Return the attitude biases of the sensors, (sensors, 3)."""
        return self._per_sensor("bias_deg", self.bias_deg)

    def _per_sensor(self, name: str, given_deg: list[Triple] | None) -> Array:
        sensors = len(self.sensor_position_m)
        rows_deg = [(0.0, 0.0, 0.0)] if given_deg is None else given_deg
        if len(rows_deg) not in (1, sensors):
            raise BadInput(
                f"{name} has {len(rows_deg)} rows for {sensors} sensors; give one each or one for all"
            )
        return np.broadcast_to(np.radians(rows_deg), (sensors, 3))


def simulate(parameters: OpticalParameters, rng: np.random.Generator) -> Recording:
    """Record one run; raise BadInput if the numbers of attitudes or biases do not match the sensors."""
    sensors = np.array(parameters.sensor_position_m)
    targets = np.array(parameters.target_position_m)
    nominal, bias = parameters.nominal_attitude_rad, parameters.bias_rad
    looks_ns = _look_times(parameters, len(targets))
    streams = [_truth(looks_ns, targets, bias)]
    for number, (place, attitude) in enumerate(zip(sensors, nominal, strict=True), start=1):
        streams += [
            *_mounting(number, place, attitude),
            _sightings(parameters, number, place, attitude + bias[number - 1], targets, looks_ns, rng),
        ]
    return Recording(streams)


def _look_times(parameters: OpticalParameters, targets: int) -> NDArray[np.int64]:
    """Compute when each target is seen in each pass, (passes, targets)."""
    per_pass = 1 if parameters.all_at_once else targets
    look = np.arange(parameters.passes)[:, None] * per_pass + np.arange(targets) % per_pass
    return simulation_stamps_ns(look * parameters.interval_s)


def _truth(looks_ns: NDArray[np.int64], targets: Array, bias: Array) -> Stream:
    """Make the stream of true target positions and biases, at the time of every sighting."""
    components = [
        *(name for number in range(1, len(targets) + 1) for name in target_components(number)),
        *(name for number in range(1, len(bias) + 1) for name in bias_components(number)),
    ]
    times_ns = np.unique(looks_ns)
    state = np.concatenate([targets.ravel(), bias.ravel()])
    return truth_stream("/truth", times_ns, components, np.tile(state, (len(times_ns), 1)))


def _mounting(number: int, place: Array, attitude: Array) -> list[Stream]:
    """Make the streams of a sensor's exactly known position and of its nominal attitude."""
    to_sensor = Rotation.from_euler("ZYX", attitude)
    start_ns = [SIMULATION_EPOCH_NS]
    return [
        fix_stream(f"/sensor{number}/position", start_ns, place[None], 0.0),
        make_stream(
            f"/sensor{number}/attitude",
            schemas.ORIENTATION,
            start_ns,
            quaternion=to_sensor.inv().as_quat(scalar_first=True)[None],
        ),
    ]


def _sightings(
    parameters: OpticalParameters,
    number: int,
    place: Array,
    attitude: Array,
    targets: Array,
    looks_ns: NDArray[np.int64],
    rng: np.random.Generator,
) -> Stream:
    """Simulate the lines of sight of one sensor, one message per target seen."""
    true = np.stack(line_of_sight(targets.T, place[:, None], attitude), axis=-1)
    noise = parameters.sigma_rad * rng.normal(size=(*looks_ns.shape, 2))
    seen = _in_view(parameters, place, targets) & (
        rng.uniform(size=looks_ns.shape) >= parameters.dropout_probability
    )
    look, target = np.nonzero(seen)
    measured = wrap_angle(true + noise)[look, target]
    order = np.argsort(looks_ns[look, target], kind="stable")
    return make_stream(
        f"/sensor{number}/line_of_sight",
        schemas.LINE_OF_SIGHT,
        looks_ns[look, target][order],
        metadata={
            key: repr(parameters.sigma_rad) for key in ("sigma_azimuth_rad", "sigma_elevation_rad")
        },
        target_id=target[order] + 1,
        azimuth_rad=measured[order, 0],
        elevation_rad=measured[order, 1],
    )


def _in_view(parameters: OpticalParameters, place: Array, targets: Array) -> NDArray[np.bool_]:
    """Find the targets (n,) that a sensor can see; a target at the sensor is never visible."""
    offset = targets - place
    distance = np.linalg.norm(offset, axis=1)
    away = distance > 0.0
    unit = offset / np.where(away, distance, 1.0)[:, None]
    middle = unit.mean(axis=0)
    half_view = np.radians(parameters.field_of_view_deg) / 2
    off_middle = np.arctan2(np.linalg.norm(np.cross(unit, middle), axis=1), unit @ middle)
    return away & (off_middle <= half_view)


OPTICAL_LOS = Simulator(
    "targets seen by optical sensors with biased attitudes: azimuth and elevation",
    OpticalParameters,
    simulate,
)
