"""What smoothers cost beside their filters, whatever the lag; and what sliding a window of steps saves.

Whole replays from columns in memory to output streams, CPU time of all cores together, medians of turns.
The direct way, which comes back over the whole lag for each estimate, is what manifolds still take. That
both give equal estimates is asserted. Run it with `make bench`, or `python -m tests.bench smoothers`.
"""

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.inference.smoothing import smoothers
from tests.bench.timing import cpu_seconds

Row = tuple[str, str, str, str]
TARGET = 3.0
LAGS = ("500ms", "20s")
SCENARIOS = {"landmarks": {"duration_s": 300.0}, "vehicles": {"duration_s": 120.0}}


def main() -> list[Row]:
    """Milliseconds of a log, and the ratio to the filter or to the direct way."""
    return [row for scenario in SCENARIOS for row in of_scenario(scenario)]


def of_scenario(scenario: str) -> list[Row]:
    """The rows of one scenario's log."""
    sources = record_ensemble(scenario, SCENARIOS[scenario], 1, 1)
    labels = ["ekf", "smoother:ekf", *(f"smoother:ekf:lag={lag}" for lag in LAGS), "smoother:iterated"]
    ways: dict[str, Callable[[], Any]] = {
        label: partial(states_of, label, sources, is_direct=False) for label in labels
    }
    for lag in LAGS:
        label = f"smoother:ekf:lag={lag}"
        ways[f"{label}, directly"] = partial(states_of, label, sources, is_direct=True)
        for found, wanted in zip(ways[label](), ways[f"{label}, directly"](), strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-10)
    ms = {name: 1e3 * s for name, s in cpu_seconds(ways).items()}
    rows = [
        row(f"{scenario}: {label}; its filter, at most {TARGET:g} times", ms[label], ms["ekf"])
        for label in labels[1:-1]
    ]
    rows.append(row(f"{scenario}: smoother:iterated; its filter", ms["smoother:iterated"], ms["ekf"]))
    return rows + [
        row(f"{scenario}: lag={lag}; directly", ms[label], ms[f"{label}, directly"])
        for lag in LAGS
        for label in [f"smoother:ekf:lag={lag}"]
    ]


def row(what: str, ours_ms: float, theirs_ms: float) -> Row:
    return what, f"{ours_ms:.3g} ms", f"{theirs_ms:.3g} ms", f"{ours_ms / theirs_ms:.2g} times"


def states_of(label: str, sources: list[MemorySource], *, is_direct: bool) -> list[Any]:
    """Means and covariances of all estimates."""
    flat = patch.object(smoothers, "is_flat", lambda _: False) if is_direct else nullcontext()
    with flat:
        found = collect(replay(sources, bind(label, sources, {})))
    states = [each for each in found.values() if "mean" in each.stream.columns]
    return [each[name] for each in states for name in ("mean", "covariance")]
