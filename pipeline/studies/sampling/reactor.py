"""The batch reactor of the S2KF's paper: nonlinear prediction against the exact moments.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section VI.A, Fig. 7. Its statements are judged for the prior mean as printed, (0.5, 3.5), and for the
two numbers swapped: only with these do the figure's curves come out.
"""

from dataclasses import replace

import numpy as np
import pandas as pd

from pipeline.output.charts import Chart
from pipeline.output.claims import Claim, judged, named
from pipeline.output.results import MetricValue, Outcome
from pipeline.runs.estimates import hash_streams
from pipeline.runs.experiment import Experiment, Record, Setting, Study
from pipeline.studies.sampling.linearization import (
    REFERENCE,
    Ensemble,
    Options,
    averages,
    ensembles,
    error_panel,
    falling,
    rmse,
)
from recorders.errors import BadInput

CASES = {"printed": "prior as printed", "swapped": "prior swapped"}
OTHERS = ("ukf", "gf-25", "rukf-12")
SMART = ("s2kf-10", "s2kf-20", "s2kf-50", "s2kf-100", "s2kf-150")
MUCH = 1.05  # a ratio of variances
EARLY = 5  # steps that count as the beginning


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
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
        outcome.claims += claims(steps, CASES[case])
    outcome.input_sha256 = hash_streams(sources)
    return outcome


def _in_case(experiment: Experiment, case: str) -> Experiment:
    """The experiment with the prior of a case."""
    if experiment.record is None:
        raise BadInput("study reactor records its own runs; give the experiment a [record] table")
    mean = experiment.record.parameters.get("prior_mean", (0.5, 3.5))
    parameters = experiment.record.parameters | {
        "prior_mean": tuple(mean) if case == "printed" else tuple(mean)[::-1]
    }
    record = Record(scenario=experiment.record.scenario, parameters=parameters)
    return experiment.model_copy(update={"record": record})


def step_errors(ensemble: Ensemble) -> pd.DataFrame:
    """One row per estimator and step.

    RMSE of mean and covariance against the exact moments' filter (the paper's), of the mean against
    truth, and how large the filter's own variance is beside the exact one.
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
    """Averages over steps and seeds; of the errors that are compared also those of every seed."""
    found: dict[str, MetricValue] = {}
    for label, rows in steps.groupby("estimator", sort=False):
        by_seed = rows.groupby("seed").mean(numeric_only=True)
        found[f"{label}.truth_rmse.{case}"] = float(by_seed["truth_rmse"].mean())
        found[f"{label}.failed_runs.{case}"] = float(by_seed["failed_runs"].sum())
        if label != REFERENCE:
            found[f"{label}.variance_ratio.{case}"] = float(by_seed["variance_ratio"].mean())
            for quantity in ("mean_rmse", "covariance_rmse"):
                found[f"{label}.{quantity}.{case}"] = float(by_seed[quantity].mean())
                found[f"{label}.{quantity}_by_seed.{case}"] = by_seed[quantity].tolist()
    return found


def claims(steps: pd.DataFrame, case: str) -> list[Claim]:
    """The paper's statements about Fig. 7, from the averages over steps and seeds.

    None for an experiment of one's own that lacks one of the paper's filters.
    """
    if not {*OTHERS, *SMART} <= set(steps["estimator"]):
        return []
    mean, covariance = averages(steps, "mean_rmse"), averages(steps, "covariance_rmse")
    variance = averages(steps, "variance_ratio")
    early = averages(steps[steps["step"] <= EARLY], "mean_rmse")
    late = averages(steps[steps["step"] > steps["step"].max() - EARLY], "mean_rmse")
    by_step = steps.groupby(["estimator", "step"])["mean_rmse"].mean()
    above = float(np.mean(by_step["rukf-12"].to_numpy() > by_step["ukf"].to_numpy()))
    found = [
        judged(
            "The S2KF converges to the analytic moments with more samples",
            "errors fall with L",
            f"mean {named(mean, *SMART)}; covariance {named(covariance, *SMART)}",
            falling([mean[name] for name in SMART]) and falling([covariance[name] for name in SMART]),
        ),
        judged(
            "With 50 samples or more the S2KF has the best means of all",
            "best of all investigated LRKFs",
            named(mean, *OTHERS, *SMART[2:]),
            max(mean[name] for name in SMART[2:]) < min(mean[name] for name in OTHERS),
        ),
        judged(
            "All S2KF have better means than GF and RUKF",
            "much better",
            named(mean, "gf-25", "rukf-12", *SMART),
            max(mean[name] for name in SMART) < min(mean["gf-25"], mean["rukf-12"]),
        ),
        judged(
            "The RUKF's means are constantly worse than the UKF's",
            "constantly at a higher level",
            f"{named(mean, 'ukf', 'rukf-12')}; worse in {above:.0%} of the steps",
            above > 0.95,
        ),
        judged(
            "The GF starts with a very high error of the mean, which falls",
            "very high RMSE at the beginning",
            f"steps 1 to {EARLY}: {named(early, *OTHERS)}; last {EARLY}: {named(late, *OTHERS)}",
            early["gf-25"] > max(late["gf-25"], 1.5 * early["ukf"], 1.5 * early["rukf-12"]),
        ),
        judged(
            "The UKF's covariance is closer to the analytic one than those of GF and RUKF",
            "much closer",
            named(covariance, *OTHERS),
            covariance["ukf"] < min(covariance["gf-25"], covariance["rukf-12"]),
        ),
        judged(
            "The S2KF's covariances outperform the UKF's with 50 samples or more",
            "can outperform the UKF",
            named(covariance, "ukf", *SMART[2:]),
            max(covariance[name] for name in SMART[2:]) < covariance["ukf"],
        ),
    ]
    found += [
        judged(
            f"The {name.upper()[:-3]} estimates itself much too uncertain",
            "much too uncertain",
            f"trace of the covariance {variance[name]:.3f} of the analytic one",
            variance[name] > MUCH,
        )
        for name in ("gf-25", "rukf-12")
    ]
    return [replace(each, claim=f"{each.claim} ({case})") for each in found]


def error_chart(steps: pd.DataFrame, case: str) -> Chart:
    """Fig. 7: RMSE of mean and covariance against the exact moments, over the steps."""
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
    "sampling filters against exact moments: nonlinear prediction in a batch reactor", study, Options
)
