"""The reference sheet's test model of particles: one number that decays, measured at every step."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters

Floats = NDArray[np.float64]
EPOCH_NS = 10**9
STEPS = 50


class ScalarParameters(ModelParameters):
    """What is kept in a step, and the standard deviations of both noises."""

    kept: float = 0.9
    sigma_moved: float = 0.5
    sigma_measured: float = 0.7


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    return (parameters.kept * state[0],)


def move_noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    return (parameters.sigma_moved**2,)


def measure(state: Any, reference: Any, parameters: Any) -> Any:
    return (state[0],)


def measure_noise(parameters: Any) -> Any:
    return (parameters.sigma_measured**2,)


VALUE = Sensor(
    "value",
    schemas.VECTOR_MEASUREMENT,
    {"x": "linear"},
    measure,
    measure_noise,
    read=lambda stream: stream["value"],
    linear=True,
)
SCALAR = Model(
    "a number that decays",
    {"x": "linear"},
    ScalarParameters,
    (VALUE,),
    Motion(move, move_noise, linear=True),
)


def simulate(seed: int) -> Floats:
    """What is measured at the steps (50,)."""
    rng = np.random.default_rng(seed)
    x, found = rng.standard_normal(), []
    for _ in range(STEPS):
        x = 0.9 * x + 0.5 * rng.standard_normal()
        found.append(x + 0.7 * rng.standard_normal())
    return np.array(found)


def source(values: Sequence[float] | Floats, first_later_ns: int = 0) -> MemorySource:
    """One value every second as a log in memory; the first one later, which particles are seeded by."""
    stamps = EPOCH_NS + 10**9 * np.arange(1, len(values) + 1)
    stamps[0] += first_later_ns
    prior = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        [EPOCH_NS],
        metadata={"components": "x", "kinds": "linear"},
        mean=[[0.0]],
        covariance=[[1.0]],
    )
    column = np.reshape(values, (-1, 1))
    told = make_stream("/value", schemas.VECTOR_MEASUREMENT, stamps, value=column)
    run = RunMetadata(scenario="scalar", parameters={}, seed=0, run=0, epoch_ns=EPOCH_NS)
    return memory_source(Recording([prior, told]), run)
