"""A shooter who moves: what is heard of where he fired, the start, and wrong reports."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.acoustic.models import Medium, Noise, clear_side, hear
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.acoustic import shot_sequence
from fuselog.replay.families.acoustic.shot_sequence import (
    MOVING_SHOOTER,
    MovingShooterParameters,
    find_shooter,
    log_likelihood,
)
from tests.replay.inference.replays import outputs

AIR: dict[str, Any] = {"speed_of_sound_mps": 342.0, "mach_number": 2.0}
SIGMAS = {
    "sigma_muzzle_blast_rad": 0.07,
    "sigma_shockwave_rad": 0.07,
    "sigma_time_difference_s": 1e-3,
}
EXACT = {
    "sigma_muzzle_blast_deg": 1e-6,
    "sigma_shockwave_deg": 1e-6,
    "sigma_time_difference_s": 1e-9,
    "acceleration_density": 0.0,
}


def recorded(seed: int = 1, **values: Any) -> MemorySource:
    """A log of the recorder `shot-sequence`."""
    return memory_source(*record_run("shot-sequence", values, seed))


def test_reports_are_of_where_a_shot_was_fired() -> None:
    """Without noise the model says of the state when it is heard what the recorder wrote."""
    source = recorded(**EXACT, shots=4, start_sigma_mps=3.0)
    reports, truth = source.streams["/shooter/reports"], source.streams["/shooter/truth"]
    rows = np.searchsorted(truth.publish_time_ns, reports.publish_time_ns)
    sensors = source.streams["/sensors"]["position_m"][reports["sensor_id"].astype(int) - 1]
    said = shot_sequence.hear(truth["state"][rows, :5].T, sensors.T, SimpleNamespace(**AIR))
    assert (truth["state"][rows, 3] != 0.0).all()
    for name, expected, close in zip(
        MOVING_SHOOTER.sensors[0].measured, said, (1e-5, 1e-5, 1e-5, 1e-5), strict=True
    ):
        known = np.isfinite(reports[name])
        assert known.any()
        assert reports[name][known] == pytest.approx(expected[known], abs=close)


def test_the_side_is_told_where_it_is_clear() -> None:
    noise, medium, trajectory = Noise(0.05, 0.05, 1e-3, 1.0), Medium(), 0.4
    off_line = np.array([-0.9, -0.1, 0.1, 0.9])
    azimuth = trajectory + np.pi + off_line
    shooter = 80.0 * np.array([np.cos(azimuth), np.sin(azimuth)])
    blast, shockwave, _ = hear(shooter, np.full(4, trajectory), (0.0, 0.0), medium)
    # at .9 rad both directions of arrival are .15 rad apart, three standard deviations are .21
    assert clear_side(blast, shockwave, noise).tolist() == [0.0, -1.0, 1.0, 0.0]
    assert clear_side(blast, np.full(4, np.nan), noise).tolist() == [0.0] * 4


def started(source: MemorySource, **values: Any) -> Any:
    """Where a log begins."""
    streams = {"reports": source.streams["/shooter/reports"], "/sensors": source.streams["/sensors"]}
    parameters = MovingShooterParameters(**{**AIR, **SIGMAS, **values})
    return find_shooter(streams, parameters)


def with_reports(source: MemorySource, **columns: Any) -> MemorySource:
    """The same log with other numbers in the first reports."""
    reports = source.streams["/shooter/reports"]
    changed = dict(reports.columns)
    for name, value in columns.items():
        changed[name] = reports[name].copy()
        changed[name][: len(value)] = value
    stream = replace(reports, columns=changed)
    return MemorySource({**source.streams, reports.topic: stream}, source.run, source.name)


def test_a_start_is_found_though_two_of_five_reports_are_wrong() -> None:
    source = recorded(seed=3, shots=2)
    truth = source.streams["/shooter/truth"]["state"][0]
    assert np.hypot(*(started(source).mean - truth[:5])[:2]) < 15.0
    wrong = with_reports(source, muzzle_blast_azimuth_rad=[0.3, -2.0], trajectory_rad=[2.0, -1.0])
    found = started(wrong)
    assert found.time_ns == source.streams["/shooter/reports"].publish_time_ns[0]
    assert np.hypot(*(found.mean - truth[:5])[:2]) < 15.0


def test_a_log_whose_bearings_do_not_meet_is_named() -> None:
    source = recorded(shots=2)
    alone = source.streams["/shooter/reports"]
    alone = alone.take(alone["sensor_id"] == 1)
    cut = MemorySource({**source.streams, alone.topic: alone}, source.run, source.name)
    with pytest.raises(BadInput, match=r"two muzzle blasts whose .* use a longer start_s"):
        started(cut)


def test_a_wrong_component_costs_a_particle_no_more_than_its_share() -> None:
    parameters = SimpleNamespace(**AIR, **SIGMAS, outlier_probability=0.1, longest_s=1.0)
    state, sensor = (50.0, 50.0, 0.5, 0.0, 0.0), (127.0, 107.0)
    heard = np.array(shot_sequence.hear(state, sensor, parameters))
    right = log_likelihood(state, tuple(heard), sensor, parameters)
    peaks = -np.log([0.07, 0.07, 1e-3, 1e-3]) - 0.5 * np.log(2 * np.pi) + np.log(0.9)
    assert right == pytest.approx(peaks.sum(), abs=1e-2)
    lost = log_likelihood(state, (*heard[:3], np.nan), sensor, parameters)
    assert right - lost == pytest.approx(peaks[3], abs=1e-2)
    echo = log_likelihood(state, (heard[0] + 2.0, *heard[1:]), sensor, parameters)
    assert right - echo == pytest.approx(peaks[0] - np.log(0.1 / (2 * np.pi)), abs=1e-2)


@pytest.mark.usefixtures("uncompiled")
def test_robust_updates_bear_wrong_reports_that_lose_the_filter() -> None:
    source = recorded(
        seed=5,
        shots=8,
        echo_probability=0.15,
        wrong_association_probability=0.15,
        dropout_probability=0.1,
    )
    truth = source.streams["/shooter/truth"]["state"][-1]
    errors = []
    for settings in ({}, {"student_freedom": 3.0}):
        state = outputs(MOVING_SHOOTER, "ekf", [source], **settings)["state"].stream
        errors.append(np.hypot(*(state["mean"][-1] - truth[:5])[:2]))
    assert errors[1] < 10.0
    assert errors[0] > 3.0 * errors[1]
