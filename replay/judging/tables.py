"""Tables of judged results, with rows per step, per run and time span, or per estimate.

The tables are made from the sums of the judge on request, so that printing metrics does not import
pandas.
"""

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd

from fuselog.replay.judging.consistency.bounds import Bounds
from fuselog.replay.judging.errors.evaluation import Errors, Floats, rmse_interval, split_topic
from fuselog.replay.judging.metrics.metrics import step_bounds
from fuselog.replay.judging.metrics.quantities import InnovationSums, Quantities


def joined(tables: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Concatenate tables; a column that a table lacks is NaN in its rows."""
    filled = [table for table in tables if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame()


def step_table(quantities: Quantities, bounds: Bounds | None = None) -> pd.DataFrame:
    """Make a table with a row for each step, over all runs: RMSE, mean NEES, and 95 % intervals.

    If there are more than `judge.STEPS` steps, each row covers several steps, and `step` is the first of
    these. If `bounds` contains a bound over the ensemble, it replaces the averages along the
    trajectories.
    """
    errors, by_step = quantities.errors, quantities.by_step
    cells, count, sums = by_step.filled()
    covariances = bounds.covariances() if bounds else None
    if covariances is not None and by_step.width == 1 and len(cells) == len(covariances):
        squared = np.diagonal(covariances, axis1=1, axis2=2)
        groups = (squared[:, errors.position].sum(axis=1), squared[:, errors.rotation].sum(axis=1))
        sums[:, 1:-3] = count[:, None] * np.column_stack([*groups, squared])
    runs = np.ceil(count / by_step.width)
    low, high = step_bounds(runs, len(errors.components))
    rmse, _, scale = errors.main
    rmse_low, rmse_high = rmse_interval(runs, *(sums[:, -3:-1] / count[:, None]).T)
    columns: dict[str, object] = {
        "estimator": errors.estimator,
        "case": errors.case,
        "step": cells[:, 1] * by_step.width,
        "runs": runs.astype(np.int64),
        "elapsed_s": sums[:, 0] / count,
        **_means(errors, count, sums),
        f"{rmse}_low": scale * rmse_low,
        f"{rmse}_high": scale * rmse_high,
    }
    return pd.DataFrame({**columns, "nees_low": low, "nees_high": high})


def time_table(quantities: Quantities) -> pd.DataFrame:
    """Make a table with one row per run and time span."""
    errors, by_time = quantities.errors, quantities.by_time
    cells, count, sums = by_time.filled()
    columns: dict[str, object] = {
        "estimator": errors.estimator,
        "case": errors.case,
        "run": cells[:, 0],
        "until_s": (cells[:, 1] + 1) * by_time.width * 1e-9,
        "estimates": count.astype(np.int64),
    }
    return pd.DataFrame({**columns, **_means(errors, count, sums)})


def table_of_runs(
    quantities: Iterable[Quantities], innovations: Mapping[str, InnovationSums]
) -> pd.DataFrame:
    """Make a table with one row per estimator, case and run.

    Columns are the number of estimates, the RMSE of each quantity and the mean NEES. If there are
    innovations, NIS per component, the share rejected by a gate and the log-likelihood of accepted
    measurements are added.
    """
    keys = ["estimator", "case", "run"]
    errors = joined(run_table(each) for each in quantities)
    measured = joined(innovation_table(topic, sums) for topic, sums in innovations.items())
    if errors.empty or measured.empty:
        return errors if measured.empty else measured
    there, own = (pd.MultiIndex.from_frame(each[keys]) for each in (errors, measured))
    return joined([errors.merge(measured, on=keys, how="left"), measured[~own.isin(there)]])


def innovation_table(topic: str, sums: InnovationSums) -> pd.DataFrame:
    """Make a table with one row per run that has innovations."""
    estimator, case = split_topic(topic)
    run, of = sums.by_run()
    with np.errstate(invalid="ignore"):
        columns = {
            "nis_per_component": of.squared / np.where(of.degrees > 0, of.degrees, np.nan),
            "gated_share": 1.0 - of.accepted / of.messages,
            "log_likelihood": of.log_likelihood,
        }
    return pd.DataFrame({"estimator": estimator, "case": case, "run": run, **columns})


def run_table(quantities: Quantities) -> pd.DataFrame:
    """Make a table with one row per run."""
    errors = quantities.errors
    runs, counts, totals = quantities.by_time.by_group()
    columns: dict[str, object] = {
        "estimator": errors.estimator,
        "case": errors.case,
        "run": runs,
        "estimates": counts.astype(np.int64),
    }
    return pd.DataFrame({**columns, **_means(errors, counts, totals)})


def error_table(errors: Errors) -> pd.DataFrame:
    """Make a row per run and step, with error and sigma of every component and the NEES."""
    sigma = np.sqrt(np.diagonal(errors.covariance, axis1=1, axis2=2))
    columns: dict[str, object] = {
        "estimator": errors.estimator,
        "case": errors.case,
        "run": errors.run,
        "step": errors.step,
        "time_ns": errors.time_ns,
        "elapsed_s": errors.elapsed_s,
    }
    for index, name in enumerate(errors.components):
        columns[f"error_{name}"] = errors.error[:, index]
        columns[f"sigma_{name}"] = sigma[:, index]
    columns["nees"] = errors.nees
    return pd.DataFrame(columns)


def _means(errors: Errors, count: Floats, sums: Floats) -> dict[str, Floats]:
    """Compute columns of RMSE by quantity and of the mean NEES."""
    mean = sums / count[:, None]
    columns: dict[str, Floats] = {}
    if errors.position:
        columns["position_rmse_m"] = np.sqrt(mean[:, 1])
    if errors.rotation:
        columns["orientation_rmse_deg"] = np.degrees(np.sqrt(mean[:, 2]))
    for column, name in enumerate(errors.components):
        columns[f"rmse_{name}"] = np.sqrt(mean[:, 3 + column])
    return {**columns, "nees": mean[:, -1]}
