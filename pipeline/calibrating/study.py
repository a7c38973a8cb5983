"""A study of calibration: the coverage of its intervals, and what each motion leaves undetermined.

Cars are calibrated one by one, from an uninformative start. Logs without noise and with a practically
uninformative prior show which parameters a motion determines.
"""

from collections.abc import Sequence
from itertools import product
from typing import Any

import pandas as pd
from pydantic import NonNegativeInt

from fuselog.pipeline.calibrating.calibrating import calibrate
from fuselog.pipeline.calibrating.manoeuvres import NAMES, OURS, TRUTH, WIDE, drive, recorded
from fuselog.pipeline.output.charts import coverage
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.simulators.car import MOTIONS

# the simulated noise is on the car's motion, the model's noise on the readings
NOISE = {"forward_noise_density": 0.05 * TRUTH[0], "turn_noise_density": 0.01 * TRUTH[1]}


class CalibrationOptions(Parameters):
    """Options of the study: the cars to calibrate, and the motions.

    Attributes:
        seeds: the first seed of each block; every block has as many cars as the experiment has runs.
        motions: the motions for which undetermined parameters are listed.
    """

    seeds: tuple[NonNegativeInt, ...] = ()
    motions: tuple[str, ...] = (*MOTIONS,)


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: CalibrationOptions = setting.options
    if unknown := [each for each in options.motions if each not in MOTIONS]:
        raise BadInput(
            f"options.motions: the calibration study has no motion {unknown[0]!r}; it has "
            + ", ".join(MOTIONS)
        )
    [(label, settings)] = experiment.estimators.items()
    wanted = settings | NOISE
    rows: list[dict[str, Any]] = []
    for block, first in enumerate(options.seeds):
        title = f"cars from seed {first}"
        for seed in setting.progress(range(first, first + experiment.runs), title, experiment.runs):
            rows += _calibrated(label, wanted, block, seed)
    found = pd.DataFrame(rows)
    outcome = Outcome(tables={"calibrated": found})
    held: dict[str, dict[str, float]] = {f"seeds from {first}": {} for first in options.seeds}
    for (place, counts), name in product(enumerate(held.values()), NAMES):
        those = found[(found["block"] == place) & (found["parameter"] == name)]
        spread = float(those["value"].std() / those["sigma"].mean())
        outcome.metrics[f"{label}.covered.{place}-{name}"] = counts[name] = float(
            those["is_covered"].sum()
        )
        outcome.metrics[f"{label}.spread.{place}-{name}"] = spread
    outcome.figures["coverage"] = coverage("calibration of a car", held)
    motions = [_left_open(label, wanted, motion) for motion in options.motions]
    outcome.tables["motions"] = pd.DataFrame(motions, columns=["motion", *NAMES])
    for name, *are_open in motions:
        outcome.metrics |= {
            f"{label}.left_open.{name.replace(' ', '-')}-{parameter}": float(is_open)
            for parameter, is_open in zip(NAMES, are_open, strict=True)
        }
    outcome.input_sha256 = hash_streams([recorded(drive(first)) for first in options.seeds])
    return outcome


def _calibrated(label: str, settings: dict[str, Any], block: int, seed: int) -> list[dict[str, Any]]:
    """Calibrate one car and return a row per parameter."""
    table = calibrate(recorded(drive(seed)), {label: settings}).parameters.set_index("parameter")
    rows: list[dict[str, Any]] = []
    for name, true in zip(NAMES, OURS, strict=True):
        value, low, high = table.loc[name, ["value", "low", "high"]].to_numpy(float)
        rows.append(
            {
                "block": block,
                "seed": seed,
                "parameter": name,
                "true": true,
                "value": value,
                "sigma": (high - low) / 3.919928,
                "is_covered": low <= true <= high,
            }
        )
    return rows


def _left_open(label: str, settings: dict[str, Any], motion: str) -> Sequence[Any]:
    """Return a row with the motion and whether each parameter stays undetermined."""
    found = calibrate(recorded(drive(None, TRUTH, motion=motion, **WIDE)), {label: settings})
    held = set(found.found.held)
    return [motion, *(name in held for name in NAMES)]


CALIBRATION = Study(
    "how often the intervals of a calibration cover the truth, and what each motion leaves open",
    study,
    CalibrationOptions,
)
