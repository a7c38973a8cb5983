"""Filters on the torus: the sheet's comparison, the grid as reference, and the contract."""

from itertools import pairwise

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.directional.headings import turn_on, turn_together
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.families.directional.distributions import wrapped_normal
from fuselog.replay.families.directional.distributions.wrapped_normal import (
    WrappedNormal,
    make_wrapped_normal,
)
from fuselog.replay.families.directional.grid import run_torus_grid_filter, torus_grid
from fuselog.replay.families.directional.torus import (
    HeadingModel,
    make_heading_model,
    run_toroidal_filter,
    run_unscented_filter,
)

pytestmark = pytest.mark.paper

STEPS = 50
DRIFT = (0.3, -0.2)


def model(coupling: float, sigma_q: float, rho_q: float, sigma_r: float, rho_r: float) -> HeadingModel:
    noise = [
        s * s * np.array([[1.0, rho], [rho, 1.0]]) for s, rho in ((sigma_q, rho_q), (sigma_r, rho_r))
    ]
    return make_heading_model(coupling, DRIFT, *noise)


def start(runs: int) -> WrappedNormal:
    return WrappedNormal(np.zeros((runs, 2)), np.broadcast_to(np.eye(2), (runs, 2, 2)))


def simulate(given: HeadingModel, runs: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Truth (runs, steps, 2), offsets, and measurements (rows, 2) in [0, 2 pi)."""
    generator = np.random.default_rng(seed)
    truth = np.empty((runs, STEPS, 2))
    x = generator.standard_normal((runs, 2))
    for step in range(STEPS):
        moved = turn_together(x[:, 0], x[:, 1], given.coupling_rad, *DRIFT)
        x = np.stack(moved, axis=-1) + generator.multivariate_normal((0, 0), given.system, runs)
        truth[:, step] = x
    noise = generator.multivariate_normal((0, 0), given.measurement, (runs, STEPS))
    measured = (truth + noise) % (2.0 * np.pi)
    return truth, np.arange(runs + 1) * STEPS, measured.reshape(-1, 2)


def rmse(truth: np.ndarray, estimate: np.ndarray) -> float:
    return float(np.sqrt((wrap_angle(estimate.reshape(truth.shape) - truth) ** 2).mean()))


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ((0.1, 0.2, 0.8, 0.8, 0.5), (0.393, 0.404, 1.18)),
        ((0.1, 0.2, 0.8, 1.3, 0.5), (0.590, 0.715, 1.53)),
        ((0.5, 0.3, 0.8, 1.0, 0.8), (0.599, 0.683, 1.38)),
        ((0.1, 0.2, 0.8, 0.3, 0.5), (0.208, 0.208, 0.59)),
    ],
)
def test_comparison_of_the_sheet(parameters, expected):
    """Torus filter, wrapped and naive UKF over 400 runs; the sheet's 100 runs are good to .02.

    The naive filter's errors come from rare wraps, so that its mean of 100 runs is good to .05.
    """
    given = model(*parameters)
    truth, offsets, measured = simulate(given, 400, 3)
    estimates = [
        run_toroidal_filter(given, start(400), offsets, measured)[1],
        *(
            run_unscented_filter(given, start(400), offsets, measured, wrapped=wrapped)[1]
            for wrapped in (True, False)
        ),
    ]
    found = [rmse(truth, each.mean) for each in estimates]
    assert np.all(np.abs(np.subtract(found, expected)) < (0.02, 0.02, 0.05)), found
    assert found[0] <= found[1] + 1e-4 < found[2]


def test_toroidal_filter_is_nearly_as_good_as_a_grid():
    """The sheet's first row, where 48 x 48 cells reach .392; the same 20 runs for both."""
    given = model(0.1, 0.2, 0.8, 0.8, 0.5)
    truth, offsets, measured = simulate(given, 20, 5)
    own = run_toroidal_filter(given, start(20), offsets, measured)[1]
    density = wrapped_normal.density(make_wrapped_normal([0.0, 0.0], np.eye(2)), torus_grid(32))
    cells = np.broadcast_to(density / density.sum(), (20, 32, 32))
    grid = run_torus_grid_filter(given, cells, offsets, measured)
    assert rmse(truth, own.mean) == pytest.approx(rmse(truth, grid.mean), abs=0.005)
    np.testing.assert_allclose(grid.state.sum(axis=(1, 2)), 1.0)


def test_an_angle_that_is_not_measured():
    """A direction alone, of a motion whose second angle is its turn: filters beside a grid."""
    given = make_heading_model(0.5, (0.0, 0.0), 0.2**2 * np.eye(2), 0.3**2 * np.eye(2))
    generator = np.random.default_rng(2)
    truth, x = np.empty((60, 2)), np.zeros(2)
    for each in truth:
        x = np.array(turn_on(*x, 0.5, 0.0, 0.0)) + 0.2 * generator.standard_normal(2)
        each[:] = x
    measured = truth + 0.3 * generator.standard_normal(truth.shape)
    measured[:, 1] = np.nan
    offsets, density = (
        np.array([0, 60]),
        wrapped_normal.density(WrappedNormal(np.zeros(2), np.eye(2)), torus_grid(32)),
    )
    grid = run_torus_grid_filter(given, density[None] / density.sum(), offsets, measured, turn_on)
    for own in (
        run_toroidal_filter(given, start(1), offsets, measured, motion=turn_on)[1],
        run_unscented_filter(given, start(1), offsets, measured, motion=turn_on, wrapped=True)[1],
    ):
        np.testing.assert_allclose(wrap_angle(own.mean - grid.mean), 0.0, atol=0.1)
    alone = given._replace(measurement=np.diag([0.3**2, 80.0]))
    same = run_toroidal_filter(alone, start(1), offsets, np.nan_to_num(measured), motion=turn_on)[1]
    own = run_toroidal_filter(given, start(1), offsets, measured, motion=turn_on)[1]
    assert np.array_equal(own.mean, same.mean)
    assert np.isfinite(grid.log_density).all()


@pytest.fixture(scope="module")
def ragged() -> tuple[HeadingModel, np.ndarray, np.ndarray]:
    """Runs of different lengths, one empty, with missing measurements."""
    given = model(0.5, 0.3, 0.8, 1.0, 0.8)
    _, _, measured = simulate(given, 3, 1)
    measured[5:8] = np.nan
    return given, np.array([0, 40, 40, 70, 150]), measured


def grid_filter(given, state, offsets, measured):
    found = run_torus_grid_filter(given, state[0], offsets, measured)
    return (found.state,), (found.mean,)


FILTERS = {
    "toroidal": run_toroidal_filter,
    "wrapped": lambda *given: run_unscented_filter(*given, wrapped=True),
    "naive": lambda *given: run_unscented_filter(*given, wrapped=False),
    "grid": grid_filter,
}


@pytest.mark.parametrize("name", FILTERS)
def test_ensemble_equals_single_runs_and_blocks_equal_the_whole(ragged, name):
    """Bit for bit: the replay's contract."""
    given, offsets, measured = ragged
    run = FILTERS[name]

    def begin(runs: int):
        return (np.full((runs, 12, 12), 1.0 / 144),) if name == "grid" else start(runs)

    ends, whole = run(given, begin(4), offsets, measured)
    for index, (first, last) in enumerate(pairwise(offsets)):
        cut = (first + last) // 2
        state, early = run(given, begin(1), np.array([0, cut - first]), measured[first:cut])
        state, late = run(given, state, np.array([0, last - cut]), measured[cut:last])
        for part, end, before, after, at_end in zip(whole, ends, early, late, state, strict=True):
            assert np.array_equal(part[first:last], np.concatenate([before, after]))
            assert np.array_equal(end[index], at_end[0])


def test_a_run_that_fails_is_nan_and_the_others_go_on(ragged):
    given, offsets, measured = ragged
    broken = WrappedNormal(np.zeros((4, 2)), np.array([np.eye(2), np.eye(2), -np.eye(2), np.eye(2)]))
    for name in ("toroidal", "wrapped"):
        expected = FILTERS[name](given, start(4), offsets, measured)[1]
        found = FILTERS[name](given, broken, offsets, measured)[1]
        assert np.isnan(found.mean[40:70]).all()
        others = np.r_[0:40, 70:150]
        assert np.array_equal(found.mean[others], expected.mean[others])


def test_bad_input_is_told(ragged):
    given, offsets, _ = ragged
    with pytest.raises(BadInput, match="positive definite"):
        make_heading_model(0.1, DRIFT, np.eye(2), [[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(BadInput, match="drift"):
        make_heading_model(0.1, (0.0, np.nan), np.eye(2), np.eye(2))
    with pytest.raises(BadInput, match="central weight"):
        run_toroidal_filter(given, start(4), offsets, np.zeros((150, 2)), central_weight=0.6)
    with pytest.raises(BadInput, match=r"shape \(10, 2\)"):
        run_toroidal_filter(given, start(4), offsets, np.zeros((10, 2)))
