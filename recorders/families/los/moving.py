"""Simulates optical sensors on aircraft: each has its own clock, and is turned by biases that drift.

Sensors fly at known poses, straight or weaving, and see the targets in turn, each at times of its own.
The frame is that of `fuselog.recorders.families.los.models`: y points up, and a sensor looks ahead,
along its own z. All white noise that drives targets and biases is continuous, so that they are exact at
any time.
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

FIRST_S = 0.5  # before the first sighting, and so before any clock that is off


class MovingOpticalParameters(Parameters):
    """Sensors on aircraft see targets; their attitudes and clocks err.

    Attributes:
        duration_s: length of the run.
        sensor_position_m: where the sensors start (x, y, z).
        velocity_mps: mean velocity of all sensors (x, y, z).
        weave_m: by how much each sensor weaves to both sides; it turns with its course.
        weave_period_s: time of one weave.
        target_position_m: where the targets are expected to start (x, y, z).
        target_velocity_mps: velocities of the targets that are expected at the start (x, y, z).
        prior_sigma_m: standard deviation of a target's position in the prior, per axis.
        prior_sigma_mps: standard deviation of a target's velocity in the prior, per axis.
        acceleration_density: noise of a target's acceleration, in m/s^2/sqrt(Hz).
        sightings_hz: how many times a second every sensor sees a target, one after the other.
        sigma_rad: standard deviation of azimuth and elevation.
        bias_sigma_rad: standard deviation of the true biases of attitude, per axis.
        bias_drift: random walk of these biases, in rad/sqrt(s).
        clock_sigma_s: standard deviation of the true offset of every sensor's clock but the first's.
        known_sigma_m: the first target reports its position once a second with this standard deviation
            per axis; without one it does not.
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
    """Holds the truth at some times (n,): targets (n, targets, 6) and biases (n, sensors, 3)."""

    times_s: Floats
    targets: Floats
    bias_rad: Floats

    def rows(self, times_s: Floats) -> NDArray[np.int64]:
        """Return the rows of times that are among its own."""
        return np.searchsorted(self.times_s, times_s)


def simulate(parameters: MovingOpticalParameters, rng: np.random.Generator) -> Recording:
    """Record one run; raises BadInput where there is not one weave for each sensor."""
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
    """Draw targets under white accelerations and biases that walk at random, from the start on."""
    steps_s = np.diff(times_s)
    place, mixed, speed = noise_moments(parameters.acceleration_density**2, steps_s)
    roots = np.zeros((len(steps_s), 2, 2))  # of a place and its velocity: root root' is their covariance
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
    """Make the stream of targets, biases and clocks."""
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
    """Simulate where the first target says that it is: a topic without messages where it does not."""
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
    """Compute places (n, 3) of a sensor, and how it is turned: ahead along its course."""
    velocity, turn_radps = np.array(parameters.velocity_mps), 2.0 * np.pi / parameters.weave_period_s
    aside = np.cross([0.0, 1.0, 0.0], velocity / np.linalg.norm(velocity))
    phase = turn_radps * times_s[:, None]
    weave_m = parameters.weave_m[number]
    places = parameters.sensor_position_m[number] + velocity * times_s[:, None]
    course = velocity + weave_m * turn_radps * np.cos(phase) * aside
    heading = np.arctan2(course[:, 0], course[:, 2])
    return places + weave_m * np.sin(phase) * aside, Rotation.from_euler("y", heading[:, None])


MOVING_LOS = Simulator(
    "optical sensors on aircraft, with clocks and attitudes that are off, see moving targets",
    MovingOpticalParameters,
    simulate,
)
