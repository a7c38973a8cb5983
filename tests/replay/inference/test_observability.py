"""Observability against section 7 of the reference sheet, and against what a smoother gains."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fuselog.pipeline.api.observability import observability
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.measurements import PLANE
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.model.model import Map, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.smoothing.iterated import IteratedSmoother
from tests.replay.inference.replays import outputs
from tests.replay.inference.test_smoothers import LEVEL, levels

EXACT = 1e-9
EPOCH_NS = 10**9
STATE = ("x_m", "y_m", "vx_mps", "vy_mps")


pytestmark = pytest.mark.usefixtures("uncompiled")


class SensorParameters(ModelParameters):
    """Of the one sensor there is."""

    sigma: float = 0.5


def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
    return state[0] + duration_s * state[2], state[1] + duration_s * state[3], state[2], state[3]


def distance(state: Any, reference: Any, parameters: Any) -> Any:
    return (np.hypot(state[0] - reference[0], state[1] - reference[1]),)


def bearing(state: Any, reference: Any, parameters: Any) -> Any:
    return (np.arctan2(state[1] - reference[1], state[0] - reference[0]),)


def variance(parameters: Any) -> Any:
    return (parameters.sigma**2,)


def target(measure: Any, name: str) -> Model:
    """A thing that moves straight on, and is seen from the points of a map."""
    seen_from = Map("/from", schemas.LANDMARK, "landmark_id", "position_m", PLANE)
    kind: Any = {name: "angle" if name == "bearing_rad" else "linear"}
    sensor = Sensor(
        "seen",
        schemas.BEARING if name == "bearing_rad" else schemas.RANGE,
        kind,
        measure,
        variance,
        reference=seen_from,
    )
    state: Any = dict.fromkeys(STATE, "linear")
    return Model("a target", state, SensorParameters, (sensor,), Motion(move, linear=True))


def log(model: Model, start: Any, places: Any, times_s: Any, scales: Any) -> MemorySource:
    """Exact measurements at times, each from a place of its own, and the truth as the prior's mean."""
    stamps = EPOCH_NS + np.rint(1e9 * times_s).astype(np.int64)
    measure, [name] = model.sensors[0].measure, model.sensors[0].measured
    values = [
        measure(move(tuple(start), (), time_s, None), place, None)[0]
        for time_s, place in zip(times_s, places, strict=True)
    ]
    number = np.arange(len(stamps))
    metadata = {"components": ",".join(STATE), "kinds": ",".join(["linear"] * 4)}
    prior = {"mean": [start], "covariance": [np.diag(np.square(scales)).ravel()]}
    streams = [
        make_stream("/prior", schemas.GAUSSIAN_ESTIMATE, [EPOCH_NS], metadata=metadata, **prior),
        make_stream("/from", schemas.LANDMARK, 0 * number, landmark_id=number, position_m=places),
        make_stream("/seen", model.sensors[0].schema, stamps, target_id=number, **{name: values}),
    ]
    run = RunMetadata(scenario="target", parameters={}, seed=0, run=0, epoch_ns=EPOCH_NS)
    return memory_source(Recording(streams), run)


RANGES = target(distance, "range_m")
BEARINGS = target(bearing, "bearing_rad")
HALVES_S = np.arange(41) * 0.5


def ranges() -> MemorySource:
    return log(RANGES, [30.0, 10.0, -1.0, 0.5], np.tile([5.0, -5.0], (41, 1)), HALVES_S, [10, 10, 1, 1])


def bearings(until_s: float) -> MemorySource:
    times_s = HALVES_S[until_s >= HALVES_S]
    places = np.stack([np.minimum(5 * times_s, 50), np.maximum(5 * (times_s - 10), 0)], axis=1)
    return log(BEARINGS, [40.0, 60.0, 1.0, -0.5], places, times_s, [50, 50, 2, 2])


def assert_direction(found: Any, wanted: list[float]) -> None:
    found = np.array(list(found.values()))
    assert_allclose(found * np.sign(found @ wanted), wanted, rtol=1e-8)


def test_ranges_to_one_beacon_do_not_tell_a_rotation_about_it() -> None:
    [row] = observability(ranges(), RANGES).to_dict("records")
    assert row["rank"] == 3
    assert_allclose(row["eigenvalues"][1:], [258.611708369, 3940.65636179, 34340.7319298], rtol=EXACT)
    assert abs(row["eigenvalues"][0]) < 1e-8
    assert_direction(
        row["direction"], [-0.514117866463, 0.856863110772, -0.0171372622154, -0.0342745244309]
    )
    assert row["weakest"].endswith("-0.0343 vy_mps: not observable, weaker than the prior")
    assert (row["begin_s"], row["end_s"], row["measurements"]) == (0, 20, 41)


