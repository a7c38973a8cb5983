"""Study of real angles on the torus: densities of a protein's dihedrals, and wind predictions.

Fits are evaluated on angles that were not used for them: dihedrals in other parts of the chain, and
winds in the second half. For the winds, the noise and the coupling are those that are most likely in the
first half. Neighbours are correlated, so intervals are Student's intervals of block means.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
import pandas as pd
from pydantic import PositiveInt
from scipy.optimize import minimize
from scipy.special import expit, logsumexp
from threadpoolctl import threadpool_limits

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.directional.headings import turn_on
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.results import state_stream
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.families.directional.distributions import wrapped_normal
from fuselog.replay.families.directional.distributions.torus_mixtures import (
    VonMisesMixture,
    WrappedMixture,
    fit_von_mises_mixture,
    fit_wrapped_mixture,
)
from fuselog.replay.families.directional.distributions.wrapped_normal import Samples, WrappedNormal
from fuselog.replay.families.directional.grid import run_torus_grid_filter, torus_grid
from fuselog.replay.families.directional.torus import (
    HeadingModel,
    make_heading_model,
    run_toroidal_filter,
    run_unscented_filter,
)
from fuselog.replay.judging.intervals import Interval, mean_interval

Filter = Callable[..., tuple[WrappedNormal, WrappedNormal]]

_PRIOR = np.diag([0.1, 0.5]) ** 2
_TURNS = 2.0 * np.pi * np.arange(-5, 6)


# The simpler density that each density is compared with.
SIMPLER = {
    "wrapped": "moments",
    "wrapped-mixture": "wrapped",
    "sine": "wrapped",
    "cosine": "wrapped",
    "sine-mixture": "wrapped-mixture",
    "cosine-mixture": "wrapped-mixture",
}


class Options(Parameters):
    """Options of the evaluation of dihedrals and wind.

    Attributes:
        folds: number of parts in which dihedrals are held out.
        most_components: largest number of components of mixtures.
        block_residues: number of residues in a block, whose means determine intervals.
        block_hours: hours in a block of the wind.
        grid_cells: number of cells of the grid per angle.
    """

    folds: PositiveInt = 10
    most_components: PositiveInt = 8
    block_residues: PositiveInt = 10
    block_hours: PositiveInt = 12
    grid_cells: PositiveInt = 48


class Prediction(NamedTuple):
    """Log densities and circular errors of the predictions of every hour except the first."""

    log_density: Floats
    error_rad: Floats


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Fit densities and predict winds; see `fuselog.pipeline.runs.experiment.Study`."""
    options: Options = setting.options
    if experiment.estimators:
        raise BadInput("study torus-real runs its own filters; leave out estimators")
    runner = Runner(experiment, setting)
    (source,) = runner.obtain()
    outcome = Outcome(input_sha256=hash_streams([source]))
    dihedrals = np.asarray(source.in_order("/dihedrals", "publish_time")["value"])
    wind = np.asarray(source.in_order("/wind", "publish_time")["value"])[:, 0]
    with threadpool_limits(1):  # the fits are so small that a second core would only wait
        _judge_fits(held_out(dihedrals, options, setting), options, outcome)
    half = len(wind) // 2
    found = {name: most_likely(wind[:half], run) for name, run in FILTERS.items()}
    _judge_predictions(wind, half, found, options, outcome)
    time_ns = source.in_order("/wind", "publish_time").publish_time_ns
    predicted = (
        _estimates(name, time_ns, predicted_by(wind, run, found[name])) for name, run in FILTERS.items()
    )
    runner.keep([source], {each.stream.topic: each for each in predicted})
    return outcome


def held_out(angles: Floats, options: Options, setting: Setting) -> pd.DataFrame:
    """Compute the log density of every pair of angles by fits to the other parts of the chain.

    The number of components of a mixture is chosen by cross-validation within the training parts.

    Args:
        angles: (n, 2), in rad, in the order of the chain.
        options: the number of parts.
        setting: setting of the experiment, which shows the progress.

    Returns:
        A table with a row for each pair and a column for each density.
    """
    stretches = np.array_split(np.arange(len(angles)), options.folds)
    found = np.full((len(angles), 7), np.nan)
    for stretch in setting.progress(stretches, "fitting dihedrals", len(stretches)):
        others = np.setdiff1d(np.arange(len(angles)), stretch)
        count = _count_of(angles[others], options)
        given, left = angles[others], angles[stretch]
        even = Samples(given, np.full(len(given), 1.0 / len(given)))
        by_moments = wrapped_normal.fit_moments(wrapped_normal.sample_moments(even))
        one, several = fit_wrapped_mixture(given, 1), fit_wrapped_mixture(given, count)
        fits: list[WrappedMixture | VonMisesMixture] = [one, several]
        fits += [
            fit_von_mises_mixture(given, kind, start)
            for start in (one, several)
            for kind in ("sine", "cosine")
        ]
        found[stretch, 0] = np.log(wrapped_normal.density(by_moments, left))
        found[stretch, 1:] = np.stack([fit.log_density(left) for fit in fits], axis=1)
    names = ["moments", "wrapped", "wrapped-mixture", "sine", "cosine", "sine-mixture", "cosine-mixture"]
    return pd.DataFrame(found, columns=names)


