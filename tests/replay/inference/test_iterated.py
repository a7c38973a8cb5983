"""The iterated smoother against the reference sheet and against scipy's least squares."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import least_squares

from fuselog.pipeline.runs.recorded import replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.models.orientation import compose, conjugate
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.engine.vectors.tangent import rotation_vector
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.estimators import modelled_by
from fuselog.replay.inference.model.model import Motion
from fuselog.replay.inference.smoothing.affine import robust
from tests.replay.inference import attitude, vehicle_a
from tests.replay.inference.attitude import ATTITUDE
from tests.replay.inference.replays import bound, outputs
from tests.replay.inference.test_recursion import assert_equal
from tests.replay.inference.test_smoothers import LEVEL, at, dense, levels
from tests.replay.inference.vehicle_a import VEHICLE_A
from tests.replay.inference.wheel import make_wheel
from tests.replay.inference.wheel import simulate as simulate_wheel
from tests.replay.inference.wheel import source as wheel_source

pytestmark = pytest.mark.paper

EXACT = 1e-9
Told = list[tuple[float, str, int, Any]]


@cache
def solved(start: str) -> Any:
    """The sheet's problem; a tick of every second gives a state at t = 0."""
    source = vehicle_a.source(vehicle_a.simulate(7)[0])
    return outputs(VEHICLE_A, "smoother", [source], forward="iterated", start=start, every_s=1.0)


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
def test_the_sheets_row() -> None:
    """Section 2: states, traces, the cost of the start and of the end, six iterations."""
    found = solved("smoother")
    wanted = {
        0.0: [-0.0624489008757, 0.102354015107, -0.0350449258494, 0.579238530252, -0.02334953841],
        10.0: [2.01876185073, -3.58586109543, -3.77125235901, 0.687583245407, -0.792225488155],
        20.0: [1.62049043234, -1.95009108544, -11.6106713747, 0.897302944881, -0.82887782255],
    }
    for time_s, mean in wanted.items():
        state, _ = at(found, time_s)
        turns = 2 * np.pi * np.round((mean[2] - state[2]) / (2 * np.pi))
        assert_allclose(state + turns * np.eye(5)[2], mean, rtol=EXACT)
    for time_s, trace in ((0.0, 0.067755727668), (10.0, 0.0264960569307)):
        assert_allclose(at(found, time_s)[1], trace, rtol=EXACT)
    assert_allclose(found["iteration"]["cost"][0], 142.662830009, rtol=1e-11)
    assert_allclose(found["solution"]["cost"], 142.651391849, rtol=1e-11)
    assert (found["solution"]["iterations"], found["solution"]["converged"]) == (6, 1)
    assert found["solution"].stream.metadata["start"] == "smoother"


@pytest.mark.paper
@pytest.mark.parametrize(
    ("start", "cost", "iterations"), [("prior", 7086.12968525, 12), ("motion", 10730.8608525, None)]
)
def test_a_start_far_away_ends_in_a_false_minimum_which_cost_and_start_tell(
    start: str, cost: float, iterations: int | None
) -> None:
    """Wrapped bearings; the search converges, but says from where and to what."""
    ended = solved(start)["solution"]
    assert_allclose(ended["cost"], cost, rtol=1e-11)
    assert ended["converged"] == 1
    assert iterations in (None, ended["iterations"])
    assert ended.stream.metadata["start"] == start


# Against scipy


def residuals_of(told: Told) -> tuple[Any, Callable[[Any], Any], Callable[[Any], Any]]:
    """The distinct times of the vehicle's problem, and the whitened residuals of its states.

    Of the prior and the motion; and of the messages (messages, 2), zero where a component is missing.
    """
    times_s = np.unique([0.0, *(each[0] for each in told)])
    node = np.searchsorted(times_s, [each[0] for each in told])
    is_seen = np.array([each[1] == "rb" for each in told])
    values = np.array([np.resize(each[3], 2) for each in told])
    places = vehicle_a.BEACONS[[each[2] for each in told]]
    durations = np.diff(times_s)

    def moved(flat: Any) -> Any:
        x = flat.reshape(-1, 5)
        made = np.stack(vehicle_a.move(tuple(x[:-1].T), (), durations, None), axis=1)
        first = (x[0] - vehicle_a.MEAN) / np.sqrt(vehicle_a.VARIANCES)
        return np.append(first, (x[1:] - made) / np.sqrt(vehicle_a.NOISE * durations[:, None]))

    def measured(flat: Any) -> Any:
        x = flat.reshape(-1, 5)[node]
        dx, dy = (places - x[:, :2]).T
        seen = np.stack([np.hypot(dx, dy), np.arctan2(dy, dx) - x[:, 2]], axis=1)
        r = (values - np.where(is_seen[:, None], seen, x[:, 3:4])) / np.where(
            is_seen[:, None], [0.3, 1.0], [0.1, np.inf]
        )
        angle = r[is_seen, 1]
        r[is_seen, 1] = (angle - 2 * np.pi * np.round(angle / (2 * np.pi))) / 0.05
        return np.nan_to_num(r, nan=0.0)

    return times_s, moved, measured


