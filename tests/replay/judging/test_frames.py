"""Frames: every stream of positions is linked to the truths' frame, and no metric spans two frames."""

from dataclasses import replace

import numpy as np
import pytest

from fuselog.pipeline.logs.foxglove import mirrors
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Stream, schemas
from fuselog.recorders.log.planes import FRAME, WORLD, frame_of
from fuselog.recorders.models.planar import into_frame
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording, Simulator, record_run
from fuselog.recorders.registry import available, load
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.tracking.judging.errors import target_topics
from fuselog.replay.judging.errors.frames import pose_topic, seen_in
from fuselog.replay.judging.errors.truths import Truths
from fuselog.replay.judging.judge import Judge

SCENARIOS = {
    name for name in available("recorders") if isinstance(load("recorders", name, object), Simulator)
} - {"biometric-scores"}
MAST = (30.0, -20.0, 2.2)


def recorded(scenario: str, **values: object) -> list[Stream]:
    fields = load("recorders", scenario, Simulator).parameters.model_fields
    if "duration_s" in fields:
        values = {"duration_s": 20.0 if scenario == "navigation" else 4.0, **values}
    return record_run(scenario, values, seed=7)[0].streams


def run_of(streams: list[Stream]) -> MemorySource:
    return memory_source(Recording(streams), RunMetadata("test", epoch_ns=SIMULATION_EPOCH_NS))


@pytest.mark.parametrize("scenario", sorted(SCENARIOS))
def test_every_position_of_every_scenario_is_in_a_frame_that_is_linked_to_the_truths(
    scenario: str,
) -> None:
    streams = recorded(scenario)
    source = run_of(streams)
    for stream in streams:
        if stream.schema is schemas.BODY_POINT:
            assert frame_of(stream.metadata)  # of a body, never of the world
        if "position_m" in stream.columns and (frame := frame_of(stream.metadata)):
            assert pose_topic(source.topics, frame, ""), f"{stream.topic}: {frame}"
        if stream.schema is schemas.DETECTION:
            sigma_m = {"vehicles": 0.7, "crossing": 10.0}[scenario]
            assert of_detected(source, stream, 4.0 * sigma_m) > 0.8, stream.topic
    framed, linked = set(), {WORLD}
    for stream in streams:
        for made in mirrors(stream):
            parts = [*getattr(made.message, "entities", ()), *getattr(made.message, "transforms", ())]
            for part in parts or [made.message]:
                is_link = hasattr(part, "parent_frame_id")
                framed.add(part.parent_frame_id if is_link else part.frame_id)
                linked |= {part.child_frame_id} if is_link else set()
    assert framed <= linked


def of_detected(source: MemorySource, detected: Stream, limit_m: float) -> float:
    """The share of true targets at the stamps of scans that have a detection so near."""
    truths, near = Truths(source), []
    for topic in target_topics(source.topics):
        truth = source.read([topic])[topic]
        place = [truth.components.index(name) for name in ("x_m", "y_m")]
        time_ns = detected.publish_time_ns
        row = np.searchsorted(truth.publish_time_ns, time_ns).clip(0, len(truth) - 1)
        seen = seen_in(
            frame_of(detected.metadata), truths, topic, truth["state"][row][:, place], time_ns, 2.0
        )
        away = np.hypot(*(detected["position_m"][:, :2] - seen).T)
        near += [away[time_ns == stamp].min() < limit_m for stamp in np.unique(time_ns)]
    return float(np.mean(near))


def seen_from_mast(streams: list[Stream], *, is_linked: bool) -> list[Stream]:
    """The network's scans as a turned mast has them, which states its frame, and maybe its pose."""
    made = []
    for stream in streams:
        if stream.topic == "/network/detection":
            place = np.stack(into_frame(MAST, tuple(stream["position_m"].T)), axis=1)
            stated = {**stream.metadata, FRAME: "mast"}
            stream = replace(stream, columns={**stream.columns, "position_m": place}, metadata=stated)
        if stream.topic == "/infrastructure/truth" and is_linked:
            once = replace(stream.take(slice(0, 1)), topic="/mast/truth")
            made.append(replace(once, columns={**once.columns, "state": np.array([MAST])}))
        made.append(stream)
    return made


ESTIMATORS = {
    "gm-phd": {"sensor": "network"},
    "tracker:jipda": {
        "sensors": ["network"],
        "sigma_m": 0.7,
        "clutter_per_m2": 1e-6,
        "birth_distance_m": 0.0,
        "detection_probability": 0.98,
    },
}


def judged(streams: list[Stream], label: str) -> Judge:
    source = run_of(streams)
    outputs = collect(replay([source], bind(label, [source], ESTIMATORS[label])))
    judge = Judge([source], gap_limit_s=2.0)
    judge.add(outputs)
    return judge


@pytest.mark.parametrize("label", ESTIMATORS)
def test_sets_and_tracks_in_a_turned_frame_are_judged_there_or_not_at_all(label: str) -> None:
    streams = [each for each in recorded("vehicles", duration_s=40.0) if "/prior" not in each.topic]
    plain = judged(streams, label).metrics
    assert max(plain[key] for key in plain if "gospa_m" in key) < 10.0
    turned = judged(seen_from_mast(streams, is_linked=True), label)
    assert turned.metrics == pytest.approx(plain, rel=1e-6, abs=1e-9)
    assert turned.components_without_truth == []
    unknown = judged(seen_from_mast(streams, is_linked=False), label)
    assert not [key for key in unknown.metrics if "gospa" in key or "followed" in key]
    [sentence] = unknown.components_without_truth
    assert "not judged: they are in frame mast" in sentence
    assert "child_frame_id = mast" in sentence


def test_a_tracker_takes_no_sensors_of_two_frames() -> None:
    source = run_of(recorded("vehicles"))
    with pytest.raises(
        BadInput, match="is in frame infrastructure, but /network/detection is in the plane"
    ):
        bind("tracker:jipda", [source], {"sigma_m": 0.7, "clutter_per_m2": 1e-6})
