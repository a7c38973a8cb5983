"""The benchmark's errors, and one BROAD trial through a filter and a common method."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fuselog.pipeline.families.directional.orientation import error_angles
from fuselog.pipeline.output.claims import decide
from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.recorders.errors import BadInput
from tests.replay.timeline.test_timeline import read

pytestmark = pytest.mark.usefixtures("blank_figures")

TRIAL = "07_undisturbed_fast_rotation_B"


def quaternion(angles_deg: list[float]) -> np.ndarray:
    return Rotation.from_euler("ZX", angles_deg, degrees=True).as_quat(scalar_first=True)


def test_heading_and_inclination_are_the_parts_of_an_error():
    """In the axes of the earth, whatever the true orientation; -q is the same orientation as q."""
    truth = Rotation.random(5, random_state=1).as_quat(scalar_first=True)
    turned = Rotation.from_quat(quaternion([-12.0, 5.0]), scalar_first=True)
    estimate = (turned * Rotation.from_quat(truth, scalar_first=True)).as_quat(scalar_first=True)
    for sign in (1.0, -1.0):
        found = error_angles(sign * estimate, truth)
        np.testing.assert_allclose(np.degrees(found.heading), 12.0)
        np.testing.assert_allclose(np.degrees(found.inclination), 5.0)
        np.testing.assert_allclose(np.degrees(found.total), np.degrees(turned.magnitude()))


@pytest.mark.paper
def test_a_trial_by_a_filter_and_by_madgwick(real_data, tmp_path):
    """Errors as first measured; a magnet is told of, and costs only the common method."""
    name, experiment = load_experiment("broad-peers", {}, {})
    few = {label: experiment.estimators[label] for label in ("ekf", "madgwick")}
    experiment = experiment.model_copy(update={"estimators": few})
    data = real_data / "broad" / f"{TRIAL}.hdf5"
    result = run_experiment(name, experiment, tmp_path / "out", data=data, logs=0)
    found = {key: value for key, value in result.metrics.items() if "total" in key}
    assert found["ekf.total_rmse_deg.all"] == pytest.approx(2.31, abs=0.02)
    assert found["ekf.total_rmse_deg.fast"] == found["ekf.total_rmse_deg.all"]
    assert "ekf.total_rmse_deg.slow" not in found
    assert found["ekf.total_rmse_deg.magnet-added"] < found["ekf.total_rmse_deg.all"] + 1.0
    assert found["madgwick.total_rmse_deg.magnet-added"] > 10.0
    assert {claim.verdict for claim in result.claims} == {"no verdict"}, "they are of three trials"
    claims = decide(experiment.claims, result.metrics, result.intervals, {})
    verdicts = {claim.claim: claim.verdict for claim in claims}
    [noticed] = [claim.verdict for claim in claims if claim.claim.startswith("ekf detects")]
    assert noticed == "confirmed"
    assert verdicts["ekf has a smaller error than madgwick"] == "inconclusive", "one trial"
    events = read(tmp_path / "out" / "magnet-added" / "timeline.rrd")[f"/events/{TRIAL}/ekf"]
    texts = [text for (text,) in events["TextLog:text"] if "field disturbed" in text]
    assert "s, ekf: magnetic field disturbed for 20 s, by up to " in texts[0]
    assert len(texts) == 2
    spans = (tmp_path / "out" / "tables" / "disturbances.csv").read_text()
    assert spans.count("magnet-added") == 2
    assert spans.count(f"{TRIAL},all") == 0


def test_what_is_no_trial_is_refused(tmp_path):
    name, experiment = load_experiment("broad-peers", {}, {})
    with pytest.raises(BadInput, match=r"no \.hdf5 files; give a BROAD trial"):
        run_experiment(name, experiment, tmp_path / "out", data=tmp_path)
    name, experiment = load_experiment("broad-peers", {}, {"options": {"estimator": "kalman"}})
    with pytest.raises(BadInput, match=r"options\.estimator: no estimator 'kalman'"):
        run_experiment(name, experiment, tmp_path / "out", data=tmp_path)
