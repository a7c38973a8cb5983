"""The study of consistency: whether errors are what covariances say, once an estimator is aligned.

That of `localization`, and one claim for each estimator: of all stamps from `aligned_s` on, those at
which the mean NEES of the runs lies in its 95 % interval. Bar-Shalom, Li, Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 5.4.2.
"""

from typing import Annotated

from pydantic import Field, NonNegativeFloat

from pipeline.output.claims import judged
from pipeline.output.results import Outcome
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.studies.toolkit import localization
from recorders.parameters import Parameters


class ConsistencyOptions(Parameters):
    """When estimators count.

    Attributes:
        aligned_s: estimators count from then on, since a run's epoch.
        least_share: share of stamps at which an estimator is to be consistent.
    """

    aligned_s: NonNegativeFloat = 0.0
    least_share: Annotated[float, Field(gt=0, le=1)] = 0.9


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
    options: ConsistencyOptions = setting.options
    outcome = localization.study(experiment, setting)
    steps = outcome.tables["steps"]
    aligned = steps[(steps["elapsed_s"] >= options.aligned_s) & steps["nees"].notna()]
    for key, rows in aligned.groupby(["estimator", "case"], sort=False):
        estimator, case = map(str, key)
        share = float(rows["nees"].between(rows["nees_low"], rows["nees_high"]).mean())
        of_case = f".{case}" if case else ""
        outcome.metrics[f"{estimator}.nees_aligned_within_95{of_case}"] = share
        outcome.claims.append(
            judged(
                f"{estimator}: from {options.aligned_s:g} s on, the mean NEES over the runs lies in its "
                f"95 % interval at {options.least_share:.0%} of the stamps or more",
                f"{options.least_share:.0%}",
                f"{share:.1%} of {len(rows)} stamps, {int(rows['runs'].max())} runs; mean NEES "
                f"{rows['nees'].mean():.2f}",
                share >= options.least_share,
            )
        )
    return outcome


CONSISTENCY = Study(
    "consistency: whether errors are what covariances say, once estimators are aligned",
    study,
    ConsistencyOptions,
    is_campaign=True,
)
