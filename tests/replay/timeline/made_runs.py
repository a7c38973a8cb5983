"""Runs that are made for families whose own estimators say more than a state, and what these say."""

from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.families.biometrics.models import Matcher, score_stream
from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from tests.replay.timeline.making import logged_late

SECOND = 10**9
PLANE = {"components": "x_m,y_m", "kinds": "linear,linear"}


class MadeRun(NamedTuple):
    """A run, and what estimators say of it."""

    source: MemorySource
    made: list[Stream]


def own(scenario: str, *streams: Stream) -> MemorySource:
    """A run of streams that are made."""
    return logged_late(memory_source(Recording([*streams]), RunMetadata(scenario, epoch_ns=SECOND)))


def sets(rings: list[Any]) -> MadeRun:
    """A set of the first ring, an empty one, and one of the two others, at three seconds."""
    stamps = SECOND * np.arange(1, 4)
    truth = make_stream(
        "/robot1/truth", schemas.TRUTH_STATE, stamps, metadata=PLANE, state=np.ones((3, 2))
    )
    vertices = make_stream(
        "/estimates/one/robot1/set",
        schemas.SET_ESTIMATE,
        np.repeat(stamps[[0, 2, 2]], 4),
        metadata=PLANE,
        ring_id=np.repeat([0, 0, 1], 4),
        vertex=np.concatenate(rings),
    )
    sizes = make_stream(
        "/estimates/one/robot1/size",
        schemas.ESTIMATE_SIZE,
        stamps,
        metadata=PLANE,
        elements=[4, 0, 8],
    )
    marks = make_stream(
        "/landmarks", schemas.LANDMARK, [SECOND], landmark_id=[1], position_m=[[2.0, 2.0]]
    )
    return MadeRun(own("relative-bearings", truth, marks), [vertices, sizes])


def scores(given: Any, arrivals: Any, threshold: str = "3.0") -> MadeRun:
    """Scores (users, users, 2) of two fingers, one probe of each user; their sums are what is fused."""
    matchers = (
        Matcher(name="left", modality="finger", failure=-1.0),
        Matcher(name="right", modality="finger"),
    )
    users = np.arange(len(given))
    fused = make_stream(
        "/estimates/one/finger/score",
        schemas.SCORE_VECTOR,
        np.repeat(arrivals, len(users)),
        metadata={"components": "log_likelihood_ratio", "threshold": threshold},
        probe_id=np.repeat(users, len(users)),
        gallery_id=np.tile(users, len(users)),
        scores=given.sum(axis=2).reshape(-1, 1),
    )
    return MadeRun(own("biometric-scores", score_stream(matchers, given, arrivals)), [fused])


def vessels(stamps: Any, numbers: Any, tracks: Any, places: Any, degrees: Any) -> MadeRun:
    """Reports of vessels by number, in a plane and on Earth (n, 2), and the tracks given to them."""
    rows = len(stamps)
    source = own(
        "ais",
        make_stream(
            "/reports",
            schemas.COURSE_FIX,
            stamps,
            position_m=places,
            course_rad=np.zeros(rows),
            speed_mps=np.ones(rows),
        ),
        make_stream("/identity", schemas.IDENTITY, stamps, thing_id=numbers),
        make_stream(
            "/geodetic",
            schemas.GEODETIC_FIX,
            stamps,
            latitude_deg=degrees[:, 0],
            longitude_deg=degrees[:, 1],
            altitude_m=np.zeros(rows),
        ),
    )
    return MadeRun(source, [track_stream("one", stamps, tracks, places)])


def track_stream(name: str, stamps: Any, numbers: Any, means: Any, told: Any = PLANE) -> Stream:
    """What a tracker says of tracks by number: states (n, k), all known to the same."""
    size = means.shape[1]
    return make_stream(
        f"/estimates/{name}/track",
        schemas.TRACK_ESTIMATE,
        stamps,
        metadata=told,
        track_id=numbers,
        mean=means,
        covariance=np.tile(np.eye(size).ravel(), (len(means), 1)),
    )


def samples(places: Any, weights: Any) -> MadeRun:
    """Weighted samples (n, 2) of a Gaussian."""
    made = make_stream(
        "/estimates/one/sample",
        schemas.DENSITY_ESTIMATE,
        [SECOND] * len(places),
        metadata=PLANE,
        weight=weights,
        mean=places,
        covariance=np.zeros((len(places), 4)),
    )
    source = MemorySource({}, RunMetadata("lcd-sampling", epoch_ns=SECOND), "samples")
    return MadeRun(source, [made])
