"""Cooperative vehicles: exact filters and bounds, associations, registration, and bad input."""

from collections.abc import Sequence
from itertools import permutations
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.stats import chi2, multivariate_normal

from fuselog.pipeline.families.vehicles.cases import Scores, scores_of
from fuselog.pipeline.runs.recorded import record_ensemble, replay_in_memory
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.vehicles.models import noise_moments
from fuselog.recorders.log import Clock
from fuselog.recorders.models.planar import into_frame
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.families.sets.judging.distances import gospa
from fuselog.replay.families.vehicles.association import (
    GATE_PROBABILITY,
    Scanning,
    all_maps,
    best_maps,
    log_likelihoods,
    log_permanents,
)
from fuselog.replay.families.vehicles.bounds import bounds, exact_total_error, follow_axis
from fuselog.replay.families.vehicles.particles import _moved
from fuselog.replay.families.vehicles.registration import register
from fuselog.replay.families.vehicles.vehicles import Joint, Motion, collapse, position_rows
from fuselog.replay.judging.errors.evaluation import errors_of
from fuselog.replay.judging.errors.label_errors import (
    assigned_squared_error,
    fixed_squared_error,
    total_error,
)
from fuselog.replay.judging.errors.truths import Truths

pytestmark = pytest.mark.paper

Floats = NDArray[np.float64]
TOLERANCE = 1e-4
WHOLE = Scanning(0.5, 1.0, 0.0)
METHODS = ("known-topology", "set", "hungarian-topology", "hungarian-registration", "hungarian-static")


@pytest.fixture(scope="module")
def runs() -> list[MemorySource]:
    """Forty runs of the paper's scenario in which two vehicles turn."""
    values = {"turn_rate_radps": [0.0, 0.05, 0.0, -0.05, 0.0], "stochastic": False}
    return record_ensemble("vehicles", values, 1, 40)


@pytest.fixture(scope="module")
def scores(runs: list[MemorySource]) -> dict[str, Scores]:
    estimators = {method: {"kind": f"vehicles:{method}"} for method in METHODS}
    estimators["kf"] = {"kind": "vehicle-kalman"}
    return scores_of(runs, replay_in_memory(runs, estimators), estimators)


def test_bounds_are_the_sheet_s() -> None:
    """Steady state per axis, exact 100-step errors and all bounds, stochastic and deterministic."""
    own, both = follow_axis(0.5), follow_axis(1.0 / 12.0)
    assert_allclose([own.stochastic[-1], *own.gain], [0.34518, 0.69036, 0.39347], atol=TOLERANCE)
    assert_allclose([both.stochastic[-1], both.deterministic[-1]], [0.06956, 0.06374], atol=TOLERANCE)
    expected = {True: (1.8628, 1.7822, 1.2339, 0.8340), False: (1.7404, 1.6653, 1.1616, 0.7984)}
    for stochastic, numbers in expected.items():
        found = bounds(5, 0.5, 0.1, stochastic=stochastic)
        exact = exact_total_error(5, 0.5, 100, stochastic=stochastic)
        assert_allclose([exact, *found], numbers, atol=TOLERANCE)


def test_the_joint_filter_with_known_fixes_is_one_kalman_filter_per_vehicle(
    runs: list[MemorySource],
) -> None:
    """Two implementations, batched and compiled, agree to rounding."""
    outputs = replay_in_memory(
        runs[:3], {"joint": {"kind": "vehicles:known"}, "own": {"kind": "vehicle-kalman"}}
    )
    for vehicle in range(1, 6):
        joint, own = (outputs[f"/estimates/{name}/vehicle{vehicle}/state"] for name in ("joint", "own"))
        assert_allclose(joint["mean"], own["mean"], atol=1e-9)
        assert_allclose(joint["covariance"], own["covariance"], atol=1e-9)


def test_total_errors_are_the_sheet_s(scores: dict[str, Scores]) -> None:
    """Forty runs of CTM2: within 4 standard errors (of the mean, doubled for medians) plus .015."""
    expected = {
        "kf": (scores["kf"].fixed, np.mean, 1.744),
        "known-topology": (scores["known-topology"].fixed, np.mean, 1.673),
        "set": (scores["set"].fixed, np.median, 1.746),
        "hungarian-topology": (scores["hungarian-topology"].assigned, np.mean, 1.674),
        "hungarian-registration": (scores["hungarian-registration"].assigned, np.mean, 1.248),
        "hungarian-static": (scores["hungarian-static"].assigned, np.mean, 1.001),
    }
    for label, (errors, average, number) in expected.items():
        error = scores[label].assigned.std() / np.sqrt(len(errors))
        assert abs(average(errors) - number) < 0.015 + 4 * error, label


