"""Optical sensors on aircraft, with clock offsets and drifting attitude biases.

Sensors fly straight or weave, with known poses. They see the targets in turn, each sensor at its own
times. The frame is that of `fuselog.recorders.families.los.models`: y points up, and a sensor looks
ahead, along its own z. The white noise that drives targets and biases is continuous, so the simulated
values are exact at any time.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat
from scipy.spatial.transform import Rotation

from fuselog.recorders.common_streams import fix_stream, prior_stream, stated_numbers, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.los.models import (
    SENSORS,
    TARGETS,
    azimuth_elevation,
    bias_components,
    clock_component,
    moving_target_components,
    rotate,
)
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.constant_velocity import noise_moments
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]
Sensors = Annotated[list[Triple], Field(min_length=2, max_length=SENSORS)]
Targets = Annotated[list[Triple], Field(min_length=TARGETS, max_length=TARGETS)]

FIRST_S = 0.5  # time before the first sighting, longer than any clock offset


class MovingOpticalParameters(Parameters):
    """Sensors on aircraft with attitude and clock errors, and the targets that they see.

    Attributes:
        duration_s: length of the run.
        sensor_position_m: initial positions of the sensors (x, y, z).
        velocity_mps: mean velocity of all sensors (x, y, z).
        weave_m: amplitude of each sensor's weaving; the sensor turns with its course.
        weave_period_s: period of the weaving.
        target_position_m: expected initial positions of the targets (x, y, z).
        target_velocity_mps: expected initial velocities of the targets (x, y, z).
        prior_sigma_m: standard deviation of a target's position in the prior, per axis.
        prior_sigma_mps: standard deviation of a target's velocity in the prior, per axis.
        acceleration_density: noise of a target's acceleration, in m/s^2/sqrt(Hz).
        sightings_hz: sightings per second of each sensor, which looks at one target after the other.
        sigma_rad: standard deviation of azimuth and elevation.
        bias_sigma_rad: standard deviation of the true attitude biases, per axis.
        bias_drift: random walk of the attitude biases, in rad/sqrt(s).
        clock_sigma_s: standard deviation of the true clock offset of every sensor except the first.
        known_sigma_m: standard deviation per axis of the position that the first target reports once a
            second; if not set, it does not report.
    """

    duration_s: Annotated[float, Field(gt=1)] = 60.0
    sensor_position_m: Sensors = [(-10e3, 5e3, 0.0), (0.0, 5e3, 0.0), (10e3, 5e3, 0.0)]
    velocity_mps: Triple = (0.0, 0.0, 150.0)
    weave_m: list[NonNegativeFloat] = [0.0, 0.0, 0.0]
    weave_period_s: PositiveFloat = 40.0
    target_position_m: Targets = [(-8e3, 9e3, 40e3), (6e3, 3e3, 45e3)]
    target_velocity_mps: Targets = [(80.0, 0.0, -120.0), (-100.0, 5.0, -60.0)]
    prior_sigma_m: PositiveFloat = 500.0
    prior_sigma_mps: PositiveFloat = 20.0
    acceleration_density: NonNegativeFloat = 0.5
    sightings_hz: PositiveFloat = 2.0
    sigma_rad: PositiveFloat = 0.3e-3
    bias_sigma_rad: NonNegativeFloat = 5e-3
    bias_drift: NonNegativeFloat = 2e-5
    clock_sigma_s: NonNegativeFloat = 0.1
    known_sigma_m: PositiveFloat | None = None


class Course(NamedTuple):
    """The truth at times (n,): targets (n, targets, 6) and biases (n, sensors, 3)."""

    times_s: Floats
    targets: Floats
    bias_rad: Floats

    def rows(self, times_s: Floats) -> NDArray[np.int64]:
        """Return the indices of the rows at the given times."""
        return np.searchsorted(self.times_s, times_s)


def simulate(parameters: MovingOpticalParameters, rng: np.random.Generator) -> Recording:
    """Record one run; raise BadInput unless there is one weave amplitude per sensor."""
    sensors = len(parameters.sensor_position_m)
    if len(parameters.weave_m) != sensors:
        raise BadInput(
            f"weave_m has {len(parameters.weave_m)} numbers for {sensors} sensors; give one for each"
        )
    start_rng, course_rng, schedule_rng, noise_rng = rng.spawn(4)
    period_s = 1.0 / parameters.sightings_hz
    phases_s = FIRST_S + period_s * schedule_rng.uniform(size=sensors)
    seen_s = [np.arange(phase_s, parameters.duration_s, period_s) for phase_s in phases_s]
    truth_s = 0.1 * np.arange(int(10.0 * (parameters.duration_s + 1.0)) + 1, dtype=float)
    mean = np.concatenate([parameters.target_position_m, parameters.target_velocity_mps], axis=1)
    sigma = np.repeat([parameters.prior_sigma_m, parameters.prior_sigma_mps], 3)
    clocks_s = parameters.clock_sigma_s * start_rng.normal(size=sensors)
    clocks_s[0] = 0.0
    course = _course(
        parameters,
        np.unique(np.concatenate([truth_s, *seen_s])),
        mean + sigma * start_rng.normal(size=mean.shape),
        parameters.bias_sigma_rad * start_rng.normal(size=(sensors, 3)),
        course_rng,
    )
    start_ns, covariance = simulation_stamps_ns(0.0), np.diag(np.tile(sigma, TARGETS) ** 2)
    prior = prior_stream("/prior", start_ns, _target_names(), mean, covariance)
    streams = [prior, _truth(course, truth_s, clocks_s)]
    streams.append(_fixes(course, truth_s[10:-10:10], parameters.known_sigma_m, noise_rng))
    for number, times_s in enumerate(seen_s):
        streams.append(_sightings(parameters, number, times_s, clocks_s[number], course, noise_rng))
    return Recording(streams)


def _course(
    parameters: MovingOpticalParameters,
    times_s: Floats,
    targets: Floats,
    bias_rad: Floats,
    rng: np.random.Generator,
) -> Course:
    """Draw targets with white accelerations and biases with random walks, from given initial values."""
    steps_s = np.diff(times_s)
    place, mixed, speed = noise_moments(parameters.acceleration_density**2, steps_s)
    roots = np.zeros((len(steps_s), 2, 2))  # root root' is the covariance of a position and its velocity
    roots[:, 1, 1] = np.sqrt(speed)
    with np.errstate(invalid="ignore"):
        roots[:, 0, 1] = np.nan_to_num(mixed / np.sqrt(speed))
    roots[:, 0, 0] = np.sqrt(place - roots[:, 0, 1] ** 2)
    pushed = np.einsum("sij,staj->stai", roots, rng.normal(size=(len(steps_s), TARGETS, 3, 2)))
    states = np.empty((len(times_s), *targets.shape))
    states[0] = targets
    for step, duration_s in enumerate(steps_s):
        states[step + 1] = states[step]
        states[step + 1, :, :3] += duration_s * states[step, :, 3:] + pushed[step, ..., 0]
        states[step + 1, :, 3:] += pushed[step, ..., 1]
    walked = rng.normal(size=(len(steps_s), *bias_rad.shape)) * np.sqrt(steps_s)[:, None, None]
    walks = np.concatenate([np.zeros((1, *bias_rad.shape)), np.cumsum(walked, axis=0)])
    return Course(times_s, states, bias_rad + parameters.bias_drift * walks)


def _target_names() -> list[str]:
    return [name for target in range(1, TARGETS + 1) for name in moving_target_components(target)]


def _truth(course: Course, times_s: Floats, clocks_s: Floats) -> Stream:
    """Make the stream of true targets, biases and clock offsets."""
    rows, sensors = course.rows(times_s), len(clocks_s)
    names = [
        *_target_names(),
        *(name for number in range(1, sensors + 1) for name in bias_components(number)),
        *(clock_component(number) for number in range(1, sensors + 1)),
    ]
    targets, bias_rad = course.targets[rows], course.bias_rad[rows]
    count = len(rows)
    clocks = np.tile(clocks_s, (count, 1))
    state = np.concatenate([targets.reshape(count, -1), bias_rad.reshape(count, -1), clocks], axis=1)
    return truth_stream("/truth", simulation_stamps_ns(times_s), names, state)


def _fixes(course: Course, times_s: Floats, sigma_m: float | None, rng: np.random.Generator) -> Stream:
    """Simulate the first target's reported positions; the topic is empty if it does not report."""
    rows, known_m = (course.rows(times_s), sigma_m) if sigma_m else (np.empty(0, np.int64), 1.0)
    measured = course.targets[rows, 0, :3] + known_m * rng.normal(size=(len(rows), 3))
    return fix_stream("/target1/fix", simulation_stamps_ns(course.times_s[rows]), measured, known_m**2)


