"""Clocks that differ, found from recordings alone: the likelihood of the innovations knows them."""

from pathlib import Path

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.runs.experiment import load_experiment
from fuselog.recorders.recording import import_run
from fuselog.replay.engine.streams.sources import memory_source

pytestmark = pytest.mark.paper


def test_the_delay_of_the_walks_velocity_is_found(navigation: Path):
    """The sheet's is .125 s, the likelihood flat from there to .15; the mapping has taken it already."""
    log = memory_source(
        *import_run("table", navigation / "gnss_imu_rtk" / "walk_0827", {"mapping": "walk"})
    )
    given = {
        "force_noise_density": 0.05,
        "gyro_noise_density": 0.001,
        "force_bias_density": 3e-4,
        "gyro_bias_density": 2e-6,
        "tilt_sigma_rad": np.radians(3.0),
        "gyro_bias_sigma_radps": np.radians(0.2),
        "velocity_delay_s": -0.075,
    }
    bounds = {"velocity_delay_s": (-0.125, 0.175)}
    found = fl.tune(log, "ekf", "velocity_delay_s", set=given, bounds=bounds, grid=7)
    assert 0.115 < found.parameters["value"][0] + 0.125 < 0.16


@pytest.mark.parametrize(
    ("path", "least_s", "most_s"),
    [
        (3, 0.1, 0.3),  # of fixes once a second that err by .5 m; .10 of those of the truth at 10 Hz
        (9, 0.375, 0.525),
    ],
)
def test_the_offset_of_the_quadrotors_unit_is_found(
    navigation: Path, path: int, least_s: float, most_s: float
):
    folder = navigation / "quad_mimu" / f"path_{path}"
    log = memory_source(*import_run("table", folder, {"mapping": "quadrotor", "seed": path}))
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
    assert least_s < found.parameters["value"][0] < most_s
