"""The linear regression Kalman filters against exact moments, and their place in the replay."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import LogWriter, open_log
from fuselog.recorders.models.planar import range_bearing
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.families.sampling.extended_target import EXTENDED_TARGET, measure
from fuselog.replay.families.sampling.reactor import REACTOR
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.kalman.regression import regression, sample_memory, sampled_sensor
from fuselog.replay.inference.kalman.steps import Gaussian, Interval, Measurement
from fuselog.replay.inference.linear_algebra.gaussian import no_innovation
from fuselog.replay.inference.model.bound_model import bound_model_of
from fuselog.replay.inference.sampling import Samples, parse_sampling
from fuselog.replay.inference.sampling.sets import SampleSets

PARAMETERS = {"batch-reactor": {}, "extended-target": {}, "landmarks": {"duration_s": 5.0}}
SAMPLINGS = ["ukf", "gf-25", "rukf-12", "s2kf-50", "s2kf-100:symmetric", "s2kf-25:rotation=3"]


def samples_of(name: str, dimension: int) -> Samples:
    return parse_sampling(name).at(dimension).draw(np.random.default_rng(1), ())


def as_sets(samples: Samples) -> SampleSets:
    return SampleSets(samples.points[None], samples.weights[None], 0, 0)


def regress(function, angular, mean, covariance, samples, *arguments):
    """Mean, covariance and cross-covariance by the kernel, uncompiled."""
    count, states = len(angular), len(mean)
    kinds, outputs = ("linear",) * states, tuple("angle" if each else "linear" for each in angular)
    memory = sample_memory(as_sets(samples), kinds, 0, outputs)
    found, with_state = np.empty((count, count)), np.empty((states, count))

    def of_state(state, _, arguments):
        return function(np.array(state), *arguments)

    regress = regression(of_state, kinds, 0, outputs)
    assert regress(mean, covariance, arguments, (), found, with_state, 0, memory)
    return memory.centre, found, with_state


def random_gaussian(dimension: int, seed: int):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(dimension, dimension))
    return rng.normal(size=dimension), root @ root.T + 0.1 * np.eye(dimension)


@pytest.mark.parametrize("name", SAMPLINGS)
def test_a_linear_function_is_regressed_exactly(name):
    """Every sampling has mean 0 and covariance I: a wrong weight, factor or index breaks this."""
    mean, covariance = random_gaussian(3, 0)
    a = np.random.default_rng(1).normal(size=(2, 3))

    def function(z, offset):
        return a[0] @ z + offset, a[1] @ z - offset

    found = regress(function, (False, False), mean, covariance, samples_of(name, 3), 7.0)
    np.testing.assert_allclose(found[0], a @ mean + [7, -7], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found[1], a @ covariance @ a.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found[2], covariance @ a.T, rtol=1e-9, atol=1e-9)


def test_angles_across_the_cut_are_regressed_as_away_from_it():
    """Turning the world by pi turns bearings, and changes no covariance: unwrapped angles would."""
    pose, covariance = np.array([0.0, 0.0, 0.3]), np.diag([0.1, 0.2, 0.05])
    samples = samples_of("s2kf-50", 3)

    def both(target, heading):
        mean = np.array([0.0, 0.0, heading])
        return regress(range_bearing, (False, True), mean, covariance, samples, target)

    here, there = both((5.0, 0.0), pose[2]), both((5.0, 0.0), pose[2] + 2 * np.pi)
    across = both((-5.0, 1e-9), pose[2])
    np.testing.assert_allclose(here[1], there[1], rtol=1e-9)
    mirrored = both((-5.0, -1e-9), pose[2])
    np.testing.assert_allclose(across[1], mirrored[1], rtol=1e-6)
    assert across[1][1, 1] < 0.2


STEP = SimpleNamespace(step_s=0.1, process_variance=1e-5, pressure_variance=0.1)
POINT = SimpleNamespace(size_drift_m2=1e-4, position_drift_m2=1e-3, point_variance_m2=1.0)


def predicted(method, mean, covariance, *samples):
    """One step of the reactor, uncompiled."""
    steps = METHODS[method].steps(bound_model_of(REACTOR, REACTOR.motion, REACTOR.sensors))
    belief = Gaussian(mean[None].copy(), covariance[None].copy())
    memory = steps.memory(tuple(as_sets(each) for each in samples))
    assert steps.predict(0, belief, Interval(np.empty(0), 1.0, STEP, 0), memory)
    return belief.mean[0], belief.covariance[0]


def test_reactor_step_has_the_moments_of_the_sheet():
    """Steinbring and Hanebeck, JAIF 2014, one step from m = [.5, 3.5], C = 10 I: appendix and UKF."""
    mean, covariance = np.array([0.5, 3.5]), 10 * np.eye(2)
    exact = predicted("analytic", mean, covariance)
    np.testing.assert_allclose(exact[0], [0.172, 3.664], atol=1e-12)
    np.testing.assert_allclose(exact[1], [[9.57505, 0.05248], [0.05248, 10.05377]], atol=1e-8)
    unscented = predicted("lrkf", mean, covariance, samples_of("ukf", 2))
    np.testing.assert_allclose(unscented[0], [0.172, 3.664], atol=1e-12)
    np.testing.assert_allclose(unscented[1], [[9.52385, 0.07808], [0.07808, 10.04097]], atol=1e-8)


def test_reactor_analytic_equals_gauss_hermite_quadrature():
    """The closed form is exact for any Gaussian, correlated ones included: 5 nodes integrate it."""
    mean, covariance = random_gaussian(2, 3)
    exact = predicted("analytic", mean, covariance)
    quadrature = predicted("lrkf", mean, covariance, gauss_hermite(2, 5))
    np.testing.assert_allclose(exact[0], quadrature[0], rtol=1e-12)
    np.testing.assert_allclose(exact[1], quadrature[1], rtol=1e-12)


def gauss_hermite(dimension: int, nodes: int) -> Samples:
    x, w = np.polynomial.hermite_e.hermegauss(nodes)
    points = np.stack(np.meshgrid(*[x] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
    weights = np.prod(np.meshgrid(*[w / w.sum()] * dimension, indexing="ij"), axis=0).ravel()
    return Samples(points, weights)


def innovated_exactly(mean, covariance, measured):
    """The innovation of a point (x, y, x^2, y^2) by the exact moments."""
    difference, spread, with_state = no_innovation(4, 4)
    EXTENDED_TARGET.sensors[0].moments(mean, covariance, (), POINT, difference, spread, with_state)
    return measured - difference, spread, with_state


def innovated(mean, covariance, measured, samples):
    """The same by samples of the target and of the noise."""
    bound_model = bound_model_of(EXTENDED_TARGET, EXTENDED_TARGET.motion, EXTENDED_TARGET.sensors)
    work = METHODS["lrkf"].steps(bound_model).memory((as_sets(samples),))
    given = Measurement(measured, POINT, np.empty(0), 0)
    assert sampled_sensor(bound_model, 0, 0)(mean, covariance, given, work)
    return work.innovations[0]


def test_extended_target_first_update_has_the_moments_of_the_sheet():
    """The same paper's target from I + C^v: analytic moments, and the UKF's blindness for the size."""
    mean, covariance = np.array([1.0, 1, 0, 0]), np.diag([1.0001, 1.0001, 1.001, 1.001])
    samples = samples_of("ukf", 8)
    difference, found, with_state = innovated_exactly(mean, covariance, np.zeros(4))
    np.testing.assert_allclose(-difference, [0, 0, 2.6677, 2.6677], atol=1e-12)
    np.testing.assert_allclose(np.diag(found), [2.6677, 2.6677, 16.23351325, 16.23351325], atol=1e-8)
    np.testing.assert_allclose(with_state[:2, 2:], 0.66673333 * np.eye(2), atol=1e-8)
    np.testing.assert_allclose(with_state[2:, :2], 1.001 * np.eye(2), atol=1e-12)
    blind = innovated(mean, covariance, np.zeros(4), samples)
    np.testing.assert_allclose(blind[2][:2, 2:], 0, atol=1e-12)


def test_extended_target_analytic_equals_gauss_hermite_quadrature():
    """Exact for any correlated prior: 5 nodes per dimension integrate it."""
    mean, covariance = random_gaussian(4, 5)
    measured = np.array([0.7, -2.0])
    exact = innovated_exactly(mean, covariance, np.array([*measured, *measured**2]))
    quadrature = product_rule(mean, covariance, measured)
    for ours, theirs in zip(exact, quadrature, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-10)


def product_rule(mean, covariance, measured):
    """Innovation, covariance and cross-covariance by Gauss-Hermite, vectorised over its points."""
    points, weights = gauss_hermite(8, 5)
    root = np.zeros((8, 8))
    root[:4, :4] = np.linalg.cholesky(covariance)
    root[4:6, 4:6] = np.eye(2) / np.sqrt(3)
    root[6:, 6:] = np.eye(2)
    joint = points @ root.T + np.append(mean, np.zeros(4))
    values = np.array(measure(joint[:, :4].T, joint[:, 4:].T, (), POINT))
    centre = values @ weights
    changes = values - centre[:, None]
    seen = np.array([*measured, *measured**2])
    offsets = (joint[:, :4] - mean) * weights[:, None]
    return seen - centre, (changes * weights) @ changes.T, offsets.T @ changes.T


def estimates(sources, names, **settings):
    found = {}
    for name in names:
        found[name] = collect(replay(sources, bind(name, sources, settings)))
    return found


CASES = [
    *((scenario, name) for scenario in PARAMETERS for name in ("lrkf:s2kf-50", "lrkf:rukf-3")),
    ("batch-reactor", "analytic"),
    ("extended-target", "analytic"),
]


@pytest.mark.paper
@pytest.mark.parametrize(("scenario", "name"), CASES)
def test_a_run_alone_and_in_an_ensemble_gives_the_same_bytes(scenario, name):
    """Also for a randomised sampling, whose draws may depend on the run alone."""
    sources = record_ensemble(scenario, PARAMETERS[scenario], seed=3, runs=3)
    together = estimates(sources, [name])[name]
    for run, source in enumerate(sources):
        alone = estimates([source], [name])[name]
        for topic, ragged in together.items():
            for column, values in ragged.of_run(run).columns.items():
                np.testing.assert_array_equal(values, alone[topic].of_run(0).columns[column])


def test_randomised_draws_differ_by_run_and_seed():
    """Two runs, or two seeds, that shared their draws would make Monte Carlo averages lie."""
    sources = record_ensemble("batch-reactor", {}, seed=3, runs=2)
    first = estimates(sources, ["lrkf:rukf-3"], seed=0)["lrkf:rukf-3"]
    second = estimates(sources, ["lrkf:rukf-3"], seed=1)["lrkf:rukf-3"]
    topic = "/estimates/lrkf:rukf-3/state"
    assert not np.array_equal(first[topic]["covariance"], second[topic]["covariance"])
    at = first[topic].offsets[:2]
    assert not np.array_equal(*first[topic]["covariance"][at])  # same prior, so only draws differ


def test_more_samples_come_closer_to_the_exact_moments():
    """The sheet's order of the reactor: 50 beat the UKF and the GF, 100 beat everything."""
    sources = record_ensemble("batch-reactor", {}, seed=1, runs=200)
    names = [f"lrkf:{each}" for each in ("ukf", "gf-25", "s2kf-10", "s2kf-50", "s2kf-100", "s2kf-150")]
    found = estimates(sources, ["analytic", *names])
    exact = found["analytic"]["/estimates/analytic/state"]["covariance"]
    error = {
        name: np.sqrt(np.mean((found[name][f"/estimates/{name}/state"]["covariance"] - exact) ** 2))
        for name in names
    }
    order = sorted(names, key=lambda name: error[name])
    assert [each[5:] for each in order] == ["s2kf-150", "s2kf-100", "s2kf-50", "ukf", "s2kf-10", "gf-25"]


