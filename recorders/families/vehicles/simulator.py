"""Vehicles that send their positions to a network, and a roadside sensor of unknown pose.

Source: Zhang, Hinz, Gulati, Clarke, Knoll, "Cooperative vehicle-infrastructure localization based on the
symmetric measurement equation filter", 2016, section 4. Vehicle N's own fixes are on /vehicleN/fix.
/network has the same fixes as they arrive, without identity and unordered. /infrastructure has unordered
detections in the sensor's own frame.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.common_streams import prior_stream, stated_numbers, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.vehicles.models import turn
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.log.planes import FRAME, body_of
from fuselog.recorders.models.geodesy import out_of_tangent_plane
from fuselog.recorders.models.planar import into_frame
from fuselog.recorders.models.states import PLANE_MOTION, POSE
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
State = Annotated[tuple[float, ...], Field(min_length=4, max_length=4)]
Pose = Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]
Box = Annotated[tuple[float, ...], Field(min_length=4, max_length=4)]
LatitudeLongitude = Annotated[tuple[float, ...], Field(min_length=2, max_length=2)]
Share = Annotated[float, Field(ge=0, lt=1)]
Detected = Annotated[float, Field(gt=0, le=1)]
PAPER_START: tuple[State, ...] = (
    (0.0, -1.5, 100.0, -1.0),
    (0.0, -1.5, 0.0, 1.0),
    (0.0, 0.0, 0.0, 3.0),
    (0.0, 1.5, 0.0, 1.0),
    (0.0, 1.5, 100.0, -1.0),
)


class Delayed(Parameters):
    """Delays of messages.

    Attributes:
        latency_s: shortest delay from measurement to arrival.
        latency_jitter_s: mean of the additional random delay (exponential).
    """

    latency_s: NonNegativeFloat = 0.0
    latency_jitter_s: NonNegativeFloat = 0.0


class Fixes(Delayed):
    """Position fixes of vehicles.

    Attributes:
        rate_hz: fixes per second of each vehicle.
        variance_m2: variance of a fix, per axis.
        dropout_probability: probability that a fix is lost.
    """

    rate_hz: PositiveFloat = 1.0
    variance_m2: PositiveFloat = 0.5
    dropout_probability: Share = 0.0


class Scans(Delayed):
    """Unordered scans of detections.

    Attributes:
        detection_probability: probability that a scan detects a vehicle.
        clutter_per_scan: mean number of false detections in a scan (Poisson), spread over the field.
    """

    detection_probability: Detected = 1.0
    clutter_per_scan: NonNegativeFloat = 0.0


class Infrastructure(Scans):
    """A roadside sensor that sees the vehicles.

    Attributes:
        rate_hz: scans per second; 0 for no scans.
        variance_m2: variance of a detection, per axis.
        pose: true pose of the sensor (x, y, heading), in m and rad.
    """

    rate_hz: NonNegativeFloat = 1.0
    variance_m2: PositiveFloat = 0.1
    pose: Pose = (60.0, -40.0, 2.0)


class VehiclesParameters(Parameters):
    """Vehicles in the plane and the sensors that detect them.

    Attributes:
        duration_s: length of the run.
        step_s: length of a time step with constant acceleration.
        stochastic: whether the initial states are drawn from the prior, and the vehicles accelerate.
            Filters always assume both; if this is False, as in the paper, they are conservative.
        start: initial states (x, vx, y, vy) of the vehicles, in m and m/s.
        vehicles: number of vehicles with random initial positions in the field; 0 to use `start`.
        speed_mps: speed of vehicles with random initial positions.
        turn_rate_radps: turn rate of each vehicle; if not set, vehicles drive straight.
        acceleration_sigma_mps2: standard deviation of the acceleration of a time step, per axis.
        prior_variance: variances of the prior (x, vx, y, vy), in m^2 and m^2/s^2.
        field_m: limits of the field (smallest x, largest x, smallest y, largest y).
        origin_deg: latitude and longitude of the plane's origin.
        fix: position fixes of the vehicles.
        network: scans of the fixes without identity, as they arrive in the network.
        infrastructure: the roadside sensor.
    """

    duration_s: PositiveFloat = 100.0
    step_s: PositiveFloat = 1.0
    stochastic: bool = True
    start: tuple[State, ...] = PAPER_START
    vehicles: Annotated[int, Field(ge=0, le=60)] = 0
    speed_mps: NonNegativeFloat = 2.0
    turn_rate_radps: tuple[float, ...] = ()
    acceleration_sigma_mps2: NonNegativeFloat = 0.5
    prior_variance: State = (2.5, 1.0, 2.5, 1.0)
    field_m: Box = (-200.0, 200.0, -150.0, 350.0)
    origin_deg: LatitudeLongitude = (48.1750, 11.5950)
    fix: Fixes = Fixes()
    network: Scans = Scans()
    infrastructure: Infrastructure = Infrastructure()

    @property
    def field_area_m2(self) -> float:
        """Return the area of the field."""
        west, east, south, north = self.field_m
        return (east - west) * (north - south)


class Drive(NamedTuple):
    """Motion of all vehicles.

    `nominal` are the initial states (vehicles, 4) known in advance, `states` (steps + 1, vehicles, 4)
    the truth, and `accelerations` (steps, vehicles, 2) are constant during each step.
    """

    step_s: float
    turn_rate_radps: Floats
    nominal: Floats
    states: Floats
    accelerations: Floats

    def states_at(self, times_s: Floats) -> Floats:
        """Compute the exact states (n, vehicles, 4) at any times within the drive."""
        steps = len(self.accelerations)
        step = np.minimum((times_s / self.step_s + 1e-9).astype(int), steps - 1)
        return self.after(step, times_s - step * self.step_s)

    def after(self, step: Integers, duration_s: Floats) -> Floats:
        """Compute the states (n, vehicles, 4) at durations (n,) after the beginning of steps (n,)."""
        span_s, acceleration = duration_s[:, None], self.accelerations[step]
        moved = turn(np.moveaxis(self.states[step], -1, 0), self.turn_rate_radps, span_s)
        states = np.stack(moved, axis=-1)
        states[..., 0::2] += 0.5 * span_s[..., None] ** 2 * acceleration
        states[..., 1::2] += span_s[..., None] * acceleration
        return states


class Detections(NamedTuple):
    """Unordered scans: the number of detections in each, and all detections (n, 2), scan after scan."""

    counts: Integers
    places: Floats


def simulate(parameters: VehiclesParameters, rng: np.random.Generator) -> Recording:
    """Record one run; raise BadInput if the number of turn rates does not match the vehicles."""
    drive_rng, fix_rng, network_rng, sensor_rng, delay_rng = rng.spawn(5)
    drive = _drive(parameters, drive_rng)
    fix_s = _times(parameters, parameters.fix.rate_hz)
    scan_s = _times(parameters, parameters.infrastructure.rate_hz)
    fixes = drive.states_at(fix_s)[..., 0::2]
    fixes += np.sqrt(parameters.fix.variance_m2) * fix_rng.normal(size=fixes.shape)
    is_received = fix_rng.uniform(size=fixes.shape[:2]) >= parameters.fix.dropout_probability
    seen = np.stack(
        into_frame(
            parameters.infrastructure.pose, np.moveaxis(drive.states_at(scan_s)[..., 0::2], -1, 0)
        ),
        axis=-1,
    )
    seen += np.sqrt(parameters.infrastructure.variance_m2) * sensor_rng.normal(size=seen.shape)
    network = _scan(parameters, parameters.network, fixes, is_received, network_rng)
    everyone = np.ones(seen.shape[:2], bool)
    sensor = _scan(parameters, parameters.infrastructure, seen, everyone, sensor_rng)
    truth_s = np.union1d(np.append(0.0, fix_s), scan_s)
    streams = [
        *_vehicle_streams(parameters, drive, truth_s),
        *_fix_streams(parameters, fix_s, fixes, is_received, delay_rng),
        *_scan_streams("/network", parameters, parameters.network, fix_s, network, delay_rng),
        *_scan_streams(
            "/infrastructure", parameters, parameters.infrastructure, scan_s, sensor, delay_rng
        ),
        truth_stream(
            "/infrastructure/truth",
            simulation_stamps_ns(truth_s),
            POSE,
            np.tile(parameters.infrastructure.pose, (len(truth_s), 1)),
        ),
    ]
    return Recording(streams)


def _times(parameters: VehiclesParameters, rate_hz: float) -> Floats:
    """Return a sensor's times; an empty array if it does not report."""
    return np.arange(1, int(parameters.duration_s * rate_hz + 1e-9) + 1) / (rate_hz or 1.0)


