"""The studies of ranges: published numbers found again, windows, and what is wrong with a folder."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.families.ranging import uwb_outdoor, uwb_pose
from fuselog.pipeline.families.ranging.study import Recording, Replayed, mean_nis
from fuselog.pipeline.families.ranging.uwb_outdoor import Window, printed, published_rmse, scored_truth
from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Stream, make_stream
from fuselog.recorders.recording import import_run
from fuselog.replay.engine.streams.sources import memory_source

pytestmark = pytest.mark.usefixtures("blank_figures", "no_timelines")


@pytest.fixture
def no_timelines(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is drawn of these recordings is looked at in tests/replay/timeline."""
    monkeypatch.setattr(Runner, "draw", lambda *_: None)


CASES = {
    "Trajectory_A/Case_1": ((51.625, 191.375), {"LS": (1.0384, 1.5735), "ESKF": (1.1158, None)}),
    "Trajectory_B/Case_3": ((56.875, 149.625), {"LS": (0.5217, 0.7938), "ESKF": (0.6003, None)}),
}


@pytest.mark.parametrize("case", CASES)
def test_published_errors_are_found_again_to_four_digits(navigation: Path, case: str) -> None:
    """In the sheet's window, which is found from the path."""
    folder, (span_s, published) = navigation / "uwb_outdoor" / "LOS" / case, CASES[case]
    source = memory_source(*import_run("table", folder, {"mapping": "uwb-outdoor"}))
    options = load_experiment("uwb-outdoor", {}, {})[1].options["windows"]
    window = Window.model_validate(options[case.partition("/")[0]])
    of = Replayed(Recording(case, folder), source, {})
    truth, begin_ns, end_ns = scored_truth(of, window, 0.5)
    first_ns = source.streams["/truth"].publish_time_ns[0]
    assert np.array([begin_ns, end_ns]) - first_ns == pytest.approx(np.array(span_s) * 1e9, abs=1e6)
    for track, (plane, space) in published.items():
        found = published_rmse(of, track, truth, begin_ns, end_ns)
        assert found[0] == pytest.approx(plane, abs=5e-5)
        assert space is None or found[1] == pytest.approx(space, abs=5e-5)
    assert printed(folder)["LS_2d"] == pytest.approx(published["LS"][0], abs=5e-5)
    elsewhere = Window.model_validate({"begin": {"x_above_m": 1e3}})
    with pytest.raises(BadInput, match="does not cross the window; set options"):
        scored_truth(of, elsewhere, 0.5)


def test_folders_without_a_recording_are_refused(navigation: Path, tmp_path: Path) -> None:
    for name, wanted in (("uwb-pose", "UWB"), ("uwb-outdoor", "trajectory.csv")):
        _, experiment = load_experiment(name, {}, {})
        with pytest.raises(BadInput, match=rf"has no {wanted}.*; give the recording's folder"):
            run_experiment(name, experiment, tmp_path / "out", data=tmp_path)
    shutil.copy(navigation / "uwb_lias" / "UWB_dynamic_exp_mid.csv", tmp_path)
    _, experiment = load_experiment("uwb-pose", {}, {})
    with pytest.raises(BadInput, match=r"motion_capture_dynamic_exp_mid.csv is missing in its folder"):
        run_experiment("uwb-pose", experiment, tmp_path / "out", data=tmp_path)


# experiment, estimator, recording: figures of the sheet, and within what share of them
POSE = "dynamic_exp_mid"
TARGETS = {
    "biased": {"position_rmse_m": 0.154, "heading_rmse_deg": 8.45, "position_spread_m": 0.139}
    | {"heading_spread_deg": 4.7, "nis": 2.99, "nees": 129.0},
    "ekf": {"position_rmse_m": 0.0758, "heading_rmse_deg": 8.40, "position_spread_m": 0.0416}
    | {"heading_spread_deg": 4.65, "nis": 0.61, "nees": 36.0},
    "cautious": {"position_rmse_m": 0.0755, "heading_rmse_deg": 8.35, "position_spread_m": 0.0412}
    | {"heading_spread_deg": 4.56, "nis": 0.07, "nees": 6.5},
}


