"""The timeline of a body in space: its path with tube and axes, fixes by quality, outages, biases."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.models.states import NAVIGATION, state_metadata
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.timeline.drawing.canvas import PALETTE
from fuselog.replay.timeline.drawing.geodetic import POOR, QUALITIES
from fuselog.replay.timeline.show import show
from tests.replay.timeline.reading import Picture, Wanted, check_views, compare, picture_of
from tests.replay.timeline.test_timeline import told

SECOND = 10**9
STAMPS = SIMULATION_EPOCH_NS + np.arange(60) * SECOND
# North at 2 m/s along the meridian of the origin.
ORIGIN = {"origin_latitude_deg": "48.0", "origin_longitude_deg": "9.0", "origin_altitude_m": "0.0"}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Picture:
    """A minute north, with fixes of four qualities and none from 20 to 40 s."""
    seconds = np.arange(60.0)
    state = np.zeros((60, 16))
    state[:, 1], state[:, 4], state[:, 6] = 2.0 * seconds, 2.0, 1.0
    state[:, 10] = np.radians(0.1)
    variance = np.full(15, 0.01)
    variance[:3] = (4.0, 9.0, 1.0)
    covariance = np.tile(np.diag(variance).ravel(), (60, 1))
    estimate = make_stream(
        "/estimates/ekf/state",
        schemas.GAUSSIAN_ESTIMATE,
        STAMPS,
        metadata=state_metadata(NAVIGATION),
        mean=state,
        covariance=covariance,
    )
    innovation = make_stream(
        "/estimates/ekf/innovation",
        schemas.INNOVATION,
        STAMPS,
        metadata=state_metadata(NAVIGATION[:6]),
        target_id=np.zeros(60),
        accepted=np.ones(60),
        normalised_innovation_squared=seconds,
        innovation=np.where((np.arange(6) < 3) == (seconds[:, None] % 2 == 0), 0.1, np.nan),
        covariance=np.full((60, 36), np.nan),
        log_likelihood=seconds,
    )
    seen = (seconds < 20) | (seconds >= 40)
    sigma_m = np.array([0.01, 0.1, 1.0, 10.0])[np.arange(seen.sum()) % 4]
    fix = make_stream(
        "/fix",
        schemas.GEODETIC_FIX,
        STAMPS[seen],
        metadata=ORIGIN,
        latitude_deg=48.0 + 2.0 * seconds[seen] / 111_194.0,
        longitude_deg=np.full(seen.sum(), 9.0),
        altitude_m=np.zeros(seen.sum()),
        covariance_m2=(sigma_m**2)[:, None] * np.eye(3).ravel(),
    )
    quality = make_stream(
        "/quality",
        schemas.VECTOR_MEASUREMENT,
        STAMPS,
        metadata={"components": "quality,satellites", "kinds": "linear,linear"},
        value=np.stack([np.where(seconds < 30, 1.0, 2.0), seconds], axis=1),
    )
    standing = make_stream(
        "/standing",
        schemas.VECTOR_MEASUREMENT,
        STAMPS,
        metadata={"components": "standing", "kinds": "linear"},
        value=np.where(seconds < 50, 0.0, 1.0)[:, None],
    )
    source = memory_source(Recording([fix, quality, standing]), RunMetadata("table"))
    outputs = {each.topic: gather([each]) for each in (estimate, innovation)}
    path = tmp_path_factory.mktemp("navigation") / "run.rrd"
    show(source, outputs, [], save=path)
    return picture_of(path)


def test_the_scene_has_path_tube_axes_and_fixes_by_quality(drawn: Picture):
    [path] = drawn.still["/navigation/ekf/path"]["LineStrips3D:strips"][0]
    assert_allclose([path[0], path[-1]], [[0, 0, 0], [0, 118, 0]])
    [sizes] = drawn.still["/navigation/ekf/tube"]["Ellipsoids3D:half_sizes"]
    assert_allclose(np.sort(sizes[0]), [2.0, 4.0, 6.0])  # two standard deviations
    [centres] = drawn.still["/navigation/ekf/tube"]["Ellipsoids3D:centers"]
    assert_allclose(
        np.diff(np.array(centres)[:, 1]), 4.0
    )  # of a path of 2 m a second, more than half of 6 m
    places = drawn.moving["/navigation/ekf/body"]["Transform3D:translation"]
    assert_allclose(np.concatenate(places)[10], [0, 20, 0])
    [points] = drawn.still["/navigation/fix"]["Points3D:positions"]
    assert_allclose(points[10], [0, 20, 0], atol=0.05)
    [colours] = drawn.still["/navigation/fix"]["Points3D:colors"]
    wanted = [*(colour for _, colour in QUALITIES), POOR]
    packed = [(red << 24) + (green << 16) + (blue << 8) + 255 for red, green, blue in wanted]
    assert colours[:4] == packed


def test_outages_are_marked_and_shaded(drawn: Picture):
    [[strip]] = drawn.still["/navigation/ekf/without_fixes"]["LineStrips3D:strips"]
    assert_allclose([strip[0], strip[-1]], [[0, 38, 0], [0, 80, 0]])
    for plot in ("velocity", "attitude", "gyro_bias"):
        shade = drawn.moving[f"/plots/motion/{plot}/without_fixes"]
        values = np.concatenate(shade["Measurements:values"])
        assert np.isfinite(values).tolist() == [True, True, False]


def test_biases_have_bands_and_each_sensor_its_innovations(drawn: Picture):
    band = drawn.moving["/plots/motion/gyro_bias/gyro_bias_x_radps_band"]
    assert_allclose(np.concatenate(band["Measurements:values"]), 0.1, rtol=1e-12)
    deviation_deg = 2.0 * np.degrees(0.1)
    assert_allclose(np.concatenate(band["Measurements:variances"]), deviation_deg**2, rtol=1e-12)
    for first, of in ((0, "x_m"), (1, "vx_mps")):
        squares = drawn.moving[f"/plots/nis_3_{of}/ekf"]["Scalars:scalars"]
        assert_allclose(np.concatenate(squares), np.arange(first, 60, 2))


def test_the_map_has_the_estimates_and_events_the_solutions_and_stops(drawn: Picture):
    [[way]] = drawn.still["/geodetic/ekf"]["GeoLineStrings:line_strings"]
    assert_allclose(way[-1], [48.0 + 118.0 / 111_194.0, 9.0], atol=1e-5)
    said = {sensor: told(drawn.moving[f"/events/{sensor}"]) for sensor in ("quality", "standing")}
    assert said["quality"] == ["quality: solution fixed", "quality: solution float"]
    assert said["standing"] == ["standing: moves", "standing: stationary: zero velocity"]


def test_every_panel_is_called_by_what_it_shows(drawn: Picture):
    """Components by themselves, and those of a kind together; NIS is far above its band."""
    titles = {(name.rpartition("_")[0].replace("_", " "), name) for name in NAVIGATION}
    units = {"m": "m", "mps": "m/s", "radps": "deg/s", "mps2": "m/s²"}
    titles = {
        (f"{quantity.capitalize()} ({units[name.rpartition('_')[2]]})", f"plots/{name}")
        for quantity, name in titles
        if quantity != "orientation"
    }
    for part in "wxyz":  # which is no unit
        titles.add((f"Orientation {part} (-)", f"plots/orientation_{part}"))
    for name in ("latitude", "longitude"):
        titles.add((f"{name.capitalize()} (deg)", f"plots/fix/{name}_deg"))
    titles |= {("Altitude (m)", "plots/fix/altitude_m"), ("Map", "map"), ("OpenStreetMap", "geodetic")}
    titles |= {("Value (-)", f"plots/{name}/value") for name in ("quality", "standing")}
    groups = {"velocity": "m/s", "attitude": "deg", "gyro_bias": "deg/s", "accelerometer_bias": "m/s²"}
    for name, unit in groups.items():
        titles.add((f"{name.replace('_', ' ').capitalize()} ({unit})", f"plots/motion/{name}"))
    for first in ("x_m, y_m, z_m", "vx_mps, vy_mps, vz_mps"):
        plot = f"plots/nis_3_{first.partition(',')[0]}"
        titles.add((f"NIS of {first} (-)", plot))
    titles |= {("Scene, tubes of 2 sigma", "navigation"), ("Events", "events")}
    check_views(drawn, titles, ["ekf"])
    velocities = {"vx_mps": 0.0, "vy_mps": 2.0, "vz_mps": 0.0}
    wanted = {name: Wanted("curve", STAMPS, np.full(60, at)) for name, at in velocities.items()}
    compare({name: drawn.moving[f"/plots/motion/velocity/{name}"] for name in wanted}, wanted)
    styles = [drawn.still[f"/plots/motion/velocity/{name}"] for name in velocities]
    packed = [int.from_bytes(bytes((*colour, 255)), "big") for colour in PALETTE[:3]]
    assert [style["SeriesLines:colors"][0] for style in styles] == [[colour] for colour in packed]
