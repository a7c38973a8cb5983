"""The bootstrap particle filter, against the reference sheet, a plain one in NumPy, and Kalman filters.

What is about the mathematics of one step and not the compiler runs uncompiled, with few particles.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import schemas
from fuselog.recorders.models.orientation import compose, conjugate
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.philox import fill_normals, philox, unit
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.engine.vectors.tangent import rotation_vector
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.estimators import of_any_model
from fuselog.replay.inference.model.model import Motion
from fuselog.replay.inference.particles.filter import BOOTSTRAP
from fuselog.replay.inference.sampling.resampling import choose_systematically
from fuselog.replay.judging.metrics.measuring import Output
from fuselog.replay.judging.metrics.metrics import PARTICLES
from tests.replay.inference import attitude, scalar, vehicle_a, wheel
from tests.replay.inference.attitude import ATTITUDE
from tests.replay.inference.replays import outputs
from tests.replay.inference.scalar import SCALAR
from tests.replay.inference.test_recursion import assert_equal, assert_same, in_blocks
from tests.replay.inference.vehicle_a import BEACONS, COVARIANCE, MEAN, VEHICLE_A, wrap
from tests.replay.inference.wheel import make_wheel

pytestmark = pytest.mark.paper

Floats = Any


# The sheet's test model


def test_systematic_resampling_is_the_sheets() -> None:
    chosen = np.empty(4, np.int64)
    choose_systematically(np.array([0.1, 0.2, 0.3, 0.4]), 0.35, chosen)
    assert chosen.tolist() == [0, 2, 2, 3]
    choose_systematically(np.array([0.5, 0.0, 0.5 - 1e-12, 0.0]), 1 - 1e-16, chosen)
    assert chosen.tolist() == [0, 2, 2, 3]  # round-off leaves the last position to the last particle


def test_every_position_chooses_the_particle_that_covers_it() -> None:
    """Including weights of zero, one that has them all, and positions that meet an end exactly."""
    rng = np.random.default_rng(1)
    drawn = [rng.uniform(size=count) ** 9 for count in (1, 2, 7, 64, 500)]
    for parts in (*drawn, np.ones(10), np.ones(48), np.eye(9)[8], np.eye(9)[0], np.eye(9)[4]):
        weights, chosen = parts / np.sum(parts), np.empty(len(parts), np.int64)
        for start in (1e-16, 0.25, 0.5, 0.7, 1.0 - 2.0**-54):
            choose_systematically(weights, start, chosen)
            positions = (np.arange(len(parts)) + start) / len(parts)
            covering = np.searchsorted(np.cumsum(weights), positions, side="right")
            assert chosen.tolist() == np.minimum(covering, len(parts) - 1).tolist()


def errors(particles: int, runs: int) -> tuple[Floats, Floats]:
    """In units of the Kalman filter's sigma / sqrt(N), (runs, 50); log-likelihoods less its.

    All of the same numbers; each run draws its own, for its first stamp is its own.
    """
    source = scalar.source(scalar.simulate(11))
    exact = outputs(SCALAR, "ekf", [source])
    exact_total = exact["innovation"]["log_likelihood"].sum()
    assert_allclose(exact_total, -66.8856458984, rtol=1e-10)
    sources = [scalar.source(scalar.simulate(11), first_later_ns=run) for run in range(runs)]
    found = outputs(SCALAR, "particles", sources, particles=particles)
    means = found["state"]["mean"].reshape(runs, -1) - exact["state"]["mean"][:, 0]
    totals = found["innovation"]["log_likelihood"].reshape(runs, -1).sum(axis=1) - exact_total
    return means / np.sqrt(exact["state"]["covariance"][:, 0] / particles), totals


@pytest.mark.parametrize(("particles", "spread"), [(100, 0.62), (1000, 0.20)])
def test_means_and_likelihoods_err_as_the_sheet_says(particles: int, spread: float) -> None:
    """Over 150 runs: the RMS over all steps, no step beyond 10, E exp(ll - exact) = 1, std of ll."""
    error, total = errors(particles, 150)
    assert 1.2 < np.sqrt(np.mean(error**2)) < 1.6
    assert np.abs(error).max() < 10
    ratio = np.exp(total)
    assert abs(ratio.mean() - 1) < 4 * ratio.std(ddof=1) / np.sqrt(len(ratio))
    assert_allclose(total.std(), spread, rtol=0.25)  # 4 standard errors of a standard deviation


def test_as_many_particles_are_effective_as_the_sheet_says() -> None:
    """Of 400 particles over 40 seeds, and so often are too few of them; the last step moves none."""
    source = scalar.source(scalar.simulate(11))
    replays = [outputs(SCALAR, "particles", [source], particles=400, seed=seed) for seed in range(40)]
    shares = np.array(
        [each["effective"]["effective"] / each["effective"]["particles"] for each in replays]
    )
    assert_allclose(shares.mean(), 0.567, atol=0.004)
    resamplings = (shares[:, :-1] < 0.5).sum(axis=1)
    assert_allclose(resamplings.mean(), 20.0, atol=0.5)
    told = PARTICLES.of(Output("particles", "", "effective", replays[0]["effective"], [source]))
    assert told["effective_share"] == pytest.approx(shares[0].mean(), rel=1e-12)


@pytest.mark.paper
def test_the_likelihood_is_unbiased() -> None:
    _, total = errors(400, 400)
    ratio = np.exp(total)
    assert abs(ratio.mean() - 1) < 4 * ratio.std(ddof=1) / np.sqrt(len(ratio))
    assert 0.004 < ratio.std(ddof=1) / np.sqrt(5000) < 0.005  # of 5000 runs


def test_innovations_are_those_of_the_moments() -> None:
    """Difference, covariance and NIS of 20000 particles are the Kalman filter's, but for sampling."""
    source = scalar.source(scalar.simulate(11))
    exact, found = (
        outputs(SCALAR, method, [source], **values)["innovation"]
        for method, values in (("ekf", {}), ("particles", {"particles": 20_000}))
    )
    spread = exact["covariance"][:, 0]
    assert_allclose(found["covariance"][:, 0], spread, rtol=0.05)
    assert np.abs((found["innovation"] - exact["innovation"])[:, 0] / np.sqrt(spread)).max() < 0.06
    assert_allclose(
        found["normalised_innovation_squared"].sum(),
        exact["normalised_innovation_squared"].sum(),
        rtol=0.02,
    )


