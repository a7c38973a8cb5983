"""The tracker of scans: its update against the formula, how tracks begin and end, and real scenarios."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.recorders.models.states import PLANE_MOTION, state_metadata
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording
from fuselog.replay.engine.replaying import replaying
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.late import parse_late
from fuselog.replay.engine.replaying.replaying import collect
from fuselog.replay.engine.streams.detections import detected_places
from fuselog.replay.engine.streams.measurements import PLANE
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.tracking.association.association import existence_after, marginals
from fuselog.replay.families.tracking.judging.errors import (
    instants_of,
    track_errors,
    track_figures,
    tracks_at,
)
from fuselog.replay.families.tracking.scan_sensors import place_clutter, polar_clutter
from fuselog.replay.inference.model.parameters import settings_type
from tests.replay.families.tracking import scan_scenes
from tests.replay.families.tracking.scan_scenes import FIELD_M, VARIANCE_M2

SECOND = 1_000_000_000
RADAR = {"sigma_m": "2.0", "detection_probability": "0.9", "clutter_per_m2": "1e-5"}
CAMERA = {"sigma_rad": "0.02", "detection_probability": "0.6", "clutter_per_rad": "0.5"}
Places = list[list[tuple[float, float]]]


def sensor(name: str, stated: dict[str, str], times_s: Any, seen: list[list[Any]]) -> list[Stream]:
    """Scans of a sensor at times in s, of places or of bearings."""
    stamps = SIMULATION_EPOCH_NS + np.rint(np.array(times_s) * SECOND).astype(np.int64)
    counts = [len(each) for each in seen]
    ids = np.arange(len(seen))
    told = [one for each in seen for one in each]
    scan = make_stream(
        f"/{name}/scan", schemas.SCAN, stamps, metadata=stated, scan_id=ids, detections=counts
    )
    own = {"publish_time_ns": np.repeat(stamps, counts), "scan_id": np.repeat(ids, counts)}
    if {"sigma_rad", "sigma_m"} <= stated.keys():
        polar = np.array(told, float).reshape(-1, 2)
        topic = f"/{name}/range_bearing"
        columns = {"range_m": polar[:, 0], "bearing_rad": polar[:, 1]}
        own_made: Any = make_stream
        return [scan, own_made(topic, schemas.SCAN_RANGE_BEARING, **own, **columns)]
    if "sigma_rad" in stated:
        seen_by: Any = make_stream
        bearing = seen_by(f"/{name}/bearing", schemas.SCAN_BEARING, **own, bearing_rad=told)
        return [scan, bearing]
    place: Any = np.array(told).reshape(-1, 2)
    made: Any = make_stream
    return [scan, made(f"/{name}/detection", schemas.DETECTION, **own, position_m=place)]


def log(*streams: list[Stream], scenario: str = "scene") -> MemorySource:
    run = RunMetadata(scenario, {}, None, 0, SIMULATION_EPOCH_NS, {})
    return memory_source(Recording([each for of in streams for each in of]), run)


def replay(source: MemorySource, label: str = "tracker:jipda", **settings: Any) -> dict[str, Any]:
    """The columns of each output."""
    outputs = replay_in_memory([source], {label: settings})
    return {topic.rpartition("/")[2]: ragged.stream for topic, ragged in outputs.items()}


def replay_late(source: MemorySource, late: str | None, **settings: Any) -> dict[str, Any]:
    """The same of messages as they arrive."""
    [bound] = bind("tracker:jipda", [source], settings)
    policy = None if late is None else parse_late(late, arrival_order=True)
    outputs = collect(replaying.replay([source], [bound], order="log_time", late=policy))
    return {topic.rpartition("/")[2]: ragged.stream for topic, ragged in outputs.items()}


def passing(seconds: int, y_m: float = 100.0) -> Places:
    """One target that goes along x at 2 m/s."""
    return [[(2.0 * second, y_m)] for second in range(seconds)]


def test_an_update_is_that_of_the_formula(uncompiled: None):
    """A track and two detections in its gate: Bar-Shalom and Fortmann, 6.4, with matrices."""
    seen = [*passing(8), [(15.0, 101.0), (18.0, 98.0)]]
    found = replay(log(sensor("radar", RADAR, range(9), seen)))
    rows = found["track"].publish_time_ns
    before, after = (np.flatnonzero(rows == SIMULATION_EPOCH_NS + at * SECOND)[0] for at in (7, 8))
    mean = found["track"]["mean"][before]
    covariance = found["track"]["covariance"][before].reshape(4, 4)
    move = np.kron(np.eye(2), [[1, 1], [0, 1]])
    noise = 0.1 * np.kron(np.eye(2), [[1 / 3, 1 / 2], [1 / 2, 1]])
    mean, covariance = move @ mean, move @ covariance @ move.T + noise
    rows_h = np.eye(4)[[0, 2]]
    spread = rows_h @ covariance @ rows_h.T + 4 * np.eye(2)
    innovation = np.array(seen[-1]) - rows_h @ mean
    squared = np.einsum("di,ij,dj->d", innovation, np.linalg.inv(spread), innovation)
    assert (squared < chi2.ppf(0.99, 2)).all()
    density = np.exp(-0.5 * squared) / (2 * np.pi * np.sqrt(np.linalg.det(spread)))
    existence = found["existence"]["existence"][before] * np.exp(-1 / 60)
    weights = 0.9 * existence * density / 1e-5
    [beta] = marginals([weights], [1 - 0.9 * 0.99 * existence])
    gain = covariance @ rows_h.T @ np.linalg.inv(spread)
    mixed = beta[1:] @ innovation
    outer = np.einsum("d,di,dj->ij", beta[1:], innovation, innovation) - np.outer(mixed, mixed)
    expected = covariance - (1 - beta[0]) * gain @ spread @ gain.T + gain @ outer @ gain.T
    np.testing.assert_allclose(found["track"]["mean"][after], mean + gain @ mixed, rtol=1e-12)
    np.testing.assert_allclose(
        found["track"]["covariance"][after].reshape(4, 4), expected, rtol=1e-9, atol=1e-12
    )
    told = found["existence"]["existence"][after]
    assert told == pytest.approx(existence_after(existence, beta[0], 0.9 * 0.99), rel=1e-12)
    last = found["association"].publish_time_ns == SIMULATION_EPOCH_NS + 8 * SECOND
    assert found["association"]["probability"][last] == pytest.approx(beta[1:], rel=1e-9)
    likeliest = int(beta[1:].argmax())
    told = found["innovation"].take(slice(-1, None))
    np.testing.assert_allclose(told["innovation"], [innovation[likeliest]], rtol=1e-9)
    np.testing.assert_allclose(told["covariance"], spread.reshape(1, 4), rtol=1e-9)
    assert told["normalised_innovation_squared"] == pytest.approx(squared[likeliest], rel=1e-9)


def test_tracks_begin_and_end_by_their_existence(uncompiled: None):
    """Clutter that comes once begins none; a target that is not seen any more is one no more."""
    seen = [*passing(8), *[[] for _ in range(12)]]
    seen[3].append((500.0, 500.0))
    found = replay(log(sensor("radar", RADAR, range(20), seen)))
    sizes = found["set"]["elements"].tolist()
    assert sizes[0] == 0
    assert max(sizes) == 1
    assert sizes[7] == 1
    assert sizes[-1] == 0
    assert set(found["track"]["track_id"]) == {1}
    existence = found["existence"]["existence"]
    assert existence[0] >= 0.97
    missed = existence[found["track"].publish_time_ns > SIMULATION_EPOCH_NS + 7 * SECOND]
    assert (np.diff(missed) < 0).all()


def test_tracks_begin_by_four_hits_in_six_chances(uncompiled: None):
    seen = passing(8)
    steady = replay(log(sensor("radar", RADAR, range(8), seen)), "tracker:hungarian")
    assert steady["set"]["elements"].tolist() == [0, 0, 0, 1, 1, 1, 1, 1]
    for gone in (1, 2, 4):
        seen[gone] = []
    seldom = replay(log(sensor("radar", RADAR, range(8), seen)), "tracker:hungarian")
    assert seldom["set"]["elements"].tolist() == [0] * 8


@pytest.mark.parametrize("association", ["nearest", "hungarian", "jpda"])
def test_tracks_are_managed_by_score(uncompiled: None, association: str):
    """The sum of log(P_D g / lambda) and log(1 - P_D P_G) passes Wald's bounds, up and down."""
    seen = [*passing(8), *[[] for _ in range(9)]]
    errors = {"false_confirmation": 1e-5, "missed_confirmation": 1e-5}
    found = replay(
        log(sensor("radar", RADAR, range(17), seen)),
        f"tracker:{association}",
        management="score",
        **errors,
    )
    # a first hit is worth about log(.9 / (2 pi 17 1e-5)) = 6.7, and Wald's upper bound is 11.5
    assert found["set"]["elements"].tolist()[:5] == [0, 0, 1, 1, 1]
    missed = np.log(1.0 - 0.9 * 0.99)
    lasting = int(np.floor(np.log(1e-5) / missed))
    assert found["set"]["elements"].tolist()[8:] == [1] * lasting + [0] * (9 - lasting)
    doubtful = replay(
        log(sensor("radar", {**RADAR, "clutter_per_m2": "0.01"}, range(17), seen)),
        f"tracker:{association}",
        management="score",
        **errors,
    )
    assert doubtful["set"]["elements"].tolist()[2] == 0


