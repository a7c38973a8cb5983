"""Bias estimation from lines of sight against an independent one of Belfadel et al., JAIF 2014."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from fuselog.recorders.errors import BadInput
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.vectors.covariances import normalized_error_squared
from fuselog.replay.estimators.localization.least_squares import Status, cramer_rao_bound, solve
from fuselog.replay.families.los import localization as optical
from fuselog.replay.families.los.localization import Scene
from fuselog.replay.judging.errors.evaluation import chi_square_interval

pytestmark = pytest.mark.paper

SCENARIOS = Path(__file__).parents[4] / "data" / "scenarios"
# (bias in deg, noise in rad): as the paper states them, and as they reproduce its table III.
STATED = (1.0, 0.34e-3)
REPRODUCING = (3.0, 0.300e-3)

TABLE_III_MRAD = np.array(
    [
        [2.872, 1.183, 2.679, 6.721, 1.129, 3.639, 2.954, 1.341, 2.459],
        [2.028, 1.190, 2.485, 7.855, 1.129, 3.138, 4.355, 1.362, 1.835],
        [2.600, 1.124, 5.780, 7.054, 1.140, 6.455, 4.969, 1.239, 5.105],
        [2.801, 1.243, 6.198, 7.094, 1.201, 6.976, 5.024, 1.388, 5.634],
        [3.334, 1.646, 4.034, 7.078, 2.295, 5.253, 5.011, 2.150, 3.869],
    ]
)


def three_sensors(scenario: int, bias_deg: float, sigma_rad: float) -> tuple[Scene, np.ndarray]:
    """Scheme 3 of a three-sensor scenario and its true parameters (1, 18)."""
    return read(f"optical-three-sensors-{scenario}", bias_deg, sigma_rad, np.full((3, 3), np.nan))


def two_sensors(scenario: int, known_roll: bool = True) -> tuple[Scene, np.ndarray]:
    """The five-bias case with its roll known, or all six biases, at 1 deg and 0.300 mrad."""
    known = np.full((2, 3), np.nan)
    if known_roll:
        known[1, 2] = 0.0
    return read(f"optical-two-sensors-{scenario}", 1.0, 0.300e-3, known)


def read(
    name: str, bias_deg: float, sigma_rad: float, known_bias_rad: np.ndarray
) -> tuple[Scene, np.ndarray]:
    given = tomllib.loads((SCENARIOS / f"{name}.toml").read_text())["parameters"]
    sensors = np.array(given["sensor_position_m"])
    scene = Scene(sensors, np.zeros_like(sensors), np.full((len(sensors), 2), sigma_rad), known_bias_rad)
    bias = np.full(scene.wanted.sum(), np.radians(bias_deg))
    return scene, np.concatenate([np.ravel(given["target_position_m"]), bias])[None]


def without_bias(scene: Scene) -> Scene:
    """Positions only: schemes 1 and 2."""
    return scene._replace(known_bias_rad=np.zeros_like(scene.position_m))


def sigma(scene: Scene, truth: np.ndarray) -> np.ndarray:
    bound = cramer_rao_bound(optical.linearize(scene, optical.predict(scene, truth), truth))
    return np.sqrt(np.diagonal(bound.covariance[0]))


def by_target(values: np.ndarray, targets: int) -> np.ndarray:
    """Root of the summed squares of each target's coordinates."""
    return np.linalg.norm(values[..., : 3 * targets].reshape(*values.shape[:-1], targets, 3), axis=-1)


def simulate(scene: Scene, truth: np.ndarray, runs: int, seed: int) -> np.ndarray:
    clean = optical.predict(scene, truth)
    noise = np.random.default_rng(seed).normal(size=(runs, *clean.shape[1:]))
    return wrap_angle(clean + scene.sigma_rad * noise)


def rank(scene: Scene, truth: np.ndarray) -> int:
    return optical.observability(scene, optical.predict(scene, truth)[0], truth[0]).rank


def test_whole_jacobian_equals_differences() -> None:
    """Every derivative stands in its target's and sensor's column, known biases have none."""
    scene, truth = two_sensors(2)
    measured = optical.predict(scene, truth)
    at = optical.linearize(scene, measured, truth)
    step = 1e-6 * np.maximum(1.0, np.abs(truth[0]))
    moved = optical.predict(scene, truth + np.diag(step)) - optical.predict(scene, truth - np.diag(step))
    differences = moved.reshape(len(step), -1).T / (2 * step)
    np.testing.assert_allclose(at.jacobian[0], differences, atol=1e-8)


