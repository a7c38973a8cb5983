"""The parts of Gaussian filters, uncompiled and in sizes of no family, beside NumPy's algebra."""

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from fuselog.recorders.log import schemas
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.kalman.steps import (
    NOT_FINITE,
    NOT_POSITIVE_DEFINITE,
    NOTHING_MEASURED,
    Gaussian,
    InnovationRecord,
    Interval,
    Measurement,
    Workspace,
    workspace,
)
from fuselog.replay.inference.kalman.update import kalman_update
from fuselog.replay.inference.linear_algebra.gaussian import cholesky
from fuselog.replay.inference.linear_algebra.manifold import boxminus, boxplus, recentring
from fuselog.replay.inference.linear_algebra.sparse import pattern_of, propagating_covariance
from fuselog.replay.inference.model.bound_model import BoundModel, bound_model_of
from fuselog.replay.inference.model.model import Control, Map, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.run.recursion import fault_of
from fuselog.replay.inference.sampling.samplers import unscented
from fuselog.replay.inference.sampling.sets import SampleSets

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


@given(st.integers(1, 6), seeds, st.booleans())
def test_a_covariance_goes_through_a_known_pattern_as_through_any_matrix(
    size: int, seed: int, has_pattern: bool
):
    generator = np.random.default_rng(seed)
    given = np.where(generator.random((size, size)) < 0.5, 0.0, generator.normal(size=(size, size)))
    left = generator.random(size) < 0.5
    given[left] = np.eye(size)[left]
    varies = [None if place[0] != place[1] else given[place] for place in np.ndindex(size, size)]
    known = {
        place: value
        for place, value in zip(np.ndindex(size, size), varies, strict=True)
        if given[place] != 0.0
    }
    covariance = positive_definite(generator, size)
    wanted, product = given @ covariance, np.empty((size, size))
    move = propagating_covariance(pattern_of(known if has_pattern else None, size))
    move(covariance, given, product)
    assert_allclose(product, wanted, atol=1e-12)
    assert_allclose(covariance, wanted @ given.T, atol=1e-12)
    assert_array_equal(covariance, covariance.T)


@pytest.mark.parametrize("last", [0.0, -1.0, np.nan, 0.25])
def test_cholesky_refuses_what_is_not_positive_definite(last: float):
    matrix = np.array([[4.0, 1.0], [1.0, last]])
    assert not cholesky(np.zeros((2, 2)), matrix, 2)


def names(letter: str, count: int) -> tuple[str, ...]:
    return tuple(f"{letter}{index}" for index in range(count))


def all_linear(letter: str, count: int) -> dict[str, Any]:
    return dict.fromkeys(names(letter, count), "linear")


def nothing(*_: Any) -> tuple[float, ...]:
    raise AssertionError


def empty_record(components: int) -> InnovationRecord:
    return InnovationRecord(np.empty(components), np.empty((components, components)), np.empty(3))


def correct(
    mean: Floats, covariance: Floats, v: Floats, s: Floats, c: Floats, gate: Floats
) -> tuple[int, InnovationRecord]:
    """The Kalman update by an innovation v with covariance S and cross-covariance C."""
    sensor = Sensor("sensor", schemas.VECTOR_MEASUREMENT, all_linear("z", len(v)), nothing)
    motion = Motion(nothing)
    bound_model = BoundModel(
        Model("", all_linear("x", len(mean)), ModelParameters, (sensor,), motion), motion, (sensor,)
    )

    def innovate(mean: Floats, covariance: Floats, measurement: Measurement, work: Workspace) -> bool:
        for place, value in zip(work.innovations[0], (measurement.data, s, c), strict=True):
            place[:] = value
        return True

    record = empty_record(len(v))
    update = kalman_update(bound_model, 0, innovate)
    plain = noise_of(np.empty(0), np.empty(0))  # no robust update
    return update(
        mean, covariance, Measurement(v, plain, gate, 0), workspace(bound_model), record
    ), record


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
    told, record = correct(
        mean, covariance, np.where(kept, v, np.nan), s, c, np.full(components + 1, np.inf)
    )
    squared, log_likelihood, accepted = record.numbers
    assert told == ALL_WELL
    assert accepted
    assert_allclose(squared, v[kept] @ np.linalg.solve(s[np.ix_(kept, kept)], v[kept]), rtol=1e-6)
    assert_allclose(log_likelihood, multivariate_normal.logpdf(v[kept], cov=s[np.ix_(kept, kept)]))
    assert_allclose(mean, x + gain @ v[kept], atol=1e-7)
    assert_allclose(covariance, p - gain @ c[:, kept].T, atol=1e-7)
    assert_array_equal(covariance, covariance.T)
    assert_array_equal(record.difference, np.where(kept, v, np.nan))
    assert_array_equal(record.covariance, np.where(np.outer(kept, kept), s, np.nan))


