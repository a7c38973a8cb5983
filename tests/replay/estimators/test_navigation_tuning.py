"""Clocks that differ, found from recordings alone: the likelihood of the innovations knows them."""

from pathlib import Path

import pytest

import fuselog as fl
from fuselog.pipeline.runs.experiment import load_experiment
from fuselog.recorders.recording import import_run
from fuselog.replay.engine.streams.sources import memory_source

pytestmark = pytest.mark.paper


def test_the_offset_of_the_quadrotors_unit_is_found(navigation: Path):
    """Of fixes once a second that err by .5 m; from those of the truth, see the recordings' tests."""
    log = memory_source(
        *import_run("table", navigation / "quad_mimu" / "path_9", {"mapping": "quadrotor", "seed": 9})
    )
    given = dict(load_experiment("quad-inertial", {}, {})[1].estimators["ekf"])
    given |= {"topics": {"inertial": "/imu1/inertial"}, "inertial_delay_s": 0.01}
    del given["every_s"]
    found = fl.tune(
        log,
        "ekf",
        "inertial_delay_s",
        set=given,
        bounds={"inertial_delay_s": (-0.2, 1.2)},
        grid=8,
    )
    assert 0.375 < found.parameters["value"][0] < 0.525