def _drive(parameters: VehiclesParameters, rng: np.random.Generator) -> Drive:
    start = _start(parameters, rng)
    count = len(start)
    rates = np.array(parameters.turn_rate_radps or (0.0,) * count)
    if len(rates) != count:
        raise BadInput(
            f"turn_rate_radps has {len(rates)} entries for {count} vehicles; give one for each"
        )
    steps = max(1, int(np.ceil(parameters.duration_s / parameters.step_s - 1e-9)))
    accelerations = rng.normal(size=(steps, count, 2)) * parameters.acceleration_sigma_mps2
    disturbance = rng.normal(size=(count, 4)) * np.sqrt(parameters.prior_variance)
    if not parameters.stochastic:
        accelerations, disturbance = np.zeros_like(accelerations), np.zeros_like(disturbance)
    drive = Drive(parameters.step_s, rates, start, np.empty((steps + 1, count, 4)), accelerations)
    drive.states[0] = start + disturbance
    for step in range(steps):
        drive.states[step + 1] = drive.after(np.array([step]), np.array([parameters.step_s]))[0]
    return drive


def _start(parameters: VehiclesParameters, rng: np.random.Generator) -> Floats:
    """Return the nominal initial states (vehicles, 4)."""
    if not parameters.vehicles:
        return np.array(parameters.start)
    west, east, south, north = parameters.field_m
    places = rng.uniform((west, south), (east, north), (parameters.vehicles, 2))
    heading = rng.uniform(0.0, 2.0 * np.pi, parameters.vehicles)
    velocity = parameters.speed_mps * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return np.stack([places[:, 0], velocity[:, 0], places[:, 1], velocity[:, 1]], axis=1)