def test_a_shut_gate_and_a_broken_innovation_change_nothing():
    shut, broken = (np.eye(2), 1.99, ALL_WELL), (-np.eye(2), np.inf, NOT_POSITIVE_DEFINITE)
    for s, gate, expected in (shut, broken):
        mean, covariance = np.zeros(3), np.eye(3)
        gates = np.array([0, 0, gate])
        told, record = correct(mean, covariance, np.ones(2), s, np.ones((3, 2)), gates)
        assert told == expected
        if told == ALL_WELL:
            assert_array_equal(record.numbers, [2.0, 0.0, 0.0])
        assert_array_equal(mean, 0)
        assert_array_equal(covariance, np.eye(3))
    taken = np.zeros(3), np.eye(3), np.ones(2), np.eye(2), np.ones((3, 2)), np.full(3, 2.0)
    assert correct(*taken)[1].numbers[2]
    nothing_there = np.zeros(3), np.eye(3), np.full(2, np.nan), np.eye(2), np.ones((3, 2)), np.ones(3)
    assert correct(*nothing_there)[0] == NOTHING_MEASURED


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_every_entry_of_an_estimate_is_looked_at(bad: float):
    assert fault_of(np.ones(2), np.eye(2)) == ALL_WELL
    assert fault_of(np.array([1.0, bad]), np.eye(2)) == NOT_FINITE
    assert fault_of(np.ones(2), np.array([[1.0, 0.0], [bad, 1.0]])) == NOT_FINITE
    assert fault_of(np.ones(2), np.diag([1.0, -1e-9])) == NOT_POSITIVE_DEFINITE


# Linear models: every filter is exact, whatever its samples.


ROBUST = ("inflate_nis", "student_freedom", "switch_nis")


def noise_of(density: Floats, variance: Floats) -> Any:
    """What the functions of `Linear` get as parameters."""
    fields = (*names("density", len(density)), *names("variance", len(variance)), *ROBUST)
    return namedtuple("Noise", fields)(*density, *variance, *[np.nan] * len(ROBUST))


def times(matrix: Floats, vector: Any) -> tuple[Any, ...]:
    """Component-first, so that it takes derivatives as well."""
    return tuple(
        sum(entry * each for entry, each in zip(row, vector, strict=True)) for row in matrix.tolist()
    )


class Linear(NamedTuple):
    """x' = F x + T B u and z = H (x - target), the last component an angle."""

    transition: Floats
    control: Floats
    look: Floats

    def bound_model(self) -> Any:
        """As component-first functions."""
        states, controls, components = len(self.transition), self.control.shape[1], len(self.look)

        def move(x: Any, u: Any, duration: float, _: Any) -> tuple[Any, ...]:
            driven = times(duration * self.control, u)
            return tuple(a + b for a, b in zip(times(self.transition, x), driven, strict=True))

        def measure(x: Any, target: Any, _: Any) -> tuple[Any, ...]:
            return times(self.look, [a - b for a, b in zip(x, target, strict=True)])

        def control_noise(duration: float, noise: Any) -> tuple[float, ...]:
            return tuple(getattr(noise, each) ** 2 / duration for each in names("density", controls))

        def variances(noise: Any) -> tuple[float, ...]:
            return tuple(getattr(noise, each) for each in names("variance", components))

        measured = {**all_linear("z", components), f"z{components - 1}": "angle"}
        targets = Map("/targets", schemas.LANDMARK, "landmark_id", "position_m", all_linear("p", states))
        schema = schemas.VECTOR_MEASUREMENT
        sensor = Sensor("sensor", schema, measured, measure, variances, reference=targets)
        motion = Motion(move, control_noise=control_noise)
        control = Control("control", schema, names("u", controls))
        state = all_linear("x", states)
        model = Model("", state, ModelParameters, (sensor,), motion, control=control)
        own = (*names("density", controls), *names("variance", components))
        return bound_model_of(model, motion, (sensor,), names=own)


def one_set(dimension: int, kappa: float) -> SampleSets:
    """The unscented samples, for every step."""
    samples = unscented(dimension, kappa)
    return SampleSets(samples.points[None], samples.weights[None], 0, 0)