def test_table_iii_is_reproduced_at_three_degrees_and_not_as_stated() -> None:
    """All 45 CRLB deviations within 1.23 % (rms 0.43 %); with the stated parameters 20.7 % are off."""

    def deviation(bias_deg: float, sigma_rad: float) -> np.ndarray:
        ours = [sigma(*three_sensors(s, bias_deg, sigma_rad))[9:] for s in range(1, 6)]
        return 1e3 * np.array(ours) / TABLE_III_MRAD - 1.0

    reproducing = deviation(*REPRODUCING)
    assert np.abs(reproducing).max() == pytest.approx(0.0123, abs=1e-4)
    assert np.sqrt((reproducing**2).mean()) == pytest.approx(0.0043, abs=1e-4)
    assert np.abs(deviation(*STATED)).max() == pytest.approx(0.207, abs=1e-3)


@pytest.mark.parametrize(
    ("parameters", "bias_mrad", "scheme_3_m", "scheme_1_m"),
    [
        (
            REPRODUCING,
            [2.875, 1.183, 2.679, 6.741, 1.128, 3.642, 2.963, 1.342, 2.460],
            [36.5, 41.5, 35.4],
            [2.73, 3.51, 2.73],
        ),
        (
            STATED,
            [3.313, 1.342, 2.765, 7.788, 1.230, 3.745, 3.414, 1.505, 2.644],
            [41.5, 47.0, 40.3],
            [3.09, 3.98, 3.09],
        ),
    ],
)
def test_bounds_of_scenario_1(
    parameters: tuple, bias_mrad: list, scheme_3_m: list, scheme_1_m: list
) -> None:
    """Table II and the sheet's numbers: any slip in frame, rotation or order shows here."""
    scene, truth = three_sensors(1, *parameters)
    deviations = sigma(scene, truth)
    np.testing.assert_allclose(1e3 * deviations[9:], bias_mrad, rtol=1e-3)
    np.testing.assert_allclose(by_target(deviations, 3), scheme_3_m, atol=0.06)
    known = sigma(without_bias(scene), truth[:, :9])
    np.testing.assert_allclose(by_target(known, 3), scheme_1_m, atol=0.006)


@pytest.mark.parametrize(
    ("bias_deg", "errors_m"), [(1.0, [146.35, 167.42, 134.66]), (-1.0, [158.96, 169.14, 158.29])]
)
def test_scheme_2_fixes_the_sense_of_the_rotation(bias_deg: float, errors_m: list) -> None:
    """Noise-free table II (146.61, 167.43, 134.80): eq (1), which turns the other way, is refuted."""
    scene, truth = three_sensors(1, bias_deg, 0.34e-3)
    found = optical.estimate(without_bias(scene), optical.predict(scene, truth))
    np.testing.assert_allclose(by_target(found.parameters - truth[:, :9], 3)[0], errors_m, atol=0.006)


@pytest.mark.parametrize(
    ("parameters", "scenario", "expected"),
    [
        *((REPRODUCING, s, nees) for s, nees in enumerate([18.41, 18.21, 18.44, 18.56, 18.78], 1)),
        *((STATED, s, nees) for s, nees in enumerate([21.24, 18.21, 18.46, 18.58, 18.93], 1)),
    ],
)
def test_three_sensors_are_efficient(parameters: tuple, scenario: int, expected: float) -> None:
    """2000 runs converge in five steps and NEES holds; not in scenario 1 at 1 deg, told honestly.

    There sensor 2 sees target 2 at 88.8 deg, where azimuth says next to nothing. `expected` comes from
    1000 runs of another program; 20000 of ours give 18.25 18.19 18.54 18.39 18.91 and 20.78 18.21 18.56
    18.43 19.09, so that scenario 5 passes a test of 100 runs only two times in three.
    """
    scene, truth = three_sensors(scenario, *parameters)
    solution = optical.estimate(scene, simulate(scene, truth, 2000, seed=1))
    assert solution.converged.all()
    assert (solution.rank == 18).all()
    assert solution.iterations.max() <= 5
    # 18 angles for 18 parameters: the fit is exact and cannot judge itself.
    assert solution.cost.max() < 1e-10
    error = solution.parameters - truth
    at_truth = cramer_rao_bound(optical.linearize(scene, optical.predict(scene, truth), truth))
    nees = normalized_error_squared(error, at_truth.covariance)
    assert nees.mean() == pytest.approx(expected, abs=3.0 * nees.std() * np.sqrt(1 / 1000 + 1 / 2000))
    at_estimate = normalized_error_squared(error, solution.covariance)
    assert at_estimate.mean() == pytest.approx(nees.mean(), rel=0.005)
    low, high = chi_square_interval(18, 100)
    if scenario == 1 and parameters is STATED:
        assert nees.mean() > high
        elevation = optical.predict(scene, truth)[0, 1, 1, 1]
        assert np.degrees(elevation) == pytest.approx(88.8, abs=0.05)
    else:
        assert low < nees.mean() < high


