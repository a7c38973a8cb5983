"""The reference sheet's robot of tuning: noisy odometry, range and bearing of four landmarks in turn."""

import numpy as np

from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.models.planar import drive, wrap_angle
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

EPOCH_NS = 10**9
STEP_S = 0.1
POSE = {"components": "x_m,y_m,heading_rad", "kinds": "linear,linear,angle"}
LANDMARKS = np.array([[8.0, 8.0], [-8.0, 8.0], [-8.0, -8.0], [8.0, -8.0]])
MEAN, VARIANCES = np.array([0.0, -4.0, 0.0]), np.array([0.01, 0.01, 0.001])
SIGMA_ODOMETRY, SIGMA_SIGHT = np.array([0.1, 0.05]), np.array([0.2, 0.03])
DENSITY = np.sqrt(STEP_S)  # of a velocity's noise, whose standard deviation over a step is one
FREE = ("forward_noise_density", "turn_noise_density", "sigma_range_m", "sigma_bearing_rad")


def of_sigmas(*sigmas: float) -> dict[str, float]:
    """The robot's parameters for standard deviations of v, w, range and bearing."""
    return dict(zip(FREE, np.array(sigmas) * [DENSITY, DENSITY, 1.0, 1.0], strict=True))


def recorded(seed: int, duration_s: float) -> MemorySource:
    """A run: odometry every step, a sighting every fifth."""
    rng = np.random.default_rng(seed)
    pose = MEAN + np.sqrt(VARIANCES) * rng.standard_normal(3)
    odometry, sights, numbers, steps = [], [], [], []
    for step in range(round(duration_s / STEP_S)):
        time_s = STEP_S * step
        velocity = np.array([1.0 + 0.5 * np.sin(0.3 * time_s), 0.25 + 0.2 * np.sin(0.37 * time_s)])
        odometry.append(velocity + SIGMA_ODOMETRY * rng.standard_normal(2))
        pose = np.array(drive(pose, velocity, STEP_S))
        if step % 5 == 4:
            number = step // 5 % 4
            x, y = LANDMARKS[number] - pose[:2]
            sight = np.array([np.hypot(x, y), np.arctan2(y, x) - pose[2]])
            sight += SIGMA_SIGHT * rng.standard_normal(2)
            sights.append([sight[0], wrap_angle(sight[1])])
            numbers.append(number + 1)
            steps.append(step + 1)
    velocities, seen = np.array(odometry), np.array(sights)
    step_ns = round(STEP_S * 1e9)
    streams = [
        make_stream(
            "/landmarks",
            schemas.LANDMARK,
            [EPOCH_NS] * 4,
            landmark_id=range(1, 5),
            position_m=LANDMARKS,
        ),
        make_stream(
            "/robot/prior",
            schemas.GAUSSIAN_ESTIMATE,
            [EPOCH_NS],
            metadata=POSE,
            mean=MEAN[None],
            covariance=np.diag(VARIANCES).reshape(1, 9),
        ),
        make_stream(
            "/robot/odometry",
            schemas.ODOMETRY,
            EPOCH_NS + step_ns * np.arange(len(velocities)),
            forward_mps=velocities[:, 0],
            turn_radps=velocities[:, 1],
        ),
        make_stream(
            "/robot/range_bearing",
            schemas.RANGE_BEARING,
            EPOCH_NS + step_ns * np.array(steps),
            target_id=numbers,
            range_m=seen[:, 0],
            bearing_rad=seen[:, 1],
        ),
    ]
    return memory_source(Recording(streams), RunMetadata("robot", epoch_ns=EPOCH_NS, seed=seed))
