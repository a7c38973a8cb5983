"""Set estimates in the log: section V, random scenes, faults, and real frames."""

import numpy as np
import pytest

from pipeline.ensemble import record_ensemble, replay_ensemble
from recorders.errors import BadInput
from recorders.recording import import_run
from replay.engine import bind
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
        assert each.faults == 0
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


def test_a_log_without_a_bound_asks_for_it(mrclam6):
    recording, run = import_run("mrclam", mrclam6, {})
    source = memory_source(recording, run)
    with pytest.raises(BadInput, match="bound_deg"):
        bind("set-membership:exact", [source], {})


def test_mrclam_fixes(mrclam6):
    """The sheet's shares and areas at two bounds; the misses are robot 3's misidentifications."""
    recording, run = import_run("mrclam", mrclam6, {})
    sources = [memory_source(recording, run)]
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
        sizes = np.concatenate([each.area_m2 for each in found])[known]
        assert np.median(sizes) == pytest.approx(area, rel=0.10)