@pytest.mark.parametrize("scenario", range(1, 6))
def test_two_sensors_are_efficient_with_one_roll_known(scenario: int) -> None:
    scene, truth = two_sensors(scenario)
    solution = optical.estimate(scene, simulate(scene, truth, 1000, seed=scenario))
    assert solution.converged.all()
    assert (solution.rank == 23).all()
    assert solution.iterations.max() <= 6
    error = solution.parameters - truth
    at_truth = cramer_rao_bound(optical.linearize(scene, optical.predict(scene, truth), truth))
    low, high = chi_square_interval(23, 1000)
    assert low < normalized_error_squared(error, at_truth.covariance).mean() < high
    rmse = np.sqrt((error**2).mean(axis=0)) / np.sqrt(np.diagonal(at_truth.covariance[0]))
    assert np.abs(rmse - 1.0).max() < 0.11  # 5 sigma of a deviation from 1000 runs


@pytest.mark.parametrize(
    ("dimension", "low", "high"), [(18, 16.843, 19.195), (23, 21.690, 24.348), (1, 0.742, 1.296)]
)
def test_intervals_of_100_runs(dimension: int, low: float, high: float) -> None:
    """The paper's probability regions for 18, 23 and single components."""
    assert chi_square_interval(dimension, 100) == pytest.approx((low, high), abs=6e-4)


def test_two_sensor_bounds_of_scenario_2() -> None:
    scene, truth = two_sensors(2)
    deviations = sigma(scene, truth)
    scheme_3 = by_target(deviations, 6)
    np.testing.assert_allclose(scheme_3, [6.55, 6.71, 6.27, 5.69, 7.40, 7.59], atol=0.006)
    np.testing.assert_allclose(1e3 * deviations[18:], [0.245, 0.441, 1.613, 0.4465, 0.240], atol=6e-4)
    scheme_1 = by_target(sigma(without_bias(scene), truth[:, :18]), 6)
    np.testing.assert_allclose(scheme_1, [3.52, 4.86, 3.74, 3.90, 4.44, 3.60], atol=0.006)


@pytest.mark.parametrize("scenario", range(1, 6))
def test_scheme_2_does_converge_with_two_sensors(scenario: int) -> None:
    """The paper says that it does not; it takes 7 or 8 steps to errors of 29 to 415 m."""
    scene, truth = two_sensors(scenario)
    found = optical.estimate(without_bias(scene), optical.predict(scene, truth))
    assert found.converged.all()
    assert found.iterations[0] in (7, 8)
    errors = by_target(found.parameters - truth[:, :18], 6)
    assert errors.min() > 28.0
    assert errors.max() < 415.0


@pytest.mark.parametrize(("targets", "expected"), [(5, 20), (6, 23), (10, 35), (40, 125)])
def test_two_sensors_always_lack_one_rank(targets: int, expected: int) -> None:
    """All may turn about the line through the sensors, however many targets there are."""
    scene, _ = two_sensors(1, known_roll=False)
    places = np.random.default_rng(targets).uniform([-5e3, 3e3, -2e3], [5e3, 8e3, 2e3], (targets, 3))
    truth = np.concatenate([places.ravel(), np.full(6, np.radians(1.0))])[None]
    told = optical.observability(scene, optical.predict(scene, truth)[0], truth[0])
    assert (told.rank, told.parameters) == (expected, expected + 1)
    assert told.turning_axis is not None
    np.testing.assert_allclose(told.turning_axis, [0.981, -0.107, -0.161], atol=6e-4)
    assert "turn together about the axis (0.981, -0.107, -0.161)" in told.sentence