def _scan(
    parameters: VehiclesParameters,
    sensor: Scans,
    places: Floats,
    offered: NDArray[np.bool_],
    rng: np.random.Generator,
) -> Detections:
    """Make unordered scans of positions (scans, vehicles, 2) with missed and false detections."""
    kept = offered & (rng.uniform(size=offered.shape) < sensor.detection_probability)
    false = rng.poisson(sensor.clutter_per_scan, len(places))
    west, east, south, north = parameters.field_m
    wrong = rng.uniform((west, south), (east, north), (int(false.sum()), 2))
    if isinstance(sensor, Infrastructure):
        wrong = np.stack(into_frame(sensor.pose, wrong.T), axis=-1)
    scan = np.concatenate([np.nonzero(kept)[0], np.repeat(np.arange(len(places)), false)])
    order = np.lexsort((rng.uniform(size=len(scan)), scan))
    return Detections(kept.sum(axis=1) + false, np.concatenate([places[kept], wrong])[order])


def _vehicle_streams(parameters: VehiclesParameters, drive: Drive, truth_s: Floats) -> list[Stream]:
    """Make prior and truth of every vehicle; the prior's channel states its motion parameters."""
    states, stamps_ns = drive.states_at(truth_s), simulation_stamps_ns(truth_s)
    covariance = np.diag(parameters.prior_variance)
    streams = []
    for index, rate in enumerate(drive.turn_rate_radps.tolist()):
        name, start = f"/vehicle{index + 1}", drive.nominal[index]
        motion = {"turn_rate_radps": repr(rate)}
        motion |= stated_numbers(parameters, "acceleration_sigma_mps2")
        streams += [
            prior_stream(f"{name}/prior", stamps_ns[0], PLANE_MOTION, start, covariance, motion),
            truth_stream(f"{name}/truth", stamps_ns, PLANE_MOTION, states[:, index]),
        ]
    return streams