def states_of(found: Any) -> Any:
    """The states, headings without jumps."""
    mean = found["state"]["mean"].copy()
    mean[:, 2] = np.unwrap(mean[:, 2])
    return mean


@pytest.mark.parametrize("loss", ["square", "huber", "cauchy"])
def test_it_is_least_squares(loss: str, uncompiled: None) -> None:
    """Scipy's optimum on the stacked residuals, and the blocks of (J'J)^-1 for the covariances.

    A robust loss goes by the length of a message's residual: what scipy gets is that residual, as long
    as its loss is high. There is an outlier.
    """
    told = vehicle_a.simulate(7)[0][:9]
    row = max(row for row, each in enumerate(told[:7]) if each[1] == "rb")
    told[row] = (*told[row][:3], told[row][3] + np.array([4.0, 0.0]))
    settings = {"loss": loss, "loss_scale": 1.5}
    found = outputs(
        VEHICLE_A, "smoother", [vehicle_a.source(told)], forward="iterated", every_s=1000.0, **settings
    )
    times_s, moved, measured = residuals_of(told)
    number = np.array([("square", "huber", "cauchy").index(loss), 1.5])

    def residuals(flat: Any) -> Any:
        r = measured(flat)
        squared = np.sum(r**2, axis=1)
        costs = np.array([robust(each, number)[0] for each in squared])
        scale = np.sqrt(2 * costs / np.where(squared > 0, squared, 1.0))
        return np.append(moved(flat), scale[:, None] * r)

    start = np.concatenate([vehicle_a.MEAN[None], states_of(found)])
    scipys = least_squares(residuals, start.ravel(), "3-point", ftol=1e-15, xtol=1e-15, gtol=1e-15)
    assert len(found["state"]) == len(times_s) - 1
    assert_allclose(found["solution"]["cost"], scipys.cost, rtol=1e-12)
    assert_allclose(states_of(found).ravel(), scipys.x[5:], atol=2e-7)
    cost, iteration = found["iteration"]["cost"], found["iteration"]["iteration"]
    assert np.all(np.diff(cost) <= 1e-9)
    assert_array_equal(iteration, np.arange(len(cost)))
    if loss == "square":
        spread = np.linalg.inv(scipys.jac.T @ scipys.jac)
        for k, covariance in enumerate(found["state"]["covariance"], 1):
            own = slice(5 * k, 5 * k + 5)
            assert_allclose(covariance.reshape(5, 5), spread[own, own], rtol=1e-5, atol=1e-9)


def test_a_robust_loss_has_the_weight_of_its_slope() -> None:
    for number in range(3):
        loss = np.array([number, 1.345])
        for squared in (0.01, 1.0, 1.9, 5.0, 400.0):
            slope = robust(squared + 1e-4, loss)[0] - robust(squared - 1e-4, loss)[0]
            assert_allclose(robust(squared, loss)[1], slope / 1e-4, rtol=1e-6)


def test_damping_only_helps_to_get_there(uncompiled: None) -> None:
    """The first steps are held back, the optimum is the same, and its covariance has none of it."""
    told = vehicle_a.simulate(8)[0][:20]
    free, held = (
        outputs(VEHICLE_A, "smoother", [vehicle_a.source(told)], forward="iterated", damping=damping)
        for damping in (0.0, 10.0)
    )
    assert held["iteration"]["damping"][0] == 10.0
    assert held["iteration"]["largest_step"][0] < 0.5 * free["iteration"]["largest_step"][0]
    assert_allclose(held["state"]["mean"], free["state"]["mean"], atol=1e-10)
    assert_allclose(held["state"]["covariance"], free["state"]["covariance"], rtol=1e-8, atol=1e-13)


