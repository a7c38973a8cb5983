"""Simulator of a vehicle, a person or a quadrotor with an inertial unit and a GNSS receiver.

The path is a spline through way points with exact velocity and acceleration, so the unit's measurements
contain no integration error. The body begins at rest. The unit has the errors of its grade; fixes have
outages, float solutions, bursts of multipath, and delays.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from fuselog.recorders.common_streams import outage_stream, prior_stream, stated_numbers, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.inertial import earth_rate, gravity
from fuselog.recorders.models.states import NAVIGATION
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns
from fuselog.recorders.simulators.navigation_parameters import NavigationParameters, Span, Unit

Floats = NDArray[np.float64]

GRID_S = 0.05  # between the knots of the path


class Path(NamedTuple):
    """The path of the body: its position (3,) and its yaw, pitch and roll, as splines over time."""

    position: BSpline
    attitude: BSpline

    def orientation(self, times_s: Floats) -> Rotation:
        """Return the rotation from forward, left, up to east, north, up."""
        return Rotation.from_euler("ZYX", self.attitude(times_s))

    def turn_rate(self, times_s: Floats) -> Floats:
        """Compute the turn rate relative to the plane, (n, 3) in the body's axes."""
        _, pitch, roll = self.attitude(times_s).T
        yaw_rate, pitch_rate, roll_rate = self.attitude.derivative()(times_s).T
        return np.stack(
            [
                roll_rate - np.sin(pitch) * yaw_rate,
                np.cos(roll) * pitch_rate + np.sin(roll) * np.cos(pitch) * yaw_rate,
                np.cos(roll) * np.cos(pitch) * yaw_rate - np.sin(roll) * pitch_rate,
            ],
            axis=1,
        )


def simulate(parameters: NavigationParameters, rng: np.random.Generator) -> Recording:
    """Simulate one run."""
    path_rng, unit_rng, gnss_rng, prior_rng, carried_rng = rng.spawn(5)
    unit = parameters.unit
    times_s = np.arange(int(parameters.duration_s * unit.rate_hz + 1e-9) + 1) / unit.rate_hz
    path = _path(parameters, path_rng)
    inertial, gyro_bias, force_bias = _inertial(parameters, path, times_s, unit_rng)
    truth = np.hstack(
        [
            path.position(times_s),
            path.position.derivative()(times_s),
            path.orientation(times_s).as_quat(canonical=True, scalar_first=True),
            gyro_bias,
            force_bias,
        ]
    )
    streams = [
        inertial,
        *_gnss(parameters, path, gnss_rng),
        *_carried(parameters, path, carried_rng),
        truth_stream("/body/truth", simulation_stamps_ns(times_s), NAVIGATION, truth),
    ]
    if parameters.prior.is_told:
        streams.append(_prior(parameters, truth[0], prior_rng))
    return Recording(streams)


def _path(parameters: NavigationParameters, rng: np.random.Generator) -> Path:
    """Compute the spline through the way points, with an initial standstill, and its attitude."""
    points = np.array(parameters.way_points_m, float).reshape(-1, 3)
    if not len(points):
        points = _random_points(parameters, rng)
    if len(points) < 3:
        raise BadInput(
            f"way_points_m has {len(points)} points; give three points or more, each of east, north "
            "and up"
        )
    begin_s, end_s = parameters.rest_s, parameters.duration_s
    if begin_s >= end_s:
        raise BadInput(
            f"rest_s is {begin_s:g} and duration_s {end_s:g}: the body must move after its rest; give a "
            "longer duration_s, or a shorter rest_s"
        )
    knots_s = np.linspace(begin_s, end_s, len(points))
    still = [(1, np.zeros(3)), (2, np.zeros(3))]
    moving = make_interp_spline(knots_s, points, k=5, bc_type=(still, still))
    # a separate grid joins rest and motion, fine enough to be as smooth as the spline
    grid_s = np.arange(0.0, end_s + 0.1, GRID_S)
    moving_s = np.clip(grid_s, begin_s, end_s)
    place, velocity = moving(moving_s), moving.derivative()(moving_s)
    moves = np.hypot(*velocity.T[:2]) > 0.05
    course = np.unwrap(np.arctan2(velocity[moves, 1], velocity[moves, 0]))
    attitude = np.zeros((len(grid_s), 3))
    attitude[:, 0] = np.interp(grid_s, grid_s[moves], course)
    set_off = np.clip((grid_s - begin_s) / 2.0, 0.0, 1.0)
    going = set_off**3 * (10.0 - 15.0 * set_off + 6.0 * set_off**2)
    if parameters.carrier == "vehicle":
        attitude[:, 1] = -np.arctan(velocity[:, 2] / np.maximum(np.hypot(*velocity.T[:2]), 1.0))
    elif parameters.carrier == "pedestrian":
        _step(grid_s, going, place, attitude, rng)
    else:
        _lean(grid_s, going, place, attitude, rng)
    return Path(make_interp_spline(grid_s, place, k=5), make_interp_spline(grid_s, attitude, k=5))


