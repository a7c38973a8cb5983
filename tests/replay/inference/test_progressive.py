"""Particles that take sharp measurements in by parts, and are spread where they are resampled."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.kalman.steps import Gaussian
from fuselog.replay.inference.particles.particles import Cloud
from fuselog.replay.inference.particles.progressive import kernel_of, renewing
from tests.replay.inference import scalar
from tests.replay.inference.replays import outputs
from tests.replay.inference.scalar import SCALAR
from tests.replay.inference.test_particles import normal
from tests.replay.inference.wheel import make_wheel


@pytest.mark.usefixtures("uncompiled")
def test_a_sharp_measurement_is_taken_in_by_parts() -> None:
    """Of 60 particles none may be within its sigma: by parts they are what the Kalman filter says."""
    source = scalar.source(scalar.simulate(11)[:3])
    sharp = {"sigma_measured": 2e-3}
    exact = outputs(SCALAR, "ekf", [source], **sharp)
    spread, known = (np.sqrt(exact["state"]["covariance"]), exact["innovation"]["log_likelihood"].sum())
    stated = replace(SCALAR, sensors=(replace(scalar.VALUE, log_likelihood=normal),))
    for model in (SCALAR, stated):
        found = outputs(model, "particles", [source], particles=60, progressive=True, **sharp)
        assert np.abs((found["state"]["mean"] - exact["state"]["mean"]) / spread).max() < 0.6
        assert_allclose(np.sqrt(found["state"]["covariance"]) / spread, 1.0, atol=0.3)
        assert found["innovation"]["log_likelihood"].sum() == pytest.approx(known, abs=1.0)
    with pytest.raises(BadInput, match="must be less than 1"):
        outputs(SCALAR, "particles", [source], progressive=True, resample_below=1.0)


@pytest.mark.usefixtures("uncompiled")
def test_particles_that_are_spread_keep_their_mean_and_covariance() -> None:
    """On a manifold: an axis and a rate, across the line where an angle is cut; none is there twice."""
    model, count, rng = make_wheel(), 600, np.random.default_rng(3)
    turn, rate = 1.5 + 0.1 * rng.normal(size=count), 2.0 + 0.3 * rng.normal(size=count)
    states = np.stack([np.cos(turn), np.sin(turn), rate], axis=1)[None]
    weight, empty = rng.exponential(size=(1, count)), np.zeros((1, count, 2))
    weight /= weight.sum()
    key = np.array([[1, 2]], np.uint64)
    work = empty, np.zeros((1, 2)), key, np.ones(1, np.int64)
    cloud = Cloud(Gaussian(empty, empty), states, weight, *work)
    memory: Any = SimpleNamespace(
        kernel=kernel_of(count, 3, 2), chosen=np.empty(count, np.int64), spare=np.empty((count, 3))
    )
    angle = np.arctan2(states[0, :, 1], states[0, :, 0])
    before = np.average([angle, rate], axis=1, weights=weight[0])
    covariance = np.cov([angle, rate], aweights=weight[0])
    with np.errstate(over="ignore"):
        assert renewing(model)(0, cloud, memory)
    angle, rate = np.arctan2(states[0, :, 1], states[0, :, 0]) % np.pi, states[0, :, 2]
    assert len(np.unique(rate)) == count
    sigma = np.sqrt(np.diag(covariance))
    assert_allclose((np.mean([angle, rate], axis=1) - before) / sigma, 0.0, atol=0.1)
    assert_allclose(np.cov([angle, rate]) / np.outer(sigma, sigma), np.eye(2), atol=0.2)
    assert np.ptp(weight) == 0.0
