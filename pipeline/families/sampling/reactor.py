"""Study of the S2KF paper's batch reactor, a nonlinear prediction compared with exact moments.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section VI.A, Fig. 7. The paper's statements are tested for the prior mean as printed, (0.5, 3.5), and
with its components swapped. Only the swapped mean reproduces the curves of the figure.
"""

import numpy as np
import pandas as pd

from fuselog.pipeline.families.sampling.linearization import (
    REFERENCE,
    Ensemble,
    Options,
    ensembles,
    error_panel,
    rmse,
)
from fuselog.pipeline.output.charts import Chart
from fuselog.pipeline.output.results import MetricValue, Outcome
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.inputs import Record
from fuselog.recorders.errors import BadInput

CASES = {"printed": "prior as printed", "swapped": "prior swapped"}
EARLY = 5  # number of steps that count as the beginning


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: Options = setting.options
    outcome = Outcome()
    sources = []
    for case in CASES:
        tables = []
        again = _in_case(experiment, case)
        found = ensembles(again, setting, options, written=case == "printed")
        for number, ensemble in enumerate(found):
            tables.append(step_errors(ensemble).assign(seed=experiment.seed + number))
            sources += ensemble.sources
        steps = pd.concat(tables).assign(case=case)
        outcome.tables[f"steps-{case}"] = steps
        outcome.figures[f"errors-{case}"] = error_chart(steps, CASES[case])
        outcome.metrics |= metrics(steps, case)
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def _in_case(experiment: Experiment, case: str) -> Experiment:
    """Return the experiment with the prior of a case."""
    if experiment.record is None:
        raise BadInput("study reactor records its own runs; add a [record] table to the experiment")
    mean = experiment.record.parameters.get("prior_mean", (0.5, 3.5))
    parameters = experiment.record.parameters | {
        "prior_mean": tuple(mean) if case == "printed" else tuple(mean)[::-1]
    }
    record = Record(scenario=experiment.record.scenario, parameters=parameters)
    return experiment.model_copy(update={"record": record})


def step_errors(ensemble: Ensemble) -> pd.DataFrame:
    """Tabulate errors by estimator and step.

    The columns are the RMSE of mean and covariance relative to the filter with exact moments (as in the
    paper), the RMSE of the mean relative to the truth, and the ratio of the filter's variance to the
    exact one.
    """
    exact = ensemble.tracks[REFERENCE]
    own = np.nanmean(np.trace(exact.covariance, axis1=2, axis2=3), axis=0)
    parts = []
    for label, each in ensemble.tracks.items():
        trace = np.nanmean(np.trace(each.covariance, axis1=2, axis2=3), axis=0)
        columns = {
            "mean_rmse": rmse(each.mean - exact.mean),
            "covariance_rmse": rmse(each.covariance - exact.covariance),
            "truth_rmse": rmse(each.mean - ensemble.truth),
            "variance_ratio": trace / own,
        }
        parts.append(
            pd.DataFrame(
                {
                    "estimator": label,
                    "step": np.arange(1, len(trace) + 1),
                    "failed_runs": each.failed,
                    **columns,
                }
            )
        )
    return pd.concat(parts)


def metrics(steps: pd.DataFrame, case: str) -> dict[str, MetricValue]:
    """Average errors over steps and seeds; for errors of mean and covariance, add each seed's value.

    For the mean, also return the errors of the first and the last steps, and the share of steps in which
    the error exceeds the UKF's.
    """
    found: dict[str, MetricValue] = {}
    by_step = steps.groupby(["estimator", "step"], sort=False)["mean_rmse"].mean()
    last = steps["step"].max()
    for label, rows in steps.groupby("estimator", sort=False):
        by_seed = rows.groupby("seed").mean(numeric_only=True)
        found[f"{label}.truth_rmse.{case}"] = float(by_seed["truth_rmse"].mean())
        found[f"{label}.failed_runs.{case}"] = float(by_seed["failed_runs"].sum())
        if label != REFERENCE:
            found[f"{label}.variance_ratio.{case}"] = float(by_seed["variance_ratio"].mean())
            for quantity in ("mean_rmse", "covariance_rmse"):
                found[f"{label}.{quantity}.{case}"] = float(by_seed[quantity].mean())
                found[f"{label}.{quantity}_by_seed.{case}"] = by_seed[quantity].tolist()
            own = by_step[label]
            found[f"{label}.early_mean_rmse.{case}"] = float(own.loc[:EARLY].mean())
            found[f"{label}.late_mean_rmse.{case}"] = float(own.loc[last - EARLY + 1 :].mean())
            if "ukf" in by_step:
                found[f"{label}.share_above_ukf.{case}"] = float((own > by_step["ukf"]).mean())
    return found


def error_chart(steps: pd.DataFrame, case: str) -> Chart:
    """Draw RMSE of mean and covariance relative to the exact moments over the steps, Fig. 7."""
    approximate = steps[steps["estimator"] != REFERENCE]
    return Chart(
        title=f"Batch reactor against the analytic moments, {case}",
        columns=2,
        panels=[
            error_panel(approximate, "mean_rmse", "RMSE of the mean"),
            error_panel(approximate, "covariance_rmse", "RMSE of the covariance"),
        ],
    )


REACTOR = Study(
    "sampling filters compared with exact moments: nonlinear prediction in a batch reactor",
    study,
    Options,
)
