"""A study of consistency: whether errors agree with the covariances after an estimator is aligned.

The study adds two metrics to those of `localization`, for stamps from `aligned_s` on: the mean NEES over
runs and stamps, and the share of stamps at which the mean over runs is in its 95 % interval.
Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section
5.4.2.
"""

from pydantic import NonNegativeFloat

from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.studies.toolkit import localization
from fuselog.recorders.parameters import Parameters


class ConsistencyOptions(Parameters):
    """The time from which estimators count as aligned.

    Attributes:
        aligned_s: time since the run's epoch from which estimates are judged.
    """

    aligned_s: NonNegativeFloat = 0.0


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: ConsistencyOptions = setting.options
    outcome = localization.study(experiment, setting)
    steps = outcome.tables["steps"]
    aligned = steps[(steps["elapsed_s"] >= options.aligned_s) & steps["nees"].notna()]
    for key, rows in aligned.groupby(["estimator", "case"], sort=False):
        estimator, case = map(str, key)
        share = float(rows["nees"].between(rows["nees_low"], rows["nees_high"]).mean())
        of_case = f".{case}" if case else ""
        outcome.metrics[f"{estimator}.nees_aligned_within_95{of_case}"] = share
        outcome.metrics[f"{estimator}.nees_aligned{of_case}"] = float(rows["nees"].mean())
    return outcome


CONSISTENCY = Study(
    "consistency: whether errors agree with the covariances after estimators are aligned",
    study,
    ConsistencyOptions,
    is_campaign=True,
)
