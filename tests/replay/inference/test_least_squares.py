"""The search, the bound and the report of every run, on models small enough to know the answer."""

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.replay.estimators.localization.least_squares import (
    SENTENCES,
    Linearization,
    Status,
    cramer_rao_bound,
    describe_direction,
    information_root,
    mask_missing,
    solve,
    unobservable_directions,
)


def fisher_information(at: Linearization) -> np.ndarray:
    """Fisher information (runs, n, n), from its root."""
    root = information_root(at)
    return np.swapaxes(root, 1, 2) @ root


def linear_model(matrix: np.ndarray, measured: np.ndarray, covariance: np.ndarray):
    """Predictions matrix @ parameters, the same matrix and covariance for all runs."""

    def model(parameters: np.ndarray, rows: np.ndarray) -> Linearization:
        runs = len(parameters)
        residual = measured[rows] - parameters @ matrix.T
        return Linearization(
            residual,
            np.broadcast_to(matrix, (runs, *matrix.shape)),
            np.broadcast_to(covariance, (runs, *covariance.shape)),
        )

    return model


def test_linear_problem_is_solved_in_one_step_with_its_textbook_covariance() -> None:
    """Columns of very different scale and correlated noise: (H' R^-1 H)^-1 H' R^-1 z."""
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(6, 3)) * [1e-4, 1.0, 1e5]
    root = rng.normal(size=(2, 3, 3))
    blocks = root @ np.swapaxes(root, 1, 2) + np.eye(3)
    full = np.zeros((6, 6))
    full[:3, :3], full[3:, 3:] = blocks
    measured = rng.normal(size=(4, 6))
    solution = solve(linear_model(matrix, measured, blocks), np.zeros((4, 3)))
    normal = matrix.T @ np.linalg.solve(full, matrix)
    expected = np.linalg.solve(normal, matrix.T @ np.linalg.solve(full, measured.T)).T
    np.testing.assert_allclose(solution.parameters, expected, rtol=1e-9)
    np.testing.assert_allclose(solution.covariance[0], np.linalg.inv(normal), rtol=1e-9)
    assert (solution.status == Status.CONVERGED).all()
    assert (solution.iterations == 2).all()


def test_trace_term_of_the_information() -> None:
    """N(a, b) tells 1/b about its mean and 1/(2 b^2) about its variance, diagonal or in blocks."""
    b = 2.5
    jacobian = np.zeros((1, 2, 2))
    jacobian[0, :, 0] = 1.0
    slope = np.zeros((1, 2, 2))
    slope[0, :, 1] = 1.0
    diagonal = Linearization(np.zeros((1, 2)), jacobian, np.full((1, 2), b), slope)
    block = diagonal._replace(
        covariance=b * np.eye(2)[None, None],
        covariance_jacobian=np.eye(2)[None, None, :, :, None] * [0, 1],
    )
    for at in (diagonal, block):
        np.testing.assert_allclose(
            fisher_information(at)[0], np.diag([2 / b, 2 / (2 * b**2)]), rtol=1e-14
        )


def arctangent_model(parameters: np.ndarray, _: np.ndarray) -> Linearization:
    """arctan(x) = 0: from |x| > 1.39 full Gauss-Newton steps run away."""
    slope = 1.0 / (1.0 + parameters**2)
    return Linearization(-np.arctan(parameters), slope[:, :, None], np.ones_like(parameters))


def test_step_control_brings_a_runaway_home() -> None:
    solution = solve(arctangent_model, np.array([[3.0], [0.5], [-20.0]]))
    assert solution.converged.all()
    assert np.abs(solution.parameters).max() < 1e-6