def test_ratios_to_the_kalman_filter(scores: dict[str, Scores]) -> None:
    """Paired over the runs the ratios are sharp: topology .959, registration .72 and .58."""
    kalman = scores["kf"].fixed.mean()
    topology = scores["known-topology"].fixed
    assert abs(topology.mean() / kalman - 0.959) < 0.003
    assert np.all(topology < scores["kf"].fixed)
    assert abs(scores["hungarian-registration"].assigned.mean() / kalman - 0.72) < 0.015
    assert abs(scores["hungarian-static"].assigned.mean() / kalman - 0.58) < 0.015


def test_runs_do_not_feel_each_other() -> None:
    """One run alone gives the numbers it gives among others; particles too draw the same."""
    runs = record_ensemble("vehicles", {"duration_s": 20.0, "stochastic": False}, 1, 2)
    methods = {
        "set": {"kind": "vehicles:set-topology"},
        "static": {"kind": "vehicles:hungarian-static"},
        "drawn": {"kind": "vehicle-particles:associations-5-topology"},
        "cloud": {"kind": "vehicle-particles:axes-20"},
    }
    together, alone = replay_in_memory(runs, methods), replay_in_memory(runs[1:], methods)
    for label in methods:
        topic = f"/estimates/{label}/vehicle1/state"
        assert_allclose(
            together[topic].of_run(1)["mean"], alone[topic]["mean"], rtol=1e-9, atol=1e-9, err_msg=label
        )


def _mixture(
    joint: Joint, rows: Floats, detections: Floats, scanning: Scanning
) -> tuple[Floats, Floats]:
    """Brute force: every partial map with its Kalman update and likelihood, and the moments of all."""
    mean, covariance = joint.mean[0], joint.covariance[0]
    vehicles, count = len(rows) // 2, len(detections)
    weights, means, seconds = [], [], []
    slots = [*range(count), *([-1] * vehicles)]
    for chosen in set(permutations(slots, vehicles)):
        seen = [v for v in range(vehicles) if chosen[v] >= 0]
        weight = scanning.clutter_per_m2 ** (count - len(seen))
        weight *= scanning.detection_probability ** len(seen)
        weight *= (1.0 - scanning.detection_probability) ** (vehicles - len(seen))
        own_mean, own_covariance = mean, covariance
        if seen:
            h = np.concatenate([rows[2 * v : 2 * v + 2] for v in seen])
            z = np.concatenate([detections[chosen[v]] for v in seen])
            s = h @ covariance @ h.T + scanning.variance_m2 * np.eye(len(z))
            nu = z - h @ mean
            gain = covariance @ h.T @ np.linalg.inv(s)
            weight *= np.exp(-0.5 * nu @ np.linalg.solve(s, nu)) / np.sqrt(np.linalg.det(2 * np.pi * s))
            own_mean, own_covariance = mean + gain @ nu, covariance - gain @ h @ covariance
        weights.append(weight)
        means.append(own_mean)
        seconds.append(own_covariance + np.outer(own_mean, own_mean))
    share = np.array(weights) / np.sum(weights)
    middle = share @ np.array(means)
    return middle, np.einsum("h,hij->ij", share, np.array(seconds)) - np.outer(middle, middle)


@pytest.mark.parametrize(
    ("scanning", "count"), [(WHOLE, 3), (Scanning(0.5, 0.8, 0.01), 4), (Scanning(0.5, 0.8, 0.01), 2)]
)
def test_collapse_has_the_moments_of_the_whole_mixture(scanning: Scanning, count: int) -> None:
    """Against brute force over all maps, correlated vehicles, with losses and clutter."""
    rng = np.random.default_rng(count)
    spread = rng.normal(size=(12, 12))
    joint = Joint(rng.normal(size=(1, 12)), (spread @ spread.T / 12 + np.eye(12))[None])
    rows = position_rows(3, 12)
    detections = rng.normal(size=(count, 2))
    predicted = (joint.mean @ rows.T).reshape(1, 3, 2)
    matrix = rows @ joint.covariance[0] @ rows.T + 0.5 * np.eye(6)
    blocks = np.stack([matrix[i : i + 2, i : i + 2] for i in (0, 2, 4)])[None]
    maps = all_maps(log_likelihoods(predicted, blocks, detections[None]), scanning)
    chosen = np.where((maps.detection < 0)[..., None], np.nan, detections[maps.detection] - predicted)
    found = collapse(joint, rows, chosen.reshape(-1, 6), 0.5 * np.ones(6), maps)
    mean, covariance = _mixture(joint, rows, detections, scanning)
    assert_allclose(found.mean[0], mean, atol=1e-6)
    assert_allclose(found.covariance[0], covariance, atol=1e-6)


