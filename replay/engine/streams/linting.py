"""Checks of log files, and of recordings with or without alterations, by the linter for logs."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.checks.lint import BLOCK, lint
from fuselog.recorders.errors import without_warnings_of_numbers
from fuselog.recorders.log import Stream
from fuselog.recorders.log.impossible import main_span_of
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, is_sensed


@without_warnings_of_numbers()
def lint_source(source: LogSource | MemorySource, *, portions: int | None = None) -> list[Finding]:
    """Check a source as it was recorded, and return the findings; see `lint` for `portions`.

    Raises BadInput if the log is damaged.
    """
    source = source.as_written()
    topics = [topic for topic in source.topics if is_sensed(source, topic)]
    if not topics:
        return []

    def blocks() -> Iterator[Mapping[str, Stream]]:
        return source.blocks(topics, "publish_time", BLOCK)

    span_ns = main_span_of(source.extent("publish_time"), blocks)
    return lint(blocks(), span_ns=span_ns, portions=portions)


def worst(found: Sequence[Finding], path: Path) -> Iterator[str]:
    """Yield a sentence about the worst finding, if any, with the command that lists all findings."""
    if found:
        others = f"; {len(found) - 1} more: fuselog lint {shlex.quote(str(path))}"
        sure = "hint" if found[0].severity == "hint" else "implausible"
        yield f"{sure}: {found[0].sentence}{others if len(found) > 1 else ''}"


def of_first_messages(sources: Sequence[LogSource | MemorySource]) -> list[str]:
    """Check the first portion of each source, and return the findings as sentences for a report."""
    many = len(sources) > 1
    return [
        f"{source.name}: {each.sentence}" if many else each.sentence
        for source in sources
        for each in lint_source(source, portions=1)
    ]
