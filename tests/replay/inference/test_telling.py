"""What who waits is told of kernels that are compiled: which method, of which model."""

import logging
import os
import re
from pathlib import Path

import pytest

import fuselog as fl
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.model.bound_model import title_of
from fuselog.replay.inference.run import filtering
from tests.replay.inference.vehicle_a import VEHICLE_A


@pytest.mark.skipif(os.environ.get("FUSELOG_UNCOMPILED") == "1", reason="nothing is compiled")
def test_a_long_first_use_is_told_with_method_and_model(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """While it happens and when it is done, and not again."""
    monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path))
    monkeypatch.setattr("fuselog.recorders.compiling.notices._PATIENCE_S", 0.0)
    caplog.set_level(logging.INFO, logger="fuselog")
    log = fl.record("landmarks", duration_s=1.0)
    for _ in range(2):
        filtering._compiled.cache_clear()
        fl.replay(log, "ekf")
    said = [record.getMessage() for record in caplog.records if "Kalman" in record.getMessage()]
    assert said[0] == "compiling the extended Kalman filter of robot, once"
    assert re.fullmatch(r"compiled the extended Kalman filter of robot in \d+\.\d s", said[1])
    assert len(said) == 2


def test_a_method_is_named_without_what_its_variants_are() -> None:
    """The first part of its summary, of a model that is registered by the model's name."""
    titles = {label: title_of(VEHICLE_A, method.summary) for label, method in METHODS.items()}
    assert all(title.endswith(f" of {VEHICLE_A.summary}") for title in titles.values())
    assert [label for label, title in titles.items() if ";" in title] == []
    assert any(";" in method.summary for method in METHODS.values())