def bend(state: Any, reference: Any, parameters: Any) -> Any:
    return np.arctan(state[0]), np.arctan(state[0])


def test_a_step_that_would_raise_the_cost_is_damped(uncompiled: None) -> None:
    """An arctangent three units from where it is measured: a free step goes four times too far."""
    model = replace(LEVEL, sensors=(replace(LEVEL.sensors[0], measure=bend, linear=False),))
    source = levels([0.1, 0.2], np.zeros((2, 2)), np.array([3.0, 0.0]), np.diag([100.0, 0.01]))
    found = outputs(model, "smoother", [source], forward="iterated", start="prior", measured=1e-4)
    told, ended = found["iteration"], found["solution"]
    assert told["damping"][0] == 0.0
    assert told["damping"].max() > 0.0
    assert np.all(np.diff(told["cost"]) < 1e-9)
    assert ended["converged"] == 1
    assert np.abs(found["state"]["mean"][:, 0]).max() < 0.01
    assert_allclose(ended["cost"], 0.045, rtol=0.01)  # that of the prior, three sigmas of ten away


# A noise that does not reach every state


def accelerate(state: Any, control: Any, noise: Any, duration_s: Any, parameters: Any) -> Any:
    half = 0.5 * duration_s * duration_s
    bend = 0.2 * duration_s * np.sin(state[0])
    return (
        state[0] + duration_s * state[1] + half * noise[0],
        state[1] - bend + duration_s * noise[0],
    )


def acceleration(state: Any, duration_s: Any, parameters: Any) -> Any:
    return (0.5,)


def far(state: Any, reference: Any, parameters: Any) -> Any:
    """How far the point is from two others, beside its line."""
    return np.sqrt(4.0 + state[0] * state[0]), np.sqrt(1.0 + (state[0] - 3.0) * (state[0] - 3.0))


PENDULUM = replace(
    LEVEL,
    sensors=(replace(LEVEL.sensors[0], measure=far, linear=False),),
    motion=Motion(accelerate, acceleration, noises=1),
)


@pytest.mark.parametrize("start", ["smoother", "prior"])
def test_singular_noise_is_worked_with_in_its_own_coordinates(start: str, uncompiled: None) -> None:
    """One acceleration a step, two states: the optimum over the first state and the accelerations."""
    rng = np.random.default_rng(4)
    times_s, values = np.arange(1, 21) * 0.25, 2.0 + 0.5 * rng.standard_normal((20, 2))
    mean, covariance = np.array([0.5, -0.2]), np.array([[2.0, 0.3], [0.3, 1.0]])
    root = np.linalg.inv(np.linalg.cholesky(covariance))

    def states(unknown: Any) -> Any:
        found = [tuple(unknown[:2])]
        for push in unknown[2:]:
            found.append(accelerate(found[-1], (), (push,), 0.25, None))
        return np.array(found)

    def residuals(unknown: Any) -> Any:
        x = states(unknown)
        seen = np.stack(far(tuple(x[1:].T), (), None), axis=1)
        parts = root @ (x[0] - mean), unknown[2:] / np.sqrt(0.5), np.ravel(values - seen) / np.sqrt(0.5)
        return np.concatenate(parts)

    found = outputs(
        PENDULUM,
        "smoother",
        [levels(times_s, values, mean, covariance)],
        forward="iterated",
        start=start,
    )
    best = least_squares(residuals, np.append(mean, np.zeros(20)), "3-point", ftol=1e-15, xtol=1e-15)
    assert found["solution"]["converged"] == 1
    assert_allclose(found["solution"]["cost"], best.cost, rtol=1e-10)
    assert_allclose(found["state"]["mean"], states(best.x)[1:], atol=1e-6)


