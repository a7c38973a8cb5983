"""Robots that share positions on MRCLAM set 6: the sheet's acceptance, mode by mode."""

import numpy as np
import pytest

from pipeline.ensemble import replay_ensemble
from recorders.recording import import_run
from replay.metrics import accuracy, consistency
from replay.sources import memory_source


@pytest.fixture(scope="module")
def judged(mrclam6):
    sources = [memory_source(*import_run("mrclam", mrclam6, {}))]
    found = {}
    for mode in ("alone", "naive", "ci"):
        estimators = {mode: {"kind": f"cooperative:{mode}"}}
        errors = replay_ensemble(sources, estimators, gap_limit_s=0.2).errors
        rmse = np.array([accuracy(each)["position_rmse_m"] for each in errors])
        found[mode] = rmse, np.array([consistency(each)["position_nees"] for each in errors])
    return found


def test_ci_is_consistent_and_naive_fusion_is_not(judged):
    assert judged["ci"][1].max() <= 2.5
    assert judged["naive"][1].mean() > 2 * judged["ci"][1].mean()
    assert judged["naive"][1].min() > 4


def test_robots_without_a_map_gain_by_those_they_meet(judged):
    alone, ci = judged["alone"][0], judged["ci"][0]
    assert np.all(ci < 0.5)
    assert np.all(ci[[0, 1, 3, 4]] < 0.3 * alone[[0, 1, 3, 4]])
