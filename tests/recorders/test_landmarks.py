"""The simulator of robots among landmarks does what its parameters say; statistics, honest bounds."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy.stats import chi2, expon, kstest, norm, poisson, uniform

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.geodesy import into_tangent_plane
from fuselog.recorders.models.planar import drive, range_bearing, wrap_angle
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, named_generator, record_run, record_runs
from fuselog.recorders.simulators import landmarks
from fuselog.recorders.simulators.landmarks_parameters import Fixes, LandmarksParameters, Sensor

Floats = NDArray[np.float64]
SURE = 1e-4  # how rarely an honest simulator fails one of these tests; the seeds are fixed


def record(seed: int = 1, run: int = 0, **parameters: object) -> dict[str, Stream]:
    recording, _ = record_run("landmarks", parameters, seed, run)
    return {stream.topic: stream for stream in recording.streams}


def residuals(streams: dict[str, Stream], topic: str) -> tuple[Floats, Floats]:
    """Measured - true range and bearing of every message; its stamps are stamps of the truth."""
    seen, truth, landmarks = streams[topic], streams["/robot1/truth"], streams["/landmarks"]
    pose = truth["state"][np.searchsorted(truth.publish_time_ns, seen.publish_time_ns)]
    places = landmarks["position_m"][seen["target_id"] - landmarks["landmark_id"][0]]
    distance, bearing = range_bearing(pose.T, places.T)
    measured_m = seen.columns.get("range_m", distance)
    measured_rad = seen.columns.get("bearing_rad", bearing)
    return measured_m - distance, wrap_angle(measured_rad - bearing)


def assert_distributed(sample: Floats, distribution: object) -> None:
    assert kstest(sample, distribution.cdf).pvalue > SURE


def assert_share(count: int, total: int, probability: float) -> None:
    """A binomial count within the normal approximation's bounds."""
    deviation = np.sqrt(total * probability * (1 - probability))
    assert abs(count - total * probability) < norm.isf(SURE / 2) * deviation


# Sensors.


class WithSonar(LandmarksParameters):
    """One sensor more."""

    sonar: Sensor = Sensor(rate_hz=4.0, outages_per_minute=10.0)


def test_one_more_sensor_changes_nothing_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever it stands among them; its own values are like no other's."""
    others = {name: Sensor(rate_hz=4.0, dropout_probability=0.1) for name in landmarks.SENSORS}
    values = {"duration_s": 10.0, "robots": 2, "fix": Fixes(rate_hz=1.0), **others}
    before = landmarks.simulate(LandmarksParameters(**values), np.random.default_rng(3)).streams
    monkeypatch.setattr(landmarks, "SENSORS", {"sonar": schemas.RANGE, **landmarks.SENSORS})
    after = landmarks.simulate(WithSonar(**values), np.random.default_rng(3)).streams
    streams = {stream.topic: stream for stream in after}
    assert set(streams) - {stream.topic for stream in before} == {
        f"/robot{number}/sonar{leaf}" for number in (1, 2) for leaf in ("", "/outages")
    }
    for stream in before:
        for name, column in stream.columns.items():
            assert_array_equal(streams[stream.topic][name], column, err_msg=f"{stream.topic} {name}")
    first, second = (streams[f"/robot{number}/sonar"]["range_m"] for number in (1, 2))
    assert not np.isin(first, second).any()
    assert not np.isin(first, streams["/robot1/range"]["range_m"]).any()


def test_sensors_draw_as_before_they_had_generators_by_name() -> None:
    children = np.random.default_rng(5).spawn(7)
    for name, number in landmarks.NUMBERS.items():
        own = named_generator(np.random.default_rng(5), name, landmarks.NUMBERS)
        assert own.random() == children[number].random()


@pytest.mark.parametrize("run", [(), (3,)])
def test_a_name_is_a_key_of_its_letters(run: tuple[int, ...]) -> None:
    outer = named_generator(np.random.default_rng(np.random.SeedSequence(5, spawn_key=run)), "robot1")
    keys = (*run, *b"robot1"), (*run, *b"robot1", *b"gyro"), (*run, *b"robot1", 0)
    drawn = [own.random() for own in (outer, named_generator(outer, "gyro"), *outer.spawn(1))]
    seeds = [np.random.SeedSequence(5, spawn_key=key) for key in keys]
    assert drawn == [np.random.default_rng(seed).random() for seed in seeds]


