"""Shooter localization against an independent implementation of Osborne et al., JAIF 2014."""

import tomllib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy import stats

from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.acoustic import models as model
from fuselog.recorders.families.acoustic.models import Medium, Noise
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.vectors.covariances import normalized_error_squared
from fuselog.replay.estimators.localization.least_squares import Solution, Status, information_root
from fuselog.replay.families.acoustic import localization as acoustic
from fuselog.replay.families.acoustic.localization import Detections, Mode, Setting
from fuselog.replay.judging.consistency.consistency import ellipse_area
from fuselog.replay.judging.errors.evaluation import chi_square_interval

pytestmark = pytest.mark.paper

SCENARIOS = Path(__file__).parents[4] / "data" / "scenarios"
MEDIUM = Medium()
MODES = [Mode.BEARINGS_ONLY, Mode.LOCAL_ESTIMATES, Mode.NATIVE_MEASUREMENTS]


class Shot(NamedTuple):
    """The truth of a scenario, one run."""

    shooter_m: np.ndarray
    trajectory_rad: np.ndarray
    sensor_m: np.ndarray


@cache
def shot(scenario: int) -> Shot:
    given = tomllib.loads((SCENARIOS / f"acoustic-{scenario}.toml").read_text())["parameters"]
    return Shot(
        np.array([given["shooter_position_m"]]),
        np.radians([given["trajectory_deg"]]),
        np.array(given["sensor_position_m"]),
    )


def noise(multiplier: float) -> Noise:
    angle = np.radians(4.0) * multiplier
    return Noise(angle, angle, 1e-3, 2.0)


def setting(mode: Mode, multiplier: float = 1.0, **options: bool) -> Setting:
    return Setting(mode, noise(multiplier), **options)


def simulate(scenario: int, multiplier: float, runs: int, seed: int) -> Detections:
    heard, sigma = acoustic.noise_free(MEDIUM, *shot(scenario)), noise(multiplier)
    rng = np.random.default_rng(seed)

    def add(column: np.ndarray, deviation: float) -> np.ndarray:
        return column + deviation * rng.normal(size=(runs, *column.shape[1:]))

    return Detections(
        wrap_angle(add(heard.muzzle_blast_rad, sigma.muzzle_blast_rad)),
        wrap_angle(add(heard.shockwave_rad, sigma.shockwave_rad)),
        add(heard.time_difference_s, sigma.time_difference_s),
        add(heard.position_m, sigma.position_m),
    )


def target_bound(scenario: int, mode: Mode, multiplier: float = 1.0, **options: bool) -> np.ndarray:
    """CRLB (2, 2) of the shooter's position."""
    return acoustic.bound(setting(mode, multiplier, **options), *shot(scenario)).covariance[0, :2, :2]


def deviation(scenario: int, mode: Mode, multiplier: float = 1.0) -> float:
    return float(np.sqrt(np.trace(target_bound(scenario, mode, multiplier))))


class Study(NamedTuple):
    """Errors of the shooter's position over the runs, their NEES and RMSE."""

    error: np.ndarray
    nees: np.ndarray
    rmse: float
    solution: Solution


@cache
def study(scenario: int, mode: Mode, multiplier: float, runs: int = 1000, seed: int = 1) -> Study:
    solution = acoustic.estimate(setting(mode, multiplier), simulate(scenario, multiplier, runs, seed))
    error = solution.parameters[:, :2] - shot(scenario).shooter_m
    nees = normalized_error_squared(error, target_bound(scenario, mode, multiplier))
    return Study(error, nees, float(np.sqrt((error**2).sum(axis=1).mean())), solution)


def combined_error(values: np.ndarray) -> float:
    """Three standard errors of the difference to a mean of 2000 values of the same kind."""
    return float(3.0 * values.std() * np.sqrt(1 / len(values) + 1 / 2000))


@pytest.mark.parametrize(("scenario", "hearing"), [(1, [0, 3, 4]), (2, [1, 2]), (3, [0, 1, 2])])
def test_who_hears_the_shockwave(scenario: int, hearing: list) -> None:
    heard = acoustic.noise_free(MEDIUM, *shot(scenario))
    assert np.flatnonzero(np.isfinite(heard.shockwave_rad[0])).tolist() == hearing


