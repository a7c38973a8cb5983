"""The vehicles' Kalman filter over an ensemble against Stone Soup's, on the same fixes.

Ours starts from columns in memory and ends with the output streams; Stone Soup gets ready-made
detections. That the estimates are equal is asserted. CPU time, of all cores together.
"""

import time
from datetime import datetime, timedelta
from statistics import median

import numpy as np
from numpy.typing import NDArray
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater

from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.recorders.families.vehicles.models import noise_moments, turn
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource

RUNS = 200
REPEATS = 5
RATES = (-0.05, 0.05, 0.0, -0.05, 0.05)
TOLERANCE = 1e-9

Row = tuple[str, float, float, float]


def main() -> list[Row]:
    """Microseconds per fix: ours over the ensemble, Stone Soup's on the first run's vehicles."""
    runs = record_ensemble("vehicles", {"turn_rate_radps": list(RATES)}, 1, RUNS)
    theirs = np.stack([stone_soup(runs[0], number) for number in range(1, 6)])
    ours = filtered(runs)
    assert np.abs(ours - theirs).max() < TOLERANCE
    fixes = RUNS * theirs.shape[0] * theirs.shape[1]
    own_us = 1e6 * cpu_seconds(lambda: filtered(runs)) / fixes
    alone_us = 1e6 * cpu_seconds(lambda: filtered(runs[:1])) / (fixes / RUNS)
    their_us = 1e6 * cpu_seconds(lambda: stone_soup(runs[0], 1)) / theirs.shape[1]
    return [
        (f"Kalman, us per fix; {RUNS} runs of 5 vehicles", own_us, their_us, their_us / own_us),
        ("Kalman, us per fix; one run of 5 vehicles", alone_us, their_us, their_us / alone_us),
    ]


def cpu_seconds(work) -> float:
    """The median of some repeats."""
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return median(times)


def filtered(runs: list[MemorySource]) -> NDArray[np.float64]:
    """Replay all runs; the first one's means (vehicles, fixes, 4)."""
    outputs = collect(replay(runs, bind("vehicle-kalman", runs, {})))
    states = [outputs[f"/estimates/vehicle-kalman/vehicle{n}/state"] for n in range(1, 6)]
    return np.stack([each.of_run(0)["mean"] for each in states])


def stone_soup(source: MemorySource, number: int) -> NDArray[np.float64]:
    """Means (fixes, 4) of one vehicle."""
    position, cross, velocity = noise_moments(0.5, 1.0)
    motion = LinearGaussianTimeInvariantTransitionModel(
        transition_matrix=np.stack(turn(np.eye(4), RATES[number - 1], 1.0)),
        covariance_matrix=np.kron(np.eye(2), [[position, cross], [cross, velocity]]),
    )
    sensor = LinearGaussian(ndim_state=4, mapping=(0, 2), noise_covar=0.5 * np.eye(2))
    predictor, updater = KalmanPredictor(motion), KalmanUpdater(sensor)
    prior = source.streams[f"/vehicle{number}/prior"]
    epoch = datetime.fromtimestamp(0)
    state = GaussianState(
        prior["mean"][0][:, None], prior["covariance"][0].reshape(4, 4), timestamp=epoch
    )
    means = []
    for step, fix in enumerate(source.streams[f"/vehicle{number}/fix"]["position_m"], start=1):
        at = epoch + timedelta(seconds=step)
        seen = Detection(fix[:, None], timestamp=at, measurement_model=sensor)
        predicted = predictor.predict(state, timestamp=at)
        state = updater.update(SingleHypothesis(predicted, seen))
        means.append(np.asarray(state.mean, float).ravel())
    return np.array(means)