def test_detections_are_as_likely_as_their_normal_density_up_to_the_gate() -> None:
    rng = np.random.default_rng(3)
    predicted, detections = rng.normal(size=(1, 3, 2)), rng.normal(scale=9.0, size=(1, 40, 2))
    roots = rng.normal(size=(3, 2, 2))
    covariance = (roots @ roots.swapaxes(1, 2) + np.eye(2))[None]
    found = log_likelihoods(predicted, covariance, detections)
    for vehicle in range(3):
        normal = multivariate_normal(predicted[0, vehicle], covariance[0, vehicle])
        off = detections[0] - predicted[0, vehicle]
        squared = np.einsum("da,da->d", off, np.linalg.solve(covariance[0, vehicle], off.T).T)
        inside, density = squared < chi2.ppf(GATE_PROBABILITY, 2), normal.logpdf(detections[0])
        assert_allclose(found[0, vehicle], np.where(inside, density, -np.inf), rtol=1e-12)
    assert 0 < np.isinf(found).sum() < found.size


def test_permanents_and_best_maps_against_all_permutations() -> None:
    """The subset sum equals the sum over permutations; the Hungarian map is the best of them."""
    rng = np.random.default_rng(8)
    logs = rng.normal(scale=3.0, size=(20, 5, 5))
    orders = np.array(list(permutations(range(5))))
    sums = logs[:, np.arange(5), orders].sum(axis=2)
    assert_allclose(log_permanents(logs), np.log(np.exp(sums).sum(axis=1)), rtol=1e-12)
    far = np.where(np.arange(5) == 0, 0.0, -2000.0) + logs  # all want the first: nothing is left of exp
    assert_allclose(log_permanents(far), sums.max(axis=1) - 8000.0, atol=np.log(120.0))
    found = best_maps(logs, WHOLE).detection
    assert_allclose(np.take_along_axis(logs, found[..., None], 2).sum(axis=(1, 2)), sums.max(axis=1))


def test_assigned_errors_are_the_best_labels_and_gospa() -> None:
    """Permuted estimates cost nothing when assigned; with a cutoff the number is GOSPA's."""
    rng = np.random.default_rng(9)
    truths = rng.uniform(0, 30, (4, 5, 2))
    assert_allclose(assigned_squared_error(truths[:, [2, 0, 1, 4, 3]], truths), 0.0, atol=1e-12)
    assert np.all(fixed_squared_error(truths[:, [2, 0, 1, 4, 3]], truths) > 1.0)
    estimates = truths + rng.normal(scale=6.0, size=truths.shape)
    ours = np.sqrt(assigned_squared_error(estimates, truths, 10.0))
    assert_allclose(ours, [gospa(a, b, 10.0).total for a, b in zip(estimates, truths, strict=True)])
    many = rng.uniform(0, 30, (1, 8, 2))
    assert_allclose(assigned_squared_error(many[:, ::-1], many), 0.0, atol=1e-12)
    assert total_error(np.array([1.0, 9.0, 26.0])) == pytest.approx(np.sqrt(12.0))


def test_registration_finds_pose_and_order() -> None:
    """Without noise exactly; vehicles in one place, or symmetric ones, are told to be unclear."""
    rng = np.random.default_rng(10)
    places = rng.uniform(-100, 100, (30, 5, 2))
    pose = np.array([60.0, -40.0, 2.0])
    seen = np.stack(into_frame(pose, np.moveaxis(places, -1, 0)), axis=-1)
    order = rng.permuted(np.tile(np.arange(5), (30, 1)), axis=1)
    found = register(places, np.take_along_axis(seen, order[..., None], 1), 0.5)
    assert found.is_clear.all()
    assert_allclose(found.pose, np.tile(pose, (30, 1)), atol=1e-9)
    assert_allclose(np.take_along_axis(order, found.detection, 1), np.tile(np.arange(5), (30, 1)))
    one_place = np.tile(places[:, :1], (1, 5, 1))
    assert not register(one_place, one_place, 0.5).is_clear.any()
    square = np.array([[[10.0, 10], [-10, 10], [-10, -10], [10, -10]]])
    assert not register(square, square, 0.5).is_clear.any()
    assert not register(places, seen + rng.normal(scale=20.0, size=seen.shape), 0.5).is_clear.any()
    assert not register(places[:, :1], seen[:, :1], 0.5).is_clear.any()
    with pytest.raises(BadInput, match="permutations of 9 vehicles; give at most 8"):
        register(np.zeros((1, 9, 2)), np.zeros((1, 9, 2)), 0.5)


