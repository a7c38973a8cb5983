"""Cases of lines of sight: one scenario under one condition, with all schemes and bounds."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting
from fuselog.pipeline.runs.inputs import Record, load_scenario
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.studies.toolkit.repetitions import (
    Floats,
    by_repetition,
    errors_named,
    root_mean_square,
)
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.los.models import ANGLES
from fuselog.recorders.families.los.simulator import OpticalParameters
from fuselog.recorders.parameters import Parameters, build, merge
from fuselog.replay.engine.replaying.estimator import configure
from fuselog.replay.engine.vectors.covariances import normalized_error_squared
from fuselog.replay.estimators.localization.least_squares import cramer_rao_bound
from fuselog.replay.families.los import localization as optical
from fuselog.replay.families.los.estimators import known_biases
from fuselog.replay.families.los.localization import Observability, Scene
from fuselog.replay.judging.consistency.consistency import component_error_squared, dilution_of_precision

ALONE, BLIND, JOINT = "scheme-1", "scheme-2", "scheme-3"


class Condition(Parameters):
    """Biases and noise of a condition.

    Attributes:
        bias_deg: magnitude of the biases, by which the biases of 1 deg in the scenario files are
            multiplied.
        sigma_rad: standard deviation of azimuth and elevation.
    """

    bias_deg: float
    sigma_rad: PositiveFloat


class Printed(Parameters):
    """Results printed in the paper; rows are scenarios, columns targets or biases.

    Attributes:
        table_of_sensors: number of the table of the sensors' positions.
        table_of_positions: number of the table of position errors.
        table_of_biases: number of the table of biases' errors.
        table_of_means: number of the table of biases' mean errors.
        position_scenario: number of the scenario whose position errors are printed, from 1.
        runs: number of runs that the paper averages over.
        sensor_position_m: positions of the sensors (x, y, z), by scenario.
        position_rmse_m: RMSE of the targets' positions, by scheme.
        bias_rmse_mrad: RMSE of the biases.
        bias_sigma_mrad: bounds of the biases' standard deviations.
        bias_mean_mrad: mean errors of the biases.
    """

    table_of_sensors: str
    table_of_positions: str
    table_of_biases: str
    table_of_means: str
    position_scenario: int = 1
    runs: int = 100
    sensor_position_m: list[list[tuple[float, float, float]]]
    position_rmse_m: dict[str, list[float]]
    bias_rmse_mrad: list[list[float]]
    bias_sigma_mrad: list[list[float]]
    bias_mean_mrad: list[list[float]]


class LosOptions(Parameters):
    """The scenarios, the conditions, and the results in the paper.

    Attributes:
        scenarios: scenario files, in the paper's order.
        conditions: biases and noise, by the name of a condition; the first is the paper's.
        paper: the paper's printed results.
    """

    scenarios: list[str]
    conditions: Annotated[dict[str, Condition], Field(min_length=1)]
    paper: Printed

    @model_validator(mode="after")
    def _are_the_papers(self) -> Self:
        if len(self.scenarios) != len(self.paper.sensor_position_m):
            raise ValueError(
                f"scenarios must be the {len(self.paper.sensor_position_m)} of the paper, in its order"
            )
        return self


@dataclass(frozen=True)
class Case:
    """One scenario under one condition.

    Attributes:
        number: number of the scenario, from 1.
        scene, truth, bound: known scene, true parameters (n,) and CRLB (n, n) of scheme 3.
        error: errors (repetitions, runs, parameters) by scheme.
        nees, nees_at_estimate: NEES of scheme 3, (repetitions, runs).
        iterations, converged: largest number of iterations and share that converged, by scheme.
    """

    number: int
    condition: str
    parameters: OpticalParameters
    scene: Scene
    truth: Floats
    bound: Floats
    error: Mapping[str, Floats]
    nees: Floats
    nees_at_estimate: Floats
    iterations: Mapping[str, int]
    converged: Mapping[str, float]
    input_sha256: str = ""

    @property
    def targets(self) -> int:
        """Return the number of targets."""
        return len(self.parameters.target_position_m)

    @property
    def sigma_mrad(self) -> Floats:
        """Return the CRLB standard deviations of the biases."""
        return 1e3 * np.sqrt(np.diagonal(self.bound))[3 * self.targets :]

    @property
    def bias_error_mrad(self) -> Floats:
        """Return the errors of the biases (repetitions, runs, biases)."""
        return 1e3 * self.error[JOINT][..., 3 * self.targets :]

    @property
    def component_nees(self) -> Floats:
        """Return the mean normalized squared error of each bias, (biases,)."""
        squared = component_error_squared(self.error[JOINT], self.bound)
        return np.nanmean(squared, axis=(0, 1))[3 * self.targets :]

    def position_error_m(self, scheme: str) -> Floats:
        """Compute distances between estimated and true targets, (repetitions, runs, targets)."""
        error = self.error[scheme][..., : 3 * self.targets]
        return np.linalg.norm(error.reshape(*error.shape[:2], self.targets, 3), axis=-1)

    def position_rmse_m(self, scheme: str) -> Floats:
        """Compute the RMSE of each target over all repetitions."""
        return root_mean_square(self.position_error_m(scheme), (0, 1))

    def dilution(self) -> Floats:
        """Compute GDOP (targets, sensors), eq (32)."""
        offset = np.array(self.parameters.target_position_m)[:, None] - self.scene.position_m
        error_m = self.position_rmse_m(ALONE)[:, None]
        return dilution_of_precision(error_m, np.linalg.norm(offset, axis=2), self.scene.sigma_rad)

    def observability(self, scene: Scene | None = None, targets: Floats | None = None) -> Observability:
        """Analyse the observability of scheme 3; `scene` and `targets` (n, 3) replace the case's own."""
        scene = scene or self.scene
        places = np.array(self.parameters.target_position_m) if targets is None else targets
        bias = self.parameters.bias_rad.ravel()[scene.wanted]
        truth = np.concatenate([places.ravel(), bias])
        return optical.observability(scene, optical.predict(scene, truth[None])[0], truth)


