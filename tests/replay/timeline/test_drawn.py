"""What families draw is what the streams say: files are read back and compared, entity by entity.

Estimates are made: each component errs by its own part of a covariance without equal entries, so that
an axis, a sign, a unit or a block that is taken for another shows.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from fuselog.recorders.families.los.models import direction
from fuselog.recorders.log import make_stream, schemas
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.families.vehicles.timeline import SHOWN_M
from fuselog.replay.judging.errors.evaluation import Floats
from fuselog.replay.timeline.landmarks import GATED, SEEN
from fuselog.replay.timeline.show import show
from tests.replay.timeline.making import (
    ESTIMATORS,
    PLANE,
    block,
    columns,
    drawn,
    ellipses,
    estimate,
    of_both,
    path,
    rays,
    record,
    unit,
)
from tests.replay.timeline.reading import Titles, Wanted, check_views, compare, consistent, picture_of


def test_robots_have_paths_arrows_ellipses_and_what_they_see(tmp_path: Path) -> None:
    view = {"maximum_range_m": 7.0, "field_of_view_deg": 350.0}
    source = record("landmarks", duration_s=2.0, robots=2, landmarks=4, range_bearing=view)
    seen = source.streams["/robot2/range_bearing"]
    values, squared = np.full((len(seen), 2), 0.1), 0.01 * np.arange(len(seen))
    values[1::3, 0] = np.nan
    innovations = make_stream(
        "/estimates/one/robot2/innovation",
        schemas.INNOVATION,
        seen.publish_time_ns,
        metadata={"components": "range_m,bearing_rad", "kinds": "linear,angle"},
        target_id=seen["target_id"],
        accepted=np.arange(len(seen)) != 3,
        innovation=values,
        covariance=np.tile(np.eye(2).ravel(), (len(seen), 1)),
        normalised_innovation_squared=squared,
        log_likelihood=squared,
    )
    run = drawn(tmp_path, source, [*of_both(source, "robot1", "robot2"), innovations])
    marks = source.streams["/landmarks"]
    place_of = dict(zip(marks["landmark_id"].tolist(), marks["position_m"], strict=True))
    wanted: dict[str, Wanted] = {}
    titles: Titles = set()
    for case in ("robot1", "robot2"):
        plots, own = run.quality(case)
        wanted |= plots
        titles |= {*own, ("Map", f"map/{case}")}
        for name, stream, field in run.tracks(case):
            time_ns, places = stream.publish_time_ns, columns(stream, field, *PLANE)
            root, heading = f"/map/{case}/{name}", columns(stream, field, "heading_rad")[:, 0]
            wanted[f"{root}/path"] = path(stream, places)
            wanted[f"{root}/pose"] = rays(time_ns, places, unit(heading), "arrows")
            if field == "mean":
                wanted[f"{root}/ellipse"] = ellipses(stream, places, block(stream, *PLANE))
        sights, truth = source.streams[f"/{case}/range_bearing"], run.truth(case)
        x, y, heading = columns(truth, "state", *PLANE, "heading_rad").T[..., None]
        angle = heading + np.radians(np.linspace(-175.0, 175.0, 49))
        rim = np.stack([x + 7.0 * np.cos(angle), y + 7.0 * np.sin(angle)], axis=2)
        here = np.stack([x, y], axis=2)
        outline = np.concatenate([here, rim, here], axis=1)
        wanted[f"/map/{case}/field\\ of\\ view"] = Wanted("lines", truth.publish_time_ns, outline)
        order = np.lexsort((sights["target_id"], sights.publish_time_ns))
        time_ns = sights.publish_time_ns[order]
        begin = columns(truth, "state", *PLANE)[np.searchsorted(truth.publish_time_ns, time_ns)]
        end = np.array([place_of[target] for target in sights["target_id"][order].tolist()])
        wanted[f"/map/{case}/sights"] = Wanted("lines", time_ns, np.stack([begin, end], axis=1))
    whole = np.isfinite(values).all(axis=1)
    for rows, degrees in ((whole, 2), (~whole, 1)):
        time_ns, plot = seen.publish_time_ns[rows], f"plots/robot2/nis_{degrees}"
        wanted[f"/{plot}/one"] = Wanted("curve", time_ns, squared[rows])
        wanted[f"/{plot}/bounds"] = consistent(degrees, time_ns)
        titles.add((f"NIS of {degrees} component{'s' * (degrees > 1)} (-)", plot))
    told = f"one: rejected range_bearing of target {seen['target_id'][3]}: NIS 0.0"
    wanted["/events/robot2/one"] = Wanted("told", seen.publish_time_ns[[3]], [told])
    compare(run.picture.moving, wanted)
    check_views(run.picture, {*titles, ("Events", "events/robot2")})
    widths = [
        run.picture.still[f"/plots/robot1/nees_3/{name}"]["SeriesLines:widths"] for name in ESTIMATORS
    ]
    assert widths == [[[4.5]], [[1.5]]]  # the first is seen below the second
    colours = run.picture.moving["/map/robot2/sights"]["LineStrips2D:colors"]
    found = [each for row in colours for each in row or []]
    red, usual = (int.from_bytes(bytes(colour), "big") for colour in (GATED, SEEN))
    assert [found.count(red), found.count(usual)] == [1, len(seen) - 1]


def test_a_shot_has_what_was_heard_its_ellipses_and_its_cone(tmp_path: Path) -> None:
    """Sensors hear almost without noise: a muzzle blast comes from the shooter."""
    source = record(
        "acoustic-shots", shots=2, sigma_position_m=1e-6, sigma_muzzle_blast_deg=1e-6, mach_number=3.0
    )
    detected = [source.streams[f"/sensor{number}/detections"] for number in range(1, 6)]
    heard = np.max([each.publish_time_ns for each in detected], axis=0)
    truth = source.streams["/shooter/truth"]
    then = truth.take(np.isin(truth.publish_time_ns, heard))
    run = drawn(tmp_path, source, [estimate(name, "shooter", then, slice(None)) for name in ESTIMATORS])
    wanted, titles = run.quality("shooter")
    fixes = [source.streams[f"/sensor{number}/position"] for number in range(1, 6)]
    places = np.concatenate([each["position_m"][:1] for each in fixes])
    shock = np.stack([each["shockwave_azimuth_rad"] for each in detected], axis=1)
    shot, sensor = np.nonzero(np.isfinite(shock))
    shooter = columns(truth, "state", *PLANE)[0]
    from_shooter = np.tile(
        (shooter - places) / np.linalg.norm(shooter - places, axis=1)[:, None], (2, 1)
    )
    everywhere = np.tile(places, (2, 1))
    wanted["/map/muzzle\\ blast"] = rays(np.repeat(heard, 5), everywhere, from_shooter)
    wanted["/map/shockwave"] = rays(heard[shot], places[sensor], unit(shock[shot, sensor]))
    extent = np.ptp(np.concatenate([places, shooter[None]]), axis=0).max()
    for name, stream, field in [("truth", then, "state"), *run.estimates("shooter")]:
        begin, angle = columns(stream, field, *PLANE), columns(stream, field, "trajectory_rad")[:, 0]
        tip, half = begin + 0.7 * extent * unit(angle), np.arcsin(1 / 3)
        back = [tip - 0.35 * extent * unit(angle + side * half) for side in (1, -1)]
        lines = np.stack([np.stack([end, tip], axis=1) for end in (begin, *back)], axis=1)
        wanted[f"/map/{name}/shot"] = Wanted("lines", np.repeat(heard, 3), lines.reshape(-1, 2, 2))
        if field == "mean":
            wanted[f"/map/{name}/shooter"] = ellipses(stream, begin, block(stream, *PLANE))
    compare(run.picture.moving, wanted)
    check_views(run.picture, {*titles, ("Map; the bullet's path ends at its shockwave", "map")})
    marks = run.picture.still["/map/sensors"]
    np.testing.assert_allclose(marks["Points2D:positions"][0], places, rtol=1e-5, atol=1e-5)
    assert marks["Points2D:labels"][0] == list("12345")


def test_lines_of_sight_are_as_measured_and_as_corrected(tmp_path: Path) -> None:
    """Where the biases are right, corrected lines of sight lead to the targets."""
    source = record("optical-los", sigma_rad=1e-9, bias_deg=[[1.0, -2.0, 3.0]] * 3)
    truth = source.streams["/truth"]
    made = of_both(source, "", rows=slice(None))
    biases = [name for name in truth.components if "bias" in name]
    for each in made:
        for name in biases:
            column = truth.components.index(name)
            each["mean"][:, column] = truth["state"][:, column]
    made[1]["covariance"][:] *= 100.0
    run = drawn(tmp_path, source, made)
    wanted, titles = run.quality()
    names = [name for name in truth.components if name.startswith("target")]
    targets = columns(truth, "state", *names)[0].reshape(-1, 3)
    for sensor in (1, 2, 3):
        place, turned, seen = (
            source.streams[f"/sensor{sensor}/{leaf}"]
            for leaf in ("position", "attitude", "line_of_sight")
        )
        begin, nominal = (
            place["position_m"][0],
            Rotation.from_quat(turned["quaternion"][0], scalar_first=True),
        )
        attitude = nominal.inv().as_euler("ZYX")
        measured = np.stack(direction(seen["azimuth_rad"], seen["elevation_rad"], attitude), axis=1)
        way = targets[seen["target_id"].astype(int) - 1] - begin
        way /= np.linalg.norm(way, axis=1)[:, None]
        time_ns = seen.publish_time_ns
        wanted[f"/space/measured/{sensor}"] = rays(time_ns, begin, measured, "rays in space")
        assert np.abs(measured - way).max() > 0.01
        for name in ESTIMATORS:
            corrected = rays(time_ns, begin, way, "rays in space")
            wanted[f"/space/{name}/corrected/{sensor}"] = corrected
    for name, stream, _ in run.estimates():
        places = columns(stream, "mean", *names).reshape(-1, 3)
        spread = np.stack([block(stream, *names[k : k + 3]) for k in (0, 3, 6)], axis=1).reshape(-1, 9)
        spread /= np.trace(spread[0].reshape(3, 3))
        values = np.concatenate([places, spread], axis=1)
        wanted[f"/space/{name}/targets"] = Wanted(
            "ellipsoids", np.repeat(stream.publish_time_ns, 3), values
        )
        stamps = np.repeat(stream.publish_time_ns, 3)
        wanted[f"/space/{name}/targets/place"] = Wanted("places in space", stamps, places)
    compare(run.picture.moving, wanted)
    one, two = (
        np.array(run.picture.moving[f"/space/{name}/targets"]["Ellipsoids3D:half_sizes"], float).ravel()
        for name in ESTIMATORS
    )
    sizes = [np.sqrt(np.trace(block(each, *names[:3])[0])) for _, each, _ in run.estimates()]
    assert np.linalg.norm(one[:3]) / np.linalg.norm(two[:3]) == pytest.approx(sizes[0] / sizes[1])
    [scene] = [view.name for view in run.picture.views if view.kind == "3D"]
    check_views(run.picture, {*titles, (scene, "space")})
    for what, places in (("sensor", None), ("target", targets)):
        marks = run.picture.still[f"/space/{what}s"]
        assert marks["Points3D:labels"][0] == [f"{what} {number}" for number in (1, 2, 3)]
        if places is not None:
            np.testing.assert_allclose(marks["Points3D:positions"][0], places, rtol=1e-6)


def test_directions_are_turned_as_estimated(tmp_path: Path) -> None:
    source = record("orientation", steps=6)
    run = drawn(tmp_path, source, of_both(source, ""))
    wanted, titles = run.quality()
    for name, stream, field in run.tracks():
        turned = np.roll(stream[field], -1, axis=1)
        wanted[f"/space/{name}"] = Wanted("turns", stream.publish_time_ns, turned)
        labels = run.picture.still[f"/space/{name}/axes"]
        assert labels["Arrows3D:labels"] == [[f"{name} {axis}" for axis in "xyz"]]
        vectors = np.array(labels["Arrows3D:vectors"][0])
        assert np.array_equal(vectors / vectors[0, 0], np.eye(3))
    compare(run.picture.moving, wanted)
    check_views(run.picture, {*titles, ("Orientation: truth in red, green, blue", "space")})


def test_an_axis_has_its_truth_measurements_and_densities(tmp_path: Path) -> None:
    source = record("axis", steps=6)
    run = drawn(tmp_path, source, of_both(source, ""))
    wanted, titles = run.quality()
    seen = source.streams["/axis"]
    truth = run.truth()
    for name, stream, ends in (
        ("truth", truth, 1.3 * truth["state"]),
        ("measurement", seen, 1.15 * seen["axis"]),
    ):
        wanted[f"/axis/{name}"] = Wanted(
            "lines", stream.publish_time_ns, np.stack([-ends, ends], axis=1)
        )
    for name, stream, _ in run.estimates():
        twice = 2.0 * np.arctan2(stream["mean"][:, 1], stream["mean"][:, 0])
        wanted[f"/axis/{name}"] = Wanted("far ends", stream.publish_time_ns, unit(twice))
    compare(run.picture.moving, wanted)
    check_views(run.picture, {*titles, ("Axis: truth grey, measurement yellow, densities", "axis")})


def test_two_headings_are_cells_of_a_torus(tmp_path: Path) -> None:
    """Heading 1 goes right, heading 2 up, from -180 degrees in the lower left corner."""
    source = record("torus-headings", steps=6)
    run = drawn(tmp_path, source, of_both(source, ""))
    wanted, titles = run.quality()

    def cells(headings: Floats) -> Floats:
        right, up = 96.0 * (np.mod(headings + np.pi, 2.0 * np.pi) / (2.0 * np.pi)).T
        return np.stack([right, 96.0 - up], axis=1)

    seen = source.streams["/headings"]
    dots = [*run.tracks(), ("measurement", seen, "value")]
    for name, stream, field in dots:
        wanted[f"/torus/{name}"] = Wanted("dots", stream.publish_time_ns, cells(stream[field]))
    one = run.made["/estimates/one/state"]
    wanted["/torus/density"] = Wanted("brightest", one.publish_time_ns, cells(one["mean"]))
    samples = run.picture.moving.pop("/torus/samples")
    for row, mean in zip(samples["Points2D:positions"], cells(one["mean"]), strict=True):
        assert np.min(np.linalg.norm(np.array(row) - mean, axis=1)) < 0.5
    compare(run.picture.moving, wanted)
    title = "Heading 2 (deg) over heading 1 (deg); density and samples of one"
    check_views(run.picture, {*titles, (title, "torus")})


def test_an_extended_target_is_a_rectangle(tmp_path: Path) -> None:
    source = record("extended-target", points=40)
    run = drawn(tmp_path, source, of_both(source, ""))
    wanted, titles = run.quality()
    for name, stream, field in run.tracks():
        half, centre = columns(stream, field, "half_x_m", "half_y_m"), columns(stream, field, *PLANE)
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        outline = centre[:, None] + signs * half[:, None]
        wanted[f"/map/{name}"] = Wanted("lines", stream.publish_time_ns, outline)
        for column, component in enumerate(stream.components):
            curve = Wanted("curve", stream.publish_time_ns, stream[field][:, column])
            wanted[f"/plots/{component}/{name}"] = curve
    points = source.streams["/surface_point"]
    wanted["/map/points"] = Wanted("dots", points.publish_time_ns, points["position_m"])
    compare(run.picture.moving, wanted)
    halves = {("Half x (m)", "plots/half_x_m"), ("Half y (m)", "plots/half_y_m")}
    check_views(run.picture, {*titles, *halves, ("Map", "map")})


def test_a_network_has_messages_on_their_way_and_the_errors_of_its_nodes(tmp_path: Path) -> None:
    """Nodes lie clockwise from the top; a message keeps left, and goes half of the way if it is lost."""
    source = record("ispace", steps=8)
    truth, links = source.streams["/truth"], source.streams["/links"]
    made = [estimate(name, node, truth) for name in ESTIMATORS for node in ("node1", "node3")]
    run = drawn(tmp_path, source, made)
    wanted: dict[str, Wanted] = {}
    titles: Titles = {("Network: links, arriving and lost messages", "map/graph")}
    for node in ("node1", "node3"):
        plots, own = run.quality(node)
        wanted |= plots
        own -= {("Events", f"events/{node}")}  # all are in one view
        titles |= {(f"{node}: {name}" if "NEES" in name else name, root) for name, root in own}
        for name, stream, _ in run.estimates(node):
            places, root = columns(stream, "mean", *PLANE), f"/map/errors/{name}/{node}"
            error = places - columns(truth, "state", *PLANE)[1:]
            wanted[f"/map/ways/{name}/{node}"] = path(stream, places)
            wanted[f"{root}/place"] = Wanted("dots", stream.publish_time_ns, error)
            wanted[f"{root}/ellipse"] = ellipses(stream, error, block(stream, *PLANE))
            titles |= {("Map", f"map/ways/{name}"), ("Errors and 95 % ellipses", f"map/errors/{name}")}
    places = columns(truth, "state", *PLANE)
    wanted["/map/truth/path"] = path(truth, places)
    wanted["/map/truth/place"] = Wanted("dots", truth.publish_time_ns, places)
    sender, receiver = (
        unit(np.radians(90.0 * (2 - links[side].astype(int)))) for side in ("sender_id", "receiver_id")
    )
    way = receiver - sender
    left = 0.025 * np.stack([-way[:, 1], way[:, 0]], axis=1) / np.linalg.norm(way, axis=1)[:, None]
    share = np.where(links["lost"] > 0, 0.5, 0.95)[:, None]
    lines = np.stack([sender + left + 0.05 * way, sender + left + share * way], axis=1)
    wanted["/map/graph/messages"] = Wanted("lines", links.publish_time_ns, lines)
    said = "/events/links"  # see `test_set_timelines`
    named = {f"/map/errors/{name}/names" for name in ESTIMATORS}
    compare({name: run.picture.moving[name] for name in {*run.picture.moving} - {said, *named}}, wanted)
    for entity in named:  # nodes that are close share a label
        labels = [" ".join(each).split() for each in run.picture.moving[entity]["Points2D:labels"]]
        assert all(len(set(each)) == len(each) for each in labels)
        assert sorted(labels[-1]) == list("13")
    check_views(run.picture, {*titles, ("Events", "events")})


def test_vehicles_are_on_the_map_close_up_and_in_the_sensors_frame(tmp_path: Path) -> None:
    source = record("vehicles", duration_s=5.0, vehicles=2)
    cases = ("vehicle1", "vehicle2", "infrastructure")
    fixes, raw = (source.streams[f"/{name}/detection"] for name in ("network", "infrastructure"))
    scans = np.unique(fixes.publish_time_ns)
    taken = np.arange(len(scans)) % 2
    ahead = np.stack([0.3 + 0.1 * taken, -0.2 + 0.3 * taken], axis=1)
    innovations = make_stream(
        "/estimates/one/vehicle2/innovation",
        schemas.INNOVATION,
        scans,
        metadata={"components": "x_m,y_m", "kinds": "linear,linear"},
        target_id=1 + taken,
        accepted=np.ones(len(scans)),
        innovation=ahead,
        covariance=np.tile(np.eye(2).ravel(), (len(scans), 1)),
        normalised_innovation_squared=np.ones(len(scans)),
        log_likelihood=np.ones(len(scans)),
    )
    made = of_both(source, *cases)
    for each, column in zip(made, (0, 1), strict=False):  # one leaves the close-up along one axis alone
        each["mean"][2, each.components.index(PLANE[column])] += 6.0
        each["covariance"][2] *= 1e3
    run = drawn(tmp_path, source, [*made, innovations])
    wanted: dict[str, Wanted] = {}
    close_up = "Close-up about the true positions, 8 m each; white lines: prediction to associated fix"
    titles: Titles = {
        ("Map", "map/map"),
        ("Raw detections in the sensor's frame", "map/sensor"),
        (close_up, "map/close"),
        ("OpenStreetMap", "geodetic"),
        ("Joint error of all vehicles (m)", "plots/error"),
        ("GOSPA, cutoff 10 m (m)", "plots/gospa"),
        ("Events", "events"),
    }
    told: dict[str, list[tuple[int, str]]] = {name: [] for name in ESTIMATORS}
    for case in cases:
        plots, own = run.quality(case)
        wanted |= {entity: each for entity, each in plots.items() if "nees" in entity}
        titles |= {(f"{case}: {name}", root) for name, root in own if "NEES" in name}
        for name in ESTIMATORS:
            _, stamps, texts = plots[f"/events/{case}/{name}/worst"]
            told[name] += zip(stamps, texts, strict=True)
    for name, found in told.items():
        stamps, texts = zip(*sorted(found, key=lambda each: each[0]), strict=True)
        wanted[f"/events/{name}/worst"] = Wanted("told", stamps, list(texts))
    truths = [run.truth(case) for case in cases[:2]]
    places = np.stack([columns(truth, "state", *PLANE) for truth in truths], axis=1)
    time_ns = truths[0].publish_time_ns
    seen = fixes.publish_time_ns, fixes["position_m"]
    near = {"fixes": seen}
    wanted["/map/map/fixes"] = Wanted("dots", *seen)
    wanted["/map/sensor/raw"] = Wanted("dots", raw.publish_time_ns, raw["position_m"])
    for n, (case, truth) in enumerate(zip(cases, truths, strict=False)):
        wanted[f"/map/map/truth/{n}"] = path(truth, places[:, n])
        for name, stream, _ in run.estimates(case):
            found = columns(stream, "mean", *PLANE)
            wanted[f"/map/map/{name}/{n}"] = path(stream, found)
            apart = found - places[1:, n]
            close = np.abs(apart).max(axis=1) < SHOWN_M
            beside, shown = apart[close] + [8.0 * n, 0.0], stream.take(close)
            wanted[f"/map/close/{name}/{n}"] = ellipses(shown, beside, block(shown, *PLANE))
        fix = source.streams[f"/{case}/geodetic_fix"]
        degrees = np.stack([fix["latitude_deg"], fix["longitude_deg"]], axis=1)
        wanted[f"/geodetic/{case}"] = Wanted("places", fix.publish_time_ns, degrees)
    for name in ESTIMATORS:
        own = [run.made[f"/estimates/{name}/{case}/state"] for case in cases]
        errors = np.stack([columns(each, "mean", *PLANE) for each in own[:2]], axis=1) - places[1:]
        size = np.sqrt(np.sum(errors**2, axis=(1, 2)))
        for plot in ("error", "gospa"):  # they are far from each other
            wanted[f"/plots/{plot}/{name}"] = Wanted("curve", time_ns[1:], size)
        rows = np.searchsorted(own[2].publish_time_ns, raw.publish_time_ns)
        (x, y, heading), (right, up) = own[2]["mean"][rows].T, raw["position_m"].T
        turned = (right + 1j * up) * np.exp(1j * heading)
        registered = np.stack([x + turned.real, y + turned.imag], axis=1)
        near[f"{name}/detections"] = raw.publish_time_ns, registered
        wanted[f"/map/map/{name}/detections"] = Wanted("dots", raw.publish_time_ns, registered)
    x, y, heading = run.truth("infrastructure")["state"][0]
    turned = (raw["position_m"] @ (1.0, 1j)) * np.exp(1j * heading)
    placed = np.stack([x + turned.real, y + turned.imag], axis=1)
    wanted["/map/map/detections"] = Wanted("dots", raw.publish_time_ns, placed)
    for entity, (stamps, found) in near.items():
        apart = found[:, None] - places[np.searchsorted(time_ns, stamps)]
        row, cell = np.nonzero(np.abs(apart).max(axis=2) < 3.8)
        beside = apart[row, cell] + np.stack([8.0 * cell, 0.0 * cell], axis=1)
        if len(row):
            wanted[f"/map/close/{entity}"] = Wanted("dots", stamps[row], beside)
    ends = fixes["position_m"][np.searchsorted(fixes.publish_time_ns, scans) + taken]
    wanted["/map/map/links"] = Wanted("lines", scans, np.stack([ends - ahead, ends], axis=1))
    apart = ends - places[1:, 1]
    shown = np.abs(apart).max(axis=1) < 3.4
    beside = apart[shown] + [8.0, 0.0]
    lines = np.stack([beside - ahead[shown], beside], axis=1)
    wanted["/map/close/links"] = Wanted("lines", scans[shown], lines)
    compare(run.picture.moving, wanted)
    check_views(run.picture, titles)


def test_sets_without_names_are_where_the_vehicles_are_whatever_their_frame(tmp_path: Path) -> None:
    """One is estimated in the frame of the sensor by the road, which is turned by two radians."""
    source = record("vehicles", duration_s=3.0, vehicles=2)
    truths = [source.streams[f"/vehicle{number}/truth"] for number in (1, 2)]
    outputs = {}
    for case in ("network", "infrastructure"):
        seen = source.streams[f"/{case}/detection"]
        stamps, counts = np.unique(seen.publish_time_ns, return_counts=True)
        told = {"components": "x_m,y_m", "kinds": "linear,linear"}
        for leaf, schema, times, columns_of in (
            ("size", schemas.ESTIMATE_SIZE, stamps, {"elements": counts}),
            (
                "element",
                schemas.DENSITY_ESTIMATE,
                seen.publish_time_ns,
                {
                    "weight": np.ones(len(seen)),
                    "mean": seen["position_m"],
                    "covariance": np.tile(np.eye(2).ravel(), (len(seen), 1)),
                },
            ),
        ):
            topic = f"/estimates/{case}/{case}/{leaf}"
            stream = make_stream(topic, schema, times, metadata=told, **columns_of)
            outputs[stream.topic] = gather([stream])
    show(source, outputs, [], save=tmp_path / "run.rrd")
    moving = picture_of(tmp_path / "run.rrd").moving
    for name in ("network", "infrastructure"):
        points = moving[f"/map/map/{name}/elements"]
        for stamp, places in zip(points["utc"], points["Points2D:positions"], strict=True):
            states = [truth["state"][np.searchsorted(truth.publish_time_ns, stamp)] for truth in truths]
            apart = np.array(places)[:, None] - np.array(states)[:, [0, 2]]
            assert np.linalg.norm(apart, axis=2).min(axis=1).max() < 6.0


def test_moving_targets_are_on_the_lines_that_sensors_measure_of_them(tmp_path: Path) -> None:
    """Without noise and biases; what is close up are the errors, with their ellipsoids."""
    exact = {"sigma_rad": 1e-9, "bias_sigma_rad": 0.0, "clock_sigma_s": 0.0, "acceleration_density": 0.0}
    source = record("moving-los", duration_s=3.0, **exact)
    run = drawn(tmp_path, source, of_both(source, ""))
    truth = run.truth()
    targets = [[f"target_{number}_{axis}_m" for axis in "xyz"] for number in (1, 2)]
    ends = np.array([columns(truth, "state", *names)[[0, -1]] for names in targets])
    for number in (1, 2, 3):
        seen = source.streams[f"/sensor{number}/moving_line_of_sight"]
        since = (seen.publish_time_ns - truth.publish_time_ns[0]) / np.ptp(truth.publish_time_ns)
        begin, end = ends[seen["target_id"].astype(int) - 1].swapaxes(0, 1)
        way = begin + since[:, None] * (end - begin) - seen["position_m"]
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        line = rays(seen.publish_time_ns, seen["position_m"], way, "rays in space")
        entity = f"/sights/measured/sensor{number}"
        compare({entity: run.picture.moving[entity]}, {entity: line})
    for errors in run.errors:
        for target, names in enumerate(targets, start=1):
            at = [errors.components.index(name) for name in names]
            entity = f"/close/target_{target}/{errors.estimator}"
            places = Wanted("places in space", errors.time_ns, errors.error[:, at])
            compare({entity: run.picture.moving[f"{entity}/place"]}, {entity: places})
            half = np.array(run.picture.moving[entity]["Ellipsoids3D:half_sizes"])[:, 0]
            spread = errors.covariance[:, at][:, :, at]
            wanted = np.sqrt(chi2.ppf(0.95, 3) * np.linalg.eigvalsh(spread))
            np.testing.assert_allclose(np.sort(half, axis=1), wanted, rtol=1e-5)


def test_ranges_lead_to_the_anchors_that_they_are_of(tmp_path: Path) -> None:
    source = record("ranging", duration_s=1.0)
    run = drawn(tmp_path, source, of_both(source, "trolley"))
    anchors, truth = source.streams["/anchors"]["position_m"][:, :2], run.truth("trolley")
    places = np.repeat(columns(truth, "state", *PLANE), len(anchors), axis=0)
    lines = np.stack([places, np.tile(anchors, (len(truth), 1))], axis=1)
    wanted = Wanted("lines", np.repeat(truth.publish_time_ns, len(anchors)), lines)
    compare({"sights": run.picture.moving["/map/trolley/sights"]}, {"sights": wanted})