def _sightings(
    parameters: MovingOpticalParameters,
    number: int,
    times_s: Floats,
    clock_s: float,
    course: Course,
    rng: np.random.Generator,
) -> Stream:
    """Simulate one sensor's lines of sight with its poses, stamped by its own clock."""
    places, to_world = _poses(parameters, number, times_s)
    rows, seen = course.rows(times_s), np.arange(len(times_s)) % TARGETS
    offset = course.targets[rows, seen, :3] - places
    ahead = to_world.inv().apply(offset)
    angles = np.stack(azimuth_elevation(rotate(course.bias_rad[rows, number].T, ahead.T)), axis=1)
    measured = wrap_angle(angles + parameters.sigma_rad * rng.normal(size=angles.shape))
    stated = stated_numbers(parameters, "acceleration_density")
    stated |= {f"sigma_{angle}_rad": repr(parameters.sigma_rad) for angle in ("azimuth", "elevation")}
    return make_stream(
        f"/sensor{number + 1}/moving_line_of_sight",
        schemas.MOVING_LINE_OF_SIGHT,
        simulation_stamps_ns(times_s + clock_s),
        metadata=stated,
        target_id=seen + 1,
        azimuth_rad=measured[:, 0],
        elevation_rad=measured[:, 1],
        position_m=places,
        quaternion=to_world.as_quat(scalar_first=True),
    )


def _poses(parameters: MovingOpticalParameters, number: int, times_s: Floats) -> tuple[Floats, Rotation]:
    """Compute the positions (n, 3) of a sensor, and its attitude along its course."""
    velocity, turn_radps = np.array(parameters.velocity_mps), 2.0 * np.pi / parameters.weave_period_s
    aside = np.cross([0.0, 1.0, 0.0], velocity / np.linalg.norm(velocity))
    phase = turn_radps * times_s[:, None]
    weave_m = parameters.weave_m[number]
    places = parameters.sensor_position_m[number] + velocity * times_s[:, None]
    course = velocity + weave_m * turn_radps * np.cos(phase) * aside
    heading = np.arctan2(course[:, 0], course[:, 2])
    return places + weave_m * np.sin(phase) * aside, Rotation.from_euler("y", heading[:, None])


MOVING_LOS = Simulator(
    "moving targets seen by optical sensors on aircraft with clock and attitude errors",
    MovingOpticalParameters,
    simulate,
)