@pytest.mark.paper
def test_the_sheets_table_of_poses(navigation: Path, tmp_path: Path) -> None:
    name, experiment = load_experiment("uwb-pose", {}, {})
    chosen = {label: experiment.estimators[label] for label in TARGETS}
    experiment = experiment.model_copy(update={"estimators": chosen})
    result = run_experiment(name, experiment, tmp_path / "out", data=navigation, logs=0)
    for label, figures in TARGETS.items():
        for quantity, value in figures.items():
            found = result.metrics[f"{label}.{quantity}.{POSE}"]
            assert found == pytest.approx(value, rel=0.05), (label, quantity)


@pytest.mark.paper
def test_the_sheets_table_of_positions_outdoors(navigation: Path, tmp_path: Path) -> None:
    """Within 5 %, and within what the issue asks; without a robust update above a metre."""
    name, experiment = load_experiment("uwb-outdoor", {}, {})
    data = navigation / "uwb_outdoor"
    result = run_experiment(name, experiment, tmp_path / "out", data=data, logs=0)
    wanted = {
        "LOS-Trajectory_A-Case_1": {"ekf": 0.877, "smoother:ekf": 0.748, "earlier": 0.834},
        "LOS-Trajectory_B-Case_3": {"ekf": 0.339, "smoother:ekf": 0.286, "earlier": 0.297},
    }
    asked = {"A": {"ekf": 0.88, "smoother:ekf": 0.76}, "B": {"ekf": 0.34, "smoother:ekf": 0.30}}
    for case, figures in wanted.items():
        found = {label: result.metrics[f"{label}.position_rmse_m.{case}"] for label in figures}
        assert found == pytest.approx(figures, rel=0.05)
        for label, limit in asked[case.split("_")[1][0]].items():
            assert found[label] <= limit
        assert result.metrics[f"not-robust.position_rmse_m.{case}"] > 1.0


@pytest.mark.paper
def test_a_path_without_a_window_is_not_held_to_errors_of_a_part_of_it(
    navigation: Path, tmp_path: Path
) -> None:
    """What part of another path printed errors are of is unknown; published tracks are judged."""
    place = tmp_path / "LOS" / "Trajectory_C" / "Case_1"
    shutil.copytree(navigation / "uwb_outdoor" / "LOS" / "Trajectory_B" / "Case_3", place)
    name, experiment = load_experiment("uwb-outdoor", {}, {})
    alone = experiment.model_copy(update={"estimators": {"ekf": experiment.estimators["ekf"]}})
    result = run_experiment(name, alone, tmp_path / "out", data=tmp_path, logs=0)
    assert [claim.claim.partition(": ")[2] for claim in result.claims] == [
        "robust filters that use only ranges are more accurate than the published tracks"
    ]


SECOND = 10**9
ROWS = np.arange(10)
STAMPS = SECOND + SECOND * ROWS


def _states(topic: str, schema: Any, components: str, states: np.ndarray, **columns: Any) -> Stream:
    kinds = ",".join(
        "quaternion" if "orientation" in each else "linear" for each in components.split(",")
    )
    field = "mean" if "covariance" in columns else "state"
    metadata = {"components": components, "kinds": kinds}
    return make_stream(topic, schema, STAMPS, metadata=metadata, **{field: states}, **columns)


def _replayed(streams: list[Stream], **outputs: dict[str, Stream]) -> Replayed:
    source = fl.MemorySource({each.topic: each for each in streams}, RunMetadata("made"), "made")
    return Replayed(Recording("made", Path("made")), source, outputs)


def _innovations(squares: np.ndarray) -> Stream:
    return make_stream(
        "/estimates/ekf/innovation",
        fl.schemas.INNOVATION,
        STAMPS,
        target_id=0 * ROWS,
        accepted=1 + 0 * ROWS,
        innovation=np.ones((10, 1)),
        covariance=np.ones((10, 1)),
        normalised_innovation_squared=squares,
        log_likelihood=np.zeros(10),
    )