def test_a_gate_keeps_outliers_out() -> None:
    values = scalar.simulate(11)
    values[20] += 50.0
    found = outputs(SCALAR, "particles", [scalar.source(values)], gate_probability=0.9999)["innovation"]
    assert np.flatnonzero(found["accepted"] == 0).tolist() == [20]
    assert found["log_likelihood"][20] == 0.0
    assert found["normalised_innovation_squared"][20] > 1000


# A plain filter of vehicle A


def plain(told: list[Any], particles: int, key: Any) -> tuple[Floats, Floats, Floats, Floats, int]:
    """Means, covariances, effective numbers, log-likelihoods of messages, and how often it resampled."""
    counter, resamplings = 0, 0

    def drawn(columns: int) -> Floats:
        nonlocal counter
        size = -(-particles * columns // 4) * 4
        numbers, words = np.empty(size), np.empty(size, np.uint64)
        with np.errstate(over="ignore"):
            counter = fill_normals(numbers, words, key, counter)
        return numbers[: particles * columns].reshape(particles, columns)

    x = MEAN + np.sqrt(np.diag(COVARIANCE)) * drawn(5)
    weight, now, found = np.full(particles, 1 / particles), 0.0, []
    likelihoods = []
    for index, (time_s, sensor, beacon, value) in enumerate(told):
        if time_s > now:
            if 1 / np.sum(weight**2) < particles / 2:
                counter, resamplings = counter + 1, resamplings + 1
                with np.errstate(over="ignore"):
                    start = unit(philox(counter, key)[0])
                ends = np.cumsum(weight)
                ends[-1] = 1.0
                positions = (np.arange(particles) + start) / particles
                x = x[np.searchsorted(ends, positions, side="right")]
                weight = np.full(particles, 1 / particles)
            noise = np.sqrt(vehicle_a.NOISE * (time_s - now)) * drawn(5)
            x = np.array([vehicle_a.move(tuple(each), (), time_s - now, None) for each in x]) + noise
            now = time_s
        if sensor == "speed":
            error = (value - x[:, 3:4]) / 0.1
            density = -0.5 * error[:, 0] ** 2 - np.log(0.1 * np.sqrt(2 * np.pi))
        else:
            seen = np.array([vehicle_a.range_bearing(each[:3], BEACONS[beacon]) for each in x])
            away = value - seen
            away[:, 1] = [wrap(each) if np.isfinite(each) else each for each in away[:, 1]]
            parts = -0.5 * (away / [0.3, 0.05]) ** 2 - np.log(np.array([0.3, 0.05]) * np.sqrt(2 * np.pi))
            density = np.nansum(parts, axis=1)
        total = weight @ np.exp(density)
        if np.isfinite(value).any():
            likelihoods.append(np.log(total))
        weight = weight * np.exp(density) / total
        if index + 1 == len(told) or told[index + 1][0] > time_s:
            mean = weight @ x
            covariance = (x - mean).T @ (weight[:, None] * (x - mean))
            found.append((mean, covariance, 1 / np.sum(weight**2)))
    return (*map(np.array, zip(*found, strict=True)), np.array(likelihoods), resamplings)


@pytest.mark.usefixtures("uncompiled")
def test_every_step_is_that_of_a_plain_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same random numbers: missing components, equal stamps, angles, resampling."""
    key = np.array([1, 2], np.uint64)
    monkeypatch.setattr("fuselog.replay.inference.particles.filter.run_key", lambda *_: key)
    told = vehicle_a.simulate(7)[0][:34]
    assert sum(np.isnan(each[3]).any() for each in told) > 2
    means, covariances, effective, likelihoods, resamplings = plain(told, 60, key)
    found = outputs(VEHICLE_A, "particles", [vehicle_a.source(told)], particles=60)
    assert_allclose(found["state"]["mean"], means, atol=1e-10)
    assert_allclose(found["state"]["covariance"].reshape(-1, 5, 5), covariances, atol=1e-10)
    assert_allclose(found["innovation"]["log_likelihood"], likelihoods, atol=1e-9)
    assert_allclose(found["effective"]["effective"], effective, rtol=1e-9)
    assert resamplings == (effective[:-1] < 30).sum() > 0


# Manifolds, and noise that is not additive


@pytest.mark.usefixtures("uncompiled")
def test_noise_of_motion_and_sensor_that_is_not_additive_on_an_axis() -> None:
    """Twelve sigmas / sqrt(N) from the unscented filter, which is no better; see `wheel`."""
    source = wheel.source(wheel.simulate(5, np.arange(0, 17) * 0.1))
    found, near = (
        outputs(make_wheel(), method, [source], **values)["state"]
        for method, values in (("particles", {"particles": 400}), ("ukf", {"kappa": 1.0}))
    )
    assert len(found) == len(near) > 15
    spread = near["covariance"].reshape(-1, 2, 2)
    turned = near["mean"][:, 0] * found["mean"][:, 1] - near["mean"][:, 1] * found["mean"][:, 0]
    assert np.abs(np.arcsin(turned) / np.sqrt(spread[:, 0, 0])).max() < 0.6
    assert np.abs((found["mean"] - near["mean"])[:, 2] / np.sqrt(spread[:, 1, 1])).max() < 0.6
    assert_allclose(np.hypot(*found["mean"][:, :2].T), 1.0, atol=1e-12)
    ratio = np.trace(found["covariance"].reshape(-1, 2, 2), axis1=1, axis2=2)
    assert_allclose(ratio / np.trace(spread, axis1=1, axis2=2), 1.0, atol=0.5)


@pytest.mark.usefixtures("uncompiled")
def test_rotations() -> None:
    """One update of an orientation and a bias: what a hundred times as many plain samples give."""
    whole, _, gyro = attitude.simulate(21)
    counts = {"/prior": 1, "/gyro": 3, "/force": 1}
    kept = [whole.streams[topic].take(np.arange(count)) for topic, count in counts.items()]
    kept[0].columns["covariance"][:] /= 25
    kept[2].columns["value"][:] = 0.4, -0.5, 9.7
    found = outputs(ATTITUDE, "particles", [memory_source(Recording(kept), whole.run)], particles=1000)
    mean, covariance = found["state"]["mean"][0], found["state"]["covariance"][0].reshape(6, 6)
    rng = np.random.default_rng(1)
    drawn = rng.normal(size=(100_000, 6)) * ([0.06] * 3 + [0.004] * 3)
    state = (*Rotation.from_rotvec(drawn[:, :3]).as_quat(scalar_first=True).T, *drawn[:, 3:].T)
    for each in gyro[:3]:
        state = attitude.move(state, each, attitude.STEP_S, None)
    values = kept[2]["value"][0]
    away = (values - np.stack(attitude.feel(state, (), None), axis=1)) / 0.3
    weight = np.exp(-0.5 * np.sum(away**2, axis=1))
    weight /= weight.sum()
    samples = np.stack(state, axis=1)
    turned = rotation_vector(compose(conjugate(np.broadcast_to(mean[:4], (100_000, 4))), samples[:, :4]))
    offsets = np.concatenate([turned, samples[:, 4:] - mean[4:]], axis=1)
    spread = offsets.T @ (weight[:, None] * offsets)
    assert_allclose(np.linalg.norm(mean[:4]), 1.0, atol=1e-12)
    sigma = np.sqrt(np.diag(spread))
    effective = 1000 / (len(weight) * np.sum(weight**2))
    assert effective > 100
    assert np.all(np.abs(weight @ offsets) < 4 * sigma / np.sqrt(effective))
    assert_allclose(covariance / np.outer(sigma, sigma), spread / np.outer(sigma, sigma), atol=0.4)


@pytest.mark.usefixtures("uncompiled")
def test_noise_through_the_control_and_added_beside_it() -> None:
    """A deterministic start and no measurement: the spread after one step is that of both noises."""

    def push(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
        return state[0], state[1], state[2] + control[0]

    def added(state: Any, duration_s: Any, parameters: Any) -> Any:
        return 0.0, 0.04

    def of_control(duration_s: Any, parameters: Any) -> Any:
        return (0.09,)

    model = replace(make_wheel(), motion=Motion(push, added, control_noise=of_control))
    messages = wheel.simulate(5, [0.0, 0.5])
    messages |= {topic: tuple(each[-1:] for each in messages[topic]) for topic in ("dial", "tacho")}
    found = outputs(model, "particles", [wheel.source(messages)], particles=800, every_s=0.25)["state"]
    variance = found["covariance"].reshape(-1, 2, 2)[:, 1, 1]
    assert_allclose(variance[1] - variance[0], 0.13, rtol=0.2)


# Seeds, runs, blocks, cores


def test_a_run_alone_in_blocks_and_on_other_cores_is_the_same(
    tmp_path: Path, on_cores: Callable[[int], None]
) -> None:
    """With ticks before the first measurement, which must not seed the run."""
    sources = [scalar.source(scalar.simulate(seed)[: 20 + seed]) for seed in range(5)]
    values = {"particles": 50, "every_s": 0.4}
    together = outputs(SCALAR, "particles", sources, **values)
    for run, source in enumerate(sources):
        alone = outputs(SCALAR, "particles", [source], **values)
        for leaf in ("state", "innovation"):
            assert_equal(together[leaf].of_run(run), alone[leaf].of_run(0))

    def replayed(source: Any, size: int = 1 << 18) -> dict[str, Ragged]:
        return outputs(SCALAR, "particles", [source], size, **values)

    for found in in_blocks(sources[0], tmp_path, replayed):
        assert_same(found, replayed(sources[0]))
    for cores in (1, 7):
        on_cores(cores)
        again = outputs(SCALAR, "particles", sources, **values)
        assert_equal(again["state"].stream, together["state"].stream)
    ticks = together["state"].of_run(0)["mean"][0], together["state"].of_run(1)["mean"][0]
    assert ticks[0] != ticks[1]


@pytest.mark.usefixtures("uncompiled")
def test_a_seed_changes_the_draws_and_a_run_without_measurements_ends_as_its_prior() -> None:
    def replayed(source: Any, model: Any, seed: int, count: int, **values: Any) -> Any:
        return outputs(model, "particles", [source], seed=seed, particles=count, **values)["state"]

    values = scalar.source(scalar.simulate(1)[:5])
    one, other, again = (replayed(values, SCALAR, seed, 20) for seed in (1, 2, 1))
    assert_equal(one.stream, again.stream)
    assert np.all(one["mean"] != other["mean"])
    messages = wheel.simulate(5, np.arange(3) * 0.1)
    silent = {topic: tuple(each[:0] for each in messages[topic]) for topic in ("dial", "tacho")}
    driven = wheel.source({**messages, **silent})
    one, other = (replayed(driven, make_wheel(), seed, 400, every_s=0.1) for seed in (1, 2))
    assert len(one) == 3
    assert np.all(one["mean"] != other["mean"])
    assert_allclose(one["mean"][0, 2], wheel.RATE, atol=4 * np.sqrt(0.09 / 400))
    assert_allclose(one["covariance"][0].reshape(2, 2)[1, 1], 0.09, rtol=0.3)


# The cloud


def test_the_cloud_has_the_moments_of_the_estimate() -> None:
    source = scalar.source(scalar.simulate(3)[:10])
    found = outputs(SCALAR, "particles", [source], particles=30, cloud=True)
    cloud, size, state = found["particle"], found["particles"], found["state"]
    assert cloud.stream.schema is schemas.DENSITY_ESTIMATE
    assert size["elements"].tolist() == [30] * 10
    weight, values = cloud["weight"].reshape(10, 30), cloud["mean"].reshape(10, 30)
    assert_allclose(weight.sum(axis=1), 1.0, rtol=1e-12)
    mean = np.sum(weight * values, axis=1)
    assert_allclose(state["mean"][:, 0], mean, rtol=1e-12)
    variance = np.sum(weight * (values - mean[:, None]) ** 2, axis=1)
    assert_allclose(state["covariance"][:, 0], variance, rtol=1e-10)
    assert not cloud["covariance"].any()
    assert_array_equal(cloud.stream.publish_time_ns, np.repeat(state.stream.publish_time_ns, 30))


# Likelihoods of a model's own


def heavy(state: Any, measured: Any, reference: Any, parameters: Any) -> Any:
    """A Cauchy distribution."""
    away = (measured[0] - state[0]) / parameters.sigma_measured
    return -np.log(np.pi * parameters.sigma_measured * (1.0 + away * away))


def normal(state: Any, measured: Any, reference: Any, parameters: Any) -> Any:
    away = (measured[0] - state[0]) / parameters.sigma_measured
    return -0.5 * (away * away + np.log(2.0 * np.pi)) - np.log(parameters.sigma_measured)


def nowhere(state: Any, measured: Any, reference: Any, parameters: Any) -> Any:
    return -np.inf if measured[0] > 10.0 else 0.0 * state[0]


def with_likelihood(function: Callable[..., Any]) -> Any:
    return replace(SCALAR, sensors=(replace(scalar.VALUE, log_likelihood=function),))


@pytest.mark.usefixtures("uncompiled")
def test_a_models_own_likelihood_is_used() -> None:
    """A Gaussian one changes nothing; after an outlier a heavy-tailed one lets the mean go less far."""
    values = scalar.simulate(11)[:12]
    values[-1] = 30.0

    def replayed(model: Any) -> Any:
        return outputs(model, "particles", [scalar.source(values)], particles=100)["state"]["mean"][:, 0]

    plainly = replayed(SCALAR)
    assert_allclose(replayed(with_likelihood(normal)), plainly, rtol=1e-12)
    assert replayed(with_likelihood(heavy))[-1] < plainly[-1] - 0.5


@pytest.mark.usefixtures("uncompiled")
def test_a_measurement_that_no_particle_explains_ends_the_run() -> None:
    values = scalar.simulate(11)[:5]
    values[3] = 30.0
    found = outputs(with_likelihood(nowhere), "particles", [scalar.source(values)], particles=20)
    assert len(found["state"]) == 3
    assert "no particle explains the measurement" in str(found["failure"].stream.metadata)


@pytest.mark.usefixtures("uncompiled")
def test_a_particle_of_which_a_sensor_says_nothing_keeps_its_weight() -> None:
    """The sensor sees what is positive alone: the sum of the weights below zero stays as it was."""

    def measure_above(state: Any, reference: Any, parameters: Any) -> Any:
        return (state[0] if state[0] > 0.0 else np.nan,)

    model = replace(SCALAR, sensors=(replace(scalar.VALUE, measure=measure_above, linear=False),))
    found = outputs(model, "particles", [scalar.source([0.5])], particles=200, cloud=True)["particle"]
    below = found["mean"][:, 0] <= 0.0
    assert 50 < below.sum() < 150
    assert_allclose(found["weight"][below], 1 / 200, rtol=1e-12)
    assert_allclose(found["weight"].sum(), 1.0, rtol=1e-12)
    assert np.ptp(found["weight"][~below]) > 0


# What is refused


def test_what_a_model_lacks_and_bad_numbers_are_one_sentence() -> None:
    assert METHODS["particles"] is BOOTSTRAP
    assert BOOTSTRAP.lacks(SCALAR) == BOOTSTRAP.lacks(make_wheel()) == ""

    def squared(state: Any, noise: Any, reference: Any, parameters: Any) -> Any:
        return (state[0] + noise[0] ** 2,)

    bent = replace(SCALAR, sensors=(replace(scalar.VALUE, measure=squared, noises=1),))
    assert BOOTSTRAP.lacks(bent) == "a likelihood of its sensor value"
    assert (
        BOOTSTRAP.lacks(replace(bent, sensors=(replace(bent.sensors[0], log_likelihood=normal),))) == ""
    )
    source = scalar.source([0.0])
    for label, sentence in {
        "particles:0": "estimator particles:0: parameter 'particles' is '0'; it should be greater than",
        "particles:many": "'particles' is 'many'; it should be a valid integer",
        "particles:-5": "'particles' is '-5'; it should be greater than or equal to 1",
        "particles:9000000": "it should be less than or equal to 1000000",
    }.items():
        with pytest.raises(BadInput, match=sentence):
            bind(label, [source], {})
    assert of_any_model(BOOTSTRAP).variant == "particles"
