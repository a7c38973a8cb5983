"""Shots in sequence and sounds in recordings: what errors are of, and which numbers hold a claim."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from fuselog.pipeline.families.acoustic import recordings, sequence
from fuselog.pipeline.families.acoustic.recordings import (
    Options,
    Published,
    Simulated,
    _explained,
    delays_of,
    differences_of,
    known_place,
)
from fuselog.pipeline.families.acoustic.sequence import log_ratio, of_runs, positions, shots_of
from fuselog.pipeline.output.claims import decide
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.experiment import load_experiment
from fuselog.recorders.errors import BadInput
from fuselog.recorders.recording import import_run, record_run
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.judging.errors.evaluation import Errors
from tests.goldens import keeping


def test_a_shot_is_where_it_was_fired_and_when_it_was_heard_last():
    values = {"shots": 3, "start_sigma_mps": 4.0, "dropout_probability": 0.3}
    source = memory_source(*record_run("shot-sequence", values, 4))
    fired, last_ns = shots_of(source)
    truth = source.streams["/shooter/truth"]
    at_shots = np.searchsorted(truth.publish_time_ns, source.epoch_ns + 5 * 10**9 * np.arange(3))
    assert fired == pytest.approx(truth["state"][at_shots, :2], abs=1e-6)
    reports_ns = source.streams["/shooter/reports"].publish_time_ns
    assert last_ns[-1] == reports_ns[-1]
    assert np.isin(last_ns, reports_ns).all()
    # meanwhile the shooter has moved
    assert np.linalg.norm(positions(source, last_ns) - fired, axis=1).min() > 0.1


def names(**columns: Any) -> Any:
    return SimpleNamespace(**columns)


def test_a_shot_has_the_error_of_its_own_estimate(monkeypatch: pytest.MonkeyPatch):
    source = memory_source(*record_run("shot-sequence", {"shots": 4}, 4))
    _, last_ns = shots_of(source)
    located = names(
        run=np.zeros(3, int),
        time_ns=last_ns[[0, 1, 3]],
        error=np.array([[3.0, 4.0], [6.0, 8.0], [9.0, 12.0]]),
        nees=np.array([3.0, 6.0, 9.0]),
        components=["x_m", "y_m", "vx_mps"],
    )
    monkeypatch.setattr(sequence, "errors_named", lambda *_: located)
    table = sequence.shot_errors(names(sources=[source]), ["ekf"])
    np.testing.assert_array_equal(table["error_m"], [5.0, 10.0, np.nan, 15.0])
    np.testing.assert_array_equal(table["nees"], [1.0, 2.0, np.nan, 3.0])


def verdicts(metrics: dict, of: str) -> list[str]:
    """Those of the shipped experiment's claims on one sound."""
    _, experiment = load_experiment("acoustic-recordings", {}, {})
    found = decide(experiment.claims, metrics, {}, {})
    return [each.verdict for each in found if each.claim.startswith(f"{of}: ")]


def runs_of(**rmse_m: list[float]) -> pd.DataFrame:
    """The runs of one case, by estimator."""
    tables = [
        pd.DataFrame({"run": range(len(each)), "estimator": label.replace("_", "-"), "rmse_m": each})
        for label, each in rmse_m.items()
    ]
    return pd.concat(tables).assign(case="clean", nees=1.0, located=1.0)


def test_a_run_that_is_lost_counts_as_one_run():
    """RMSE half as large in all runs, a thousandth in one: the mean of logarithms."""
    runs = runs_of(student=[1.0, 2.0, 0.5, 3.0, 0.001], not_robust=[2.0, 4.0, 1.0, 6.0, 1.0])
    mean, low, high, *_ = log_ratio(runs, "clean", "student", "not-robust")
    assert mean == pytest.approx(np.log(0.5**4 * 0.001) / 5)
    assert low < np.log(0.5) < high


def test_runs_are_judged_by_the_shots_that_were_located():
    shots = pd.DataFrame({"error_m": [3.0, 4.0, np.nan], "nees": [1.0, 3.0, np.nan]})
    (row,) = of_runs(shots.assign(case="clean", estimator="ekf", run=0)).to_dict("records")
    assert row["rmse_m"] == pytest.approx(np.sqrt(12.5))
    assert (row["nees"], row["located"]) == (2.0, pytest.approx(2 / 3))


