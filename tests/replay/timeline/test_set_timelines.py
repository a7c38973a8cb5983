"""The timelines of sets and networks: what their files hold against what was recorded and estimated."""

import numpy as np
import pytest

from fuselog.recorders.log import schemas
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.families.networks.timeline import ARRIVED, LOST
from fuselog.replay.families.sets.judging.regions import areas_of, rings_of
from fuselog.replay.judging.judge import Judge
from fuselog.replay.timeline.show import show
from tests.replay.timeline.test_timeline import read, told


def drawn(scenario, parameters, estimators, folder):
    source = memory_source(*record_run(scenario, parameters, 1))
    outputs = collect(replay([source], [b for name in estimators for b in bind(name, [source], {})]))
    errors = Judge([source], {}, gap_limit_s=0.2).add(outputs).errors
    path = folder / "run.rrd"
    show(source, outputs, [each for each in errors if each is not None], save=path)
    return source, outputs, read(path)


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    rules = ["network:ci-trace", "network:alone"]
    parameters = {"steps": 30}
    return drawn("ispace", parameters, rules, tmp_path_factory.mktemp("net"))


def test_every_message_is_a_line_and_lost_ones_are_red_and_end_half_way(network):
    source, _, found = network
    links = source.streams["/links"]
    messages = found["/map/graph/messages"]
    strips = np.array([strip for row in messages["LineStrips2D:strips"] for strip in row])
    colours = np.array([colour for row in messages["LineStrips2D:colors"] for colour in row])
    lost = links["lost"] > 0
    ends = [links[side].astype(int) for side in ("sender_id", "receiver_id")]
    assert len(strips) == len(lost)
    red, green = (int.from_bytes(bytes(colour), "big") for colour in (LOST, ARRIVED))
    assert np.array_equal(colours, np.where(lost, red, green))
    length = np.linalg.norm(strips[:, 1] - strips[:, 0], axis=1)
    sides = np.where(np.abs(np.subtract(*ends)) == 2, 2.0, np.sqrt(2.0))
    np.testing.assert_allclose(length, np.where(lost, 0.45, 0.9) * sides, rtol=1e-5)


def test_the_events_name_the_lost_messages_of_every_time(network):
    source, _, found = network
    links = source.streams["/links"]
    texts = told(found["/events/links"])
    assert len(texts) == 30
    for time_ns, text in zip(np.unique(links.publish_time_ns), texts, strict=True):
        rows = (links.publish_time_ns == time_ns) & (links["lost"] > 0)
        pairs = zip(links["sender_id"][rows], links["receiver_id"][rows], strict=True)
        named = [f"{sender}>{receiver}" for sender, receiver in pairs]
        assert text.startswith("10 messages sent")
        assert all(name in text for name in named[:8])
        assert ("lost" in text) == bool(named)


def test_every_node_has_its_nees_and_an_ellipse_around_its_error(network):
    _, outputs, found = network
    for node in range(1, 5):
        case = f"node{node}"
        assert len(found[f"/plots/{case}/nees_4/bounds"]["Measurements:values"]) == 2
        for rule in ("ci-trace", "alone"):
            estimates = outputs[f"/estimates/network:{rule}/{case}/state"]
            entity = found[f"/map/errors/network\\:{rule}/{case}/ellipse"]
            ellipses = np.array([row[0] for row in entity["LineStrips2D:strips"] if row])
            assert len(ellipses) == len(estimates)
            place = found[f"/map/errors/network\\:{rule}/{case}/place"]["Points2D:positions"]
            middles = ellipses[:, :-1].mean(axis=1)
            np.testing.assert_allclose(middles, np.array(place)[:, 0], atol=1e-5)


def test_a_log_without_estimates_and_a_network_without_links_are_drawn(tmp_path):
    _, _, found = drawn("ispace", {"steps": 5, "links": []}, [], tmp_path)
    assert "/map/truth/path" in found
    assert "/map/graph/messages" not in found


