"""Claims of few runs: decided by intervals or not at all."""

from fuselog.pipeline.output.claims import decide
from fuselog.pipeline.runs.experiment import Study, numbers_of
from fuselog.recorders.parameters import build
from fuselog.recorders.registry import load
from tests.claims.pages import as_shipped, stored


def test_no_claim_of_few_runs_is_decided_without_an_interval() -> None:
    """Of every shipped experiment that makes runs, by its kept metrics without their intervals."""
    tried = 0
    for name, kept in stored().items():
        experiment = as_shipped(name)
        if experiment.import_ or experiment.runs <= 3:
            continue
        study = load("studies", experiment.study, Study)
        numbers = numbers_of(experiment, build(study.options, experiment.options, name)) | {"runs": 3.0}
        claims = [claim for claim in experiment.claims if claim.least_runs == experiment.runs]
        found = decide(claims, kept.metrics, {}, numbers)
        assert {each.verdict for each in found} <= {"inconclusive", "not reproducible"}, name
        tried += len(found)
    assert tried > 200
