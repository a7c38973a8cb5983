"""Ellipsoids of sensors that are turned: what is found, applied, left open, written and refused."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import fuselog as fl
from fuselog.pipeline.altering.sources import alter
from fuselog.pipeline.calibrating import ellipsoid_study as study
from fuselog.pipeline.calibrating.ellipsoid_fit import NAMES
from fuselog.pipeline.optimise import QUANTILE
from tests.goldens import keeping
from tests.pipeline.conftest import Said


def readings(log: fl.MemorySource, field: str = study.FIELD) -> np.ndarray:
    topic, _, name = field.rpartition(".")
    return log.read([topic])[topic][name]


@pytest.mark.parametrize("unit", study.UNITS)
@pytest.mark.paper
def test_what_a_turned_unit_errs_by_is_found(unit: str) -> None:
    """Each number within 3.5 standard errors, by two units."""
    truth = study.UNITS[unit][1]
    for seed in (1, 2):
        table = study.calibrated(unit, seed).table
        sigma = (table["high"] - table["low"]) / 2.0 / QUANTILE
        assert list(table["parameter"]) == list(NAMES)
        assert np.abs((table["value"] - truth) / sigma).max() < 3.5


@pytest.mark.paper
def test_settings_correct_the_log() -> None:
    log = study.recorded("magnetometer", 1)
    found = study.calibrated("magnetometer", 1)
    lengths = np.linalg.norm(readings(alter(log, found.settings)), axis=1)
    assert np.std(lengths) == pytest.approx(0.3, rel=0.1)
    assert lengths.mean() == pytest.approx(study.FIELD_UT, rel=1e-3)
    relative = fl.ellipsoid(log, study.FIELD)
    assert relative.offset == pytest.approx(found.offset, rel=1e-6)
    assert relative.matrix / relative.length == pytest.approx(found.matrix / found.length, rel=1e-6)
    assert np.trace(relative.matrix) == pytest.approx(3.0)
    assert any("no --length was given" in each for each in relative.notes)


def test_readings_of_one_side_determine_nothing() -> None:
    log = study.recorded("magnetometer", 1)
    stream = log.streams["/imu"]
    is_near = stream["magnetic_field_ut"] @ [1.0, 0.0, 0.0] > 44.0
    found = fl.ellipsoid(fl.Recording([stream.take(np.flatnonzero(is_near))]), study.FIELD)
    assert "to too few sides, which does not determine offset_x" in found.notes[0]
    assert found.left_open == list(NAMES)


@pytest.mark.parametrize("axis", [0, 2])
def test_the_one_axis_of_turns_is_named(axis: int) -> None:
    log = study.recorded("magnetometer", 1)
    angle = np.linspace(0.0, 12.0, len(readings(log)))
    plane = np.stack([20.0 * np.cos(angle), 20.0 * np.sin(angle), np.full_like(angle, -40.0)], axis=1)
    column = np.roll(plane, axis - 2, axis=1) + np.random.default_rng(1).normal(0.0, 0.3, plane.shape)
    stream = log.streams["/imu"]
    turned = fl.make_stream(
        "/imu",
        fl.schemas.INERTIAL_SAMPLE,
        stream.publish_time_ns,
        **{**stream.columns, "magnetic_field_ut": column},
    )
    found = fl.ellipsoid(fl.Recording([turned]), study.FIELD, length=study.FIELD_UT)
    assert f"about one axis only, near {'xyz'[axis]}, which does not determine" in found.notes[0]
    assert {f"offset_{'xyz'[axis]}", f"scale_{'xyz'[axis]}"} <= {*found.left_open}
    assert found.table.set_index("parameter").loc[found.left_open].isna().all(axis=None)
    assert found.settings == {}


@pytest.mark.usefixtures("blank_figures")
def test_the_command(fuselog: Callable[..., Said], tmp_path: Path) -> None:
    log = tmp_path / "positions.mcap"
    fl.write(log, study.recorded("accelerometer", 1))
    said = fuselog(
        "ellipsoid", str(log), "--field", study.FORCE, "--json", "--out", str(tmp_path / "out")
    )
    assert said.code == 0, said.err
    offset = {row["parameter"]: row["value"] for row in said.json["parameters"]}["offset_y"]
    assert offset == pytest.approx(-0.3, abs=0.01)
    assert (tmp_path / "out" / "tables" / "ellipsoid.csv").exists()
    half = fuselog("ellipsoid", str(log), "--field", study.FORCE, "--json", "--length", "4.903325")
    scale = {row["parameter"]: row["value"] for row in half.json["parameters"]}["scale_y"]
    assert scale == pytest.approx(0.99 / 2, abs=0.002)
    for field, words in (
        ("/imu", "expected TOPIC.FIELD"),
        ("/imu.turn", "has no vector turn"),
        ("/imu.turn_rate_radps", "its 6000 readings are all equal"),
    ):
        refused = fuselog("ellipsoid", str(log), "--field", field)
        assert (refused.code, words in refused.err) == (2, True), refused.err


def test_the_study_counts_the_intervals_that_hold_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three units, each a tenth further off than the one before; intervals are .15 to either side."""

    def calibrated(unit: str, seed: int) -> SimpleNamespace:
        values = study.UNITS[unit][1] + 0.1 * (seed - 7)
        return SimpleNamespace(table=pd.DataFrame({"low": values - 0.15, "high": values + 0.15}))

    monkeypatch.setattr(study, "calibrated", calibrated)
    options = study.EllipsoidOptions(seeds=(7, 17))  # none of the second block holds
    setting = SimpleNamespace(options=options, progress=lambda each, *_: each)
    outcome = study.study(SimpleNamespace(runs=3), setting)
    keeping.hold_outcome("study ellipsoid", {}, outcome)
    found = outcome.metrics
    for block, held in enumerate((2.0, 0.0)):
        own = [each for key, each in found.items() if key.startswith(f"ellipsoid.covered.{block}-")]
        assert own == [held] * 18
