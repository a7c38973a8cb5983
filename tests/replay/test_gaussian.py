"""The parts of Gaussian filters, uncompiled and in sizes of no family, beside NumPy's algebra."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from replay.estimators.gaussian import (
    Filter,
    Innovation,
    Models,
    cholesky,
    correct,
    is_finite,
    linearised,
    no_innovation,
    sampled,
)
from replay.sampling.samplers import unscented
from replay.sampling.sets import SampleSets

Floats = NDArray[np.float64]
seeds = st.integers(0, 2**32 - 1)


def positive_definite(generator: np.random.Generator, size: int) -> Floats:
    root = generator.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


@given(st.integers(1, 5), seeds)
def test_cholesky_is_numpys_in_place_too(size: int, seed: int):
    matrix = positive_definite(np.random.default_rng(seed), size)
    factor = np.zeros((size, size))
    assert cholesky(factor, matrix, size)
    assert_allclose(factor, np.linalg.cholesky(matrix), atol=1e-12)
    assert cholesky(matrix, matrix, size)
    assert_allclose(np.tril(matrix), factor, atol=1e-12)


@pytest.mark.parametrize("last", [0.0, -1.0, np.nan, 0.25])
def test_cholesky_refuses_what_is_not_positive_definite(last: float):
    matrix = np.array([[4.0, 1.0], [1.0, last]])
    assert not cholesky(np.zeros((2, 2)), matrix, 2)


@given(st.integers(1, 5), st.integers(1, 4), seeds)
def test_correct_is_the_kalman_update_by_what_was_measured(states: int, components: int, seed: int):
    """Any components may be missing; the covariance stays exactly symmetric."""
    generator = np.random.default_rng(seed)
    joint = positive_definite(generator, states + components)
    p, s, c = joint[:states, :states].copy(), joint[states:, states:], joint[:states, states:]
    x, v = generator.normal(size=states), generator.normal(size=components)
    kept = generator.uniform(size=components) < 0.7
    kept[generator.integers(components)] = True
    gain = c[:, kept] @ np.linalg.inv(s[np.ix_(kept, kept)])
    mean, covariance = x.copy(), p.copy()
    innovation = Innovation(np.where(kept, v, np.nan), s.copy(), c.copy())
    squared, accepted = correct(mean, covariance, innovation, np.full(components + 1, np.inf))
    assert accepted
    assert_allclose(squared, v[kept] @ np.linalg.solve(s[np.ix_(kept, kept)], v[kept]), rtol=1e-6)
    assert_allclose(mean, x + gain @ v[kept], atol=1e-7)
    assert_allclose(covariance, p - gain @ c[:, kept].T, atol=1e-7)
    assert_array_equal(covariance, covariance.T)


def test_a_shut_gate_and_a_broken_innovation_change_nothing():
    for s, gate, expected in ((np.eye(2), 1.99, 2.0), (-np.eye(2), np.inf, np.nan)):
        mean, covariance = np.zeros(3), np.eye(3)
        innovation = Innovation(np.ones(2), s, np.ones((3, 2)))
        squared, accepted = correct(mean, covariance, innovation, np.array([0, 0, gate]))
        assert not accepted
        assert_array_equal(squared, expected)
        assert_array_equal(mean, 0)
        assert_array_equal(covariance, np.eye(3))
    assert correct(
        np.zeros(3), np.eye(3), Innovation(np.ones(2), np.eye(2), np.ones((3, 2))), np.full(3, 2.0)
    )[1]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_is_finite_finds_every_entry(bad: float):
    assert is_finite(np.ones(2), np.eye(2))
    assert not is_finite(np.array([1.0, bad]), np.eye(2))
    assert not is_finite(np.ones(2), np.array([[1.0, 0.0], [bad, 1.0]]))


# Linear models: every filter is exact, whatever its samples.


class Linear(NamedTuple):
    """x' = F x + T B u and z = H (x - target), the last component an angle."""

    transition: Floats
    control: Floats
    look: Floats

    def models(self) -> Models:
        """As component-first functions and filled Jacobians."""

        def motion(x: Floats, u: Floats, duration: float) -> tuple[float, ...]:
            return tuple(self.transition @ x + duration * self.control @ u)

        def motion_jacobians(x: Floats, u: Floats, duration: float, f: Floats, g: Floats) -> None:
            f[:], g[:] = self.transition, duration * self.control

        def sensor(x: Floats, target: Floats) -> tuple[float, ...]:
            return tuple(self.look @ (x - target))

        def sensor_jacobian(x: Floats, target: Floats, rows: Floats) -> None:
            rows[:] = self.look

        angular = tuple(row == len(self.look) - 1 for row in range(len(self.look)))
        return Models(len(self.transition), motion, motion_jacobians, sensor, sensor_jacobian, angular)


def one_set(dimension: int, kappa: float) -> SampleSets:
    """The unscented samples, for every step."""
    samples = unscented(dimension, kappa)
    return SampleSets(samples.points[None], samples.weights[None], 0, 0)


@pytest.mark.parametrize(("make", "kappa"), [(linearised, None), (sampled, 0.0), (sampled, 1.7)])
@given(st.integers(1, 4), st.integers(1, 3), st.integers(1, 5), seeds)
def test_filters_are_exact_for_linear_models_of_any_size(
    make: Callable[[Models], Filter],
    kappa: float | None,
    states: int,
    controls: int,
    components: int,
    seed: int,
):
    """Sizes that no family has: nothing in the parts knows of three states and two components."""
    generator = np.random.default_rng(seed)
    linear = Linear(
        generator.normal(size=(states, states)),
        generator.normal(size=(states, controls)),
        0.1 * generator.normal(size=(components, states)),
    )
    linear.look[-1] *= 0.01  # the samples of an angle stay within half a turn
    memory, predict, innovate = make(linear.models())
    work = memory(states, controls, components, one_set(states, kappa or 0.0))
    x, p = generator.normal(size=states), positive_definite(generator, states)
    u, density = generator.normal(size=controls), generator.uniform(size=controls)
    mean, covariance = x.copy(), p.copy()
    assert predict(mean, covariance, u, density, 0.5, 0, work)
    gain = 0.5 * linear.control
    p = linear.transition @ p @ linear.transition.T + gain @ np.diag(density**2 / 0.5) @ gain.T
    x = linear.transition @ x + gain @ u
    assert_allclose(mean, x, atol=1e-9)
    assert_allclose(covariance, p, atol=1e-9)
    target, variance = generator.normal(size=states), generator.uniform(size=components)
    measured = linear.look @ (x - target) + 0.1
    measured[-1] += 2 * np.pi  # a turn more is the same angle
    innovation = no_innovation(states, components)
    assert innovate(mean, covariance, target, measured, variance, innovation, 0, work)
    assert_allclose(innovation.difference, 0.1, atol=1e-9)
    assert_allclose(
        innovation.covariance, linear.look @ p @ linear.look.T + np.diag(variance), atol=1e-9
    )
    assert_allclose(innovation.cross_covariance, p @ linear.look.T, atol=1e-9)


def test_sampling_says_where_the_covariance_is_none():
    linear = Linear(np.eye(2), np.eye(2), np.eye(2))
    memory, predict, innovate = sampled(linear.models())
    work = memory(2, 2, 2, one_set(2, 0.0))
    one = np.ones(2)
    assert not predict(np.zeros(2), -np.eye(2), one, one, 1.0, 0, work)
    assert not innovate(np.zeros(2), -np.eye(2), one, one, one, no_innovation(2, 2), 0, work)
