"""Moving lines of sight: recorder and model agree, and what can be told of the biases."""

import numpy as np
import pytest

from fuselog import make_stream, schemas
from fuselog.pipeline.runs.recorded import record_ensemble, replay_in_memory
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.los.models import bias_components
from fuselog.recorders.log import Stream
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.families.los.moving import move, sight

SIDE_BY_SIDE = [(-10e3, 5e3, 0.0), (0.0, 5e3, 0.0), (10e3, 5e3, 0.0)]
MANOEUVRE = {"weave_m": [0.0, 0.0, 1000.0]}
EXACT = {"sigma_rad": 1e-12, "acceleration_density": 0.0, "bias_drift": 0.0, "duration_s": 30.0}


def recorded(**parameters) -> MemorySource:
    (source,) = record_ensemble("moving-los", EXACT | parameters, 3, 1)
    return source


def unknowns(source: MemorySource) -> np.ndarray:
    """Targets at the start (12,), then yaw, pitch, roll and clock of every sensor."""
    truth = source.streams["/truth"]
    names = truth.components
    own = [
        names.index(name)
        for number in (1, 2, 3)
        for name in (*bias_components(number), f"sensor_{number}_clock_s")
    ]
    return truth["state"][0, [*range(12), *own]]


def predicted(source: MemorySource, x: np.ndarray) -> np.ndarray:
    """The angles of all messages by the model, from what is unknown."""
    found = []
    for number in range(3):
        stream = source.streams[f"/sensor{number + 1}/moving_line_of_sight"]
        since_s = (stream.publish_time_ns - source.epoch_ns) * 1e-9
        reference = (stream["target_id"], *stream["position_m"].T, *stream["quaternion"].T)
        yaw, pitch, roll, clock_s = x[12 + 4 * number :][:4]
        state = move(tuple(x[:12]), (), since_s, None)
        found.append(np.stack(sight(state, reference, (yaw, pitch, roll), clock_s), axis=1))
    return np.concatenate(found)


def test_the_model_says_what_is_recorded():
    """Poses that turn, biases, targets in turn, and clocks that are ahead: all have the same sense."""
    source = recorded(**MANOEUVRE)
    streams = [source.streams[f"/sensor{number}/moving_line_of_sight"] for number in (1, 2, 3)]
    angles = np.concatenate([np.stack([s["azimuth_rad"], s["elevation_rad"]], axis=1) for s in streams])
    x = unknowns(source)
    assert predicted(source, x) == pytest.approx(angles, abs=1e-10)
    assert np.abs(x[[19, 23]]).min() > 0.01
    x[19] = -x[19]
    assert np.abs(predicted(source, x) - angles).max() > 1e-4


def spectrum(source: MemorySource) -> tuple[np.ndarray, np.ndarray]:
    """Singular values and right vectors, by differences; the first clock is right, and left out."""
    x = unknowns(source)
    scale = np.array([*[500.0] * 3, *[20.0] * 3, *[500.0] * 3, *[20.0] * 3, *([5e-3] * 3 + [0.1]) * 3])
    free = np.delete(np.arange(24), 15)
    columns = []
    for column in free:
        step = np.zeros(24)
        step[column] = 1e-3 * scale[column]
        columns.append((predicted(source, x + step) - predicted(source, x - step)).ravel() / 2e-3)
    _, values, vectors = np.linalg.svd(np.stack(columns, axis=1))
    return values, vectors


def test_who_flies_straight_side_by_side_cannot_tell_the_roll_that_all_have():
    """The scene may turn about the line between the sensors; a manoeuvre or one beside it tells."""
    straight = recorded(bias_sigma_rad=0.0)
    values, vectors = spectrum(straight)
    rolls = vectors[-1][[14, 17, 21]]
    assert values[-1] < 1e-4 * values[-2]
    assert np.abs(rolls).min() > 0.1
    assert rolls == pytest.approx(np.repeat(rolls.mean(), 3), rel=1e-3)
    assert np.abs(vectors[-1][[12, 13, 15, 16, 18, 19, 20, 22]]).max() < 0.01
    beside = [*SIDE_BY_SIDE[:2], (10e3, 5e3, -15e3)]
    for telling in (MANOEUVRE, {"sensor_position_m": beside}):
        assert spectrum(recorded(bias_sigma_rad=0.0, **telling))[0][-1] > 100.0 * values[-1]


@pytest.mark.usefixtures("uncompiled")
def test_a_field_of_another_width_is_named():
    """The model asks for a quaternion in space."""
    source = recorded()
    topic = "/sensor2/moving_line_of_sight"
    columns = {
        name: source.streams[topic][name]
        for name in ("target_id", "azimuth_rad", "elevation_rad", "position_m", "quaternion")
    }
    wrong: Stream = make_stream(
        topic,
        schemas.MOVING_LINE_OF_SIGHT,
        source.streams[topic].publish_time_ns,
        metadata=source.streams[topic].metadata,
        **columns | {"quaternion": columns["quaternion"][:, :2]},
    )
    streams = {**source.streams, topic: wrong}
    with pytest.raises(BadInput, match="quaternion has 2 components; the model needs 4"):
        replay_in_memory([MemorySource(streams, source.run, "cut")], {"ekf": {"model": "moving-sights"}})


def test_every_sensor_says_how_it_weaves():
    with pytest.raises(BadInput, match="weave_m has 1 numbers for 3 sensors"):
        recorded(weave_m=[1.0])
