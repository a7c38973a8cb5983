"""Guaranteed sets over time as an experiment: bounds from the other robots, verdicts, refusals."""

import numpy as np
import pytest

from fuselog.pipeline.families.sets.error_bounds import BoundOptions, state_bounds
from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.recorders.errors import BadInput
from tests.claims.few_runs import as_of_all

pytestmark = pytest.mark.usefixtures("blank_figures")

SHORT = {"duration_s": 12.0, "runs": 1, "robots": 2, "landmarks": 5}


def test_bounds_are_those_of_the_other_robots():
    """What one robot's channels state depends on the others alone."""
    parameters = {
        "duration_s": 30.0,
        "robots": 2,
        "forward_noise_density": 0.0,
        "turn_noise_density": 0.0,
    }
    [source] = record_ensemble("landmarks", parameters, 1, 1)
    # the truth of robot 2 is 1 % farther along than its odometry says
    truth = source.streams["/robot2/truth"]
    truth["state"][:, :2] += 0.01 * (truth["state"][:, :2] - truth["state"][0, :2])
    [stated] = state_bounds([source], BoundOptions(), 0.2)
    far, near = (stated.streams[f"/robot{robot}/odometry"].metadata for robot in (1, 2))
    assert float(near["position_error_m"]) < 1e-6
    assert float(far["position_error_m"]) == pytest.approx(1.2 * 0.01 * 0.6 * 2.0, rel=0.2)
    assert float(far["position_error_mps"]) > 100 * float(near["position_error_mps"])
    assert "position_error_m" not in source.streams["/robot1/odometry"].metadata
    bearings = stated.streams["/robot2/range_bearing"].metadata
    sigma_rad = 0.02
    # the share .999 of a normal distribution is within 3.29 standard deviations
    assert float(bearings["bearing_bound_rad"]) == pytest.approx(3.29 * sigma_rad, rel=0.3)
    assert float(bearings["bound_rad"]) == pytest.approx(3.29 * np.sqrt(2) * sigma_rad, rel=0.3)


@pytest.mark.paper
def test_the_study_guarantees_and_refuses(tmp_path):
    name, experiment = load_experiment("set-filter", SHORT, {})
    result = run_experiment(name, experiment, tmp_path / "out", logs=1)
    found = result.metrics
    assert as_of_all(name, vars(result))[0].verdict == "confirmed"
    for robot in ("robot1", "robot2"):
        assert found[f"filter.violations.{robot}"] == 0
        assert found[f"filter.guaranteed_share.{robot}"] > 0.5
        assert found[f"filter-l8.area_median_m2.{robot}"] >= found[f"filter.area_median_m2.{robot}"]
    assert (tmp_path / "out" / "timeline.rrd").stat().st_size > 0
    _, alone = load_experiment("set-filter", {**SHORT, "robots": 1}, {})
    with pytest.raises(BadInput, match="at least two robots"):
        run_experiment(name, alone, tmp_path / "alone")