@pytest.mark.parametrize(
    ("scenario", "delays_ms", "sigma_range_m"),
    [
        (1, [113.456, 65.454, 65.763], [18.789, 22.744, 42.906]),
        (2, [106.685, 30.984], [39.246, 28.695]),
    ],
)
def test_delays_and_range_deviations(scenario: int, delays_ms: list, sigma_range_m: list) -> None:
    """Eq (26) with c^2 sigma_tau^2; the print has sigma_r there."""
    heard = acoustic.noise_free(MEDIUM, *shot(scenario))
    delay = heard.time_difference_s[0]
    hears = np.isfinite(delay)
    np.testing.assert_allclose(1e3 * delay[hears], delays_ms, atol=6e-4)
    separation = (heard.muzzle_blast_rad - heard.shockwave_rad)[0, hears]
    distance = np.linalg.norm(shot(scenario).shooter_m - shot(scenario).sensor_m[hears], axis=1)
    variance, _, _ = model.local_estimate_covariances(distance, separation, noise(1.0), MEDIUM)
    np.testing.assert_allclose(np.sqrt(variance), sigma_range_m, atol=6e-4)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("options", [{}, {"estimate_sensors": False}, {"cross_covariances": True}])
def test_whole_jacobian_equals_differences(mode: Mode, options: dict) -> None:
    """Jacobian of the residual and slope of the covariance, every column of every mode."""
    chosen = setting(mode, **options)
    heard = simulate(1, 0.2, 1, seed=3)
    at = acoustic.starting_point(chosen, heard)[0]
    step = 1e-5 * np.maximum(1.0, np.abs(at))
    here = acoustic.linearize(chosen, heard, at[None])
    for j, size in enumerate(step):
        shift = size * np.eye(len(at))[j]
        up, down = (acoustic.linearize(chosen, heard, (at + s * shift)[None]) for s in (1, -1))
        slope = -(up.residual - down.residual) / (2 * size)
        np.testing.assert_allclose(here.jacobian[..., j], slope, atol=1e-7)
        if here.covariance_jacobian is not None and chosen.estimate_sensors:
            slope = (up.covariance - down.covariance) / (2 * size)
            scale = np.abs(here.covariance).max()
            np.testing.assert_allclose(here.covariance_jacobian[..., j], slope, atol=1e-8 * scale)


@pytest.mark.parametrize(
    ("scenario", "deviations_m", "areas_m2", "sigma_trajectory_deg"),
    [
        (1, [5.279, 5.087, 3.084], [234.63, 221.86, 86.87], 1.161),
        (2, [8.738, 8.271, 8.105], [599.87, 555.30, 427.90], 1.551),
        (3, [18.792, 11.840, 3.844], [1498.2, 890.4, 127.35], 1.417),
    ],
)
def test_bounds(scenario: int, deviations_m: list, areas_m2: list, sigma_trajectory_deg: float) -> None:
    ours = [deviation(scenario, mode) for mode in MODES]
    np.testing.assert_allclose(ours, deviations_m, rtol=1e-3)
    areas = [ellipse_area(target_bound(scenario, mode)) for mode in MODES]
    np.testing.assert_allclose(areas, areas_m2, rtol=1e-3)
    native = acoustic.bound(setting(Mode.NATIVE_MEASUREMENTS), *shot(scenario)).covariance[0]
    assert np.degrees(np.sqrt(native[2, 2])) == pytest.approx(sigma_trajectory_deg, abs=6e-4)


@pytest.mark.parametrize("scenario", [1, 2, 3])
def test_local_estimates_with_cross_terms_carry_the_native_information(scenario: int) -> None:
    """Mean-term information with the full covariance of eq (16) equals the native one to 1e-12."""
    heard = acoustic.noise_free(MEDIUM, *shot(scenario))
    truth = np.concatenate(
        [shot(scenario).shooter_m[0], shot(scenario).trajectory_rad, heard.position_m.ravel()]
    )[None]

    def information(mode: Mode) -> np.ndarray:
        at = acoustic.linearize(setting(mode, cross_covariances=True), heard, truth)
        [root] = information_root(at._replace(covariance_jacobian=None))
        return root.T @ root

    native = information(Mode.NATIVE_MEASUREMENTS)
    difference = information(Mode.LOCAL_ESTIMATES) - native
    scale = np.sqrt(np.diagonal(native))
    assert np.abs(difference / np.outer(scale, scale)).max() < 1e-12


@pytest.mark.parametrize("scenario", [1, 2, 3])
@pytest.mark.parametrize("mode", [Mode.BEARINGS_ONLY, Mode.NATIVE_MEASUREMENTS])
def test_absorbed_position_fixes_leave_the_same_bound(scenario: int, mode: Mode) -> None:
    """Estimating the sensors along or adding their error to the measurements is one information."""
    joint = target_bound(scenario, mode)
    absorbed = target_bound(scenario, mode, estimate_sensors=False)
    np.testing.assert_allclose(absorbed, joint, rtol=1e-12)


def test_cross_terms_in_the_trace_make_an_impossible_bound() -> None:
    """Refuted: eq (48) with eqs (17), (18): area 69.8 below the native measurements' 86.9 m2."""
    impossible = target_bound(1, Mode.LOCAL_ESTIMATES, cross_covariances=True)
    assert ellipse_area(impossible) == pytest.approx(69.80, abs=0.01)
    assert ellipse_area(impossible) < ellipse_area(target_bound(1, Mode.NATIVE_MEASUREMENTS))


