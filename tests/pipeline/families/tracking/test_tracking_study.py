"""What studies of trackers stand on: figures of whole tracks, differences by run, claims."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fuselog.pipeline.families.tracking.study import figures_of, measure_changes
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.replay.families.tracking.judging.errors import UNREFERENCED_M, TracksAt
from fuselog.replay.judging.intervals import mean_interval


def test_figures_of_whole_tracks():
    """Track 1 follows for 5 instants, then track 2 for 4; track 9, far away, is left out.

    Half a metre off at 9 of 10 instants, one of them missed, and one switch: 100 m^2 half twice.
    """
    truths = np.zeros((1, 10, 2))
    told = []
    for instant in range(10):
        number = [1] if instant < 5 else [] if instant == 5 else [2]
        place = [[0.5, 0.0]] * len(number)
        told.append(TracksAt(np.array([*number, 9]), np.array([*place, [0.0, 900.0]])))
    figures = figures_of(told, truths, UNREFERENCED_M)
    assert (figures["tracks"], figures["track_length_s"]) == (2, pytest.approx((2.0 + 1.5) / 2))
    assert figures["trajectory_gospa_m"] == pytest.approx(np.sqrt((9 * 0.25 + 200 + 100) / 10))
    assert (figures["switches"], figures["breaks"]) == (1, 1)
    assert figures["target1_coverage"] == 0.9
    assert figures["unreferenced_targets"] == 1
    every = figures_of(told, truths)
    assert (every["tracks"], every["false_targets"]) == (3, 1)
    assert every["trajectory_gospa_m"] == pytest.approx(np.sqrt((9 * 0.25 + 200 + 100) / 10 + 200))
    assert every["idf1"] < figures["referenced_idf1"]


def test_an_interval_of_a_mean():
    """As in a table of Student's distribution: 2.776 for five values."""
    mean, low, high, *_ = mean_interval([1, 2, 3, 4, 5])
    assert (mean, high - mean, mean - low) == pytest.approx(
        (3, 2.776 * 0.7071, 2.776 * 0.7071), abs=1e-3
    )
    assert mean_interval([2.0])[0] == 2


def test_estimators_are_compared_run_by_run():
    """What one of them lacks, as a target that it never follows, has no number."""
    table = pd.DataFrame(
        {
            "estimator": ["a"] * 5 + ["b"] * 5,
            "run": [*range(5)] * 2,
            "gospa_m": [0.0] * 5 + [1, 2, 3, 4, 5],
            "target1_rmse_m": [1.0] * 5 + [np.nan] * 5,
        }
    )
    outcome = Outcome()
    measure_changes(table, [("a", "b"), ("a", "missing")], outcome, "case")
    low, high = outcome.intervals["a.change_in_gospa_m.b-case"]
    assert outcome.metrics["a.change_in_gospa_m.b-case"] == -3
    assert (low, high) == pytest.approx((-3 - 2.776 * 0.7071, -3 + 2.776 * 0.7071), abs=1e-3)
    assert np.isnan(outcome.metrics["a.change_in_target1_rmse_m.b-case"])
    assert len(outcome.metrics) == 2


@pytest.mark.paper
def test_crossing_targets(tmp_path: Path):
    """Two cases of two runs: tables by case, the same ways of the targets in both; claims need all."""
    over = {
        "runs": 2,
        "estimators": {
            "hungarian": {"kind": "tracker:hungarian", "birth_distance_m": 0.0, "birth_sigma_mps": 8.0}
        },
        "options": {"clutter_per_scan": [1.0], "detection_probability": [0.95, 0.5]},
    }
    name, experiment = load_experiment("crossing", {"duration_s": 30}, over)
    result = run_experiment(name, experiment, tmp_path / "out", logs=0)
    seen, missed = (
        result.metrics[f"hungarian.gospa_m.clutter-1-detection-{share}"] for share in (95, 50)
    )
    assert isinstance(seen, float)
    assert isinstance(missed, float)
    assert 0.0 < seen < missed
    assert result.claims == []
    table = pd.read_csv(tmp_path / "out" / "tables" / "runs.csv")
    assert len(table) == 4
    assert set(table["detection_probability"]) == {0.95, 0.5}
