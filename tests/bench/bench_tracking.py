"""The JPDA tracker against Stone Soup's JPDA, on the same scans, with the same gates and tracks.

Both begin with the things' priors; none begins or ends a track. Time is of whole scans: prediction,
gates, association, update.
"""

from datetime import datetime, timedelta
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.recorders.recording import SIMULATION_EPOCH_NS
from fuselog.replay.engine.streams.blocks import Block, gather, merge_events
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.families.tracking.association.scans import Scans
from fuselog.replay.families.tracking.association.tracking import track_scans
from fuselog.replay.families.tracking.association.tracks import Tracks, no_tracks
from fuselog.replay.families.tracking.scan_sensors import KINDS
from fuselog.replay.families.tracking.scans import scans_of
from fuselog.replay.families.tracking.targets import targets_of
from fuselog.replay.families.tracking.tracker import (
    TrackerParameters,
    find_sensors,
    settings_of,
    tracker_of,
)
from tests.replay.families.tracking.scan_scenes import FIELD_M, VARIANCE_M2, Scene, simulate, source

RUNS, REPEATS = 3, 5
DETECTION, CLUTTER_PER_M2, GATE = 0.9, 3.0 / FIELD_M**2, 0.99
COVARIANCE = np.diag([2.5, 1.0, 2.5, 1.0])
PARAMETERS = TrackerParameters(
    association="jpda",
    sigma_m=VARIANCE_M2**0.5,
    gate_probability=GATE,
    birth_distance_m=1e9,
    silence_s=1e9,
    same_within_m=0.0,
)

Row = tuple[str, float, float, float]


class Tracked(NamedTuple):
    """The marginals (scans, tracks, 1 + detections) as lists, and seconds per scan."""

    marginals: list[np.ndarray]
    seconds: float


def main() -> list[Row]:
    """Rows of (what, ours, Stone Soup's, how many times faster or the largest difference)."""
    ours, theirs = [], []
    for seed in range(RUNS):
        scene = simulate(seed)
        ours.append(run_ours(scene, source(scene)))
        theirs.append(run_stone_soup(scene))
    apart = max(
        float(np.abs(one - other).max())
        for mine, its in zip(ours, theirs, strict=True)
        for one, other in zip(mine.marginals, its.marginals, strict=True)
    )
    ours_us, theirs_us = (1e6 * median(each.seconds for each in found) for found in (ours, theirs))
    return [
        ("JPDA tracker, us per scan", ours_us, theirs_us, theirs_us / ours_us),
        ("largest difference of a marginal", 0.0, 0.0, apart),
        pmbm_in_time(),
    ]


def pmbm_in_time() -> Row:
    """How long PMBM takes for a scan of 20 targets and 30 false detections, and has at 10 Hz.

    Scans are a second apart, so that gates are wider than at 10 Hz.
    """
    scene = simulate(0, things=20, scans=100, clutter=30.0)
    log = source(scene, clutter=30.0)
    settings = {"sigma_m": VARIANCE_M2**0.5, "acceleration_density": 0.04, "most_tracks": 300}
    settings |= {"undetected_per_m2": 20 / FIELD_M**2 / len(scene.scans), "same_within_m": 0.0}
    times = []
    for _ in range(1 + REPEATS):
        begin = perf_counter()
        outputs = replay_in_memory([log], {"tracker:pmbm": settings})
        times.append(perf_counter() - begin)
    assert not len(outputs["/estimates/tracker:pmbm/unused"])
    seconds = median(times[1:]) / len(scene.scans)
    return "PMBM, ms per scan and from scan to scan at 10 Hz", 1e3 * seconds, 100.0, 0.1 / seconds


