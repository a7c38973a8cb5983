"""Position fixes, in the plane and on the ellipsoid, as sensors of any model that has a position."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.models.geodesy import earth_centred, out_of_tangent_plane
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.geodetic import in_plane
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.model.binding import topics_of
from fuselog.replay.inference.model.model import Model, Motion
from fuselog.replay.inference.model.parameters import ModelParameters
from tests.replay.inference.replays import bound, outputs

Floats = NDArray[np.float64]
EPOCH_NS = 10**9
STAMPS = EPOCH_NS + 10**9 * np.arange(1, 7)
# A place in the north, so that the axes of the tangent plane turn soon.
ORIGIN = 60.0, 10.0
STATED = {"origin_latitude_deg": "60.0", "origin_longitude_deg": "10.0"}


def stay(state: Any, *_: Any) -> Any:
    return state


def drift(state: Any, duration_s: Any, parameters: Any) -> Any:
    return tuple(duration_s for _ in state)


def wandering(*names: str) -> Model:
    """A thing that wanders; its author wrote no measurement function."""
    state = dict.fromkeys(names, "linear")
    return Model("a wanderer", state, ModelParameters, (), Motion(stay, drift, linear=True))


PLANE, SPACE = wandering("speed_mps", "y_m", "x_m"), wandering("x_m", "y_m", "z_m")


def log(model: Model, *streams: Stream) -> MemorySource:
    n = model.size
    prior = make_stream(
        "/prior",
        schemas.GAUSSIAN_ESTIMATE,
        [EPOCH_NS],
        metadata={"components": ",".join(model.state)},
        mean=np.zeros((1, n)),
        covariance=(1e4 * np.eye(n)).reshape(1, n * n),
    )
    run = RunMetadata(scenario="wanderer", epoch_ns=EPOCH_NS)
    return memory_source(Recording([prior, *streams]), run)


def fixes(position: Floats, covariance: Floats) -> Stream:
    return make_stream(
        "/fix", schemas.POSITION_FIX, STAMPS, position_m=position, covariance_m2=covariance
    )


def geodetic(place: Floats, covariance: Floats, stated: dict[str, str] = STATED) -> Stream:
    """Places (n, 3): latitude, longitude, altitude."""
    return make_stream(
        "/fix",
        schemas.GEODETIC_FIX,
        STAMPS,
        metadata=stated,
        latitude_deg=place[:, 0],
        longitude_deg=place[:, 1],
        altitude_m=place[:, 2],
        covariance_m2=covariance,
    )


def places(seed: int = 3) -> tuple[Floats, Floats]:
    """Places in the plane (n, 2), and the same as latitude, longitude and altitude (n, 3)."""
    plane = np.random.default_rng(seed).normal(scale=300.0, size=(len(STAMPS), 2))
    return plane, np.stack(out_of_tangent_plane(plane.T, ORIGIN), axis=1)


def full(seed: int, size: int, scale: float = 1.0) -> Floats:
    """Covariances (n, size, size)."""
    lower = np.random.default_rng(seed).normal(size=(len(STAMPS), size, size))
    return scale * lower @ lower.transpose(0, 2, 1)


def kalman(model: Model, value: Floats, covariance: Floats, names: list[str]) -> Floats:
    """The textbook's last mean: a random walk with measurements of some components."""
    mean, spread = np.zeros(model.size), 1e4 * np.eye(model.size)
    h = np.eye(model.size)[[list(model.state).index(name) for name in names]]
    for z, r in zip(value, covariance, strict=True):
        spread = spread + np.eye(model.size)
        gain = spread @ h.T @ np.linalg.inv(h @ spread @ h.T + r)
        mean, spread = mean + gain @ (z - h @ mean), spread - gain @ h @ spread
    return mean


