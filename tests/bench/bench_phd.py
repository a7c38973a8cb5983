"""The GM-PHD filter against Stone Soup's, on the same scans and with the same rules.

Stone Soup multiplies a detected birth by the survival probability, caps a merged weight at one, moves
the heaviest component while it merges, and spreads what is pruned: here births are given the inverse,
and its reducer is told to merge and prune as Vo and Ma, 2006, table II do, which is what ours does.
"""

from datetime import datetime, timedelta
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.recorders.recording import SIMULATION_EPOCH_NS
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.families.sets.judging.distances import gospa
from fuselog.replay.families.sets.judging.errors import CUTOFF_M, set_errors
from fuselog.replay.families.tracking.gaussian_mixture_phd import (
    PhdParameters,
    filter_scans,
    no_components,
    scans_of,
    settings_of,
)
from fuselog.replay.judging.errors.truths import Truths
from tests.replay.families.tracking.scan_scenes import FIELD_M, VARIANCE_M2, Scene, simulate, source

RUNS = 6
REPEATS = 5
PARAMETERS = PhdParameters(acceleration_sigma_mps2=0.2)
THRESHOLDS = {
    "prune_threshold": PARAMETERS.prune_weight,
    "merge_threshold": PARAMETERS.merge_squared,
    "max_number_components": PARAMETERS.most_components,
}
DETECTION, CLUTTER_PER_M2 = 0.9, 3.0 / FIELD_M**2
# A Gaussian so wide that its density is that of uniform births all over the field.
BIRTH_SIGMA_M = 1e4

Row = tuple[str, float, float, float]


class Theirs(NamedTuple):
    """Stone Soup's mean GOSPA of a scene, and its seconds per scan."""

    gospa_m: float
    seconds: float


def main() -> list[Row]:
    """Rows of (what, ours, Stone Soup's, how many times faster or the difference)."""
    scenes = [simulate(seed) for seed in range(RUNS)]
    sources = [source(scene) for scene in scenes]
    outputs = replay_in_memory(sources, {"gm-phd": PARAMETERS.model_dump(exclude_none=True)})
    [found] = set_errors(outputs, [*map(Truths, sources)]).values()
    ours_m = float(found.gospa.mean())
    ours_us = 1e6 * filter_seconds(sources)
    rows = []
    for rules, reducer in (
        ("rules alike", vo_ma_reducer()),
        ("its reducer as shipped", shipped_reducer()),
    ):
        theirs = [run_stone_soup(scene, reducer) for scene in scenes]
        theirs_m = float(np.mean([each.gospa_m for each in theirs]))
        theirs_us = 1e6 * median(each.seconds for each in theirs)
        rows += [
            (f"GM-PHD, us per scan; {rules}", ours_us, theirs_us, theirs_us / ours_us),
            (f"mean GOSPA in m, c = 10, difference; {rules}", ours_m, theirs_m, abs(ours_m - theirs_m)),
        ]
    return rows


def filter_seconds(sources: list) -> float:
    """Wall time per scan of our filter, over all runs, one after another."""
    names = ("/sensor/scan", "/sensor/detection")
    scans = scans_of(*(gather([each.streams[name] for each in sources]) for name in names))
    settings = settings_of(PARAMETERS, sources[0].topics[names[0]])
    mixture = no_components(len(sources), PARAMETERS.most_components)
    for run, each in enumerate(sources):
        priors = [rows for name, rows in each.streams.items() if name.endswith("/prior")]
        mixture.used[run] = len(priors)
        for component, prior in enumerate(priors):
            mixture.time_ns[run], mixture.weight[run, component] = prior.publish_time_ns[0], 1.0
            mixture.mean[run, component] = prior["mean"][0]
            mixture.covariance[run, component] = prior["covariance"][0].reshape(4, 4)
    filter_scans(mixture, scans, settings)
    times = []
    for _ in range(REPEATS):
        begin = perf_counter()
        filter_scans(mixture, scans, settings)
        times.append(perf_counter() - begin)
    return median(times) / len(scans.time_ns)


