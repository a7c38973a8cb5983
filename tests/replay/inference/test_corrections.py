"""Corrections of components that move together, of a state that has one more by itself."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.testing import assert_allclose

from replay.estimators.navigation import INERTIAL, correct
from replay.inference.augmentation import augmented
from replay.inference.corrections import correcting, relinearising
from replay.inference.generate import differencing

MODEL = augmented(INERTIAL, ("lever_x_m",))
N, T = MODEL.size, MODEL.tangent
RNG = np.random.default_rng(4)
MEAN = RNG.normal(size=N)
MEAN[6:10] /= np.linalg.norm(MEAN[6:10])
STEP, ROOT = 0.7 * RNG.normal(size=T), 0.1 * RNG.normal(size=(T, T))


def workspace(step: Any) -> Any:
    """What a correction by this step works in."""
    made = {"state": N, "transition": (T, T), "product": (T, T), "turned": T}
    return SimpleNamespace(step=step, **{name: np.empty(shape) for name, shape in made.items()})


def corrected(step: Any) -> tuple[Any, Any]:
    """The mean and the covariance after a step."""
    mean, covariance = MEAN.copy(), ROOT @ ROOT.T
    correcting(MODEL)(mean, covariance, workspace(step))
    return mean, covariance


def test_a_correction_carries_the_covariance_by_its_derivative():
    mean, covariance = corrected(STEP)
    assert_allclose(mean, [*correct(tuple(MEAN[:-1]), tuple(STEP[:-1])), MEAN[-1] + STEP[-1]])
    slopes, size = np.empty((T, T)), 1e-6
    for column in range(T):
        further, _ = corrected(STEP + size * np.eye(T)[column])
        differencing(MODEL.kinds)(further, mean, slopes, column)
    slopes = slopes.T / size
    assert_allclose(covariance, slopes @ ROOT @ ROOT.T @ slopes.T, atol=1e-6)
    step_to, chain = relinearising(MODEL)
    rows, work = np.eye(T), workspace(STEP)
    step_to(MEAN, work)
    chain(rows, work)
    assert_allclose(rows, slopes, atol=1e-5)


def test_without_a_function_of_the_model_components_move_by_themselves():
    """Small steps are alike, large ones are not."""
    apart, work = MEAN.copy(), workspace(1e-5 * STEP)
    correcting(replace(MODEL, correct=None))(apart, np.eye(T), work)
    assert_allclose(corrected(1e-5 * STEP)[0], apart, atol=1e-9)
    correcting(replace(MODEL, correct=None))(apart := MEAN.copy(), np.eye(T), workspace(STEP))
    assert np.abs(corrected(STEP)[0] - apart).max() > 0.1
