"""A study of how often the intervals of a resting sensor's noise cover the truth.

Each unit is recorded at rest, with white noise and a walk, and analysed like a user's log, including
tests for drift, vibration and correlation, a choice of terms, and intervals.
"""

from typing import Any

import numpy as np
import pandas as pd
from pydantic import NonNegativeInt
from scipy.signal import lfilter

from fuselog.pipeline.output.charts import coverage
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.sensing.allan import interval
from fuselog.pipeline.sensing.noise import noise
from fuselog.pipeline.sensing.terms import Terms
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

TURN = "/wheels.turn_radps"
TERMS, STEP_S, SIZE = Terms(1e-3, 1e-4), 0.02, 65536
TAUS_S = (1.0, 10.0, 100.0)
QUANTITIES = ("white", "walk", *(f"deviation-{tau_s:g}s" for tau_s in TAUS_S))


class NoiseOptions(Parameters):
    """Options of the study: the units to analyse.

    Attributes:
        seeds: the first seed of each block of the experiment's runs.
    """

    seeds: tuple[NonNegativeInt, ...] = ()


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: NoiseOptions = setting.options
    rows: list[dict[str, Any]] = []
    for block, first in enumerate(options.seeds):
        title = f"units from seed {first}"
        for seed in setting.progress(range(first, first + experiment.runs), title, experiment.runs):
            rows.append({"block": block, "seed": seed, **_looked_at(seed)})
    found = pd.DataFrame(rows)
    outcome = Outcome(tables={"noise": found})
    held: dict[str, dict[str, float]] = {}
    for place, first in enumerate(options.seeds):
        those = found[found["block"] == place]
        counts = held[f"seeds from {first}"] = {name: float(those[name].sum()) for name in QUANTITIES}
        outcome.metrics |= {f"noise.covered.{place}-{name}": each for name, each in counts.items()}
        for quantity in ("found_white", "found_walk"):
            spread = float(np.log(those[quantity]).std())
            outcome.metrics[f"noise.spread.{place}-{quantity.removeprefix('found_')}"] = spread
    outcome.figures["coverage"] = coverage("noise of a unit at rest", held)
    firsts = [at_rest(unit(first, SIZE, TERMS, STEP_S), STEP_S) for first in options.seeds]
    outcome.input_sha256 = hash_streams(firsts)
    return outcome


def _looked_at(seed: int) -> dict[str, Any]:
    """Estimate one unit's noise, and test which intervals cover the truth."""
    values = unit(seed, SIZE, TERMS, STEP_S)
    [column] = noise(at_rest(values, STEP_S), TURN).columns
    low, high = interval(column.curve.deviations, column.degrees)
    true = np.sqrt(TERMS.allan_variance(column.curve.taus_s, STEP_S))
    row: dict[str, Any] = {}
    for name in ("white", "walk"):
        number = column.numbers.get(name)
        row[name] = number is not None and number.low <= getattr(TERMS, name) <= number.high
        row[f"found_{name}"] = (number.value if number is not None else 0.0) or np.nan
    for tau_s in TAUS_S:
        at = int(np.argmin(np.abs(np.log(column.curve.taus_s / tau_s))))
        row[f"deviation-{tau_s:g}s"] = low[at] <= true[at] <= high[at]
    return row


def unit(seed: int, size: int, terms: Terms, step_s: float) -> Floats:
    """Draw samples (size,) of one column: white noise, walk, Gauss-Markov noise, quantised angle.

    The random numbers of each term depend only on the seed, not on which other terms are present.
    """
    rng = np.random.Generator(np.random.Philox(key=seed))
    white, walk, markov = (rng.standard_normal(size) for _ in range(3))
    angle = rng.random(size + 1) - 0.5
    decay = np.exp(-step_s / terms.markov_time_s)
    driven = terms.markov * np.sqrt(1 - decay**2) * markov
    driven[0] = terms.markov * markov[0]
    walked = np.concatenate([[0.0], np.cumsum(terms.walk * np.sqrt(step_s) * walk)[:-1]])
    quantised = np.diff(terms.quantisation * np.sqrt(12) * angle) / step_s
    found: Floats = terms.white / np.sqrt(step_s) * white + walked
    return found + lfilter([1], [1, -decay], driven) + quantised


def at_rest(values: Floats, step_s: float) -> MemorySource:
    """Make a log whose turn rate `TURN` has these values.

    Args:
        values: (n,), in rad/s.
        step_s: the time between two values.

    Returns:
        The log, which begins at time 0.
    """
    stream = make_stream(
        TURN.partition(".")[0],
        schemas.ODOMETRY,
        np.rint(np.arange(len(values)) * step_s * 1e9).astype(np.int64),
        forward_mps=np.zeros(len(values)),
        turn_radps=values,
    )
    return memory_source(Recording([stream]), RunMetadata("at rest", epoch_ns=0))


NOISE = Study("how often the intervals of a sensor's noise cover the truth", study, NoiseOptions)