def test_native_bound_is_not_always_the_lower_one() -> None:
    """Refuted: "CRLB_nm is always lower than CRLB_le"; scenario 2 at a tenth of the noise."""
    assert deviation(2, Mode.LOCAL_ESTIMATES, 0.1) == pytest.approx(2.116, abs=6e-4)
    assert deviation(2, Mode.NATIVE_MEASUREMENTS, 0.1) == pytest.approx(2.181, abs=6e-4)
    assert deviation(2, Mode.LOCAL_ESTIMATES, 0.3) < deviation(2, Mode.NATIVE_MEASUREMENTS, 0.3)
    assert deviation(2, Mode.LOCAL_ESTIMATES, 0.5) > deviation(2, Mode.NATIVE_MEASUREMENTS, 0.5)


def test_estimating_sensors_along_is_not_negligible() -> None:
    """Refuted: sensor 4 of scenario 1 gains 29 % in y."""
    chosen = setting(Mode.NATIVE_MEASUREMENTS)
    covariance = acoustic.bound(chosen, *shot(1)).covariance[0]
    index = acoustic.parameter_names(chosen, range(1, 6)).index("sensor_4_y_m")
    assert np.sqrt(covariance[index, index]) == pytest.approx(1.42, abs=0.005)


def area_ratios(aim: tuple, shooter: tuple) -> list[float]:
    """Ellipse area of bearings only over that of local estimates and native measurements."""
    place = np.array([shooter], dtype=float)
    trajectory = np.arctan2(aim[1] - place[:, 1], aim[0] - place[:, 0])
    areas = [
        ellipse_area(
            acoustic.bound(setting(mode), place, trajectory, shot(3).sensor_m).covariance[0, :2, :2]
        )
        for mode in MODES
    ]
    return [float(areas[0] / areas[1]), float(areas[0] / areas[2])]


@pytest.mark.parametrize(
    ("aim", "shooter", "ratios"),
    [
        ((150, 80), (50, 50), [1.7739, 11.912]),
        ((150, 80), (0, 0), [2.6349, 30.096]),
        ((120, 50), (50, 50), [1.6707, 3.3399]),
        ((120, 50), (0, 0), [2.5846, 28.864]),
    ],
)
def test_area_ratios_of_figures_22_and_23(aim: tuple, shooter: tuple, ratios: list) -> None:
    np.testing.assert_allclose(area_ratios(aim, shooter), ratios, rtol=1e-4)


def test_area_ratio_is_one_where_no_shockwave_is_heard() -> None:
    """Then the trajectory is unobservable, which must not spoil the bound of the position."""
    place, away = np.array([[300.0, 300.0]]), np.array([np.pi / 4])
    bounds = [acoustic.bound(setting(mode), place, away, shot(3).sensor_m) for mode in MODES]
    assert [int(bound.rank[0]) for bound in bounds] == [8, 8, 8]
    assert np.isinf(bounds[2].covariance[0, 2, 2])
    areas = [ellipse_area(bound.covariance[0, :2, :2]) for bound in bounds]
    np.testing.assert_allclose(areas[0] / areas[1:], 1.0, rtol=1e-12)


@pytest.mark.parametrize("scenario", [1, 2, 3])
@pytest.mark.parametrize("multiplier", [0.1, 1.0, 1.5])
def test_native_measurements_are_efficient(scenario: int, multiplier: float) -> None:
    """At every noise. One run in some thousands of scenario 3 at 1.5 ends at a false optimum."""
    low, high = chi_square_interval(2, 100)
    assert (round(low, 3), round(high, 3)) == (1.627, 2.411)
    found = study(scenario, Mode.NATIVE_MEASUREMENTS, multiplier)
    assert found.solution.converged.all()
    assert low < found.nees.mean() < high


@pytest.mark.parametrize(
    ("mode", "scenario", "multiplier", "expected"),
    [
        (Mode.BEARINGS_ONLY, 3, 0.1, 2.02),
        (Mode.BEARINGS_ONLY, 3, 1.0, 2.41),
        (Mode.BEARINGS_ONLY, 3, 1.2, 2.67),
        (Mode.LOCAL_ESTIMATES, 2, 0.1, 2.09),
        (Mode.LOCAL_ESTIMATES, 2, 1.0, 2.36),
    ],
)
def test_nees_of_the_other_modes(mode: Mode, scenario: int, multiplier: float, expected: float) -> None:
    """Against 2000 runs of another program, within three combined standard errors."""
    nees = study(scenario, mode, multiplier).nees
    assert nees.mean() == pytest.approx(expected, abs=combined_error(nees))


