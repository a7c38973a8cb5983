"""A count of how often several faults in a car's log are all named, with their correct values.

The logs have a compass and a prior, so most faults can be distinguished.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field

from fuselog.pipeline.diagnosing.battery.battery import OPEN, RIGHT, Right, case_of
from fuselog.pipeline.diagnosing.battery.car import FAULTS, faulty, recorded
from fuselog.pipeline.diagnosing.causes import Cause, seek
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import NOISES
from fuselog.pipeline.diagnosing.sentences import MOST_SENTENCES
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.simulators.car import philox
from fuselog.replay.judging.intervals import Interval

PAIRS, TRIPLES = 135, 40
AXES = "E, N exchanged"
# The quantity that each fault changes. Faults of the same quantity, such as opposite factors, hide each
# other.
FIELDS: dict[str, Sequence[str]] = {
    "stamps of fixes": ("fixes .3 s late", "fixes 18 s late"),
    "turn rate": ("turn rate's sign", "degrees as radians", "gyro bias .02", "gyro bias .0004 t"),
    "speed": ("speed x 3.6", "speed / 3.6", "speed x .3048"),
    "lever": ("lever (2, .6) m",),
    "variance of fixes": ("fix variance x 4", "fix variance / 16", "sd written as variance"),
    "axes of fixes": (AXES,),
    "stamps of odometry": ("odometry clock 6 % fast",),
    "noise of turns": ("gyro density / 5",),
    "compass": ("compass + 4.5 deg", "compass clockwise from north"),
}
# Any two of these have the effect of the third: each mirrors turn rate, position or heading.
MIRRORS = {"turn rate's sign", AXES, "compass clockwise from north"}
# Fixes that are 3.6 times too far apart explain both: they also look 3.6 times noisier.
ALIKE = {"speed / 3.6", "fix variance / 16"}
# Lost messages are found from the stamps, and "nothing" is not a fault.
NOT_PAIRED = {"nothing", "half of the odometry lost"}


class TogetherOptions(Parameters):
    """Options of the study: the number of sets of faults.

    Attributes:
        pairs: the number of pairs, counted from the first.
        triples: the number of triples.
    """

    pairs: Annotated[int, Field(ge=1, le=PAIRS)] = PAIRS
    triples: Annotated[int, Field(ge=1, le=TRIPLES)] = TRIPLES

    def sets(self) -> list[tuple[str, ...]]:
        """Return the sets of faults, first the pairs and then the triples."""
        return [*pairs()[: self.pairs], *triples()[: self.triples]]


def pairs() -> list[tuple[str, ...]]:
    """Return all pairs of faults of different quantities that a log can distinguish."""
    return [each for each in combinations(_in_order(), 2) if _is_told(each)]


def triples() -> list[tuple[str, ...]]:
    """Draw triples with a fixed seed, in which a log can distinguish each fault from the others."""
    every = [each for each in combinations(_in_order(), 3) if _is_told(each)]
    chosen = philox(63).choice(len(every), TRIPLES, replace=False)
    return [every[place] for place in sorted(chosen.tolist())]


def _in_order() -> list[str]:
    """Return the faults in the order in which they are planted; swapped axes come last."""
    return sorted((name for name in FAULTS if name not in NOT_PAIRED), key=lambda name: name == AXES)


def _is_told(faults: Sequence[str]) -> bool:
    fields = {field for name in faults for field, own in FIELDS.items() if name in own}
    is_one = len(MIRRORS.intersection(faults)) > 1 or ALIKE.issubset(faults)
    return len(fields) == len(faults) and not is_one


def tried(faults: Sequence[str], seed: int) -> dict[str, Any]:
    """Plant faults, and test whether causes name them with intervals that cover the true values."""
    log = recorded(faulty(seed, *faults), has_prior=True)
    causes = seek(log, "ekf", OPEN, MOST_SENTENCES).causes
    planted = [RIGHT[name] for name in faults]
    found = [_estimate(causes, right) for right in planted]
    values = [
        each.low <= right.value <= each.high
        for each, right in zip(found, planted, strict=True)
        if each is not None and np.isfinite(right.value) and each.low != each.high
    ]
    first = causes[0].hypothesis.kind if causes else ""
    return {
        "faults": " + ".join(faults),
        "planted": len(faults),
        "seed": seed,
        "are_named": all(each is not None for each in found),
        "values": len(values),
        "within": sum(values),
        "is_noise_first": first in NOISES and not any(right.kind in NOISES for right in planted),
        "causes": "; ".join(cause.statement for cause in causes),
    }


def _estimate(causes: Sequence[Cause], right: Right) -> Interval | None:
    """Return the value that causes give a planted fault under any name; for noise, its logarithm."""
    for cause in causes:
        for each in (cause, *cause.others):
            for number in each.numbers:
                if (each.hypothesis.kind, each.hypothesis.topic, number.name) == right[:3]:
                    is_noise = each.hypothesis.kind in NOISES
                    return number.rising(np.log) if is_noise else number
    return None


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    rows, every = [], setting.options.sets()
    for case, faults in enumerate(every):
        seeds = _seeds(experiment, case)
        rows += [tried(faults, seed) for seed in setting.progress(seeds, " + ".join(faults), len(seeds))]
    found = pd.DataFrame(rows)
    outcome = Outcome(metrics={**metrics_of(found)}, tables={"together": found})
    outcome.input_sha256 = hash_streams(
        [
            recorded(faulty(_seeds(experiment, case)[0], *faults), has_prior=True)
            for case, faults in enumerate(every)
        ]
    )
    return outcome


def _seeds(experiment: Experiment, case: int) -> range:
    """Return the seeds of a case; no two cases share seeds, so no logs share noise and errors."""
    first = experiment.seed + case * experiment.runs
    return range(first, first + experiment.runs)


def metrics_of(rows: pd.DataFrame) -> dict[str, float]:
    """Count named faults over all pairs of faults, over all triples, and for each set of faults."""
    metrics = dict[str, float]()
    for case, own in (("pairs", rows[rows["planted"] == 2]), ("triples", rows[rows["planted"] == 3])):
        metrics |= {
            f"ekf.logs.{case}": float(len(own)),
            f"ekf.named_share.{case}": float(own["are_named"].mean()),
            f"ekf.values.{case}": float(own["values"].sum()),
            f"ekf.within_share.{case}": float(own["within"].sum() / max(own["values"].sum(), 1)),
            f"ekf.noise_first.{case}": float(own["is_noise_first"].sum()),
        }
    for faults, own in rows.groupby("faults", sort=False):
        metrics[f"ekf.named.{case_of(str(faults))}"] = float(own["are_named"].sum())
        metrics[f"ekf.within.{case_of(str(faults))}"] = float(own["within"].sum())
    return metrics


FAULTS_TOGETHER = Study(
    "how often a diagnosis names two or three faults planted in a log, with their values",
    study,
    TogetherOptions,
    runs="logs per pair and per triple",
)
