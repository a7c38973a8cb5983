"""What stress does to the shipped estimators in shipped simulated scenarios, kept and shown.

`python -m tests.docs.stressed` stresses them, in about five minutes, keeps what it finds in
docs/stressed.json, and makes the table of docs/stress.md; with `--keep` it makes that of what is kept.
An experiment's estimators are stressed as its file has them, whatever its study does beside.
"""

import json
import re
import sys
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

import fuselog as fl
from pipeline.runs.experiment import Experiment, Setting, load_experiment
from pipeline.runs.runner import Runner
from pipeline.stressing.changes import CHANGES, DROPPED, PARAMETERS
from pipeline.stressing.stressing import How, stress_runs
from pipeline.stressing.sums import verdicts_of
from recorders.errors import BadInput

DOCS = Path(__file__).parents[2] / "docs"
KEPT, PAGE = DOCS / "stressed.json", DOCS / "stress.md"
RUNS = 5
NO_STATE = ("biometrics-*",)  # scores of persons have no state that a change could move
_TABLE = re.compile(r"(<!-- stressed -->\n).*?(<!-- end -->)", re.DOTALL)

# Why those that are not harmless are not: by experiment, estimator and change, the first that fits.
WHY = (
    (
        "acoustic-sequence",
        "mixture",
        "*",
        "too few particles, of which a few come near the truth: each draw ends elsewhere",
    ),
    ("*", "rukf-*", "*", "its samples are random, and hang on the run's first message: another draw"),
    (
        "vehicles-scaling",
        "particles-set",
        "*",
        "200 particles for all vehicles together collapse: its covariance is next to nothing",
    ),
    (
        "vehicles-scaling",
        "p*",
        "*",
        "sums of powers or products of all positions are far from linear: rounding grows",
    ),
    (
        "ispace*",
        "*",
        "stamps",
        "nodes send at the stamps at which they measure: a microsecond later it waits a step",
    ),
    (
        "los-moving",
        "*",
        "*",
        "takes attitudes and clocks as stated: too sure; its study has it estimate them",
    ),
    (
        "manoeuvres",
        "*",
        "*",
        "one mode alone is a wrong model of who drives, turns and stands: too sure",
    ),
    (
        "bingham-*",
        "kalman*",
        "*",
        "a Gaussian of quaternions, whose covariance is none of a direction: too sure",
    ),
    (
        "torus-filter",
        "*",
        "*",
        "its covariance is that of the angles' moments, and grows with neither more nor less data",
    ),
    (
        "*",
        "*",
        DROPPED,
        "what it measures tells much: a lost message moves it as far as its covariance says",
    ),
    ("*", "*", PARAMETERS, "in proportion to its parameters"),
    ("*", "*", "start", "a moved start stays: little is measured of it, or not linearly"),
    ("*", "*", "stamps", "in proportion to the shift"),
)


class Row(NamedTuple):
    """What stress does to one estimator over the first runs of an experiment.

    Attributes:
        experiment, estimator: whose.
        verdict: over the runs; empty where it is refused.
        counts: how many runs have which.
        change: which change decides, in the run that it moves most.
        sigmas, metres, degrees: how far it moves that one.
    """

    experiment: str
    estimator: str
    verdict: str
    counts: dict[str, int]
    change: str = ""
    sigmas: float | None = None
    metres: float | None = None
    degrees: float | None = None

    @property
    def why(self) -> str:
        """Why it is not harmless."""
        own = self.experiment, self.estimator, self.change
        fits = (why for *names, why in WHY if all(map(fnmatchcase, own, names)))
        return "" if self.verdict in ("harmless", "not tried") else next(fits, "")


def shipped() -> Iterator[tuple[str, Experiment]]:
    """The experiments that simulate, and have estimators that can be stressed."""
    for name in fl.experiments:
        _, experiment = load_experiment(name, {}, {})
        if (
            experiment.record
            and experiment.estimators
            and not any(fnmatchcase(name, no) for no in NO_STATE)
        ):
            yield name, experiment


def stressed(name: str, experiment: Experiment, labels: Sequence[str]) -> list[Row]:
    """What stress does to some estimators of an experiment; those that it refuses are left out."""
    runs = Runner(experiment, Setting(Path(), Path(), logs=0, draws=False)).obtain(runs=RUNS)
    rows = []
    for label in labels:
        own = {label: {"kind": label, **experiment.estimators[label]}}
        try:
            found = stress_runs(runs, own, How(0, experiment.gap_limit_s))
        except BadInput:
            continue
        verdict = verdicts_of(found)[label].verdict
        counts = pd.Series([each.worst for each in found]).value_counts().to_dict()
        if verdict == "not tried":
            rows.append(Row(name, label, verdict, counts))
            continue
        worst = [each for each in found if each.worst == verdict]
        of = max(worst, key=lambda each: each.tried[each.deciding].largest)
        told = next(row for row in of.rows if row["change"] == of.deciding)
        sizes = (told["amplification"], told["metres"], told["degrees"])
        rows.append(Row(name, label, verdict, counts, of.deciding, *map(_number, sizes)))
    return rows


def _number(value: Any) -> float | None:
    return None if pd.isna(value) else float(f"{value:.3g}")


def kept() -> list[Row]:
    """What was found last."""
    return [Row(**row) for row in json.loads(KEPT.read_text(encoding="utf-8"))]


def table(rows: Sequence[Row]) -> str:
    """A line for estimators of an experiment that fare alike, and how many fare how."""
    lines = [
        "| experiment | estimators | verdict | by | sigmas, m, deg | why |",
        "|---|---|---|---|---|---|",
    ]
    alike: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        alike.setdefault((row.experiment, row.verdict, row.change, row.why), []).append(row)
    for (experiment, verdict, change, why), own in alike.items():
        worst = max(own, key=lambda row: row.sigmas or 0.0)
        sizes = ", ".join("-" if each is None else f"{each:g}" for each in worst[5:]) if change else ""
        by = CHANGES[change].words if change and verdict != "harmless" else ""
        labels = ", ".join(f"`{row.estimator}`" for row in own)
        lines.append(f"| `{experiment}` | {labels} | {verdict} | {by} | {sizes} | {why} |")
    verdicts = pd.Series([row.verdict for row in rows]).value_counts()
    counted = ", ".join(f"{verdicts[each]} {each}" for each in verdicts.index)
    return "\n".join([*lines, "", f"Of {len(rows)}: {counted}.", ""])


def rendered(page: str, rows: Sequence[Row]) -> str:
    """The page with its table made anew."""
    return _TABLE.sub(lambda found: f"{found[1]}{table(rows)}{found[2]}", page)


def main() -> None:
    """Stress all, unless `--keep` is given, and make the page's table."""
    if "--keep" not in sys.argv[1:]:
        rows = [row for name, each in shipped() for row in stressed(name, each, [*each.estimators])]
        text = json.dumps([row._asdict() for row in rows], indent=1)
        KEPT.write_text(text + "\n", encoding="utf-8")
    PAGE.write_text(rendered(PAGE.read_text(encoding="utf-8"), kept()), encoding="utf-8")


if __name__ == "__main__":
    main()
