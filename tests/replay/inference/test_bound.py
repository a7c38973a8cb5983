"""The posterior Cramer-Rao bound, against the reference sheet, dense information, and estimators."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fuselog.pipeline.output.summary import error_charts
from fuselog.pipeline.runs.ensemble import RunGroup, replay_parts
from fuselog.pipeline.runs.recorded import record_ensemble, replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.smoothing.bound import back_memory, smooth
from fuselog.replay.judging.consistency.bounds import Bounds, Output
from tests.replay.inference import vehicle_a
from tests.replay.inference.replays import bound, outputs
from tests.replay.inference.test_cells import NEAR_LINEAR, SCENARIOS
from tests.replay.inference.vehicle_a import VEHICLE_A

EPOCH_NS = 10**9
PLANE = ("x_m", "y_m", "vx_mps", "vy_mps")


# The sheet's linear example


class PlaneParameters(ModelParameters):
    """The density of the acceleration."""

    density: float = 0.5


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    x, y, vx, vy = state
    return x + duration_s * vx, y + duration_s * vy, vx, vy


def noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    q = parameters.density
    place, mixed, speed = q * duration_s**3 / 3, q * duration_s**2 / 2, q * duration_s
    return place, 0.0, place, mixed, 0.0, speed, 0.0, mixed, 0.0, speed


def stiff_noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    return 0.0, 0.0, parameters.density * duration_s, parameters.density * duration_s


def measure(state: Any, reference: Any, parameters: Any) -> Any:
    return state[0], state[1]


def measure_noise(parameters: Any) -> Any:
    return 0.25, 0.25


FIX = Sensor(
    "fix",
    schemas.VECTOR_MEASUREMENT,
    {"x_m": "linear", "y_m": "linear"},
    measure,
    measure_noise,
    read=lambda stream: stream["value"],
    linear=True,
)
CV = Model(
    "a target of constant velocity",
    dict.fromkeys(PLANE, "linear"),
    PlaneParameters,
    (FIX,),
    Motion(move, noise, linear=True),
)
COVARIANCE = np.diag([1, 1, 0.25, 0.25])


def target(seed: int, first: int = 1, truth: bool = True) -> MemorySource:
    """Fifty steps of .1 s from step `first` on; what is measured does not matter."""
    rng = np.random.default_rng(seed)
    stamps = EPOCH_NS + 10**8 * np.arange(first, 51)
    metadata = {"components": ",".join(PLANE), "kinds": "linear,linear,linear,linear"}
    prior = {"mean": np.zeros((1, 4)), "covariance": COVARIANCE.reshape(1, 16)}
    streams = [
        make_stream("/prior", schemas.GAUSSIAN_ESTIMATE, [EPOCH_NS], metadata=metadata, **prior),
        make_stream("/fix", schemas.VECTOR_MEASUREMENT, stamps, value=rng.normal(size=(51 - first, 2))),
    ]
    if truth:
        times, states = EPOCH_NS + 10**8 * np.arange(51), rng.normal(size=(51, 4))
        streams.append(
            make_stream("/truth", schemas.TRUTH_STATE, times, metadata=metadata, state=states)
        )
    run = RunMetadata(scenario="target", parameters={}, seed=seed, run=0, epoch_ns=EPOCH_NS)
    return memory_source(Recording(streams), run)


def bounds_of(found: Any, sources: Sequence[MemorySource]) -> Bounds:
    return Bounds().add(Output("bound", "", "step", found["step"], sources))


def dense(steps: Any) -> Any:
    """The covariances (nodes, 4, 4) by the inverse of the whole joint information of one run."""
    transition, noises, information = (
        steps[name].reshape(-1, 4, 4) for name in ("transition", "noise", "information")
    )
    count = len(transition)
    joint = np.zeros((4 * count, 4 * count))
    for k in range(count):
        rows = np.zeros((4, 4 * count))
        rows[:, 4 * k : 4 * k + 4] = np.eye(4)
        if k:
            rows[:, 4 * k - 4 : 4 * k] = -transition[k]
        joint += rows.T @ np.linalg.inv(noises[k]) @ rows
        joint[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] += information[k]
    whole = np.linalg.inv(joint)
    return np.array([whole[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] for k in range(count)])


@pytest.mark.usefixtures("uncompiled")
def test_the_linear_example_gives_the_sheets_numbers() -> None:
    """Over three runs and along one; the filter's own covariance is it too."""
    sources = [target(seed) for seed in range(3)]
    found = outputs(CV, "bound", sources)
    over_runs = bounds_of(found, sources).covariances()
    assert over_runs is not None
    along = found["state"]["covariance"].reshape(3, 50, 4, 4)
    exact = outputs(CV, "ekf", sources[:1])["state"]["covariance"].reshape(50, 4, 4)
    for covariance in (over_runs[-1], along[0, -1]):
        assert_allclose(np.diag(covariance), [0.0646230425516] * 2 + [0.31061774829] * 2, rtol=1e-9)
        assert_allclose(covariance[0, 2], 0.0962748981334, rtol=1e-9)
    sigma = np.sqrt(np.diagonal(exact, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    assert np.abs((over_runs - exact) / scale).max() < 1e-12
    assert np.abs((along[0] - exact) / scale).max() < 1e-14


@pytest.mark.usefixtures("uncompiled")
def test_smoothers_are_held_to_the_joint_information() -> None:
    """Step 25: position sigma .360 of the filter, .193 of the smoother."""
    sources = [target(seed) for seed in range(2)]
    filtered, found = (outputs(CV, "bound", sources, of=of) for of in ("filter", "smoother"))
    sigma = [
        np.sqrt(bounds_of(each, sources).covariances()[24, :2, :2].trace()) for each in (filtered, found)
    ]
    assert_allclose(sigma, [0.360, 0.193], atol=5e-4)
    whole = dense(found["step"].of_run(0))[1:]
    assert_allclose(bounds_of(found, sources).covariances(), whole, rtol=1e-7, atol=1e-12)
    along = found["state"].of_run(0)["covariance"].reshape(50, 4, 4)
    assert_allclose(along, whole, rtol=1e-7, atol=1e-12)


@pytest.mark.usefixtures("uncompiled")
def test_singular_noise_and_other_stamps_are_averaged_along_the_trajectories() -> None:
    stiff = replace(CV, motion=Motion(move, stiff_noise, linear=True))
    sources = [target(seed) for seed in range(2)]
    found = outputs(stiff, "bound", sources)
    assert bounds_of(found, sources).complaint == "the process noise is singular"
    exact = outputs(stiff, "ekf", sources)["state"]["covariance"]
    assert_allclose(found["state"]["covariance"], exact, atol=1e-14)
    smoothed, ours = (
        outputs(stiff, method, sources, **values)["state"]["covariance"]
        for method, values in (("smoother", {}), ("bound", {"of": "smoother"}))
    )
    assert_allclose(ours, smoothed, atol=1e-12)
    unalike = [target(0), target(1, first=2)]
    assert (
        bounds_of(outputs(CV, "bound", unalike), unalike).complaint == "the runs have different stamps"
    )


@pytest.mark.usefixtures("uncompiled")
def test_the_first_node_may_have_the_priors_stamp() -> None:
    """Measured there, and a tick alone: the same from the first common stamp on."""
    sources = [target(0, first=0)]
    found = outputs(CV, "bound", sources)
    covariances = bounds_of(found, sources).covariances()
    assert covariances is not None
    assert_allclose(covariances, found["state"]["covariance"].reshape(51, 4, 4), rtol=1e-9, atol=1e-15)
    ticked = [target(0)]
    found = outputs(CV, "bound", ticked, every_s=0.1)
    covariances = bounds_of(found, ticked).covariances()
    assert covariances is not None
    assert_allclose(
        covariances, found["state"]["covariance"].reshape(51, 4, 4)[1:], rtol=1e-9, atol=1e-15
    )


# Model A


@cache
def trajectories(runs: int, end_s: float = 20.0) -> tuple[MemorySource, ...]:
    simulated = vehicle_a.simulate_all(range(1000, 1000 + runs), missing=False)
    return tuple(
        vehicle_a.source(
            [each for each in told if each[0] <= end_s],
            truth=[each for each in truth if each[0] <= end_s],
        )
        for told, truth in simulated
    )


@pytest.mark.paper
def test_two_hundred_trajectories_give_the_sheets_table() -> None:
    sources = trajectories(200)
    found = bounds_of(outputs(VEHICLE_A, "bound", sources), sources)
    covariances = found.covariances()
    assert covariances is not None
    place = np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1])
    rows = np.searchsorted(found.stamps[1:], np.array([1, 5, 10, 20]) * 10**9)
    wanted = [0.224835762459, 0.159244629134, 0.137779340906, 0.153995605932]
    assert_allclose(place[rows], wanted, rtol=1e-9)
    variances = [0.0112082993816, 0.0125063472646, 6.85875939412e-4, 0.00565370750787, 0.0124868724342]
    assert_allclose(np.diag(covariances[-1]), variances, rtol=1e-9)
    estimates = outputs(VEHICLE_A, "ekf", sources)["state"]["mean"].reshape(200, 160, 5)
    truth = np.stack([source.streams["/truth"]["state"][1:] for source in sources])
    rmse = np.sqrt(np.mean(np.sum((estimates - truth)[:, :, :2] ** 2, axis=2), axis=0))
    assert_allclose(rmse[rows], [0.228, 0.160, 0.163, 0.174], atol=5e-4)
    assert_allclose(np.mean(rmse / place), 1.0855, atol=5e-5)


