"""Effects of changes that should not matter, summed over runs: counts and means."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from fuselog.pipeline.output.alarms import Stressing, Verdict
from fuselog.pipeline.output.words import count
from fuselog.pipeline.stressing.verdicts import ORDER, Stressed

# One in this many runs may be worse by chance: 1 in 1,000 lost messages has a larger effect than
# expected.
RARE_RUNS = 100


@dataclass
class StressSums:
    """The effects of stress on one estimator, summed over runs.

    Attributes:
        estimator: the estimator's label.
        verdicts: the number of runs with each verdict.
        worst: the largest A of each verdict, with the sentences of that run.
        moved: the sum of a metric's changes and the number of runs, by change and by (case, metric).
    """

    estimator: str
    verdicts: Counter[Verdict] = field(default_factory=Counter)
    worst: dict[Verdict, tuple[float, list[str]]] = field(default_factory=dict)
    moved: dict[str, dict[tuple[str, str], tuple[float, int]]] = field(default_factory=dict)

    def add(self, stressed: Stressed) -> None:
        """Add a run."""
        largest = max((each.largest for each in stressed.tried.values()), default=0.0)
        moved = {
            name: {key: (by, 1) for key, by in each.moved.items()}
            for name, each in stressed.tried.items()
        }
        own = {stressed.worst: (largest, stressed.sentences)}
        self.merge(StressSums(self.estimator, Counter([stressed.worst]), own, moved))

    def merge(self, other: "StressSums") -> None:
        """Add the sums of later runs."""
        self.verdicts += other.verdicts
        for verdict, (largest, sentences) in other.worst.items():
            if verdict not in self.worst or largest > self.worst[verdict][0]:
                self.worst[verdict] = largest, sentences
        for name, of in other.moved.items():
            own = self.moved.setdefault(name, {})
            for key, (by, runs) in of.items():
                before = own.get(key, (0.0, 0))
                own[key] = before[0] + by, before[1] + runs

    @property
    def summary(self) -> Stressing:
        """Return the verdict over all runs."""
        runs = self.verdicts.total()
        often = [each for each, own in self.verdicts.items() if own * RARE_RUNS > runs]
        verdict = max(often, key=ORDER.index)
        words = [*self.worst[verdict][1]]
        if runs > 1:
            counts = sorted(self.verdicts.items(), key=lambda each: -ORDER.index(each[0]))
            shares = ", ".join(f"{each} in {own}" for each, own in counts)
            words = [f"{self.estimator} over {count(runs, 'run')}: {shares}", *words]
        return Stressing(self.estimator, verdict, words, self._largest)

    @property
    def _largest(self) -> dict[str, float]:
        """Return the largest change of each metric's mean, by case and over all cases."""
        largest: dict[str, float] = {}
        for of in self.moved.values():
            sums: dict[str, tuple[float, int]] = {}
            for (case, quantity), (by, runs) in of.items():
                for key in dict.fromkeys((quantity, f"{quantity}.{case}" if case else quantity)):
                    before = sums.get(key, (0.0, 0))
                    sums[key] = before[0] + by, before[1] + runs
            for key, (by, runs) in sums.items():
                largest[key] = max(largest.get(key, 0.0), abs(by) / runs)
        return largest


def verdicts_of(stressed: Iterable[Stressed]) -> dict[str, Stressing]:
    """Compute the verdict on each estimator over its runs."""
    sums: dict[str, StressSums] = {}
    for each in stressed:
        sums.setdefault(each.estimator, StressSums(each.estimator)).add(each)
    return {label: each.summary for label, each in sums.items()}
