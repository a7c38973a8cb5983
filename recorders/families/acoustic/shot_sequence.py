"""Shots of a moving shooter, heard by sensors at known positions, with some wrong detections.

The velocity changes by white acceleration, and the direction of the shots by a random walk. The sound of
each shot comes from the position at which the shot was fired, and is heard when it arrives. A sensor may
miss a shot; it may mistake an echo, which comes later and from any direction, for the muzzle blast; or
it may combine the muzzle blast with the shockwave of another shot. `/shooter/reports` contains the
reports of all sensors to a fusion centre; `/sensors` contains the positions of the sensors.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.recorders.common_streams import fix_stream, stated_numbers, truth_stream
from fuselog.recorders.families.acoustic.models import (
    SHOT_COMPONENTS,
    clear_side,
    hear,
    sensor_components,
    stated_metadata,
    trajectory_from_shockwave,
)
from fuselog.recorders.families.acoustic.simulator import AcousticParameters, require_time_to_hear
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.constant_velocity import noise_moments
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

Floats = NDArray[np.float64]
Probability = Annotated[float, Field(ge=0, le=1)]

STATE = (*SHOT_COMPONENTS, "vx_mps", "vy_mps")
# Time step of the simulated and recorded path.
PATH_S = 0.1


class ShotSequenceParameters(AcousticParameters):
    """The scenario of a shot, with the motion of the shooter and the errors of the sensors.

    The shooter begins near `shooter_position_m` and aims near `trajectory_deg`.

    Attributes:
        start_sigma_m: standard deviation of the true initial position, per axis.
        start_sigma_mps: standard deviation of the true initial velocity, per axis.
        start_sigma_deg: standard deviation of the direction of the first shot.
        acceleration_density: noise of the shooter's acceleration, in m/s^2/sqrt(Hz).
        trajectory_density: random walk of the direction of shots, in rad/sqrt(s).
        echo_probability: probability that a sensor mistakes an echo for the muzzle blast.
        echo_delay_s: mean delay of an echo (exponential).
        wrong_association_probability: probability that a sensor combines the muzzle blast with the
            shockwave of another shot.
        wrong_delay_s: longest time between the muzzle blast and the shockwave with which it is wrongly
            combined.
    """

    shots: PositiveInt = 20
    sigma_position_m: PositiveFloat = 0.01
    start_sigma_m: NonNegativeFloat = 10.0
    start_sigma_mps: NonNegativeFloat = 0.5
    start_sigma_deg: NonNegativeFloat = 10.0
    acceleration_density: NonNegativeFloat = 0.05
    trajectory_density: NonNegativeFloat = 0.01
    echo_probability: Probability = 0.0
    echo_delay_s: PositiveFloat = 0.1
    wrong_association_probability: Probability = 0.0
    wrong_delay_s: PositiveFloat = 0.5


class Heard(NamedTuple):
    """All sensors' measurements of all shots, (shots, sensors); NaN for a shockwave that is not heard.

    `arrival_s` counts from the epoch; `is_heard` is false if a sensor missed the shot.
    """

    arrival_s: Floats
    muzzle_blast_rad: Floats
    shockwave_rad: Floats
    time_difference_s: Floats
    is_heard: NDArray[np.bool_]


def simulate(parameters: ShotSequenceParameters, rng: np.random.Generator) -> Recording:
    """Record one run; raise BadInput if a shot is fired before all sensors heard the previous one."""
    path_rng, noise_rng, fault_rng = rng.spawn(3)
    shots_s = parameters.interval_s * np.arange(float(parameters.shots))
    path_s = PATH_S * np.arange(round((shots_s[-1] + parameters.interval_s) / PATH_S) + 1)
    path, aims = _path(parameters, len(path_s), path_rng), _aims(parameters, path_rng)

    def state_at(times_s: Floats) -> Floats:
        """Compute the states (n, 5); the direction of aim is that of the last shot."""
        shot = np.searchsorted(shots_s, times_s, side="right") - 1
        x, y, vx, vy = (np.interp(times_s, path_s, column) for column in path.T)
        return np.stack([x, y, wrap_angle(aims[shot]), vx, vy], axis=1)

    sensors = np.array(parameters.sensor_position_m)
    heard = _heard(parameters, shots_s, state_at(shots_s), noise_rng, fault_rng)
    require_time_to_hear(parameters.interval_s, (heard.arrival_s - shots_s[:, None]).max())
    times_s = np.unique(np.concatenate([path_s, heard.arrival_s.ravel()]))
    places = np.tile(sensors.ravel(), (len(times_s), 1))
    numbers = range(1, len(sensors) + 1)
    named = [*STATE, *(name for number in numbers for name in sensor_components(number))]
    states = np.concatenate([state_at(times_s), places], axis=1)
    truth = truth_stream("/shooter/truth", simulation_stamps_ns(times_s), named, states)
    start_ns = simulation_stamps_ns(np.zeros(len(sensors)))
    surveyed = make_stream(
        "/sensors", schemas.LANDMARK, start_ns, landmark_id=np.array(numbers), position_m=sensors
    )
    streams = [truth, surveyed, _reports(parameters, heard)]
    variance_m2 = parameters.sigma_position_m**2
    for number, place in enumerate(sensors, start=1):
        streams += [
            fix_stream(f"/sensor{number}/position", start_ns[:1], place[None], variance_m2),
            _detections(parameters, number, heard),
        ]
    return Recording(streams)


def _path(parameters: ShotSequenceParameters, steps: int, rng: np.random.Generator) -> Floats:
    """Draw positions and velocities (steps, 4) every `PATH_S`."""
    place, mixed, speed = noise_moments(parameters.acceleration_density**2, PATH_S)
    noise = rng.multivariate_normal(
        np.zeros(2), [[place, mixed], [mixed, speed]], size=(steps, 2), method="eigh"
    )
    start = rng.normal(size=4) * np.repeat([parameters.start_sigma_m, parameters.start_sigma_mps], 2)
    states = np.empty((steps, 4))
    states[0] = start + np.array([*parameters.shooter_position_m, 0.0, 0.0])
    for step in range(1, steps):
        states[step] = states[step - 1] + noise[step].T.ravel()
        states[step, :2] += PATH_S * states[step - 1, 2:]
    return states


def _aims(parameters: ShotSequenceParameters, rng: np.random.Generator) -> Floats:
    """Draw the unwrapped directions of the bullets (shots,)."""
    sigma = np.full(parameters.shots, parameters.trajectory_density * np.sqrt(parameters.interval_s))
    sigma[0] = np.radians(parameters.start_sigma_deg)
    changes = sigma * rng.normal(size=parameters.shots)
    return np.radians(parameters.trajectory_deg) + np.cumsum(changes)


def _heard(
    parameters: ShotSequenceParameters,
    shots_s: Floats,
    fired: Floats,
    noise_rng: np.random.Generator,
    fault_rng: np.random.Generator,
) -> Heard:
    """Simulate the sensors' measurements of shots fired in these states (shots, 5)."""
    sensors = np.array(parameters.sensor_position_m).T[:, None]
    x, y, trajectory = fired.T[:3, :, None]
    noise, medium = parameters.noise, parameters.medium
    with np.errstate(invalid="ignore"):
        true = np.stack(hear((x, y), trajectory, sensors, medium))
    shape = true.shape[1:]
    sigma = np.array(noise[:3])[:, None, None]
    blast, shockwave, delay = true + sigma * noise_rng.normal(size=true.shape)
    distance = np.hypot(x - sensors[0], y - sensors[1])
    arrival_s = shots_s[:, None] + distance / medium.speed_of_sound_mps

    chances = fault_rng.uniform(size=(3, *shape))
    anywhere = fault_rng.uniform(-np.pi, np.pi, size=(2, *shape))
    later_s = fault_rng.exponential(parameters.echo_delay_s, shape)
    is_echo = chances[0] < parameters.echo_probability
    blast = np.where(is_echo, anywhere[0], blast)
    delay = np.where(is_echo, delay + later_s, delay)
    arrival_s = np.where(is_echo, arrival_s + later_s, arrival_s)
    is_wrong = chances[1] < parameters.wrong_association_probability
    shockwave = np.where(is_wrong, anywhere[1], shockwave)
    delay = np.where(is_wrong, fault_rng.uniform(0.0, parameters.wrong_delay_s, shape), delay)
    is_heard = chances[2] >= parameters.dropout_probability
    return Heard(arrival_s, wrap_angle(blast), wrap_angle(shockwave), delay, is_heard)