@pytest.mark.paper
@pytest.mark.usefixtures("uncompiled")
def test_parts_blocks_and_orders_of_an_ensemble_give_the_same_bound() -> None:
    """Cut in two, and in blocks: equal but for round-off of the sums."""
    sources = trajectories(4, 4.0)
    whole = bounds_of(outputs(VEHICLE_A, "bound", sources), sources).covariances()
    merged = Bounds()
    for part in (slice(0, 1), slice(1, 4)):
        each = outputs(VEHICLE_A, "bound", sources[part])["step"]
        merged = merged.merge(Bounds().add(Output("bound", "", "step", each, sources[part], part.start)))
    assert whole is not None
    assert_allclose(merged.covariances(), whole, rtol=1e-9)
    assert merged.covariances() is not None
    blocks = outputs(VEHICLE_A, "bound", sources, 40)
    assert_allclose(bounds_of(blocks, sources).covariances(), whole, rtol=1e-12)


@pytest.mark.usefixtures("uncompiled")
def test_runs_of_other_lengths_have_no_bound_together() -> None:
    """Their steps are of the same stamps as far as both go; later the mean would be of one alone."""
    sources = [target(0), target(1)]
    fixes = sources[1].streams["/fix"]
    streams = {**sources[1].streams, "/fix": fixes.take(slice(0, 30))}
    short = Recording(list(streams.values()))
    sources[1] = memory_source(short, sources[1].run)
    bounds = bounds_of(outputs(CV, "bound", sources), sources)
    assert bounds.complaint
    assert bounds.covariances() is None


