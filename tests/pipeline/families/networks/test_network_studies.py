"""The experiments on sets and networks, run small: their numbers, their verdicts, their files."""

import pytest

from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.recorders.errors import BadInput
from tests.claims.few_runs import as_of_all

pytestmark = [pytest.mark.paper, pytest.mark.usefixtures("blank_figures")]


def verdicts(result):
    return [claim.verdict for claim in as_of_all(result.experiment, vars(result))]


def test_the_room(tmp_path):
    """Its metrics, verdicts and files; tests/replay compares more runs with the sheet."""
    name, experiment = load_experiment("ispace", {"runs": 4}, {})
    result = run_experiment(name, experiment, tmp_path / "out", logs=1)
    found = result.metrics
    assert found["ci-trace.rmse_ratio"] == pytest.approx(1.075, abs=0.05)
    assert found["ci-trace.nees"] < 4.4
    assert found["naive.nees"] > 1000
    # at first a node knows little but its own measurement
    assert found["ci-trace.rmse_ratio.all-steps"] > found["ci-trace.rmse_ratio"]
    # 100 messages of stamp, mean and triangle; split CI sends its independent part as well
    assert found["ci-trace.load_bytes_per_link"] == 100 * 8 * (1 + 4 + 10)
    assert found["split-ci.load_bytes_per_link"] == 100 * 8 * (1 + 4 + 20)
    assert found["alone.load_bytes_per_link"] == 0
    assert verdicts(result).count("refuted") == 2
    assert (tmp_path / "out" / "timeline.rrd").stat().st_size > 0


def test_a_run_that_ends_before_it_is_judged_is_refused(tmp_path):
    name, experiment = load_experiment("ispace", {"runs": 1, "steps": 5}, {})
    rules = {"ci-trace": experiment.estimators["ci-trace"]}
    experiment = experiment.model_copy(update={"estimators": rules})
    with pytest.raises(BadInput, match="record more steps"):
        run_experiment(name, experiment, tmp_path / "out")


def test_sets_of_section_v_and_of_random_scenes(tmp_path):
    name, experiment = load_experiment("relative-bearings", {"runs": 2}, {})
    result = run_experiment(name, experiment, tmp_path / "out", logs=1)
    found = result.metrics
    for shape, area in (("exact", 0.01464), ("box", 0.02904), ("l4", 0.0309), ("l8", 0.0197)):
        assert found[f"{shape}.area_m2.section-v"] == pytest.approx(area, rel=0.03)
        assert found[f"{shape}.violations"] == 0
        assert found[f"{shape}.containment_share"] == 1
    assert verdicts(result)[:5] == ["confirmed"] * 4 + ["refuted"]
    assert verdicts(result)[-1] == "not reproducible"
    assert (tmp_path / "out" / "timeline.rrd").stat().st_size > 0
