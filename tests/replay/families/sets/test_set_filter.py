"""Sets over time: no true pose is lost while bounds hold, faults are isolated, the judge can tell."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from fuselog.pipeline.runs.recorded import record_ensemble, replay_ensemble
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.families.sets.judging.filter_evaluation import judge_filter
from fuselog.replay.families.sets.regions.frames import (
    CONTRADICTS_ITSELF,
    CONTRADICTS_PAST,
    FRAME_WRONG,
    PAST_WRONG,
)
from fuselog.replay.families.sets.regions.moving_sets import (
    Headings,
    Motion,
    all_headings_of,
    common_headings,
    directions,
    from_rings,
    moved,
    to_rings,
    within_l8,
)

DRIVE = {
    "landmarks": 5,
    "duration_s": 40.0,
    "range_bearing": {"rate_hz": 0.5, "sigma_bearing_rad": 0.005, "maximum_range_m": 9.0},
}
BOUNDS = {
    "kind": "set-filter:exact",
    "bound_deg": 2.0,
    "bearing_bound_rad": 0.025,
    "position_error_m": 0.1,
    "position_error_mps": 0.05,
    "heading_error_rad": 0.06,
    "heading_error_radps": 0.01,
}
SHAPE = shapely.Polygon([(0, 0), (2, 0), (2, 1), (1, 0.3), (0, 1)])


def test_where_a_robot_may_be_after_a_motion_and_was_before_it():
    rng = np.random.default_rng(3)
    for half in (0.0, 0.3, 1.5, 2.5, np.pi):
        headings = Headings(2.9, half)
        motion = Motion(np.array([0.7, -0.4]), 0.05, 0.0, 0.0)
        inside = shapely.get_coordinates(SHAPE)[rng.integers(0, 5, 300)]
        heading = headings.middle_rad + half * rng.uniform(-1, 1, 300)
        wrong = rng.uniform(-np.pi, np.pi, 300)
        step = motion.displacement_m + 0.05 * np.stack([np.cos(wrong), np.sin(wrong)], axis=1)
        turn = np.exp(1j * heading) * (step[:, 0] + 1j * step[:, 1])
        there = inside + np.stack([turn.real, turn.imag], axis=1)
        after = moved(SHAPE, headings, motion)
        assert shapely.intersects_xy(after, there[:, 0], there[:, 1]).all()
        for start, end in zip(inside[:20], there[:20], strict=True):
            before = moved(shapely.Point(end).buffer(1e-9), headings, motion, -1)
            assert before.intersects(shapely.Point(start))
    # no wider than what is added for the polygon of an offset
    sure = moved(SHAPE, Headings(0.0, 0.0), motion)
    assert sure.area < SHAPE.buffer(0.05 * 1.03, quad_segs=64).area


def test_intervals_of_headings():
    assert common_headings(Headings(3.0, 0.2), Headings(-3.1, 0.2)) == pytest.approx(
        (3.0916, 0.1084), abs=1e-3
    )
    assert common_headings(Headings(0.0, 0.2), Headings(1.0, 0.2)) is None
    narrow = Headings(1.0, 1.5)
    assert common_headings(Headings(-2.0, 3.0), narrow) == narrow  # they meet at both ends
    assert all_headings_of(Headings(3.0, 0.1), Headings(-3.0, 0.1)).half_rad == pytest.approx(
        0.2416, abs=1e-3
    )
    seen = directions(shapely.box(1.0, -1.0, 2.0, 1.0), np.zeros(2))
    assert abs(seen.middle_rad) == pytest.approx(np.pi)
    assert seen.half_rad == pytest.approx(np.pi / 4, abs=1e-6)
    assert directions(shapely.box(-1.0, -1.0, 2.0, 1.0), np.zeros(2)).half_rad == np.pi


def test_a_vertex_on_an_edge_is_no_corner():
    """It is there or not as rounding has it; one that is off the edge is kept."""
    for off, corners in ((1e-15, 4), (1e-8, 5)):
        square = shapely.Polygon([(0, 0), (0.7, -off), (1, 0), (1, 1), (0, 1)])
        assert [len(ring) for ring in to_rings(square)] == [corners]


def test_l8_is_around_a_set_in_two_pieces_and_rings_keep_holes():
    pieces = SHAPE.union(shapely.Point(4, 3).buffer(0.3))
    around = within_l8(pieces)
    assert around.covers(pieces)
    assert pieces.area < around.area < 2.5 * pieces.area < pieces.convex_hull.area
    ring = SHAPE.difference(shapely.Point(0.3, 0.3).buffer(0.1))
    assert from_rings(to_rings(ring)).symmetric_difference(ring).area == pytest.approx(0.0, abs=1e-12)


def followed(source: MemorySource, **values):
    settings = {"filter": {**BOUNDS, **values}}
    replayed = replay_ensemble([source], settings, gap_limit_s=0.2)
    [found] = judge_filter(replayed.outputs, [source], 0.2)
    return replayed, found


@pytest.fixture(scope="module")
def source() -> MemorySource:
    return record_ensemble("landmarks", DRIVE, 4, 1)[0]


@pytest.mark.parametrize("most_edges", [400, 4])
def test_sets_hold_the_robot_while_bounds_hold(source, most_edges):
    replayed, found = followed(source, most_edges=most_edges)
    assert found.guaranteed.all()
    assert found.violations == 0
    assert (found.finding == -1).all()
    assert (found.growth > 1.0).any() == (most_edges == 4)
    # what is judged can fail: sets beside the robot, and odometry that errs more than is stated
    sets = replayed.outputs["/estimates/filter/robot1/set"]
    columns = {**sets.stream.columns, "vertex": sets["vertex"] + 5.0}
    aside = {**replayed.outputs}
    aside["/estimates/filter/robot1/set"] = Ragged(replace(sets.stream, columns=columns), sets.offsets)
    [beside] = judge_filter(aside, [source], 0.2)
    assert beside.violations > 0
    _, tight = followed(source, position_error_m=0.0, position_error_mps=0.001)
    assert not tight.odometry_holds.all()
    assert not tight.guaranteed.all()
    assert tight.violations == 0


def spoilt(source: MemorySource, topic: str, field: str, first_s: float, end_s: float, spoil):
    """The log with one column of a topic changed between two times."""
    stream = source.streams[topic]
    elapsed_s = (stream.publish_time_ns - source.epoch_ns) * 1e-9
    chosen = (elapsed_s > first_s) & (elapsed_s < end_s)
    columns = {**stream.columns, field: np.where(chosen, spoil(stream), stream[field])}
    return replace(source, streams={**source.streams, topic: replace(stream, columns=columns)})


def found_wrong(found):
    return [finding for finding in found.finding.tolist() if finding >= 0]


def test_a_frame_that_contradicts_the_past_is_isolated_by_the_next(source):
    """All bearings of one frame are as from a place 1.5 m away: its set alone holds nothing true."""
    truth, landmarks = source.streams["/robot1/truth"], source.streams["/landmarks"]
    places = dict(zip(landmarks["landmark_id"].tolist(), landmarks["position_m"], strict=True))

    def from_elsewhere(stream):
        pose = truth["state"][np.searchsorted(truth.publish_time_ns, stream.publish_time_ns)]
        away = np.array([places[target] for target in stream["target_id"].tolist()]) - pose[:, :2] - 1.0
        return np.arctan2(away[:, 1], away[:, 0]) - pose[:, 2]

    wrong = spoilt(source, "/robot1/range_bearing", "bearing_rad", 19, 21, from_elsewhere)
    _, found = followed(wrong)
    assert (~found.frame_holds).sum() == 1
    assert found_wrong(found) == [CONTRADICTS_PAST, FRAME_WRONG]
    assert found.guaranteed.all()
    assert found.violations == 0


def test_a_past_that_was_wrong_is_isolated_too(source):
    """Odometry says for less than half a second that the robot went twelve times as fast."""
    wrong = spoilt(
        source,
        "/robot1/odometry",
        "forward_mps",
        20.8,
        21.2,
        lambda stream: 12.0 * stream["forward_mps"],
    )
    _, found = followed(wrong)
    assert found_wrong(found) == [CONTRADICTS_PAST, PAST_WRONG]
    assert not found.odometry_holds.all()
    assert found.guaranteed.all()
    assert found.violations == 0


def test_a_frame_that_contradicts_itself_is_left_out(source):
    """The bearings of one frame are mirrored; a pair to blame is named."""
    wrong = spoilt(
        source, "/robot1/range_bearing", "bearing_rad", 19, 21, lambda stream: -stream["bearing_rad"]
    )
    replayed, found = followed(wrong)
    assert found_wrong(found) == [CONTRADICTS_ITSELF]
    assert len(replayed.outputs["/estimates/filter/robot1/fault"]) == 1
    assert found.guaranteed.all()
    assert found.violations == 0