def test_ranks_of_three_sensors() -> None:
    """Collinear sensors may turn about their line; two targets give 12 angles and rank 12 of 15."""
    scene, truth = three_sensors(1, *STATED)
    assert rank(scene, truth) == 18
    line = scene._replace(position_m=np.array([[-5e3, 0.0, 100.0], [0.0, 500, 200], [5e3, 1e3, 300]]))
    assert rank(line, truth) == 17
    _, six = two_sensors(1)
    more = np.concatenate([six[:, :18], np.full((1, 9), 0.02)], axis=1)
    assert rank(line, more) == 26
    assert rank(scene, np.concatenate([truth[:, :6], truth[:, 9:]], axis=1)) == 12


def test_fixing_any_one_bias_is_not_safe() -> None:
    """Scenario 5 with the second yaw known leaves 185 mrad, although its rank is full."""
    scene, truth = two_sensors(5, known_roll=False)
    table = optical.sigma_with_one_bias_known(scene, optical.predict(scene, truth)[0], truth[0])
    worst_mrad = 1e3 * table.max(axis=1)
    assert worst_mrad[3] == pytest.approx(185.0, abs=1.5)
    assert worst_mrad[5] == pytest.approx(1.54, abs=0.01)
    np.testing.assert_array_equal(np.diagonal(table), 0.0)


def test_printed_starting_point_misses_scenario_1() -> None:
    """Eqs (21)-(23), put right, bring no run of scenario 1 to the estimate; the rays bring all."""
    scene, truth = three_sensors(1, *REPRODUCING)
    measured = simulate(scene, truth, 40, seed=1)
    found = optical.estimate(scene, measured, optical.printed_starting_point(scene, measured))
    right = optical.estimate(scene, measured).parameters
    assert (np.abs(found.parameters / right - 1.0).max(axis=1) < 1e-3).sum() == 0


def test_the_stated_field_of_view_does_not_hold() -> None:
    """60 deg, says the paper; in scenario 1 the second sensor's targets span 68 deg."""
    scene, truth = three_sensors(1, *STATED)
    offset = truth[0, :9].reshape(3, 3) - scene.position_m[1]
    unit = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    assert np.degrees(np.arccos((unit @ unit.T).clip(-1, 1)).max()) == pytest.approx(68.0, abs=0.1)


def test_bad_runs_are_told_and_the_rest_goes_on() -> None:
    """Parallel rays and a missing line of sight, among good runs that stay the same bit for bit."""
    scene, truth = three_sensors(2, *STATED)
    measured = simulate(scene, truth, 300, seed=5)
    measured[1] = measured[1, :1, :1]
    measured[2, 0, 0] = np.nan
    solution = optical.estimate(scene, measured)
    assert solution.status[:3].tolist() == [
        Status.CONVERGED,
        Status.NO_START,
        Status.UNOBSERVABLE,
    ]
    assert solution.rank[2] == 16
    assert solution.converged[3:].all()
    alone = optical.estimate(scene, measured[299:])
    assert all(
        column[299].tobytes() == own[0].tobytes() for column, own in zip(solution, alone, strict=True)
    )


def test_target_on_a_sensor_is_not_finite() -> None:
    scene, truth = three_sensors(2, *STATED)
    measured = optical.predict(scene, truth)
    truth[0, :3] = scene.position_m[0]
    found = solve(lambda p, rows: optical.linearize(scene, measured[rows], p), truth)
    assert found.status[0] == Status.NOT_FINITE


def test_shapes_that_do_not_fit_are_refused() -> None:
    scene, _ = three_sensors(1, *STATED)
    with pytest.raises(BadInput, match="3 sensors"):
        optical.estimate(scene, np.zeros((1, 3, 2, 2)))
    with pytest.raises(BadInput, match="sigma_rad"):
        optical.estimate(scene._replace(sigma_rad=np.zeros(3)), np.zeros((1, 3, 3, 2)))


def test_same_estimates_as_scipy() -> None:
    """An independent solver with its own differences agrees to 1e-8."""
    scene, truth = three_sensors(2, *REPRODUCING)
    measured = simulate(scene, truth, 3, seed=7)
    ours = optical.estimate(scene, measured)
    for run, start in enumerate(optical.starting_point(scene, measured)):
        theirs = least_squares(
            lambda p, run=run: optical.linearize(scene, measured[[run]], p[None]).residual[0] / 3e-4,
            start,
            x_scale="jac",
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
        )
        np.testing.assert_allclose(ours.parameters[run], theirs.x, rtol=1e-8)
