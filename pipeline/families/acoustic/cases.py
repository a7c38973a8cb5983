"""Cases of shooter localization: one scenario at one noise level, with all modes and bounds."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting
from fuselog.pipeline.runs.inputs import Record, load_scenario
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.studies.toolkit.repetitions import (
    Floats,
    by_repetition,
    errors_named,
    root_mean_square,
)
from fuselog.recorders.families.acoustic.models import (
    local_estimate_covariances,
    range_from_time_difference,
)
from fuselog.recorders.families.acoustic.simulator import AcousticParameters
from fuselog.recorders.parameters import Parameters, build, merge
from fuselog.replay.engine.replaying.estimator import configure
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.engine.vectors.covariances import normalized_error_squared
from fuselog.replay.families.acoustic import localization as acoustic
from fuselog.replay.families.acoustic.estimator import ShooterParameters, gather_detections
from fuselog.replay.families.acoustic.localization import Detections
from fuselog.replay.judging.consistency.consistency import ellipse_area

BEARINGS, LOCAL, NATIVE = "bearings-only", "local-estimates", "native-measurements"
CROSS = "cross-covariances"
FAR_M = 50.0

Place = tuple[float, float]


class Maps(Parameters):
    """The estimators and the grid for the maps in figures 22 and 23.

    Attributes:
        scenario: scenario with the sensors.
        aims: aim point (x, y), in m, by the label of an estimator.
        low_m: smallest x and y of the grid of shooter positions.
        high_m: largest x and y of the grid of shooter positions.
        step_m: spacing of the grid.
    """

    scenario: str
    aims: dict[str, Place]
    low_m: Place
    high_m: Place
    step_m: PositiveFloat


class AcousticOptions(Parameters):
    """The paper's scenarios, noise levels and maps.

    Attributes:
        scenarios: the paper's three scenarios, as files.
        multipliers: multiples of the angular noise.
        modes: estimators that run at all multiples; the others run only at 1 and the last multiple.
        maps: maps of figures 22 and 23.
    """

    scenarios: Annotated[list[str], Field(min_length=3, max_length=3)]
    multipliers: Annotated[list[PositiveFloat], Field(min_length=1)]
    modes: list[str]
    maps: Maps

    @model_validator(mode="after")
    def _has_what_claims_need(self) -> Self:
        if 1.0 not in self.multipliers:
            raise ValueError("multipliers must contain 1, the paper's noise")
        if not {BEARINGS, LOCAL, NATIVE} <= set(self.modes):
            raise ValueError(f"modes must contain {BEARINGS}, {LOCAL} and {NATIVE}")
        return self


@dataclass(frozen=True)
class Mode:
    """Results of one estimator in a case.

    Attributes:
        components: names of the n parameters.
        bound: CRLB (n, n) at the true parameters.
        error: errors (repetitions, shots of a repetition, n).
        nees: NEES of the shooter's position, (repetitions, shots of a repetition).
        converged: share of solutions that converged.
    """

    components: list[str]
    bound: Floats
    error: Floats
    nees: Floats
    converged: float

    @property
    def bound_m(self) -> float:
        """Return the square root of the trace of the position's CRLB."""
        return float(np.sqrt(np.trace(self.bound[:2, :2])))

    @property
    def rmse_m(self) -> float:
        """Return the RMSE of the position."""
        return float(np.sqrt(np.nanmean(self.distance_m**2)))

    @property
    def distance_m(self) -> Floats:
        """Return the distances of estimates from the truth, (repetitions, shots of a repetition)."""
        return np.linalg.norm(self.error[..., :2], axis=-1)

    @property
    def mean_nees(self) -> float:
        """Return the mean NEES over all solutions."""
        return float(np.nanmean(self.nees))

    @property
    def covariance(self) -> Floats:
        """Return the covariance of the estimated positions, (2, 2)."""
        error = self.error[..., :2].reshape(-1, 2)
        return np.cov(error[np.isfinite(error).all(axis=1)].T)

    @property
    def area_m2(self) -> float:
        """Return the area of the 95 % ellipse of the CRLB."""
        return float(ellipse_area(self.bound[:2, :2]))

    @property
    def area_ratio(self) -> float:
        """Return the area of the estimates' 95 % ellipse divided by that of the CRLB."""
        return float(ellipse_area(self.covariance)) / self.area_m2

    @property
    def far_per_1000(self) -> float:
        """Return the number of missing or distant (over 50 m) solutions per thousand."""
        return 1000.0 * float(np.mean(~(self.distance_m <= FAR_M)))

    @property
    def rmse(self) -> Floats:
        """Return the RMSE of every parameter."""
        return root_mean_square(self.error, (0, 1))


@dataclass(frozen=True)
class Case:
    """One scenario at one multiple of the angular noise, and its modes by estimator label."""

    number: int
    multiplier: float
    parameters: AcousticParameters
    modes: Mapping[str, Mode]
    heard: Detections
    input_sha256: str


