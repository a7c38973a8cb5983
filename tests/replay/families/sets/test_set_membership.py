"""Set estimates in the log: section V, random scenes, faults, and real frames."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.path import Path

from fuselog.pipeline.runs.recorded import record_ensemble, replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, make_stream, open_log, schemas, write_log
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.streams.sources import LogSource, memory_source
from fuselog.replay.engine.vectors.tangent import truth_at
from fuselog.replay.families.sets.judging.evaluation import judge_sets
from fuselog.replay.families.sets.regions.feasible_sets import (
    arena_around,
    box,
    exact_set,
    excess_rad,
    rings,
)
from fuselog.replay.families.sets.regions.frames import Known, frames
from fuselog.replay.families.sets.regions.pseudo_ellipsoids import fit, room

pytestmark = pytest.mark.paper

SHAPES = ("exact", "box", "l4", "l8")


def judged(sources, shapes=SHAPES, **values):
    estimators = {shape: {"kind": f"set-membership:{shape}", **values} for shape in shapes}
    replayed = replay_ensemble(sources, estimators, gap_limit_s=0.2)
    return replayed, {e.estimator: e for e in judge_sets(replayed.outputs, sources, 0.2)}


def test_section_v_through_the_log():
    _, sets = judged(record_ensemble("relative-bearings", {}, 1, 1))
    area = {shape: sets[shape].area_m2[0] for shape in SHAPES}
    assert area["exact"] == pytest.approx(0.01464, rel=3e-3)
    assert area["box"] == pytest.approx(0.02904, rel=0.01)
    assert area["l8"] == pytest.approx(0.0197, rel=0.03)
    assert area["l4"] == pytest.approx(0.0309, rel=0.04)
    # the sheet: "L4 < box" is false for the final set
    assert area["exact"] < area["l8"] < area["box"] < area["l4"]
    assert all(each.inside.all() for each in sets.values())


def test_every_set_holds_the_truth_in_random_scenes():
    parameters = {"scene": "random", "looks": 3, "landmarks": 4, "bound_deg": 3.0}
    sources = record_ensemble("relative-bearings", parameters, 5, 2)
    replayed, sets = judged(sources, weighting="equal")
    for each in sets.values():
        assert len(each.inside) == 6
        assert each.inside.all()
        assert each.bound_holds.all()
        assert each.violations == each.faults == 0
    assert len(replayed.outputs["/estimates/exact/robot1/fault"]) == 0


def test_a_misidentified_landmark_is_a_fault_with_its_pair():
    parameters = {
        "scene": "random",
        "looks": 40,
        "landmarks": 6,
        "bound_deg": 1.0,
        "error_share": 0.5,
        "misidentified_probability": 0.03,
    }
    sources = record_ensemble("relative-bearings", parameters, 2, 1)
    clean = record_ensemble("relative-bearings", {**parameters, "misidentified_probability": 0.0}, 2, 1)
    replayed, sets = judged(sources, ("exact",))
    _, right = judged(clean, ("exact",))
    assert right["exact"].faults == 0
    faults = replayed.outputs["/estimates/exact/robot1/fault"].stream
    assert sets["exact"].faults > 5
    spoilt, true = (each[0].streams["/robot1/relative_bearing"] for each in (sources, clean))
    # same seed, but the draws of wrong landmarks differ: a pair is wrong where it misses its true angle
    angle = {
        (a, b): c for a, b, c in zip(true["first_id"], true["second_id"], true["angle_rad"], strict=True)
    }
    blamed = [
        abs(np.angle(np.exp(1j * (c - angle[a, b])))) > np.radians(1.5)
        for a, b, c in zip(faults["first_id"], faults["second_id"], faults["angle_rad"], strict=True)
    ]
    assert np.mean(blamed) > 0.9
    assert len(spoilt) == len(true)


@pytest.fixture(scope="module")
def real(mrclam6_log):
    return mrclam6_log


@pytest.fixture(scope="module")
def fourth(real):
    """The first quarter of the log."""
    topics = [f"/robot{robot}/{leaf}" for robot in range(1, 6) for leaf in ("range_bearing", "truth")]
    end_ns = real.epoch_ns + 0.25 * (real.streams["/robot1/truth"].publish_time_ns[-1] - real.epoch_ns)
    kept = {topic: real.streams[topic] for topic in topics}
    kept = {topic: each.take(each.publish_time_ns <= end_ns) for topic, each in kept.items()}
    return replace(real, streams={**real.streams, **kept})


def test_a_log_without_a_bound_asks_for_it(real):
    with pytest.raises(BadInput, match="bound_deg"):
        bind("set-membership:exact", [real], {})


def hall(source):
    """The rectangle around the landmarks, wider by 1.25 m: what the sheet's areas are of."""
    low, high = arena_around(source.streams["/landmarks"]["position_m"], 1.25)
    return *low.tolist(), *high.tolist()


