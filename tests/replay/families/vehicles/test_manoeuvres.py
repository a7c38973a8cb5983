"""A vehicle that turns and stops: what its modes are worth to an estimator, and whether they hold."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fuselog.pipeline.runs.recorded import record_ensemble, replay_ensemble
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.families.vehicles.vehicle_model import VEHICLE
from tests.replay.inference.replays import outputs

RUNS = 200
MODES = list(VEHICLE.modes or ())
# Constant velocity with white accelerations, from quiet to wild.
SIGMAS_MPS2 = (0.5, 1.0, 2.0, 4.0)
SINGLE = {f"ekf-{mode}": {"kind": "ekf", "mode": mode} for mode in MODES} | {
    f"ekf-{number}": {"kind": "ekf", "acceleration_sigma_mps2": sigma}
    for number, sigma in enumerate(SIGMAS_MPS2)
}


@cache
def sources() -> Sequence[MemorySource]:
    return record_ensemble("manoeuvres", {}, 1, RUNS)


def test_the_vehicle_turns_and_stops_as_it_says() -> None:
    """Its positions are the integral of its velocities, and no acceleration is beyond what is stated."""
    [source] = record_ensemble("manoeuvres", {"fix_rate_hz": 50.0}, 2, 1)
    x, vx, y, vy = source.streams["/vehicle1/truth"]["state"].T
    assert_allclose(np.cumsum(vx[1:] + vx[:-1]) * 0.01, x[1:] - x[0], atol=0.02)
    assert_allclose(np.cumsum(vy[1:] + vy[:-1]) * 0.01, y[1:] - y[0], atol=0.02)
    speed = np.hypot(vx, vy)
    assert speed.min() == 0.0
    assert speed.max() == pytest.approx(10.0)
    acceleration = np.hypot(np.diff(vx), np.diff(vy)) * 50
    assert 2.99 < acceleration.max() < 3.01
    assert (acceleration < 1e-9).mean() > 0.3


def rmse(errors: Any, columns: Sequence[int]) -> Any:
    """Of every run, all stamps together (runs,)."""
    squares = np.square(errors.error[:, columns]).sum(axis=1)
    counts = np.bincount(errors.run, minlength=RUNS)
    return np.sqrt(np.bincount(errors.run, squares, RUNS) / counts)


@pytest.mark.paper
def test_interacting_modes_err_less_than_each_single_motion() -> None:
    """Of 200 runs the paired interval of 99 % is above zero, against all three modes and all sigmas.

    On average the position errs 5 % less than the best of them and the velocity 10 % less than the best
    mode, as set before the first look; against the best sigma, which is found in hindsight, 8 % are left
    of the 10 % that were set for it too. The page on methods prints what the modes are worth.
    """
    name, worth = "imm:ekf", []
    replayed = replay_ensemble(sources(), {name: {}, **SINGLE}, gap_limit_s=1.0)
    assert not any(replayed.metrics(["failures"]).values())
    found = {each.estimator: each for each in replayed.errors}
    for columns, gain in (((0, 2), 0.05), ((1, 3), 0.1)):
        own = rmse(found[name], columns)
        means = {}
        for label in SINGLE:
            apart = rmse(found[label], columns) - own
            assert apart.mean() - 2.58 * apart.std(ddof=1) / np.sqrt(RUNS) > 0.0, label
            means[label] = (own + apart).mean()
        modes = {label: means[label] for label in means if label.partition("-")[2] in MODES}
        rivals = means if columns == (0, 2) else modes
        assert own.mean() < (1.0 - gain) * min(rivals.values())
        worth.append(round(100 * (1.0 - own.mean() / min(modes.values()))))
    page = (Path(__file__).parents[4] / "docs" / "your-model-more.md").read_text(encoding="utf-8")
    position, velocity = worth
    assert position == velocity
    printed = f"errors of position and velocity are {position} % smaller than with the best"
    assert printed in " ".join(page.split())
    assert 3.0 < found[name].nees.mean() < 5.0


@pytest.mark.paper
def test_modes_are_what_the_vehicle_does() -> None:
    """Standing for three seconds it is believed to stand, driving on for three not to manoeuvre."""
    found = outputs(VEHICLE, "imm", sources(), smoothed_modes=True)
    for topic in ("modes", "smoothed_modes"):
        standing, driving = [], []
        for run, source in enumerate(sources()):
            stream = found[topic].of_run(run)
            truth = source.streams["/vehicle1/truth"]["state"]
            row = np.searchsorted(
                source.streams["/vehicle1/truth"].publish_time_ns, stream.publish_time_ns
            )
            velocity = truth[:, 1::2]
            change = np.abs(np.diff(velocity, axis=0, prepend=velocity[:1])).max(axis=1) > 1e-9
            moved = np.convolve(np.hypot(*velocity.T) > 0.0, np.ones(7), "full")[: len(truth)] > 0
            changed = np.convolve(change, np.ones(7), "full")[: len(truth)] > 0
            standing.append(stream["probability"][~moved[row], 2])
            driving.append(stream["probability"][(~changed & (np.hypot(*velocity.T) > 0))[row], 0])
        assert np.concatenate(standing).mean() > 0.8
        assert np.concatenate(driving).mean() > 0.6
