"""The part of a log that contains measurements, for diagnoses and tuning."""

from collections.abc import Sequence
from dataclasses import replace

from fuselog.replay.engine.replaying.estimator import Bound, Recursive
from fuselog.replay.engine.streams.sources import LogSource, MemorySource

# time in s for which controls are kept, so that the last measurement is between two controls
BEYOND_NS = 1_000_000_000


def until_last_measured(
    source: LogSource | MemorySource, bound: Sequence[Bound]
) -> LogSource | MemorySource:
    """Cut a log a second after its last measurement if the controls continue for longer.

    Missing estimates after this time are not a failure.
    """
    readings = [
        (each, each.reading())
        for each in bound
        if isinstance(each, Recursive) and each.reading is not None
    ]
    controls = {topic for _, reading in readings for topic in reading.controls}
    measured = {topic for each, _ in readings for topic in each.streams} - controls
    if len(readings) < len(bound) or not controls or not measured:
        return source
    ends_ns = [
        int(stream.publish_time_ns.max())
        for topic in sorted(measured)
        for stream in source.read([topic]).values()
        if len(stream)
    ]
    if not ends_ns or max(ends_ns) + BEYOND_NS >= source.extent("publish_time")[1]:
        return source
    end_ns = max(ends_ns) + BEYOND_NS
    return replace(source, end_ns=end_ns if source.end_ns is None else min(end_ns, source.end_ns))
