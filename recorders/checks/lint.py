"""Tables of the checks, and their application to a log, portion by portion to limit memory."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import islice

from fuselog.recorders.checks import (
    columns,
    covariances,
    forces,
    impossible,
    limits,
    losses,
    magnetic,
    names,
    places,
    speeds,
    stamps,
    turns,
)
from fuselog.recorders.checks.body import bodies
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.checks.motion import BodyMotion
from fuselog.recorders.log import Stream
from fuselog.recorders.log.impossible import main_span, possible
from fuselog.recorders.log.streams import concatenate

MOST = 1 << 19  # messages in a portion
BLOCK = 1 << 16

OfTopic = Callable[[Stream, Mapping[str, Stream]], Iterator[Finding]]  # a topic, with all topics
OfMotion = Callable[[BodyMotion], Iterator[Finding]]  # topics of one body, compared in pairs
# The checks by the data that they use, in the order in which findings are listed.
OF_ALL_MESSAGES: tuple[OfTopic, ...] = (impossible.beyond, impossible.integers)
OF_STAMPS: tuple[OfTopic, ...] = (losses.losses, losses.silences, losses.repeats)
OF_MOTION: tuple[OfMotion, ...] = (
    turns.gravity,
    turns.quaternions,
    speeds.leaps,
    speeds.clocks,
    speeds.delays,
    speeds.factors,
    turns.degrees,
    turns.signs,
    turns.mounting,
    turns.headings,
    speeds.rest,
)
OF_TOPIC: tuple[OfTopic, ...] = (
    impossible.apart,
    impossible.restated,
    stamps.units,
    stamps.order,
    stamps.jitter,
    stamps.leaps,
    stamps.drift,
    covariances.impossible,
    places.ranges,
    places.misread,
    places.heights,
    places.jumps,
    forces.unmeasured,
    limits.heights,
    limits.zeros,
    limits.leaps,
    limits.turns,
    limits.dates,
    forces.upright,
    magnetic.units,
    magnetic.iron,
    columns.codes,
    columns.negative,
    columns.saturated,
    columns.frozen,
    columns.rounded,
    names.frames,
    names.doubles,
    names.strays,
)


def compared(streams: Mapping[str, Stream]) -> list[Finding]:
    """Check stamps of topics, and compare topics of the same body in pairs."""
    found = list(_asked(OF_STAMPS, streams))
    for body in bodies(streams):
        motion = BodyMotion(body)
        of_motion = [each for check in OF_MOTION for each in check(motion)]
        known = {(each.kind, each.where) for each in found}
        found += [each for each in of_motion if (each.kind, each.where) not in known]
    return found + list(losses.drifts(streams))


def lint(
    blocks: Iterable[Mapping[str, Stream]],
    *,
    span_ns: tuple[int, int] | None = None,
    portions: int | None = None,
) -> list[Finding]:
    """Check a log, given as blocks that follow one another in time; hints come last.

    Every portion of about `MOST` messages is checked separately, and a finding in several portions is
    reported once, for the first. Topics are compared in pairs only in the first portion.

    Args:
        blocks: streams by topic; estimates are ignored.
        span_ns: span of most messages of the log if other messages are years away (see `main_span_of`);
            by default the span of each portion.
        portions: number of portions to check; by default all.

    Returns:
        The findings, hints last; empty for a log without faults, since the thresholds are hardly ever
        exceeded by chance.
    """
    found: dict[tuple[str, str, str], list[Finding]] = {}
    for index, whole in enumerate(islice(_portions(blocks), portions)):
        most_ns = span_ns or main_span(stream.publish_time_ns for stream in whole.values())
        cleared = {topic: possible(stream, most_ns)[0] for topic, stream in whole.items()}
        streams = {topic: stream for topic, stream in cleared.items() if len(stream)}
        of_stamps = compared(streams) if not index else list(_asked(OF_STAMPS, streams))
        # messages left out because of their values are not lost
        of_stamps = [
            each
            for each in of_stamps
            if each.kind not in ("lost messages", "gap")
            or len(streams[each.where]) == len(whole[each.where])
            or any(one.kind == each.kind for one in _asked(OF_STAMPS, whole, [each.where]))
        ]
        of_impossible = _asked((partial(impossible.years, most_ns), *OF_ALL_MESSAGES), whole)
        for each in (*of_impossible, *of_stamps, *_asked(OF_TOPIC, streams)):
            others = found.setdefault((each.kind, each.where, each.part), [])
            if not others or (each in of_stamps and not index):
                others.append(each)
    listed = [each for several in found.values() for each in several]
    return sorted(listed, key=lambda each: each.severity == "hint")


def _asked(
    checks: Iterable[OfTopic], streams: Mapping[str, Stream], topics: Iterable[str] | None = None
) -> Iterator[Finding]:
    for topic in streams if topics is None else topics:
        for check in checks:
            yield from check(streams[topic], streams)


def _portions(blocks: Iterable[Mapping[str, Stream]]) -> Iterator[dict[str, Stream]]:
    """Join blocks until they have `MOST` messages, without estimates and empty topics."""
    parts: dict[str, list[Stream]] = {}
    count = 0
    for block in blocks:
        for topic, stream in block.items():
            if len(stream) and not topic.startswith("/estimates/"):
                parts.setdefault(topic, []).append(stream)
                count += len(stream)
        if count > MOST:
            yield {topic: concatenate(several) for topic, several in parts.items()}
            parts, count = {}, 0
    if parts:
        yield {topic: concatenate(several) for topic, several in parts.items()}