def _fix_streams(
    parameters: VehiclesParameters,
    times_s: Floats,
    fixes: Floats,
    is_received: NDArray[np.bool_],
    rng: np.random.Generator,
) -> list[Stream]:
    """Simulate every vehicle's fixes, in the plane and as latitude and longitude."""
    covariance = (parameters.fix.variance_m2 * np.eye(2)).reshape(1, 4)
    streams = []
    for index in range(fixes.shape[1]):
        rows = is_received[:, index]
        places = fixes[rows, index]
        published, logged = _clocks(parameters.fix, times_s[rows], rng)
        latitude, longitude, _ = out_of_tangent_plane(places.T, parameters.origin_deg)
        streams += [
            make_stream(
                f"/vehicle{index + 1}/fix",
                schemas.POSITION_FIX,
                published,
                log_time_ns=logged,
                position_m=places,
                covariance_m2=np.repeat(covariance, len(places), axis=0),
            ),
            make_stream(
                f"/vehicle{index + 1}/geodetic_fix",
                schemas.GEODETIC_FIX,
                published,
                log_time_ns=logged,
                latitude_deg=latitude,
                longitude_deg=longitude,
                altitude_m=np.zeros(len(places)),
            ),
        ]
    return streams


def _scan_streams(
    prefix: str,
    parameters: VehiclesParameters,
    sensor: Scans,
    times_s: Floats,
    detections: Detections,
    rng: np.random.Generator,
) -> list[Stream]:
    """Make scans with counts and their detections; the channels state the parameters for a filter."""
    published, logged = _clocks(sensor, times_s, rng)
    scan = np.repeat(np.arange(len(times_s)), detections.counts)
    variance_m2 = (sensor if isinstance(sensor, Infrastructure) else parameters.fix).variance_m2
    stated = {
        "variance_m2": repr(variance_m2),
        "detection_probability": repr(sensor.detection_probability),
        "clutter_per_m2": repr(sensor.clutter_per_scan / parameters.field_area_m2),
    }
    if isinstance(sensor, Infrastructure):
        stated[FRAME] = body_of(f"{prefix}/truth", {})
    return [
        make_stream(
            f"{prefix}/scan",
            schemas.SCAN,
            published,
            log_time_ns=logged,
            metadata=stated,
            scan_id=np.arange(len(times_s)),
            detections=detections.counts,
        ),
        make_stream(
            f"{prefix}/detection",
            schemas.DETECTION,
            published[scan],
            log_time_ns=logged[scan],
            metadata=stated,
            scan_id=scan,
            position_m=detections.places,
        ),
    ]


def _clocks(sensor: Delayed, times_s: Floats, rng: np.random.Generator) -> tuple[Integers, Integers]:
    """Return the publish times of messages and their arrival times at the recorder."""
    delay_s = sensor.latency_s + sensor.latency_jitter_s * rng.exponential(size=len(times_s))
    return simulation_stamps_ns(times_s), simulation_stamps_ns(times_s + delay_s)


VEHICLES = Simulator(
    "vehicles that send fixes to a network, and a roadside sensor of unknown pose; both unordered",
    VehiclesParameters,
    simulate,
)