ALL_TOLD = {"confirming_existence": 1e-9, "keeping_existence": 0.0, "ending_existence": 1e-9}


def test_pmbm_of_one_target_and_one_detection(uncompiled: None):
    """Closed form: a detection is clutter, the known target, or one never detected before."""
    seen: Places = [[(0.0, 100.0)], [(2.0, 100.0)]]
    found = replay(log(sensor("radar", RADAR, range(2), seen)), "tracker:pmbm", **ALL_TOLD)
    unknown, clutter = 0.9 * 1e-6, 1e-5
    assert found["set"]["elements"].tolist() == [1, 2]
    first, known, new = found["existence"]["existence"]
    assert first == pytest.approx(unknown / (clutter + unknown), rel=1e-12)
    before = first * np.exp(-1 / 60)
    variance = 4 + 9 + 0.1 / 3 + 4
    density = np.exp(-0.5 * 2.0**2 / variance) / (2 * np.pi * variance)
    detected = 0.9 * before * density / (clutter + unknown)
    missed = 1 - 0.9 * 0.99 * before
    none = missed / (missed + detected)
    assert known == pytest.approx(existence_after(before, none, 0.9 * 0.99), rel=1e-9)
    assert new == pytest.approx(none * unknown / (clutter + unknown), rel=1e-9)


