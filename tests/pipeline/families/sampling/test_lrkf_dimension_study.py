"""How many samples pay: exact moments, and which verdicts intervals give."""

import numpy as np
import pandas as pd
import pytest

from fuselog.pipeline.families.sampling.lrkf_dimension import (
    Options,
    Waves,
    exact,
    measure_drives,
    moment_errors,
    sampled,
    samplings_of,
)
from fuselog.pipeline.output.claims import decide
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.experiment import Experiment, load_experiment, run_experiment
from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.sampling import Samples

pytestmark = pytest.mark.usefixtures("blank_figures")


def test_moments_of_waves_are_those_of_a_fine_quadrature():
    """Gauss-Hermite points in the plane, of which 40 x 40 are exact to rounding."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    points = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
    grid = Samples(points, np.outer(weights, weights).ravel() / weights.sum() ** 2)
    waves = Waves(np.array([[0.8, -0.6], [0.0, 1.3], [1.0, 0.1]]), np.array([0.3, -2.0, 1.0]))
    for found, wanted in zip(sampled(waves, grid), exact(waves), strict=True):
        assert found == pytest.approx(wanted, abs=1e-13)


def samplings(*kinds: str):
    estimators = {kind: {"kind": f"lrkf:{kind}"} for kind in kinds}
    return samplings_of(Experiment(title="t", estimators={"ekf": {}, **estimators}))


def test_samplings_are_compared_on_the_same_functions():
    """So that the UKF's set is as good as that of three points on each axis, which it is."""
    options = Options(dimensions=(3,), functions=2)
    table = moment_errors(samplings("ukf", "gf-3", "rukf-1"), options, seed=1)
    wide = table.pivot_table("mean_error", ["direction", "function"], "estimator")
    assert wide["ukf"].to_numpy() == pytest.approx(wide["gf-3"].to_numpy(), rel=1e-9)
    assert not np.isclose(wide["ukf"], wide["rukf-1"]).any()
    assert set(table["samples"]) == {7}
    again = moment_errors(samplings("ukf", "gf-3", "rukf-1"), options, seed=1)
    pd.testing.assert_frame_equal(table, again)


def test_a_share_that_pays_has_its_whole_interval_beyond_it():
    """2 % less in every run pays; 2 % less on average of runs that differ widely does not."""

    def verdicts(ratios):
        rows = [("ukf", run, 1.0, 1.0, 7) for run in range(5)]
        rows += [("s2kf-100", run, ratio, 1.0, 100) for run, ratio in enumerate(ratios)]
        columns = ["estimator", "run", "position_rmse_m", "nees_per_component", "samples"]
        table = pd.DataFrame(rows, columns=columns).assign(drive="d")
        table = pd.concat([table, table[table["estimator"] == "ukf"].assign(estimator="ekf")])
        outcome = Outcome()
        measure_drives(table, Options(), outcome)
        _, experiment = load_experiment("lrkf-dimension", {}, {})
        claims = decide(experiment.claims, outcome.metrics, outcome.intervals, {})
        [found] = [each.verdict for each in claims if each.claim.startswith("d: 100 LCD samples")]
        return found, outcome.metrics["lrkf.samples_that_pay.d"]

    assert verdicts([0.98, 0.981, 0.979, 0.98, 0.98]) == ("confirmed", 100.0)
    assert verdicts([0.7, 1.2, 0.8, 1.22, 0.98]) == ("inconclusive", 100.0)
    assert verdicts([0.995, 0.994, 0.995, 0.996, 0.995]) == ("refuted", 7.0)


def test_the_study_runs_without_drives_and_asks_for_samplings(tmp_path):
    """Claims need their samplings alone."""
    name, experiment = load_experiment("lrkf-dimension", {}, {})
    options = {"dimensions": [2, 3], "functions": 2}
    experiment = experiment.model_copy(update={"options": options})
    result = run_experiment(name, experiment, tmp_path / "out")
    assert len(result.claims) == 8
    assert result.metrics["s2kf-100.mean_error.n3-axes"] < result.metrics["gf-25.mean_error.n3-axes"]
    none = experiment.model_copy(update={"estimators": {"ekf": {}}})
    with pytest.raises(BadInput, match="give estimators such as lrkf:ukf"):
        run_experiment(name, none, tmp_path / "none")


def test_a_drive_is_judged_by_its_position(tmp_path):
    """Run by run and estimator by estimator; the extended filter has no samples."""
    drives = {"landmarks": {"scenario": "landmarks", "parameters": {"duration_s": 2.0}}}
    experiment = Experiment(
        title="t",
        study="lrkf-dimension",
        runs=2,
        estimators={"ekf": {}, "ukf": {"kind": "lrkf:ukf"}},
        options={"dimensions": [2], "functions": 2, "drives": drives},
    )
    result = run_experiment("t", experiment, tmp_path / "out")
    assert result.metrics["ukf.samples.landmarks"] == 7.0
    assert "ekf.samples.landmarks" not in result.metrics
    assert 0.0 < result.metrics["ekf.position_rmse_m.landmarks"] < 0.3
    assert (tmp_path / "out" / "landmarks" / "timeline.rrd").exists()