def _reports(parameters: ShotSequenceParameters, heard: Heard) -> Stream:
    """Make the reports of all sensors, in order of arrival."""
    noise, medium = parameters.noise, parameters.medium
    shot, sensor = np.nonzero(heard.is_heard)
    order = np.argsort(heard.arrival_s[shot, sensor], kind="stable")
    chosen = shot[order], sensor[order]
    blast, shockwave = heard.muzzle_blast_rad[chosen], heard.shockwave_rad[chosen]
    side, lead = clear_side(blast, shockwave, noise), heard.time_difference_s[chosen]
    trajectory = trajectory_from_shockwave(shockwave, side, medium)
    motion = stated_numbers(parameters, "acceleration_density", "trajectory_density")
    return make_stream(
        "/shooter/reports",
        schemas.SHOT_REPORT,
        simulation_stamps_ns(heard.arrival_s[chosen]),
        metadata=stated_metadata(noise, medium) | motion,
        sensor_id=chosen[1] + 1,
        muzzle_blast_azimuth_rad=blast,
        trajectory_rad=np.where(side == 0.0, np.nan, trajectory),
        left_lead_s=np.where(side > 0.0, lead, np.nan),
        right_lead_s=np.where(side < 0.0, lead, np.nan),
    )


def _detections(parameters: ShotSequenceParameters, number: int, heard: Heard) -> Stream:
    """Make one sensor's detections, one message per shot that it does not miss."""
    shots = np.flatnonzero(heard.is_heard[:, number - 1])
    of_sensor = shots, number - 1
    return make_stream(
        f"/sensor{number}/detections",
        schemas.SHOT_DETECTION,
        simulation_stamps_ns(heard.arrival_s[of_sensor]),
        metadata=stated_metadata(parameters.noise, parameters.medium),
        shot_id=shots + 1,
        muzzle_blast_azimuth_rad=heard.muzzle_blast_rad[of_sensor],
        shockwave_azimuth_rad=heard.shockwave_rad[of_sensor],
        time_difference_s=heard.time_difference_s[of_sensor],
    )


SHOT_SEQUENCE = Simulator(
    "shots of one moving shooter heard by acoustic sensors, with echoes and wrong associations",
    ShotSequenceParameters,
    simulate,
)