def _count_of(angles: Floats, options: Options) -> int:
    """Find the number of wrapped normals that is most likely on held-out parts."""
    stretches = np.array_split(np.arange(len(angles)), 3)
    scores = []
    for count in range(1, options.most_components + 1):
        fits = [fit_wrapped_mixture(np.delete(angles, each, axis=0), count) for each in stretches]
        scores.append(
            sum(fit.log_density(angles[each]).sum() for fit, each in zip(fits, stretches, strict=True))
        )
    return 1 + int(np.argmax(scores))


def _judge_fits(table: pd.DataFrame, options: Options, outcome: Outcome) -> None:
    for name, column in table.items():
        outcome.metrics[f"{name}.log_density.dihedrals"] = float(column.mean())
    outcome.tables["dihedrals"] = table.rename_axis("residue").reset_index()
    for name, simpler in SIMPLER.items():
        gain = interval(table[name] - table[simpler], options.block_residues)
        outcome.measure(f"{name}.log_density_gain.{simpler}", gain)


def _judge_predictions(
    wind: Floats,
    half: int,
    found: Mapping[str, Mapping[str, float]],
    options: Options,
    outcome: Outcome,
) -> None:
    predictions = {name: predict(wind, run, found[name]) for name, run in FILTERS.items()}
    predictions["grid"] = predict_on_grid(wind, found["torus"], options.grid_cells)
    predictions |= persistence(wind, half)
    rows = [
        pd.DataFrame({"hour": np.arange(1, len(wind)), "predictor": name, **each._asdict()})
        for name, each in predictions.items()
    ]
    outcome.tables["wind"] = pd.concat(rows, ignore_index=True)
    later = {
        name: Prediction(*(each[half - 1 :] for each in both)) for name, both in predictions.items()
    }
    for name, each in later.items():
        outcome.metrics[f"{name}.log_density.wind"] = float(each.log_density.mean())
        outcome.metrics[f"{name}.error_rad.wind"] = float(each.error_rad.mean())
    for name, parameters in found.items():
        outcome.metrics |= {f"{name}.{key}.wind": value for key, value in parameters.items()}
    outcome.figures["wind"] = _chart(outcome.tables["wind"], half)

    own = later["torus"]
    for name in ("persistence", "persistence-with-jumps", "ukf", "grid"):
        gain = interval(own.log_density - later[name].log_density, options.block_hours)
        outcome.measure(f"torus.log_density_gain.{name}", gain)
    nearer = interval(later["persistence"].error_rad - own.error_rad, options.block_hours)
    outcome.measure("torus.error_gain_rad.persistence", nearer)