@pytest.mark.parametrize("scenario", [1, 2])
@pytest.mark.parametrize("multiplier", [0.1, 1.0, 1.5])
def test_bearings_only_is_efficient_in_good_geometry(scenario: int, multiplier: float) -> None:
    low, high = chi_square_interval(2, 100)
    assert low < study(scenario, Mode.BEARINGS_ONLY, multiplier).nees.mean() < high


def test_bearings_only_misses_its_bound_in_bad_geometry() -> None:
    """Scenario 3: RMSE 21.6 against 18.8 m, and far above 27.6 m at 1.5, with a heavy tail."""
    found = study(3, Mode.BEARINGS_ONLY, 1.0)
    squared = (found.error**2).sum(axis=1)
    assert squared.mean() == pytest.approx(21.6**2, abs=combined_error(squared))
    assert deviation(3, Mode.BEARINGS_ONLY, 1.5) == pytest.approx(27.6, abs=0.05)
    noisy = study(3, Mode.BEARINGS_ONLY, 1.5)
    assert noisy.nees[noisy.solution.converged].mean() > chi_square_interval(2, 100)[1]


def test_local_estimates_beat_their_approximate_bound_in_scenario_3() -> None:
    """RMSE 9.43 (20000 runs of ours: 9.22) against 11.84 m, as range and angles share their errors."""
    found = study(3, Mode.LOCAL_ESTIMATES, 1.0, runs=2000)
    squared = (found.error**2).sum(axis=1)
    assert squared.mean() == pytest.approx(9.43**2, abs=combined_error(squared))
    assert found.rmse < 0.85 * deviation(3, Mode.LOCAL_ESTIMATES)
    assert 1.47 < found.nees.mean() < 1.92


def test_cross_covariances_destabilise_the_search() -> None:
    """At 1.5 times the noise, errors over 50 m per 1000 runs: tens to hundreds against a few."""
    runs = 200
    for scenario, least in ((1, 30), (2, 100), (3, 40)):
        heard = simulate(scenario, 1.5, runs, seed=2)

        def far(cross: bool, scenario: int = scenario, heard: Detections = heard) -> float:
            chosen = setting(Mode.LOCAL_ESTIMATES, 1.5, cross_covariances=cross)
            error = acoustic.estimate(chosen, heard).parameters[:, :2] - shot(scenario).shooter_m
            return 1000 * float((np.linalg.norm(error, axis=1) > 50.0).mean())

        assert far(True) > least
        assert far(False) < 26


def test_range_error_has_a_right_tail() -> None:
    """Refuted: the "heavier left tail" of figures 3-5; skew +1.1, +1.7, +2.9, bias +3, +5, +13 m.

    The last skew stands for no number: it is 2.9 to 4.2 from one million draws to the next.
    """
    heard = simulate(3, 1.0, 100_000, seed=4)
    separation = heard.muzzle_blast_rad - heard.shockwave_rad
    estimate = model.range_from_time_difference(heard.time_difference_s, separation, MEDIUM)
    error = estimate - np.linalg.norm(shot(3).shooter_m - shot(3).sensor_m, axis=1)
    np.testing.assert_allclose(error.mean(axis=0), [3, 5, 13], atol=0.5)
    skew = stats.skew(error)
    np.testing.assert_allclose(skew[:2], [1.1, 1.7], atol=0.1)
    assert skew[2] > 2.0


@pytest.mark.parametrize("mode", MODES)
def test_bad_runs_are_told_and_the_rest_goes_on(mode: Mode) -> None:
    """Parallel bearings, a sensor that heard nothing, no shockwave at all: beside a good run."""
    heard = simulate(3, 1.0, 4, seed=6)
    heard.muzzle_blast_rad[1] = 0.3
    heard.muzzle_blast_rad[2, 1:] = np.nan
    heard.shockwave_rad[2, 1:] = np.nan
    heard.shockwave_rad[3] = np.nan
    solution = acoustic.estimate(setting(mode), heard)
    bearings_only = mode == Mode.BEARINGS_ONLY
    assert solution.status[0] == Status.CONVERGED
    assert solution.status[1] == Status.NO_START
    assert solution.status[2] == Status.NO_START
    assert solution.status[3] == (Status.CONVERGED if bearings_only else Status.UNOBSERVABLE)
    alone = acoustic.estimate(setting(mode), heard.take(np.array([0])))
    assert all(
        column[0].tobytes() == own[0].tobytes() for column, own in zip(solution, alone, strict=True)
    )


def test_shapes_that_do_not_fit_are_refused() -> None:
    heard = simulate(3, 1.0, 2, seed=6)
    with pytest.raises(BadInput, match="position_m"):
        acoustic.estimate(setting(Mode.BEARINGS_ONLY), heard._replace(position_m=np.zeros((2, 3))))
    with pytest.raises(BadInput, match="noise"):
        acoustic.estimate(setting(Mode.BEARINGS_ONLY, 0.0), heard)