def test_sets_are_polygons_with_their_areas_and_faults_are_told(tmp_path):
    parameters = {"scene": "random", "looks": 12, "landmarks": 5, "misidentified_probability": 0.1}
    shapes = ("exact", "box")
    names = [f"set-membership:{shape}" for shape in shapes]
    _, outputs, found = drawn("relative-bearings", parameters, names, tmp_path)
    for name in names:
        sizes, sets = (outputs[f"/estimates/{name}/robot1/{leaf}"].stream for leaf in ("size", "set"))
        frames = rings_of(sizes, sets)
        assert any(not rings for rings in frames)
        strips = [
            strip
            for row in found[f"/map/robot1/{name.replace(':', chr(92) + ':')}"]["LineStrips2D:strips"]
            for strip in row
        ]
        rings = [ring for each in frames for ring in each]
        assert len(strips) == len(rings)
        for strip, ring in zip(strips, rings, strict=True):
            np.testing.assert_allclose(np.array(strip)[:-1], ring, rtol=1e-5, atol=1e-5)
            assert strip[0] == strip[-1]
        plot = found[f"/plots/robot1/area/{name.replace(':', chr(92) + ':')}"]["Scalars:scalars"]
        np.testing.assert_allclose(np.ravel(plot), areas_of(frames))
        faults = outputs[f"/estimates/{name}/robot1/fault"].stream
        assert faults.schema.full_name == schemas.RELATIVE_BEARING.full_name
        assert told(found[f"/events/robot1/{name.replace(':', chr(92) + ':')}"]) == [
            f"{name}: empty set, caused by the pair {first}, {second}"
            for first, second in zip(faults["first_id"], faults["second_id"], strict=True)
        ]


def test_what_one_bearing_allows_ends_where_its_bound_does(tmp_path):
    """Most corners see both landmarks at the measured angle plus or minus the bound."""
    source, _, found = drawn("relative-bearings", {}, ["set-membership"], tmp_path)
    [allowed] = found["/map/bearings/robot1/allowed"]["LineStrips2D:strips"]
    seen, marks = (source.streams[topic] for topic in ("/robot1/relative_bearing", "/landmarks"))
    place_of = dict(zip(marks["landmark_id"].tolist(), marks["position_m"][:, :2], strict=True))
    assert len(allowed) == len(seen) == 3
    for strip, first, second, angle in zip(
        allowed, seen["first_id"].tolist(), seen["second_id"].tolist(), seen["angle_rad"], strict=True
    ):
        bearings = [np.arctan2(*(place_of[each] - np.array(strip)).T[::-1]) for each in (first, second)]
        away = np.abs(np.angle(np.exp(1j * (bearings[0] - bearings[1] - angle))))
        assert np.median(away) == pytest.approx(np.radians(4.0), rel=0.01)


def test_particles_are_drawn_where_they_are_with_their_weights(tmp_path):
    source = memory_source(*record_run("landmarks", {"duration_s": 2.0}, 1))
    settings = {"kind": "particles:50", "model": "robot", "cloud": True}
    outputs = collect(replay([source], bind("cloud", [source], settings)))
    show(source, outputs, [], save=tmp_path / "run.rrd")
    found = read(tmp_path / "run.rrd")["/map/robot1/cloud/particles"]
    cloud = outputs["/estimates/cloud/robot1/particle"]
    rows = found["Points2D:positions"]
    assert [len(row) for row in rows] == [50] * len(np.unique(cloud.stream.publish_time_ns))
    places = np.concatenate([np.array(list(row)) for row in rows])
    np.testing.assert_allclose(places, cloud["mean"][:, :2], rtol=1e-5)
    radii = np.concatenate([np.array(list(row)) for row in found["Points2D:radii"]])
    np.testing.assert_allclose(radii**2, 1.5**2 * 50 * cloud["weight"], rtol=1e-4, atol=1e-9)
    curve = read(tmp_path / "run.rrd")["/plots/robot1/effective/cloud"]["Scalars:scalars"]
    effective = outputs["/estimates/cloud/robot1/effective"]["effective"]
    np.testing.assert_allclose(np.ravel(curve), effective / 50, rtol=1e-12)


def test_the_bound_is_a_band_about_no_error_and_has_no_nees(tmp_path):
    _, outputs, found = drawn("landmarks", {"duration_s": 2.0}, ["ekf", "bound"], tmp_path)
    sigma = np.sqrt(outputs["/estimates/bound/robot1/pose"]["covariance"][:, 0])
    band = found["/plots/robot1/error_x_m/bound"]
    pairs = np.array([list(row) for row in band["Measurements:variances"]])
    np.testing.assert_allclose(pairs[:, 1], (2 * sigma) ** 2, rtol=1e-6)
    values = np.array([list(row) for row in band["Measurements:values"]])
    assert np.abs(values).max() < 1e-12
    drawn_of = {entity.rpartition("/")[2] for entity in found if "nees" in entity.lower()}
    assert "ekf" in drawn_of
    assert "bound" not in drawn_of