@pytest.mark.parametrize("landmarks", [5, 0])
def test_runs_that_are_simulated_together_equal_the_same_runs_alone(landmarks: int) -> None:
    sensor = {"rate_hz": 3.0, "maximum_range_m": 5.0, "dropout_probability": 0.2}
    sensor |= {"outlier_probability": 0.2, "outages_per_minute": 10.0, "latency_jitter_s": 0.1}
    names = ("range_bearing", "range", "bearing", "relative_bearing")
    values = {
        "duration_s": 7.0,
        "robots": 2,
        "robots_see_each_other": True,
        "landmarks": landmarks,
        "fix": {"rate_hz": 1.0, "outages_per_minute": 10.0},
        **dict.fromkeys(names, sensor),
    }
    recorded = record_runs("landmarks", values, 7, [3, 1, 4])
    for run, (together, metadata) in zip((3, 1, 4), recorded, strict=True):
        alone, stated = record_run("landmarks", values, 7, run)
        assert metadata == stated
        for stream, own in zip(together.streams, alone.streams, strict=True):
            assert (stream.topic, stream.metadata) == (own.topic, own.metadata)
            clocks = stream.publish_time_ns, stream.log_time_ns, stream.position
            assert_array_equal(clocks, [own.publish_time_ns, own.log_time_ns, own.position])
            for name, column in own.columns.items():
                assert stream[name].tobytes() == column.tobytes(), (run, own.topic, name)


def test_noise_and_bias_are_gaussian_as_stated():
    sensor = {
        "rate_hz": 5.0,
        "sigma_range_m": 0.2,
        "bias_range_m": 0.5,
        "sigma_bearing_rad": 0.03,
        "bias_bearing_rad": -0.1,
    }
    streams = record(range_bearing=sensor, range=sensor, bearing=sensor)
    for topic, has_range, has_bearing in (("range_bearing", 1, 1), ("range", 1, 0), ("bearing", 0, 1)):
        range_m, bearing_rad = residuals(streams, f"/robot1/{topic}")
        assert len(range_m) > 1000
        if has_range:
            assert_distributed(range_m, norm(0.5, 0.2))
        if has_bearing:
            assert_distributed(bearing_rad, norm(-0.1, 0.03))


def test_range_and_bearing_errors_are_independent_and_white():
    range_m, bearing_rad = residuals(record(duration_s=300.0), "/robot1/range_bearing")
    bound = norm.isf(SURE / 2) / np.sqrt(len(range_m))
    assert abs(np.corrcoef(range_m, bearing_rad)[0, 1]) < bound
    for errors in (range_m, bearing_rad):
        assert abs(np.corrcoef(errors[1:], errors[:-1])[0, 1]) < bound


def test_outliers_are_as_frequent_as_stated_and_anywhere():
    """Ranges up to the sensor's reach, bearings all round."""
    sensor = {
        "rate_hz": 5.0,
        "outlier_probability": 0.2,
        "sigma_range_m": 1e-4,
        "sigma_bearing_rad": 1e-5,
    }
    streams = record(duration_s=200.0, range_bearing=sensor)
    range_m, bearing_rad = residuals(streams, "/robot1/range_bearing")
    wild_range, wild_bearing = np.abs(range_m) > 1e-3, np.abs(bearing_rad) > 1e-4
    for wild in (wild_range, wild_bearing):
        assert_share(int(wild.sum()), len(wild), 0.2)
    assert_share(int((wild_range & wild_bearing).sum()), len(wild_range), 0.2**2)
    seen = streams["/robot1/range_bearing"]
    assert_distributed(seen["range_m"][wild_range], uniform(0, 8))
    assert_distributed(seen["bearing_rad"][wild_bearing], uniform(-np.pi, 2 * np.pi))


def test_ranges_are_never_negative_nor_bearings_beyond_half_a_turn():
    sensor = {"rate_hz": 5.0, "sigma_range_m": 20.0, "sigma_bearing_rad": 5.0}
    seen = record(range_bearing=sensor)["/robot1/range_bearing"]
    assert seen["range_m"].min() >= 0
    assert np.abs(seen["bearing_rad"]).max() <= np.pi


def visible(streams: dict[str, Stream], rate_hz: float, reach_m: float, view_deg: float) -> int:
    """How many sightings a perfect sensor would make."""
    truth, landmarks = streams["/robot1/truth"], streams["/landmarks"]
    poses = truth["state"][:: round(20 / rate_hz)]
    distance, bearing = range_bearing(poses.T[:, :, None], landmarks["position_m"].T[:, None, :])
    in_view = np.abs(wrap_angle(bearing)) <= np.radians(view_deg) / 2
    return int(np.sum((distance <= reach_m) & in_view))


