"""The study of score fusion end to end on few simulated users: tables, figures, claims, timeline."""

import pandas as pd
import pytest
import rerun.chunk as rc

from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.replay.families.biometrics.verification import relative_rate_increase

pytestmark = pytest.mark.paper


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("biometrics") / "result"
    settings = {"users": 40, "low_galleries": 2, "options": {"seeds": 2, "replicates": 20}}
    settings |= {label: {"folds": 2} for label in ("qda", "knn", "hmm")}
    label, experiment = load_experiment("biometrics-simulated", settings, {"runs": 2})
    with pytest.MonkeyPatch.context() as patch:
        # each bar of each of many fusions is sent by itself
        patch.setattr("fuselog.replay.families.biometrics.timeline.UPDATES", 3)
        return folder, run_experiment(label, experiment, folder, logs=1)


def test_tables_stand_beside_the_paper_and_follow_from_the_rates(result):
    """Tables 2 to 4 by subset and fusion; Table 5 is their mean. Other matchers would differ."""
    folder, outcome = result
    factors = pd.read_parquet(folder / "tables" / "factors.parquet").set_index(["subset", "fusion"])
    row = factors.loc[("matcher-1", "knn")]
    singles = [
        outcome.metrics[f"single.identified_percent.{name}"] for name in ("face-C", "finger-left")
    ]
    assert row["paper_percent"] == 99.22
    assert row["rri"] == pytest.approx(
        relative_rate_increase(row["ours_percent"] / 100, [rate / 100 for rate in singles])[1]
    )
    increases = {
        f"{fusion}.relative_increase.{case}": of for (case, fusion), of in factors["rri"].items()
    }
    assert len(increases) > 4
    assert {key: outcome.metrics[key] for key in increases} == increases
    impact = pd.read_parquet(folder / "tables" / "impact.parquet").set_index(["fused", "fusion"])
    two = factors.loc[[("matcher-1", "knn"), ("matcher-2", "knn")], "rri"].mean()
    assert impact.loc[("two modalities", "knn"), "rri"] == pytest.approx(two)
    assert impact.loc[("one modality", "mean"), "paper_rri"] == pytest.approx(
        (0.2845 + 0.5001) / 2, abs=1e-3
    )


def test_seeds_repeat_what_draws_and_nothing_else(result):
    """A cross validation has a spread over its seeds; a rule has none to tell."""
    metrics = result[1].metrics
    assert metrics["qda.verification_rate_sd_percent.all"] >= 0
    assert not any(key.startswith("mean.verification_rate_sd") for key in metrics)


def test_claims_name_their_runs_and_the_timeline_reads_back(result):
    folder, outcome = result
    assert len(outcome.claims) == 10
    assert all("(2 runs)" in claim.ours for claim in outcome.claims[:9])
    entities = {chunk.entity_path for chunk in rc.RrdReader(str(folder / "timeline.rrd")).stream()}
    for part in ("/fusion/all/hmm/scores/genuine", "/errors/all/mean", "/matchers/all/face-C/impostor"):
        assert part in entities
    assert {path.stem for path in (folder / "figures").iterdir()} == {"det", "distributions", "roc"}
