"""The gate at its bound: a measurement whose NIS is just that is let in, the next larger one is not."""

import numpy as np
import pytest

from fuselog.replay.inference.run import filtering
from tests.replay.inference.replays import outputs
from tests.replay.inference.scalar import SCALAR, source

LAST = 4


@pytest.mark.paper
@pytest.mark.parametrize("method", ["ekf", "ukf", "iekf", "particles"])
def test_what_is_at_the_bound_is_let_in(
    method: str, uncompiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of five measurements the last one lies farthest off, and the gate is at its NIS."""
    log = source([0.5, -0.2, 0.4, 0.1, 3.0])
    count = {"particles": 100} if method == "particles" else {}
    squared = outputs(SCALAR, method, [log], gate_probability=1.0, **count)["innovation"]
    nis = squared["normalised_innovation_squared"]
    assert nis.argmax() == LAST
    for bound, accepted_likelihood in ((nis[LAST], 1), (np.nextafter(nis[LAST], 0.0), 0)):
        monkeypatch.setattr(filtering, "_nis_bounds", lambda *_, at=bound: np.array([np.inf, at]))
        found = outputs(SCALAR, method, [log], gate_probability=0.9, **count)["innovation"]
        assert found["normalised_innovation_squared"][LAST] == nis[LAST]
        assert found["accepted"].tolist() == [1, 1, 1, 1, accepted_likelihood]
