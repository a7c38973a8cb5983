"""The reference sheet's problem of section 5: attitude and a gyro's bias from three sensors."""

from functools import cache
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.models.orientation import compose, conjugate, rotate
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.model.model import Control, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters

Floats = NDArray[np.float64]
STATE = {f"orientation_{part}": "quaternion" for part in "wxyz"} | {
    f"gyro_bias_{axis}_radps": "linear" for axis in "xyz"
}
EPOCH_NS = 10**9
STEP_S = 0.02


class AttitudeParameters(ModelParameters):
    """Noise of the gyro and its bias, and of the two vectors that are measured."""

    gyro_density: float = 0.01
    bias_density: float = 0.001
    sigma_force: float = 0.3
    sigma_field: float = 0.05


def product(p: Any, q: Any) -> Any:
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    """Q exp((g - b) dt): cos and sinc of the half angle as functions that are smooth at zero."""
    x = 0.5 * duration_s * (control[0] - state[4])
    y = 0.5 * duration_s * (control[1] - state[5])
    z = 0.5 * duration_s * (control[2] - state[6])
    half = np.sqrt(x * x + y * y + z * z)
    ratio = np.sinc(half / np.pi)
    turned = product(state, (np.cos(half), ratio * x, ratio * y, ratio * z))
    return (turned[0], turned[1], turned[2], turned[3], state[4], state[5], state[6])


def noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    gyro, bias = parameters.gyro_density**2 * duration_s, parameters.bias_density**2 * duration_s
    return gyro, gyro, gyro, bias, bias, bias


def seen(state: Any, vector: Any) -> Any:
    """R(q)'v."""
    w, x, y, z = state[0], state[1], state[2], state[3]
    a, b, c = vector
    return (
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c,
        2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c,
        2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )


def feel(state: Any, reference: Any, parameters: Any) -> Any:
    return seen(state, (0.0, 0.0, 9.81))


def point(state: Any, reference: Any, parameters: Any) -> Any:
    return seen(state, (0.5, 0.0, -0.4))


def feel_noise(parameters: Any) -> Any:
    return parameters.sigma_force**2, parameters.sigma_force**2, parameters.sigma_force**2


def point_noise(parameters: Any) -> Any:
    return parameters.sigma_field**2, parameters.sigma_field**2, parameters.sigma_field**2


def _vector(topic: str, names: str, measure: Any, variance: Any) -> Sensor:
    return Sensor(
        topic,
        schemas.VECTOR_MEASUREMENT,
        {f"{names}_{axis}": "linear" for axis in "xyz"},
        measure,
        variance,
        read=lambda stream: stream["value"],
    )


ATTITUDE = Model(
    "attitude from a gyro, an accelerometer and a magnetometer",
    STATE,
    AttitudeParameters,
    (_vector("force", "force", feel, feel_noise), _vector("field", "field", point, point_noise)),
    Motion(move, noise),
    control=Control(
        "gyro",
        schemas.VECTOR_MEASUREMENT,
        ("x_radps", "y_radps", "z_radps"),
        read=lambda stream: stream["value"],
    ),
)


def _rates(steps: int) -> Floats:
    t = np.arange(steps) * STEP_S
    return np.stack([0.5 * np.sin(0.7 * t), 0.4 * np.cos(0.5 * t), np.full(steps, 0.3)], axis=1)


@cache
def _turned(steps: int) -> Floats:
    """The rotation since the start after every step, (steps, 4)."""
    turns = Rotation.from_rotvec(_rates(steps) * STEP_S).as_quat(scalar_first=True)
    return np.stack([*accumulate(turns, compose)])


@cache
def simulate(seed: int, steps: int = 500) -> tuple[MemorySource, Floats, Floats]:
    """The log, the true states after every step, and what the gyro said."""
    rng = np.random.default_rng(seed)
    start = np.array([0.3] * 3 + [0.02] * 3) * rng.standard_normal(6)
    q, bias = Rotation.from_rotvec(start[:3]).as_quat(scalar_first=True), start[3:]
    step, rates = np.arange(steps), _rates(steps)
    # drawn step by step: of the gyro, its bias, and of what is measured after every fifth and tenth
    counts = 6 + 3 * ((step + 1) % 5 == 0) + 3 * ((step + 1) % 10 == 0)
    drawn, begin = rng.standard_normal(counts.sum()), np.cumsum(counts) - counts

    def drawn_in(chosen: Any, offset: int) -> Floats:
        return drawn[(begin[chosen] + offset)[:, None] + np.arange(3)]

    drifts = 0.001 * np.sqrt(STEP_S) * drawn_in(step, 3)
    biases = np.cumsum(np.concatenate([bias[None], drifts]), axis=0)
    gyro = rates + biases[:-1] + 0.01 / np.sqrt(STEP_S) * drawn_in(step, 0)
    q = compose(q, _turned(steps))
    fifth, tenth = step[4::5], step[9::10]
    force = rotate(conjugate(q[fifth]), np.array([0.0, 0.0, 9.81])) + 0.3 * drawn_in(fifth, 6)
    field = rotate(conjugate(q[tenth]), np.array([0.5, 0.0, -0.4])) + 0.05 * drawn_in(tenth, 9)
    step_ns = 20_000_000
    metadata = {"components": ",".join(STATE), "kinds": ",".join(STATE.values())}
    prior = np.diag([0.3**2] * 3 + [0.02**2] * 3)

    def vectors(topic: str, at: Any, values: Any) -> Any:
        stamps = EPOCH_NS + step_ns * at
        return make_stream(topic, schemas.VECTOR_MEASUREMENT, stamps, value=values)

    streams = [
        make_stream(
            "/prior",
            schemas.GAUSSIAN_ESTIMATE,
            [EPOCH_NS],
            metadata=metadata,
            mean=[[1.0, 0, 0, 0, 0, 0, 0]],
            covariance=prior.reshape(1, 36),
        ),
        vectors("/gyro", step, gyro),
        vectors("/force", fifth + 1, force),
        vectors("/field", tenth + 1, field),
    ]
    run = RunMetadata(scenario="attitude", parameters={}, seed=seed, run=0, epoch_ns=EPOCH_NS)
    return memory_source(Recording(streams), run), np.concatenate([q, biases[1:]], axis=1), gyro