def test_pmbm_is_the_sum_over_all_maps(uncompiled: None):
    """Existence of two known and three new targets, by enumeration of all global hypotheses."""
    seen: Places = [[(0.0, 100.0), (6.0, 100.0)], [(2.0, 101.0), (4.0, 99.0), (7.0, 100.0)]]
    found = replay(log(sensor("radar", RADAR, range(2), seen)), "tracker:pmbm", **ALL_TOLD)
    unknown, clutter, detectable = 0.9 * 1e-6, 1e-5, 0.9 * 0.99
    existence = found["existence"]["existence"]
    before = existence[:2] * np.exp(-1 / 60)
    variance = 4 + 9 + 0.1 / 3 + 4
    apart = np.array(seen[1])[None] - np.array(seen[0])[:, None]
    density = np.exp(-0.5 * (apart**2).sum(axis=2) / variance) / (2 * np.pi * variance)
    weights, exists = [], []
    for chosen in product([None, 0, 1, 2], repeat=2):
        used = [each for each in chosen if each is not None]
        if len(used) != len(set(used)):
            continue
        weight, alive = 1.0, []
        for track, detection in enumerate(chosen):
            missed = 1 - detectable * before[track]
            if detection is None:
                weight *= missed
                alive.append((1 - detectable) * before[track] / missed)
            else:
                weight *= 0.9 * before[track] * density[track, detection]
                alive.append(1.0)
        for detection in range(3):
            is_left = detection not in used
            weight *= clutter + unknown if is_left else 1.0
            alive.append(unknown / (clutter + unknown) if is_left else 0.0)
        weights.append(weight)
        exists.append(alive)
    assert len(weights) == 13
    marginal = np.average(exists, weights=weights, axis=0)
    np.testing.assert_allclose(existence[2:], marginal, rtol=1e-9)


