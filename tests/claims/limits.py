"""Where each claim changes its verdict: made metrics, moved away from those that are kept.

A claim is decided by what it reads: an estimator's quantity, in one case or several. That is multiplied
by a factor while all else stays, and where the verdict changes is found: a limit, with a verdict on
either side.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

from fuselog.pipeline.output.claims import Claim, StatedClaim, _combinations, _decided, _named
from fuselog.pipeline.output.expressions import Values
from fuselog.pipeline.output.numbers import exactly
from fuselog.pipeline.output.results import MetricValue, split_metric
from fuselog.pipeline.runs.experiment import Study, numbers_of
from fuselog.pipeline.runs.inputs import shipped
from fuselog.recorders.parameters import build
from fuselog.recorders.registry import load
from tests.claims import pages

MOVES = (-3.0, 0.0, 0.1, 0.5, 0.9, 1.0, 1.1, 2.0, 10.0, 100.0)
NEAR = (0.99, 1.01)  # of what it may equal
MOST = 3  # groups of metrics that are moved
HALVINGS = 14
_WORDS = ("sentence", "paper", "ours", "why", "unless")
WIDTH = 0.05  # of a moved metric's interval, where a claim needs one
# Groups of metrics, from the smallest on: an estimator's quantity, a quantity, and all.
WIDER: tuple[Callable[[str], str], ...] = (
    lambda key: "{1} of {0}".format(*split_metric(key)),
    lambda key: split_metric(key)[1],
    lambda _: "all that is read",
)


class Limit(NamedTuple):
    """Where a verdict changes: what is moved, its first metric's value there, the verdicts around it.

    `keys` are the metrics that are moved, `width` is that of their intervals.
    """

    moved: str
    at: float
    below: str
    above: str
    keys: Sequence[str]
    width: float


class _Seen(dict[str, MetricValue]):
    """Metrics that remember which of them were read."""

    read: dict[str, None]

    def __getitem__(self, key: str) -> MetricValue:
        self.read[key] = None
        return super().__getitem__(key)


class Made:
    """A claim of one thing, such as one robot, and the metrics and numbers that it is decided by."""

    def __init__(
        self,
        experiment: str,
        claim: StatedClaim,
        metrics: Mapping[str, MetricValue],
        numbers: Mapping[str, float],
    ) -> None:
        seen = _Seen(metrics)
        seen.read = {}
        self.experiment, self.claim = experiment, claim
        self._numbers = {name: exactly(number) for name, number in numbers.items()}
        # with a reason of its own, so that none is made of the numbers
        self._bare = claim.model_copy(update=dict.fromkeys(_WORDS, "") | {"why": "-"})
        self.metrics: Mapping[str, MetricValue] = seen
        self.decided(seen)
        self.metrics = {key: metrics[key] for key in seen.read}

    def decided(
        self, metrics: Mapping[str, Any], intervals: Mapping[str, Sequence[float | None]] | None = None
    ) -> Claim | None:
        """The claim by these metrics and intervals; None where it is left out."""
        return _decided(self.claim, Values(metrics, intervals or {}, self._numbers))

    @property
    def read(self) -> list[str]:
        """The metrics that it reads and that are numbers, in their order."""
        return [key for key, value in self.metrics.items() if value is not None]

    def with_moved(
        self, keys: Sequence[str], factor: float, width: float = 0.0, claim: StatedClaim | None = None
    ) -> Claim | None:
        """The claim with some metrics times a factor, whose intervals have this relative half width."""
        moved = {key: _times(self.metrics[key], factor) for key in keys}
        ends = {
            key: (at - abs(at) * width, at + abs(at) * width)
            for key, at in moved.items()
            if width and isinstance(at, int | float)
        }
        return _decided(claim or self.claim, Values({**self.metrics, **moved}, ends, self._numbers))

    def limits(self, width: float = 0.0) -> list[Limit]:
        """All limits, by the smallest groups of metrics that have one."""
        for name_of in WIDER:
            groups: dict[Any, list[str]] = {}
            for key in self.read:
                groups.setdefault(name_of(key), []).append(key)
            own = [self._limits_of(name, keys, width) for name, keys in [*groups.items()][:MOST]]
            if found := [limit for limits in own for limit in limits]:
                return found
        return [] if width else self.limits(WIDTH)

    def _limits_of(self, name: str, keys: Sequence[str], width: float) -> Iterator[Limit]:
        first = _first(self.metrics[keys[0]])
        factors = sorted({*MOVES, *self._equal_to(first)})
        verdicts = [self._verdict(keys, factor, width) for factor in factors]
        for low, high, below, above in zip(factors, factors[1:], verdicts, verdicts[1:], strict=False):
            if below != above:
                for _ in range(HALVINGS):
                    middle = 0.5 * (low + high)
                    is_below = self._verdict(keys, middle, width) == below
                    low, high = (middle, high) if is_below else (low, middle)
                sides = (below, above) if first >= 0.0 else (above, below)
                yield Limit(name, _times(first, high), *sides, keys, width)

    def _equal_to(self, value: float) -> Iterator[float]:
        """Factors by which a metric is what else is read, or is named in the comparison, or near it."""
        stated = [self.claim.holds, self.claim.reproducible, *map(str, self.claim.given.values())]
        others = [_first(self.metrics[key]) for key in self.read[:MOST]]
        others += [
            float(each) for each in re.findall(r"(?<![\w.\[])\d+\.?\d*(?:e-?\d+)?", " ".join(stated))
        ]
        for other in others if value else ():
            yield from (near * abs(other / value) for near in (1.0, *NEAR))
            yield -abs(other / value)

    def _verdict(self, keys: Sequence[str], factor: float, width: float) -> str:
        """By the comparison alone: words take a quarter of the time and decide nothing."""
        found = self.with_moved(keys, factor, width, self._bare)
        return found.verdict if found else "left out"


def _first(value: MetricValue) -> float:
    while isinstance(value, list):
        value = value[0]
    return float(value or 0.0)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, list):
        return [_times(each, factor) for each in value]
    return None if value is None else factor * value if value else factor - 1.0


@cache
def all_limits() -> list[tuple[Made, list[Limit]]]:
    """Every shipped claim with its limits."""
    return [(made, made.limits() if made.claim.holds else []) for made in made_claims()]


def made_claims() -> Iterator[Made]:
    """Every shipped claim, of the first thing that it is of; where these are words, of the last too."""
    for name in shipped("experiments"):
        experiment = pages.as_shipped(name)
        kept = pages.stored()[name]
        study = load("studies", experiment.study, Study)
        numbers = numbers_of(experiment, build(study.options, experiment.options, name))
        for claim in experiment.claims:
            each = list(_combinations(claim.each, kept.metrics))
            has_words = any(isinstance(of, list) for of in claim.each.values())
            for meant in each[:1] + (each[1:][-1:] if has_words else []):
                one = _named(claim, meant).model_copy(update={"each": {}, "recording": ""})
                made = Made(name, one, kept.metrics, numbers)
                if made.decided(kept.metrics):
                    yield made