def test_a_window_is_scored_from_where_a_path_enters_it_at_its_level() -> None:
    """Of a published track the errors are in the plane, then in space."""
    path = np.stack([ROWS, 2.0 * ROWS, np.where(ROWS == 5, 9.0, 1.0)], axis=1)
    truth = _states("/truth", fl.schemas.TRUTH_STATE, "x_m,y_m,z_m", path)
    off = _states(
        "/published/LS", fl.schemas.TRUTH_STATE, "x_m,y_m,z_m", np.add(path, [3.0, -4.0, 12.0])
    )
    of = _replayed([truth, off])
    window = uwb_outdoor.Window(
        begin=uwb_outdoor.Place(x_above_m=1.5, y_below_m=9.0), end=uwb_outdoor.Place(y_above_m=13.0)
    )
    reference, begin_ns, end_ns = uwb_outdoor.scored_truth(of, window, 0.5)
    assert (begin_ns, end_ns) == (STAMPS[2], STAMPS[7])
    assert reference.time_ns.tolist() == np.delete(STAMPS, 5).tolist()
    between = reference.at(STAMPS[[5]])  # linear where the row is at another height
    np.testing.assert_allclose(between, [[5.0, 10.0, 1.0]])
    plane, space = uwb_outdoor.published_rmse(of, "LS", reference, STAMPS[6], STAMPS[7])
    assert (plane, space) == pytest.approx((5.0, 13.0))
    assert mean_nis(_innovations(1.0 * ROWS), STAMPS[2], STAMPS[5]) == pytest.approx(3.5)


def test_poses_err_by_direction_and_about_their_mean() -> None:
    """The truth turns past half a turn, and its frame is turned by 90 degrees against the tags'."""
    yaw = 2.9 + 0.1 * ROWS
    turned = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=1)
    names = "x_m,y_m,z_m,orientation_w,orientation_x,orientation_y,orientation_z"
    path = np.column_stack([ROWS, 0 * ROWS, 0 * ROWS, turned])
    truth = _states("/truth", fl.schemas.TRUTH_STATE, names, path)
    side = np.where(ROWS % 2, 1.0, -1.0)
    error = np.column_stack([0.3 + 0.1 * side, np.full(10, -0.4), np.full(10, 0.2)])
    mean = np.column_stack([ROWS, 0 * ROWS, yaw + np.pi / 2]) + error
    mean[:, 2] = np.angle(np.exp(1j * mean[:, 2]))
    covariance = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.02], [0.0, 0.02, 0.25]])
    spread = np.tile(covariance.ravel(), (10, 1))
    state = _states(
        "/estimates/ekf/state",
        fl.schemas.GAUSSIAN_ESTIMATE,
        "x_m,y_m,heading_rad",
        mean,
        covariance=spread,
    )
    of = _replayed([truth], ekf={"state": state, "innovation": _innovations(1.0 * ROWS)})
    options = uwb_pose.UwbPoseOptions(skip_s=2.0, mounting_yaw_deg=90.0)
    figures, stamps, errors = uwb_pose.figures_of(of, "ekf", options)
    assert stamps.tolist() == STAMPS[2:].tolist()
    np.testing.assert_allclose(errors, error[2:], atol=1e-9)
    around = error[2:] - error[2:].mean(axis=0)
    inverse = np.linalg.inv(covariance)
    assert figures == pytest.approx(
        {
            "position_rmse_m": np.sqrt(0.3**2 + 0.1**2 + 0.4**2),
            "heading_rmse_deg": np.degrees(0.2),
            "position_spread_m": 0.1,
            "heading_spread_deg": 0.0,
            "nis": 5.5,
            "nees": np.mean(np.einsum("ni,ij,nj->n", error[2:], inverse, error[2:])),
            "nees_around_mean": np.mean(np.einsum("ni,ij,nj->n", around, inverse, around)),
        },
        abs=1e-9,
    )
