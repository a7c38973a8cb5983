"""Asks the checks of a log in their table, portion by portion, so that memory is bounded."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import islice

from fuselog.recorders.checks import (
    columns,
    covariances,
    forces,
    impossible,
    limits,
    magnetic,
    names,
    places,
    stamps,
)
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.checks.losses import losses
from fuselog.recorders.checks.plausibility import BLOCK, MOST, OF_STAMPS, findings
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Log, Stream, read_blocks, read_empty, read_span
from fuselog.recorders.log.impossible import main_span, main_span_of, possible
from fuselog.recorders.log.streams import concatenate

Check = Callable[[Stream, Mapping[str, Stream]], Iterator[Finding]]
# Of all messages; the other checks look at what is possible.
OF_IMPOSSIBLE: tuple[Check, ...] = (impossible.beyond, impossible.integers)
CHECKS: tuple[Check, ...] = (
    impossible.apart,
    impossible.restated,
    stamps.units,
    stamps.order,
    stamps.jitter,
    stamps.leaps,
    stamps.drift,
    covariances.impossible,
    places.ranges,
    places.exchanged,
    places.scaled,
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
    columns.frozen,
    columns.saturated,
    columns.rounded,
    names.frames,
    names.doubles,
    names.strays,
)


def lint(
    blocks: Iterable[Mapping[str, Stream]],
    *,
    span_ns: tuple[int, int] | None = None,
    portions: int | None = None,
) -> list[Finding]:
    """Return what is wrong with a log, of blocks that follow one another in time; hints stand last.

    Every portion of some `MOST` messages is checked by itself, and what is found in several is said
    once, of the first. Topics are compared in pairs in the first portion alone.

    Args:
        blocks: streams by topic; estimates are not looked at.
        span_ns: of most messages of the log, if others are years from them; see `main_span_of`. Without
            it, of most of each portion.
        portions: how many portions to look at; all without it.

    Returns:
        The findings, the worst first; none of a log without a fault: thresholds are far from chance.
    """
    found: dict[tuple[str, str, str], list[Finding]] = {}
    for index, whole in enumerate(islice(_portions(blocks), portions)):
        most_ns = span_ns or main_span(stream.publish_time_ns for stream in whole.values())
        cleared = {topic: possible(stream, most_ns)[0] for topic, stream in whole.items()}
        streams = {topic: stream for topic, stream in cleared.items() if len(stream)}
        of_stamps = findings(streams) if not index else list(_asked(OF_STAMPS, streams))
        # what is left out for its values is not lost
        of_stamps = [
            each
            for each in of_stamps
            if each.cause != "lost messages"
            or len(streams[each.topic]) == len(whole[each.topic])
            or any(losses(whole[each.topic], whole))
        ]
        of_impossible = _asked((partial(impossible.years, most_ns), *OF_IMPOSSIBLE), whole)
        for each in (*of_impossible, *of_stamps, *_asked(CHECKS, streams)):
            others = found.setdefault((each.cause, each.topic, each.field), [])
            if not others or (each in of_stamps and not index):
                others.append(each)
    listed = [each for several in found.values() for each in several]
    return sorted(listed, key=lambda each: each.sure == "hint")


def lint_log(log: Log, *, portions: int | None = None) -> list[Finding]:
    """Return the findings of a log file, see `lint`; raises BadInput where it is damaged."""
    topics = [topic for topic in log.topics if _is_sensed(log, topic)]
    if not topics:
        return []
    span_ns = main_span_of(read_span(log, "publish_time"), lambda: read_blocks(log, topics))
    blocks = read_blocks(log, topics, block_messages=BLOCK)
    return lint(blocks, span_ns=span_ns, portions=portions)


def _asked(checks: Iterable[Check], streams: Mapping[str, Stream]) -> Iterator[Finding]:
    for stream in streams.values():
        for check in checks:
            yield from check(stream, streams)


def _portions(blocks: Iterable[Mapping[str, Stream]]) -> Iterator[dict[str, Stream]]:
    """Join blocks until they have `MOST` messages, without estimates and topics that are empty."""
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


def _is_sensed(log: Log, topic: str) -> bool:
    if topic.startswith("/estimates/"):
        return False
    try:
        read_empty(log, topic)
    except BadInput:
        return False
    return True
