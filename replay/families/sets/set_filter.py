"""Filter of guaranteed position sets, which are moved by odometry and cut by every frame of bearings.

Briechle, Hanebeck (2004) derive the set of one frame of relative bearings, see `set_membership`; the
recursion that moves and intersects sets is from Schweppe, Recursive State Estimation: Unknown but
Bounded Errors and System Inputs (1968). The error of odometry is bounded over a span of time instead of
per second: a delayed start of the robot, for example, adds its error only once. Each frame therefore
also cuts the set at an earlier stamp, which is called the anchor. The current set is moved from the
anchor in one step.

If a frame contradicts the previous set, the sets of both are kept; if only one of the two is wrong, the
other one contains the robot. Their union is the estimate until later frames have emptied one of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.recorders.extras import AtFirstUse
from fuselog.recorders.log import Stream, Topic, make_stream, schemas
from fuselog.replay.engine.api.functions import batch
from fuselog.replay.engine.api.inputs import Binding, Given
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.engine.streams.channels import given_or_stated
from fuselog.replay.engine.streams.failures import reason_stream
from fuselog.replay.families.sets.regions.feasible_sets import excess_rad, to_blame
from fuselog.replay.families.sets.regions.frames import (
    CONTRADICTS_ITSELF,
    CONTRADICTS_PAST,
    ERRORS,
    FINDINGS,
    FRAME_WRONG,
    PAST_WRONG,
    STATED,
    UNDECIDED,
    Bearings,
    Bounds,
    Frame,
    frames_with_bearings,
)
from fuselog.replay.families.sets.regions.moving_sets import (
    ALL_HEADINGS,
    Headings,
    Motion,
    Odometry,
    all_headings_of,
    common_headings,
    corners_of,
    directions,
    from_rings,
    moved,
    odometry_of,
    relative_pose,
    to_rings,
    turned,
    within_l8,
)
from fuselog.replay.families.sets.set_membership import (
    SetParameters,
    bearings_in,
    fault_stream,
    known_of,
    polygons,
    set_metadata,
    set_streams,
)

if TYPE_CHECKING:
    import shapely
else:
    shapely = AtFirstUse("shapely", "papers", "guaranteed sets over time")

LEAVES = ("range_bearing", "bearing", "relative_bearing")


class SetFilterParameters(SetParameters):
    """Bounds of the errors; missing bounds are read from the channels.

    Consider a span of T s, and the robot's pose at its start. Relative to this pose, the position of the
    odometry has an error of at most `position_error_m` + T `position_error_mps`, and its heading of at
    most `heading_error_rad` + T `heading_error_radps`.

    Attributes:
        bearing_bound_rad: bound of the error of single bearings, which determine the heading;
            `bound_deg` is the bound for their differences.
        position_error_m: constant part of the bound of the odometry's position error.
        position_error_mps: increase of the bound of the odometry's position error per second.
        heading_error_rad: constant part of the bound of the odometry's heading error.
        heading_error_radps: increase of the bound of the odometry's heading error per second.
        anchor_s: time after which the current set becomes the new anchor, from which motion is measured.
        most_edges: number of edges above which a part of a set is enclosed in a pseudo-ellipsoid with L
            = 8, which replaces it.
    """

    least_landmarks: Annotated[int, Field(ge=2)] = 2
    bearing_bound_rad: Annotated[float, Field(gt=0, lt=np.pi)] | None = None
    position_error_m: NonNegativeFloat | None = None
    position_error_mps: NonNegativeFloat | None = None
    heading_error_rad: NonNegativeFloat | None = None
    heading_error_radps: NonNegativeFloat | None = None
    anchor_s: PositiveFloat = 5.0
    most_edges: PositiveInt = 400


class SetStep(NamedTuple):
    """Estimate at one frame.

    Attributes:
        time_ns: stamp of the frame.
        anchor_ns: stamp of the set that was moved to this frame; the frame's own stamp if no set was
            moved.
        parts: the set; if a frame contradicts the moved set, also the set of that frame.
        headings: interval of the heading.
        growth: factor by which the enclosing pseudo-ellipsoid with L = 8 enlarged the set.
        finding: index in FINDINGS of the finding at this frame; None if there is none.
        blamed: the index of the wrong relative bearing, if any.
    """

    time_ns: int
    anchor_ns: int
    parts: list[shapely.Geometry]
    headings: Headings
    growth: float = 1.0
    finding: int | None = None
    blamed: int | None = None


@dataclass
class Anchor:
    """Set and headings of a robot at an earlier stamp; `parts` as in SetStep."""

    time_ns: int
    pose: Floats
    parts: list[shapely.Geometry]
    headings: Headings


def motion_between(time_ns: Integers, poses: Floats, bounds: Bounds) -> Motion:
    """Compute the motion between two stamps from the poses of the odometry.

    Args:
        time_ns: (2,), the earlier one first.
        poses: (2, 3), x, y in m and heading in rad.
        bounds: bounds of the odometry's error, which grow with the time between the stamps.
    """
    span_s = float(time_ns[1] - time_ns[0]) * 1e-9
    *displacement, turn = relative_pose(*poses)
    return Motion(
        np.array(displacement), bounds.position.over(span_s), float(turn), bounds.heading.over(span_s)
    )


def narrowed(
    headings: Headings, places: shapely.Geometry, seen: Bearings, bound_rad: float
) -> Headings | None:
    """Narrow headings to those that agree with the bearings of landmarks; if none agree, return None."""
    left: Headings | None = headings
    for place, bearing in zip(*seen, strict=True):
        if left is not None:
            direction = directions(places, place)
            half = min(direction.half_rad + bound_rad, np.pi)
            left = common_headings(left, Headings(direction.middle_rad - bearing, half))
    return left


def follow(
    found: Iterable[tuple[Frame, Bearings]],
    odometry: Odometry,
    bounds: Bounds,
    parameters: SetFilterParameters,
) -> list[SetStep]:
    """Compute the estimates of one run, starting at its first frame with a set."""
    anchor: Anchor | None = None
    steps = []
    for frame, seen in found:
        pose = odometry.pose_at(np.array([frame.time_ns]))[0]
        cut = from_rings(polygons(frame.pairs, frame.arena, parameters))
        if anchor is None:
            if cut.area > 0.0:
                step = _first(frame, cut, seen, bounds)
                anchor = Anchor(frame.time_ns, pose, step.parts, step.headings)
                steps.append(step)
            continue
        step = _advance(anchor, frame, cut, seen, pose, bounds)
        is_old = step.time_ns - anchor.time_ns >= parameters.anchor_s * 1e9
        is_cut = step.finding != CONTRADICTS_ITSELF
        if step.finding in (CONTRADICTS_PAST, UNDECIDED) or (is_old and is_cut):
            parts = [_simpler(part, parameters.most_edges) for part in step.parts]
            step = step._replace(parts=parts, growth=_area(parts) / _area(step.parts))
            anchor = Anchor(frame.time_ns, pose, parts, step.headings)
        steps.append(step)
    return steps


def _first(frame: Frame, cut: shapely.Geometry, seen: Bearings, bounds: Bounds) -> SetStep:
    """Make the estimate from a single frame."""
    headings = narrowed(ALL_HEADINGS, cut, seen, bounds.bearing_rad) or ALL_HEADINGS
    return SetStep(frame.time_ns, frame.time_ns, [cut], headings)


def _advance(
    anchor: Anchor, frame: Frame, cut: shapely.Geometry, seen: Bearings, pose: Floats, bounds: Bounds
) -> SetStep:
    """Move an anchor's set to a frame, and cut both sets by the positions that the frame allows."""
    stamps = np.array([anchor.time_ns, frame.time_ns])
    motion = motion_between(stamps, np.array([anchor.pose, pose]), bounds)
    past = [moved(part, anchor.headings, motion) for part in anchor.parts]
    headings = turned(anchor.headings, motion)
    step = SetStep(frame.time_ns, anchor.time_ns, past, headings)
    if cut.area == 0.0:
        blamed = to_blame(frame.pairs, frame.arena)
        first = int(blamed[0]) if len(blamed) else None
        return step._replace(finding=CONTRADICTS_ITSELF, blamed=first)
    agreed = _cut(anchor, step, cut, seen, motion, bounds)
    if agreed is not None:
        return agreed
    whole, own = shapely.union_all(past), _first(frame, cut, seen, bounds)
    return step._replace(
        parts=[whole, cut],
        headings=all_headings_of(headings, own.headings),
        finding=CONTRADICTS_PAST if len(past) == 1 else UNDECIDED,
        blamed=_contradicting(frame, whole),
    )


