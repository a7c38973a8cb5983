"""Parameters in the state: the same as a model that was written so, and recovered within their sigma."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_equal
from scipy.stats import chi2

import fuselog as fl
from fuselog.pipeline.runs.recorded import record_ensemble, replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.models.planar import range_bearing
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.estimators.dead_reckoning import RECKONING
from fuselog.replay.estimators.landmarks import ROBOT
from fuselog.replay.inference.model.augmentation import augmented
from fuselog.replay.inference.model.checking import check_model
from fuselog.replay.inference.model.model import Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from tests.replay.inference import vehicle_a
from tests.replay.inference.replays import bound, outputs
from tests.replay.inference.vehicle_a import (
    RANGE_BEARING,
    SPEED,
    VEHICLE_A,
    VehicleParameters,
    move,
    noise,
)
from tests.replay.inference.wheel import make_wheel

BIAS, SIGMA, DRIFT = 0.25, 0.5, 0.02
ESTIMATE: dict[str, Any] = {
    "estimate": ["bias_range_m"],
    "estimate_sigma": {"bias_range_m": SIGMA},
    "estimate_drift": {"bias_range_m": DRIFT},
}


class BiasedParameters(VehicleParameters):
    """With a range bias."""

    bias_range_m: float = BIAS


def see(state: Any, reference: Any, parameters: Any) -> Any:
    distance, bearing = range_bearing((state[0], state[1], state[2]), reference)
    return distance + parameters.bias_range_m, bearing


def see_by_state(state: Any, reference: Any, parameters: Any) -> Any:
    distance, bearing = range_bearing((state[0], state[1], state[2]), reference)
    return distance + state[5], bearing


def move_six(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    x, y, heading, speed, turn = move(state[:5], control, duration_s, parameters)
    return x, y, heading, speed, turn, state[5]


def noise_six(state: Any, duration_s: Any, parameters: Any) -> Any:
    x, y, heading, speed, turn = noise(state[:5], duration_s, parameters)
    return x, y, heading, speed, turn, 0.02**2 * duration_s


DECLARED = replace(
    VEHICLE_A,
    parameters=BiasedParameters,
    sensors=(replace(RANGE_BEARING, measure=see), SPEED),
    augmentable={"bias_range_m": "linear"},
)
WRITTEN = Model(
    "the same by hand",
    {**vehicle_a.STATE, "bias_range_m": "linear"},
    VehicleParameters,
    (replace(RANGE_BEARING, measure=see_by_state), SPEED),
    Motion(move_six, noise_six),
)


def with_bias(source: MemorySource) -> MemorySource:
    """The log with the bias in its prior."""
    longer = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        source.streams["/prior"].publish_time_ns,
        metadata={
            "components": ",".join(WRITTEN.state),
            "kinds": ",".join(WRITTEN.state.values()),
        },
        mean=[[*vehicle_a.MEAN, BIAS]],
        covariance=np.diag([*vehicle_a.VARIANCES, SIGMA**2]).reshape(1, 36),
    )
    return MemorySource({**source.streams, "/prior": longer}, source.run, source.name)


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("method", ["ekf", "ukf", "smoother"])
def test_it_is_the_model_that_has_it_in_its_state(method: str) -> None:
    source = vehicle_a.source(vehicle_a.simulate(7)[0][:80])
    found = outputs(DECLARED, method, [source], **ESTIMATE)
    by_hand = outputs(WRITTEN, method, [with_bias(source)])
    assert found["state"].stream.components[-1] == "bias_range_m"
    for name in ("mean", "covariance"):
        assert_allclose(found["state"][name], by_hand["state"][name], rtol=1e-9, atol=1e-12)
    likelihoods = [each["innovation"]["log_likelihood"].sum() for each in (found, by_hand)]
    assert_allclose(*likelihoods, rtol=1e-12)


@pytest.mark.paper
def test_augmented_models_keep_to_what_they_declare() -> None:
    """With noise of all kinds; what reads none of them stays linear."""
    check_model(augmented(ROBOT, tuple(ROBOT.augmentable)))
    check_model(augmented(RECKONING, ("forward_scale",)))
    wheel = replace(make_wheel(), augmentable={"gate_probability": "linear"})
    check_model(same := augmented(wheel, ("gate_probability",)))
    assert [sensor.linear for sensor in same.sensors] == [each.linear for each in wheel.sensors]
    assert not augmented(ON_A_LINE, ("delay_s",)).sensors[0].linear
    check_model(augmented(ON_A_LINE, ("delay_s",)))


def test_what_can_be_estimated_is_listed() -> None:
    listed = (
        "bias_range_m, bias_bearing_rad (angle), bias_heading_rad (angle), forward_scale, "
        "turn_bias_radps, lever_x_m, lever_y_m"
    )
    assert fl.models["robot"].facts["estimable"] == listed


@pytest.mark.paper
def test_biases_of_simulated_robots_are_recovered_within_their_sigma() -> None:
    """And the pose is as good as its covariance says, which without them it is not."""
    runs, true = 40, {"bias_range_m": 0.2, "turn_bias_radps": 0.02}
    scenario = {
        "duration_s": 20.0,
        "turn_bias_radps": true["turn_bias_radps"],
        "range_bearing": {"rate_hz": 5.0, "bias_range_m": true["bias_range_m"]},
    }
    sources = record_ensemble("landmarks", scenario, 17, runs)
    sigmas = {"bias_range_m": 0.3, "turn_bias_radps": 0.05}
    settings = {"estimate": list(true), "estimate_sigma": sigmas, "gate_probability": 1.0}
    labels = ["ekf", "smoother:ekf"]
    replayed = replay_ensemble(sources, dict.fromkeys(labels, settings), gap_limit_s=0.2)
    metrics = replayed.metrics()
    for label in labels:
        poses = replayed.outputs[f"/estimates/{label}/robot1/pose"]
        last = gather([poses.of_run(run).take(slice(-1, None)) for run in range(runs)]).stream
        for index, (name, value) in enumerate(true.items(), start=3):
            assert last.components[index] == name
            sigma = np.sqrt(last["covariance"].reshape(runs, 5, 5)[:, index, index])
            assert sigma.max() < 0.2 * sigmas[name]
            squares = (((last["mean"][:, index] - value) / sigma) ** 2).sum()
            assert chi2.ppf(0.005, runs) < squares < chi2.ppf(0.995, runs)
        nees = metrics[f"{label}.nees.robot1"] * runs
        assert chi2.ppf(0.005, 3 * runs) < nees < chi2.ppf(0.995, 3 * runs)
    without = replay_ensemble(sources, {"ekf": {}}, gap_limit_s=0.2).metrics()
    assert without["ekf.nees.robot1"] > 30


@pytest.mark.parametrize(
    ("augmentable", "words"),
    [
        (("delay_s",), "augmentable is a tuple; expected a mapping from parameter to kind"),
        ({"dellay_s": "linear"}, "'dellay_s' is not a parameter of the model; did you mean 'delay_s'"),
        ({"delay_s": "metres"}, "delay_s is of kind 'metres'; expected linear or angle"),
    ],
)
def test_what_is_no_list_of_what_can_be_estimated_is_one_sentence(augmentable: Any, words: str) -> None:
    model = replace(ON_A_LINE, augmentable=augmentable)
    given: dict[str, Any] = {"estimate": ["delay_s"], "estimate_sigma": {"delay_s": 0.5}}
    with pytest.raises(BadInput, match=words):
        bound(model, "ekf", [MemorySource({}, RunMetadata("line", epoch_ns=0), "line")], **given)


@pytest.mark.usefixtures("uncompiled")
def test_particles_say_that_a_parameter_is_constant() -> None:
    """What is drawn at the start is all there is of it, unless it drifts."""
    log, estimate = fl.record("landmarks", duration_s=0.5), ["bias_range_m", "forward_scale"]
    given = {"kind": "particles:5", "estimate": estimate, "estimate_sigma": dict.fromkeys(estimate, 0.1)}
    drifts = {"bias_range_m": 0.01, "forward_scale": 0.0}
    comes_back = {"forward_scale": 5.0}
    own = {
        "still": given,
        "one": {**given, "estimate_drift": drifts},
        "none": {**given, "estimate_drift": drifts, "estimate_time_s": comes_back},
    }
    words = "is constant, so particles keep the values that were drawn at the start"
    said = [each.partition(words) for each in fl.replay(log, own).losses if words in each]
    assert [first for first, _, _ in said] == [
        "still robot1: bias_range_m, forward_scale ",
        "one robot1: forward_scale ",
    ]
    assert all("give estimate_drift, or use a Gaussian filter" in remedy for _, _, remedy in said)


@pytest.mark.usefixtures("uncompiled")
def test_a_truth_may_have_the_parameter_too() -> None:
    """Then its error is judged where it is estimated; an estimate without it is judged as before."""
    log, own = fl.record("landmarks", duration_s=0.5), {"ekf": {}, "more": {"kind": "ekf", **ESTIMATE}}
    truth = log["/robot1/truth"]
    kinds = {"components": "x_m,y_m,heading_rad,bias_range_m", "kinds": "linear,linear,angle,linear"}
    wider = np.pad(truth["state"][:, :3], ((0, 0), (0, 1)))
    stamps_ns = truth.publish_time_ns
    more = make_stream(truth.topic, schemas.TRUTH_STATE, stamps_ns, metadata=kinds, state=wider)
    judged = [
        fl.replay(replace(log, streams={**log.streams, truth.topic: each}), own).judge.metrics
        for each in (truth, more)
    ]
    known = [metrics["more.bias_range_rmse_m.robot1"] for metrics in judged]
    assert np.isfinite(known).tolist() == [False, True]
    alone = [{k: v for k, v in metrics.items() if k.startswith("ekf.")} for metrics in judged]
    assert_equal(*alone)


# A time offset: what the sensor says is of the state of so much earlier


class OffsetParameters(ModelParameters):
    """How old a fix is when it is stamped."""

    delay_s: float = 0.0


def fix(state: Any, reference: Any, parameters: Any) -> Any:
    return (state[0] - parameters.delay_s * state[1],)


def prompt_fix(state: Any, reference: Any, parameters: Any) -> Any:
    return (state[0],)


def fix_noise(parameters: Any) -> Any:
    return (0.05**2,)


def walk(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    return state[0] + duration_s * state[1], state[1]


def walk_noise(state: Any, duration_s: Any, parameters: Any) -> Any:
    return 0.0, 0.5 * duration_s


FIX = Sensor(
    "fix",
    schemas.VECTOR_MEASUREMENT,
    {"x_m": "linear"},
    fix,
    fix_noise,
    read=lambda stream: stream["value"],
    linear=True,
)
ON_A_LINE = Model(
    "on a line",
    {"x_m": "linear", "vx_mps": "linear"},
    OffsetParameters,
    (FIX, replace(FIX, topic="prompt", measure=prompt_fix)),
    Motion(walk, walk_noise, linear=True),
    augmentable={"delay_s": "linear"},
)


@pytest.mark.usefixtures("uncompiled")
def test_a_time_offset_is_a_parameter_too() -> None:
    """A model whose state says how it moves lets its sensor see the state of another time."""
    rng, delay_s, count = np.random.default_rng(3), 0.2, 400
    x, speed = np.zeros(count), np.full(count, 3.0)
    for k in range(1, count):
        speed[k] = speed[k - 1] + np.sqrt(0.5 * 0.1) * rng.standard_normal()
        x[k] = x[k - 1] + 0.1 * speed[k - 1]
    stamps = 10**9 + 10**8 * np.arange(count)
    streams = [
        make_stream(
            topic,
            schemas.VECTOR_MEASUREMENT,
            stamps,
            value=(value + 0.05 * rng.standard_normal(count))[:, None],
        )
        for topic, value in {"/fix": x - delay_s * speed, "/prompt": x}.items()
    ]
    prior = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        stamps[:1],
        metadata={"components": "x_m,vx_mps", "kinds": "linear,linear"},
        mean=[[0.0, 3.0]],
        covariance=[[0.01, 0.0, 0.0, 0.01]],
    )
    run = RunMetadata("line", epoch_ns=0)
    source = MemorySource({each.topic: each for each in (prior, *streams)}, run, "line")
    settings: dict[str, Any] = {"estimate": ["delay_s"], "estimate_sigma": {"delay_s": 0.5}}
    last = outputs(ON_A_LINE, "ekf", [source], **settings)["state"].stream
    sigma = np.sqrt(last["covariance"][-1][-1])
    assert abs(last["mean"][-1, 2] - delay_s) < 3 * sigma < 0.05
