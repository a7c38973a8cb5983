"""Shots heard by acoustic sensors with position fixes: detections, fixes, truth.

Osborne, Bar-Shalom, George and Kaplan, JAIF 2014. Each sensor detects each shot when its muzzle blast
arrives. The shockwave, and the time by which it precedes the muzzle blast, are measured only if the
geometry allows it.
"""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat, PositiveInt

from fuselog.recorders.common_streams import fix_stream, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.acoustic.models import (
    SHOT_COMPONENTS,
    Medium,
    Noise,
    hear,
    sensor_components,
    stated_metadata,
)
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

Array = NDArray[np.float64]
Place = tuple[float, float]


class AcousticParameters(Parameters):
    """A shot through the air and the sensors that hear it.

    Attributes:
        shooter_position_m: position of the shooter (x, y).
        trajectory_deg: direction of the shot, anticlockwise from the x axis.
        sensor_position_m: positions of the sensors (x, y).
        mach_number: Mach number of the bullet.
        speed_of_sound_mps: speed of sound in the air.
        sigma_muzzle_blast_deg: standard deviation of the direction of arrival of the muzzle blast.
        sigma_shockwave_deg: standard deviation of the direction of arrival of the shockwave.
        sigma_time_difference_s: standard deviation of the time between shockwave and muzzle blast.
        sigma_position_m: standard deviation of a sensor's own position, per axis.
        shots: number of shots.
        interval_s: time between shots.
        dropout_probability: probability that a sensor's detection of a shot is lost.
    """

    shooter_position_m: Place = (50, 50)
    trajectory_deg: float = 30.0
    sensor_position_m: Annotated[list[Place], Field(min_length=1)] = [
        (127, 107),
        (20, 22),
        (90, 0),
        (136, 68),
        (182, 59),
    ]
    mach_number: Annotated[float, Field(gt=1)] = 2.0
    speed_of_sound_mps: PositiveFloat = 342.0
    sigma_muzzle_blast_deg: PositiveFloat = 4.0
    sigma_shockwave_deg: PositiveFloat = 4.0
    sigma_time_difference_s: PositiveFloat = 1e-3
    sigma_position_m: PositiveFloat = 2.0
    shots: PositiveInt = 1
    interval_s: PositiveFloat = 5.0
    dropout_probability: Annotated[float, Field(ge=0, lt=1)] = 0.0

    @property
    def medium(self) -> Medium:
        """Return the speeds of sound and bullet."""
        return Medium(self.speed_of_sound_mps, self.mach_number)

    @property
    def noise(self) -> Noise:
        """Return the noise of the sensors, with angles in rad."""
        return Noise(
            float(np.radians(self.sigma_muzzle_blast_deg)),
            float(np.radians(self.sigma_shockwave_deg)),
            self.sigma_time_difference_s,
            self.sigma_position_m,
        )


def simulate(parameters: AcousticParameters, rng: np.random.Generator) -> Recording:
    """Record one run; raise BadInput if a shot is fired before all sensors heard the previous one."""
    shooter = np.array(parameters.shooter_position_m)
    sensors = np.array(parameters.sensor_position_m)
    travel_s = np.linalg.norm(sensors - shooter, axis=1) / parameters.speed_of_sound_mps
    require_time_to_hear(parameters.interval_s, travel_s.max())
    shots_s = parameters.interval_s * np.arange(float(parameters.shots))
    streams = [_truth(parameters, shots_s, travel_s)]
    for number, (place, delay_s) in enumerate(zip(sensors, travel_s, strict=True), start=1):
        streams += [
            _fixes(parameters, number, place, shots_s, rng),
            _detections(parameters, number, place, shots_s + delay_s, rng),
        ]
    return Recording(streams)


def require_time_to_hear(interval_s: float, longest_s: float) -> None:
    """Raise BadInput if the sound of a shot travels longer than the interval between shots."""
    if longest_s >= interval_s:
        raise BadInput(
            f"interval_s = {interval_s}: the sound travels {longest_s:.3g} s to the "
            "farthest sensor; give a longer interval_s"
        )


def _truth(parameters: AcousticParameters, shots_s: Array, travel_s: Array) -> Stream:
    """Make the true states of shot and sensors, for the times at which shots are fired and heard."""
    places = np.ravel(parameters.sensor_position_m)
    numbers = range(1, len(travel_s) + 1)
    components = [*SHOT_COMPONENTS, *(name for s in numbers for name in sensor_components(s))]
    shot = [*parameters.shooter_position_m, wrap_angle(np.radians(parameters.trajectory_deg))]
    times_ns = np.unique(simulation_stamps_ns(shots_s[:, None] + np.append(0.0, travel_s)))
    state = np.tile(np.concatenate([shot, places]), (len(times_ns), 1))
    return truth_stream("/shooter/truth", times_ns, components, state)


def _fixes(
    parameters: AcousticParameters,
    number: int,
    place: Array,
    shots_s: Array,
    rng: np.random.Generator,
) -> Stream:
    """Make a sensor's measured positions, one message per shot."""
    sigma = parameters.sigma_position_m
    measured = place + sigma * rng.normal(size=(len(shots_s), 2))
    return fix_stream(f"/sensor{number}/position", simulation_stamps_ns(shots_s), measured, sigma**2)


def _detections(
    parameters: AcousticParameters,
    number: int,
    place: Array,
    heard_s: Array,
    rng: np.random.Generator,
) -> Stream:
    """Simulate a sensor's detections, one message per shot that it does not miss."""
    shots = len(heard_s)
    trajectory = np.radians(parameters.trajectory_deg)
    noise, medium = parameters.noise, parameters.medium
    with np.errstate(invalid="ignore"):
        true = np.stack(hear(parameters.shooter_position_m, trajectory, place, medium))
    measured = true + np.array(noise[:3]) * rng.normal(size=(shots, 3))
    heard = rng.uniform(size=shots) >= parameters.dropout_probability
    return make_stream(
        f"/sensor{number}/detections",
        schemas.SHOT_DETECTION,
        simulation_stamps_ns(heard_s[heard]),
        metadata=stated_metadata(noise, medium),
        shot_id=np.flatnonzero(heard) + 1,
        muzzle_blast_azimuth_rad=wrap_angle(measured[heard, 0]),
        shockwave_azimuth_rad=wrap_angle(measured[heard, 1]),
        time_difference_s=measured[heard, 2],
    )


ACOUSTIC_SHOTS = Simulator(
    "a supersonic shot heard by acoustic sensors: muzzle blast, shockwave, time between them, GPS",
    AcousticParameters,
    simulate,
)