def test_bad_input_is_refused_in_one_sentence():
    """A prior that no filter can start from, and samplings that do not fit."""
    (source,) = record_ensemble("batch-reactor", {}, seed=0, runs=1)
    prior = source.streams["/prior"]
    singular = {**prior.columns, "covariance": np.ones((1, 4))}
    bad = MemorySource({**source.streams, "/prior": replace(prior, columns=singular)}, source.run, "bad")
    with pytest.raises(BadInput, match="not positive definite"):
        estimates([bad], ["lrkf:ukf"])
    with pytest.raises(BadInput, match="give 3 or more"):
        bind("lrkf:s2kf-2", [source], {})
    with pytest.raises(BadInput, match="not a sampling"):
        bind("lrkf:foo", [source], {})
    with pytest.raises(BadInput, match="no variants"):
        bind("analytic:s2kf-50", [source], {})


def test_a_run_that_loses_definiteness_is_told_and_the_others_go_on():
    """One randomised set has a negative weight more often than not, and so covariances that are none."""
    sources = record_ensemble("extended-target", {"points": 20}, seed=0, runs=50)
    name = "lrkf:rukf-4"
    found = estimates(sources, [name])[name]
    failed = found[f"/estimates/{name}/failure"]
    steps = np.diff(found[f"/estimates/{name}/state"].offsets)
    assert 0 < len(failed) < 50
    assert set(failed["reason"]) == {0}
    np.testing.assert_array_equal(np.diff(failed.offsets), steps < 20)


