"""Top views of the estimates of several candidates."""

from collections.abc import Sequence

from fuselog.pipeline.comparing.candidates import Candidate
from fuselog.pipeline.output.charts import Chart
from fuselog.recorders.log import RunMetadata
from fuselog.replay.engine.streams.sources import MemorySource, Source


def side_by_side(candidates: Sequence[Candidate], run: str) -> tuple[Source, MemorySource]:
    """Return the log of a run, and the estimates of all candidates under their names."""
    source = candidates[0].pairs[run][0]
    streams = {
        topic: stream
        for own in (candidate.estimates(run) for candidate in candidates)
        for topic, stream in own.read([*own.topics]).items()
    }
    about = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
    return source, MemorySource(streams, about, source.name)


def scene_of(candidates: Sequence[Candidate], run: str, gap_limit_s: float) -> dict[str, Chart]:
    """Draw a run from above, and enlarge one second of it if the ellipses are too small to be seen.

    The result is empty if the truth or the estimates have no horizontal positions.
    """
    from fuselog.pipeline.output.report.first_run import seen_from_above  # slow to import
    from fuselog.pipeline.output.report.scene import lens, plan

    found = seen_from_above(*side_by_side(candidates, run), gap_limit_s)
    if found is None:
        return {}
    near = lens(found, [candidate.name for candidate in candidates])
    return {"scene": plan(found)} | ({"lens": near} if near else {})