def test_existence_goes_with_any_association(uncompiled: None):
    """Of a single track all maps have the weights of jipda; the nearest detection is for certain."""
    source = log(sensor("radar", RADAR, range(10), [*passing(7), [], [], []]))
    jipda, jpda, nearest = (
        replay(source, label, management="existence")
        for label in ("tracker:jipda", "tracker:jpda", "tracker:nearest")
    )
    existence = [each["existence"]["existence"] for each in (jipda, jpda, nearest)]
    np.testing.assert_array_equal(existence[0], existence[1])
    assert existence[2][0] == 1.0
    missed = 1.0 - 0.9 * 0.99
    before = existence[2][-2] * np.exp(-1 / 60)
    assert existence[2][-1] == pytest.approx(missed * before / (1 - 0.9 * 0.99 * before), rel=1e-12)


def seen_by_fixes(places: Places) -> MemorySource:
    """One target's detections as scans, and as fixes of a vehicle that begins where a track would."""
    stamps = SIMULATION_EPOCH_NS + np.arange(len(places)) * SECOND
    made: Any = make_stream
    first = np.array(places[0][0])
    prior = made(
        "/target/prior",
        schemas.GAUSSIAN_ESTIMATE,
        stamps[:1],
        metadata=state_metadata(PLANE_MOTION),
        mean=[[first[0], 0.0, first[1], 0.0]],
        covariance=[np.diag([4.0, 9.0, 4.0, 9.0]).ravel()],
    )
    fixes = made(
        "/target/fix",
        schemas.POSITION_FIX,
        stamps[1:],
        metadata=state_metadata(PLANE),
        position_m=np.array(places[1:]).reshape(-1, 2),
        covariance_m2=np.tile((4.0 * np.eye(2)).ravel(), (len(places) - 1, 1)),
    )
    clear = {**RADAR, "clutter_per_m2": "1e-30", "gate_probability": "0.999999999"}
    return log(sensor("radar", clear, range(len(places)), places), [prior, fixes])


