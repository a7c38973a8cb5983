"""Outages of a receiver, bridged by an inertial unit: the protocol, and the recording of the walk."""

import struct
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from fuselog.pipeline.output.results import Result
from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.studies.navigation.gnss_ins import GnssInsOptions, ignoring_delay
from fuselog.pipeline.studies.navigation.outages import (
    Rows,
    coasted,
    error_table,
    hermite,
    in_runs,
    length_table,
    rows_of,
    window_table,
    windows_of,
)
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.replay.engine.streams.sources import MemorySource

pytestmark = pytest.mark.usefixtures("blank_figures")


def accelerated() -> Rows:
    """A path along x with 2 m/s2 for 100 s, of which the fix at 60 s is none to judge by."""
    since_s = np.arange(0.0, 100.0, 0.5)
    zero = np.zeros_like(since_s)
    place = np.stack([since_s**2, zero], axis=1)
    place[120] = np.nan
    return Rows(np.rint(1e9 * since_s).astype(np.int64), place, np.stack([2 * since_s, zero], axis=1))


def test_windows_are_where_all_of_it_is_a_truth():
    windows = windows_of(accelerated(), 10.0, 25.0, 10.0)
    assert [each.start_s for each in windows] == [25.0, 35.0, 45.0, 65.0, 75.0, 85.0]
    assert windows[0].rows.tolist() == list(range(50, 70))
    shared = in_runs(windows, 10.0, 2)
    assert [[each.name for each in run] for run in shared] == [
        ["10s-at-25s", "10s-at-45s", "10s-at-65s", "10s-at-85s"],
        ["10s-at-35s", "10s-at-75s"],
    ]


def test_what_takes_no_inertial_unit_errs_as_it_must():
    """The last velocity by half the acceleration times the square of the time; the cubic not at all."""
    rows = accelerated()
    [window, *_] = windows_of(rows, 10.0, 25.0, 10.0)
    ahead_s = rows.since_s[window.rows] - 24.5
    assert_allclose(coasted(rows, window)[:, 0], -(ahead_s**2), rtol=1e-12)
    assert_allclose(hermite(rows, window), 0.0, atol=1e-9)
    lengths = length_table(window_table(error_table(rows, [[window]], {}, []))).set_index("estimator")
    assert lengths.loc["constant-velocity", "end_rmse_m"] == pytest.approx(100.0)
    assert lengths.loc["constant-velocity", "over_rmse_m"] == pytest.approx(np.sqrt(np.mean(ahead_s**4)))


