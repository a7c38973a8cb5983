"""The paths of a quadrotor of the reference sheet, section 3, as logs: one of its units, and fixes."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recorders.log import make_stream, schemas
from recorders.log.run import RunMetadata
from recorders.models.states import NAVIGATION, state_metadata
from recorders.recording import Recording
from replay.engine.sources import MemorySource, memory_source

Floats = NDArray[np.float64]

EPOCH_NS = 10**12
# The sheet's; at this latitude gravity is its 9.7955 m/s2.
SETTINGS: dict[str, float] = {
    "force_noise_density": 0.12,
    "gyro_noise_density": 0.002,
    "force_bias_density": 0.02,
    "gyro_bias_density": 1e-4,
    "origin_latitude_deg": 32.805,
    "origin_altitude_m": 0.0,
    "gate_probability": 1.0,
    "every_s": 0.1,
}


class Flight(NamedTuple):
    """What is true: times (n,), position and velocity (n, 3) in east, north, up, and orientation."""

    time_ns: NDArray[np.int64]
    place: Floats
    velocity: Floats
    orientation: Rotation


def read_flight(folder: Path) -> Flight:
    """The truth of a path, 10 Hz; angles are of the compass, nose up, right side down."""
    rows = np.loadtxt(folder / "GT.csv", delimiter=",", skiprows=1)
    times_s = np.round(rows[:, 0], 3)
    place = rows[:, [8, 7, 9]] * [1.0, 1.0, -1.0]
    angles = np.stack([90.0 - rows[:, 3], -rows[:, 4], rows[:, 5]], axis=1)
    return Flight(
        EPOCH_NS + np.rint(1e9 * times_s).astype(np.int64),
        place,
        np.gradient(place, times_s, axis=0),
        Rotation.from_euler("ZYX", angles, degrees=True),
    )


def log_of(folder: Path, flight: Flight, seed: int, offset_s: float) -> MemorySource:
    """Its first unit, with fixes once a second that err by .5 m, where the moved samples cover them.

    `offset_s` is what is to be added to the unit's stamps; here they stay as they are.
    """
    samples = np.loadtxt(folder / "IMU_1.csv", delimiter=",", skiprows=1)
    unit_ns = EPOCH_NS + np.rint(1e9 * samples[:, 0]).astype(np.int64)
    chosen = np.arange(0, len(flight.place), 10)
    error = 0.5 * np.random.default_rng(seed).normal(size=(len(chosen), 3))
    fix_ns, fixes = flight.time_ns[chosen], flight.place[chosen] + error
    moved_ns = unit_ns[[0, -1]] + round(1e9 * offset_s)
    used = (fix_ns >= moved_ns[0]) & (fix_ns <= moved_ns[1])
    fix_ns, fixes = fix_ns[used], fixes[used]
    orientation = flight.orientation[0].as_quat(scalar_first=True)
    mean = np.concatenate([fixes[0], flight.velocity[0], orientation, np.zeros(6)])
    degrees = np.radians([10.0, 10.0, 5.0, 2.0, 2.0, 2.0])
    sigma = np.concatenate([[0.5] * 3, [1.0] * 3, degrees, [0.5] * 3])
    run = RunMetadata(scenario="quadrotor", parameters={}, seed=seed, run=0, epoch_ns=EPOCH_NS)
    streams = [
        make_stream(
            "/body/prior",
            schemas.GAUSSIAN_ESTIMATE,
            fix_ns[:1],
            metadata=state_metadata(NAVIGATION),
            mean=mean[None],
            covariance=np.diag(sigma**2).reshape(1, -1),
        ),
        make_stream(
            "/body/inertial",
            schemas.INERTIAL_SAMPLE,
            unit_ns,
            specific_force_mps2=samples[:, 4:7],
            turn_rate_radps=np.radians(samples[:, 7:10]),
            magnetic_field_ut=np.full((len(samples), 3), np.nan),
        ),
        make_stream(
            "/body/fix",
            schemas.POSITION_FIX,
            fix_ns,
            position_m=fixes,
            covariance_m2=np.tile(0.25 * np.eye(3).reshape(9), (len(fixes), 1)),
        ),
    ]
    return memory_source(Recording(streams), run)