def turning(seconds: int) -> Places:
    """A target that goes straight on, turns sharply, and stands."""
    rng = np.random.default_rng(5)
    rates = np.where(np.abs(np.arange(seconds) - 15) < 4, 0.4, 0.0)
    speeds = np.where(np.arange(seconds) < 25, 8.0, 0.0)
    heading = np.cumsum(rates)
    path = np.cumsum(speeds[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    return [[tuple(place)] for place in path + 2.0 * rng.normal(size=path.shape)]


@pytest.mark.parametrize("association", ["jpda", "hungarian"])
def test_a_track_of_several_modes_is_an_interacting_multiple_model(uncompiled: None, association: str):
    """One target without clutter: states and modes are those of the house's own filter."""
    source = seen_by_fixes(turning(40))
    motion = {"turn_rate_radps": 0.0, "acceleration_sigma_mps2": 0.3}
    alone = {topic: each.stream for topic, each in replay_in_memory([source], {"imm": motion}).items()}
    label = f"tracker:{association}"
    found = replay(source, label, model="vehicle", motion=motion, hits_needed=1)
    rows = slice(-len(found["track"]), None)
    assert len(found["track"]) == 39
    assert found["modes"].components == ["drive", "manoeuvre", "stand"]
    for ours, theirs, field in (
        ("track", "state", "mean"),
        ("track", "state", "covariance"),
        ("modes", "modes", "probability"),
    ):
        expected = alone[f"/estimates/imm/target/{theirs}"][field][rows]
        np.testing.assert_allclose(found[ours][field], expected, rtol=1e-9, atol=1e-9)
    likeliest = found["modes"]["probability"].argmax(axis=1)
    assert set(likeliest) == {0, 1, 2}


def test_one_mode_of_a_model_is_a_filter(uncompiled: None):
    source = seen_by_fixes(passing(12))
    motion = {"turn_rate_radps": 0.02, "acceleration_sigma_mps2": 0.3}
    ekf = replay_in_memory([source], {"ekf": motion})["/estimates/ekf/target/state"]
    found = replay(
        source, "tracker:hungarian", model="vehicle", mode="drive", motion=motion, hits_needed=1
    )
    assert "modes" not in found
    np.testing.assert_allclose(found["track"]["mean"], ekf["mean"], rtol=1e-9, atol=1e-9)


def test_a_second_target_needs_distance_and_room(uncompiled: None):
    """Within `birth_distance_m` of a confirmed track none begins; without room that is said."""
    both = [[*near, *far] for near, far in zip(passing(30), passing(30, 125.0), strict=True)]
    for second in range(9):
        both[second] = both[second][:1]
    source = log(sensor("radar", RADAR, range(30), both))
    assert replay(source)["set"]["elements"].max() == 1
    assert replay(source, birth_distance_m=20.0)["set"]["elements"].max() == 2
    crowded = replay(source, birth_distance_m=20.0, most_tracks=1)
    assert crowded["set"]["elements"].max() == 1
    assert len(crowded["unused"]) == 21
    assert "most_tracks" in crowded["unused"].metadata["reasons"]


def test_detections_of_one_hull_are_joined(uncompiled: None):
    """Chains of those within a distance are one detection at their mean."""
    seen: Places = [[(x, 96.0), (x, 104.0), (x + 8.0, 104.0)] for [(x, _)] in passing(10)]
    joined = replay(log(sensor("radar", {**RADAR, "joined_within_m": "9"}, range(10), seen)))
    assert joined["set"]["elements"].max() == 1
    state = joined["track"]["mean"][-1]
    assert state == pytest.approx([18 + 8 / 3, 2, (96 + 104 + 104) / 3, 0], abs=0.3)


def test_bearings_sharpen_confirmed_tracks_alone(uncompiled: None):
    """They begin none, and a track takes one in every interval."""
    seconds = np.arange(20)
    bearings = [[np.arctan2(100.0, 2.0 * (second + 0.5))] for second in seconds]
    radar = sensor("radar", RADAR, seconds, passing(20))
    alone = replay(log(radar))
    often = replay(log(radar, sensor("camera", CAMERA, seconds + 0.5, bearings)))
    seldom = replay(
        log(radar, sensor("camera", {**CAMERA, "interval_s": "4.5"}, seconds + 0.5, bearings))
    )
    assert set(often["track"]["track_id"]) == {1}
    last_ns = SIMULATION_EPOCH_NS + 19 * SECOND
    variance = [
        float(found["track"]["covariance"][found["track"].publish_time_ns == last_ns][0, 0])
        for found in (often, seldom, alone)
    ]
    assert variance == sorted(variance)
    assert len(set(variance)) == 3
    assert often["association"].metadata["sensors"] == "radar,camera"


SURVEY = {**RADAR, "sigma_m": "1.0", "sigma_rad": "0.01", "sigma_across_m": "1.0"}


def test_ranges_with_bearings_are_places(uncompiled: None):
    """Measured in polar form, with the covariance that this has in the plane, tracks are the same."""
    places = passing(15, 400.0)
    polar = [[(np.hypot(x, y), np.arctan2(y, x))] for [(x, y)] in places]
    found = replay(log(sensor("radar", SURVEY, range(15), polar)))
    narrow = {**RADAR, "sigma_m": "1.0", "sigma_across_rad": "0.01"}
    planar = replay(log(sensor("radar", narrow, range(15), places)))
    assert len(found["track"]) == len(planar["track"]) >= 10
    np.testing.assert_allclose(found["track"]["mean"], planar["track"]["mean"], atol=0.05)
    covariance = (each["track"]["covariance"] for each in (found, planar))
    np.testing.assert_allclose(*covariance, atol=0.02)
    np.testing.assert_allclose(
        found["existence"]["existence"], planar["existence"]["existence"], atol=1e-3
    )


def test_biases_as_parameters_are_taken_off(uncompiled: None):
    places = passing(15, 400.0)
    polar = [[(np.hypot(x, y) + 20.0, np.arctan2(y, x) - 0.1)] for [(x, y)] in places]
    out = {**SURVEY, "bias_range_m": "20", "bias_rad": "-0.1"}
    found = replay(log(sensor("radar", out, range(15), polar)))
    np.testing.assert_allclose(found["track"]["mean"][-1], [28.0, 2.0, 400.0, 0.0], atol=0.05)
    off = [[(x + 7.0, y - 9.0)] for [(x, y)] in places]
    found = replay(log(sensor("radar", {**RADAR, "bias_x_m": "7", "bias_y_m": "-9"}, range(15), off)))
    np.testing.assert_allclose(found["track"]["mean"][-1], [28.0, 2.0, 400.0, 0.0], atol=0.05)


def test_clutter_in_polar_form_is_that_of_the_plane():
    """Over a disc it is its area times the density, whatever varies by range and sector."""
    names = ("clutter_per_m2", "near_range_m", "far_range_m", "far_clutter_factor")
    names += ("sector_from_rad", "sector_to_rad", "sector_clutter_factor")
    parameters = settings_type(names)(0.01, 20.0, 40.0, 3.0, 3.0, -3.0, 5.0)
    ranges = (np.arange(500) + 0.5) * 0.1
    turns = -np.pi + (np.arange(360) + 0.5) * 2 * np.pi / 360
    cells = [[polar_clutter((each, turn), parameters) for turn in turns] for each in ranges]
    steady, outer = 20.0**2 / 2, 3 * (50.0**2 - 40.0**2) / 2
    rising = sum(each * (1 + (each - 20) / 10) * 0.1 for each in ranges if 20 <= each <= 40)
    turned = 2 * np.pi + 4 * (2 * np.pi - 6.0)
    expected = 0.01 * (steady + rising + outer) * turned
    assert np.sum(cells) * 0.1 * 2 * np.pi / 360 == pytest.approx(expected, rel=0.01)
    place = 30.0 * np.cos(1.0), 30.0 * np.sin(1.0)
    assert place_clutter(place, parameters) == pytest.approx(0.02)
    assert place_clutter((-45.0, 0.0), parameters) == pytest.approx(0.15)


def test_misses_count_by_range_and_sector(uncompiled: None):
    """P_D .9 near, falling to .1; half of it in the sector: (1 - P_D P_G) tells how much a miss says."""
    limits = {"near_range_m": "50", "far_range_m": "150", "far_detection_probability": "0.1"}
    sector = {"sector_from_rad": "1.0", "sector_to_rad": "2.0", "sector_detection_factor": "0.5"}
    for stated, probability in ((limits, 0.5), (sector, 0.45), (limits | sector, 0.25)):
        seen = [*[[(0.0, 100.0)] for _ in range(8)], []]
        radar = sensor("radar", RADAR, range(8), seen[:8])
        found = replay(log(radar, sensor("lidar", {**RADAR, **stated}, [8], [[]])))
        before, after = found["existence"]["existence"][-2:]
        before *= np.exp(-1 / 60)
        assert after == pytest.approx(existence_after(before, 1.0, 0.99 * probability), rel=1e-3)


def test_a_miss_in_a_blind_sector_says_nothing(uncompiled: None):
    seen = [*passing(8), [], []]
    blind = {"blind_from_rad": 1.0, "blind_to_rad": 2.0}
    source = log(
        sensor("radar", RADAR, range(8), seen[:8]), sensor("lidar", RADAR, [8.5, 9.5], seen[8:])
    )
    told = replay(source)["existence"]["existence"]
    assert told[-1] < 0.5
    stated = {**RADAR, **{name: repr(value) for name, value in blind.items()}}
    turned = log(
        sensor("radar", RADAR, range(8), seen[:8]), sensor("lidar", stated, [8.5, 9.5], seen[8:])
    )
    assert replay(turned)["existence"]["existence"][-1] > 0.9


def test_clusters_that_are_too_large_are_told(uncompiled: None):
    """Thirteen tracks and detections in each other's gates; twelve are still summed."""
    for count, told in ((12, []), (13, [13])):
        row = [(1.0 * each, 0.0) for each in range(count)]
        found = replay(log(sensor("radar", {**RADAR, "sigma_m": "9"}, [0, 1], [row, row])))
        assert found["approximation"]["tracks"].tolist() == told


def test_a_detection_lies_beside_where_its_sensor_was_at_its_scan():
    """Scans are numbered in no order, have several detections or none; fixes come between them."""
    scan = make_stream(
        "/radar/scan", schemas.SCAN, [10, 20, 30], scan_id=[7, 3, 9], detections=[2, 0, 1]
    )
    detected = make_stream(
        "/radar/detection",
        schemas.DETECTION,
        [30, 10, 10],
        scan_id=[9, 7, 7],
        position_m=[[1.0, 2.0], [30.0, 4.0], [5.0, 60.0]],
    )
    fix = make_stream(
        "/ship/fix",
        schemas.POSITION_FIX,
        [12, 20, 31],
        position_m=[[100.0, 200.0], [400.0, 300.0], [999.0, 999.0]],
        covariance_m2=np.tile(np.eye(2).ravel(), (3, 1)),
    )
    assert detected_places(scan, detected, None).tolist() == detected["position_m"].tolist()
    found = detected_places(scan, detected, fix)
    assert found.tolist() == [[401.0, 302.0], [130.0, 204.0], [105.0, 260.0]]


def test_a_lag_is_of_the_measurement(uncompiled: None):
    """Detections that are where a target was 2 s ago lead to where it is now."""
    late: Places = [[(2.0 * second - 4.0, 100.0)] for second in range(20)]
    found = replay(log(sensor("radar", {**RADAR, "lag_s": "2"}, range(20), late)))
    assert found["track"]["mean"][-1] == pytest.approx([38, 2, 100, 0], abs=1.0)


def late_log() -> MemorySource:
    """A radar, and a lidar every other scan of which comes 1.2 s late; it is one radar scan behind."""
    radar = sensor("radar", RADAR, range(16), passing(16))
    times = np.arange(15) + 0.5
    lidar = sensor("lidar", RADAR, times, [[(2.0 * time, 100.5)] for time in times])
    delayed = []
    for stream in lidar:
        late_ns = np.where(np.arange(len(stream)) % 2 == 0, 1_200_000_000, 0)
        delayed.append(replace(stream, log_time_ns=stream.publish_time_ns + late_ns))
    return log(radar, delayed)


@pytest.mark.parametrize("late", ["wait:2", "rewind:2"])
def test_late_scans_in_their_place(uncompiled: None, late: str):
    """What is known after the last one is what is known in order, to the last bit."""
    source = late_log()
    in_order = replay(source)
    found = replay_late(source, late)
    state = [each["track"]["mean"][-1] for each in (found, in_order)]
    np.testing.assert_array_equal(*state)
    assert not len(found["skipped"])
    rewound = found.get("rewound")
    if late == "rewind:2":
        assert rewound is not None
        assert rewound["repeated"].tolist() == [2] * 7 + [1]
        assert len(found["set"]) == len(in_order["set"])
    else:
        assert found["set"]["elements"].tolist() == in_order["set"]["elements"].tolist()


def test_late_scans_are_left_out_and_counted(uncompiled: None):
    source = late_log()
    dropped = replay_late(source, "drop")
    assert len(dropped["skipped"]) == 16  # scans, and their detections
    plain = replay_late(source, None)
    assert len(plain["unused"]) == 8
    assert "rewind" in plain["unused"].metadata["reasons"]
    np.testing.assert_array_equal(dropped["track"]["mean"], plain["track"]["mean"])


def _without(streams: list[Stream], *topics: str) -> list[Stream]:
    return [each for each in streams if each.topic not in topics]


def _numbered(streams: list[Stream], number: list[int]) -> list[Stream]:
    scan, detection = streams
    columns = {**scan.columns, "scan_id": np.array(number, np.uint32)}
    made: Any = make_stream
    again = made(scan.topic, scan.schema, scan.publish_time_ns, metadata=scan.metadata, **columns)
    return [again, detection]


@pytest.mark.parametrize(
    ("streams", "settings", "said"),
    [
        (sensor("camera", CAMERA, [0], [[0.5]]), {}, "cannot begin from bearings only"),
        (
            sensor("radar", {**RADAR, "origin": "/own/fix"}, [0], [[(1, 2)]]),
            {},
            r"topic /own/fix \(fuselog.PositionFix\), is missing",
        ),
        (_numbered(sensor("radar", RADAR, [0, 1], [[], []]), [4, 4]), {}, "two scans have the number 4"),
        (_numbered(sensor("radar", RADAR, [0], [[(1, 2)]]), [7]), {}, "states 1 detections, but has 0"),
        (
            _without(sensor("radar", RADAR, [0], [[(1, 2)]]), "/radar/scan"),
            {},
            "detections without scans; record",
        ),
        (sensor("radar", {"sigma_m": "1"}, [0], [[]]), {}, "does not state clutter_per_m2.*--set"),
        (sensor("radar", RADAR, [0], [[]]), {"sensors": ["lidar"]}, "no scans of sensor lidar"),
        (
            sensor("radar", RADAR, [0], [[]]),
            {"model": "vehicle"},
            "states turn_rate_radps; .*--set motion.",
        ),
        (
            sensor("radar", RADAR, [0], [[]]),
            {"model": "robot"},
            "robot: the model is driven by odometry",
        ),
        (sensor("radar", RADAR, [0], [[]]), {"model": "batch-reactor"}, "has no position x_m, y_m"),
        (sensor("radar", RADAR, [0], [[]]), {"management": "hits"}, "management = hits with jpda"),
        (
            sensor("radar", RADAR, [0], [[]]),
            {"motion": {"turn_rate_radps": 0.0}},
            "need a model; set model=",
        ),
    ],
)
def test_bad_input_is_named(uncompiled: None, streams, settings, said: str):
    with pytest.raises(BadInput, match=said):
        replay(log(streams), **settings)


def test_pmbm_follows_targets_in_clutter():
    """Five targets, ten false detections a scan. None vanishes, as jipda takes for granted."""
    settings = {"acceleration_density": 0.04, "birth_sigma_mps": 1.0, "sigma_m": VARIANCE_M2**0.5}
    settings |= {"birth_distance_m": 0.0, "same_within_m": 0.0}
    scenes = [scan_scenes.simulate(seed, clutter=10.0) for seed in range(6)]
    sources = [scan_scenes.source(scene, clutter=10.0) for scene in scenes]
    found = {}
    for name, own in (("jipda", {}), ("pmbm", {"undetected_per_m2": 5 / FIELD_M**2 / 50})):
        label, parts = f"tracker:{name}", []
        outputs = replay_in_memory(sources, {label: settings | own})
        for run, scene in enumerate(scenes):
            sizes, tracks = (
                outputs[f"/estimates/{label}/{leaf}"].of_run(run) for leaf in ("set", "track")
            )
            told = tracks_at(sizes, tracks, sizes.publish_time_ns[10:])
            true = np.moveaxis(scene.states[11:, :, 0::2], 1, 0)
            each = track_errors(told, true, cutoff_m=5.0)
            parts.append([part.mean() for part in (each.gospa_all, each.missed, each.false)])
        found[name] = np.mean(parts, axis=0)
    gospa, missed, false = found["pmbm"]
    assert gospa < 1.1 * found["jipda"][0]
    assert missed / 12.5 < 0.2  # targets, at half the square of the cutoff each
    assert false / 12.5 < 0.1


@pytest.mark.paper
def test_the_sheets_reference_trackers(autoferry_log: Callable[[int], MemorySource]):
    """Radar and lidar over all scenarios, within the sheet's tolerances of its row, or better."""
    sources = [autoferry_log(number) for number in (2, 3, 5, 13, 16, 22)]
    label = "tracker:jipda"
    outputs = replay_in_memory(sources, {label: {"sensors": ["radar", "lidar"]}})
    figures = []
    for run, source in enumerate(sources):
        at_ns, true, limit_m = instants_of(source)
        sizes, tracks = (outputs[f"/estimates/{label}/{leaf}"].of_run(run) for leaf in ("set", "track"))
        told = tracks_at(sizes, tracks, at_ns)
        figures.append(track_figures(track_errors(told, true, unreferenced_m=limit_m)))
    mean = {name: np.mean([each[name] for each in figures]) for name in figures[0]}
    assert mean["gospa_m"] < 9.16
    theirs = [5.86, 11.30, 10.28, 8.70, 5.56, 13.28]
    assert all(each["gospa_m"] < one + 0.2 for each, one in zip(figures, theirs, strict=True))
    assert mean["target1_rmse_m"] == pytest.approx(4.89, abs=0.7)
    assert mean["target2_rmse_m"] == pytest.approx(3.92, abs=0.7)
    assert mean["target1_coverage"] == pytest.approx(0.92, abs=0.02)
    assert mean["target2_coverage"] == pytest.approx(0.81, abs=0.02)
    rewound = replay_late(sources[5], "rewind:1", sensors=["radar", "lidar"])
    assert len(rewound["rewound"]) == 5
    last = outputs[f"/estimates/{label}/track"].of_run(5)["mean"][-1]
    np.testing.assert_array_equal(rewound["track"]["mean"][-1], last)
    late = track_figures(
        track_errors(tracks_at(rewound["set"], rewound["track"], at_ns), true, unreferenced_m=limit_m)
    )
    assert late["gospa_m"] == pytest.approx(figures[5]["gospa_m"], abs=0.05)
    one = replay_in_memory(sources[2:3], {label: {"sensors": ["radar", "lidar"]}})
    for leaf in ("set", "track", "association"):
        both = outputs[f"/estimates/{label}/{leaf}"].of_run(2), one[f"/estimates/{label}/{leaf}"].stream
        for name, column in both[0].columns.items():
            np.testing.assert_array_equal(column, both[1][name])
