"""The BROAD experiment on the trials at hand, and on what is no trial."""

import numpy as np
import pytest

from fuselog.pipeline.runs.ensemble import RunGroup, replay_parts
from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording
from fuselog.replay.engine.streams.sources import memory_source

pytestmark = pytest.mark.paper


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


def test_an_estimator_without_estimates_is_told():
    """Force and field are parallel: there is no attitude to start from, and no number is one."""
    count = 3000
    samples = make_stream(
        "/trial/inertial",
        schemas.INERTIAL_SAMPLE,
        SIMULATION_EPOCH_NS + 10_000_000 * np.arange(count),
        specific_force_mps2=np.tile([0.0, 0.0, 9.8], (count, 1)),
        turn_rate_radps=np.zeros((count, 3)),
        magnetic_field_ut=np.tile([0.0, 0.0, 40.0], (count, 1)),
    )
    source = memory_source(Recording([samples]), RunMetadata("broad"))
    judge = replay_parts([RunGroup([source])], {"bingham-inertial": {}}, gap_limit_s=1).judge
    at_s = f"{SIMULATION_EPOCH_NS * 1e-9:.3f} s"
    assert judge.failures == [
        f"{source.name}: bingham-inertial trial failed at {at_s}: there is no estimate"
    ]
