"""Runs of families whose own estimators say more than a state, with all that these may say."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from recorders.log import Stream, make_stream, schemas
from recorders.models.states import PLANE_MOTION, state_metadata
from recorders.recording import SIMULATION_EPOCH_NS
from replay.engine.streams.sources import MemorySource
from tests.replay.estimators.test_tracker import CAMERA, RADAR, log, sensor
from tests.replay.timeline.made_runs import (
    PLANE,
    SECOND,
    own,
    samples,
    scores,
    sets,
    track_stream,
    vessels,
)
from tests.replay.timeline.making import estimate, logged_late, record

ROWS = np.arange(4)


def boards() -> Iterator[tuple[str, MemorySource, list[Stream]]]:
    """Title, run, and what estimators say of it."""
    ring = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
    yield "sets", *sets([ring, ring + 1.0, 2.0 + 0.25 * ring[::-1]])
    rng = np.random.default_rng(1)
    given = rng.uniform(0.0, 1.0, (70, 70, 2)) + 0.9 * np.eye(70)[:, :, None]
    yield "fused scores", *scores(given, SECOND * np.arange(1, 71))
    stamps, places = SECOND * np.array([1, 10, 20, 900]), np.stack([10.0 * ROWS, -5.0 * ROWS], axis=1)
    degrees = np.stack([50.0 + 1e-4 * ROWS, -1.0 - 2e-4 * ROWS], axis=1)
    reported = vessels(stamps, [7, 8, 7, 8], [1, 2, 1, 3], places, degrees)
    yield "vessels", *reported
    yield "vessels without tracks", reported.source, []
    yield "samples", *samples(places, np.array([1.2, 0.3, -0.5, 1.0]))
    yield "a network that shares", *_sharing()
    yield "tracks", *_tracked()
    yield "events", *_events()


def _sharing() -> tuple[MemorySource, list[Stream]]:
    """Two estimators of a network's node, the second of which sends what it knows."""
    source = record("ispace", steps=4)
    made = [estimate(name, "node1", source.streams["/truth"]) for name in ("one", "two")]
    sent = estimate("two", "node1", source.streams["/truth"])
    del sent.metadata["truth"]
    topic = "/estimates/two/node1/sent"
    columns = {"mean": sent["mean"], "covariance": sent["covariance"]}
    return source, [
        *made,
        make_stream(topic, sent.schema, sent.publish_time_ns, metadata=sent.metadata, **columns),
    ]


def _tracked() -> tuple[MemorySource, list[Stream]]:
    """A target that two sensors on a ship see; its first track ends, and another goes on with it."""
    seconds = np.arange(12)
    stamps = SIMULATION_EPOCH_NS + seconds * SECOND
    ship = np.stack([10.0 + seconds, -0.5 * seconds], axis=1)
    target = np.stack([2.0 * seconds, np.full(12, 100.0)], axis=1)
    away = target - ship
    streams = [
        make_stream("/vessel/truth", schemas.TRUTH_STATE, stamps, metadata=PLANE, state=target),
        make_stream(
            "/ship/fix",
            schemas.POSITION_FIX,
            stamps,
            metadata=PLANE,
            position_m=ship,
            covariance_m2=np.full((12, 4), np.nan),
        ),
    ]
    stated = {"origin": "/ship/fix"}
    joined = RADAR | stated | {"joined_within_m": "12.0"}
    seen = [[(60.0, -60.0), (x - 3.0, y), (x + 3.0, y)] for x, y in away.tolist()]
    bearings = [[np.arctan2(y, x)] for x, y in away]
    source = logged_late(
        log(
            streams,
            sensor("radar", joined, seconds, seen),
            sensor("camera", CAMERA | stated, seconds, bearings),
            scenario="autoferry",
        )
    )
    rows = np.array([1, 2, 3, 4, 7, 8, 9, 10, 11])
    numbers = np.where(rows < 6, 1, 4)
    made = []
    for name in ("one", "two"):
        stem = f"/estimates/{name}"
        states = np.zeros((len(rows), 4))
        states[:, [0, 2]] = target[rows] + 0.25 * numbers[:, None]
        tracks = track_stream(name, stamps[rows], numbers, states, state_metadata(PLANE_MOTION))
        held = np.isin(seconds, rows)
        made += [
            tracks,
            make_stream(
                f"{stem}/set", schemas.ESTIMATE_SIZE, stamps, metadata=tracks.metadata, elements=held
            ),
            make_stream(
                f"{stem}/existence", schemas.EXISTENCE, stamps[rows], existence=0.5 + rows / 25.0
            ),
            make_stream(
                f"{stem}/association",
                schemas.ASSOCIATION,
                stamps[rows],
                metadata={"sensors": "camera,radar"},
                track_id=numbers,
                sensor_id=np.ones(len(rows), int),
                scan_id=rows,
                detection=np.ones(len(rows), int),
                probability=1.0 - rows / 25.0,
            ),
        ]
    return source, made


def _events() -> tuple[MemorySource, list[Stream]]:
    """All that may happen to an estimator, once."""
    stamps = SECOND * np.arange(1, 5)
    truth = make_stream("/truth", schemas.TRUTH_STATE, stamps, metadata=PLANE, state=np.eye(4)[:, :2])
    made = [estimate("one", "", truth), _cloud(stamps[1:3])]
    reasons = {"reasons": '["for this reason"]'}
    kinds = (schemas.STARTED, schemas.DIAGNOSED, schemas.SKIPPED, schemas.FAILURE)
    for stamp, schema in zip(stamps, kinds, strict=True):
        topic = f"/estimates/one/{schema.name.lower()}"
        made.append(make_stream(topic, schema, [stamp], metadata=reasons, reason=[0]))
    late = {"log_time_ns": stamps[1:2] + SECOND // 4}
    made += [
        make_stream("/estimates/one/rewound", schemas.REWOUND, stamps[1:2], **late, repeated=[3]),
        make_stream("/estimates/one/waited", schemas.WAITED, stamps[2:3], behind_s=[0.125]),
        make_stream(
            "/estimates/one/fault",
            schemas.RELATIVE_BEARING,
            stamps[3:],
            first_id=[1],
            second_id=[2],
            angle_rad=[0.5],
        ),
    ]
    return own("unheard-of", truth), made


def _cloud(stamps: NDArray[np.int64]) -> Stream:
    """Three particles at each stamp."""
    rows = 3 * len(stamps)
    return make_stream(
        "/estimates/one/particle",
        schemas.DENSITY_ESTIMATE,
        np.repeat(stamps, 3),
        metadata=PLANE,
        weight=np.tile([0.5, 0.25, 0.25], len(stamps)),
        mean=np.arange(2.0 * rows).reshape(rows, 2),
        covariance=np.zeros((rows, 4)),
    )