def test_mrclam_fixes(real):
    """The sheet's share and area; the misses are robot 3's misidentifications."""
    values = {"kind": "set-membership:exact", "bound_deg": 1.5, "arena_m": hall(real)}
    replayed = replay_ensemble([real], {"exact": values}, gap_limit_s=0.2)
    found = judge_sets(replayed.outputs, [real], 0.2)
    known = np.concatenate([each.known for each in found])
    assert known.sum() == 1197
    inside = np.concatenate([each.inside for each in found])[known]
    assert inside.mean() == pytest.approx(0.978, abs=0.005)
    assert sum(each.violations for each in found) == 0
    sizes = np.concatenate([each.area_m2 for each in found])[known]
    assert np.median(sizes) == pytest.approx(1.28, rel=0.10)


def test_what_the_sensor_reaches_bounds_the_sets_where_nobody_states_an_arena(fourth):
    """Nothing is fitted to the set: no robot is outside, none missed; half the hall leaves some out."""
    values = {"kind": "set-membership:exact", "bound_deg": 3.0}
    low_x, low_y, high_x, high_y = hall(fourth)
    half = {**values, "arena_m": (low_x, 0.5 * (low_y + high_y), high_x, high_y)}
    replayed = replay_ensemble([fourth], {"known": values, "half": half}, gap_limit_s=0.2)
    found = judge_sets(replayed.outputs, [fourth], 0.2)
    known, halved = ([each for each in found if each.estimator == name] for name in ("known", "half"))
    assert sum(each.known.sum() for each in known) == 237
    assert sum(each.violations for each in known) == sum(each.outside_arena for each in known) == 0
    assert sum(each.outside_arena for each in halved) > 25
    assert sum(each.violations for each in halved) == 0


def beyond(range_m, stated=()):
    """A robot 1.33 m beyond all landmarks: ranges and exact bearings of one look."""
    places, place = np.array([[0.0, 0.0], [4.0, 0.5], [2.0, 3.0]]), np.array([2.0, 4.33])
    way = places - place
    stamp = [10**9]
    streams = [
        make_stream("/landmarks", schemas.LANDMARK, [0] * 3, landmark_id=[3, 1, 2], position_m=places),
        make_stream(
            "/robot1/truth",
            schemas.TRUTH_STATE,
            stamp,
            metadata={"components": "y_m,x_m", "kinds": "linear,linear"},
            state=[place[::-1]],
        ),
        make_stream(
            "/robot1/bearing",
            schemas.BEARING,
            stamp * 3,
            metadata=dict(stated),
            target_id=[3, 1, 2],
            bearing_rad=np.arctan2(way[:, 1], way[:, 0]),
        ),
    ]
    if range_m is not None:
        seen = make_stream(
            "/robot1/range_bearing",
            schemas.RANGE_BEARING,
            stamp * 3,
            target_id=[3, 1, 2],
            range_m=range_m + np.hypot(*way.T),
            bearing_rad=np.arctan2(way[:, 1], way[:, 0]),
        )
        streams[-1] = seen
    return memory_source(Recording(streams), RunMetadata("test"))


@pytest.mark.parametrize(
    ("source", "values", "outside"),
    [
        (beyond(0.1), {}, 0),  # the longest range that was measured
        (beyond(None, {"maximum_range_m": "5.0"}), {}, 0),
        (beyond(None), {"maximum_range_m": 5.0}, 0),
        (beyond(0.1, {"maximum_range_m": "1.0"}), {"maximum_range_m": 5.0}, 0),
        (beyond(None), {"maximum_range_m": 4.0}, 1),  # it is 4.77 m from the first landmark
        (beyond(0.1), {"arena_m": (-1.25, -1.25, 5.25, 4.25)}, 1),
    ],
)
def test_a_robot_outside_the_arena_is_counted_apart_from_a_broken_guarantee(source, values, outside):
    """1.33 m beyond the landmarks: the sensor's range holds it; a wrong premise is named as such."""
    _, sets = judged([source], ("exact",), bound_deg=4.0, **values)
    exact = sets["exact"]
    assert exact.known.all()
    assert exact.bound_holds.all()
    assert (exact.outside_arena, exact.violations) == (outside, 0)
    assert exact.inside.all() == (not outside)