def _last(sources: Sequence[MemorySource], method: str) -> Floats:
    """The last estimates (runs, vehicles, 4); fails where a run did not go to the end."""
    outputs = replay_in_memory(sources, {"m": {"kind": f"vehicles:{method}"}})
    states = [outputs[topic] for topic in outputs if topic.endswith("/state") and "vehicle" in topic]
    assert all((np.diff(each.offsets) == np.diff(states[0].offsets)).all() for each in states)
    return np.stack([each["mean"][each.offsets[1:] - 1] for each in states], axis=1)


@pytest.mark.parametrize(
    "values",
    [
        {"network": {"detection_probability": 0.01}, "infrastructure": {"detection_probability": 0.01}},
        {
            "duration_s": 5.0,  # each scan has as many
            "network": {"clutter_per_scan": 20.0},
            "infrastructure": {"clutter_per_scan": 20.0},
        },
        {"infrastructure": {"rate_hz": 0.0}},
        {"start": [[5.0, 1.0, 5.0, 0.0]] * 3},
        {"start": [[5.0, 1.0, 5.0, 0.0]]},
    ],
    ids=["no detections", "more detections than vehicles", "never reports", "one place", "one vehicle"],
)
@pytest.mark.parametrize("method", ["set-topology", "axes", "hungarian-static", "complex-topology"])
def test_difficult_input_is_filtered_to_the_end(values: dict[str, object], method: str) -> None:
    """No failure and no NaN, whatever scans lack or have too much."""
    sources = record_ensemble("vehicles", {"duration_s": 25.0, **values}, 2, 2)
    assert np.isfinite(_last(sources, method)).all()


@pytest.mark.parametrize("order", ["publish_time", "arrival_order"])
def test_rates_delays_and_losses_mixed(order: str) -> None:
    """Sensors of different rates, late and lossy: every stamp has an estimate near the truth."""
    late = {"latency_jitter_s": 0.3}
    values = {
        "duration_s": 20.0,
        "stochastic": False,
        "fix": {"dropout_probability": 0.2, **late},
        "network": {"detection_probability": 0.8, **late},
        "infrastructure": {"rate_hz": 3.0, "latency_s": 0.1},
    }
    sources = record_ensemble("vehicles", values, 2, 3)
    clock: Clock = "publish_time" if order == "publish_time" else "log_time"
    for method in ("known-static", "set-topology", "hungarian-static"):
        outputs = replay_in_memory(sources, {"m": {"kind": f"vehicles:{method}"}}, order=clock)
        errors = errors_of(
            outputs["/estimates/m/vehicle3/state"], [*map(Truths, sources)], gap_limit_s=2.0
        )
        assert errors is not None
        assert len(errors.error) >= 3 * 60
        rmse = np.sqrt(np.mean(np.sum(errors.error[:, errors.position] ** 2, axis=1)))
        assert rmse < (1.5 if order == "publish_time" else 4.0), method


def test_methods_that_do_not_exist_are_refused_with_choices() -> None:
    sources = record_ensemble("vehicles", {"duration_s": 5.0}, 2, 1)
    for kind, words in (
        ("vehicles:hungarien", "hungarian"),
        ("vehicles:set-topologie", "set"),
        ("vehicle-particles:set", "set-1000"),
    ):
        with pytest.raises(BadInput, match=words):
            replay_in_memory(sources, {"m": {"kind": kind}})


def test_particles_are_spread_by_the_motions_own_noise():
    """Of a vehicle that does not turn: the moments of 40 000 draws, within five standard errors."""
    count, sigma, duration_s = 40_000, 0.7, 1.5
    motion = Motion(np.zeros(1), np.array([sigma]))
    at_rest = Joint(np.zeros((count, 4)), np.zeros((count, 4, 4)))
    moved = _moved(SimpleNamespace(motion=motion), at_rest, duration_s, np.random.default_rng(4))
    position, cross, velocity = noise_moments(sigma, duration_s)
    axis = np.array([[position, cross], [cross, velocity]])
    wanted = np.kron(np.eye(2), axis)
    found = moved.T @ moved / count
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    assert np.abs((found - wanted) / scale).max() < 5 * np.sqrt(2 / count)
