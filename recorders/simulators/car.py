"""Simulator of a car with wheels, a receiver of fixes, and a compass, all with errors.

The car drives on exact arcs, one for each step of its odometry. Its logs test diagnosis and calibration.
Begin with `drive`; `streams_of` makes a log.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, PositiveFloat

from fuselog.recorders.common_streams import fix_stream, prior_stream, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.states import POSE
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

Floats = NDArray[np.floating]
Motion = Callable[[Floats], tuple[Floats, Floats]]
RAMP_S = 5.0  # time of acceleration after a rest
SPEED_MPS, TURN_RADPS, CIRCLE_S = 8.0, 0.4, 15.708


def straight(time_s: Floats) -> tuple[Floats, Floats]:
    """Return the rates of a straight drive: speeds and turn rates (n,) at times (n,)."""
    return np.full_like(time_s, SPEED_MPS), 0.0 * time_s


def changing_speed(time_s: Floats) -> tuple[Floats, Floats]:
    """Return the rates of a straight drive at changing speed."""
    return SPEED_MPS + 4.0 * np.sin(0.4 * time_s), 0.0 * time_s


def circle(time_s: Floats) -> tuple[Floats, Floats]:
    """Return the rates of a circle with a radius of 20 m."""
    return np.full_like(time_s, SPEED_MPS), np.full_like(time_s, TURN_RADPS)


def circles(time_s: Floats) -> tuple[Floats, Floats]:
    """Return the rates of alternating circles to the left and to the right."""
    is_left = time_s // CIRCLE_S % 2 == 0
    return np.full_like(time_s, SPEED_MPS), np.where(is_left, TURN_RADPS, -TURN_RADPS)


def slalom(time_s: Floats) -> tuple[Floats, Floats]:
    """Return the rates of a slalom."""
    return np.full_like(time_s, SPEED_MPS), TURN_RADPS * np.sin(0.8 * time_s)


def rich(time_s: Floats) -> tuple[Floats, Floats]:
    """Return the rates of turns in both directions at changing speed, which excite every parameter."""
    turn = 0.25 * np.sin(0.21 * time_s) + 0.15 * np.sin(0.53 * time_s)
    return SPEED_MPS + 3.0 * np.sin(0.4 * time_s), turn


MOTIONS: dict[str, Motion] = {
    "straight": straight,
    "changing speed": changing_speed,
    "circle": circle,
    "circles in both senses": circles,
    "slalom": slalom,
    "turns at changing speed": rich,
}


class CarParameters(Parameters):
    """The motion of the car, and the noise and faults of its sensors; by default there are no faults.

    Attributes:
        duration_s: length of the drive.
        motion: kind of motion.
        rest_s: duration of the initial standstill, which is followed by 5 s of acceleration.
        begin: "of the prior" draws the first pose from the prior, whose mean is zero; "any heading"
            starts the car at the origin with a random heading, and this pose is the mean of the prior.
        prior_sigma_m, prior_sigma_rad: standard deviations of the position, per axis, and of the heading
            in the prior.
        odometry_step_s, fix_step_s, compass_step_s: times between messages.
        first_fix_s: time of the first fix.
        forward_noise_density: noise density of the wheels' forward speed, in m/s/sqrt(Hz).
        turn_noise_density: noise density of the wheels' turn rate, in rad/s/sqrt(Hz).
        fix_sigma_m: standard deviation of a fix, per axis.
        compass_sigma_rad: standard deviation of a heading.
        forward_factor, turn_factor: ratio of the wheels' readings to the motion.
        turn_error_radps: bias of the wheels' turn rate, measured minus true.
        lever_x_m, lever_y_m: position of the antenna, forward and left of the car's reference point.
        fix_delay_s: time from the measurement of a fix to its stamp.
        compass_error_rad: bias of the compass, measured minus true.
    """

    duration_s: PositiveFloat = 120.0
    motion: Literal[
        "straight",
        "changing speed",
        "circle",
        "circles in both senses",
        "slalom",
        "turns at changing speed",
    ] = "turns at changing speed"
    rest_s: NonNegativeFloat = 0.0
    begin: Literal["of the prior", "any heading"] = "of the prior"
    prior_sigma_m: PositiveFloat = 10.0
    prior_sigma_rad: PositiveFloat = 0.1
    odometry_step_s: PositiveFloat = 0.1
    fix_step_s: PositiveFloat = 0.5
    compass_step_s: PositiveFloat = 0.2
    first_fix_s: NonNegativeFloat = 1.0
    forward_noise_density: PositiveFloat = 0.05
    turn_noise_density: PositiveFloat = 0.01
    fix_sigma_m: PositiveFloat = 0.3
    compass_sigma_rad: PositiveFloat = 0.02
    forward_factor: float = 1.0
    turn_factor: float = 1.0
    turn_error_radps: float = 0.0
    lever_x_m: float = 0.0
    lever_y_m: float = 0.0
    fix_delay_s: float = 0.0
    compass_error_rad: float = 0.0


class Truth(NamedTuple):
    """The motion of the car: speeds and turn rates (n,) in the steps, poses (n + 1, 3) at their ends."""

    step_s: float
    speed_mps: Floats
    turn_radps: Floats
    pose: Floats

    def at(self, times_s: Floats) -> Floats:
        """Interpolate poses (m, 3) exactly at any times; before the start, the car is stationary."""
        step = np.clip(times_s // self.step_s, 0, len(self.speed_mps) - 1).astype(int)
        since_s = np.maximum(times_s - step * self.step_s, 0.0)
        return self.pose[step] + arcs(
            self.pose[step, 2], self.speed_mps[step], self.turn_radps[step], since_s
        )


class Car(NamedTuple):
    """The data in a log of the car: stamps in s, SI units; the heading is anticlockwise from east.

    Attributes:
        truth: motion of the car.
        odometry_s, speed_mps, turn_radps, fix_s, fix_m, compass_s, compass_rad: measurements.
        forward_density, turn_density, fix_variance_m2, compass_sigma_rad: values that the sensors state.
        prior, prior_sigmas: mean (3,) of the first pose, and its standard deviations.
        fix_late_s, lever_m: delay of fixes, and position of the antenna.
        seed: seed for further random numbers.
    """

    truth: Truth
    odometry_s: Floats
    speed_mps: Floats
    turn_radps: Floats
    fix_s: Floats
    fix_m: Floats
    compass_s: Floats
    compass_rad: Floats
    forward_density: float
    turn_density: float
    fix_variance_m2: float
    compass_sigma_rad: float
    prior: Floats
    prior_sigmas: Floats
    fix_late_s: float = 0.0
    lever_m: tuple[float, float] = (0.0, 0.0)
    seed: int = 0


def arcs(heading_rad: Floats, speed_mps: Floats, turn_radps: Floats, duration_s: Floats) -> Floats:
    """Compute the changes of poses along exact arcs.

    Args:
        heading_rad: (n,), heading before each step.
        speed_mps: (n,), forward speed.
        turn_radps: (n,), turn rate, anticlockwise.
        duration_s: (n,), duration of each step.

    Returns:
        (n, 3), changes of x and y in m, and of the heading in rad.
    """
    turned = turn_radps * duration_s
    chord = speed_mps * duration_s * np.sinc(0.5 * turned / np.pi)
    about = heading_rad + 0.5 * turned
    return np.stack([chord * np.cos(about), chord * np.sin(about), turned], axis=-1)


def philox(key: int) -> np.random.Generator:
    """Make a Philox generator with this key."""
    return np.random.Generator(np.random.Philox(key=key))


def drive(given: CarParameters, rng: np.random.Generator | None = None) -> Car:
    """Drive the car; without a generator there is no noise, and the car begins at zero.

    Raises BadInput if the drive is shorter than a step of a sensor.
    """
    step_s, n = given.odometry_step_s, round(given.duration_s / given.odometry_step_s)
    first, last = given.first_fix_s / given.fix_step_s, round(given.duration_s / given.fix_step_s)
    fix_s = given.fix_step_s * np.arange(first, last + 1e-9)
    compass_s = given.compass_step_s * np.arange(round(given.duration_s / given.compass_step_s) + 1)
    if not n or not len(fix_s):
        raise BadInput(
            f"duration_s={given.duration_s:g}: is too short for a step of the odometry or a fix; make "
            "it longer"
        )
    sigmas = np.array([given.prior_sigma_m, given.prior_sigma_m, given.prior_sigma_rad])
    begin = np.zeros(3)
    if rng is not None and given.begin == "any heading":
        begin[2] = 2.0 * np.pi * rng.uniform()
    elif rng is not None:
        begin = rng.standard_normal(3) * sigmas
    wheels, fixes, compass = (
        np.zeros(size) if rng is None else rng.standard_normal(size)
        for size in ((n, 2), (len(fix_s), 2), len(compass_s))
    )
    since_s = (np.arange(n) + 0.5) * step_s
    speed, _ = MOTIONS[given.motion](since_s - given.rest_s)
    _, turn = MOTIONS[given.motion](since_s)
    if given.rest_s > 0.0:
        ramp = np.clip((since_s - given.rest_s) / RAMP_S, 0.0, 1.0)
        speed, turn = ramp * speed, ramp * turn
    before_rad = begin[2] + np.concatenate([[0.0], np.cumsum(turn * step_s)])
    moved = np.cumsum(arcs(before_rad[:-1], speed, turn, np.full(n, step_s)), axis=0)
    truth = Truth(step_s, speed, turn, begin + np.concatenate([np.zeros((1, 3)), moved]))
    pose = truth.at(fix_s - given.fix_delay_s)
    cosine, sine = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x_m, y_m = given.lever_x_m, given.lever_y_m
    arm = np.stack([cosine * x_m - sine * y_m, sine * x_m + cosine * y_m], axis=1)
    of_wheels = np.array([given.forward_noise_density, given.turn_noise_density])
    noise = of_wheels / step_s**0.5 * wheels
    return Car(
        truth,
        np.arange(n) * step_s,
        given.forward_factor * (speed + noise[:, 0]),
        given.turn_factor * (turn + noise[:, 1]) + given.turn_error_radps,
        fix_s,
        pose[:, :2] + arm + given.fix_sigma_m * fixes,
        compass_s,
        truth.at(compass_s)[:, 2] + given.compass_error_rad + given.compass_sigma_rad * compass,
        given.forward_noise_density,
        given.turn_noise_density,
        given.fix_sigma_m**2,
        given.compass_sigma_rad,
        begin if given.begin == "any heading" else np.zeros(3),
        sigmas,
        given.fix_delay_s,
        (given.lever_x_m, given.lever_y_m),
    )


def stamps_ns(times_s: Floats) -> NDArray[np.int64]:
    """Convert times (n,) in s to stamps in ns since zero."""
    return np.rint(1e9 * times_s).astype(np.int64)


def streams_of(
    car: Car,
    stamps: Callable[[Floats], NDArray[np.int64]] = stamps_ns,
    *,
    has_compass: bool = True,
    has_prior: bool = True,
) -> list[Stream]:
    """Make the streams of the car: wheels, fixes, and optionally the compass and the prior.

    Args:
        car: the measurements.
        stamps: function that makes stamps in ns from times (n,) in s.
        has_compass, has_prior: whether to include the compass and the prior.
    """
    half = 0.5 * car.compass_rad
    zero = np.zeros_like(half)
    wheels = make_stream(
        "/car/odometry",
        schemas.ODOMETRY,
        stamps(car.odometry_s),
        metadata={
            "forward_noise_density": repr(car.forward_density),
            "turn_noise_density": repr(car.turn_density),
        },
        forward_mps=car.speed_mps,
        turn_radps=car.turn_radps,
    )
    fixes = fix_stream("/car/fix", stamps(car.fix_s), car.fix_m, car.fix_variance_m2)
    compass = make_stream(
        "/car/heading",
        schemas.ORIENTATION,
        stamps(car.compass_s),
        metadata={"covariance_rad2": ",".join(3 * [repr(car.compass_sigma_rad**2)])},
        quaternion=np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1),
    )
    covariance = np.diag(car.prior_sigmas**2)
    prior = prior_stream("/car/prior", stamps(np.zeros(1)), POSE, car.prior, covariance)
    return [wheels, fixes, *[compass] * has_compass, *[prior] * has_prior]


def simulate(parameters: CarParameters, rng: np.random.Generator) -> Recording:
    """Simulate one run, with the truth at the ends of the odometry's steps."""
    car = drive(parameters, rng)
    at_ns = simulation_stamps_ns(parameters.odometry_step_s * np.arange(len(car.truth.pose)))
    truth = truth_stream("/car/truth", at_ns, POSE, car.truth.pose)
    return Recording([*streams_of(car, simulation_stamps_ns), truth])


CAR = Simulator(
    "a car with wheels, fixes and a compass, whose scales, lever arm and delay may be wrong",
    CarParameters,
    simulate,
)