def _step(
    grid_s: Floats, going: Floats, place: Floats, attitude: Floats, rng: np.random.Generator
) -> None:
    """Add, in place, bobbing and swaying at 1.9 steps per second, and slow turns to both sides."""
    phase, step = rng.uniform(0.0, 2 * np.pi, 4), 2 * np.pi * 1.9 * grid_s
    place[:, 2] += 0.03 * going * np.sin(step + phase[0])
    attitude[:, 0] += 0.8 * going * np.sin(0.5 * grid_s + phase[1])
    attitude[:, 1] = 0.05 * going * np.sin(step + phase[2])
    attitude[:, 2] = 0.05 * going * np.sin(0.5 * step + phase[3])


def _lean(
    grid_s: Floats, going: Floats, place: Floats, attitude: Floats, rng: np.random.Generator
) -> None:
    """Set the attitude, in place: a slow yaw, and a tilt that aligns the up axis with the thrust."""
    phase = rng.uniform(0.0, 2 * np.pi, 2)
    yaw = phase[0] + 1.5 * going * np.sin(0.2 * grid_s + phase[1])
    thrust = make_interp_spline(grid_s, place, k=5).derivative(2)(grid_s)
    thrust[:, 2] += 9.81
    ahead = np.cos(yaw) * thrust[:, 0] + np.sin(yaw) * thrust[:, 1]
    left = np.cos(yaw) * thrust[:, 1] - np.sin(yaw) * thrust[:, 0]
    pitch = np.arctan2(ahead, thrust[:, 2])
    attitude[:] = np.stack([yaw, pitch, -np.arctan2(left, np.hypot(ahead, thrust[:, 2]))], axis=1)


def _random_points(parameters: NavigationParameters, rng: np.random.Generator) -> Floats:
    """Draw way points: a path of legs for a vehicle or person, points in a box for a quadrotor."""
    legs = max(3, round((parameters.duration_s - parameters.rest_s) / parameters.leg_s))
    length_m = parameters.speed_mps * parameters.leg_s
    if parameters.carrier == "quadrotor":
        inside = rng.uniform(-1.0, 1.0, (legs, 3)) * [length_m, length_m, 0.25 * length_m]
        return np.vstack([np.zeros(3), inside + np.array([0.0, 0.0, 0.5 * length_m])])
    course = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.normal(size=legs) * 0.6)
    steps = length_m * np.stack([np.cos(course), np.sin(course), 0.02 * rng.normal(size=legs)], axis=1)
    return np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])


def _inertial(
    parameters: NavigationParameters, path: Path, times_s: Floats, rng: np.random.Generator
) -> tuple[Stream, Floats, Floats]:
    """Simulate the unit's samples; also return gyroscope and accelerometer biases (n, 3)."""
    unit = parameters.unit
    turned = path.orientation(times_s).inv()
    earth = np.array(earth_rate(parameters.origin_latitude_deg))
    down = np.array([0.0, 0.0, -gravity(parameters.origin_latitude_deg, parameters.origin_altitude_m)])
    velocity, acceleration = (path.position.derivative(order)(times_s) for order in (1, 2))
    force = turned.apply(acceleration - down + 2.0 * np.cross(earth, velocity))
    rate = path.turn_rate(times_s) + turned.apply(earth)
    rates, gyro_bias = _sensed(
        unit, rate, unit.gyro_noise_density, unit.gyro_bias_density, unit.gyro_bias_sigma_radps, rng
    )
    forces, force_bias = _sensed(
        unit, force, unit.force_noise_density, unit.force_bias_density, unit.force_bias_sigma_mps2, rng
    )
    densities = ("force_noise_density", "gyro_noise_density", "force_bias_density", "gyro_bias_density")
    stream = make_stream(
        "/body/inertial",
        schemas.INERTIAL_SAMPLE,
        simulation_stamps_ns(times_s + unit.delay_s),
        metadata=stated_numbers(unit, *densities) | _origin(parameters),
        specific_force_mps2=_rounded(forces, unit.force_quantum_mps2),
        turn_rate_radps=_rounded(rates, unit.gyro_quantum_radps),
        magnetic_field_ut=np.full_like(force, np.nan),
    )
    return stream, gyro_bias, force_bias


