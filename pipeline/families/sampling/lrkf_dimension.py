"""Study of linear regression Kalman filters in 2 to 20 dimensions: the benefit of more samples.

Moments are tested first, without a filter. The moments of waves y = sin(k'x + phase) of x ~ N(0, I) are
known exactly, because

    E exp(i k'x) = exp(-|k|^2 / 2).

The vectors k point in all directions or, as for a sine of the heading, along the axes. The samplings are
those of the experiment's estimators, which then run on drives of robots and vehicles.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from time import process_time
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from pydantic import Field, PositiveFloat, PositiveInt

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.inputs import Record
from fuselog.pipeline.runs.recorded import judge, replay_in_memory
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.studies.toolkit.repetitions import rmse_of_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.inference.sampling import Sampler, Samples, parse_sampling
from fuselog.replay.judging.intervals import mean_interval

DIRECTIONS = {"all": "in all directions", "axes": "along the axes"}
RATED = "s2kf-100"  # the sampling with which the errors of the others are compared
X_LIMITS, X_TICKS = (4.0, 600.0), (5.0, 20.0, 100.0, 500.0)


class Options(Parameters):
    """Options of the tests with functions of several dimensions, and of the drives.

    Attributes:
        dimensions: dimensions of the state.
        functions: number of random functions for each dimension.
        phase_sigma_rad: standard deviation of k'x, that is, the length of k.
        pays: share by which more samples must reduce an error to be worthwhile.
        drives: recordings by name.
    """

    dimensions: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (2, 5, 10, 20)
    functions: Annotated[int, Field(ge=2)] = 60
    phase_sigma_rad: PositiveFloat = 1.0
    pays: Annotated[float, Field(gt=0, lt=1)] = 0.01
    drives: dict[str, Record] = {}


class Waves(NamedTuple):
    """The function sin(K x + phases): vectors K (m, n), phases (m,)."""

    vectors: Floats
    phases: Floats


class Moments(NamedTuple):
    """Mean (m,) and covariance (m, m) of a function's values, and their covariance with x (n, m)."""

    mean: Floats
    covariance: Floats
    cross: Floats


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: Options = setting.options
    samplings = samplings_of(experiment)
    moments = moment_errors(samplings, options, experiment.seed)
    tables, sources = [], []
    for name, drive in options.drives.items():
        recorded, table = driven(experiment, setting, name, drive)
        counts = {label: at(table["dimension"][0]).count for label, at in samplings.items()}
        tables.append(table.assign(drive=name, samples=table["estimator"].map(counts)))
        sources += recorded
    outcome = Outcome(input_sha256=hash_streams(sources), tables={"moments": moments})
    _measure_moments(moments, outcome)
    runs = pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()
    if tables:
        outcome.tables["runs"] = runs
        measure_drives(runs, options, outcome)
    outcome.figures["samples"] = _chart(moments, runs)
    return outcome


def samplings_of(experiment: Experiment) -> dict[str, Callable[[int], Sampler]]:
    """Return the samplings of the estimators by label; raise BadInput if there are none."""
    kinds = {label: str(values.get("kind", label)) for label, values in experiment.estimators.items()}
    found: dict[str, Callable[[int], Sampler]] = {
        label: parse_sampling(kind.removeprefix("lrkf:")).at
        for label, kind in kinds.items()
        if kind.startswith("lrkf:")
    }
    if not found:
        raise BadInput("study lrkf-dimension compares samplings; give estimators such as lrkf:ukf")
    return found


def exact(waves: Waves) -> Moments:
    """Compute the exact moments of waves of x ~ N(0, I)."""
    vectors, phases = waves
    squared = np.sum(vectors**2, axis=1)
    fading = np.exp(-0.5 * squared)

    def product(sign: float) -> Floats:
        """Compute E cos((k_i + sign k_j)'x + phase_i + sign phase_j)."""
        apart = vectors[:, None] + sign * vectors
        return np.exp(-0.5 * np.sum(apart**2, axis=2)) * np.cos(phases[:, None] + sign * phases)

    mean = np.sin(phases) * fading
    covariance = 0.5 * (product(-1.0) - product(1.0)) - np.outer(mean, mean)
    return Moments(mean, covariance, (np.cos(phases) * fading) * vectors.T)


