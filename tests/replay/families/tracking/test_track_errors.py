"""Tracks judged at instants: the sheet's check without a tracker; what is followed, switched, broken."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest

from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.recorders.models.states import PLANE_MOTION, state_metadata
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.families.tracking.judging.errors import (
    SOME_ARE_KNOWN,
    UNREFERENCED_M,
    TracksAt,
    as_trajectories,
    instants_of,
    track_errors,
    track_figures,
    tracks_at,
)
from fuselog.replay.judging.judge import Judge

# By scenario: instants; of the radar GOSPA of all, G50, unreferenced; of the lidar the first two.
SHEET = {
    2: (216, 29.485838, 12.099938, 4.370370, 13.726466, 13.496173),
    3: (241, 30.867881, 17.607442, 3.406639, 17.970020, 17.865041),
    5: (258, 31.278400, 18.981872, 3.325581, 17.527516, 17.278602),
    13: (214, 17.283432, 11.700544, 0.864486, 11.506414, 11.293939),
    16: (218, 22.524523, 10.789246, 1.977064, 12.290916, 12.199762),
    22: (149, 29.536414, 15.465166, 3.422819, 15.312036, 13.764257),
}


def last_scans(streams: Mapping[str, Stream], sensor: str, at_ns: np.ndarray) -> list[TracksAt]:
    """The world's places of the last scan of a sensor at each instant, numbered as they come."""
    scan, seen = streams[f"/{sensor}/scan"], streams[f"/{sensor}/detection"]
    fix = streams["/ownship/fix"]
    own = dict(zip(fix.publish_time_ns.tolist(), fix["position_m"], strict=True))
    found = []
    for time_ns in at_ns:
        before = np.where(scan.publish_time_ns <= time_ns, scan.publish_time_ns, -1)
        row = int(before.argmax())
        place = seen["position_m"][seen["scan_id"] == scan["scan_id"][row]]
        found.append(TracksAt(np.arange(len(place)), place + own[int(scan.publish_time_ns[row])]))
    return found


@pytest.mark.paper
@pytest.mark.parametrize("scenario", SHEET)
def test_the_sheets_check_without_a_tracker(autoferry_log: Callable[[int], MemorySource], scenario: int):
    source = autoferry_log(scenario)
    at_ns, true, limit_m = instants_of(source)
    assert limit_m == UNREFERENCED_M
    radar, lidar = (
        track_errors(last_scans(source.streams, sensor, at_ns), true, unreferenced_m=limit_m)
        for sensor in ("radar", "lidar")
    )
    found = track_figures(radar)
    assert SHEET[scenario] == pytest.approx(
        (
            len(at_ns),
            found["gospa_all_m"],
            found["gospa_m"],
            found["unreferenced_targets"],
            track_figures(lidar)["gospa_all_m"],
            track_figures(lidar)["gospa_m"],
        ),
        abs=1e-6,
    )
    if scenario == 2:
        names = "missed_targets", "false_targets", "target1_rmse_m", "target2_rmse_m"
        parts = [0.087963, 0.087963, 7.006923, 9.090370]
        assert [found[name] for name in names] == pytest.approx(parts, abs=1e-6)
        # the sheet reckons with stamps of 1e9 s as doubles, which are good to 2e-7 s
        assert found["localisation_m2"] == pytest.approx(126.947289, abs=5e-6)


def test_switches_breaks_and_what_has_no_reference():
    """One target stands at the origin, another comes at the end; track 7 is lost and returns as 8."""
    still = np.zeros((1, 5, 2))
    late = np.full((1, 5, 2), np.nan)
    late[0, 4] = (100, 0)
    tracks = [
        TracksAt(np.array([7, 9]), np.array([[3.0, 4.0], [0.0, 60.0]])),
        TracksAt(np.empty(0, np.int64), np.empty((0, 2))),
        TracksAt(np.array([7]), np.array([[0.0, 25.0]])),
        TracksAt(np.array([8]), np.array([[0.0, 0.0]])),
        TracksAt(np.array([8, 7]), np.array([[100.0, 3.0], [0.0, 0.0]])),
    ]
    errors = track_errors(tracks, np.concatenate([still, late]), unreferenced_m=UNREFERENCED_M)
    assert errors.unreferenced is not None
    assert errors.track.tolist() == [[7, -1, -1, 8, 7], [-1, -1, -1, -1, 8]]
    assert errors.unreferenced.tolist() == [1, 0, 0, 0, 0]
    assert errors.gospa_all[0] == pytest.approx(np.sqrt(25 + 200))
    assert errors.gospa.tolist() == pytest.approx([5, np.sqrt(200), 20, 0, 3])
    figures = track_figures(errors)
    assert (figures["switches"], figures["breaks"]) == (2, 1)
    assert figures["target1_coverage"] == 0.6
    assert figures["target1_rmse_m"] == pytest.approx(np.sqrt(25 / 3))
    assert (figures["target2_coverage"], figures["target2_rmse_m"]) == (1, 3)
    assert (figures["missed_targets"], figures["false_targets"]) == (0.4, 0.2)
    assert np.isfinite(as_trajectories(tracks)[:, :, 0]).sum(axis=1).tolist() == [3, 2, 1]