@pytest.mark.parametrize(("reach_m", "view_deg"), [(8.0, 360.0), (4.0, 360.0), (8.0, 90.0)])
def test_sensors_see_what_is_in_range_and_view(reach_m: float, view_deg: float):
    sensor = {"rate_hz": 5.0, "maximum_range_m": reach_m, "field_of_view_deg": view_deg}
    streams = record(range_bearing=sensor)
    assert len(streams["/robot1/range_bearing"]) == visible(streams, 5.0, reach_m, view_deg)


def test_dropouts_are_as_frequent_as_stated():
    streams = record(duration_s=200.0, range_bearing={"rate_hz": 5.0, "dropout_probability": 0.3})
    assert_share(len(streams["/robot1/range_bearing"]), visible(streams, 5.0, 8.0, 360.0), 0.7)


def test_a_chance_of_zero_changes_no_random_number() -> None:
    """Numbers that decide nothing are skipped; a chance that is almost zero draws them."""
    never, almost = (
        record(
            duration_s=9.0,
            range_bearing={"rate_hz": 5.0, "dropout_probability": chance, "outlier_probability": chance},
        )["/robot1/range_bearing"]
        for chance in (0.0, 1e-300)
    )
    for name, column in almost.columns.items():
        assert_array_equal(never[name], column, err_msg=name)


def test_outages_come_at_their_rate_are_recorded_and_silence_the_sensor():
    sensor = {"rate_hz": 5.0, "outages_per_minute": 3.0, "outage_s": 2.0}
    streams = record(duration_s=1200.0, range_bearing=sensor)
    outages, seen = streams["/robot1/range_bearing/outages"], streams["/robot1/range_bearing"]
    low, high = poisson(60).ppf([SURE / 2, 1 - SURE / 2])
    assert low <= len(outages) <= high
    assert_array_equal(outages["end_time_ns"] - outages.publish_time_ns, 2_000_000_000)
    starts_s = (outages.publish_time_ns - SIMULATION_EPOCH_NS) * 1e-9
    assert_distributed(starts_s, uniform(0, 1200))
    stamps = seen.publish_time_ns
    dead = [
        (stamps >= start) & (stamps < end)
        for start, end in zip(outages.publish_time_ns, outages["end_time_ns"], strict=True)
    ]
    assert not np.any(dead)
    perfect = visible(streams, 5.0, 8.0, 360.0)
    assert 0.8 < len(seen) / perfect < 0.97  # 60 outages of 2 s in 1200 s are a tenth
    assert "/robot1/range_bearing/outages" not in record()


def test_fixes_err_as_stated_in_the_plane_and_on_earth():
    """Outages silence them, and no other stream notices that there are some."""
    receiver = {"rate_hz": 4.0, "sigma_m": 0.5, "outages_per_minute": 2.0, "outage_s": 5.0}
    streams = record(duration_s=300.0, fix=receiver)
    fixes, truth, outages = (streams[f"/robot1/{name}"] for name in ("fix", "truth", "fix/outages"))
    place = truth["state"][np.searchsorted(truth.publish_time_ns, fixes.publish_time_ns), :2]
    assert_distributed((fixes["position_m"] - place).ravel(), norm(0.0, 0.5))
    assert_array_equal(fixes["covariance_m2"], np.tile([0.25, 0.0, 0.0, 0.25], (len(fixes), 1)))
    assert len(outages) > 3
    for begin_ns, end_ns in zip(outages.publish_time_ns, outages["end_time_ns"], strict=True):
        assert not ((begin_ns <= fixes.publish_time_ns) & (fixes.publish_time_ns < end_ns)).any()
    assert 0.6 * 1201 < len(fixes) < 1201
    origin = (54.0, 12.0)
    on_earth = record(duration_s=300.0, fix={**receiver, "origin_deg": origin})["/robot1/fix"]
    assert on_earth.metadata == {"origin_latitude_deg": "54.0", "origin_longitude_deg": "12.0"}
    geodetic = (on_earth[name] for name in ("latitude_deg", "longitude_deg", "altitude_m"))
    east, north, up = into_tangent_plane(tuple(geodetic), origin)
    assert_allclose(np.stack([east, north], axis=1), fixes["position_m"], atol=1e-6)
    assert_allclose(up, 0.0, atol=1e-6)
    for topic, stream in record(duration_s=300.0).items():
        assert_array_equal(stream.publish_time_ns, streams[topic].publish_time_ns)
        for name, column in stream.columns.items():
            assert_array_equal(column, streams[topic][name])


