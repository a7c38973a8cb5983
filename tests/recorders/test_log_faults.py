"""A slice of the fault campaign: `make faults` tries for minutes what is tried here for seconds."""

import numpy as np
import pytest

from fuselog.recorders.log import read_streams
from tests.faults import crafted, cuts, damaged_logs, flips


@pytest.mark.paper
@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(("campaign", "most"), [(flips, 8), (cuts, 8), (crafted, 3)], ids=str)
def test_faults_hold(campaign, most):
    """Exactly the right numbers, a stated part of them, or one sentence."""
    tally = campaign.run(60.0, np.random.default_rng(0), most)
    assert tally.notes == []
    assert tally.held == tally.tried >= most


@pytest.mark.paper
def test_what_does_not_hold_is_noted(monkeypatch):
    """The campaign can fail: a reader that leaves the last message out in silence is found out."""

    def forgetful(log, topics, **options):
        found = read_streams(log, topics, **options)
        return {topic: stream.take(slice(0, max(len(stream) - 1, 0))) for topic, stream in found.items()}

    sample = damaged_logs.sample

    def honest_sample(*arguments):
        with monkeypatch.context() as patch:
            patch.setattr(damaged_logs, "read_streams", read_streams)
            return sample(*arguments)

    monkeypatch.setattr(damaged_logs, "sample", honest_sample)
    monkeypatch.setattr(damaged_logs, "read_streams", forgetful)
    tally = flips.run(60.0, np.random.default_rng(0), 6)
    assert tally.held < tally.tried
    assert "and nothing says so" in " ".join(tally.notes)