def sampled(waves: Waves, samples: Samples) -> Moments:
    """Compute the moments of waves from a sample set (L, n)."""
    points, weights = samples
    values = np.sin(points @ waves.vectors.T + waves.phases)
    mean = weights @ values
    weighted = weights[:, None] * (values - mean)
    return Moments(mean, weighted.T @ (values - mean), points.T @ weighted)


def moment_errors(
    samplings: Mapping[str, Callable[[int], Sampler]], options: Options, seed: int
) -> pd.DataFrame:
    """Tabulate the relative errors of moments by sampling, dimension, direction and function.

    The error of the mean is a root mean square, in standard deviations of the function's values. The
    errors of covariances are relative, in the Frobenius norm.
    """
    rows = []
    for dimension in options.dimensions:
        for number, direction in enumerate(DIRECTIONS):
            rng, drawing = np.random.default_rng([seed, dimension, number]).spawn(2)
            functions = [_waves(dimension, direction, options, rng) for _ in range(options.functions)]
            for label, at in samplings.items():
                sampler = at(dimension)
                drawn = sampler.draw(drawing, (len(functions),))
                for function, waves in enumerate(functions):
                    wanted = exact(waves)
                    found = sampled(waves, Samples(*(part[function] for part in drawn)))
                    sigma = np.sqrt(np.diag(wanted.covariance))
                    mean_error = np.sqrt(np.mean(((found.mean - wanted.mean) / sigma) ** 2))
                    others = [_relative(*each) for each in zip(found[1:], wanted[1:], strict=True)]
                    rows.append(
                        (label, dimension, sampler.count, direction, function, mean_error, *others)
                    )
    names = ["estimator", "dimension", "samples", "direction", "function"]
    return pd.DataFrame(rows, columns=[*names, "mean_error", "covariance_error", "cross_error"])


def _waves(dimension: int, direction: str, options: Options, rng: np.random.Generator) -> Waves:
    vectors = rng.standard_normal((dimension, dimension)) if direction == "all" else np.eye(dimension)
    vectors *= options.phase_sigma_rad / np.linalg.norm(vectors, axis=1, keepdims=True)
    return Waves(vectors, rng.uniform(-np.pi, np.pi, dimension))


def _relative(found: Floats, wanted: Floats) -> float:
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


def driven(
    experiment: Experiment, setting: Setting, name: str, drive: Record
) -> tuple[list[MemorySource], pd.DataFrame]:
    """Record a drive's runs, keep them in a folder named after it, and tabulate estimators and runs.

    Each row contains the state's dimension, the position RMSE, the mean NEES per component, and the CPU
    time in ms of all cores per second of a run, averaged over all runs.
    """
    runner = Runner(experiment.model_copy(update={"record": drive}), setting)
    sources = runner.obtain()
    outputs: dict[str, Ragged] = {}
    rows = []
    for label, settings in setting.progress(
        experiment.estimators.items(), name, len(experiment.estimators)
    ):
        replay_in_memory(sources[:1], {label: settings})  # compile first
        begin = process_time()
        found = replay_in_memory(sources, {label: settings})
        seconds = process_time() - begin
        [errors] = judge(sources, found, experiment.gap_limit_s).errors
        lasts_s = float(sum(errors.elapsed_s[errors.run == run].max() for run in range(len(sources))))
        places = replace(errors, error=errors.error[:, errors.position])
        for run, rmse_m in enumerate(rmse_of_runs(places, len(sources)).tolist()):
            nees = float(np.mean(errors.nees[errors.run == run])) / len(errors.components)
            rows.append((label, run, len(errors.components), rmse_m, nees, 1e3 * seconds / lasts_s))
        outputs |= found
    runner.keep(sources, outputs, name, drawn=name)
    columns = ["estimator", "run", "dimension", "position_rmse_m", "nees_per_component", "cpu_ms_per_s"]
    return sources, pd.DataFrame(rows, columns=columns)


