"""The bootstrap particle filter beside Stone Soup's, on the same log, with as many particles.

A vehicle in the plane with fixes of its position: a motion and a sensor that Stone Soup has itself, in
NumPy over all particles. Both resample systematically below half of the effective number, and give mean
and covariance after every fix. Run it with `make bench`, or `python -m tests.bench particles`.
"""

from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import ESSResampler
from stonesoup.types.array import StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import ParticleState
from stonesoup.updater.particle import ParticleUpdater

from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.recorders.families.vehicles.models import noise_moments, turn
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource
from tests.bench.timing import cpu_seconds

Floats = NDArray[np.float64]
Row = tuple[str, str, str, str]
PARTICLES = 2000
WANTED = 10.0  # times as fast
ACCELERATION_MPS2, TURN_RADPS = 0.5, 0.05


def main() -> list[Row]:
    """Microseconds per fix; both have to come as near to the Kalman filter as their number allows."""
    motion = {"turn_rate_radps": [TURN_RADPS], "vehicles": 1, "duration_s": 1000.0}
    source = record_ensemble("vehicles", motion, 1, 1)[0]
    exact = means_of(source, "vehicle-kalman")
    for found in (means_of(source, f"particles:{PARTICLES}"), stone_soup(source)):
        assert np.sqrt(np.mean((found - exact) ** 2)) < 0.1
    ways = {
        "ours": lambda: means_of(source, f"particles:{PARTICLES}"),
        "theirs": lambda: stone_soup(source),
    }
    us = {name: 1e6 * s / len(exact) for name, s in cpu_seconds(ways).items()}
    ratio = us["theirs"] / us["ours"]
    what = f"particles:{PARTICLES}, per fix; Stone Soup, at least {WANTED:g} times"
    return [(what, f"{us['ours']:.3g} us", f"{us['theirs']:.3g} us", f"{ratio:.1f} times")]


def means_of(source: MemorySource, estimator: str) -> Floats:
    """Means (fixes, 4) of a replay, all that is around the loop included."""
    settings = {} if estimator == "vehicle-kalman" else {"model": "vehicle"}
    [states] = [
        rows
        for topic, rows in collect(replay([source], bind(estimator, [source], settings))).items()
        if topic.endswith("/state")
    ]
    return states["mean"]


def stone_soup(source: MemorySource) -> Floats:
    """Means (fixes, 4) of Stone Soup's."""
    np.random.seed(1)  # noqa: NPY002 - it draws from NumPy's global generator
    place, mixed, velocity = noise_moments(ACCELERATION_MPS2, 1.0)
    motion = LinearGaussianTimeInvariantTransitionModel(
        transition_matrix=np.stack(turn(np.eye(4), TURN_RADPS, 1.0)),
        covariance_matrix=np.kron(np.eye(2), [[place, mixed], [mixed, velocity]]),
    )
    sensor = LinearGaussian(ndim_state=4, mapping=(0, 2), noise_covar=0.5 * np.eye(2))
    predictor, updater = ParticlePredictor(motion), ParticleUpdater(sensor, ESSResampler())
    prior, epoch = source.streams["/vehicle1/prior"], datetime.fromtimestamp(0)
    covariance = prior["covariance"][0].reshape(4, 4)
    drawn = np.random.default_rng(1).multivariate_normal(prior["mean"][0], covariance, PARTICLES)
    weight = np.full(PARTICLES, 1 / PARTICLES)
    state = ParticleState(StateVectors(drawn.T), weight=weight, timestamp=epoch)
    means = []
    for step, fix in enumerate(source.streams["/vehicle1/fix"]["position_m"], start=1):
        at = epoch + timedelta(seconds=step)
        seen = Detection(fix[:, None], timestamp=at, measurement_model=sensor)
        state = updater.update(SingleHypothesis(predictor.predict(state, timestamp=at), seen))
        means.append(np.asarray(state.mean, float).ravel())
        assert np.isfinite(state.covar).all()
    return np.array(means)