def run_case(experiment: Experiment, setting: Setting, number: int, name: str, condition: str) -> Case:
    """Record a scenario with and without its biases, replay all schemes, and compute their bounds."""
    options: LosOptions = setting.options
    chosen = options.conditions[condition]
    recorder, values, _ = load_scenario(name)
    sensors = len(options.paper.sensor_position_m[number - 1])
    if recorder != "optical-los" or len(values.get("bias_deg", [])) != sensors:
        raise BadInput(
            f"scenario {name} is not an optical-los scenario with bias_deg for {sensors} sensors; give "
            "such a scenario"
        )
    bias_deg = (chosen.bias_deg * np.array(values["bias_deg"])).tolist()
    values = merge(values, {"sigma_rad": chosen.sigma_rad, "bias_deg": bias_deg})
    values = merge(values, experiment.record.parameters if experiment.record else {})
    parameters = build(OpticalParameters, values, f"scenario {name}")

    runner = Runner(experiment.model_copy(update={"record": Record(scenario=name)}), setting)

    def replayed(over: Mapping[str, Any], *schemes: str) -> Replayed:
        seed = experiment.seed + number - 1  # scenarios have different noise
        sources = runner.obtain(merge(values, over), seed=seed)
        return runner.replay(sources, {scheme: experiment.estimators[scheme] for scheme in schemes})

    free, biased = replayed({"bias_deg": None}, ALONE), replayed({}, BLIND, JOINT)
    if condition == next(iter(options.conditions)):
        place = f"scenario-{number}"
        runner.keep(biased.sources, biased.outputs, place, drawn="" if number == 1 else None)
    case = _judged(experiment, number, condition, parameters, free, biased)
    return replace(case, input_sha256=hash_streams(biased.sources))


def _judged(
    experiment: Experiment,
    number: int,
    condition: str,
    parameters: OpticalParameters,
    free: Replayed,
    biased: Replayed,
) -> Case:
    """Evaluate a replayed case and compute its bounds."""
    scene = scene_of(parameters, configure(JOINT, experiment.estimators[JOINT])[1])
    bias = parameters.bias_rad.ravel()[scene.wanted]
    truth = np.concatenate([np.ravel(parameters.target_position_m), bias])
    at_truth = optical.linearize(scene, optical.predict(scene, truth[None]), truth[None])
    bound = cramer_rao_bound(at_truth).covariance[0]
    replays = {ALONE: free, BLIND: biased, JOINT: biased}
    found = {scheme: errors_named(replay, scheme) for scheme, replay in replays.items()}
    error = {
        scheme: by_repetition(errors, errors.error, experiment.runs) for scheme, errors in found.items()
    }
    ends = {s: replay.outputs[f"/estimates/{s}/solution"] for s, replay in replays.items()}
    return Case(
        number,
        condition,
        parameters,
        scene,
        truth,
        bound,
        error,
        normalized_error_squared(error[JOINT], bound),
        by_repetition(found[JOINT], found[JOINT].nees, experiment.runs),
        {s: int(end["iterations"].max()) for s, end in ends.items()},
        {s: float(end["converged"].mean()) for s, end in ends.items()},
    )


def scene_of(parameters: OpticalParameters, estimator: Parameters) -> Scene:
    """Return the known part of a scenario: sensors, attitudes, noise, known biases."""
    sensors = np.array(parameters.sensor_position_m)
    sigma = np.full((len(sensors), 2), parameters.sigma_rad)
    known = known_biases(range(1, len(sensors) + 1), estimator)
    return Scene(sensors, parameters.nominal_attitude_rad, sigma, known)


def bias_names(case: Case) -> list[str]:
    """Return the names of the estimated biases for tables."""
    names = [f"{angle}{s + 1}" for s in range(len(case.scene.position_m)) for angle in ANGLES]
    return [name for name, wanted in zip(names, case.scene.wanted, strict=True) if wanted]


def observabilities(case: Case) -> dict[str, Observability]:
    """Return the observability for variations of a case, by name of the variation."""
    wanted = case.scene._replace(known_bias_rad=np.full_like(case.scene.known_bias_rad, np.nan))
    first, last = case.scene.position_m[[0, -1]]
    share = np.linspace(0.0, 1.0, len(case.scene.position_m))[:, None]
    inline = wanted._replace(position_m=first + share * (last - first))
    targets = np.array(case.parameters.target_position_m)
    low, high = targets.min(axis=0) - 1e3, targets.max(axis=0) + 1e3
    rng = np.random.default_rng(case.number)
    varied = {
        "scheme 3": case.observability(),
        "all biases wanted": case.observability(wanted),
        "sensors in a line": case.observability(inline),
        "a target less": case.observability(wanted, targets[:-1]),
    }
    for count in (5, 10, 40):
        varied[f"{count} targets"] = case.observability(wanted, rng.uniform(low, high, (count, 3)))
    return varied


def one_bias_known(case: Case) -> Floats:
    """Compute CRLB standard deviations in mrad of all biases (columns) if one bias (row) is known."""
    scene = case.scene._replace(known_bias_rad=np.full_like(case.scene.known_bias_rad, np.nan))
    biases = case.parameters.bias_rad.ravel()
    truth = np.concatenate([np.ravel(case.parameters.target_position_m), biases])
    seen = optical.predict(scene, truth[None])[0]
    return 1e3 * optical.sigma_with_one_bias_known(scene, seen, truth)