def _measure_moments(moments: pd.DataFrame, outcome: Outcome) -> None:
    """Measure errors with intervals over functions, and logs of `RATED`'s errors relative to others."""
    for (dimension, direction), rows in moments.groupby(["dimension", "direction"], sort=False):
        case = f"n{dimension}-{direction}"
        for quantity in ("mean_error", "covariance_error", "cross_error"):
            wide: Any = rows.pivot_table(quantity, "function", "estimator", sort=False)
            for label in wide:
                outcome.measure(f"{label}.{quantity}.{case}", mean_interval(wide[label]))
            if quantity == "mean_error" and RATED in wide:
                for label in wide.columns.drop(RATED):
                    ratio = mean_interval(np.log(wide[RATED] / wide[label]))
                    outcome.measure(f"{label}.log_ratio.{case}", ratio)


def measure_drives(runs: pd.DataFrame, options: Options, outcome: Outcome) -> None:
    """Measure errors by drive, and by how many % other samples change the position error."""
    found = outcome.metrics
    for drive, of_drive in runs.groupby("drive", sort=False):
        quantities = ["position_rmse_m", "nees_per_component", "samples"]
        means: Any = of_drive.groupby("estimator", sort=False)[quantities].mean()
        for label, row in means.iterrows():
            found |= {f"{label}.{name}.{drive}": float(value) for name, value in row.dropna().items()}
        enough = means["position_rmse_m"] <= (1.0 + options.pays) * means["position_rmse_m"].min()
        found[f"lrkf.samples_that_pay.{drive}"] = float(means["samples"][enough].min())
        rmse_m: Any = of_drive.pivot_table("position_rmse_m", "run", "estimator")
        for label, other in (("ukf", "ekf"), (RATED, "ukf")):
            if {label, other} <= set(rmse_m):
                change = 100.0 * (rmse_m[label] / rmse_m[other] - 1.0)
                key = f"{label}.rmse_change_percent.{drive}-{other}"
                outcome.measure(key, mean_interval(change))


def _chart(moments: pd.DataFrame, runs: pd.DataFrame) -> Chart:
    """Draw errors of means over the number of samples by dimension, and errors and time of drives."""
    panels = []
    for direction, words in DIRECTIONS.items():
        of_direction = moments[moments["direction"] == direction]
        for dimension, rows in of_direction.groupby("dimension", sort=False):
            title = f"waves {words}, N = {dimension}"
            y = Axis(label="error of the mean (sigma)", log=True, limits=(3e-3, 1.0))
            panels.append(_over_samples(rows, "mean_error", y, title))
    for drive, rows in runs.groupby("drive", sort=False) if len(runs) else ():
        title = f"{drive}, {rows['dimension'].iloc[0]} states"
        middle_m = float(rows["position_rmse_m"].mean())
        y = Axis(label="RMSE of the position (m)", limits=(0.0, 1.5 * middle_m))
        panels.append(_over_samples(rows, "position_rmse_m", y, title))
        y = Axis(label="CPU time per second of log (ms)", log=True)
        panels.append(_over_samples(rows, "cpu_ms_per_s", y, title))
    return Chart(panels=panels, columns=moments["dimension"].nunique())


def _over_samples(rows: pd.DataFrame, quantity: str, y: Axis, title: str) -> Panel:
    """Draw a line per family of samplings, and a horizontal line for the EKF, which has no samples."""
    x = Axis(label="samples", log=True, limits=X_LIMITS, ticks={each: f"{each:g}" for each in X_TICKS})
    panel = Panel(x=x, y=y, title=title)
    mean = rows.groupby(["estimator", "samples"], dropna=False, sort=False)[quantity].mean()
    table = mean.reset_index()
    for name, own in table.groupby(table["estimator"].str.partition("-")[0], sort=False):
        if own["samples"].isna().all():
            panel.series.append(level(str(name), X_LIMITS, own[quantity].iloc[0]))
        else:
            panel.series.append(curve(str(name), own["samples"], own[quantity], "line+markers"))
    return panel


LRKF_DIMENSION = Study(
    "sampling filters by dimension and number of samples: errors of moments, drives and CPU time",
    study,
    Options,
)
