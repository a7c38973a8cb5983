"""Units of several grades while a receiver is silent: which errors count, what so many drives show."""

import numpy as np
import pytest

from fuselog.pipeline.output.claims import decide
from fuselog.pipeline.runs.experiment import load_experiment
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.studies.navigation.imu_grades import Span, horizontal, outage_of
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.errors.evaluation import Errors


@pytest.mark.parametrize("count", [0, 1, 2])
def test_the_study_is_of_one_outage(count: int) -> None:
    spans = [[10.0 * k, 10.0 * k + 5.0] for k in range(1, count + 1)]
    run = RunMetadata("navigation", epoch_ns=0, parameters={"gnss": {"outages_s": spans}})
    source = MemorySource({}, run, "drive")
    if count == 1:
        assert outage_of(source) == Span(10.0, 15.0)
    else:
        with pytest.raises(BadInput, match=f"{count} outages; give exactly one"):
            outage_of(source)


def test_errors_count_in_the_outage_alone():
    """In the plane, from the last fix on and before the next one."""
    elapsed_s = np.array([49.8, 50.0, 50.5, 79.5, 80.0])
    error = np.array(
        [[1.0, 9.0, 0.0], [3.0, 9.0, 4.0], [6.0, 9.0, 8.0], [0.3, 9.0, 0.4], [1.0, 9.0, 0.0]]
    )
    none = np.zeros(5, np.int64)
    errors = Errors(
        "ekf",
        "body",
        ("x_m", "z_m", "y_m"),
        ("linear",) * 3,
        none,
        none,
        none,
        elapsed_s,
        error,
        np.empty((5, 3, 3)),
        np.empty(5),
        0,
        (),
    )
    found = horizontal(errors, Span(50.0, 80.0))
    assert found["after_s"].tolist() == [0.0, 0.5, 29.5]
    assert found["error_m"].tolist() == pytest.approx([5.0, 10.0, 0.5])


@pytest.mark.parametrize(
    ("largest_m", "runs", "verdict"),
    [
        (0.9, 59, "confirmed"),
        (1.1, 59, "refuted"),  # one beyond it
        (0.9, 58, "inconclusive"),  # too few to show anything
    ],
)
def test_a_limit_is_held_where_no_drive_of_enough_is_beyond_it(largest_m, runs, verdict):
    _, experiment = load_experiment("imu-grades", {}, {})
    metrics = {"ekf.horizontal_95_m.tactical-30s": largest_m}
    claims = decide(experiment.claims, metrics, {}, {"runs": runs})
    [found] = [each for each in claims if each.claim.startswith("tactical: 30 s after")]
    assert found.verdict == verdict


@pytest.mark.paper
@pytest.mark.parametrize(
    ("outages_s", "sentence"),
    [
        ("[]", "0 outages; give exactly one"),
        ("[[8, 11]]", "no estimate 10 s after the start of the outage; use a longer outage"),
    ],
)
def test_a_drive_without_a_long_outage_is_refused(outages_s, sentence, fuselog, tmp_path, monkeypatch):
    monkeypatch.setattr(Runner, "draw", lambda *_, **__: None)  # nothing of a refused run is seen
    command = [
        "run",
        "imu-grades",
        "--out",
        str(tmp_path / "out"),
        "--set",
        f"gnss.outages_s={outages_s}",
    ]
    assert sentence in fuselog(*command, "--set", "duration_s=12.0", "--set", "runs=1").err
    assert not (tmp_path / "out").exists()