def test_bearings_alone_need_an_arena_or_a_range():
    with pytest.raises(BadInput, match=r"has no ranges .* --set maximum_range_m"):
        judged([beyond(None)], ("exact",), bound_deg=4.0)
    with pytest.raises(BadInput, match="low x, low y, high x, high y"):
        judged([beyond(0.1)], ("exact",), bound_deg=4.0, arena_m=(1, 1, 0, 2))


def test_the_sets_of_a_span_are_judged_by_their_own_frames(tmp_path):
    parameters = {"scene": "random", "looks": 9, "landmarks": 4, "bound_deg": 3.0}
    (whole,) = record_ensemble("relative-bearings", parameters, 5, 1)
    write_log(tmp_path / "log.mcap", list(whole.streams.values()), whole.run)
    stamps_ns = whole.streams["/robot1/truth"].publish_time_ns
    part = LogSource(open_log(tmp_path / "log.mcap"), start_ns=int(stamps_ns[4]))
    _, sets = judged([part], ("exact",))
    assert len(sets["exact"].inside) == 5
    assert sets["exact"].bound_holds.all()
    assert sets["exact"].violations == sets["exact"].outside_arena == 0


def test_neither_the_order_of_the_map_nor_a_landmark_seen_twice_changes_a_set():
    """A landmark seen twice at the same angle says nothing new, and is not two landmarks."""
    source = beyond(0.1)
    landmarks, seen = source.streams["/landmarks"], source.streams["/robot1/range_bearing"]
    others = {
        "once": source.streams,
        "sorted": {**source.streams, "/landmarks": landmarks.take(np.array([1, 2, 0]))},
        "twice": {**source.streams, "/robot1/range_bearing": seen.take(np.array([0, 1, 2, 1]))},
        "two": {**source.streams, "/robot1/range_bearing": seen.take(np.array([0, 1, 1]))},
    }
    areas = {}
    for name, streams in others.items():
        _, sets = judged(
            [memory_source(Recording(list(streams.values())), source.run)], ("exact",), bound_deg=4.0
        )
        areas[name] = sets["exact"].area_m2
    assert areas["sorted"] == pytest.approx(areas["once"], rel=1e-12)
    assert areas["twice"] == pytest.approx(areas["once"], rel=1e-9)
    assert len(areas["two"]) == 0


def test_every_real_frame_whose_bound_holds_is_in_its_sets(real):
    """Of every sixth frame, with no exception: where all bearings keep the bound of 2 deg."""
    known = Known(np.radians(2.0), 3, None, None)
    judged_frames = 0
    for robot in range(1, 6):
        seen, truth = (real.streams[f"/robot{robot}/{leaf}"] for leaf in ("range_bearing", "truth"))
        found = list(frames(seen, real.streams["/landmarks"], known))[::6]
        times = np.array([frame.time_ns for frame in found])
        places = truth_at(truth, times, ["linear", "linear", "angle"], 0.2)[:, :2]
        for frame, place in zip(found, places, strict=True):
            if np.isnan(place[0]) or excess_rad(frame.pairs, place).max() > 0:
                continue  # no truth, or a bound that does not hold
            judged_frames += 1
            border = exact_set(frame.pairs, frame.arena)
            low, high = box(border)
            assert np.all((low <= place) & (place <= high))
            assert sum(Path(ring, closed=False).contains_point(place) for ring in rings(border)) % 2
            for order in (4, 8):
                assert room(fit(frame.pairs, frame.arena, order, "equal"), place) >= -1e-9
    assert judged_frames > 183


def test_two_landmarks_at_one_place_are_refused():
    (source,) = record_ensemble("relative-bearings", {}, 1, 1)
    landmarks = source.streams["/landmarks"]
    places = landmarks["position_m"].copy()
    places[1] = places[0]
    streams = {
        **source.streams,
        "/landmarks": replace(landmarks, columns={**landmarks.columns, "position_m": places}),
    }
    with pytest.raises(BadInput, match="at the same position"):
        judged([replace(source, streams=streams)], ("exact",))