def test_bearings_tell_the_distance_once_the_observer_turns() -> None:
    """Up to 10 s the scale of what is relative is not observable; up to 20 s all is."""
    [row] = observability(bearings(10), BEARINGS, sigma=0.01).to_dict("records")
    assert row["rank"] == 3
    assert_allclose(row["eigenvalues"][1:], [60.8640848932, 6309.80104816, 142554.128718], rtol=EXACT)
    assert_direction(
        row["direction"], [0.553835503266, 0.830753254899, -0.0553835503266, -0.00692294379]
    )
    [row] = observability(bearings(20), BEARINGS, sigma=0.01).to_dict("records")
    assert row["rank"] == 4
    wanted = [1400.05679476, 19366.7245204, 523609.255598, 1961519.13153]
    assert_allclose(row["eigenvalues"], wanted, rtol=EXACT)
    assert "priors" in row["weakest"]
    assert "weaker" not in row["weakest"]


def test_an_estimated_trajectory_fills_the_null_space_with_false_information(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The sheet's trap: rank 4, but the words still say that the prior knows more."""
    once = IteratedSmoother.smoothed_once

    def shaken(self: IteratedSmoother, state: Any) -> Any:
        way = once(self, state)
        way.states.mean[:, :2] += 0.3 * np.random.default_rng(31).standard_normal((41, 2))
        return way

    monkeypatch.setattr(IteratedSmoother, "smoothed_once", shaken)
    [row] = observability(ranges(), RANGES).to_dict("records")
    assert row["rank"] == 4
    assert_allclose(row["eigenvalues"][0], 1.06465653691, rtol=EXACT)
    assert row["weakest"].endswith("as much as 1.06 priors, weaker than the prior")


def test_windows_are_of_their_own_and_scales_can_be_stated() -> None:
    """Each tells of the state at its beginning; what is left over belongs to the last whole one."""
    whole = observability(ranges(), RANGES, window_s=8.0)
    assert whole["begin_s"].tolist() == [0, 8]
    assert whole["end_s"].tolist() == [8, 20]
    assert whole["measurements"].tolist() == [17, 24]
    later = log(
        RANGES, [22.0, 14.0, -1.0, 0.5], np.tile([5.0, -5.0], (24, 1)), HALVES_S[1:25], [10, 10, 1, 1]
    )
    [alone] = observability(later, RANGES).to_dict("records")
    assert_allclose(whole["eigenvalues"][1][1:], alone["eigenvalues"][1:], rtol=EXACT)
    scaled = observability(ranges(), RANGES, scales={"x_m": 20.0, "y_m": 20.0, "vx_mps": 2, "vy_mps": 2})
    assert_allclose(
        scaled["eigenvalues"][0][1:],
        4 * np.array([258.611708369, 3940.65636179, 34340.7319298]),
        rtol=EXACT,
    )


def test_without_noise_of_the_motion_it_is_what_the_smoother_gains() -> None:
    """P_s^-1 at the prior's time is P_0^-1 and the Gramian: a linear problem, missing components."""
    times_s, values = np.arange(1, 9) * 0.5, np.random.default_rng(3).standard_normal((8, 2))
    values[2, 0], values[5] = np.nan, np.nan
    covariance = np.array([[2.0, 0.3], [0.3, 1.0]])
    source, known = levels(times_s, values, [0.5, -0.2], covariance), {"level": 0.0, "slope": 0.0}
    smoothed = outputs(LEVEL, "smoother", [source], every_s=1.0, **known)["state"]
    gain = np.linalg.inv(smoothed["covariance"][0].reshape(2, 2)) - np.linalg.inv(covariance)
    [row] = observability(source, LEVEL, **known).to_dict("records")
    scale = np.sqrt(np.diag(covariance))
    assert_allclose(row["eigenvalues"], np.linalg.eigvalsh(scale[:, None] * gain * scale), rtol=EXACT)
    assert row["measurements"] == 7


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ({"window_s": 0.0}, "window_s"),
        ({"scales": {"x": 1.0}}, "--scale x: the state has no such component; did you mean 'x_m'"),
        ({"scales": {"x_m": -1.0}}, "x_m"),
        ({"model": "robot"}, "robot does not fit this log"),
    ],
)
def test_what_cannot_be_asked_is_one_sentence(asked: dict[str, Any], sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence) as error:
        observability(ranges(), **{"model": RANGES, **asked})
    assert "\n" not in str(error.value)


def test_a_log_without_measurements_tells_nothing() -> None:
    source = log(RANGES, [30.0, 10.0, -1.0, 0.5], np.empty((0, 2)), np.empty(0), [10, 10, 1, 1])
    with pytest.raises(BadInput, match="no messages on"):
        observability(source, RANGES)
