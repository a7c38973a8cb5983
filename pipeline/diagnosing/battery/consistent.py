"""Counts the causes that are named in logs of the car with nothing wrong, whatever noise is the largest.

The wheels have the noise of `car`. What they err by between two fixes is RATIOS times the error of a
fix, and between two headings as many times that of a heading.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import pandas as pd

from fuselog.pipeline.diagnosing.battery.car import (
    COMPASS_STEP_S,
    FIX_STEP_S,
    FORWARD_DENSITY,
    TURN_DENSITY,
    Noise,
    drive,
    recorded,
)
from fuselog.pipeline.diagnosing.causes import seek
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.replay.engine.streams.sources import MemorySource

TO_FIX = (0.1, 0.3, 1.0, 3.0, 10.0)
TO_COMPASS = (None, 0.1, 1.0, 10.0)


class Ratios(NamedTuple):
    """States how many times larger the wheels' error between two messages is than a message's own."""

    to_fix: float
    to_compass: float | None  # None: there is no compass

    @property
    def noise(self) -> Noise:
        """Return the noise of the car's sensors."""
        fix_sigma_m = FORWARD_DENSITY * FIX_STEP_S**0.5 / self.to_fix
        compass_sigma_rad = TURN_DENSITY * COMPASS_STEP_S**0.5 / (self.to_compass or 1.0)
        return Noise(fix_sigma_m=fix_sigma_m, compass_sigma_rad=compass_sigma_rad)


def all_ratios() -> Iterator[Ratios]:
    """Yield the settings of the car."""
    for to_compass in TO_COMPASS:
        for to_fix in TO_FIX:
            yield Ratios(to_fix, to_compass)


def log_of(ratios: Ratios, seed: int) -> MemorySource:
    """Return a log in which nothing is wrong."""
    car = drive(seed, noise=ratios.noise)
    return recorded(car, has_compass=ratios.to_compass is not None, has_prior=True)


def tried(ratios: Ratios, seed: int) -> dict[str, Any]:
    """Look for a cause in a log in which nothing is wrong; it has no name if none is found."""
    found = seek(log_of(ratios, seed), "ekf", {"kind": "ekf", "gate_probability": 1.0}, 1)
    named = [cause.hypothesis.name for cause in found.causes]
    return {**ratios._asdict(), "seed": seed, "cause": named[0] if named else ""}


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    rows, seeds = [], range(experiment.seed, experiment.seed + experiment.runs)
    outcome = Outcome()
    for ratios in all_ratios():
        title = f"to fixes {ratios.to_fix:g}, to compass {ratios.to_compass or 0:g}"
        own = [tried(ratios, seed) for seed in setting.progress(seeds, title, len(seeds))]
        case = f"{ratios.to_fix:g}-{ratios.to_compass or 0:g}"
        outcome.metrics[f"ekf.false_causes.{case}"] = float(sum(bool(each["cause"]) for each in own))
        rows += own
    found = pd.DataFrame(rows)
    outcome.metrics["ekf.false_causes.all"] = float((found["cause"] != "").sum())
    outcome.metrics["ekf.logs"] = float(len(found))
    outcome.tables["tried"] = found
    outcome.input_sha256 = hash_streams([log_of(ratios, experiment.seed) for ratios in all_ratios()])
    return outcome


FALSE_CAUSES = Study(
    "how often a diagnosis names a cause in a log with nothing wrong, whatever noise is the largest",
    study,
    runs="logs of each of 20 settings of the noise",
)