def _cut(
    anchor: Anchor, step: SetStep, cut: shapely.Geometry, seen: Bearings, motion: Motion, bounds: Bounds
) -> SetStep | None:
    """Cut the step and its anchor by a frame; if nothing is left of a set, return None."""
    common = shapely.union_all(step.parts).intersection(cut)
    if common.area == 0.0:
        return None
    headings = narrowed(step.headings, common, seen, bounds.bearing_rad)
    if headings is None:
        return None
    before = common_headings(anchor.headings, turned(headings, motion, -1))
    if before is None:
        return None
    origin = moved(cut, before, motion, -1)
    held = [part.intersection(origin) for part in anchor.parts]
    parts = [moved(part, before, motion).intersection(cut) for part in held]
    alive = [index for index, part in enumerate(parts) if part.area > 0.0]
    if not alive:
        return None
    finding = None
    if len(alive) < len(parts):
        finding = FRAME_WRONG if alive == [0] else PAST_WRONG
    anchor.parts, anchor.headings = [held[index] for index in alive], before
    return step._replace(parts=[parts[index] for index in alive], headings=headings, finding=finding)


def _contradicting(frame: Frame, places: shapely.Geometry) -> int | None:
    """Find the relative bearing that is violated most at the best-fitting corner of a set."""
    excess = np.nan_to_num(excess_rad(frame.pairs, shapely.get_coordinates(places)), nan=0.0)
    best = excess[np.argmin(excess.max(axis=1))]
    return int(np.argmax(best)) if best.max() > 0.0 else None


