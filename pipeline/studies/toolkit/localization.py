"""A study of estimators that track a moving object: errors, consistency, innovations.

Most experiments use this study, which records or imports runs, replays and judges them, and draws
charts. Families that reproduce the claims of a paper have studies with additional tables, figures and
metrics.
"""

from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.output.summary import summarise
from fuselog.pipeline.runs.campaigns import judge
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    done = judge(experiment, setting)
    outcome = summarise(done.judge, done.coverage, done.parameters)
    outcome.input_sha256, outcome.parameters = done.input_sha256, done.parameters
    outcome.timings = done.timings
    return outcome


LOCALIZATION = Study(
    "errors, consistency and innovations of estimators, over time and runs", study, is_campaign=True
)