@pytest.mark.paper
@pytest.mark.parametrize(("method", "kappa"), [("ekf", 0.0), ("iekf", 0.0), ("ukf", 0.0), ("ukf", 1.7)])
@settings(max_examples=12)
@given(st.integers(1, 4), st.integers(1, 3), st.integers(1, 5), seeds)
def test_filters_are_exact_for_linear_models_of_any_size(
    method: str, kappa: float, states: int, controls: int, components: int, seed: int
):
    """Sizes that no family has: nothing in the parts knows of three states and two components."""
    generator = np.random.default_rng(seed)
    linear = Linear(
        generator.normal(size=(states, states)),
        generator.normal(size=(states, controls)),
        0.1 * generator.normal(size=(components, states)),
    )
    linear.look[-1] *= 0.01  # the samples of an angle stay within half a turn
    steps = METHODS[method].steps(linear.bound_model())
    work = steps.memory((one_set(states, kappa),) * len(steps.sampled))
    x, p = generator.normal(size=states), positive_definite(generator, states)
    u, density = generator.normal(size=controls), generator.uniform(size=controls)
    variance = generator.uniform(0.01, 1.0, size=components)
    noise = noise_of(density, variance)
    belief = Gaussian(x[None].copy(), p[None].copy())
    assert steps.predict(0, belief, Interval(u, 0.5, noise, 0), work)
    gain = 0.5 * linear.control
    p = linear.transition @ p @ linear.transition.T + gain @ np.diag(density**2 / 0.5) @ gain.T
    x = linear.transition @ x + gain @ u
    assert_allclose(belief.mean[0], x, atol=1e-9)
    assert_allclose(belief.covariance[0], p, atol=1e-9)
    target = generator.normal(size=states)
    measured = linear.look @ (x - target) + 0.1
    measured[-1] += 2 * np.pi  # a turn more is the same angle
    data, record = np.append(measured, target), empty_record(components)
    gate = np.full(components + 1, np.inf)
    assert steps.updates[0](0, belief, Measurement(data, noise, gate, 0), work, record) == ALL_WELL
    spread = linear.look @ p @ linear.look.T + np.diag(variance)
    assert_allclose(record.difference, 0.1, atol=1e-9)
    assert_allclose(record.covariance, spread, atol=1e-9)
    gain = p @ linear.look.T @ np.linalg.inv(spread)
    assert_allclose(belief.mean[0], x + gain @ np.full(components, 0.1), atol=1e-7)
    assert_allclose(belief.covariance[0], p - gain @ linear.look @ p, atol=1e-7)


def test_sampling_says_where_the_covariance_is_none():
    steps = METHODS["ukf"].steps(Linear(np.eye(2), np.eye(2), np.eye(2)).bound_model())
    work = steps.memory((one_set(2, 0.0),) * 2)
    one = np.ones(2)
    noise, belief = noise_of(one, one), Gaussian(np.zeros((1, 2)), -np.eye(2)[None])
    assert not steps.predict(0, belief, Interval(one, 1.0, noise, 0), work)
    update = steps.updates[0]
    measurement = Measurement(np.ones(4), noise, np.full(3, np.inf), 0)
    told = update(0, belief, measurement, work, empty_record(2))
    assert told == NOT_POSITIVE_DEFINITE


@settings(max_examples=20)
@given(seeds)
def test_tangent_vectors_from_a_shifted_centre_lead_to_the_same_states(seed: int):
    """By less than half a turn, or half of that of an axis, however far they were."""
    generator = np.random.default_rng(seed)
    kinds = ("linear", "angle", "axis", "axis", *4 * ("quaternion",))
    values, shift = generator.uniform(-3.0, 3.0, (5, 6)), generator.uniform(-0.9, 0.9, 6)
    centre = np.array([2.0, 3.0, 0.6, 0.8, 1.0, 0.0, 0.0, 0.0])
    away, shifted = values.copy(), centre.copy()
    again = recentring(kinds)(away, shift)
    assert away[:, 0].tolist() == values[:, 0].tolist()  # linear: the caller subtracts the shift
    away[:, 0] -= shift[0]
    add, differ, apart = boxplus(kinds), boxminus(kinds), np.empty((5, 6))
    add(shifted, shift)
    for row, (old, new) in enumerate(zip(values, away, strict=True)):
        one, other = centre.copy(), shifted.copy()
        add(one, old)
        add(other, new)
        differ(tuple(one), tuple(other), apart, row)
    assert_allclose(apart, 0.0, atol=1e-7)
    assert again  # of a rotation that is not settled
    assert np.all(np.abs(away[:, 1]) <= np.pi)
    assert np.all(np.abs(away[:, 2]) <= 0.5 * np.pi)