def test_what_is_told_later_is_predicted_for_longer():
    """A track at 2 m/s, told every second; at 3.5 s with a delay of 1 s the one of 2 s is known.

    One that has no velocity stays where it is.
    """
    seconds = np.arange(5)
    sizes = make_stream("/set", schemas.ESTIMATE_SIZE, seconds * 10**9, elements=np.ones(5, np.int64))
    tracks = make_stream(
        "/track",
        schemas.TRACK_ESTIMATE,
        seconds * 10**9,
        metadata=state_metadata(PLANE_MOTION),
        track_id=np.ones(5, np.int64),
        mean=np.stack([seconds**2, np.full(5, 2.0), 0.0 * seconds, np.zeros(5)], axis=1),
        covariance=np.zeros((5, 16)),
    )
    at_ns = np.array([3_500_000_000])
    for delay_s, x_m in ((0.0, 9.0 + 1.0), (1.0, 4.0 + 3.0)):
        [told] = tracks_at(sizes, tracks, at_ns, round(delay_s * 1e9))
        assert told.place.tolist() == [[x_m, 0.0]]
    assert len(tracks_at(sizes, tracks, at_ns, 4 * 10**9)[0].number) == 0
    still = make_stream(
        "/track",
        schemas.TRACK_ESTIMATE,
        tracks.publish_time_ns,
        metadata=state_metadata(PLANE_MOTION[:1] + PLANE_MOTION[2:3]),
        track_id=tracks["track_id"],
        mean=tracks["mean"][:, [0, 2]],
        covariance=np.zeros((5, 4)),
    )
    assert tracks_at(sizes, still, at_ns)[0].place.tolist() == [[9.0, 0.0]]


@pytest.mark.parametrize("covers", [{}, {"covers": "some targets"}])
def test_a_replay_is_judged_wherever_there_are_truths_and_tracks(covers: dict[str, str]) -> None:
    """In blocks as whole; of targets only while they are there, of tracks from the first set told on.

    The first target is there all the time, the second from 20 s on and 3 m beside its track; the number
    of the first one's track changes at 30 s. A set is told every second, from the first second on.
    """
    names = ("x_m", "y_m", "vx_mps", "vy_mps")
    stamps = np.arange(0, 41, 1) * 1_000_000_000
    truths = [
        make_stream(
            f"/target{number}/truth",
            schemas.TRUTH_STATE,
            stamps[begin:],
            metadata=state_metadata(names[:2]) | covers,
            state=np.stack([stamps[begin:] * 1e-9, np.full(41 - begin, 100.0 * number)], axis=1),
        )
        for number, begin in ((1, 0), (2, 20))
    ]
    source = MemorySource({each.topic: each for each in truths}, RunMetadata("own", epoch_ns=0), "own")
    told_ns = stamps[1:]
    sizes = make_stream("/estimates/t/set", schemas.ESTIMATE_SIZE, told_ns, elements=np.full(40, 2))
    mean = np.zeros((40, 2, 4))
    mean[..., 0], mean[..., 2] = told_ns[:, None] * 1e-9, 1.0
    mean[:, 0, 1], mean[:, 1, 1] = 100.0, 203.0
    number = np.tile([1, 2], (40, 1))
    number[30:, 0] = 7
    tracks = make_stream(
        "/estimates/t/track",
        schemas.TRACK_ESTIMATE,
        np.repeat(told_ns, 2),
        metadata=state_metadata(names),
        track_id=number.ravel(),
        mean=mean.reshape(80, 4),
        covariance=np.tile(np.eye(4).ravel(), (80, 1)),
    )
    found = {}
    for blocks in (1, 4):
        judge = Judge([source], gap_limit_s=0.2)
        for sets in np.array_split(np.arange(40), blocks):
            rows = slice(2 * sets[0], 2 * sets[-1] + 2)
            now = sizes.take(slice(sets[0], sets[-1] + 1)), tracks.take(rows)
            judge.add({each.topic: gather([each]) for each in now})
        found[blocks] = judge.metrics
        assert (SOME_ARE_KNOWN in judge.notes_of_coverage) == bool(covers)
    assert found[1] == found[4]
    figures = {key.removeprefix("t."): value for key, value in found[1].items()}
    # judged from 10 to 40 s, twice a second: 61 instants, of which 41 have both targets
    assert figures["missed_targets"] == figures["breaks"] == 0.0
    assert figures["followed_share"] == 1.0
    assert figures["followed_rmse_m"] == pytest.approx(np.sqrt(9.0 * 41 / 102))
    assert figures["switches"] == 1.0
    followed = 2 * (42 + 41) / (102 + 61 + 61)  # each track is near a target at some instant
    if covers:
        assert (figures["false_targets"], figures["unreferenced_targets"]) == (
            0.0,
            pytest.approx(20 / 61),
        )
        assert figures["referenced_idf1"] == pytest.approx(followed)
        assert figures["gospa_m"] == pytest.approx(3.0 * 41 / 61)
        assert figures["gospa_all_m"] > figures["gospa_m"]
    else:
        assert figures["false_targets"] == pytest.approx(20 / 61)
        assert figures["idf1"] == pytest.approx(followed)
        assert figures["gospa_m"] == pytest.approx((3.0 * 41 + np.sqrt(200) * 20) / 61)
        assert not {"gospa_all_m", "unreferenced_targets", "referenced_idf1"} & set(figures)
