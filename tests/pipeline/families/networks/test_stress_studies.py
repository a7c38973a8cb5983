"""Networks and robots under stress: what is taken out of a log, and a small run of the study."""

from functools import partial

import numpy as np
import pytest

from fuselog.pipeline.families.networks.cooperative_stress import (
    CooperativeStressOptions,
    _edited,
    _lying,
    _once_in,
    _robots,
    _while_there,
)
from fuselog.pipeline.runs.experiment import load_experiment, run_experiment
from fuselog.pipeline.runs.recorded import record_ensemble
from fuselog.recorders.errors import BadInput

pytestmark = pytest.mark.usefixtures("blank_figures")


@pytest.fixture(scope="module")
def robots():
    parameters = {"robots": 3, "duration_s": 30.0, "robots_see_each_other": True}
    return record_ensemble("landmarks", parameters, 1, 1)[0]


def fellows(source, robot):
    stream = source.streams[f"/robot{robot}/range_bearing"]
    return stream.take(np.flatnonzero(stream["target_id"] <= 3))


def test_two_robots_share_at_most_once_in_an_interval(robots):
    edited = _edited(robots, partial(_once_in, 4.0), [1, 2, 3])
    for robot in (1, 2, 3):
        before, after = fellows(robots, robot), fellows(edited, robot)
        assert 0 < len(after) < len(before)
        for target in np.unique(before["target_id"]):
            stamps = after.publish_time_ns[after["target_id"] == target]
            assert (np.diff(stamps) >= 4e9).all()
            assert stamps[0] == before.publish_time_ns[before["target_id"] == target][0]
        topic = f"/robot{robot}/range_bearing"
        landmarks = [source.streams[topic]["target_id"] > 3 for source in (robots, edited)]
        assert landmarks[0].sum() == landmarks[1].sum()


def test_a_robot_that_leaves_is_not_seen_and_sees_nobody(robots):
    edited = _edited(robots, partial(_while_there, 2), [1, 2, 3])
    seen = [fellows(edited, robot) for robot in (1, 2, 3)]
    times_s = [(each.publish_time_ns - robots.epoch_ns) * 1e-9 for each in seen]
    away = [(each > 10.5) & (each < 19.5) for each in times_s]
    assert not away[1].any()
    assert not (seen[0]["target_id"][away[0]] == 2).any()
    assert (seen[0]["target_id"][~away[0]] == 2).any()
    assert (seen[0]["target_id"][away[0]] == 3).any()


def test_a_robot_lies_about_its_start_and_must_be_there(robots):
    options = CooperativeStressOptions(leaving=2, liar=3, lie_m=2.5)
    moved = _lying(robots, options).streams["/robot3/prior"]["mean"]
    assert moved - robots.streams["/robot3/prior"]["mean"] == pytest.approx(np.array([[2.5, 0, 0]]))
    assert _robots(robots, options) == [1, 2, 3]
    with pytest.raises(BadInput, match=r"options.leaving = 5 is not one of the robots 1, 2, 3"):
        _robots(robots, CooperativeStressOptions())


@pytest.mark.paper
def test_the_room_under_stress(tmp_path):
    name, experiment = load_experiment("ispace-stress", {"runs": 4}, {})
    result = run_experiment(name, experiment, tmp_path / "out", logs=1)
    found = result.metrics
    assert found["ci.nees.calm"] < 5 < 100 < found["naive.nees.calm"]
    assert found["ci.nees.late"] < 5
    assert len(result.claims) == 10
    assert (tmp_path / "out" / "figures" / "bandwidth.svg").exists()
