"""Verdicts on the metrics of two candidates, withheld if irrelevant changes have a larger effect."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from fuselog.pipeline.output.alarms import Stressing
from fuselog.pipeline.output.words import count
from fuselog.replay.judging.errors.differences import Difference, Target
from fuselog.replay.judging.intervals import FEWEST_RUNS, too_few
from fuselog.replay.judging.verdicts import DIFFER, Comparison

ALL = "all"


class Paired(NamedTuple):
    """A metric of two candidates, with the difference over the runs and the verdict.

    Attributes:
        first, second: names of the candidates.
        quantity: name of the metric.
        case: case of the estimates; `all` is the mean over the cases of each run.
        target: best value of the metric.
        found: difference over the runs, with its interval.
        where: start and end of the time span that contributes most to the difference, in s since the
            run's epoch; None if there is no such span.
        stressed: largest change of either candidate's metric under changes that should not matter.
        unit: what a run is, if it is not a single run.
    """

    first: str
    second: str
    quantity: str
    case: str
    target: Target
    found: Difference
    where: tuple[float, float] | None = None
    stressed: float = 0.0
    unit: str = "run"

    @property
    def is_withheld(self) -> bool:
        """Test whether changes that should not matter move the metric by more than the difference."""
        return self.found.verdict in DIFFER and abs(self.found.more.value) < self.stressed

    @property
    def sentence(self) -> str:
        """Return the verdict in words."""
        found = self.found
        of = f" of {self.case}" if self.case else ""
        values = f"{found.second:.4g} against {found.first:.4g}"
        if isinstance(self.target, float):
            values += f", where {self.target:g} is ideal"
        if found.runs < FEWEST_RUNS:
            equal = "equal in every run; " if found.verdict == Comparison.TIE else ""
            return f"{self.quantity}{of}: {values}; {equal}{too_few(found.runs)}"
        interval = f"difference {found.more}"
        of_runs = f"{count(found.runs, self.unit)}, margin {found.margin:.3g}"
        verdict = f"{self.second} is {found.verdict} than {self.first}"
        if found.verdict == Comparison.UNDECIDED:
            verdict = f"{self.second} and {self.first} may or may not differ by more than the margin"
        elif found.verdict == Comparison.TIE:
            verdict = f"no difference beyond the margin between {self.second} and {self.first}"
        if self.is_withheld:
            return (
                f"{self.quantity}{of}: verdict withheld: {values}; {interval}: changes that should not "
                f"matter move it by up to {self.stressed:.3g}"
            )
        when = f"; most from {self.where[0]:.1f} to {self.where[1]:.1f} s" if self.where else ""
        return f"{self.quantity}{of}: {verdict}: {values}; {interval}, {of_runs}{when}"


def under_stress(paired: Sequence[Paired], verdicts: Mapping[str, Stressing]) -> list[Paired]:
    """Add to each metric the larger of the two candidates' changes under stress."""
    found = []
    for each in paired:
        key = each.quantity if each.case in ("", ALL) else f"{each.quantity}.{each.case}"
        own = [verdicts[name].moved.get(key, 0.0) for name in (each.first, each.second)]
        found.append(each._replace(stressed=max(own)))
    return found
