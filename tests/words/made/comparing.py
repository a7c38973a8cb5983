"""Sentences of `fuselog compare` and `fuselog check`, on either side of what decides them."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

from fuselog.pipeline.checking.discrepancies import Discrepancy
from fuselog.pipeline.comparing.comparing import Paired
from fuselog.pipeline.comparing.groups import unlike_runs
from fuselog.replay.judging.errors.differences import Difference, Target, paired_difference
from fuselog.replay.judging.intervals import Interval

EIGHT = np.array([1.0, 1.2, 0.9, 1.1, 1.05, 0.95, 1.15, 0.85])


def verdicts() -> Iterator[str]:
    """Verdicts: the second is half of the first, one and a half times it, much like it, and the same."""
    for target in ("low", "high", 1.0, 0.5, None):
        for second in (0.5 * EIGHT, 1.5 * EIGHT, EIGHT[::-1] * 1.02, EIGHT + 0.001, EIGHT):
            found = paired_difference(EIGHT, second, target, 0.02)
            yield Paired("ekf", "ukf", "some_quantity", "robot1", target, found).sentence
    crossing: Target = 1.0
    found = paired_difference(EIGHT - 0.5, EIGHT + 0.5, crossing, 0.02)
    yield Paired("ekf", "ukf", "nis_per_component", "", crossing, found).sentence


def few_runs() -> Iterator[str]:
    """Fewer runs than an interval takes, and when a difference is."""
    for runs in (4, 5):
        found = paired_difference(EIGHT[:runs], 2.0 * EIGHT[:runs], "low", 0.02, scale=100.0)
        yield Paired("ekf", "ukf", "log_likelihood", "", "high", found).sentence
    found = Difference(1.0, 2.0, Interval(1.0, 0.9, 1.1), 0.02, "worse", 1.0, 7)
    yield Paired("a", "b", "rmse_m", "x", "low", found, (1.25, 2.5)).sentence


def unlike() -> Iterator[str]:
    """What two sides do not share."""
    first = _side("a", "12345", {"1": "x", "2": "y"}, {"rate": 1, "gate": 0.99})
    yield from unlike_runs(first, _side("b", "12345", {"1": "x", "2": "y"}, {"rate": 1, "gate": 0.99}))
    yield from unlike_runs(first, _side("b", "5", {}, {"rate": 2}))
    yield from unlike_runs(_side("b", "126", {}, {}), first)
    yield from unlike_runs(
        first, _side("b", "12345", {"1": "z", "2": "y"}, {str(n): n for n in range(9)})
    )


def _side(name: str, runs: str, truths: dict[str, str], settings: dict[str, Any]) -> Any:
    return SimpleNamespace(
        name=name, label="ekf", rows={"run": [*runs, *runs]}, truths=truths, settings=settings
    )


def discrepancies() -> Iterator[str]:
    """What is not as in a golden."""
    missing = Discrepancy("run.mcap", "/estimates/ekf/pose", "mean", np.inf, 1e-12)
    apart = missing._replace(apart=3e-7)
    row = apart._replace(row=17, before=1.5, after=1.25)
    yield missing.sentence
    yield apart.sentence
    yield row.sentence
    yield row._replace(component="x_m", stamp_ns=4_000_000_000).sentence
    yield Discrepancy("", "metric", "ekf.nees", 0.5, 1e-6).sentence


COMPARED = (verdicts, few_runs, unlike)
CHECKED = (discrepancies,)