@pytest.mark.parametrize("shape", ["full", "diagonal"])
def test_a_model_with_a_position_takes_fixes_with_their_own_covariance(
    uncompiled: None, shape: str
) -> None:
    """In the plane and in space, of models in either, whatever the order of the state."""
    spread = full(1, 3)
    if shape == "diagonal":
        spread = spread * np.eye(3)
    value = np.random.default_rng(2).normal(scale=10.0, size=(len(STAMPS), 3))

    def told(size: int) -> Floats:
        own = spread[:, :size, :size]
        return own.reshape(len(own), -1) if shape == "full" else np.diagonal(own, axis1=1, axis2=2)

    for model, size, used in ((PLANE, 2, 2), (PLANE, 3, 2), (SPACE, 3, 3), (SPACE, 2, 2)):
        source = log(model, fixes(value[:, :size], told(size)))
        found = outputs(model, "ekf", [source])["state"]["mean"][-1]
        names = ["x_m", "y_m", "z_m"][:used]
        wanted = kalman(model, value[:, :used], spread[:, :used, :used], names)
        assert_allclose(found, wanted, rtol=1e-9)


def test_latitude_and_longitude_are_a_position_through_the_origin(uncompiled: None) -> None:
    plane, place = places()
    spread = np.full((len(STAMPS), 3), 4.0)
    found = outputs(PLANE, "ekf", [log(PLANE, geodetic(place, spread))])
    wanted = outputs(PLANE, "ekf", [log(PLANE, fixes(plane, spread[:, :2]))])
    assert "started" not in found
    assert_allclose(found["state"]["mean"], wanted["state"]["mean"], atol=1e-6)
    assert np.abs(found["state"]["mean"][-1, 1:]).max() > 50.0
    without_height = place.copy()
    without_height[:, 2] = np.nan
    alone = outputs(SPACE, "ekf", [log(SPACE, geodetic(without_height, spread))])["state"]
    assert_array_equal(alone["mean"][:, 2], 0.0)
    assert (alone["covariance"][:, 8] > 1e4).all()


def test_covariances_turn_with_the_axes() -> None:
    """At 100 km: axes by differences of earth-centred places along east, north and up."""
    place, spread = np.tile([60.5, 11.5, 200.0], (len(STAMPS), 1)), full(5, 3)

    def axes(latitude: float, longitude: float, altitude: float) -> Floats:
        at = np.array([latitude, longitude, altitude])
        steps = np.array([[0.0, 1e-5, 0.0], [1e-5, 0.0, 0.0], [0.0, 0.0, 1.0]])
        along = [np.subtract(earth_centred(*(at + s)), earth_centred(*(at - s))) for s in steps]
        return np.array([each / np.linalg.norm(each) for each in along])

    turn = axes(*ORIGIN, 0.0) @ axes(60.5, 11.5, 200.0).T
    wanted = turn @ spread @ turn.T
    origins = np.array([[*ORIGIN, 0.0]])
    for stated, size in ((spread, 3), (spread[:, :2, :2], 2)):
        fix = gather([geodetic(place, stated.reshape(len(stated), -1))])
        found = in_plane(fix, origins)["covariance_m2"].reshape(-1, 3, 3)
        if size == 3:
            assert_allclose(found, wanted, rtol=1e-6, atol=1e-6)
            assert np.abs(found - spread).max() > 0.02
        else:
            flat = turn[:2, :2] @ stated @ turn[:2, :2].T
            assert_allclose(found[:, :2, :2], flat, rtol=1e-6, atol=1e-6)
            assert np.isnan(found[:, 2]).all()


def test_an_origin_that_no_channel_states_is_the_first_fix_and_is_told(uncompiled: None) -> None:
    _, place = places()
    spread = np.tile([1.0, 1.0], (len(STAMPS), 1))
    found = outputs(PLANE, "ekf", [log(PLANE, geodetic(place, spread, {}))])
    assert sentences_of(found["started"].stream) == [
        "no channel states the origin of the plane: the first fix of /fix is used"
    ]
    origin = found["origin"].stream
    assert (origin["latitude_deg"][0], origin["longitude_deg"][0]) == tuple(place[0, :2])
    names = "origin_latitude_deg", "origin_longitude_deg", "origin_altitude_m"
    stated = dict(zip(names, map(repr, place[0].tolist()), strict=True))
    wanted = outputs(PLANE, "ekf", [log(PLANE, geodetic(place, spread, stated))])
    assert_array_equal(found["state"]["mean"], wanted["state"]["mean"])


