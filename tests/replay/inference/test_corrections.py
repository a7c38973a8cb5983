"""Corrections of components that move together: there and back, with the covariance."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from replay.estimators.navigation import INERTIAL, correct
from replay.inference.corrections import moving, reaching_back
from replay.inference.generate import differencing, retraction

KINDS = (*INERTIAL.kinds, "linear")  # with a parameter that is estimated too
N, T = len(KINDS), len(KINDS) - 1


def workspace(**given: Any) -> Any:
    """What a correction works in."""
    shapes = {"state": N, "transition": (T, T), "product": (T, T), "change": (1, T), "step": T}
    return SimpleNamespace(**{name: np.empty(shape) for name, shape in shapes.items()} | given)


@pytest.fixture
def believed() -> Any:
    """A mean, its covariance, and a large step."""
    rng = np.random.default_rng(4)
    mean, root = rng.normal(size=N), 0.1 * rng.normal(size=(T, T))
    mean[6:10] /= np.linalg.norm(mean[6:10])
    return mean, root @ root.T, 0.7 * rng.normal(size=T)


def test_a_correction_carries_the_covariance_by_its_derivative(believed: Any):
    mean, covariance, step = believed
    moved, carried = mean.copy(), covariance.copy()
    moving(KINDS, INERTIAL.correction)(moved, carried, workspace(step=step))
    assert_allclose(moved, [*correct(mean[:-1], step[:-1]), mean[-1] + step[-1]])
    slopes, subtract, size = np.empty((T, T)), differencing(KINDS), 1e-6
    for column in range(T):
        further, found = mean.copy(), covariance.copy()
        other = workspace(step=step + size * np.eye(T)[column])
        moving(KINDS, INERTIAL.correction)(further, found, other)
        subtract(further, moved, slopes, column)
    assert_allclose(carried, slopes.T @ covariance @ slopes / size**2, atol=1e-6)


def test_the_way_back_undoes_a_correction(believed: Any):
    mean, covariance, step = believed
    moved, carried = mean.copy(), covariance.copy()
    moving(KINDS, INERTIAL.correction)(moved, carried, workspace(step=step.copy()))
    back = workspace(mean=moved, covariance=carried)
    reaching_back(KINDS, INERTIAL.correction)(mean, back)
    assert_allclose(back.change[0], step, atol=1e-12)
    assert_allclose(back.covariance, covariance, atol=1e-12)


def test_a_small_correction_is_that_of_every_component(believed: Any):
    mean, covariance, step = believed
    together, apart = mean.copy(), mean.copy()
    moving(KINDS, INERTIAL.correction)(together, covariance, workspace(step=1e-5 * step))
    retraction(KINDS)(apart, 1e-5 * step)
    assert_allclose(together, apart, atol=1e-9)
