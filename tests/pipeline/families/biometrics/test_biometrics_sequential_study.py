"""Verification in sequence on ratios that are calibrated by construction, and on simulated scores."""

import numpy as np
import pytest

from fuselog.pipeline.families.biometrics.sequential import Drawn, Options, wald_tests, watched
from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.recorders.errors import BadInput

pytestmark = pytest.mark.usefixtures("blank_figures")

USERS = 400
SHIFT = 2.5  # of the person's scores, which are normal: the ratio of x is SHIFT x - SHIFT^2 / 2
OPTIONS = Options(rates=[(0.01, 0.01)], watched=20, watched_probes=3000, label_ratio=4.0)


@pytest.fixture(scope="module")
def drawn() -> dict[str, Drawn]:
    rng, names = np.random.default_rng(0), ("face", "left", "right")
    scores = rng.normal(size=(len(names), USERS, USERS)) + SHIFT * np.eye(USERS)
    ratios = SHIFT * scores - 0.5 * SHIFT**2
    return {name: Drawn(of, np.arange(USERS)) for name, of in zip(names, ratios, strict=True)}


def test_stated_rates_hold_for_independent_probes_and_not_for_probes_that_are_alike(drawn):
    rows = list(wald_tests(drawn, OPTIONS, np.random.default_rng(1)))
    of = {(row["way"], row["matcher"]): row for row in rows}
    for matcher in drawn:
        assert of["independent", matcher]["false_accept"] < 0.01
        assert of["independent", matcher]["false_reject"] < 0.012
        assert of["one-identity", matcher]["false_accept"] < 0.01
        assert of["alike", matcher]["false_reject"] > 0.02
        assert of["alike", matcher]["genuine_probes"] > of["independent", matcher]["genuine_probes"]
        assert of["independent", matcher]["undecided"] == 0.0
    assert of["matchers", "all"]["false_accept"] < 0.01
    assert 0.0 < of["matchers", "all"]["undecided"] < 0.2, "three probes do not always decide"


def test_a_watched_matcher_is_quiet_until_it_fails(drawn):
    rows = list(watched(drawn, OPTIONS, np.random.default_rng(2)))
    of = {(row["fault"], row["matcher"]): row for row in rows}
    for matcher in drawn:
        assert of["none", matcher]["probes"] > 1000.0
        assert of["misses", matcher]["probes"] < 15.0
        assert of["accepts", matcher]["probes"] < 15.0
        assert of["misses", matcher]["probes"] < of["drifts", matcher]["probes"] < 100.0
        assert of["drifts", matcher]["silent"] == 0.0


def test_matchers_that_are_never_sure_watch_nothing(drawn):
    unsure = OPTIONS.model_copy(update={"label_ratio": 100.0})
    with pytest.raises(BadInput, match=r"can label only 0 of 60000 probes to monitor face; lower"):
        list(watched(drawn, unsure, np.random.default_rng(2)))


@pytest.mark.paper
def test_simulated_scores_give_every_claim_and_need_ratios_of_all_pairs(tmp_path, monkeypatch):
    # each bar of each of many fusions is sent by itself
    monkeypatch.setattr("fuselog.replay.families.biometrics.timeline.UPDATES", 3)
    name, experiment = load_experiment(
        "biometrics-sequential-simulated",
        {
            "users": 40,
            "ratio": {"genuine_components": 1, "impostor_components": 1, "iterations": 2, "folds": 2},
        },
        {"options": {"sequences": 50, "replicates": 20, "watched": 4, "watched_probes": 200}},
    )
    result = run_experiment(name, experiment, tmp_path / "a", logs=0)
    assert len(result.claims) == 2 * 7 + 2 + 4
    single = experiment.model_copy(
        update={"estimators": {"mean": {"kind": "score-rule", "subsets": ["face-C", "face-G"]}}}
    )
    with pytest.raises(BadInput, match="needs log-likelihood ratios of all pairs"):
        run_experiment(name, single, tmp_path / "c", logs=0)
