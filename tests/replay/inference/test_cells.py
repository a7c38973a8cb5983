"""Every filled cell of the table of models and methods: it replays logs, and is consistent.

A new model comes here with logs of its own: the table is what is registered.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest

from fuselog.pipeline.runs.recorded import record_ensemble, replay_ensemble
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.estimators import registered_models
from fuselog.replay.judging.errors.evaluation import Errors
from tests.replay.inference.wheel import make_wheel

RUNS = 30
FEW_RANGES = {
    "duration_s": 3.0,
    "rate_hz": 5.0,
    "anchors_m": [(-10.0, -6.0, 3.0), (10.0, -6.0, 3.0), (10.0, 6.0, 2.5), (-10.0, 6.0, 2.5)],
}
# What simulates logs of a model, near linear where that can be: scenario, parameters.
SCENARIOS: dict[str, tuple[str, dict[str, Any]]] = {
    # the prior is wrong by a standard deviation, along what the sum of the pressures does not tell
    "batch-reactor": ("batch-reactor", {"prior_mean": [2.9, 1.1], "prior_variance": 0.01}),
    "extended-target": ("extended-target", {}),
    "inertial": ("navigation", {"duration_s": 12.0, "unit": {"rate_hz": 50.0}}),
    "moving-shooter": ("shot-sequence", {"shots": 4}),
    "moving-sights": ("moving-los", {"duration_s": 3.0}),
    "ranging-pose": ("ranging", {**FEW_RANGES, "tags_m": [(0.4, 0.0, 0.0), (-0.3, 0.3, 0.0)]}),
    "ranging-position": ("ranging", {**FEW_RANGES, "tags_m": [(0.0, 0.0, 0.0)]}),
    "robot": ("landmarks", {"duration_s": 4.0, "range_bearing": {"rate_hz": 4.0}}),
    "vehicle": ("vehicles", {"duration_s": 14.0, "stochastic": True}),
}
# Not the extended target: its pseudo-measurement is quadratic, and its scales are uniform.
NEAR_LINEAR = ("robot", "vehicle", "batch-reactor")
CONSISTENT = (*NEAR_LINEAR, "inertial", "ranging-pose", "ranging-position")
# So many particles that a sharp measurement does not leave a few; and these vehicles go on as they
# are: an interacting multiple model that expects manoeuvres is too careful.
SETTINGS: dict[tuple[str, str], dict[str, Any]] = {
    **{
        (name, "particles"): {"particles": 5_000 if name.startswith("ranging") else 2_500}
        for name in SCENARIOS
    },
    ("vehicle", "imm"): {"manoeuvres_per_s": 0.0},
}
CELLS = [
    (name, method)
    for name, model in registered_models().items()
    for method, each in METHODS.items()
    if not each.lacks(model) and method != "bound"  # which estimates nothing, see `test_bound`
    # of 12 and 15 components, thousands of particles leave too few near what sharp sensors say
    if (name, method) not in (("inertial", "particles"), ("moving-sights", "particles"))
    # whose kernels take longest to compile, see `test_unscented_and_extended_inertial_filters_agree`
    if (name, method) not in (("inertial", "ukf"), ("inertial", "lrkf"))
    # what is located at one stamp has no steps, and no recorder simulates a unit with a magnetometer:
    # see `test_sound_source` and `test_attitude`
    if name not in ("sound-source", "orientation")
]


@cache
def sources(model: str) -> Sequence[MemorySource]:
    scenario, parameters = SCENARIOS[model]
    return record_ensemble(scenario, parameters, 3, RUNS)


def nees(model: str, method: str, runs: int = RUNS, **settings: Any) -> tuple[float, float]:
    """Mean over steps and runs per component, and its standard error over the runs."""
    logs = sources(model)[:runs]
    replayed = replay_ensemble(logs, {method: {"model": model, **settings}}, gap_limit_s=0.2)
    assert not any(replayed.metrics(["failures"]).values())
    assert replayed.errors
    means = []
    for errors in replayed.errors:
        size = len(errors.components)
        for run in range(runs):
            own = errors.nees[errors.run == run]
            assert len(own) > 10
            assert np.isfinite(own).all()
            means.append(own.mean() / size)
    return float(np.mean(means)), float(np.std(means, ddof=1) / np.sqrt(len(means)))


@pytest.mark.paper
@pytest.mark.parametrize(("model", "method"), CELLS)
def test_every_cell_is_consistent(model: str, method: str, request: pytest.FixtureRequest) -> None:
    """The mean NEES per component is 1 within 4 standard errors where the model is near linear.

    Of what takes long there are a third of the runs. Elsewhere two logs are followed to their ends, in
    plain Python but for particles and the extended target, whose kernels others use.
    """
    settings = SETTINGS.get((model, method), {})
    if model in CONSISTENT:
        takes_long = method == "particles" or model == "inertial"
        mean, error = nees(model, method, RUNS // 3 if takes_long else RUNS, **settings)
        assert abs(mean - 1) < 4 * error
    else:
        if method != "particles" and model != "extended-target":
            request.getfixturevalue("uncompiled")
        nees(model, method, 2, **settings)


@pytest.mark.paper
def test_unscented_and_extended_inertial_filters_agree() -> None:
    """One run, in which what both leave out is small: within a fifth of a standard deviation."""
    settings = {"model": "inertial"}
    log = record_ensemble("navigation", {"duration_s": 11.0, "unit": {"rate_hz": 12.5}}, 3, 1)

    def errors(method: str) -> Errors:
        replayed = replay_ensemble(log, {method: settings}, gap_limit_s=0.2)
        [found] = replayed.errors
        return found

    extended, unscented = errors("ekf"), errors("ukf")
    sigma = np.sqrt(np.diagonal(extended.covariance, axis1=1, axis2=2))
    assert np.abs(unscented.error - extended.error).max() > 0.0
    assert np.all(np.abs(unscented.error - extended.error) < 0.2 * sigma)


def test_wrong_noise_is_not_consistent() -> None:
    """What the test above can tell: sigmas of half their size, and of twice."""
    for factor, sign in ((0.5, 1), (2.0, -1)):
        mean, error = nees("robot", "ekf", sigma_range_m=0.1 * factor, sigma_bearing_rad=0.02 * factor)
        assert sign * (mean - 1) > 4 * error


def test_a_sensor_whose_linearisation_is_singular_has_no_extended_filter() -> None:
    """A point and its square: an innovation covariance of rank two of four, at every state."""
    model = registered_models()["extended-target"]
    for method in ("ekf", "iekf"):
        assert METHODS[method].lacks(model) == "a regular linearisation of its sensor surface_point"
    assert ("extended-target", "ukf") in CELLS
    assert METHODS["ekf"].lacks(make_wheel()) == ""


@pytest.mark.paper
@pytest.mark.parametrize("model", NEAR_LINEAR)
@pytest.mark.parametrize("method", ["ekf", "ukf"])
def test_smoothers_err_less_than_their_filters(model: str, method: str) -> None:
    """Thirty runs each: the RMSE of the whole state, of all stamps together."""
    smoother = f"smoother:{method}"
    settings = {name: {"model": model} for name in (method, smoother)}
    replayed = replay_ensemble(sources(model), settings, gap_limit_s=0.2)
    assert not any(replayed.metrics(["failures"]).values())
    errors = {each.estimator: each.error for each in replayed.errors}
    rmse = {name: np.sqrt(np.mean(np.square(error))) for name, error in errors.items()}
    assert rmse[smoother] < rmse[method]


@pytest.mark.paper
def test_a_smoother_is_no_better_than_the_prior_that_misleads_all_runs() -> None:
    """The reactor's first pressure: a prior that errs alike in every run is an error that stays.

    In the logs above it is a standard deviation off, always to the same side, and what is not measured
    keeps that: smoothed once, at samples or to the optimum, by about as much, and more than filtered.
    Where the prior errs as it says, every smoother is better in every component.
    """
    rng = np.random.default_rng(5)
    methods = ("ekf", "smoother:ekf", "smoother:ukf", "smoother:iterated")
    spread = [
        record_ensemble("batch-reactor", {"prior_mean": start, "prior_variance": 0.01}, seed, 1)[0]
        for seed, start in enumerate(([3.0, 1.0] + 0.1 * rng.standard_normal((200, 2))).tolist())
    ]

    def rmse(logs: Sequence[MemorySource]) -> list[Any]:
        found = replay_ensemble(logs, {method: {} for method in methods}, gap_limit_s=0.2)
        errors = {each.estimator: each.error for each in found.errors}
        return [np.sqrt(np.mean(np.square(errors[method]), axis=0)) for method in methods]

    ekf, *smoothed = rmse(sources("batch-reactor"))
    for each in smoothed:
        assert each[0] > ekf[0]
        np.testing.assert_allclose(each, smoothed[0], rtol=0.02)
    ekf, *smoothed = rmse(spread)
    for each in smoothed:
        assert np.all(each < ekf)
