"""What who waits is told of kernels that are compiled: which method, of which model."""

import logging
import os
import re
from pathlib import Path

import pytest

import fuselog as fl
from replay.inference.run import filtering


@pytest.mark.skipif(os.environ.get("FUSELOG_UNCOMPILED") == "1", reason="nothing is compiled")
def test_a_long_first_use_is_told_with_method_and_model(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """While it happens and when it is done, and not again."""
    monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path))
    monkeypatch.setattr("replay.engine.compiling.notices._PATIENCE_S", 0.0)
    caplog.set_level(logging.INFO, logger="fuselog")
    log = fl.record("landmarks", duration_s=1.0)
    for _ in range(2):
        filtering._compiled.cache_clear()
        fl.replay(log, "ekf")
    said = [record.getMessage() for record in caplog.records if "Kalman" in record.getMessage()]
    assert said[0] == "compiling the extended Kalman filter of robot, once"
    assert re.fullmatch(r"compiled the extended Kalman filter of robot in \d+\.\d s", said[1])
    assert len(said) == 2