def test_robot_filters_are_one_house():
    """`ukf` is the LRKF with unscented samples, byte for byte, and every sampling follows the robot."""
    sources = record_ensemble("landmarks", PARAMETERS["landmarks"], seed=2, runs=2)
    names = ["lrkf:ukf:kappa=0", "lrkf:s2kf-50", "lrkf:gf-3", "lrkf:rukf-12"]
    found = estimates(sources, ["ukf", *names])
    means = {name: each[f"/estimates/{name}/robot1/pose"]["mean"] for name, each in found.items()}
    np.testing.assert_array_equal(means[names[0]], means["ukf"])
    for name in names[1:]:
        apart = np.abs(means[name] - means["ukf"]).max()
        assert 0 < apart < 0.02, (name, apart)


@pytest.mark.parametrize(("scenario", "name"), CASES)
def test_a_log_in_blocks_gives_the_same_bytes(scenario, name, tmp_path):
    """State, samples and draws are carried over the cuts between blocks."""
    (source,) = record_ensemble(scenario, PARAMETERS[scenario], seed=4, runs=1)
    with LogWriter(tmp_path / "run.mcap", source.run) as writer:
        writer.write(source.streams.values())
    log = LogSource(open_log(tmp_path / "run.mcap"))
    bound = bind(name, [log], {})
    whole, cut = collect(replay([log], bound)), collect(replay([log], bound, block_messages=7))
    for topic, ragged in whole.items():
        for column, values in ragged.stream.columns.items():
            np.testing.assert_array_equal(values, cut[topic][column])


def test_parameters_of_other_models_are_refused_and_gates_are_used():
    """What is given but not used would be believed."""
    (source,) = record_ensemble("batch-reactor", {}, seed=0, runs=1)
    with pytest.raises(BadInput, match=r"lrkf:ukf, model batch-reactor: .*sigma_range_m"):
        bind("lrkf:ukf", [source], {"sigma_range_m": 0.1})
    found = estimates([source], ["lrkf:ukf"], gate_probability=0.5)["lrkf:ukf"]
    accepted = found["/estimates/lrkf:ukf/innovation"]["accepted"]
    assert 0 < accepted.mean() < 1