def run_ours(scene: Scene, log: MemorySource) -> Tracked:
    """Our tracker on a scene."""
    found = find_sensors(log.topics, ())
    targets = targets_of("bench", PARAMETERS, [log.topics[scan] for scan in found.scans])
    settings = settings_of(log.topics, found, PARAMETERS, targets)
    streams = {topic: gather([log.streams[topic]]) for topic in (*found.scans, *found.detections)}
    scans = scans_of(Block(streams, merge_events(streams, "publish_time")), found, KINDS, {})
    tracker = tracker_of(PARAMETERS, targets, settings)
    tracks = begun(scene.states[0])
    _, said = track_scans(tracker, scans, settings.numbers, targets.newborn, tracks)
    times = []
    for _ in range(REPEATS):
        begin = perf_counter()
        track_scans(tracker, scans, settings.numbers, targets.newborn, tracks)
        times.append(perf_counter() - begin)
    return Tracked(marginals_of(scans, said, len(scene.states[0])), median(times) / len(scans.time_ns))


def begun(states: np.ndarray) -> Tracks:
    """Confirmed tracks with these states (things, 4)."""
    count = len(states)
    tracks = no_tracks(1, count, (1, 4, 4), 1, np.empty((0, 0)))
    tracks.used[:] = tracks.met[:] = count
    tracks.time_ns[:] = tracks.seen_ns[:] = SIMULATION_EPOCH_NS
    tracks.number[0] = np.arange(count)
    tracks.mean[0, :, 0], tracks.covariance[0, :, 0] = states, COVARIANCE
    tracks.existence[:], tracks.is_confirmed[:] = 1.0, True
    return tracks


def marginals_of(scans: Scans, said: list[Any], tracks: int) -> list[np.ndarray]:
    """What was said of associations, by scan, the share of none first."""
    [(_, told)] = said
    paired = int(told.end[0, 1])
    counts = scans.end - scans.first
    found = [np.zeros((tracks, 1 + count)) for count in counts]
    pairs = zip(told.pair[0, :paired], told.associated[0, :paired], strict=True)
    for (track, scan, detection), probability in pairs:
        found[scan][track, 1 + detection] = probability
    for each in found:
        each[:, 0] = 1.0 - each.sum(axis=1)
    return found


def run_stone_soup(scene: Scene) -> Tracked:
    """Stone Soup's JPDA on a scene."""
    from stonesoup.dataassociator.probability import JPDA
    from stonesoup.functions import gm_reduce_single
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import (
        CombinedLinearGaussianTransitionModel,
        ConstantVelocity,
    )
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.array import StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.types.update import GaussianStateUpdate
    from stonesoup.updater.kalman import KalmanUpdater

    density = PARAMETERS.acceleration_density
    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(density)] * 2)
    sensor = LinearGaussian(ndim_state=4, mapping=(0, 2), noise_covar=VARIANCE_M2 * np.eye(2))
    predictor, updater = KalmanPredictor(motion), KalmanUpdater(sensor)
    hypothesiser = PDAHypothesiser(predictor, updater, CLUTTER_PER_M2, DETECTION, GATE)
    associator = JPDA(hypothesiser=hypothesiser)
    epoch = datetime.fromtimestamp(SIMULATION_EPOCH_NS // 10**9)
    tracks = [Track([GaussianState(mean[:, None], COVARIANCE, epoch)]) for mean in scene.states[0]]
    marginals, spent = [], 0.0
    for step, places in enumerate(scene.scans, start=1):
        at = epoch + timedelta(seconds=step)
        seen = [Detection(place[:, None], timestamp=at, measurement_model=sensor) for place in places]
        number = {id(each): index for index, each in enumerate(seen)}
        found = np.zeros((len(tracks), 1 + len(seen)))
        begin = perf_counter()
        associated = associator.associate(set(tracks), set(seen), at)
        for row, track in enumerate(tracks):
            hypotheses = associated[track]
            states, weights = [], []
            for hypothesis in hypotheses:
                state = updater.update(hypothesis) if hypothesis else hypothesis.prediction
                states.append(state)
                weights.append(float(hypothesis.probability))
                column = 1 + number[id(hypothesis.measurement)] if hypothesis else 0
                found[row, column] = weights[-1]
            mean, covariance = gm_reduce_single(
                StateVectors([each.state_vector for each in states]),
                np.stack([each.covar for each in states], axis=2),
                np.array(weights),
            )
            track.append(GaussianStateUpdate(mean, covariance, hypotheses, at))
        spent += perf_counter() - begin
        marginals.append(found)
    return Tracked(marginals, spent / len(scene.scans))
