"""Set estimates in the log: section V, random scenes, faults, and real frames."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.path import Path

from pipeline.ensemble import record_ensemble, replay_ensemble
from recorders.errors import BadInput
from recorders.recording import import_run
from replay.engine import bind
from replay.estimators.feasible_sets import box, exact_set, excess_rad, rings
from replay.estimators.pseudo_ellipsoids import fit, room
from replay.estimators.set_membership import SetParameters, frames, map_and_arena
from replay.evaluation import truth_at
from replay.set_evaluation import judge_sets
from replay.sources import memory_source

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
    sources = record_ensemble("relative-bearings", parameters, 5, 5)
    replayed, sets = judged(sources, weighting="equal")
    for each in sets.values():
        assert len(each.inside) == 15
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
def real(mrclam6):
    return memory_source(*import_run("mrclam", mrclam6, {}))


def test_a_log_without_a_bound_asks_for_it(real):
    with pytest.raises(BadInput, match="bound_deg"):
        bind("set-membership:exact", [real], {})


def test_mrclam_fixes(real):
    """The sheet's shares and areas at two bounds; the misses are robot 3's misidentifications."""
    sources = [real]
    for bound_deg, share, area in ((1.5, 0.978, 1.28), (3.0, 0.9975, 4.5)):
        replayed = replay_ensemble(
            sources,
            {"exact": {"kind": "set-membership:exact", "bound_deg": bound_deg}},
            gap_limit_s=0.2,
        )
        found = judge_sets(replayed.outputs, sources, 0.2)
        known = np.concatenate([each.known for each in found])
        assert known.sum() == 1197
        inside = np.concatenate([each.inside for each in found])[known]
        assert inside.mean() == pytest.approx(share, abs=0.005)
        assert sum(each.violations for each in found) == 0
        sizes = np.concatenate([each.area_m2 for each in found])[known]
        assert np.median(sizes) == pytest.approx(area, rel=0.10)


def test_every_real_frame_whose_bound_holds_is_in_its_sets(real):
    """Containment with no exception: where all relative bearings of a frame keep the bound of 2 deg."""
    known, arena = map_and_arena(real.streams["/landmarks"], SetParameters().arena_margin_m)
    judged_frames = 0
    for robot in range(1, 6):
        seen, truth = (real.streams[f"/robot{robot}/{leaf}"] for leaf in ("range_bearing", "truth"))
        found = list(frames(seen, known, np.radians(2.0), 3))
        times = np.array([frame.time_ns for frame in found])
        places = truth_at(truth, times, ["linear", "linear", "angle"], 0.2)[:, :2]
        for frame, place in zip(found, places, strict=True):
            if np.isnan(place[0]) or excess_rad(frame.pairs, place).max() > 0:
                continue  # no truth, or a bound that does not hold
            judged_frames += 1
            border = exact_set(frame.pairs, arena)
            low, high = box(border)
            assert np.all((low <= place) & (place <= high))
            assert sum(Path(ring, closed=False).contains_point(place) for ring in rings(border)) % 2
            for order in (4, 8):
                assert room(fit(frame.pairs, arena, order, "equal"), place) >= -1e-9
    assert judged_frames > 1100


def test_two_landmarks_at_one_place_are_refused():
    (source,) = record_ensemble("relative-bearings", {}, 1, 1)
    landmarks = source.streams["/landmarks"]
    places = landmarks["position_m"].copy()
    places[1] = places[0]
    streams = {
        **source.streams,
        "/landmarks": replace(landmarks, columns={**landmarks.columns, "position_m": places}),
    }
    with pytest.raises(BadInput, match="coincide"):
        judged([replace(source, streams=streams)], ("exact",))
