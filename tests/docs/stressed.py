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

from fuselog.pipeline.runs.experiment import Setting, load_experiment, read_experiment
from fuselog.pipeline.runs.inputs import shipped as names_of
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.stressing.changes import CHANGES, DROPPED, PARAMETERS
from fuselog.pipeline.stressing.copies import How
from fuselog.pipeline.stressing.stressing import stress_runs
from fuselog.pipeline.stressing.sums import verdicts_of
from fuselog.recorders.errors import BadInput

DOCS = Path(__file__).parents[2] / "docs"
KEPT, PAGE = DOCS / "stressed.json", DOCS / "stress.md"
RUNS = 5
NO_STATE = ("biometrics-*",)  # scores of persons have no state that a change could move
_TABLE = re.compile(r"(<!-- stressed -->\n).*?(<!-- end -->)", re.DOTALL)

# Why estimators are not harmless: by experiment, estimator and change, the first that fits. What is not
# in proportion to the change is measured: by what is decided in both copies, by other seeds, by
# the NEES of the unchanged replay or by smaller changes; what is in proportion is said of the change.
JUMPS = (
    ("*", "rukf-*", "*", "its samples are random: another seed has the same effect as one ulp"),
    (
        "acoustic-sequence",
        "mixture",
        "*",
        "its 4000 particles are random: another seed has the same effect as one ulp, up to 0.5 sigma",
    ),
    (
        "bingham-2d",
        "kalman",
        DROPPED,
        "a Gaussian of a direction is overconfident: NEES is 2.1 instead of 1",
    ),
    (
        "ispace*",
        "*",
        "stamps",
        "a message sent 1 us before a measurement lacks it: 18 to 938 sigma; sent after it, below 1",
    ),
    (
        "los-moving",
        "*",
        DROPPED,
        "it trusts the stated attitudes and is overconfident: NEES over 10000; its study estimates them",
    ),
    (
        "los-t*-sensors",
        "scheme-3",
        DROPPED,
        "a pass has hardly more measurements than unknowns: without one, only this pass fails",
    ),
    (
        "manoeuvres",
        "stand",
        DROPPED,
        "a model for standing still, used while driving, is overconfident: NEES is 330000",
    ),
    (
        "navigation-unknown-heading",
        "*",
        "start",
        "the heading is unknown for 5 s: the likeliest of 45 members changes; its probability is 0.03",
    ),
    (
        "reactor",
        "*",
        DROPPED,
        "its covariance depends on the state: without the message its sigmas fall to 1/2 to 2/3",
    ),
    (
        "set-filter",
        "ekf",
        PARAMETERS,
        "its gate is at 13.82: it accepts a measurement at a NIS of 13.6 and rejects it at 14.6",
    ),
    (
        "torus-filter",
        "ukf-naive",
        DROPPED,
        "it treats angles as numbers on a line: the two copies are on different sides of pi",
    ),
    (
        "torus-filter",
        "*",
        DROPPED,
        "far from linear: the message moves it by over a sigma, but changes its sigmas by at most 3 %",
    ),
    (
        "vehicles-scaling",
        "powers",
        "*",
        "rounding errors grow thirtyfold per step, to sigmas in ten steps; one of two runs diverges",
    ),
    (
        "vehicles-scaling",
        "products",
        "*",
        "rounding errors grow thirtyfold per step, to sigmas in ten steps",
    ),
    (
        "vehicles-scaling",
        "particles-set",
        "*",
        "200 particles collapse: another seed has the same effect; with 20000 particles, 30 sigma",
    ),
)
MOVES = {
    DROPPED: "a lost message moves it by less than a sigma, or as far as its covariance explains",
    PARAMETERS: "in proportion to its parameters",
    "start": "the measurements contain little information about the start",
    "stamps": "in proportion to the shift",
}
NOT_TRIED = "tracks or sets, with no Gaussian to compare"


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
        """Why it is not harmless; empty where nobody has said so yet."""
        if self.verdict == "not tried":
            return NOT_TRIED
        if self.verdict == "sensitive":
            return MOVES.get(self.change, "")
        own = self.experiment, self.estimator, self.change
        fits = (why for *names, why in JUMPS if all(map(fnmatchcase, own, names)))
        return next(fits, "") if self.verdict != "harmless" else ""

    @property
    def said(self) -> str:
        """The verdict, and in how many runs where that is not all."""
        own, runs = self.counts.get(self.verdict, 0), sum(self.counts.values())
        return self.verdict if own == runs else f"{self.verdict}, {own} of {runs}"


def shipped() -> Iterator[tuple[str, list[str]]]:
    """The experiments that simulate, with their estimators that can be stressed."""
    for name in names_of("experiments"):
        stated = read_experiment(name).values  # noqa: PD011
        if "record" in stated and not any(fnmatchcase(name, no) for no in NO_STATE):
            yield name, [*stated.get("estimators", {})]


def stressed(name: str, labels: Sequence[str]) -> list[Row]:
    """What stress does to some estimators of an experiment; those that it refuses are left out."""
    _, experiment = load_experiment(name, {}, {})
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
        alike.setdefault((row.experiment, row.said, row.change, row.why), []).append(row)
    for (experiment, said, change, why), own in alike.items():
        worst = max(own, key=lambda row: row.sigmas or 0.0)
        sizes = ", ".join("-" if each is None else f"{each:g}" for each in worst[5:]) if change else ""
        by = CHANGES[change].words if change and said != "harmless" else ""
        labels = ", ".join(f"`{row.estimator}`" for row in own)
        lines.append(f"| `{experiment}` | {labels} | {said} | {by} | {sizes} | {why} |")
    verdicts = pd.Series([row.verdict for row in rows]).value_counts()
    counted = ", ".join(f"{verdicts[each]} {each}" for each in verdicts.index)
    return "\n".join([*lines, "", f"Of {len(rows)} estimators: {counted}.", ""])


def rendered(page: str, rows: Sequence[Row]) -> str:
    """The page with its table made anew."""
    return _TABLE.sub(lambda found: f"{found[1]}{table(rows)}{found[2]}", page)


def main() -> None:
    """Stress all, unless `--keep` is given, and make the page's table."""
    if "--keep" not in sys.argv[1:]:
        rows = [row for name, labels in shipped() for row in stressed(name, labels)]
        text = json.dumps([row._asdict() for row in rows], indent=1)
        KEPT.write_text(text + "\n", encoding="utf-8")
    PAGE.write_text(rendered(PAGE.read_text(encoding="utf-8"), kept()), encoding="utf-8")


if __name__ == "__main__":
    main()