def _sensed(
    unit: Unit,
    true: Floats,
    noise_density: float,
    bias_density: float,
    bias_sigma: float,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Simulate the measurement of a quantity (n, 3) along three axes; also return the biases (n, 3)."""
    step_s = 1.0 / unit.rate_hz
    walk = rng.normal(size=true.shape) * bias_density * np.sqrt(step_s)
    walk[0] = bias_sigma * rng.normal(size=3)
    bias = np.cumsum(walk, axis=0)
    axes = np.eye(3) + np.diag(unit.scale_sigma * rng.normal(size=3))
    axes += unit.misalignment_sigma_rad * rng.normal(size=(3, 3)) * (1.0 - np.eye(3))
    noise = rng.normal(size=true.shape) * noise_density / np.sqrt(step_s)
    return true @ axes.T + bias + noise, bias


def _rounded(values: Floats, quantum: float) -> Floats:
    """Round values to multiples of a quantum."""
    return np.round(values / quantum) * quantum if quantum else values


def _gnss(parameters: NavigationParameters, path: Path, rng: np.random.Generator) -> list[Stream]:
    """Simulate the fixes and velocities of the receiver's antenna, and the outages."""
    gnss, origin = parameters.gnss, _origin(parameters)
    lever = np.array(gnss.lever_m)

    def times(rate_hz: float) -> Floats:
        every_s = np.arange(0.0, parameters.duration_s + 1e-9, 1.0 / rate_hz)
        return every_s[~_within(every_s, gnss.outages_s)]

    def noise(times_s: Floats, sigma: float, sigma_up: float) -> tuple[Floats, Floats]:
        factor = np.where(_within(times_s, gnss.floats_s), gnss.float_factor, 1.0)
        sigmas = factor[:, None] * np.array([sigma, sigma, sigma_up])
        covariance = (sigmas[:, :, None] ** 2 * np.eye(3)).reshape(-1, 9)
        return sigmas * rng.normal(size=sigmas.shape), covariance

    fix_s = times(gnss.rate_hz)
    antenna = path.position(fix_s) + path.orientation(fix_s).apply(lever)
    error, covariance = noise(fix_s, gnss.sigma_m, gnss.sigma_up_m)
    error += _within(fix_s, gnss.multipath_s)[:, None] * np.array(gnss.multipath_m)
    streams = [
        make_stream(
            "/body/fix",
            schemas.POSITION_FIX,
            simulation_stamps_ns(fix_s + gnss.delay_s),
            metadata=origin,
            position_m=antenna + error,
            covariance_m2=covariance,
        )
    ]
    if gnss.velocity_rate_hz > 0:
        velocity_s = times(gnss.velocity_rate_hz)
        swung = path.orientation(velocity_s).apply(np.cross(path.turn_rate(velocity_s), lever))
        error, covariance = noise(velocity_s, gnss.sigma_mps, gnss.sigma_up_mps)
        streams.append(
            make_stream(
                "/body/velocity",
                schemas.VELOCITY_FIX,
                simulation_stamps_ns(velocity_s + gnss.velocity_delay_s),
                metadata=origin,
                velocity_mps=path.position.derivative()(velocity_s) + swung + error,
                covariance_m2ps2=covariance,
            )
        )
    if gnss.outages_s:
        streams.append(outage_stream("/body/fix/outages", simulation_stamps_ns(gnss.outages_s)))
    return streams


def _carried(parameters: NavigationParameters, path: Path, rng: np.random.Generator) -> list[Stream]:
    """Simulate the wheels, compass and barometer that are on board."""
    carried, streams = parameters.carried, []

    def times(rate_hz: float) -> Floats:
        return np.arange(0.0, parameters.duration_s + 1e-9, 1.0 / rate_hz)

    if carried.wheel_rate_hz > 0:
        times_s, axle = times(carried.wheel_rate_hz), np.array(carried.axle_m)
        turned, rate = path.orientation(times_s).inv(), path.turn_rate(times_s)
        velocity = turned.apply(path.position.derivative()(times_s)) + np.cross(rate, axle)
        scale = 1.0 + carried.wheel_scale_sigma * rng.normal()
        streams.append(
            make_stream(
                "/body/wheel",
                schemas.ODOMETRY,
                simulation_stamps_ns(times_s),
                metadata={"sigma_wheel_mps": repr(carried.wheel_sigma_mps)}
                | dict(zip(("axle_x_m", "axle_y_m", "axle_z_m"), map(repr, axle.tolist()), strict=True)),
                forward_mps=scale * velocity[:, 0]
                + carried.wheel_sigma_mps * rng.normal(size=len(rate)),
                turn_radps=rate[:, 2],
            )
        )
    if carried.compass_rate_hz > 0:
        times_s = times(carried.compass_rate_hz)
        error = Rotation.from_rotvec(
            np.outer(carried.compass_sigma_rad * rng.normal(size=len(times_s)), [0.0, 0.0, 1.0])
        )
        seen = (error * path.orientation(times_s)).as_quat(canonical=True, scalar_first=True)
        streams.append(
            make_stream(
                "/body/heading",
                schemas.ORIENTATION,
                simulation_stamps_ns(times_s),
                metadata={"sigma_heading_rad": repr(carried.compass_sigma_rad)},
                quaternion=seen,
            )
        )
    if carried.barometer_rate_hz > 0:
        times_s = times(carried.barometer_rate_hz)
        error_m = carried.barometer_sigma_m * rng.normal(size=(len(times_s), 1))
        streams.append(
            make_stream(
                "/body/height",
                schemas.VECTOR_MEASUREMENT,
                simulation_stamps_ns(times_s),
                metadata={"sigma_height_m": repr(carried.barometer_sigma_m)},
                value=path.position(times_s)[:, 2:] + error_m,
            )
        )
    return streams


def _within(times_s: Floats, spans_s: list[Span]) -> NDArray[np.bool_]:
    """Test which times are in one of the spans."""
    spans = np.array(spans_s, float).reshape(-1, 2)
    inside = (times_s[:, None] >= spans[:, 0]) & (times_s[:, None] < spans[:, 1])
    return np.any(inside, axis=1, keepdims=True)[:, 0]


def _prior(parameters: NavigationParameters, truth: Floats, rng: np.random.Generator) -> Stream:
    """Draw the prior by adding an error to the truth; an orientation's error is a yaw and a tilt.

    The yaw is about the vertical axis, so that an unknown heading does not affect the tilt.
    """
    prior, unit = parameters.prior, parameters.unit
    sigma = np.repeat(
        [
            prior.sigma_m,
            prior.sigma_mps,
            prior.tilt_sigma_rad,
            unit.gyro_bias_sigma_radps,
            unit.force_bias_sigma_mps2,
        ],
        3,
    )
    sigma[8] = prior.heading_sigma_rad
    error = sigma * rng.normal(size=15)
    mean = truth.copy()
    mean[:6] += error[:6]
    tilt = Rotation.from_rotvec([error[6], error[7], 0.0])
    turned = Rotation.from_rotvec([0.0, 0.0, error[8]]) * Rotation.from_quat(
        truth[6:10], scalar_first=True
    )
    mean[6:10] = (turned * tilt).as_quat(canonical=True, scalar_first=True)
    mean[10:] = 0.0  # the biases are drawn about zero
    covariance = np.diag(sigma**2)
    up = (turned * tilt).inv().apply([0.0, 0.0, 1.0])
    level = prior.tilt_sigma_rad**2 * (np.eye(3) - np.outer(up, up))
    covariance[6:9, 6:9] = level + prior.heading_sigma_rad**2 * np.outer(up, up)
    start_ns = simulation_stamps_ns(0.0)
    return prior_stream("/body/prior", start_ns, NAVIGATION, mean, covariance, _origin(parameters))


def _origin(parameters: NavigationParameters) -> dict[str, str]:
    """Return the metadata that states the origin of the plane."""
    return stated_numbers(parameters, "origin_latitude_deg", "origin_longitude_deg", "origin_altitude_m")


NAVIGATING = Simulator(
    "a vehicle, person or quadrotor with an inertial unit and GNSS: outages, float solutions, delays",
    NavigationParameters,
    simulate,
)
