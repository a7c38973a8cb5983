"""Study of moving lines of sight: which biases are observable, why, and how accurately.

If sensors fly straight side by side, one direction of the state is unobservable: rotating the whole
scene and the attitudes of the sensors about the line between the sensors changes no measurement. Targets
with constant velocities then have different, but still constant, velocities. A manoeuvre, a sensor off
the line, or a known target should make this direction observable; each is a case of the study.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from pydantic import PositiveInt

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.families.los.models import (
    TARGETS,
    bias_components,
    clock_component,
    moving_target_components,
)
from fuselog.recorders.families.los.moving import MovingOpticalParameters
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.inference.observability import OBSERVABILITY
from fuselog.replay.judging.errors.evaluation import Errors
from fuselog.replay.judging.intervals import mean_interval

MODEL = "moving-sights"
ALIGNED_S, LAST_S = 10.0, 10.0


class Options(Parameters):
    """The cases, and the number of runs whose observability is computed.

    Attributes:
        cases: changes to the scenario's parameters, by the name of a case.
        observed_runs: number of runs whose observability is computed.
    """

    cases: dict[str, dict[str, Any]]
    observed_runs: PositiveInt = 5


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: Options = setting.options
    outcome = Outcome()
    sources: list[MemorySource] = []
    tables: list[pd.DataFrame] = []
    directions: list[dict[str, str]] = []
    for case, differing in options.cases.items():
        recorded = Runner(experiment, setting).obtain(differing)
        scenario = MovingOpticalParameters.model_validate(recorded[0].run.parameters)
        shared = unknowns(scenario)
        settings = {
            label: {"model": MODEL, **(values if "estimate" in values else {**shared, **values})}
            for label, values in experiment.estimators.items()
        }
        runner = Runner(experiment.model_copy(update={"estimators": settings}), setting)
        replayed = runner.replay(recorded)
        runner.keep(recorded, replayed.outputs, case, drawn=case if tables else "")
        weakest_of = weakest_directions(recorded[: options.observed_runs], shared)
        table = pd.concat([seconds_of(errors) for errors in replayed.errors]).assign(case=case)
        table = table[
            table["second"] < int(scenario.duration_s)
        ]  # later stamps come from clocks that are ahead
        outcome.tables[f"observability-{case}"] = weakest_of
        sigmas = prior_sigmas(scenario)
        direction = weakest({name: float(weakest_of[name].iloc[0]) for name in sigmas}, sigmas)
        directions.append({"case": case, "weakest_direction": direction})
        _measure(case, table, weakest_of, sigmas, outcome)
        tables.append(table)
        sources += recorded
    every = pd.concat(tables, ignore_index=True)
    outcome.input_sha256 = hash_streams(sources)
    outcome.tables |= {"seconds": every, "directions": pd.DataFrame(directions)}
    outcome.figures["bound"] = _chart(every)
    return outcome


def unknowns(parameters: MovingOpticalParameters) -> dict[str, Any]:
    """Return the unknowns besides the targets: all biases, and all clocks except the first."""
    numbers = range(1, len(parameters.sensor_position_m) + 1)
    biases = [name for number in numbers for name in bias_components(number)]
    clocks = [clock_component(number) for number in numbers[1:]]
    return {
        "estimate": biases + clocks,
        "estimate_sigma": dict.fromkeys(biases, parameters.bias_sigma_rad)
        | dict.fromkeys(clocks, parameters.clock_sigma_s),
        "estimate_drift": dict.fromkeys(biases, parameters.bias_drift),
    }


def weakest_directions(sources: list[MemorySource], shared: Mapping[str, Any]) -> pd.DataFrame:
    """Find the least observable direction of each run, and its eigenvalue relative to the prior.

    Due to rounding, the zero eigenvalue of a singular information matrix becomes positive or negative,
    with a magnitude of up to the largest eigenvalue times the machine precision. Therefore, the largest
    eigenvalue times the machine precision is the lower limit of the smallest eigenvalue.
    """
    settings = {"kind": OBSERVABILITY, "model": MODEL, **shared}
    found = replay_in_memory(sources, {"observability": settings})
    stream = found["/estimates/observability/observability"].stream
    directions = dict(zip(stream.components, stream["direction"].T, strict=True))
    eigenvalues = stream["eigenvalues"]
    least = np.maximum(eigenvalues[:, 0], np.finfo(float).eps * eigenvalues[:, -1])
    return pd.DataFrame({"least_eigenvalue": least, **directions})


def prior_sigmas(parameters: MovingOpticalParameters) -> dict[str, float]:
    """Return the prior standard deviation of every component."""
    targets = {
        name: parameters.prior_sigma_m if name.endswith("_m") else parameters.prior_sigma_mps
        for target in range(1, TARGETS + 1)
        for name in moving_target_components(target)
    }
    return targets | unknowns(parameters)["estimate_sigma"]


def seconds_of(errors: Errors) -> pd.DataFrame:
    """Compute mean squared errors by run and second; for a bound, the square of the bound.

    `common_roll_rad2` describes the mean roll bias of all sensors. Columns named like a bias describe
    this bias; the other columns are means over components. Values are NaN if the estimator does not have
    the components.
    """
    table: dict[str, Any] = {"run": errors.run, "second": errors.elapsed_s.astype(int)}
    for quantity, ending in (("target_m2", "_m"), ("bias_rad2", "_bias_rad"), ("clock_s2", "_clock_s")):
        columns = [i for i, name in enumerate(errors.components) if name.endswith(ending)]
        table[quantity] = errors.squared[:, columns].mean(axis=1) if columns else np.nan
    for name in errors.components:
        if name.endswith("_bias_rad"):
            table[name] = errors.squared[:, errors.components.index(name)]
    rolls = [i for i, name in enumerate(errors.components) if name.endswith("roll_bias_rad")]
    table["common_roll_rad2"] = _common(errors, rolls) if rolls else np.nan
    table["nees_per_component"] = errors.nees / len(errors.components)
    found: Any = pd.DataFrame(table).groupby(["run", "second"], as_index=False).mean()
    return found.assign(estimator=errors.estimator)


def _common(errors: Errors, columns: list[int]) -> Floats:
    """Compute the mean square of the mean of some components."""
    if errors.is_bound:
        return errors.covariance[:, columns][:, :, columns].mean(axis=(1, 2))
    return errors.error[:, columns].mean(axis=1) ** 2


def _last(table: pd.DataFrame, label: str, quantity: str) -> Floats:
    """Average a quantity over the last seconds, by run."""
    own = table[(table["estimator"] == label) & (table["second"] > table["second"].max() - LAST_S)]
    return own.groupby("run")[quantity].mean().to_numpy()


def _measure(
    case: str,
    table: pd.DataFrame,
    weakest_of: pd.DataFrame,
    sigmas: Mapping[str, float],
    outcome: Outcome,
) -> None:
    """Measure errors at the end of the runs, with intervals over the runs."""
    found, labels = outcome.metrics, set(table["estimator"])
    logs = np.log10(weakest_of["least_eigenvalue"])
    found[f"observability.least_eigenvalue.{case}"] = float(10.0 ** logs.mean())
    least = mean_interval(logs)
    outcome.measure(f"observability.log10_least_eigenvalue.{case}", least)
    if "smoother" in labels:
        rolls = [sigma for name, sigma in sigmas.items() if name.endswith("roll_bias_rad")]
        prior = float(np.sum(np.square(rolls))) / len(rolls) ** 2
        left = mean_interval(_last(table, "smoother", "common_roll_rad2") / prior)
        outcome.measure(f"smoother.common_roll_left.{case}", left)
    if {"ekf", "bound"} <= labels:
        bound = _last(table, "bound", "bias_rad2").mean()
        ratio = mean_interval(_last(table, "ekf", "bias_rad2") / bound)
        outcome.measure(f"ekf.bias_by_bound.{case}", ratio)
    if {"ekf", "unaware"} <= labels:
        squares = (_last(table, label, "target_m2") for label in ("unaware", "ekf"))
        worse = mean_interval(0.5 * np.log(np.divide(*squares)))
        outcome.measure(f"unaware.target_ratio_to_ekf.{case}", worse.rising(np.exp))
    units = {"target_m2": ("target_m", 1.0), "bias_rad2": ("bias_mrad", 1e3)}
    units |= {"clock_s2": ("clock_ms", 1e3), "common_roll_rad2": ("common_roll_mrad", 1e3)}
    for label in table["estimator"].unique():
        for quantity, (name, scale) in units.items():
            value = scale * float(np.sqrt(_last(table, label, quantity).mean()))
            if np.isfinite(value):
                found[f"{label}.{name}.{case}"] = value
        for name in filter(lambda name: name.endswith("_bias_rad"), map(str, table.columns)):
            value = 1e3 * float(np.sqrt(_last(table, label, name).mean()))
            if np.isfinite(value):
                found[f"{label}.{name.removesuffix('rad')}mrad.{case}"] = value
        nees = _aligned_nees(table, label)
        if np.isfinite(nees).all():
            outcome.measure(f"{label}.nees_per_component.{case}", mean_interval(nees))


def _aligned_nees(table: pd.DataFrame, label: str) -> Floats:
    own = table[(table["estimator"] == label) & (table["second"] >= ALIGNED_S)]
    return own.groupby("run")["nees_per_component"].mean().to_numpy()


def weakest(direction: Mapping[str, float], sigmas: Mapping[str, float]) -> str:
    """Name the components with the largest entries in a direction, in units of the prior."""
    parts = {name: share / sigmas[name] for name, share in direction.items()}
    largest = max(abs(part) for part in parts.values())
    return " ".join(
        f"{part / largest:+.1f} {name}"
        for name, part in sorted(parts.items(), key=lambda each: -abs(each[1]))
        if abs(part) > 0.3 * largest
    )


def _chart(every: pd.DataFrame) -> Chart:
    """Draw the common roll, all biases and NEES over time, one column per case."""
    axes = {
        "common_roll_rad2": Axis(label="RMSE of the common roll (mrad)", log=True, limits=(0.1, 6.0)),
        "bias_rad2": Axis(label="RMSE of a bias (mrad)", log=True, limits=(0.1, 6.0)),
        "nees_per_component": Axis(label="NEES for each component", limits=(0.5, 1.5)),
    }
    panels = []
    for quantity, y in axes.items():
        for case, of_case in every.groupby("case", sort=False):
            panel = Panel(x=Axis(label="time (s)"), y=y, title=str(case))
            for estimator, rows in of_case.groupby("estimator", sort=False):
                mean = rows.groupby("second")[quantity].mean()
                values = 1e3 * np.sqrt(mean) if quantity.endswith("rad2") else mean
                if estimator != "unaware":
                    panel.series.append(curve(str(estimator), mean.index, values))
            if quantity == "nees_per_component":
                panel.series.append(level("ideal", of_case["second"], 1.0))
            panels.append(panel)
    return Chart(panels=panels, columns=every["case"].nunique())


LOS_MOVING = Study(
    "moving lines of sight: observability of biases and clocks, and errors against the bound",
    study,
    Options,
)
