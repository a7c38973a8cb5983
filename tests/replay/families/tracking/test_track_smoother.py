"""Smoothed tracks: the house's smoother where the association is certain."""

import numpy as np
import pytest

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.models.states import PLANE_MOTION, state_metadata
from fuselog.recorders.recording import SIMULATION_EPOCH_NS
from fuselog.replay.families.tracking.targets import TARGET
from tests.replay.families.tracking.test_tracker import RADAR, SECOND, log, replay, replay_late, sensor
from tests.replay.inference.replays import outputs

MOTION = {"turn_rate_radps": 0.0, "acceleration_sigma_mps2": 0.3}


@pytest.mark.parametrize("targets", [1, 2])
def test_with_certain_association_a_track_is_smoothed_as_its_target_alone(
    uncompiled: None, targets: int
):
    """The first detection is the birth, that of the prior; the others are fixes of 2 m."""
    rng = np.random.default_rng(4)
    times_s = np.cumsum(rng.uniform(0.3, 1.5, 20))
    place = np.stack([3.0 * times_s, 40.0 - times_s], axis=1) + rng.normal(0, 2, (20, 2))
    seen = [[(each[0], each[1] + 500 * k) for k in range(targets)] for each in place]
    radar = sensor("radar", RADAR, times_s, seen)
    tracker = {"association": "hungarian", "smoothed": True}
    found = replay(log(radar), "tracker", **tracker)
    tracks = found["track"].take(found["track"]["track_id"] == 1)
    stamps = radar[0].publish_time_ns
    prior = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        stamps[:1],
        metadata=state_metadata(PLANE_MOTION),
        mean=[[place[0, 0], 0, place[0, 1], 0]],
        covariance=np.diag([4.0, 9.0, 4.0, 9.0]).reshape(1, 16),
    )
    fixes = make_stream(
        "/fix",
        schemas.POSITION_FIX,
        stamps[1:],
        position_m=place[1:],
        covariance_m2=np.tile([4.0, 0, 0, 4.0], (19, 1)),
    )
    alone = outputs(TARGET, "smoother", [log([prior, fixes])])["state"].stream
    rows = np.searchsorted(alone.publish_time_ns, tracks.publish_time_ns)
    assert len(rows) == 17
    np.testing.assert_allclose(tracks["mean"], alone["mean"][rows], rtol=0, atol=1e-9)
    np.testing.assert_allclose(tracks["covariance"], alone["covariance"][rows], rtol=0, atol=1e-9)
    filtered = replay(log(radar), "tracker", association="hungarian")
    for leaf in ("set", "association", "existence"):
        for name, column in filtered[leaf].columns.items():
            np.testing.assert_array_equal(found[leaf][name], column)
    last = found["track"]["track_id"] == 1
    np.testing.assert_array_equal(found["track"]["mean"][last][-1], filtered["track"]["mean"][last][-1])


def test_smoothed_tracks_do_not_go_back_for_late_scans(uncompiled: None):
    source = log(sensor("radar", RADAR, range(3), [[(0.0, 0.0)]] * 3))
    with pytest.raises(BadInput, match="smoothed tracks cannot be combined with --late rewind"):
        replay_late(source, "rewind:1", smoothed=True)


def test_a_log_in_which_nothing_is_tracked(uncompiled: None):
    found = replay(log(sensor("radar", RADAR, range(3), [[], [], []])), smoothed=True)
    assert len(found["track"]) == 0
    assert found["set"]["elements"].tolist() == [0, 0, 0]
    assert found["set"].publish_time_ns[0] == SIMULATION_EPOCH_NS + 0 * SECOND


def test_modes_are_not_smoothed(uncompiled: None):
    source = log(sensor("radar", RADAR, range(3), [[(0.0, 0.0)]] * 3))
    with pytest.raises(BadInput, match="smoothed tracks require a model with one linear motion"):
        replay(source, smoothed=True, model="vehicle", motion=MOTION)