def test_the_three_clocks():
    """Stamp, arrival and the sensor's own clock, each with its own error; shared within a look."""
    sensor = {
        "rate_hz": 4.0,
        "latency_s": 0.1,
        "latency_jitter_s": 0.05,
        "clock_offset_s": -3.0,
        "stamp_offset_s": 0.025,
    }
    seen = record(duration_s=400.0, bearing=sensor)["/robot1/bearing"]
    looked = (seen["sensor_time_ns"] - SIMULATION_EPOCH_NS) * 1e-9 + 3.0
    assert_allclose(looked * 4, np.rint(looked * 4), atol=1e-6)
    assert_allclose((seen.publish_time_ns - SIMULATION_EPOCH_NS) * 1e-9 - looked, 0.025, atol=2e-9)
    _, first = np.unique(seen["sensor_time_ns"], return_index=True)
    delay_s = (seen.log_time_ns - SIMULATION_EPOCH_NS) * 1e-9 - looked
    assert_distributed(delay_s[first], expon(0.1, 0.05))
    same_look = np.diff(seen["sensor_time_ns"]) == 0
    assert_array_equal(np.diff(seen.log_time_ns)[same_look], 0)


def test_relative_bearings_are_the_differences_of_all_pairs_of_a_look():
    sensor = {"rate_hz": 5.0, "sigma_bearing_rad": 0.0}
    streams = record(bearing=sensor, relative_bearing=sensor)
    bearing, pairs = streams["/robot1/bearing"], streams["/robot1/relative_bearing"]
    expected = [
        (stamp, first, second, wrap_angle(bearing["bearing_rad"][i] - bearing["bearing_rad"][j]))
        for stamp in np.unique(bearing.publish_time_ns)
        for i, first in places(bearing, stamp)
        for j, second in places(bearing, stamp)
        if i < j
    ]
    found = sorted(zip(pairs.publish_time_ns, pairs["first_id"], pairs["second_id"], strict=True))
    assert found == sorted(each[:3] for each in expected)
    order = np.lexsort((pairs["second_id"], pairs["first_id"], pairs.publish_time_ns))
    apart = wrap_angle(pairs["angle_rad"][order] - [each[3] for each in sorted(expected)])
    assert_allclose(apart, 0, atol=1e-12)


def places(stream: Stream, stamp: int) -> list[tuple[int, int]]:
    """Row and target of the messages of one stamp."""
    rows = np.flatnonzero(stream.publish_time_ns == stamp)
    return [(int(row), int(stream["target_id"][row])) for row in rows]


# Motion.


def driven(streams: dict[str, Stream], robot: int = 1) -> tuple[Floats, Floats]:
    """The true velocities (steps, 2) between the truth's stamps, and the odometry's."""
    pose = streams[f"/robot{robot}/truth"]["state"]
    odometry = streams[f"/robot{robot}/odometry"]
    turn = wrap_angle(np.diff(pose[:, 2])) * 20
    along = np.hypot(*np.diff(pose[:, :2], axis=0).T) / np.sinc(turn / 40 / np.pi) * 20
    said = np.stack([odometry["forward_mps"], odometry["turn_radps"]], axis=1)
    back = np.cos(np.arctan2(*np.diff(pose[:, :2], axis=0).T[::-1]) - pose[:-1, 2] - turn / 40)
    return np.stack([along * np.sign(back), turn], axis=1), said


def test_odometry_errs_by_white_noise_of_its_density_scale_and_bias():
    streams = record(
        duration_s=200.0, forward_noise_density=0.04, turn_noise_density=0.03, speed_mps=1.0
    )
    true, said = driven(streams)
    for k, density in enumerate((0.04, 0.03)):
        errors = true[:, k] - said[:, k]
        assert_distributed(errors, norm(0, density * np.sqrt(20)))
        bound = norm.isf(SURE / 2) / np.sqrt(len(errors))
        assert abs(np.corrcoef(errors[1:], errors[:-1])[0, 1]) < bound
    noiseless = {"forward_noise_density": 0.0, "turn_noise_density": 0.0}
    true, said = driven(record(**noiseless, forward_scale_error=0.1, turn_bias_radps=-0.02))
    assert_allclose(true[:, 0], 1.1 * said[:, 0], atol=1e-9)
    assert_allclose(true[:, 1], said[:, 1] - 0.02, atol=1e-9)


