"""Car D of the sheet of sensors, section 3: wheels, a gyroscope and fixes, without a prior."""

import numpy as np

import fuselog as fl
from recorders.log import RunMetadata

STEP_S = 0.1
DENSITIES = {"forward_noise_density": "0.05", "turn_noise_density": "0.01"}


def car(seed: int, stated: float = 1.0) -> fl.MemorySource:
    """A drive of 100 s after 10 s at rest; the fixes state so many times their variance of 0.25 m2."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    heading = 2.0 * np.pi * rng.uniform()
    odometry, fixes = rng.standard_normal((1000, 2)), rng.standard_normal((201, 2))
    times_s = (np.arange(1000) + 0.5) * STEP_S
    ramp = np.clip((times_s - 10.0) / 5.0, 0.0, 1.0)
    speed = ramp * (8.0 + 3.0 * np.sin(0.4 * (times_s - 10.0)))
    turn = ramp * (0.25 * np.sin(0.21 * times_s) + 0.15 * np.sin(0.53 * times_s))
    before = heading + np.concatenate([[0.0], np.cumsum(turn * STEP_S)])
    chord = speed * STEP_S * np.sinc(0.5 * turn * STEP_S / np.pi)
    about = before[:-1] + 0.5 * turn * STEP_S
    steps = chord[:, None] * np.stack([np.cos(about), np.sin(about)], axis=1)
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])[::5] + 0.5 * fixes
    noise = np.array([0.05, 0.01]) / STEP_S**0.5 * odometry
    wheels = fl.make_stream(
        "/car/odometry",
        fl.schemas.ODOMETRY,
        np.arange(1000) * 100_000_000,
        metadata=DENSITIES,
        forward_mps=speed + noise[:, 0],
        turn_radps=turn + noise[:, 1],
    )
    seen = fl.make_stream(
        "/car/fix",
        fl.schemas.POSITION_FIX,
        np.arange(201) * 500_000_000,
        position_m=place,
        covariance_m2=np.tile(stated * np.array([0.25, 0.0, 0.0, 0.25]), (201, 1)),
    )
    streams = {"/car/odometry": wheels, "/car/fix": seen}
    return fl.MemorySource(streams, RunMetadata("car", epoch_ns=0), "car")
