"""The walk of the reference sheet, section 2, as a log: RTK fixes and a hand-held unit."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from recorders.log import Stream, make_stream, schemas
from recorders.log.run import RunMetadata
from recorders.models.geodesy import into_tangent_plane
from recorders.recording import Recording
from replay.engine.sources import MemorySource, memory_source

Floats = NDArray[np.float64]

# Its rows lie 1 ms before multiples of .25 s; moved there, `every_s` gives estimates at all of them.
TO_WHOLE_NS = 10**6
# The sheet's.
SETTINGS: dict[str, float] = {
    "force_noise_density": 0.05,
    "gyro_noise_density": 0.001,
    "force_bias_density": 3e-4,
    "gyro_bias_density": 2e-6,
    "mounting_yaw_rad": 0.5 * np.pi,
    "velocity_delay_s": 0.125,
    "tilt_sigma_rad": np.radians(3.0),
    "heading_sigma_rad": np.radians(20.0),
    "gyro_bias_sigma_radps": np.radians(0.2),
}


class Walk(NamedTuple):
    """The recording: rows of the fixes in east, north, up (n, 3), and the unit's samples.

    Attributes:
        time_ns: (n,), of the rows.
        place, velocity, sigma_place, sigma_velocity: (n, 3), as printed but for the float solutions,
            whose standard deviations are 10 and 2 times what is printed.
        is_fixed: (n,) whether the ambiguities were.
        origin: latitude and longitude in deg, height in m.
        inertial: the samples.
    """

    time_ns: NDArray[np.int64]
    place: Floats
    velocity: Floats
    sigma_place: Floats
    sigma_velocity: Floats
    is_fixed: NDArray[np.bool_]
    origin: tuple[float, float, float]
    inertial: Stream

    @property
    def since_s(self) -> Floats:
        """Seconds since the first row."""
        return (self.time_ns - self.time_ns[0]) * 1e-9


def read_walk(folder: Path) -> Walk:
    """Both files; their clocks are alike."""
    rows = pd.read_csv(folder / "gnss_1730_sf.pos", comment="%", sep=r"\s+", header=None)
    stamps = pd.to_datetime(rows[0] + " " + rows[1], format="%Y/%m/%d %H:%M:%S.%f")
    geodetic = rows[[2, 3, 4]].to_numpy()
    is_fixed = rows[5].to_numpy() == 1
    latitude, longitude, height = map(float, geodetic[0])
    origin = latitude, longitude, height
    place = np.stack(into_tangent_plane(tuple(geodetic.T), origin), axis=1)
    samples = np.loadtxt(folder / "imu_1730_sf.csv", delimiter=",")
    count = len(samples)
    return Walk(
        stamps.astype("datetime64[ns]").astype("int64").to_numpy() + TO_WHOLE_NS,
        place,
        rows[[16, 15, 17]].to_numpy(),
        rows[[8, 7, 9]].to_numpy() * np.where(is_fixed, 1.0, 10.0)[:, None],
        rows[[19, 18, 20]].to_numpy() * np.where(is_fixed, 1.0, 2.0)[:, None],
        is_fixed,
        origin,
        make_stream(
            "/walk/inertial",
            schemas.INERTIAL_SAMPLE,
            np.rint(samples[:, 0] * 1e6).astype(np.int64) * 1000 + TO_WHOLE_NS,
            specific_force_mps2=9.80665 * samples[:, 1:4],
            turn_rate_radps=samples[:, 4:7],
            magnetic_field_ut=np.full((count, 3), np.nan),
        ),
    )


def log_of(walk: Walk, withheld: NDArray[np.bool_] | None = None) -> MemorySource:
    """The log without the rows that are withheld, begun .2 s after the unit's first sample."""
    begin_ns = walk.inertial.publish_time_ns[0] + 2 * 10**8
    used = (walk.time_ns >= begin_ns) & (walk.time_ns <= walk.inertial.publish_time_ns[-1])
    if withheld is not None:
        used &= ~withheld

    latitude, longitude, altitude = map(repr, walk.origin)
    origin = {
        "origin_latitude_deg": latitude,
        "origin_longitude_deg": longitude,
        "origin_altitude_m": altitude,
    }

    def rows(topic: str, schema: schemas.Schema, **columns: Floats) -> Stream:
        return make_stream(topic, schema, walk.time_ns[used], metadata=origin, **columns)

    fix = rows(
        "/walk/fix",
        schemas.POSITION_FIX,
        position_m=walk.place[used],
        covariance_m2=_diagonal(walk.sigma_place[used]),
    )
    velocity = rows(
        "/walk/velocity",
        schemas.VELOCITY_FIX,
        velocity_mps=walk.velocity[used],
        covariance_m2ps2=_diagonal(walk.sigma_velocity[used]),
    )
    run = RunMetadata(scenario="walk", parameters={}, seed=0, run=0, epoch_ns=int(walk.time_ns[0]))
    return memory_source(Recording([walk.inertial, fix, velocity]), run)


def _diagonal(sigma: Floats) -> Floats:
    """Covariances (n, 9), row-major, of standard deviations (n, 3)."""
    return (sigma[:, :, None] ** 2 * np.eye(3)).reshape(-1, 9)
