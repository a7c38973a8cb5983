"""A scene of things with constant velocity, seen in unordered scans with misses and clutter."""

from typing import NamedTuple

import numpy as np

from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.models.states import PLANE_MOTION, state_metadata
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

FIELD_M = 200.0
VARIANCE_M2 = 0.5


class Scene(NamedTuple):
    """True states (scans + 1, things, 4), one second apart, and each scan's detections (n, 2)."""

    states: np.ndarray
    scans: list[np.ndarray]


def simulate(
    seed: int, *, things: int = 5, scans: int = 50, detection: float = 0.9, clutter: float = 3.0
) -> Scene:
    """Things start anywhere in a square field and have random accelerations."""
    rng = np.random.default_rng(seed)
    states = np.empty((scans + 1, things, 4))
    states[0, :, 0::2] = rng.uniform(-0.4 * FIELD_M, 0.4 * FIELD_M, (things, 2))
    states[0, :, 1::2] = rng.normal(size=(things, 2))
    for step in range(scans):
        force = 0.2 * rng.normal(size=(things, 2))
        states[step + 1] = states[step]
        states[step + 1, :, 0::2] += states[step, :, 1::2] + 0.5 * force
        states[step + 1, :, 1::2] += force
    seen = []
    for step in range(1, scans + 1):
        there = states[step, rng.uniform(size=things) < detection, 0::2]
        there = there + np.sqrt(VARIANCE_M2) * rng.normal(size=there.shape)
        wrong = rng.uniform(-0.5 * FIELD_M, 0.5 * FIELD_M, (rng.poisson(clutter), 2))
        seen.append(rng.permutation(np.concatenate([there, wrong])))
    return Scene(states, seen)


def source(scene: Scene, *, detection: float = 0.9, clutter: float = 3.0) -> MemorySource:
    """The scene as a log has it: scans, detections, truths and priors."""
    counts = np.array([len(each) for each in scene.scans])
    times = SIMULATION_EPOCH_NS + np.arange(len(scene.states)) * 1_000_000_000
    number = np.repeat(np.arange(len(counts)), counts)
    stated = {
        "variance_m2": repr(VARIANCE_M2),
        "detection_probability": repr(detection),
        "clutter_per_m2": repr(clutter / FIELD_M**2),
    }
    motion = state_metadata(PLANE_MOTION)
    streams = [
        make_stream(
            "/sensor/scan",
            schemas.SCAN,
            times[1:],
            metadata=stated,
            scan_id=np.arange(len(counts)),
            detections=counts,
        ),
        make_stream(
            "/sensor/detection",
            schemas.DETECTION,
            times[1:][number],
            metadata=stated,
            scan_id=number,
            position_m=np.concatenate([np.empty((0, 2)), *scene.scans]),
        ),
    ]
    for thing in range(scene.states.shape[1]):
        states = scene.states[:, thing]
        streams += [
            make_stream(
                f"/thing{thing}/truth", schemas.TRUTH_STATE, times, metadata=motion, state=states
            ),
            make_stream(
                f"/thing{thing}/prior",
                schemas.GAUSSIAN_ESTIMATE,
                times[:1],
                metadata=motion,
                mean=states[:1],
                covariance=np.diag([2.5, 1.0, 2.5, 1.0]).reshape(1, 16),
            ),
        ]
    run = RunMetadata("scan-scene", {}, 0, 0, SIMULATION_EPOCH_NS, {})
    return memory_source(Recording(streams), run)
