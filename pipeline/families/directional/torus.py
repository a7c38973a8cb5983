"""Study of estimation on the torus: propagation of samples through a coupling (figure 3), and a filter.

Kurz and Hanebeck, "Deterministic Sampling on the Torus for Bivariate Circular Estimation", 2016. The
propagation is a computation without a log. Its truth is the population value, computed with
Gauss-Hermite nodes instead of the paper's 10,000 samples. The filter is the one that the paper
announces, with a grid filter as reference.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydantic import PositiveFloat, PositiveInt

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curves
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import Replayed, require_memory
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.studies.toolkit.repetitions import rmse_of_runs, table_of_runs
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.directional.headings import turn_together
from fuselog.recorders.families.directional.torus_headings import HeadingsParameters
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.families.directional.distributions import wrapped_normal
from fuselog.replay.families.directional.distributions.wrapped_normal import Samples, WrappedNormal
from fuselog.replay.families.directional.grid import run_torus_grid_filter, torus_grid
from fuselog.replay.families.directional.torus import make_heading_model

Floats = NDArray[np.float64]


class PropagationOptions(Parameters):
    """The sweep of figure 3.

    Attributes:
        sigma_rad: standard deviations of the two angles, in rad.
        couplings_rad: couplings of the two angles, in rad.
        correlations: correlations of the two angles.
        random_samples: number of random samples to compare with.
        central_weights: weights of the central sample to compare; the first is the one that fuselog
            uses.
    """

    sigma_rad: tuple[PositiveFloat, PositiveFloat] = (0.8, 1.3)
    couplings_rad: tuple[float, ...] = (0.1, 0.2, 0.5, 1.0)
    correlations: tuple[float, ...] = tuple(np.linspace(-0.9, 0.9, 19).round(12).tolist())
    random_samples: PositiveInt = 50
    central_weights: tuple[float, ...] = (0.2, 0.45)


class MomentErrors(NamedTuple):
    """Errors of mean and covariance, averaged over entries, ([runs,] correlations)."""

    mean: Floats
    covariance: Floats


def propagation_errors(
    options: PropagationOptions, coupling_rad: float, runs: int, rng: np.random.Generator
) -> dict[str, MomentErrors]:
    """Propagate samples and truth once, fit both by mixed maximum likelihood, and compare their moments.

    The keys of the result are `five-wW` for every central weight (W in percent), `ukf` and `random`.
    """
    rho, sigma = np.array(options.correlations), np.array(options.sigma_rad)
    unit = np.stack([np.ones_like(rho), rho, rho, np.ones_like(rho)], axis=-1).reshape(-1, 2, 2)
    root = np.linalg.cholesky(np.outer(sigma, sigma) * unit)
    distributions = WrappedNormal(np.zeros((len(rho), 2)), root @ np.swapaxes(root, -1, -2))
    moments = wrapped_normal.circular_moments(distributions)
    star = np.sqrt(2.5) * np.array([[0.0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    several = WrappedNormal(*(np.stack([part] * runs) for part in distributions))
    drawn = wrapped_normal.sample(several, options.random_samples, rng)
    share = 1.0 / options.random_samples
    sets = {
        **{
            f"five-w{100 * weight:g}": wrapped_normal.five_samples(moments, weight)
            for weight in options.central_weights
        },
        "ukf": _linear_samples(root, star, np.full(5, 0.2)),
        "random": Samples(drawn, np.full(drawn.shape[:-1], share)),
    }
    truth = wrapped_normal.fit_mixed_mle(_moved(_linear_samples(root, *_gauss_hermite()), coupling_rad))
    found = {}
    for name, samples in sets.items():
        fitted = wrapped_normal.fit_mixed_mle(_moved(samples, coupling_rad))
        found[name] = MomentErrors(
            np.abs(wrap_angle(fitted.mean - truth.mean)).mean(axis=-1),
            np.abs(fitted.covariance - truth.covariance).mean(axis=(-1, -2)),
        )
    return found


def _gauss_hermite(order: int = 40) -> tuple[Floats, Floats]:
    """Return nodes (n, 2) and weights (n,) of a standard normal distribution in the plane."""
    x, w = np.polynomial.hermite_e.hermegauss(order)
    nodes = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    weights = np.outer(w, w).ravel() / w.sum() ** 2
    kept = weights > 1e-14
    return nodes[kept], weights[kept]


def _linear_samples(root: Floats, points: Floats, weights: Floats) -> Samples:
    positions = points @ np.swapaxes(root, -1, -2)
    return Samples(positions, np.broadcast_to(weights, positions.shape[:-1]))


def _moved(samples: Samples, coupling_rad: float) -> Samples:
    x = samples.positions
    return Samples(
        np.stack(turn_together(x[..., 0], x[..., 1], coupling_rad, 0.0, 0.0), axis=-1), samples.weights
    )


def study_propagation(experiment: Experiment, setting: Setting) -> Outcome:
    """Study propagation with random samples, figure 3; see `fuselog.pipeline.runs.experiment.Study`."""
    options: PropagationOptions = setting.options
    if experiment.record or experiment.import_ or experiment.estimators:
        raise BadInput("study torus-propagation uses no data; leave out record, import and estimators")
    drawn_bytes = experiment.runs * len(options.correlations) * options.random_samples * 2 * 8
    # the samples as drawn, and after propagation
    require_memory(f"{experiment.runs} runs of random samples", 2 * drawn_bytes)
    outcome = Outcome()
    tables = []
    for coupling_rad in setting.progress(
        options.couplings_rad, "propagating", len(options.couplings_rad)
    ):
        rng = np.random.default_rng(experiment.seed)
        found = propagation_errors(options, coupling_rad, experiment.runs, rng)
        case = f"c={1000 * coupling_rad:g}-mrad"
        for name, errors in found.items():
            outcome.metrics[f"{name}.mean_error_rad.{case}"] = float(errors.mean.mean())
            outcome.metrics[f"{name}.covariance_error_rad2.{case}"] = float(errors.covariance.mean())
            for part, values in errors._asdict().items():
                by_correlation = np.atleast_2d(values).mean(axis=0).tolist()
                outcome.metrics[f"{name}.{part}_errors_by_correlation.{case}"] = by_correlation
            tables.append(_rows(options, coupling_rad, name, errors))
    outcome.tables["errors"] = pd.concat(tables)
    outcome.figures["errors"] = propagation_chart(outcome.tables["errors"], options)
    return outcome


def _rows(
    options: PropagationOptions, coupling_rad: float, name: str, errors: MomentErrors
) -> pd.DataFrame:
    mean, covariance = (np.atleast_2d(part).mean(axis=0) for part in errors)
    return pd.DataFrame(
        {
            "coupling_rad": coupling_rad,
            "samples": name,
            "correlation": options.correlations,
            "mean_error_rad": mean,
            "covariance_error_rad2": covariance,
        }
    )


def propagation_chart(table: pd.DataFrame, options: PropagationOptions) -> Chart:
    """Draw errors over the correlation: one column per coupling, mean above and covariance below."""
    quantities = {
        "mean_error_rad": "error of the mean (rad)",
        "covariance_error_rad2": "error of the covariance (rad²)",
    }
    panels = []
    for quantity, label in quantities.items():
        for coupling_rad in options.couplings_rad:
            of_coupling = table[table["coupling_rad"] == coupling_rad]
            series = curves(of_coupling, ["samples"], "correlation", quantity)
            panels.append(
                Panel(
                    title=f"c = {coupling_rad:g} rad",
                    x=Axis(label="correlation"),
                    y=Axis(label=label, log=True),
                    series=series,
                )
            )
    return Chart(columns=len(options.couplings_rad), panels=panels)


class FilterOptions(Parameters):
    """The cases of the study, and the grid filter.

    Attributes:
        cases: changes to the scenario's parameters, by the name of a case.
        grid_cells: number of cells of the grid per angle.
    """

    cases: dict[str, dict[str, float]] = {}
    grid_cells: PositiveInt = 48


def study_filter(experiment: Experiment, setting: Setting) -> Outcome:
    """Compare toroidal and unscented filters; see `fuselog.pipeline.runs.experiment.Study`."""
    options: FilterOptions = setting.options
    outcome = Outcome()
    sources: list[MemorySource] = []
    errors_rad: dict[str, dict[str, Floats]] = {}
    for case, replayed in Runner(experiment, setting).cases(options.cases or {"all": {}}):
        found = {
            errors.estimator: rmse_of_runs(errors, len(replayed.sources)) / np.sqrt(2.0)
            for errors in replayed.errors
        }
        found["grid"] = _grid_errors_rad(replayed, options.grid_cells)
        rmse = {name: float(np.sqrt(np.nanmean(error**2))) for name, error in found.items()}
        outcome.metrics.update({f"{name}.angle_rmse_rad.{case}": each for name, each in rmse.items()})
        errors_rad[case] = found
        sources += replayed.sources
    outcome.input_sha256 = hash_streams(sources)
    outcome.tables["runs"] = table_of_runs("angle_rmse_rad", errors_rad)
    outcome.figures["errors"] = filter_figure(errors_rad)
    return outcome


def _grid_errors_rad(replayed: Replayed, cells: int) -> Floats:
    """Compute the RMSE per angle of every run (runs,) by Bayes' rule on a grid over the torus."""
    logs = [source.read(["/truth", "/headings"]) for source in replayed.sources]
    stated = replayed.sources[0].run
    assert stated is not None
    given = HeadingsParameters.model_validate(stated.parameters)
    system, measurement = given.covariances()
    model = make_heading_model(
        given.coupling_rad, (given.drift1_rad, given.drift2_rad), system, measurement
    )
    truth = np.concatenate([log["/truth"]["state"] for log in logs])
    measured = np.concatenate([log["/headings"]["value"] for log in logs])
    offsets = np.cumsum([0, *(len(log["/truth"]) for log in logs)])
    prior = wrapped_normal.density(
        WrappedNormal(np.zeros(2), given.prior_sigma_rad**2 * np.eye(2)), torus_grid(cells)
    )
    state = np.broadcast_to(prior / prior.sum(), (len(logs), cells, cells))
    found = run_torus_grid_filter(model, state, offsets, measured)
    squared = (wrap_angle(found.mean - truth) ** 2).mean(axis=1)
    return np.sqrt(np.add.reduceat(squared, offsets[:-1]) / np.diff(offsets))


def filter_figure(errors_rad: dict[str, dict[str, Floats]]) -> Figure:
    """Draw the errors of every filter over the runs, case by case."""
    figure = Figure(figsize=(2.8 * len(errors_rad) + 1, 4), layout="constrained")
    plots = np.atleast_1d(figure.subplots(1, len(errors_rad), sharey=True))
    for axes, (case, found) in zip(plots, errors_rad.items(), strict=True):
        shown = [error[np.isfinite(error)] for error in found.values()]
        axes.boxplot(shown, tick_labels=list(found), showmeans=True, sym=".")
        axes.set_title(case)
        axes.tick_params(axis="x", rotation=20)
    plots[0].set_ylabel("RMSE of a run per angle (rad)")
    return figure


TORUS_PROPAGATION = Study(
    "propagation of five samples on the torus, compared with the UKF's and random samples",
    study_propagation,
    PropagationOptions,
)
TORUS_FILTER = Study(
    "the recursive toroidal filter compared with unscented filters and a grid filter",
    study_filter,
    FilterOptions,
)