def run_case(experiment: Experiment, setting: Setting, number: int, multiplier: float) -> Case:
    """Record a scenario, replay the modes for this noise level, and compute their bounds."""
    options: AcousticOptions = setting.options
    name = options.scenarios[number - 1]
    stated = experiment.record.parameters if experiment.record else {}
    values = merge(load_scenario(name)[1], stated)
    for angle in ("sigma_muzzle_blast_deg", "sigma_shockwave_deg"):
        values[angle] = multiplier * values[angle]
    parameters = build(AcousticParameters, values, f"scenario {name}")
    everything = multiplier in (1.0, options.multipliers[-1])
    labels = [each for each in experiment.estimators if everything or each in options.modes]
    estimators = {label: experiment.estimators[label] for label in labels}
    runner = Runner(experiment.model_copy(update={"record": Record(scenario=name)}), setting)
    sources = runner.obtain(values, seed=experiment.seed + number - 1)
    replayed = runner.replay(sources, estimators)
    if multiplier == 1.0:
        runner.keep(sources, replayed.outputs, name, drawn="" if number == 1 else None)
    modes = {}
    for label, settings in estimators.items():
        errors = errors_named(replayed, label)
        bound = bound_of(parameters, settings, label)
        error = by_repetition(errors, errors.error, experiment.runs)
        nees = normalized_error_squared(error[..., :2], bound[:2, :2])
        solution = replayed.outputs[f"/estimates/{label}/shooter/solution"]
        converged = float((solution["converged"] != 0).mean())
        modes[label] = Mode(list(errors.components), bound, error, nees, converged)
    return Case(number, multiplier, parameters, modes, _heard(sources), hash_streams(sources))


def bound_of(parameters: AcousticParameters, settings: Mapping[str, Any], label: str) -> Floats:
    """Return the CRLB (n, n) of an estimator at the truth."""
    estimator = configure(label, settings)[1]
    assert isinstance(estimator, ShooterParameters)
    chosen = acoustic.Setting(
        estimator.mode,
        parameters.noise,
        parameters.medium,
        estimator.estimate_sensors,
        estimator.cross_covariances,
    )
    bound: Floats = acoustic.bound(chosen, *truth_of(parameters)).covariance[0]
    return bound


def truth_of(parameters: AcousticParameters) -> tuple[Floats, Floats, Floats]:
    """Return positions (m) of shooter (1, 2) and sensors (sensors, 2), and trajectory (1,) in rad."""
    return (
        np.array([parameters.shooter_position_m]),
        np.radians([parameters.trajectory_deg]),
        np.array(parameters.sensor_position_m),
    )


def _heard(sources: list[MemorySource]) -> Detections:
    """Collect the detections of all shots by all sensors."""
    numbers = range(1, len([topic for topic in sources[0].topics if topic.endswith("/detections")]) + 1)
    streams = [
        [gather([source.streams[f"/sensor{n}/{leaf}"] for source in sources]) for n in numbers]
        for leaf in ("detections", "position")
    ]
    return gather_detections(*streams)[1]


def hearing(case: Case) -> list[float]:
    """Return the numbers, from 1, of the sensors that hear the shockwave."""
    true = acoustic.noise_free(case.parameters.medium, *truth_of(case.parameters))
    return [float(sensor + 1) for sensor in np.flatnonzero(np.isfinite(true.shockwave_rad[0]))]


def range_errors_m(case: Case) -> dict[int, tuple[Floats, float]]:
    """Compute the range errors of each sensor that hears the shockwave, and sigma_r of eq (26)."""
    parameters, heard = case.parameters, case.heard
    shooter, trajectory, sensors = truth_of(parameters)
    true = acoustic.noise_free(parameters.medium, shooter, trajectory, sensors)
    found = {}
    for sensor in [int(number) - 1 for number in hearing(case)]:
        distance = float(np.linalg.norm(shooter[0] - sensors[sensor]))
        separation = heard.muzzle_blast_rad[:, sensor] - heard.shockwave_rad[:, sensor]
        delay = heard.time_difference_s[:, sensor]
        estimate = range_from_time_difference(delay, separation, parameters.medium)
        exact = true.muzzle_blast_rad[0, sensor] - true.shockwave_rad[0, sensor]
        variance, _, _ = local_estimate_covariances(distance, exact, parameters.noise, parameters.medium)
        found[sensor + 1] = (estimate - distance, float(np.sqrt(variance)))
    return found


def area_ratios(maps: Maps, label: str, aim: Place) -> tuple[Floats, Floats, Floats]:
    """Compute, on a grid of shooter positions, the bearings-only ellipse area divided by a mode's."""
    parameters = build(AcousticParameters, load_scenario(maps.scenario)[1], f"scenario {maps.scenario}")
    x, y = (
        np.arange(low, high + 0.5 * maps.step_m, maps.step_m)
        for low, high in zip(maps.low_m, maps.high_m, strict=True)
    )
    shooter = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    trajectory = np.arctan2(aim[1] - shooter[:, 1], aim[0] - shooter[:, 0])
    sensors = np.array(parameters.sensor_position_m)
    areas = [
        ellipse_area(
            acoustic.bound(
                acoustic.Setting(acoustic.Mode(mode), parameters.noise, parameters.medium),
                shooter,
                trajectory,
                sensors,
            ).covariance[:, :2, :2]
        )
        for mode in (BEARINGS, label)
    ]
    ratio: Floats = (areas[0] / areas[1]).reshape(len(y), len(x))
    return x, y, ratio