# What is judged


@pytest.mark.paper
@pytest.mark.parametrize("name", NEAR_LINEAR)
def test_no_filter_is_below_the_bound_and_no_smoother_below_that_of_smoothers(name: str) -> None:
    """Over 25 runs, by component: the mean square is not below by more than four standard errors."""
    scenario, parameters = SCENARIOS[name]
    sources = record_ensemble(scenario, parameters, 5, 25)
    labels = ("ekf", "ukf", "smoother:ekf", "smoother:ukf", "bound", "bound:smoother")
    settings = {label: {"model": name} for label in labels}
    replayed = replay_ensemble(sources, settings, gap_limit_s=0.2)
    assert not any(replayed.metrics(["failures"]).values())
    for errors in replayed.errors:
        if errors.is_bound:
            continue
        of = "bound:smoother" if errors.estimator.startswith("smoother") else "bound"
        for column, component in enumerate(errors.components):
            per_run = np.array(
                [np.mean(errors.error[errors.run == run, column] ** 2) for run in range(25)]
            )
            mean, error = per_run.mean(), per_run.std(ddof=1) / 5
            least = least_square(replayed, of, errors.case, component)
            assert mean > least - 4 * error
            assert mean < 3 * least


def least_square(replayed: Any, of: str, case: str, component: str) -> float:
    """Of the ensemble, where it has one, or the mean along the trajectories."""
    bounds = Bounds()
    steps = replayed.outputs["/".join(filter(None, ("/estimates", of, case, "step")))]
    covariances = bounds.add(Output(of, case, "step", steps, replayed.sources)).covariances()
    [errors] = [each for each in replayed.errors if (each.estimator, each.case) == (of, case)]
    column = errors.components.index(component)
    if covariances is None:
        return float(errors.covariance[:, column, column].mean())
    return float(covariances[:, column, column].mean())