def test_a_linear_problem_takes_one_step(uncompiled: None) -> None:
    """From the prior: one step there, and one that finds nothing left to do."""
    rng = np.random.default_rng(1)
    times_s = np.sort(np.round(rng.uniform(0.1, 5.0, 25), 1))
    values = rng.standard_normal((25, 2))
    values[3], values[7, 0] = np.nan, np.nan
    given = times_s, values, np.array([0.5, -0.2]), np.array([[2.0, 0.3], [0.3, 1.0]])
    found = outputs(LEVEL, "smoother", [levels(*given)], forward="iterated", start="prior")
    _, mean, covariance = dense(*given)
    assert found["solution"]["iterations"] == 2
    assert_allclose(found["state"]["mean"], mean[1:], rtol=1e-10, atol=1e-12)
    assert_allclose(
        found["state"]["covariance"].reshape(-1, 2, 2), covariance[1:], rtol=1e-10, atol=1e-12
    )


# Manifolds


def short_attitude(steps: int) -> tuple[MemorySource, Any]:
    source, _, gyro = attitude.simulate(21)
    end_ns = attitude.EPOCH_NS + 20_000_000 * steps
    streams = [
        each.take(slice(0, np.searchsorted(each.publish_time_ns, end_ns, "right")))
        for each in source.streams.values()
    ]
    return memory_source(Recording(streams), source.run), gyro


def test_rotations_are_stationary_on_their_manifold(uncompiled: None) -> None:
    """The slope of the cost by every rotation and bias is zero, and (J'J)^-1 are the covariances.

    Residuals are written with rotation vectors only; the prior is 1.5 rad off, so that steps are large.
    """
    source, gyro = short_attitude(8)
    found = outputs(ATTITUDE, "smoother", [source], forward="iterated", every_s=attitude.STEP_S)
    assert found["solution"]["converged"] == 1
    states = found["state"]["mean"]
    assert len(states) == 9

    def plus(x: Any, d: Any) -> Any:
        half = np.linalg.norm(d[:3]) / 2
        turn = np.append(np.cos(half), 0.5 * np.sinc(half / np.pi) * d[:3])
        return np.append(compose(x[:4], turn), x[4:] + d[3:])

    def minus(a: Any, b: Any) -> Any:
        return np.append(rotation_vector(compose(conjugate(b[:4]), a[:4])[None])[0], a[4:] - b[4:])

    noise = np.sqrt(0.02 * np.array([0.01**2] * 3 + [0.001**2] * 3))
    prior = np.array([0.3] * 3 + [0.02] * 3)
    force, field = (source[f"/{name}"] for name in ("force", "field"))

    def residuals(flat: Any) -> Any:
        x = [plus(state, d) for state, d in zip(states, flat.reshape(-1, 6), strict=True)]
        parts = [minus(x[0], np.array([1.0, 0, 0, 0, 0, 0, 0])) / prior]
        for k in range(8):
            moved = np.array(attitude.move(tuple(x[k]), tuple(gyro[k]), 0.02, None))
            parts.append(minus(x[k + 1], moved) / noise)
        for stream, measure, sigma in ((force, attitude.feel, 0.3), (field, attitude.point, 0.05)):
            for time_ns, value in zip(stream.publish_time_ns, stream["value"], strict=True):
                node = (time_ns - attitude.EPOCH_NS) // 20_000_000
                parts.append((value - np.array(measure(x[node], (), None))) / sigma)
        return np.concatenate(parts)

    step, zero = 1e-5, np.zeros(9 * 6)
    jacobian = np.stack(
        [
            (residuals(zero + step * row) - residuals(zero - step * row)) / (2 * step)
            for row in np.eye(len(zero))
        ],
        axis=1,
    )
    at_zero, spread = residuals(zero), np.linalg.inv(jacobian.T @ jacobian)
    assert_allclose(found["solution"]["cost"], 0.5 * at_zero @ at_zero, rtol=1e-10)
    assert_allclose(spread @ jacobian.T @ at_zero / np.sqrt(np.diag(spread)), 0.0, atol=1e-6)
    for k, covariance in enumerate(found["state"]["covariance"]):
        own = slice(6 * k, 6 * k + 6)
        assert_allclose(covariance.reshape(6, 6), spread[own, own], rtol=1e-5, atol=1e-11)


def test_an_interpolated_control_and_an_axis(uncompiled: None) -> None:
    """The wheel: its control starts before the prior, its messages wait for the next one."""
    messages = simulate_wheel(3, np.arange(-1, 12) * 0.2)
    found = outputs(make_wheel(), "smoother", [wheel_source(messages)], forward="iterated")
    once = outputs(make_wheel(), "smoother", [wheel_source(messages)])
    assert found["solution"]["converged"] == 1
    assert_array_equal(found["state"].stream.publish_time_ns, once["state"].stream.publish_time_ns)
    assert np.abs(found["state"]["mean"] - once["state"]["mean"]).max() < 0.1


