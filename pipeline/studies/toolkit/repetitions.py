"""Repetitions of a paper's Monte Carlo experiment, where step k of all runs is one repetition.

A log can contain the same experiment several times, with new noise and one estimate each time. An
ensemble of 100 runs with 10 steps thus repeats a paper's 100 runs ten times, and a rule that the paper
states for its 100 runs can be tested ten times.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import ndtri

from fuselog.pipeline.output.charts import Axis, Series, curve
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.recorders.errors import BadInput
from fuselog.replay.judging.errors.evaluation import Errors

Floats = NDArray[np.float64]
# The label of the 95 % interval of a mean NEES.
EFFICIENT = "95 % if efficient"


def require_spread(solutions: int) -> None:
    """Raise BadInput if there are too few `solutions` of an experiment for a standard error."""
    if solutions < 2:
        raise BadInput(
            "claims are judged by standard errors, which need at least two runs; give --runs 2 or more"
        )


def errors_named(replayed: Replayed, estimator: str) -> Errors:
    """Return the errors of an estimator that has a single stream of estimates."""
    [errors] = [each for each in replayed.errors if each.estimator == estimator]
    return errors


def by_repetition(errors: Errors, values: Floats, runs: int) -> Floats:
    """Arrange the values of estimates by repetition and run.

    Args:
        errors: errors of n estimates, with the step and run of each.
        values: values of these estimates, (n, ...).
        runs: number of runs.

    Returns:
        Values (repetitions, runs, ...), NaN if a solution failed.
    """
    repeated = np.full((int(errors.step.max(initial=-1)) + 1, runs, *values.shape[1:]), np.nan)
    repeated[errors.step, errors.run] = values
    return repeated


def root_mean_square(values: Floats, axis: int | tuple[int, ...]) -> Floats:
    """Compute the root mean square, ignoring NaN.

    Args:
        values: values of any shape.
        axis: axis or axes over which the mean is taken.

    Returns:
        The root mean square, with the shape of `values` without these axes.
    """
    return np.sqrt(np.nanmean(values**2, axis=axis))


def rms_length(errors: Floats) -> float:
    """Compute the root mean square of the lengths of errors (n, d), NaN for n = 0."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) if len(errors) else np.nan


def rmse_of_runs(errors: Errors, runs: int) -> Floats:
    """Compute the root mean square length of the errors of each run (runs,), NaN without errors."""
    squared = np.sum(errors.error**2, axis=1)
    count = np.bincount(errors.run, minlength=runs)
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.bincount(errors.run, squared, runs) / count)


def table_of_runs(quantity: str, cases: Mapping[str, Mapping[str, Floats]]) -> pd.DataFrame:
    """Make a table with a row per estimator, case and run, with which reports compare estimators.

    Args:
        quantity: name of the listed quantity, as in the metrics.
        cases: values (runs,) by case and estimator.
    """
    return pd.DataFrame(
        [
            (estimator, case, run, value)
            for case, found in cases.items()
            for estimator, values in found.items()
            for run, value in enumerate(values.tolist())
        ],
        columns=["estimator", "case", "run", quantity],
    )


def worst_deviation(printed: Floats, squared: Floats, runs: int) -> tuple[float, float]:
    """Compute the largest deviation of a paper's RMSEs from ours, in standard errors.

    Args:
        printed: RMSEs in the paper, (k,).
        squared: our squared errors, (n, k), NaN if a solution failed.
        runs: number of runs in the paper.

    Returns:
        The largest of the k deviations, and the value that it exceeds with a probability of 5 % if both
        have the same distribution.
    """
    mean = np.nanmean(squared, axis=0)
    error = np.nanstd(squared, axis=0) * np.sqrt(1.0 / runs + 1.0 / len(squared))
    allowed = float(ndtri(1.0 - 0.025 / len(printed)))
    return float(np.max(np.abs(printed**2 - mean) / error)), allowed


def groups(
    values: Sequence[Sequence[float]], labels: Sequence[str], names: Sequence[str], axis: str
) -> tuple[Axis, list[Series]]:
    """Draw values side by side in named groups; return the axis, and a series per position."""
    size = max(len(group) for group in values)
    series = []
    for place in range(size):
        x = np.arange(len(values)) + (place - 0.5 * (size - 1)) * 0.8 / size
        series.append(curve(labels[place], x, [group[place] for group in values], "markers"))
    return Axis(label=axis, ticks={float(place): name for place, name in enumerate(names)}), series
