"""Corrections of components that bend together, of a state that has one more by itself."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fuselog.replay.estimators.navigation.navigation import INERTIAL
from fuselog.replay.estimators.navigation.turning import heading, move, move_back
from fuselog.replay.inference.linear_algebra.manifold import boxminus
from fuselog.replay.inference.model.augmentation import augmented
from fuselog.replay.inference.model.corrections import comparing, correcting, relinearising, sloping

MODEL = augmented(INERTIAL, ("lever_x_m",))
N, T = MODEL.size, MODEL.tangent
RNG = np.random.default_rng(4)
MEAN = RNG.normal(size=N)
MEAN[6:10] /= np.linalg.norm(MEAN[6:10])
STEP, ROOT = 0.7 * RNG.normal(size=T), 0.1 * RNG.normal(size=(T, T))
P = ROOT @ ROOT.T
DIRECTION = np.array([*heading(tuple(MEAN[:-1])), 0.0])
SLOPE = P @ DIRECTION / (DIRECTION @ P @ DIRECTION)


def workspace(step: Any) -> Any:
    """What a correction by this step works in."""
    made = {"state": N, "transition": (T, T), "product": (T, T), "turned": T, "slope": T}
    made["change"] = (1, T)
    work = SimpleNamespace(step=step, **{name: np.empty(shape) for name, shape in made.items()})
    made_slope()(MEAN, P, work.slope)
    return work


@cache
def made_slope() -> Any:
    return sloping(MODEL.kinds, MODEL.correct)


@cache
def made_correction(back: bool) -> Any:
    return correcting(MODEL.kinds, MODEL.correct, back=back)


def corrected(step: Any, back: bool) -> tuple[Any, Any]:
    """The mean and the covariance after a step."""
    mean, covariance = MEAN.copy(), P.copy()
    made_correction(back)(mean, covariance, workspace(step))
    return mean, covariance


def slopes_of(back: bool) -> Any:
    """The derivative (T, T) of the corrected state by the step, by differences."""
    mean, slopes, size = corrected(STEP, back)[0], np.empty((T, T)), 1e-6
    for column in range(T):
        further, _ = corrected(STEP + size * np.eye(T)[column], back)
        boxminus(MODEL.kinds)(further, mean, slopes, column)
    return slopes.T / size


def test_the_tangent_is_that_of_the_mean_given_the_heading():
    assert_allclose(workspace(STEP).slope, SLOPE)


@pytest.mark.paper
@pytest.mark.parametrize("back", [False, True])
def test_a_correction_carries_the_covariance_by_its_derivative(back: bool):
    mean, covariance = corrected(STEP, back)
    function = move_back if back else move
    inner = function(tuple(MEAN[:-1]), tuple(STEP[:-1]), tuple(SLOPE[:-1]))
    assert_allclose(mean, [*inner, MEAN[-1] + STEP[-1]])
    slopes = slopes_of(back)
    assert_allclose(covariance, slopes @ P @ slopes.T, atol=1e-6)


@pytest.mark.paper
def test_an_iterated_update_linearises_along_the_curve():
    step_to, chain = relinearising(MODEL)
    rows, work = np.eye(T), workspace(STEP)
    step_to(MEAN, work)
    chain(rows, work)
    assert_allclose(rows, slopes_of(False), atol=1e-5)


def test_the_way_back_finds_the_step_and_the_covariance_again():
    mean, covariance = corrected(STEP, True)
    work = workspace(np.empty(T))
    comparing(MODEL.kinds, MODEL.correct)(MEAN, mean, covariance, work)
    assert_allclose(work.change[0], STEP, atol=1e-12)
    assert_allclose(covariance, P, atol=1e-12)


def test_without_a_correction_of_the_model_components_move_by_themselves():
    """Small steps are alike, large ones are not."""
    by_itself = correcting(MODEL.kinds, None)
    apart = MEAN.copy()
    by_itself(apart, np.eye(T), workspace(1e-5 * STEP))
    assert_allclose(corrected(1e-5 * STEP, False)[0], apart, atol=1e-9)
    by_itself(apart := MEAN.copy(), np.eye(T), workspace(STEP))
    assert np.abs(corrected(STEP, False)[0] - apart).max() > 0.1
    work = workspace(np.empty(T))
    comparing(MODEL.kinds, None)(MEAN, apart, np.eye(T), work)
    assert_allclose(work.change[0], STEP, atol=1e-12)
