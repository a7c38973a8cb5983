"""Comparison of the Bingham filter with modified Kalman filters, figures 4 and 5.

Kurz, Gilitschenski, Julier, Hanebeck, "Recursive Bingham Filter for Directional Estimation Involving 180
Degree Symmetry", JAIF 9(2), 2014, section 7. Every ensemble is recorded twice, with Bingham noise and
with Gaussian noise of the same spread, (57)-(60). An error is the angle between the axes, which is half
the rotation between two orientations.
"""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydantic import PositiveInt

from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.inputs import load_scenario
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.studies.toolkit.repetitions import require_spread, rmse_of_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.directional.orientation import AxisParameters
from fuselog.recorders.models.orientation import axis_angle_between
from fuselog.recorders.parameters import Parameters, build, merge
from fuselog.recorders.recording import Recorder
from fuselog.recorders.registry import load
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.families.directional.bingham import BinghamNoise, make_steps
from fuselog.replay.families.directional.distributions import bingham
from fuselog.replay.families.directional.estimators import as_bingham, as_covariance
from fuselog.replay.families.directional.grid import run_axis_grid_filter
from fuselog.replay.judging.intervals import mean_interval

Floats = NDArray[np.float64]


class BinghamOptions(Parameters):
    """The estimator to compare with the others, and the grid of the reference filter.

    Attributes:
        estimator: label of the estimator to compare with the others.
        grid_cells: number of cells of the reference filter on a grid.
    """

    estimator: str = "bingham"
    grid_cells: PositiveInt = 720


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: BinghamOptions = setting.options
    if options.estimator not in experiment.estimators:
        raise BadInput(
            f"experiment '{experiment.title}': estimator {options.estimator} is missing; add it"
        )
    require_spread(experiment.runs)
    stated = _stated(experiment)
    sources: list[MemorySource] = []
    errors_deg: dict[str, dict[str, Floats]] = {}
    for case, replayed in Runner(experiment, setting).cases(_cases(stated)):
        errors_deg[case] = _errors_deg(replayed, stated, options, case)
        sources += replayed.sources
    outcome = Outcome(input_sha256=hash_streams(sources))
    for case, found in errors_deg.items():
        for name, error in found.items():
            outcome.metrics[f"{name}.angular_rmse_mean_deg.{case}"] = float(np.nanmean(error))
            outcome.metrics[f"{name}.angular_rmse_median_deg.{case}"] = float(np.nanmedian(error))
            outcome.metrics[f"{name}.failed_runs.{case}"] = float(np.isnan(error).sum())
            more = error - found[options.estimator]
            if name != options.estimator:
                excess = mean_interval(more[np.isfinite(more)])
                outcome.measure(f"{name}.excess_deg.{case}", excess)
    outcome.tables["runs"] = pd.concat(
        [pd.DataFrame({"case": case, **found}) for case, found in errors_deg.items()]
    )
    outcome.figures["errors"] = error_figure(errors_deg)
    return outcome


def _stated(experiment: Experiment) -> AxisParameters:
    """Return the scenario's parameters; raise BadInput if it has neither axes nor orientations."""
    if not experiment.record:
        raise BadInput(f"experiment '{experiment.title}' has no scenario; add it in [record]")
    name, values, label = load_scenario(experiment.record.scenario)
    kind = load("recorders", name, Recorder).parameters
    if not issubclass(kind, AxisParameters):
        raise BadInput(
            f"study bingham: scenario {label} has neither axes nor orientations; give the scenario axis "
            "or orientation"
        )
    return build(kind, merge(values, experiment.record.parameters), f"scenario {label}")


def _cases(stated: AxisParameters) -> dict[str, dict[str, Any]]:
    """Return both kinds of noise; the Gaussian noise has the covariance of the Bingham noise."""
    gaussian = {
        name: {
            "distribution": "gaussian",
            "diagonal": np.diagonal(as_covariance(getattr(stated, name))).tolist(),
        }
        for name in ("system", "measurement")
    }
    return {"bingham-noise": {}, "gaussian-noise": gaussian}


def _errors_deg(
    replayed: Replayed, stated: AxisParameters, options: BinghamOptions, case: str
) -> dict[str, Floats]:
    """Compute the angular RMSE of every estimator by run, (runs,)."""
    runs = len(replayed.sources)
    is_axis = stated.dimension() == 2
    scale = np.degrees(1.0 if is_axis else 0.5)
    found = {errors.estimator: scale * rmse_of_runs(errors, runs) for errors in replayed.errors}
    if is_axis and case == "bingham-noise":
        found["grid"] = _grid_errors_deg(replayed, stated, options.grid_cells)
    return found


def _grid_errors_deg(replayed: Replayed, stated: AxisParameters, cells: int) -> Floats:
    """Compute the smallest possible errors, by Bayes' rule on a grid over the half circle."""
    logs = [source.read(["/truth", "/axis"]) for source in replayed.sources]
    truth = np.stack([log["/truth"]["state"] for log in logs])
    measured = np.concatenate([log["/axis"]["axis"] for log in logs])
    runs, count, _ = truth.shape
    still = np.tile([1.0, 0.0], (len(measured), 1))
    steps = make_steps(np.arange(runs + 1) * count, still, measured)
    angle = np.pi / cells * np.arange(cells)
    points = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    prior = np.exp(bingham.log_density(as_bingham(stated.prior), points))
    noise = BinghamNoise(as_bingham(stated.system), as_bingham(stated.measurement))
    _, axes = run_axis_grid_filter(noise, np.tile(prior / prior.sum(), (runs, 1)), steps)
    error = axis_angle_between(truth, axes.reshape(truth.shape))
    return np.degrees(np.sqrt((error**2).mean(axis=1)))


def error_figure(errors_deg: dict[str, dict[str, Floats]]) -> Figure:
    """Draw the runs' errors of every estimator, as in figures 4 and 5."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    for axes, (case, found) in zip(
        figure.subplots(1, len(errors_deg), sharey=True), errors_deg.items(), strict=True
    ):
        shown = [error[np.isfinite(error)] for error in found.values()]
        axes.boxplot(shown, tick_labels=list(found), showmeans=True, sym=".")
        axes.set(title=case.replace("-", " "), yscale="log")
        axes.tick_params(axis="x", rotation=15)
    figure.axes[0].set_ylabel("angular RMSE of a run (deg)")
    return figure


BINGHAM = Study(
    "the Bingham filter compared with Kalman filters, with both kinds of noise", study, BinghamOptions
)
