"""A study of how often the intervals of fitted ellipsoids cover the truth.

A magnetometer is rotated steadily, and an accelerometer is put down in many positions. Both have
offsets, scale errors and cross terms.
"""

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from pydantic import NonNegativeInt

from fuselog.pipeline.calibrating.ellipsoid import Ellipsoid, ellipsoid
from fuselog.pipeline.calibrating.ellipsoid_fit import NAMES, matrix_of
from fuselog.pipeline.output.charts import coverage
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording
from fuselog.recorders.units import STANDARD_GRAVITY_MPS2
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

FIELD, FORCE = "/imu.magnetic_field_ut", "/imu.specific_force_mps2"
FIELD_UT = 48.0
# offsets in the field's unit, scales, cross terms
MAGNETOMETER = np.array([12.0, -30.0, 7.0, 1.05, 0.93, 1.02, 0.03, -0.02, 0.01])
ACCELEROMETER = np.array([0.2, -0.3, 0.1, 1.01, 0.99, 1.005, 0.004, -0.006, 0.003])
STEP_S, HELD_S, MOVED_S, POSITIONS = 0.02, 2.0, 1.0, 40


class EllipsoidOptions(Parameters):
    """Options of the study: the units to calibrate.

    Attributes:
        seeds: the first seed of each block; every block has as many units as the experiment has runs.
    """

    seeds: tuple[NonNegativeInt, ...] = ()


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: EllipsoidOptions = setting.options
    rows: list[dict[str, Any]] = []
    for block, first in enumerate(options.seeds):
        title = f"units from seed {first}"
        for seed in setting.progress(range(first, first + experiment.runs), title, experiment.runs):
            rows += [{"block": block, "seed": seed, "unit": unit, **_held(unit, seed)} for unit in UNITS]
    found = pd.DataFrame(rows)
    outcome = Outcome(tables={"ellipsoids": found})
    for unit in UNITS:
        held: dict[str, dict[str, float]] = {}
        for block, first in enumerate(options.seeds):
            those = found[(found["block"] == block) & (found["unit"] == unit)]
            counts = held[f"seeds from {first}"] = {name: float(those[name].sum()) for name in NAMES}
            outcome.metrics |= {
                f"ellipsoid.covered.{block}-{unit}-{name}": each for name, each in counts.items()
            }
        outcome.figures[f"coverage-{unit}"] = coverage(f"ellipsoid of a rotated {unit}", held)
    outcome.input_sha256 = hash_streams(
        [recorded(unit, first) for unit, first in product(UNITS, options.seeds)]
    )
    return outcome


def _held(unit: str, seed: int) -> dict[str, bool]:
    """Test which intervals of a unit cover the truth."""
    _, truth = UNITS[unit]
    table = calibrated(unit, seed).table
    return dict(zip(NAMES, (table["low"] <= truth) & (truth <= table["high"]), strict=True))


def calibrated(unit: str, seed: int) -> Ellipsoid:
    """Calibrate a simulated unit."""
    name, length = (FIELD, FIELD_UT) if unit == "magnetometer" else (FORCE, None)
    return ellipsoid(recorded(unit, seed), name, length=length)


def recorded(unit: str, seed: int) -> MemorySource:
    """Make a log of a simulated unit, whose other sensors read zero."""
    draw, truth = UNITS[unit]
    rng = np.random.Generator(np.random.Philox(key=seed))
    vectors, noise = draw(rng)
    readings = vectors @ np.linalg.inv(matrix_of(truth)) + truth[:3]
    readings += noise * rng.standard_normal(readings.shape)
    nothing = np.zeros_like(readings)
    is_magnetic = unit == "magnetometer"
    stream = make_stream(
        "/imu",
        schemas.INERTIAL_SAMPLE,
        np.rint(np.arange(len(readings)) * STEP_S * 1e9).astype(np.int64),
        specific_force_mps2=nothing if is_magnetic else readings,
        turn_rate_radps=nothing,
        magnetic_field_ut=readings if is_magnetic else nothing,
    )
    return memory_source(Recording([stream]), RunMetadata(f"turned {unit}", epoch_ns=0))


def turned(rng: np.random.Generator) -> tuple[Floats, float]:
    """Simulate the field (n, 3) in the axes of a unit rotated for a minute; return it and the noise."""
    time_s = STEP_S * np.arange(3000)
    across, up = 1.1 * time_s, 1.5 * np.sin(0.13 * time_s)
    across, up = across + 6.0 * rng.random(), up + 0.05 * rng.random()
    directions = np.stack([np.cos(across) * np.cos(up), np.sin(across) * np.cos(up), np.sin(up)], axis=1)
    return FIELD_UT * directions, 0.3


def put_down(rng: np.random.Generator) -> tuple[Floats, float]:
    """Simulate the specific force (n, 3) of a unit moved between positions; return it and the noise."""
    directions = rng.standard_normal((POSITIONS, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    held, moved = round(HELD_S / STEP_S), round(MOVED_S / STEP_S)
    forces = np.repeat(STANDARD_GRAVITY_MPS2 * directions, held + moved, axis=0)
    is_moved = np.arange(len(forces)) % (held + moved) >= held
    forces[is_moved] += rng.standard_normal((int(is_moved.sum()), 3))
    return forces, 0.05


UNITS: Mapping[str, tuple[Callable[[np.random.Generator], tuple[Floats, float]], Floats]] = {
    "magnetometer": (turned, MAGNETOMETER),
    "accelerometer": (put_down, ACCELEROMETER),
}
ELLIPSOID = Study("how often the intervals of an ellipsoid cover the truth", study, EllipsoidOptions)
