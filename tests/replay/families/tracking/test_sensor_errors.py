"""Errors of sensors in the tracks' states, against Kalman filters of all targets and errors at once."""

from typing import Any

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import Floats
from tests.replay.families.tracking.test_tracker import (
    RADAR,
    SECOND,
    SIMULATION_EPOCH_NS,
    log,
    replay,
    sensor,
)

CLEAR = {**RADAR, "clutter_per_m2": "1e-30", "gate_probability": "0.999999999"}
ONCE = {"hits_needed": 1, "acceleration_density": 0.1}
MOVE = np.kron(np.eye(2), [[1, 1], [0, 1]])
NOISE = 0.1 * np.kron(np.eye(2), [[1 / 3, 1 / 2], [1 / 2, 1]])
PLACE = np.eye(4)[[0, 2]]


def updated(mean: Floats, covariance: Floats, rows: Floats, measured: Floats, noise: Floats) -> Any:
    gain = covariance @ rows.T @ np.linalg.inv(rows @ covariance @ rows.T + noise)
    return mean + gain @ (measured - rows @ mean), covariance - gain @ rows @ covariance


def joint(born: Floats, error: Floats, targets: int) -> tuple[Floats, Floats]:
    """Targets of any velocity that were detected with one error, and that error: by a wide prior."""
    size = 4 * targets + len(error)
    mean, covariance = np.zeros(size), np.zeros((size, size))
    covariance[4 * targets :, 4 * targets :] = error
    for target in range(targets):
        own = slice(4 * target, 4 * target + 4)
        mean[own] = PLACE.T @ born[target]
        covariance[own, own] = np.diag([4.0, 9.0, 4.0, 9.0])
        for other in range(targets):
            covariance[own, 4 * other : 4 * other + 4] += PLACE.T @ error @ PLACE
        covariance[own, -len(error) :] = -PLACE.T @ error
        covariance[-len(error) :, own] = -error @ PLACE
    return mean, covariance


def places_of(seconds: int, offset: float) -> Any:
    """Two targets far apart, seen by a sensor that is out by its offset."""
    rng = np.random.default_rng(int(10 * offset))
    return [
        [
            tuple(np.array(place) + offset + 2 * rng.normal(size=2))
            for place in ((3.0 * t, 0.0), (0.0, 900.0))
        ]
        for t in range(seconds)
    ]


def test_registration_errors_are_estimated_by_all_tracks_together(uncompiled: None):
    """A radar that is out, and a lidar that sees one of the targets: the joint Kalman filter of all."""
    seen, exact = places_of(12, 6.0), [scan[:1] for scan in places_of(12, 0.0)]
    radar = {**CLEAR, "registration_sigma_m": "5", "interval_s": "0"}
    source = log(
        sensor("radar", radar, range(0, 12, 2), seen[::2]),
        sensor("lidar", CLEAR, range(1, 12, 2), exact[1::2]),
    )
    found = replay(source, "tracker:hungarian", **ONCE)
    assert found["track"].components[4:] == ["radar_registration_x_m", "radar_registration_y_m"]
    mean, covariance = joint(np.array(seen[0]), 25.0 * np.eye(2), 2)
    both = np.eye(10)
    both[:4, :4] = both[4:8, 4:8] = MOVE
    noise = np.zeros((10, 10))
    noise[:4, :4] = noise[4:8, 4:8] = NOISE
    for second in range(1, 12):
        mean, covariance = both @ mean, both @ covariance @ both.T + noise
        rows, measured = np.zeros((2, 10)), np.array(exact[second]).ravel()
        rows[:, :4] = PLACE
        if second % 2 == 0:
            rows, measured = np.zeros((4, 10)), np.array(seen[second]).ravel()
            rows[:2, :4], rows[2:, 4:8] = PLACE, PLACE
            rows[:, 8:] = np.tile(np.eye(2), (2, 1))
        mean, covariance = updated(mean, covariance, rows, measured, 4 * np.eye(len(rows)))
    last = found["track"].publish_time_ns == SIMULATION_EPOCH_NS + 11 * SECOND
    means, covariances = (
        found["track"]["mean"][last],
        found["track"]["covariance"][last].reshape(-1, 6, 6),
    )
    for target in range(2):
        own = [*range(4 * target, 4 * target + 4), 8, 9]
        np.testing.assert_allclose(means[target], mean[own], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            covariances[target], covariance[np.ix_(own, own)], rtol=1e-9, atol=1e-9
        )
    assert means[1][2] == pytest.approx(900.0, abs=4.0)  # the radar alone would say 906


def test_correlated_errors_are_each_tracks_own(uncompiled: None):
    """A Gauss-Markov error of every target, by the Kalman filter of one target and its error."""
    seen = places_of(10, 3.0)
    radar = {**CLEAR, "correlated_sigma_m": "4", "correlation_s": "6"}
    found = replay(log(sensor("radar", radar, range(10), seen)), "tracker:hungarian", **ONCE)
    assert found["track"].components[4:] == ["radar_correlated_x_m", "radar_correlated_y_m"]
    fade = np.exp(-1 / 6)
    move, noise = np.eye(6), np.zeros((6, 6))
    move[:4, :4], move[4:, 4:] = MOVE, fade * np.eye(2)
    noise[:4, :4], noise[4:, 4:] = NOISE, 16 * (1 - fade**2) * np.eye(2)
    rows = np.hstack([PLACE, np.eye(2)])
    for target in range(2):
        mean, covariance = joint(np.array([seen[0][target]]), 16.0 * np.eye(2), 1)
        for second in range(1, 10):
            mean, covariance = move @ mean, move @ covariance @ move.T + noise
            mean, covariance = updated(
                mean, covariance, rows, np.array(seen[second][target]), 4 * np.eye(2)
            )
        mine = found["track"]["track_id"] == target + 1
        np.testing.assert_allclose(found["track"]["mean"][mine][-1], mean, rtol=1e-9, atol=1e-9)
        last = found["track"]["covariance"][mine][-1].reshape(6, 6)
        np.testing.assert_allclose(last, covariance, rtol=1e-9, atol=1e-9)


def test_the_birth_of_a_range_with_a_bearing_has_its_error(uncompiled: None):
    """The position of a newborn is out by what its sensor is: rotated, and by the range."""
    places = [(0.0, 500.0)] * 6
    polar = [[(np.hypot(x, y) - 8.0, np.arctan2(y, x))] for x, y in places]
    stated = {**CLEAR, "sigma_m": "2", "sigma_rad": "0.004", "registration_sigma_m": "10"}
    survey = sensor("radar", stated, range(0, 12, 2), polar)
    lidar = sensor("lidar", CLEAR, range(1, 12, 2), [[each] for each in places])
    found = replay(log(survey, lidar), "tracker:hungarian", **ONCE)
    error = found["track"].components.index("radar_registration_range_m")
    assert found["track"]["mean"][-1][error] == pytest.approx(-8.0, abs=1.0)
    assert found["track"]["mean"][-1][2] == pytest.approx(500.0, abs=1.0)


def test_errors_that_cannot_be_estimated_are_said(uncompiled: None):
    source = log(sensor("radar", {**CLEAR, "registration_sigma_m": "5"}, [0], [[]]))
    motion = {"turn_rate_radps": 0.0, "acceleration_sigma_mps2": 0.3}
    with pytest.raises(BadInput, match="registration errors require targets with one motion; set mode="):
        replay(source, model="vehicle", motion=motion)
    with pytest.raises(BadInput, match="tracks with sensor errors cannot be smoothed"):
        replay(source, smoothed=True)