def run_stone_soup(scene: Scene, reducer: Any) -> Theirs:
    """Stone Soup's GM-PHD on a scene."""
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import TaggedWeightedGaussianState
    from stonesoup.updater.kalman import KalmanUpdater
    from stonesoup.updater.pointprocess import PHDUpdater

    transition = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
    noise = PARAMETERS.acceleration_sigma_mps2**2 * np.kron(np.eye(2), [[0.25, 0.5], [0.5, 1.0]])
    motion = LinearGaussianTimeInvariantTransitionModel(
        transition_matrix=transition, covariance_matrix=noise
    )
    sensor = LinearGaussian(ndim_state=4, mapping=(0, 2), noise_covar=VARIANCE_M2 * np.eye(2))
    kalman = KalmanUpdater(sensor)
    updater = PHDUpdater(
        kalman,
        clutter_spatial_density=CLUTTER_PER_M2,
        prob_detection=DETECTION,
        prob_survival=PARAMETERS.survival_probability,
    )
    gate = np.sqrt(chi2.ppf(PARAMETERS.gate_probability, 2))
    pairs = DistanceHypothesiser(
        KalmanPredictor(motion), kalman, Mahalanobis(), missed_distance=float(gate)
    )
    hypothesiser = GaussianMixtureHypothesiser(pairs, order_by_detection=True)
    epoch = datetime.fromtimestamp(SIMULATION_EPOCH_NS // 10**9)
    covariance = np.diag([2.5, 1.0, 2.5, 1.0])

    def component(mean, spread, weight, tag, at) -> TaggedWeightedGaussianState:
        return TaggedWeightedGaussianState(
            mean.reshape(-1, 1), spread, weight=weight, tag=tag, timestamp=at
        )

    mixture = [
        component(mean, covariance, 1.0, f"{thing}", epoch) for thing, mean in enumerate(scene.states[0])
    ]
    wide = np.diag([BIRTH_SIGMA_M**2, PARAMETERS.birth_sigma_mps**2] * 2)
    weight = PARAMETERS.births_per_m2 * 2 * np.pi * BIRTH_SIGMA_M**2
    distances, spent = [], 0.0
    for step, places in enumerate(scene.scans, start=1):
        at = epoch + timedelta(seconds=step)
        seen = [
            Detection(place.reshape(-1, 1), timestamp=at, measurement_model=sensor) for place in places
        ]
        begin = perf_counter()
        birth = component(np.zeros(4), wide, weight / PARAMETERS.survival_probability, "birth", at)
        hypotheses = hypothesiser.hypothesise([*mixture, birth], seen, at, order_by_detection=True)
        mixture = list(reducer.reduce(list(updater.update(hypotheses))))
        spent += perf_counter() - begin
        found = [
            np.asarray(each.mean, float).ravel()[[0, 2]]
            for each in mixture
            if each.weight > 0.5
            for _ in range(max(1, int(np.floor(float(each.weight) + 0.5))))
        ]
        truth = scene.states[step][:, [0, 2]]
        distances.append(gospa(np.array(found).reshape(-1, 2), truth, CUTOFF_M, 2).total)
    return Theirs(float(np.mean(distances)), spent / len(scene.scans))


def vo_ma_reducer() -> Any:
    """Stone Soup's reducer with the rules of Vo and Ma: their moments, no cap, nothing spread."""
    from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
    from stonesoup.types.state import TaggedWeightedGaussianState

    class VoMaReducer(GaussianMixtureReducer):
        def prune(self, components_list):
            return [each for each in components_list if each.weight > self.prune_threshold]

        def merge(self, components_list):
            left = sorted(components_list, key=lambda each: float(each.weight), reverse=True)
            merged = []
            while left:
                seed = left[0]
                centre = np.asarray(seed.mean, float)
                close = [each is seed or squared(each, centre) <= self.merge_threshold for each in left]
                group = [each for each, near in zip(left, close, strict=True) if near]
                left = [each for each, near in zip(left, close, strict=True) if not near]
                weights = np.array([float(each.weight) for each in group])
                means = np.stack([np.asarray(each.mean, float) for each in group])
                mean = np.einsum("k,kij->ij", weights, means) / weights.sum()
                spread = sum(
                    weight * (each.covar + (own - mean) @ (own - mean).T)
                    for weight, each, own in zip(weights, group, means, strict=True)
                )
                merged.append(
                    TaggedWeightedGaussianState(
                        mean,
                        np.asarray(spread / weights.sum(), float),
                        weight=weights.sum(),
                        tag=seed.tag,
                        timestamp=seed.timestamp,
                    )
                )
            return merged

    def squared(component, centre):
        difference = np.asarray(component.mean, float) - centre
        return (difference.T @ np.linalg.solve(component.covar, difference)).item()

    return VoMaReducer(**THRESHOLDS)


def shipped_reducer() -> Any:
    """Stone Soup's reducer with our thresholds."""
    from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer

    return GaussianMixtureReducer(**THRESHOLDS)
