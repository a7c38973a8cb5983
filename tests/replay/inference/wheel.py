"""A wheel that is driven: an axis, noise that is not additive, a control linear between its messages.

So small that a plain loop of NumPy says what filters have to give.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.model.model import Control, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters

Floats = NDArray[np.float64]
EPOCH_NS = 10**9
STATE = {"direction_x": "axis", "direction_y": "axis", "rate_radps": "linear"}
ANGLE, RATE = 3.0, 0.8  # close to where an axis is itself again
COVARIANCE = np.array([[0.04, 0.01], [0.01, 0.09]])


class WheelParameters(ModelParameters):
    """The slip's share of a turn, the density of the rate's noise, and noise of the sensors."""

    slip: float = 0.1
    rate_density: float = 0.3
    sigma_dial: float = 0.1
    sigma_gain: float = 0.05
    sigma_tacho: float = 0.2


def turned(angle: Any, rate: Any, control: Any, noise: Any, duration_s: float) -> Any:
    turn = (rate + 0.5 * control * duration_s) * duration_s
    return angle + turn * (1.0 + noise[0]), rate + control * duration_s + noise[1]


def move(state: Any, control: Any, noise: Any, duration_s: Any, parameters: Any) -> Any:
    turn, rate = turned(0.0, state[2], control[0], noise, duration_s)
    cosine, sine = np.cos(turn), np.sin(turn)
    return state[0] * cosine - state[1] * sine, state[0] * sine + state[1] * cosine, rate


def noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    return parameters.slip**2, parameters.rate_density**2 * duration_s


def read_dial(state: Any, noise: Any, reference: Any, parameters: Any) -> Any:
    """Cosine and sine of twice the angle, by an amplifier whose gain is noisy."""
    x, y = state[0], state[1]
    return (1.0 + noise[0]) * (x * x - y * y) + noise[1], (1.0 + noise[0]) * 2.0 * x * y + noise[2]


def dial_noise(parameters: Any) -> Any:
    return parameters.sigma_gain**2, parameters.sigma_dial**2, parameters.sigma_dial**2


def read_tacho(state: Any, reference: Any, parameters: Any) -> Any:
    return (state[2],)


def tacho_noise(parameters: Any) -> Any:
    return (parameters.sigma_tacho**2,)


def make_wheel() -> Model:
    """A model of its own, for which nothing is compiled yet."""
    vector: dict[str, Any] = {"read": lambda stream: stream["value"]}
    dial = {"cosine": "linear", "sine": "linear"}
    return Model(
        "a driven wheel",
        STATE,
        WheelParameters,
        (
            Sensor("dial", schemas.VECTOR_MEASUREMENT, dial, read_dial, dial_noise, noises=3, **vector),
            Sensor(
                "tacho",
                schemas.VECTOR_MEASUREMENT,
                {"rate_radps": "linear"},
                read_tacho,
                tacho_noise,
                linear=True,
                **vector,
            ),
        ),
        Motion(move, noise, noises=2),
        control=Control(
            "drive", schemas.VECTOR_MEASUREMENT, ("acceleration_radps2",), interpolated=True, **vector
        ),
    )


def simulate(seed: int, control_s: Sequence[float]) -> dict[str, tuple[Floats, Floats]]:
    """Stamps in seconds and values of every topic; the truth does not matter here."""
    rng = np.random.default_rng(seed)
    dial_s, tacho_s = np.arange(-1, 21) * 0.1, np.arange(1, 9) * 0.25
    angle = ANGLE + RATE * dial_s
    dial = np.stack([np.cos(2 * angle), np.sin(2 * angle)], axis=1) + 0.1 * rng.normal(size=(22, 2))
    return {
        "dial": (dial_s, dial),
        "tacho": (tacho_s, RATE + 0.2 * rng.normal(size=(8, 1))),
        "drive": (np.array(control_s), np.sin(4 * np.array(control_s))[:, None]),
    }


def source(
    messages: dict[str, tuple[Floats, Floats]], order: Sequence[str] = ("dial", "tacho", "drive")
) -> MemorySource:
    """The messages as a log in memory; at equal stamps in the order of the topics given."""
    metadata = {"components": ",".join(STATE), "kinds": ",".join(STATE.values())}
    prior = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        [EPOCH_NS],
        metadata=metadata,
        mean=[[np.cos(ANGLE), np.sin(ANGLE), RATE]],
        covariance=COVARIANCE.reshape(1, 4),
    )
    streams = [
        make_stream(f"/{topic}", schemas.VECTOR_MEASUREMENT, stamps_of(messages[topic][0]), value=value)
        for topic in order
        for value in [messages[topic][1]]
    ]
    run = RunMetadata(scenario="wheel", parameters={}, seed=0, run=0, epoch_ns=EPOCH_NS)
    return memory_source(Recording([prior, *streams]), run)


def stamps_of(times_s: Floats) -> NDArray[np.int64]:
    return EPOCH_NS + np.rint(times_s * 1e9).astype(np.int64)