def _simpler(part: shapely.Geometry, most_edges: int) -> shapely.Geometry:
    return within_l8(part) if shapely.get_num_coordinates(corners_of(part)) > most_edges else part


def _area(parts: Sequence[shapely.Geometry]) -> float:
    return float(shapely.union_all(parts).area)


def solve(given: Given[SetFilterParameters]) -> list[Ragged]:
    """Compute a set at every frame of every run; see `fuselog.replay.engine.api.functions.batch`."""
    known, bounds = given.setup
    stated = map(repr, (*bounds.position, *bounds.heading, bounds.bearing_rad))
    metadata = {
        **set_metadata(given.topics["seen"].name, known),
        "odometry": given.topics["odometry"].name,
        **dict(zip(STATED, stated, strict=True)),
    }
    solved = []
    for run in range(given.runs):
        seen, driven = given["seen"].of_run(run), given["odometry"].of_run(run)
        velocity = np.stack([driven["forward_mps"], driven["turn_radps"]], axis=1)
        found = list(frames_with_bearings(seen, given["/landmarks"].of_run(run), known))
        odometry = odometry_of(driven.publish_time_ns, velocity)
        steps = follow(found, odometry, bounds, given.parameters)
        frame_at = {frame.time_ns: frame for frame, _ in found}
        solved.append(_streams(f"/estimates/{given.name}", metadata, steps, frame_at))
    return [gather(streams) for streams in zip(*solved, strict=True)]


def _streams(
    prefix: str, metadata: Mapping[str, str], steps: Sequence[SetStep], frame_at: Mapping[int, Frame]
) -> tuple[Stream, ...]:
    """Make the streams of sets (as in `set_membership`), of their anchors and of findings."""
    blamed = [(frame_at[step.time_ns], step.blamed) for step in steps if step.blamed is not None]
    with_finding = [step for step in steps if step.finding is not None]
    return (
        *set_streams(
            prefix, metadata, [(step.time_ns, to_rings(shapely.union_all(step.parts))) for step in steps]
        ),
        fault_stream(prefix, blamed),
        make_stream(
            f"{prefix}/step",
            schemas.SET_STEP,
            np.array([step.time_ns for step in steps], np.int64),
            metadata=metadata,
            anchor_time_ns=np.array([step.anchor_ns for step in steps], np.int64),
            heading_rad=np.array([step.headings.middle_rad for step in steps]),
            heading_half_width_rad=np.array([step.headings.half_rad for step in steps]),
            area_growth=np.array([step.growth for step in steps]),
        ),
        reason_stream(
            f"{prefix}/diagnosed",
            schemas.DIAGNOSED,
            np.array([step.time_ns for step in with_finding], np.int64),
            np.array([step.finding for step in with_finding], np.int64),
            FINDINGS,
        ),
    )


def _find(_: str, topics: Mapping[str, Topic], parameters: SetFilterParameters) -> Iterator[Binding]:
    for prefix, topic in bearings_in(topics, LEAVES):
        if f"{prefix}/odometry" not in topics:
            continue
        odometry, landmarks, bearing_rad = topics[f"{prefix}/odometry"], topics["/landmarks"], np.pi
        stated = [given_or_stated(parameters, [odometry], error) for error in ERRORS]
        if not topic.name.endswith("/relative_bearing"):
            bearing_rad = given_or_stated(parameters, [topic], "bearing_bound_rad")
        setup = known_of(topic, landmarks, parameters), Bounds.of([*stated, bearing_rad])
        streams = {"seen": topic, "odometry": odometry}
        yield Binding(streams, {"/landmarks": landmarks}, prefix, setup=setup)


SET_FILTER = batch(
    "guaranteed sets of positions over time, moved by odometry with bounded errors: exact, box, l4, l8",
    parameters=SetFilterParameters,
    find=_find,
    requirements="/landmarks and, per robot, .../odometry and one of .../range_bearing, bearing, "
    "relative_bearing",
    solve=solve,
    variant="shape",
)
