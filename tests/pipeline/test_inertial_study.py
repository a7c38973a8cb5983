"""The BROAD experiment on the trials at hand, and on what is no trial."""

import pytest

from pipeline.experiment import load_experiment, run_experiment
from recorders.errors import BadInput


def test_broad_reaches_its_target(real_data, tmp_path):
    """No more than 3.5 degrees on average; per trial the numbers that the filter's own runs gave."""
    name, experiment = load_experiment("broad", {}, {})
    result = run_experiment(name, experiment, tmp_path / "out", data=real_data / "broad", logs=0)
    found = {key: value for key, value in result.metrics.items() if ".movement_rmse_deg" in key}
    per_trial = [found[key] for key in sorted(found) if key.startswith("bingham.movement_rmse_deg.")]
    assert per_trial == pytest.approx([1.664, 1.889, 2.406], abs=0.002)
    assert found["bingham.movement_rmse_deg"] <= 3.5
    assert found["gyro.movement_rmse_deg"] > found["gyro-minus-bias.movement_rmse_deg"]
    assert [claim.verdict for claim in result.claims] == ["confirmed", "confirmed"]
    assert (tmp_path / "out" / "timeline.rrd").stat().st_size > 0


def test_a_folder_without_trials_is_refused(tmp_path):
    name, experiment = load_experiment("broad", {}, {})
    with pytest.raises(BadInput, match=r"no \.hdf5 files"):
        run_experiment(name, experiment, tmp_path / "out", data=tmp_path)
