"""The study of consistency: which stamps count, and what is claimed of them."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from fuselog.pipeline.output.claims import decide
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.experiment import load_experiment
from fuselog.pipeline.studies.toolkit import localization
from fuselog.pipeline.studies.toolkit.consistency import ConsistencyOptions, study


def steps(estimator: str, nees: Any) -> pd.DataFrame:
    """A stamp a second, at which NEES of 2 to 4 is consistent."""
    time_s = np.arange(len(nees), dtype=float)
    given = {"elapsed_s": time_s, "nees": nees, "nees_low": 2.0, "nees_high": 4.0, "runs": 7}
    return pd.DataFrame({"estimator": estimator, "case": "body", **given})


def test_stamps_count_once_aligned_and_each_estimator_is_claimed(monkeypatch: pytest.MonkeyPatch):
    """Before 5 s all is off; then one of ten stamps of the first is, and two of the second."""
    early = [9.0] * 5
    good = steps("good", [*early, *[3.0] * 9, 4.1])
    bad = steps("bad", [*early, 1.9, 4.1, *[3.0] * 8])

    def judged(*_: Any) -> Outcome:
        return Outcome(tables={"steps": pd.concat([good, bad])})

    monkeypatch.setattr(localization, "study", judged)
    setting = SimpleNamespace(options=ConsistencyOptions(aligned_s=5.0))
    outcome = study(None, setting)  # type: ignore[arg-type]
    assert outcome.metrics == {
        "good.nees_aligned_within_95.body": 0.9,
        "good.nees_aligned.body": pytest.approx(3.11),
        "bad.nees_aligned_within_95.body": 0.8,
        "bad.nees_aligned.body": pytest.approx(3.0),
    }
    _, experiment = load_experiment("navigation-heading", {}, {})
    claims = decide(experiment.claims, outcome.metrics, {}, {"aligned_s": 5.0, "runs": 200.0})
    assert [claim.verdict for claim in claims] == ["confirmed", "refuted"]
    assert claims[0].claim.startswith("good: from 5 s on, the mean NEES over the runs is in its")
    assert claims[1].ours == "80.0 % of the stamps, 200 runs; mean NEES 3.00"
