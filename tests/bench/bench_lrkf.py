"""One step of the UKF and of the S2KF with 50 samples beside peers and beside C, in one run.

The batch reactor: a sampled prediction and a linear update. Ours starts from columns in memory and ends
with the output streams, everything included; the peers get ready-made arrays, samples of ours, and the
same linear update in NumPy. Stone Soup takes no samples of one's own. All estimates agree to 1e-6. Needs
the extra `bench`, and a C compiler. Run it with `make bench`, or `python -m tests.bench lrkf`.
"""

import time
from collections.abc import Callable
from datetime import datetime, timedelta
from types import SimpleNamespace

import numpy as np
from filterpy.kalman import UnscentedKalmanFilter
from pyrecest.distributions import GaussianDistribution
from pyrecest.filters import UnscentedKalmanFilter as PyRecEstFilter
from stonesoup.base import Property
from stonesoup.models.base import GaussianModel
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.base import TransitionModel
from stonesoup.predictor.kalman import UnscentedKalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater

from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.recorders.families.sampling.reactor import react
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.inference.sampling import Samples, parse_sampling
from tests.bench.reference.reactor import compiled_c

STEP_S, PROCESS, PRESSURE = 0.1, 1e-5, 0.1
H = np.array([[1.0, 1.0]])
MEAN, COVARIANCE = np.array([0.5, 3.5]), 10 * np.eye(2)
STEPS = 2000
TOLERANCE = 1e-6


def main() -> list[tuple[str, str, str, str]]:
    """Rows of what was measured: our microseconds per step, theirs, and how many times ours that is."""
    (log,) = record_ensemble("batch-reactor", {"steps": STEPS}, 1, 1)
    many = record_ensemble("batch-reactor", {}, 1, 1000)
    read = log.streams["/pressure"]["value"][:, 0]
    rows = []
    for name in ("ukf", "s2kf-50"):
        samples = parse_sampling(name).at(2).draw(np.random.default_rng(), ())
        peers = {"FilterPy": filterpy, "PyRecEst": pyrecest, "C, gcc -O3": c}
        if name == "ukf":
            peers["Stone Soup"] = stonesoup
        mine, wanted = timed(lambda name=name: ours(name, [log]), STEPS)
        together, _ = timed(lambda name=name: ours(name, many), 1000 * 50)
        for peer, run in peers.items():
            theirs, found = timed(lambda run=run, samples=samples: run(read, samples), STEPS)
            apart = np.max(np.abs(found - wanted))
            assert apart < TOLERANCE, f"{peer}'s {name} and ours are {apart} apart"
            rows.append(row(f"{name}, one log; {peer}", mine, theirs))
            rows.append(row(f"{name}, 1000 runs; {peer}, one", together, theirs))
    return rows


def row(name: str, mine: float, theirs: float) -> tuple[str, str, str, str]:
    return name, f"{mine:.3g} us", f"{theirs:.3g} us", f"{theirs / mine:.2g}"


def timed(action: Callable[[], np.ndarray], steps: int, repeats: int = 5) -> tuple[float, np.ndarray]:
    """The least microseconds per step, and the result; the first call compiles."""
    result, taken = action(), []
    for _ in range(repeats):
        begin = time.perf_counter()
        action()
        taken.append(time.perf_counter() - begin)
    return min(taken) / steps * 1e6, result


def ours(name: str, sources: list) -> np.ndarray:
    estimator = f"lrkf:{name}"
    outputs = collect(replay(sources, bind(estimator, sources, {})))
    return outputs[f"/estimates/{estimator}/state"]["mean"]


def moved(state: np.ndarray, _: float) -> np.ndarray:
    return np.array(react(state, STEP_S))


def linear_update(mean: np.ndarray, covariance: np.ndarray, read: float) -> tuple:
    gain = covariance @ H.T / (H @ covariance @ H.T + PRESSURE)
    return mean + gain[:, 0] * (read - mean.sum()), covariance - gain @ H @ covariance


def sigma_points(samples: Samples) -> SimpleNamespace:
    """Our samples, as FilterPy and what PyRecEst is built on take them."""
    points, weights = samples
    return SimpleNamespace(
        num_sigmas=lambda: len(weights),
        sigma_points=lambda mean, covariance: mean + points @ np.linalg.cholesky(covariance).T,
        Wm=weights,
        Wc=weights,
        n=2,
    )


def filterpy(read: np.ndarray, samples: Samples) -> np.ndarray:
    ukf = UnscentedKalmanFilter(2, 1, STEP_S, None, moved, sigma_points(samples))
    ukf.x, ukf.P, ukf.Q = MEAN.copy(), COVARIANCE.copy(), PROCESS * np.eye(2)
    found = []
    for each in read:
        ukf.predict()
        ukf.x, ukf.P = linear_update(ukf.x, ukf.P, each)
        found.append(ukf.x)
    return np.array(found)


def pyrecest(read: np.ndarray, samples: Samples) -> np.ndarray:
    start = GaussianDistribution(MEAN, COVARIANCE)
    ukf = PyRecEstFilter(start, STEP_S, moved, points=sigma_points(samples), dim_z=1)
    inner, found = ukf._filter_state, []
    for each in read:
        ukf.predict_nonlinear(moved, PROCESS * np.eye(2), STEP_S)
        inner.x, inner.P = linear_update(inner.x, inner.P, each)
        found.append(inner.x)
    return np.array(found)


class Reaction(TransitionModel, GaussianModel):
    """The reactor in Stone Soup's terms."""

    ndim_state: int = Property(default=2)

    def covar(self, **_):
        """Of the noise."""
        return PROCESS * np.eye(2)

    def function(self, state, noise=False, **_):
        """One step; Stone Soup asks for one without noise."""
        del noise
        return np.array(react(state.state_vector, STEP_S)).reshape(2, -1).view(type(state.state_vector))


def stonesoup(read: np.ndarray, _: Samples) -> np.ndarray:
    predictor = UnscentedKalmanPredictor(Reaction(), alpha=1.0, beta=0.0, kappa=0.5)
    model = LinearGaussian(2, [0], np.array([[PRESSURE]]))
    model.matrix = lambda **_: H
    updater = KalmanUpdater(model)
    at, found = datetime(2026, 1, 1), []
    state = GaussianState(MEAN[:, None], COVARIANCE, timestamp=at)
    for each in read:
        at += timedelta(seconds=STEP_S)
        prediction = predictor.predict(state, timestamp=at)
        detection = Detection(np.array([[each]]), timestamp=at, measurement_model=model)
        state = updater.update(SingleHypothesis(prediction, detection))
        found.append(np.asarray(state.state_vector, float)[:, 0])
    return np.array(found)


def c(read: np.ndarray, samples: Samples) -> np.ndarray:
    """A loop written for this one system, as fast as a C compiler makes it."""
    return compiled_c()(read, *map(np.array, samples), np.array([0, len(read)]))


if __name__ == "__main__":
    for each in main():
        print("{:36} {:>10} {:>10} {:>8}".format(*each))
