"""Lists the checks in the order in which findings are named, and reads what they need of a log.

A check of motion takes a body's topics compared in pairs, one of stamps a topic and all others.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping

from fuselog.recorders.checks import losses, speeds, turns
from fuselog.recorders.checks.body import bodies
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.checks.motion import BodyMotion
from fuselog.recorders.log import Stream
from fuselog.recorders.log.streams import concatenate

MOST = 1 << 19  # messages that are looked at: the first of a log, however long it is
BLOCK = 1 << 16

OF_STAMPS: tuple[Callable[[Stream, Mapping[str, Stream]], Iterator[Finding]], ...] = (
    losses.losses,
    losses.repeats,
)
OF_MOTION: tuple[Callable[[BodyMotion], Iterator[Finding]], ...] = (
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


def findings(streams: Mapping[str, Stream]) -> list[Finding]:
    """Return what topics say of their own faults, the worst first; see `finding.Finding`.

    Estimates are not looked at. A log without a fault has none: thresholds are far from chance.
    """
    sensed = {
        topic: stream
        for topic, stream in streams.items()
        if len(stream) and not topic.startswith("/estimates/")
    }
    found = [each for stream in sensed.values() for check in OF_STAMPS for each in check(stream, sensed)]
    for body in bodies(sensed):
        motion = BodyMotion(body)
        of_motion = [each for check in OF_MOTION for each in check(motion)]
        known = {(each.cause, each.topic) for each in found}
        found += [each for each in of_motion if (each.cause, each.topic) not in known]
    return found + list(losses.drifts(sensed))


def findings_in(blocks: Iterable[Mapping[str, Stream]]) -> list[Finding]:
    """Return the findings of blocks that follow one another in time, by the first `MOST` messages."""
    parts: dict[str, list[Stream]] = {}
    count = 0
    for block in blocks:
        for topic, stream in block.items():
            parts.setdefault(topic, []).append(stream)
            count += len(stream)
        if count > MOST:
            break
    return findings({topic: concatenate(found) for topic, found in parts.items()})