# As one of many


def test_runs_do_not_mix_and_blocks_do_not_matter(uncompiled: None) -> None:
    """Two runs at once, one of which starts in the middle of nothing, are each as alone."""
    told = [vehicle_a.simulate(seed)[0][:10] for seed in (3, 4)]
    sources = [vehicle_a.source(each) for each in told]
    together = outputs(VEHICLE_A, "smoother", sources, forward="iterated")
    pieces = outputs(VEHICLE_A, "smoother", sources, block_messages=6, forward="iterated")
    for run, source in enumerate(sources):
        alone = outputs(VEHICLE_A, "smoother", [source], forward="iterated")
        for name in ("state", "solution", "iteration", "innovation"):
            assert_equal(together[name].of_run(run), alone[name].of_run(0))
            assert_equal(pieces[name].of_run(run), alone[name].of_run(0))


def test_what_the_gate_keeps_out_has_no_cost(uncompiled: None) -> None:
    told = vehicle_a.simulate(7, outlier=True)[0][:78]
    kept = outputs(
        VEHICLE_A, "smoother", [vehicle_a.source(told)], forward="iterated", gate_probability=0.999
    )
    out = kept["innovation"]["accepted"] == 0
    assert out.sum() == 1
    at_ns, target = kept["innovation"].stream.publish_time_ns[out], kept["innovation"]["target_id"][out]
    without = [
        (*each[:3], np.full(2, np.nan))
        if each[1] == "rb" and vehicle_a.EPOCH_NS + round(each[0] * 1e9) == at_ns and each[2] == target
        else each
        for each in told
    ]
    missing = outputs(VEHICLE_A, "smoother", [vehicle_a.source(without)], forward="iterated")
    assert_allclose(kept["solution"]["cost"], missing["solution"]["cost"], rtol=1e-12)
    assert_allclose(kept["state"]["mean"], missing["state"]["mean"], atol=1e-10)


def test_start_and_cost_stand_in_the_summary(uncompiled: None) -> None:
    source = vehicle_a.source(vehicle_a.simulate(7)[0][:16])
    made = modelled_by(VEHICLE_A, METHODS["smoother"], "smoother")
    settings = {"kind": made, "forward": "iterated", "start": "prior"}
    told = replay_ensemble([source], {"best": settings}, gap_limit_s=1.0).metrics(["solution"])
    found = outputs(VEHICLE_A, "smoother", [source], forward="iterated", start="prior")
    assert told["best.start_cost"] == pytest.approx(found["iteration"]["cost"][0])
    assert told["best.cost"] == pytest.approx(found["solution"]["cost"][0])
    assert told["best.converged_share"] == 1


def test_too_few_iterations_are_said(uncompiled: None) -> None:
    """The states are those of the last step taken, the covariances those about them."""
    told = vehicle_a.simulate(7)[0][:40]
    found = outputs(VEHICLE_A, "smoother", [vehicle_a.source(told)], forward="iterated", iterations=1)
    start = outputs(VEHICLE_A, "smoother", [vehicle_a.source(told)])
    assert (found["solution"]["iterations"], found["solution"]["converged"]) == (1, 0)
    assert_allclose(found["state"]["mean"], start["state"]["mean"], atol=1e-12)


@pytest.mark.parametrize(
    ("forward", "settings", "sentence"),
    [
        ("iterated:lag=1s", {}, "uses the whole run and has no variants; leave out ':lag=1s'"),
        ("ekf", {"loss": "huber"}, "loss is a setting of smoother:iterated, not of smoother:ekf"),
        ("iterated", {"loss": "tukey"}, "loss"),
        ("iterated", {"damping": -1.0}, "damping"),
        ("iterated", {"iterations": 0}, "iterations"),
    ],
)
def test_what_cannot_be_asked_is_one_sentence(
    forward: str, settings: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(BadInput, match=sentence) as error:
        bound(VEHICLE_A, "smoother", [vehicle_a.source([])], forward=forward, **settings)
    assert "\n" not in str(error.value)