@pytest.mark.usefixtures("uncompiled")
def test_tables_and_metrics_show_the_bound_beside_estimators() -> None:
    """RMSE under the names that those of estimators have, over the ensemble and by step; no NEES."""
    sources = record_ensemble("batch-reactor", {}, 3, 4)
    settings = {label: {"model": "batch-reactor"} for label in ("ekf", "bound")}
    parts = [RunGroup(sources[:3], 0, is_all=False), RunGroup(sources[3:], 3, is_all=False)]
    judge = replay_parts(parts, settings, gap_limit_s=0.2).judge
    metrics, [table] = judge.metrics, [each for topic, each in judge.steps.items() if "/bound/" in topic]
    assert {key.replace("bound", "ekf") for key in metrics if "bound" in key and "rmse" in key} == {
        key for key in metrics if "ekf" in key and "rmse" in key
    }
    assert not [key for key in metrics if key.startswith("bound.nees")]
    assert table["nees"].isna().all()
    squares = np.mean(table["rmse_pressure_a"] ** 2)
    assert_allclose(metrics["bound.pressure_rmse_a"], np.sqrt(squares))
    along = [np.mean(each["covariance"][:, 0]) for each in alone(sources)]
    assert metrics["bound.pressure_rmse_a"] < np.sqrt(np.mean(along))  # Jensen's inequality
    assert judge.notes_of_coverage == []
    [chart] = error_charts(judge).values()
    labels = [{series.label for series in panel.series} for panel in chart.panels]
    assert ["bound" in each for each in labels] == [True, False]  # it has no NEES


def alone(sources: Sequence[MemorySource]) -> list[Any]:
    """What is known along each trajectory."""
    settings = {"bound": {"model": "batch-reactor"}}
    states = replay_ensemble(sources, settings, gap_limit_s=0.2).outputs["/estimates/bound/state"]
    return [states.of_run(run) for run in range(len(sources))]


# What is refused


@pytest.mark.usefixtures("uncompiled")
def test_a_bound_without_truth_is_refused_in_one_sentence() -> None:
    source = target(0, truth=False)
    with pytest.raises(BadInput, match=r"a bound needs the true states, but .* /truth; use"):
        bound(CV, "bound", [source])
    short = target(0)
    cut = [
        each.take(slice(0, 20)) if each.topic == "/truth" else each for each in short.streams.values()
    ]
    found = outputs(CV, "bound", [memory_source(Recording(cut), short.run)])
    assert len(found["state"]) == 19
    assert "the truth is unknown at this time" in str(found["failure"].stream.metadata)


def test_the_way_back_is_the_smoothers_where_what_is_predicted_is_singular() -> None:
    """Two runs of their own; the last state is known exactly, so that no inverse of P- is there."""
    rng, steps = np.random.default_rng(6), 9
    transition = np.eye(3) + 0.2 * rng.standard_normal((steps, 3, 3))
    transition[:, 2] = [0.0, 0.0, 1.0]
    root = rng.standard_normal((2, steps, 3, 3)) * np.array([1.0, 1.0, 0.0])[:, None]
    covariance, noise = root @ root.swapaxes(-1, -2)
    for node in range(1, steps):  # a measurement leaves half of what is predicted
        predicted = transition[node] @ covariance[node - 1] @ transition[node].T + noise[node]
        covariance[node] = 0.5 * predicted
    offsets, found = np.array([0, 4, steps]), covariance.copy()
    for run in range(2):
        smooth(run, offsets, transition, noise, found, back_memory(3))
    for begin, end in ((0, 4), (4, steps)):
        wanted = covariance[end - 1]
        assert_allclose(found[end - 1], wanted)
        for node in range(end - 2, begin - 1, -1):
            step, here = transition[node + 1], covariance[node]
            predicted = step @ here @ step.T + noise[node + 1]
            gain = here @ step.T @ np.linalg.pinv(predicted, 1e-10, hermitian=True)
            wanted = here + gain @ (wanted - predicted) @ gain.T
            assert_allclose(found[node], wanted, rtol=1e-9, atol=1e-12)
            assert found[node].trace() < 0.99 * here.trace()