def interval(values: Floats | pd.Series, block: int) -> Interval:
    """Compute the mean and its 95 % interval, by Student's distribution of block means.

    Args:
        values: (n,), in an order in which neighbouring values may be correlated.
        block: number of values in a block; an incomplete last block is dropped.
    """
    whole = np.asarray(values)[: len(values) // block * block]
    return mean_interval(whole.reshape(-1, block).mean(axis=1))


FILTERS: dict[str, Filter] = {
    "torus": partial(run_toroidal_filter, motion=turn_on),
    "ukf": partial(run_unscented_filter, motion=turn_on, wrapped=True),
}


def most_likely(
    wind: Floats, run: Callable[..., tuple[WrappedNormal, WrappedNormal]]
) -> dict[str, float]:
    """Find the coupling and the sigmas that predict directions best.

    Args:
        wind: (hours,), directions in rad.
        run: function that runs the filter.

    Returns:
        The coupling and the sigmas, by parameter name.
    """

    def given(x: Floats) -> dict[str, float]:
        system, measurement = np.exp(x[1:])
        return {
            "coupling_rad": float(np.tanh(x[0])),
            "system_sigma_rad": float(system),
            "measurement_sigma_rad": float(measurement),
        }

    def cost(x: Floats) -> float:
        total = float(predict(wind, run, given(x)).log_density.sum())
        return -total if np.isfinite(total) else np.inf

    starts = [[coupling, np.log(0.4), np.log(0.2)] for coupling in (-0.5, 0.0, 0.5)]
    found = [minimize(cost, start, method="Nelder-Mead") for start in starts]
    return given(min(found, key=lambda each: each.fun).x)


def _model(parameters: Mapping[str, float]) -> HeadingModel:
    noise = (parameters[f"{which}_sigma_rad"] ** 2 * np.eye(2) for which in ("system", "measurement"))
    return make_heading_model(parameters["coupling_rad"], (0.0, 0.0), *noise)


def _measured(wind: Floats) -> Floats:
    """Return measurements of the direction, but not of the turn, for every hour except the first."""
    return np.stack([wind[1:], np.full(len(wind) - 1, np.nan)], axis=1)


def predicted_by(wind: Floats, run: Filter, parameters: Mapping[str, float]) -> WrappedNormal:
    """Predict direction and turn of every hour except the first from the previous hours.

    Args:
        wind: (hours,), directions in rad; the filter begins at the first direction.
        run: function that runs the filter.
        parameters: the filter's coupling and sigmas, by name.

    Returns:
        Means (hours - 1, 2) in rad, and their covariances.
    """
    model, measured = _model(parameters), _measured(wind)
    prior = WrappedNormal(np.array([[wind[0], 0.0]]), _PRIOR[None])
    _, after = run(model, prior, np.array([0, len(measured)]), measured)
    before = WrappedNormal(
        *(np.concatenate([first, rest[:-1]]) for first, rest in zip(prior, after, strict=True))
    )
    hours = np.arange(len(measured) + 1)
    return run(model, before, hours, np.full(measured.shape, np.nan))[1]


def predict(wind: Floats, run: Filter, parameters: Mapping[str, float]) -> Prediction:
    """Evaluate a filter's prediction of every hour except the first against the measurement.

    Args:
        wind: (hours,), directions in rad.
        run: function that runs the filter.
        parameters: the filter's coupling and sigmas, by name.

    Returns:
        The log densities and the errors in rad, (hours - 1,) each.
    """
    next_ = predicted_by(wind, run, parameters)
    variance = next_.covariance[:, 0, 0] + parameters["measurement_sigma_rad"] ** 2
    return _of_normal(wind[1:] - next_.mean[:, 0], variance)


def _of_normal(deviation: Floats, variance: Floats | float) -> Prediction:
    deviation, variance = wrap_angle(deviation), np.reshape(variance, (-1, 1))
    exponents = -0.5 * (deviation[:, None] + _TURNS) ** 2 / variance
    log_density = logsumexp(exponents - 0.5 * np.log(2.0 * np.pi * variance), axis=1)
    return Prediction(log_density, np.abs(deviation))


def predict_on_grid(wind: Floats, parameters: Mapping[str, float], cells: int) -> Prediction:
    """Evaluate predictions by Bayes' rule on a grid, as `predict` does for a filter.

    Args:
        wind: (hours,), directions in rad.
        parameters: coupling and sigmas, by name.
        cells: number of cells of the grid per angle.

    Returns:
        The log densities and the errors in rad, (hours - 1,) each.
    """
    measured = _measured(wind)
    prior = wrapped_normal.density(WrappedNormal(np.array([wind[0], 0.0]), _PRIOR), torus_grid(cells))
    begin = (prior / prior.sum())[None]
    filtered = run_torus_grid_filter(
        _model(parameters), begin, np.array([0, len(measured)]), measured, turn_on
    )
    return Prediction(filtered.log_density, np.abs(wrap_angle(wind[1:] - filtered.predicted[:, 0])))


def persistence(wind: Floats, half: int) -> dict[str, Prediction]:
    """Predict that every hour equals the previous one.

    Args:
        wind: (hours,), directions in rad.
        half: number of hours, counted from the first, that are used to fit the width.

    Returns:
        Two predictions by name, with wrapped normal noise only, and with occasional arbitrary jumps.
    """
    turn = np.diff(wind)

    def predicted(x: Floats, share: float) -> Prediction:
        normal = _of_normal(turn, np.exp(2.0 * x[0]))
        log_density = np.logaddexp(
            np.log1p(-share) + normal.log_density, np.log(max(share, 1e-300) / (2.0 * np.pi))
        )
        return Prediction(log_density, normal.error_rad)

    def cost(x: Floats) -> float:
        share = 0.0 if len(x) == 1 else float(expit(x[1]))
        return -float(predicted(x, share).log_density[: half - 1].sum())

    plain = minimize(cost, [np.log(0.5)], method="Nelder-Mead").x
    with_jumps = minimize(cost, [np.log(0.3), -2.0], method="Nelder-Mead").x
    return {
        "persistence": predicted(plain, 0.0),
        "persistence-with-jumps": predicted(with_jumps, float(expit(with_jumps[1]))),
    }


def _chart(table: pd.DataFrame, half: int) -> Chart:
    """Draw the cumulative gain in log density over persistence, for the second half."""
    wide = table.pivot_table(index="hour", columns="predictor", values="log_density").loc[half:]
    gains = wide.sub(wide["persistence"], axis=0).cumsum()
    panel = Panel(x=Axis(label="hour"), y=Axis(label="cumulative log density minus that of persistence"))
    for name in gains.columns.drop("persistence"):
        panel.series.append(curve(str(name), gains.index, gains[name]))
    return Chart(panels=[panel])


def _estimates(name: str, time_ns: Integers, predicted: WrappedNormal) -> Ragged:
    """Return, as estimates, a filter's predictions for every hour except the first."""
    angles: Components = {"direction_rad": "angle", "turn_rad": "angle"}
    stream = state_stream(f"/estimates/{name}/state", time_ns[1:], angles, None, *predicted)
    return Ragged(stream, np.array([0, len(stream)]))


TORUS_REAL = Study(
    "wrapped normal and von Mises densities of dihedrals, and predictions of winds", study, Options
)