def test_truth_is_what_the_true_velocities_drive():
    """Poses follow one another by the arc; the estimators rely on the same function."""
    streams = record()
    true, _ = driven(streams)
    pose = streams["/robot1/truth"]["state"]
    moved = np.transpose(drive(pose[:-1].T, true.T, 0.05))
    assert_allclose(moved[:, :2], pose[1:, :2], atol=1e-9)
    assert_allclose(wrap_angle(moved[:, 2] - pose[1:, 2]), 0, atol=1e-9)


def test_priors_err_as_they_say():
    """Over 300 runs the normalised squares are chi-square with three degrees."""
    squares = []
    for run in range(300):
        streams = record(run=run, duration_s=0.1, landmarks=0, prior_sigma_m=0.5, prior_sigma_rad=0.2)
        prior, truth = streams["/robot1/prior"], streams["/robot1/truth"]
        error = prior["mean"][0] - truth["state"][0]
        error[2] = wrap_angle(error[2])
        squares.append(error @ np.linalg.inv(prior["covariance"].reshape(3, 3)) @ error)
    assert_distributed(np.array(squares), chi2(3))


def test_robots_see_each_other_where_they_are():
    streams = record(robots=3, robots_see_each_other=True, landmarks=4)
    seen = streams["/robot1/range_bearing"]
    assert set(seen["target_id"].tolist()) <= {2, 3, *streams["/landmarks"]["landmark_id"].tolist()}
    for other in (2, 3):
        rows = seen["target_id"] == other
        assert rows.sum() > 50
        at = np.searchsorted(streams["/robot1/truth"].publish_time_ns, seen.publish_time_ns[rows])
        apart = (streams[f"/robot{other}/truth"]["state"] - streams["/robot1/truth"]["state"])[at, :2]
        assert_distributed(seen["range_m"][rows] - np.hypot(*apart.T), norm(0, 0.1))


# Random streams.


def same(first: Stream, second: Stream) -> bool:
    return first.columns.keys() == second.columns.keys() and all(
        np.array_equal(column, second.columns[name]) for name, column in first.columns.items()
    )


def test_a_seed_and_a_run_give_the_same_numbers_and_others_give_others():
    first, again = record(seed=7, run=3), record(seed=7, run=3)
    assert first.keys() == again.keys()
    assert all(same(first[topic], again[topic]) for topic in first)
    for other in (record(seed=7, run=4), record(seed=8, run=3)):
        assert not any(same(first[topic], other[topic]) for topic in first)


def test_runs_are_independent():
    """The noise of neighbouring runs and seeds is not correlated."""
    runs = [
        residuals(record(seed, run), "/robot1/range_bearing")[0][:1000]
        for seed in (1, 2)
        for run in (0, 1)
    ]
    correlation = np.corrcoef(runs)[np.triu_indices(4, 1)]
    assert np.abs(correlation).max() < norm.isf(SURE / 2) / np.sqrt(1000)


def test_another_robot_or_sensor_changes_no_other_stream():
    """Each draws from a random stream of its own; only the landmarks' numbers follow the robots'."""
    alone = record()
    crowded = record(robots=3, bearing={"rate_hz": 2.0}, relative_bearing={"rate_hz": 3.0})
    for topic in ("/robot1/truth", "/robot1/odometry", "/robot1/prior"):
        assert same(alone[topic], crowded[topic])
    assert_array_equal(alone["/landmarks"]["position_m"], crowded["/landmarks"]["position_m"])
    seen, seen_too = alone["/robot1/range_bearing"], crowded["/robot1/range_bearing"]
    assert_array_equal(seen["range_m"], seen_too["range_m"])
    assert_array_equal(seen["target_id"] + 2, seen_too["target_id"])
    faulty = record(odometry_latency_s=1.0, range_bearing={"rate_hz": 5.0, "latency_s": 1.0})
    assert same(alone["/robot1/range_bearing"], faulty["/robot1/range_bearing"])


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"robots": 0}, "'robots' is 0"),
        ({"range": {"dropout_probability": 1.5}}, r"'range\.dropout_probability' is 1.5"),
        ({"range": {"speed": 1}}, r"no parameter 'range\.speed'; available: rate_hz"),
        ({"duration_s": float("nan")}, "'duration_s' is nan"),
        ({"forward_scale_error": -1.0}, "'forward_scale_error' is -1"),
    ],
)
def test_impossible_parameters_are_refused_by_name(parameters: dict[str, object], words: str):
    with pytest.raises(BadInput, match=words):
        record(**parameters)
