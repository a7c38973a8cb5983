"""Estimators of optical bias and of the shooter on streams: batches, failures told per run."""

from dataclasses import replace

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.los import localization as optical
from fuselog.replay.families.los.localization import Scene
from fuselog.replay.judging.errors.evaluation import errors_of
from fuselog.replay.judging.errors.truths import Truths


def source(scenario: str, run: int = 0, **parameters: object) -> MemorySource:
    return memory_source(*record_run(scenario, parameters, 1, run))


def solve(sources: list[MemorySource], name: str, **settings: object) -> dict[str, Ragged]:
    """Outputs by their last names."""
    outputs = collect(replay(sources, bind(name, sources, settings)))
    return {topic.rpartition("/")[2]: ragged for topic, ragged in outputs.items()}


def failures(outputs: dict[str, Ragged], run: int) -> list[str]:
    return sentences_of(outputs["failure"].of_run(run))


BIAS = [(1.0, 1.0, 1.0)] * 3


def test_streams_give_what_the_arrays_give() -> None:
    """The estimate from messages equals the one from the measurements as an array, bit for bit."""
    run = source("optical-los", bias_deg=BIAS, passes=1)
    state = solve([run], "los-biases")["state"].stream
    sights = [run.streams[f"/sensor{s}/line_of_sight"] for s in (1, 2, 3)]
    measured = np.array([np.stack([s["azimuth_rad"], s["elevation_rad"]], axis=-1) for s in sights])
    places = np.array([run.streams[f"/sensor{s}/position"]["position_m"][0] for s in (1, 2, 3)])
    scene = Scene(places, np.zeros((3, 3)), np.full((3, 2), 0.34e-3), np.full((3, 3), np.nan))
    direct = optical.estimate(scene, measured.swapaxes(0, 1)[None])
    np.testing.assert_array_equal(state["mean"], direct.parameters)
    assert state.publish_time_ns[0] == max(s.publish_time_ns[-1] for s in sights)


def test_every_pass_is_a_batch_of_its_own_and_ensembles_equal_single_runs() -> None:
    runs = [source("optical-los", run, bias_deg=BIAS, passes=3) for run in range(3)]
    together = solve(runs, "los-biases")
    assert np.diff(together["state"].offsets).tolist() == [3, 3, 3]
    for number, run in enumerate(runs):
        alone, ours = solve([run], "los-biases")["state"].stream, together["state"].of_run(number)
        np.testing.assert_array_equal(alone["mean"], ours["mean"])
        np.testing.assert_array_equal(alone["covariance"], ours["covariance"])
    errors = errors_of(together["state"], [*map(Truths, runs)])
    assert errors is not None
    assert errors.without_truth == 0
    assert errors.kinds.count("angle") == 9


def test_a_bias_that_is_known_is_not_estimated() -> None:
    run = source("optical-los", bias_deg=BIAS, passes=1)
    state = solve([run], "los-biases", known_bias_deg={"sensor_2_roll": 1.0})["state"].stream
    assert "sensor_2_roll_bias_rad" not in state.components
    assert len(state.components) == 17
    with pytest.raises(BadInput, match="no bias 'sensor_9_roll'"):
        solve([run], "los-biases", known_bias_deg={"sensor_9_roll": 1.0})


def test_bad_runs_are_told_and_the_rest_goes_on() -> None:
    """A target behind all rays, one on a sensor, sights that are missing: beside a good run."""
    good = source("optical-los", 0, bias_deg=BIAS, passes=1)
    on_sensor = [(-5500, 950, 15), (-235.9, 8152, 0), (2413, 6451, 0)]
    runs = [
        good,
        source("optical-los", 1, bias_deg=BIAS, passes=1, target_position_m=on_sensor),
        source("optical-los", 2, bias_deg=BIAS, passes=1, dropout_probability=0.6),
    ]
    outputs = solve(runs, "los-biases")
    assert outputs["solution"]["converged"].tolist()[0] == 1
    assert len(outputs["state"].of_run(0)) == 1
    np.testing.assert_array_equal(
        outputs["state"].of_run(0)["mean"], solve([good], "los-biases")["state"].stream["mean"]
    )
    for run in (1, 2):
        assert len(outputs["state"].of_run(run)) == 0
        assert failures(outputs, run)
    assert "rank too low" in failures(outputs, 1)[0]


def test_collinear_sensors_and_too_few_targets_are_unobservable() -> None:
    line = [(-5e3, 0, 100), (0, 500, 200), (5e3, 1e3, 300)]
    for parameters in (
        {"sensor_position_m": line},
        {"target_position_m": [(-2860, 6820, 0), (2413, 6451, 0)]},
    ):
        outputs = solve([source("optical-los", **parameters)], "los-biases")
        assert "rank too low" in failures(outputs, 0)[0]


def test_sensors_that_differ_between_runs_are_no_ensemble() -> None:
    other = [(-5400, 950, 15), (-230, 2720, 45), (5900, 50, 20)]
    with pytest.raises(BadInput, match="position_m must be the same"):
        solve([source("optical-los"), source("optical-los", sensor_position_m=other)], "los-biases")


@pytest.mark.parametrize("mode", ["bearings-only", "local-estimates", "native-measurements"])
def test_every_shot_is_located_on_its_own(mode: str) -> None:
    """One message per shot at its last detection; NEES of 13 components over 100 shots near 13."""
    runs = [source("acoustic-shots", run, shots=20) for run in range(5)]
    outputs = solve(runs, f"shooter:{mode}")
    assert np.diff(outputs["solution"].offsets).tolist() == [20] * 5
    last = max(runs[0].streams[f"/sensor{s}/detections"].publish_time_ns[0] for s in range(1, 6))
    assert outputs["solution"].stream.publish_time_ns[0] == last
    errors = errors_of(outputs["state"], [*map(Truths, runs)])
    assert errors is not None
    size = len(errors.components)
    assert errors.nees.mean() == pytest.approx(size, abs=5.0 * np.sqrt(2.0 * size / len(errors.nees)))


def test_shots_may_have_any_numbers() -> None:
    """Numbers that do not count up in time: every shot is what it was, in the order of time."""
    run = source("acoustic-shots", shots=4)
    plain = solve([run], "shooter:bearings-only")["state"].stream
    streams = dict(run.streams)
    for topic, stream in run.streams.items():
        if topic.endswith("/detections"):
            other = np.array([30, 7, 99, 2], np.uint32)[stream["shot_id"] - stream["shot_id"].min()]
            streams[topic] = replace(stream, columns={**stream.columns, "shot_id": other})
    outputs = solve([replace(run, streams=streams)], "shooter:bearings-only")
    assert failures(outputs, 0) == []
    np.testing.assert_array_equal(outputs["state"]["mean"], plain["mean"])
    np.testing.assert_array_equal(outputs["state"].stream.publish_time_ns, plain.publish_time_ns)


def test_sensors_need_not_be_estimated() -> None:
    state = solve([source("acoustic-shots")], "shooter", estimate_sensors=False)["state"].stream
    assert state.components == ["x_m", "y_m", "trajectory_rad"]


def test_shots_that_too_few_hear_are_told() -> None:
    """With most detections lost some shots have fewer than two bearings; the others are located."""
    outputs = solve(
        [source("acoustic-shots", shots=40, dropout_probability=0.7)], "shooter:bearings-only"
    )
    found = outputs["solution"]["converged"] != 0
    assert 0 < found.sum() < len(found)
    assert len(outputs["state"]) == found.sum()
    assert len(failures(outputs, 0)) == (~found).sum()
