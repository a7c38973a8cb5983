"""A count of the causes that are named in logs of the car without faults, for many noise ratios.

The wheels have the noise of `car`. The wheels' error between two fixes is a multiple of a fix's error,
and their error between two headings is a multiple of a heading's error. The options list the noise
ratios.
"""

from itertools import product
from typing import Annotated, Any, NamedTuple

import pandas as pd
from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.pipeline.diagnosing.battery.car import drive, recorded
from fuselog.pipeline.diagnosing.causes import seek
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.simulators.car import CarParameters
from fuselog.replay.engine.streams.sources import MemorySource


class FalseCausesOptions(Parameters):
    """Options of the study: lists of noise ratios, of which all combinations are used.

    Attributes:
        to_fix: ratios of the wheels' error between two fixes to the error of a fix.
        to_compass: ratios of the wheels' error between two headings to the error of a heading; 0 means
            no compass.
    """

    to_fix: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (0.1, 0.3, 1.0, 3.0, 10.0)
    to_compass: Annotated[tuple[NonNegativeFloat, ...], Field(min_length=1)] = (0.0, 0.1, 1.0, 10.0)

    def ratios(self) -> list["Ratios"]:
        """Return all combinations."""
        return [
            Ratios(to_fix, to_compass) for to_compass, to_fix in product(self.to_compass, self.to_fix)
        ]


class Ratios(NamedTuple):
    """Ratios of the wheels' error between two messages to the error of a message."""

    to_fix: float
    to_compass: float  # 0: there is no compass

    @property
    def noise(self) -> dict[str, float]:
        """Return the noise of the car's fixes and compass, as parameters."""
        usual = CarParameters()
        to_fix = usual.forward_noise_density * usual.fix_step_s**0.5
        to_compass = usual.turn_noise_density * usual.compass_step_s**0.5
        return {
            "fix_sigma_m": to_fix / self.to_fix,
            "compass_sigma_rad": to_compass / (self.to_compass or 1.0),
        }


def log_of(ratios: Ratios, seed: int) -> MemorySource:
    """Make a log without a fault."""
    car = drive(seed, **ratios.noise)
    return recorded(car, has_compass=ratios.to_compass > 0.0, has_prior=True)


def tried(ratios: Ratios, seed: int) -> dict[str, Any]:
    """Search for a cause in a log without faults; the name is empty if no cause is found."""
    found = seek(log_of(ratios, seed), "ekf", {"kind": "ekf", "gate_probability": 1.0}, 1)
    named = [cause.hypothesis.name for cause in found.causes]
    return {**ratios._asdict(), "seed": seed, "cause": named[0] if named else ""}


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    rows, seeds = [], range(experiment.seed, experiment.seed + experiment.runs)
    outcome, every = Outcome(), setting.options.ratios()
    for ratios in every:
        title = f"to fixes {ratios.to_fix:g}, to compass {ratios.to_compass:g}"
        own = [tried(ratios, seed) for seed in setting.progress(seeds, title, len(seeds))]
        case = f"{ratios.to_fix:g}-{ratios.to_compass:g}"
        outcome.metrics[f"ekf.false_causes.{case}"] = float(sum(bool(each["cause"]) for each in own))
        rows += own
    found = pd.DataFrame(rows)
    outcome.metrics["ekf.false_causes.all"] = float((found["cause"] != "").sum())
    outcome.metrics["ekf.logs"] = float(len(found))
    outcome.tables["tried"] = found
    outcome.input_sha256 = hash_streams([log_of(ratios, experiment.seed) for ratios in every])
    return outcome


FALSE_CAUSES = Study(
    "how often a diagnosis names a cause in a fault-free log, at many noise ratios",
    study,
    FalseCausesOptions,
    runs="logs per noise setting; there are 20 settings unless options give others",
)