@pytest.fixture(scope="module")
def result(navigation: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    """The experiment as it ships, with outages of one length; claims hold the numbers of all three."""
    name, experiment = load_experiment("gnss-ins", {"options": {"lengths_s": [15]}}, {})
    folder = tmp_path_factory.mktemp("gnss-ins") / "out"
    return run_experiment(name, experiment, folder, data=navigation, logs=0)


@pytest.mark.paper
def test_innovations_and_biases_of_the_walk_are_the_sheets(result: Result):
    found = {key.removeprefix("ekf."): value for key, value in result.metrics.items()}
    for kind, nis, share, by_axis in (
        ("position", 2.64, 0.059, [0.54, 0.49, 1.61]),
        ("velocity", 2.69, 0.045, [0.46, 0.47, 1.75]),
    ):
        assert found[f"{kind}_nis"] == pytest.approx(nis, abs=0.4)
        assert found[f"{kind}_nis_share_above_95"] == pytest.approx(share, abs=0.03)
        assert_allclose([found[f"{kind}_nis_{axis}"] for axis in "xyz"], by_axis, atol=0.3)
    gyro = np.array([found[f"end_gyro_bias_{axis}_radps"] for axis in "xyz"], float)
    assert_allclose(np.degrees(gyro), [0.130, 0.085, 0.174], atol=0.03)
    assert found["end_accelerometer_bias_z_mps2"] == pytest.approx(0.116, abs=0.03)


@pytest.mark.paper
def test_outages_are_bridged_as_the_sheet_says(result: Result):
    """The filter and the smoother within 1.25 times; what needs no tuning checks the protocol."""

    def found(name: str) -> float:
        value = result.metrics[f"{name}.15s"]
        assert isinstance(value, float)
        return value

    assert found("constant-velocity.end_rmse_m") == pytest.approx(20.32, rel=0.01)
    assert found("constant-velocity.over_rmse_m") == pytest.approx(12.04, rel=0.01)
    assert found("hermite.over_rmse_m") == pytest.approx(2.18, rel=0.01)
    assert found("ekf.end_rmse_m") < 1.25 * 3.60
    assert found("ekf.over_rmse_m") < 1.25 * 1.72
    assert found("smoother.over_rmse_m") < 1.25 * 0.141
    assert 0.3 < found("ekf.end_nees") < 5.0
    windows = [key for key in result.metrics if key.startswith("ekf.window_rmse_m.")]
    assert len(windows) == 5


@pytest.mark.paper
def test_ignoring_the_delay_of_the_velocity_costs_half_of_what_the_smoother_gains(result: Result):
    assert result.metrics["smoother-at-stamps.over_rmse_m.15s"] == pytest.approx(0.216, rel=0.15)
    assert {claim.verdict for claim in result.claims} == {"confirmed"}


@pytest.mark.paper
def test_a_raw_recording_with_another_mounting_takes_settings_alone(
    navigation: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The walk as the raw logger has it, x backwards: the same errors, but for ticks of 1 ms."""
    walk, raw = navigation / "gnss_imu_rtk" / "walk_0827", tmp_path / "drive"
    raw.mkdir()
    (raw / "gnss.pos").write_bytes((walk / "gnss_1730_sf.pos").read_bytes())
    rows = np.loadtxt(walk / "imu_1730_sf.csv", delimiter=",")
    time_ms, force, rate = rows[:, 0] * 1e3, rows[:, 1:4], np.degrees(rows[:, 4:7])
    # forward is -y of the walk's unit; turned by -90 deg about z more, forward is -x
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    start_ms = int(time_ms[0])
    tick = np.rint(time_ms - start_ms).astype(int)
    table = pd.DataFrame(np.hstack([force @ turn, rate @ turn])).assign(tick=tick)
    table.to_csv(raw / "imu_0000.csv", header=False, index=False)
    head = b"TIMETAG RTKLIB demo5".ljust(64, b"\0")
    head += struct.pack("<Id", start_ms // 1000, start_ms % 1000 / 1000)
    ends = struct.pack("<4I", 0, 0, int(tick[-1] - tick[0]), 0)
    (raw / "imu_0000.csv.tag").write_bytes(head + ends)
    settings = {
        "mapping": "walk-raw",
        "mounting_deg": [0, 0, 180],
        "options": {"lengths_s": [15], "delayed": ""},
    }
    name, experiment = load_experiment("gnss-ins", settings, {})
    alone = {"ekf": experiment.estimators["ekf"]}
    experiment = experiment.model_copy(update={"estimators": alone})
    monkeypatch.setattr(Runner, "draw", lambda *_, **__: None)  # the walk's timeline is drawn above
    found = run_experiment(name, experiment, tmp_path / "out", data=tmp_path, logs=0)
    assert found.metrics["ekf.over_rmse_m.15s"] == pytest.approx(1.71, rel=0.03)
    assert {claim.verdict for claim in found.claims} == {"no verdict"}  # they are the walk's own


@pytest.mark.parametrize(("delays_s", "taken_back"), [({}, -0.125), ({"/velocity": 0.1}, -0.1)])
def test_the_smoother_that_ignores_a_delay_takes_back_that_of_the_recording(
    delays_s: dict[str, float], taken_back: float
):
    _, experiment = load_experiment("gnss-ins", {"delays_s": delays_s}, {})
    options = GnssInsOptions(delayed="smoother-at-stamps")
    changed = ignoring_delay(experiment, options).estimators
    assert changed["smoother-at-stamps"]["velocity_delay_s"] == taken_back
    assert changed["smoother"] == experiment.estimators["smoother"]


def test_several_recordings_and_none(tmp_path: Path):
    name, experiment = load_experiment("gnss-ins", {}, {})
    with pytest.raises(
        BadInput, match=r"neither this folder nor one in it has all files of the mapping \(\*\.pos"
    ):
        run_experiment(name, experiment, tmp_path / "out", data=tmp_path)
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        for file in ("a.pos", "imu_sf.csv"):
            (tmp_path / folder / file).touch()
    with pytest.raises(BadInput, match=r"several recordings; give one of .*one, .*two with --data"):
        run_experiment(name, experiment, tmp_path / "out", data=tmp_path)


def test_a_recording_of_float_solutions_alone_has_no_truth():
    stamps_ns, place, spread = np.array([10**9]), np.zeros((1, 3)), np.ones((1, 9))
    fix = make_stream("/fix", schemas.POSITION_FIX, stamps_ns, position_m=place, covariance_m2=spread)
    velocity = make_stream(
        "/velocity", schemas.VELOCITY_FIX, stamps_ns, velocity_mps=place, covariance_m2ps2=spread
    )
    streams = {"/fix": fix, "/velocity": velocity}
    with pytest.raises(BadInput, match=r"^drive: has no messages of /truth, because no row"):
        rows_of(MemorySource(streams, RunMetadata("table"), "drive"))