@pytest.mark.paper
def test_the_real_array_is_held_to_what_was_published(acoustic):
    given = {"band_hz": [5000.0, 10000.0]}
    table = differences_of(memory_source(*import_run("sound-recordings", acoustic, given)))
    name = "LOCA_2021_detections-zeep"
    rows = table[table["sound"] == name]
    assert rows["microphone"].tolist() == sorted(rows["microphone"])
    assert rows["z_m"].tolist() == [14.392, 2.9, 15.092, 3.6, 14.392, 2.9]
    assert rows["sigma_s"].between(1e-5, 1e-3).all()
    published = [0.0, 0.0325, -0.002, 0.0316, -0.0086, 0.024]
    for change_s, verdict in ((0.0, "confirmed"), (2e-3, "refuted")):
        known = Published(delay_s=[*published[:-1], published[-1] + change_s])
        assert verdicts(delays_of(table, Options(published={name: known})), name) == [verdict]
    with pytest.raises(BadInput, match="2 delays for 6 microphones"):
        delays_of(table, Options(published={name: Published(delay_s=[0.0, 1.0])}))
    # two differences more than coordinates: 5.99 with 95 %
    for squared, verdict in ((1.1, "confirmed"), (1.3, "refuted")):
        assert verdicts(_explained(name, np.full(5, squared), table), name)[-1] == verdict


def test_a_known_place_is_held_to_its_error_and_region():
    none = np.zeros(1, np.int64)
    errors = Errors(
        "ekf",
        "aru",
        ("x_m", "y_m"),
        ("linear",) * 2,
        none,
        none,
        none,
        np.zeros(1),
        np.array([[0.03, 0.03]]),
        np.empty((1, 2, 2)),
        np.array([6.5]),
        0,
        (),
    )
    metrics = known_place(errors)
    assert metrics["ekf.largest_error_m.aru"] == pytest.approx(0.03 * np.sqrt(2.0))
    assert verdicts(metrics, "aru") == ["confirmed", "refuted"]


@pytest.mark.parametrize(
    ("nees", "inside", "expected"),
    [(2.0, 0.95, ["confirmed"] * 2), (2.6, 0.92, ["refuted", "confirmed"]), (1.5, 0.9, ["refuted"] * 2)],
)
def test_covariances_are_right_within_chi_square(nees, inside, expected):
    """Of 100 sounds in the plane: NEES from 1.63 to 2.41, at least 91 in their regions."""
    metrics = {
        "ekf.nees.snr-10": nees,
        "ekf.median_nees.snr-10": nees,
        "ekf.coverage_share.snr-10": inside,
    }
    metrics |= {"simulated.sounds.snr-10": 100.0, "simulated.coordinates.snr-10": 2.0}
    assert verdicts(metrics, "simulated, 10 dB") == expected


def test_simulated_sounds_have_errors_and_regions_by_their_noise(monkeypatch: pytest.MonkeyPatch):
    """Of two noises: what is recorded, and its columns, metrics and shares by closed forms."""
    asked: list[Any] = []

    def record(scenario: str, parameters: dict, seed: int, runs: int, _: object) -> list:
        asked.append((scenario, parameters, seed, runs))
        return [names(streams={"/sound/truth": {"state": np.zeros((1, 2))}})]

    def replay(_: list, estimators: dict) -> SimpleNamespace:
        size_m = asked[-1][1]["snr_db"]
        error = size_m * np.array([[0.6, 0.8, 9.0], [0.0, 2.0, 9.0], [3.0, 0.0, 9.0], [2.4, 3.2, 9.0]])
        nees = np.array([1.0, 5.9, 6.1, 20.0])
        assert estimators == {"ekf": "its settings"}
        return names(errors=[names(error=error, nees=nees, run=np.arange(4))])

    monkeypatch.setattr(recordings, "record_ensemble", record)
    runner: Any = names(
        setting=names(progress=None),
        experiment=names(estimators={"ekf": "its settings", "ukf": "others"}),
        replay=replay,
    )
    wanted = Simulated(runs=4, seed=7, snr_db=[10.0, 2.5], parameters={"height_m": 3.0})
    outcome = Outcome()
    table = recordings.simulate(runner, wanted, "ekf")
    recordings._judge_simulated(table, "ekf", outcome)
    keeping.hold_outcome("acoustic-recordings", {}, outcome)
    recorded = [{"height_m": 3.0, "snr_db": noise} for noise in (10.0, 2.5)]
    assert asked == [("sound-source", parameters, 7, 4) for parameters in recorded]
    assert list(table) == ["snr_db", "run", "error_m", "nees", "inside", "coordinates"]
    assert table["error_m"].tolist() == pytest.approx([10.0, 20.0, 30.0, 40.0, 2.5, 5.0, 7.5, 10.0])
    assert outcome.metrics == {
        f"{name}.snr-{noise:g}": pytest.approx(value)
        for noise in (10.0, 2.5)
        for name, value in (
            ("ekf.median_error_m", 2.5 * noise),
            ("ekf.nees", 8.25),
            ("ekf.median_nees", 6.0),
            ("ekf.coverage_share", 0.5),
            ("simulated.sounds", 4.0),
            ("simulated.coordinates", 2.0),
        )
    }
    [panel] = outcome.figures["simulated"].panels
    assert [each.label for each in panel.series] == ["10 dB", "2.5 dB"]
    assert (panel.series[1].x, panel.series[1].y) == ([2.5, 5.0, 7.5, 10.0], [0.25, 0.5, 0.75, 1.0])
