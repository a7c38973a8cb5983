"""From where on `lint` and `import` find a fault: the least of it that is told, and the sentence.

Each is of a few rows that are made, so that a limit or a sentence that changes is seen, and of which
fault. What is whole, as a number of rows, is told to the last one.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.checks import (
    columns,
    covariances,
    forces,
    losses,
    magnetic,
    places,
    speeds,
    stamps,
    turns,
)
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.log import Stream
from tests.words.made.faulty import (
    ROWS,
    UPRIGHT,
    alike,
    both,
    by_velocities,
    climbing,
    counted,
    fast,
    field,
    fixes,
    gaining,
    gap,
    grid,
    inertial,
    inertial_b,
    late,
    leaning,
    levels,
    lossy,
    mirrored,
    motion,
    off_course,
    off_grid,
    placed,
    resting,
    rounded_to,
    saturated,
    second,
    spread,
    stepping,
    steps,
    stuck,
    thinned_out,
    turned,
    turning,
    uneven,
    weighing,
)

Found = Iterable[Finding]


class Edge(NamedTuple):
    """What is found of how much of a fault, and two amounts of which other things are told."""

    title: str
    found: Callable[[Any], Found]
    ends: tuple[float, float]


def one(check: Callable[..., Iterator[Finding]], stream: Stream, *others: Stream) -> Found:
    """What a check of a topic says, beside others."""
    return check(stream, {each.topic: each for each in (stream, *others)})


OF_STAMPS = (
    Edge(
        "a step of an inertial unit, s",
        lambda s: one(stamps.units, inertial(step_ns=int(1e9 * s))),
        (1, 3),
    ),
    Edge("its rate, Hz", lambda f: one(stamps.units, inertial(step_ns=int(1e9 / f))), (1e4, 3e4)),
    Edge("the rate of fixes, Hz", lambda f: one(stamps.units, fixes(step_ns=int(1e9 / f))), (300, 900)),
    Edge("years", lambda y: one(stamps.units, inertial(ahead_ns=int(y * 3.2e16))), (60, 100)),
    Edge(
        "steps to and fro, of the usual",
        lambda s: one(stamps.jitter, inertial(301, step_ns=1e7 * (1.0 + s * np.tile([-1, 0, 1], 100)))),
        (0.05, 0.4),
    ),
    *(
        Edge("seconds ahead", lambda s: one(stamps.leaps, inertial(ahead_ns=1e9 * s), fixes()), ends)
        for ends in (
            (17.0, 18.0),
            (18.0, 19.0),
            (36.0, 37.0),
            (37.0, 38.0),
            (3590.0, 3600.0),
            (3600.0, 3610.0),
        )
    ),
    Edge("hours ahead", lambda h: one(stamps.leaps, inertial(ahead_ns=3600e9 * h), fixes()), (12, 20)),
    Edge(
        "of two topics that are ahead, by how much less another is",
        lambda s: one(stamps.leaps, inertial(ahead_ns=18e9), inertial_b(18.0 - s)),
        (0.1, 2.0),
    ),
    *(
        Edge("the gain of a clock", lambda g: one(stamps.drift, gaining(g)), ends)
        for ends in ((1e-6, 1e-4), (1e-4, 1e-2))
    ),
    Edge(
        "seconds of a clock that gains", lambda s: one(stamps.drift, gaining(1e-4, span_s=s)), (50, 200)
    ),
    Edge(
        "messages of a clock that gains", lambda n: one(stamps.drift, gaining(1e-4, count=n)), (20, 100)
    ),
    Edge("the rate of all clocks", lambda g: losses.drifts({"/imu": gaining(g)}), (1e-4, 1e-2)),
    Edge("messages of them", lambda n: losses.drifts({"/imu": gaining(0.1, count=n)}), (20, 100)),
    Edge("seconds of them", lambda s: losses.drifts({"/imu": gaining(0.1, span_s=s)}), (5.0, 20.0)),
    Edge("messages that lack, of 1000", lambda n: one(losses.losses, lossy(n)), (1, 50)),
    Edge("every n-th message lacks", lambda n: one(losses.losses, thinned_out(n)), (400, 4)),
    Edge("a gap of so many", lambda n: one(losses.silences, gap(n)), (10, 100)),
    Edge("longer steps, of the usual", lambda n: one(losses.losses, inertial(step_ns=steps(n))), (1, 2)),
    Edge("these", lambda n: one(losses.losses, inertial(step_ns=steps(n))), (2, 9)),
    Edge(
        "steps that are not regular", lambda n: one(losses.losses, inertial(step_ns=uneven(n))), (1, 120)
    ),
    Edge("messages of which some lack", lambda n: one(losses.losses, lossy(5, count=n)), (30, 90)),
)


OF_COLUMNS = (
    Edge("rows of one value", lambda n: one(columns.frozen, stuck(n)), (5, 30)),
    Edge(
        "rows of one value where each is there twice",
        lambda n: one(columns.frozen, stuck(n, 2, count=3000)),
        (12, 60),
    ),
    Edge(
        "of those in which another moves, a share",
        lambda s: one(columns.frozen, stuck(40, 1, s)),
        (0.2, 0.9),
    ),
    Edge("rounded to, of its noise", lambda s: one(columns.rounded, rounded_to(s)), (0.5, 3.0)),
    Edge("rows that change, of 200", lambda n: one(columns.rounded, stepping(n)), (4, 30)),
    Edge("of how many values", lambda n: one(columns.rounded, levels(n)), (2, 3)),
    Edge("rows at the end of a range", lambda n: one(columns.saturated, saturated(n)), (2, 20)),
    Edge("of 10,000", lambda n: one(columns.saturated, saturated(n, count=10_000)), (2, 20)),
    *(
        Edge("an end, of 250 deg/s", lambda s: one(columns.saturated, saturated(9, s)), ends)
        for ends in ((0.9, 1.0), (1.0, 1.1))
    ),
    *(
        Edge("an end in counts", lambda n: one(columns.saturated, counted(n)), ends)
        for ends in ((32_700, 32_767), (32_768, 32_800))
    ),
    Edge(
        "how far off its grid, of a step",
        lambda s: [said(columns.resolution(off_grid(s)))],
        (0.001, 0.1),
    ),
    Edge(
        "a step, of the largest", lambda s: [said(columns.resolution(1.0 + s * grid()))], (1e-10, 1e-7)
    ),
)


def said(number: float) -> Finding:
    return Finding("values", "", "", 0.0, f"a grid of {number:.3g}" if number else "no grid")


OF_SENSORS = (
    Edge(
        "a latitude", lambda x: one(places.ranges, fixes(latitude_deg=np.full(ROWS, x))), (80.0, 100.0)
    ),
    Edge(
        "a longitude",
        lambda x: one(places.ranges, fixes(longitude_deg=np.full(ROWS, x))),
        (170.0, 190.0),
    ),
    Edge("both", lambda x: one(places.ranges, both(x)), (80.0, 100.0)),
    Edge("a number", lambda x: one(places.ranges, both(x)), (1e5, 1e7)),
    *(
        Edge("metres between heights", lambda x: one(places.heights, fixes(), second(x)), ends)
        for ends in ((1.0, 20.0), (20.0, 200.0))
    ),
    Edge("how these scatter, m", lambda x: one(places.heights, fixes(), second(50.0, x)), (1.0, 20.0)),
    Edge("a climb, m", lambda x: one(places.heights, climbing(x), placed(x)), (0.5, 5.0)),
    Edge("its noise", lambda x: one(places.heights, climbing(9.0), placed(9.0, x)), (0.1, 9.0)),
    Edge("hard iron, of the radius", lambda x: one(magnetic.iron, field(x)), (0.1, 0.5)),
    Edge("soft iron", lambda x: one(magnetic.iron, field(0.0, x)), (1.01, 1.5)),
    Edge("radians of a turn", lambda x: one(magnetic.iron, field(0.5, turn=x)), (3.0, 6.283)),
    Edge("fields of a turn", lambda n: one(magnetic.iron, field(0.5, count=int(n))), (30, 80)),
    Edge("upright, of its length", lambda x: one(forces.upright, leaning(x)), (0.7, 0.99)),
    Edge("upside down", lambda x: one(forces.upright, leaning(x, axis=2)), (-0.7, -0.99)),
    Edge("samples of it", lambda n: one(forces.upright, leaning(0.99, int(n))), (10, 80)),
    Edge("not symmetric by", lambda x: one(covariances.impossible, spread(x, 0.0)), (1e-8, 1e-3)),
    Edge("a correlation of 1 and", lambda x: one(covariances.impossible, spread(x, x)), (1e-8, 1e-3)),
)


OF_MOTION = (
    *(
        Edge("rad for each of a rate", lambda x: turns.degrees(motion(turn=alike(x))), ends)
        for ends in ((0.01, 0.0174), (0.0174, 0.03), (40.0, 57.3), (57.3, 80.0))
    ),
    Edge("how alike", lambda x: turns.degrees(motion(turn=alike(57.3, x))), (0.5, 0.99)),
    Edge("windows", lambda n: turns.degrees(motion(turn=alike(57.3, windows=n))), (5, 30)),
    Edge("a rate, rad/s", lambda x: turns.degrees(fast(x)), (10.0, 90.0)),
    Edge("a slope", lambda x: turns.signs(mirrored(x)), (0.2, 0.9)),
    Edge("rad of heading less course", lambda x: turns.headings(off_course(x)), (0.01, 0.2)),
    Edge("of which these spread", lambda x: turns.headings(off_course(1.0, x)), (0.4, 0.1)),
    Edge("beside their error", lambda x: turns.headings(off_course(x, 0.2)), (0.1, 0.9)),
    Edge("windows of them", lambda n: turns.headings(off_course(1.0, count=n)), (5, 30)),
    Edge("rad that forces are turned by", lambda x: turns.mounting(turned(x)), (0.1, 0.9)),
    Edge("how they fit", lambda x: turns.mounting(turned(1.0, x)), (0.7, 0.99)),
    Edge("how their mirror image does", lambda x: turns.mounting(turned(1.0, 0.95, x)), (0.9, 0.3)),
    *(
        Edge("a force at rest", lambda x: turns.gravity(weighing(x)), ends)
        for ends in ((0.5, 1.0), (1.0, 1.5), (900.0, 960.0), (960.0, 1000.0), (1000.0, 1100.0))
    ),
    Edge("of which down", lambda x: turns.gravity(weighing(9.8, x)), (0.7, 0.99)),
    Edge(
        "lengths of quaternions less 1",
        lambda x: turns.quaternions(motion(heading=(1.0 + x) * UPRIGHT)),
        (1e-4, 1e-2),
    ),
    *(
        Edge("seconds late", lambda x: speeds.delays(late(x)), ends)
        for ends in ((17.0, 18.0), (18.0, 19.0), (-18.0, -17.0))
    ),
    *(
        Edge("metres for each of a speed", lambda x: speeds.factors(motion(speed=alike(x))), ends)
        for ends in (
            *((0.2, 0.2778), (0.2778, 0.3048), (0.7, 0.9), (0.9, 1.4)),
            *((1.8, 1.944), (1.944, 2.1), (3.0, 3.6)),
        )
    ),
    *(
        Edge("variance at rest, of the stated", lambda x: speeds.rest(resting(x)), ends)
        for ends in ((1.0, 9.0), (1.0, 0.1))
    ),
    Edge("of many fixes", lambda x: speeds.rest(resting(x, 900)), (1.0, 9.0)),
    Edge("fixes at rest", lambda n: speeds.rest(resting(20.0, n)), (5, 30)),
    Edge("rad/s of a turn", lambda x: turns.quaternions(turning(x)), (0.01, 0.4)),
    Edge("of summed velocities", lambda x: speeds.factors(by_velocities(x)), (1.0, 1.6)),
    Edge("how these differ", lambda x: speeds.factors(motion(speed=alike(3.6, spread_=x))), (0.5, 0.1)),
)  # fmt: skip


def of_stamps() -> Iterator[str]:
    """Stamps and clocks: how much of a fault is told, with the sentence from there on."""
    yield from map(_told, OF_STAMPS)


def of_columns() -> Iterator[str]:
    """Columns that freeze, are rounded, or end."""
    yield from map(_told, OF_COLUMNS)


def of_sensors() -> Iterator[str]:
    """Places, fields, forces, covariances."""
    yield from map(_told, OF_SENSORS)


def of_motion() -> Iterator[str]:
    """Topics that are compared with one another."""
    yield from map(_told, OF_MOTION)


EDGES = (of_stamps, of_columns, of_sensors, of_motion)


def _told(edge: Edge) -> str:
    """The edge, what is told on this side of it, and on the other."""
    near, far = edge.ends
    is_whole = isinstance(near, int) and isinstance(far, int)
    before, after = _words(edge, near), _words(edge, far)
    assert _kind(before) != _kind(after), f"{edge.title}: {before}"
    narrow = 1 if is_whole else 1e-5 * abs(far - near)
    while abs(far - near) > narrow:
        middle = (near + far) // 2 if is_whole else 0.5 * (near + far)
        words = _words(edge, middle)
        if _kind(words) == _kind(before):
            near, before = middle, words
        else:
            far, after = middle, words
    at = f"{far}" if is_whole else f"{far:#.5g}"
    return f"{edge.title}: {before}, and from {at} on {after}"


def _words(edge: Edge, amount: float) -> str:
    return (
        " / ".join(f"{each.sentence} ({each.kind}, {each.value:.3g})" for each in edge.found(amount))
        or "nothing"
    )


def _kind(words: str) -> str:
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", words)