def test_two_origins_are_refused() -> None:
    _, place = places()
    other = make_stream(
        "/reference",
        schemas.TRUTH_STATE,
        STAMPS[:1],
        metadata={"components": "x_m", **STATED, "origin_longitude_deg": "10.5"},
        state=[[0.0]],
    )
    source = log(PLANE, geodetic(place, np.ones((6, 2))), other)
    with pytest.raises(
        BadInput, match=r"/fix and /reference state different origins .*60, 10, 0 and 60"
    ):
        bound(PLANE, "ekf", [source])
    half = log(PLANE, geodetic(place, np.ones((6, 2)), {"origin_latitude_deg": "60.0"}))
    with pytest.raises(BadInput, match="topic /fix does not state origin_longitude_deg"):
        bound(PLANE, "ekf", [half])


@pytest.mark.parametrize("unknown", [0.0, np.nan])
def test_a_fix_without_a_covariance_needs_a_sigma(uncompiled: None, unknown: float) -> None:
    """Zeros are as good as none: nothing is known so well."""
    plane, place = places()
    spread = np.tile([4.0, 0.0, 0.0, 4.0], (len(STAMPS), 1))
    spread[2:4] = unknown
    for fix in (fixes(plane, spread), geodetic(place, spread)):
        found = outputs(PLANE, "ekf", [log(PLANE, fix)])
        said = "topic /fix: covariance_m2 is missing; give --set sigma_fix_m=..."
        assert sentences_of(found["skipped"].stream) == [said, said]
        assert_array_equal(found["state"].stream.publish_time_ns, np.delete(STAMPS, [2, 3]))
        given = outputs(PLANE, "ekf", [log(PLANE, fix)], sigma_fix_m=2.0)
        assert len(given["skipped"]) == 0
        assert len(given["state"]) == len(STAMPS)


def test_a_topic_may_stand_for_another(uncompiled: None) -> None:
    plane, _ = places()
    fix = fixes(plane, np.ones((6, 2)))
    elsewhere = make_stream("/gps/place", schemas.POSITION_FIX, STAMPS, **{
        name: column for name, column in fix.columns.items() if name != "sensor_time_ns"
    })  # fmt: skip
    wanted = outputs(PLANE, "ekf", [log(PLANE, fix)])["state"]["mean"]
    source = log(PLANE, elsewhere)
    found = outputs(PLANE, "ekf", [source], topics={"fix": "/gps/place"})["state"]["mean"]
    assert_array_equal(found, wanted)
    assert bound(PLANE, "ekf", [source]) == []
    for names, words in (
        ({"fixx": "/gps/place"}, "topics.fixx: no model has a topic of this name; did you mean 'fix'"),
        ({"fix": "/gps/plaec"}, "topics.fix = /gps/plaec: the log has no such topic; did you mean"),
    ):
        with pytest.raises(BadInput, match=words):
            bound(PLANE, "ekf", [source], topics=names)
    assert bound(PLANE, "ekf", [log(PLANE, fix)], topics={"fix": ""}) == []


def test_what_nothing_drives_is_one_thing_unless_something_is_there_twice() -> None:
    """A prior beside a receiver's namespace; with a second receiver nobody knows whose is whose."""
    spread = np.ones((6, 2))
    fix = fixes(np.zeros((6, 2)), spread)
    first, second = (replace(fix, topic=f"/{name}/fix") for name in ("gps", "radar"))
    [found] = topics_of(PLANE, log(PLANE, first).topics)
    assert (found.prefix, [topic.name for _, topic in found.sensors]) == ("", ["/gps/fix"])
    assert topics_of(PLANE, log(PLANE, first, second).topics) == []
    [chosen] = topics_of(PLANE, log(PLANE, first, second).topics, {"fix": "/radar/fix"})
    assert [topic.name for _, topic in chosen.sensors] == ["/radar/fix"]
