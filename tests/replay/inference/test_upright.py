"""Corrections that turn about up and then tilt: what is unknown about up stays so about it alone."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from replay.estimators.navigation import INERTIAL
from replay.inference.steps import correcting

UP = np.array([0.0, 0.0, 1.0])


def corrected(before: Rotation, step: Any) -> Rotation:
    """An orientation after a turn about up, and a tilt about what is level in the body."""
    up = before.inv().apply(UP)
    turn = up @ step
    return Rotation.from_rotvec(turn * UP) * before * Rotation.from_rotvec(step - turn * up)


def step_between(before: Rotation, after: Rotation) -> Any:
    """The correction that leads from one orientation to another."""
    up, up_after = before.inv().apply(UP), after.inv().apply(UP)
    axis = np.cross(up_after, up)
    sine = np.linalg.norm(axis)
    tilt = axis / sine * np.arctan2(sine, up @ up_after) if sine > 0.0 else axis
    turned = (after * Rotation.from_rotvec(-tilt) * before.inv()).as_rotvec()
    return turned[2] * up + tilt


@pytest.fixture
def moved() -> Any:
    """Mean, covariance and step before, and both after the correction."""
    rng = np.random.default_rng(0)
    before = Rotation.from_euler("ZYX", [1.0, 0.3, -0.2])
    root, step = rng.normal(size=(15, 15)), 0.3 * rng.normal(size=15)
    mean = np.concatenate([np.zeros(6), before.as_quat(scalar_first=True), np.zeros(6)])
    covariance = root @ root.T
    work = SimpleNamespace(step=step.copy(), turned=np.empty(15))
    after, carried = mean.copy(), covariance.copy()
    correcting(INERTIAL)(after, carried, work)
    return before, step, covariance, Rotation.from_quat(after[6:10], scalar_first=True), carried


def test_the_mean_is_turned_and_tilted(moved: Any):
    before, step, _, after, _ = moved
    assert_allclose((after.inv() * corrected(before, step[6:9])).as_rotvec(), 0.0, atol=1e-15)
    assert_allclose(step_between(before, after), step[6:9], atol=1e-14)


def test_the_covariance_is_carried_by_the_derivative(moved: Any):
    before, step, covariance, after, carried = moved
    jacobian, small = np.eye(15), 1e-6
    for k in range(3):
        away = small * np.eye(3)[k]
        ends = (step_between(after, corrected(before, step[6:9] + sign * away)) for sign in (1.0, -1.0))
        jacobian[6:9, 6 + k] = (next(ends) - next(ends)) / (2.0 * small)
    assert_allclose(carried, jacobian @ covariance @ jacobian.T, atol=1e-8)