def test_a_failing_run_is_told_and_leaves_the_others_bit_for_bit() -> None:
    """One run without a start, one without finite values, one that runs off, among good ones."""

    def model(parameters: np.ndarray, rows: np.ndarray) -> Linearization:
        at = arctangent_model(parameters, rows)
        residual = np.where((rows == 2)[:, None], np.nan, at.residual)
        residual = np.where((rows == 3)[:, None], np.exp(-parameters), residual)
        jacobian = np.where((rows == 3)[:, None, None], np.exp(-parameters)[:, :, None], at.jacobian)
        return Linearization(residual, jacobian, at.covariance)

    start = np.array([[0.5], [np.nan], [0.5], [0.5], [0.7]])
    together = solve(model, start, max_iterations=10)
    assert together.status.tolist() == [
        Status.CONVERGED,
        Status.NO_START,
        Status.NOT_FINITE,
        Status.ITERATION_LIMIT,
        Status.CONVERGED,
    ]
    assert set(together.status) <= set(SENTENCES) == set(Status)
    assert np.isnan(together.covariance[1]).all()
    alone = solve(arctangent_model, start[[4]])
    assert all(
        column[4].tobytes() == own[0].tobytes() for column, own in zip(together, alone, strict=True)
    )


def test_unobservable_direction_is_found_and_named() -> None:
    """Only x + 2 y and z are measured: (2, -1, 0) is free, so x and y have no finite variance."""
    matrix = np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 1e-6]])
    model = linear_model(matrix, np.ones((1, 3)), np.ones(3))
    solution = solve(model, np.zeros((1, 3)))
    assert solution.status[0] == Status.UNOBSERVABLE
    assert solution.rank[0] == 2
    bound = cramer_rao_bound(model(np.zeros((1, 3)), np.array([0])))
    np.testing.assert_array_equal(np.isinf(np.diagonal(bound.covariance[0])), [True, True, False])
    assert bound.covariance[0, 2, 2] == pytest.approx(1e12)
    [directions] = unobservable_directions(model(np.zeros((1, 3)), np.array([0])))
    text = describe_direction(["x_m", "y_m", "z_m"], directions[:, 0])
    assert text == "x_m +1, y_m -0.5"


def test_fewer_measurements_than_parameters_is_a_rank_and_not_an_exception() -> None:
    model = linear_model(np.array([[1.0, 1.0, 0.0]]), np.ones((2, 1)), np.ones(1))
    solution = solve(model, np.zeros((2, 3)))
    assert solution.rank.tolist() == [1, 1]
    assert (solution.status == Status.UNOBSERVABLE).all()


def test_missing_measurement_weighs_nothing() -> None:
    """Masking a row in a block equals leaving it out, in estimate and information."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3))
    at = Linearization(
        rng.normal(size=(1, 3)),
        rng.normal(size=(1, 3, 2)),
        (root @ root.T + np.eye(3))[None, None],
        rng.normal(size=(1, 1, 3, 3, 2)),
    )
    masked = mask_missing(at, np.array([[True, False, True]]))
    kept = [0, 2]
    left_out = Linearization(
        at.residual[:, kept],
        at.jacobian[:, kept],
        at.covariance[:, :, kept][..., kept],
        at.covariance_jacobian[:, :, kept][:, :, :, kept],
    )
    np.testing.assert_allclose(fisher_information(masked), fisher_information(left_out), rtol=1e-12)


def test_a_covariance_that_is_not_positive_stops_its_own_run_only() -> None:
    covariance = np.array([np.eye(2), -np.eye(2)])[:, None]

    def model(parameters: np.ndarray, rows: np.ndarray) -> Linearization:
        jacobian = np.broadcast_to(np.eye(2), (len(rows), 2, 2))
        return Linearization(1.0 - parameters, jacobian, covariance[rows])

    solution = solve(model, np.zeros((2, 2)))
    assert solution.status.tolist() == [Status.CONVERGED, Status.NOT_FINITE]
    np.testing.assert_allclose(solution.parameters[0], 1.0)


def test_a_start_of_the_wrong_shape_is_refused() -> None:
    with pytest.raises(BadInput, match="runs, parameters"):
        solve(arctangent_model, np.zeros(3))
