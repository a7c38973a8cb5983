"""The table `coverage`: how many messages of every topic of a log were used."""

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fuselog.pipeline.output.results import read_table
from fuselog.recorders.errors import BadInput, some_of
from fuselog.recorders.log import Clock
from fuselog.recorders.log.impossible import Rejections
from fuselog.recorders.parsing import parse_json
from fuselog.replay.engine.replaying.estimator import Bound, bind
from fuselog.replay.engine.replaying.replaying import BLOCK_MESSAGES
from fuselog.replay.engine.replaying.usage import (
    CONTROLS,
    INNOVATION,
    LANDMARK,
    PRIOR,
    SKIPPED,
    TRUTH,
    UNTAKEN,
    Row,
    Usage,
)
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import LogSource, Source, is_sensed
from fuselog.replay.judging.errors.truths import Doubt

if TYPE_CHECKING:
    import pandas as pd

MOST_TOPICS = 3  # largest number of topics that a sentence names
COLUMNS = [*Row._fields]
# Note of an estimates log on the span and clock of its replay; absent for a whole log by publish time.
REPLAYED = "replayed"


def untaken(
    sources: Sequence[Source], labels: Iterable[str], bound: Iterable[Bound], order: Clock
) -> list[Row]:
    """List the topics that an estimator does not use at all, in the replayed spans of all logs.

    Truths and maps are not listed. Controls are listed only if a setting would make the estimator use
    them.
    """
    taken: dict[str, set[str]] = {label: set() for label in labels}
    offers: dict[str, dict[str, str]] = {}
    for each in bound:
        initialization = getattr(each, "initialization", None)
        own = {
            *each.streams,
            *each.static,
            *each.priors,
            *(initialization.topics if initialization else ()),
        }
        label = each.name.partition("/")[0]
        taken.setdefault(label, set()).update(own)
        offers.setdefault(label, {}).update(getattr(each, "offers", {}))
    offered = {name for own in offers.values() for name in own}
    messages: Counter[str] = Counter()
    for source in sources:
        for name, topic in source.topics.items():
            is_control = topic.schema_name in CONTROLS and name not in offered
            if is_control or topic.schema_name in (LANDMARK, TRUTH) or name.endswith("/prior"):
                continue
            if all(name in own for own in taken.values()) or not topic.messages:
                continue
            if is_sensed(source, name):
                messages[name] += _messages(source, name, order)
    return [
        Row(label, name, count, 0, 0, 0, _untaken(offers.get(label, {}).get(name, "")))
        for name, count in messages.items()
        for label, own in taken.items()
        if count and name not in own
    ]


def _untaken(offer: str) -> str:
    return f"{UNTAKEN}; with {offer} it does" if offer else UNTAKEN


def _messages(source: Source, topic: str, order: Clock) -> int:
    """Count the messages of a topic in the source's span."""
    if source.start_ns is None and getattr(source, "end_ns", None) is None:
        return source.topics[topic].messages
    return sum(len(block[topic]) for block in source.blocks([topic], order, BLOCK_MESSAGES))


def recounted(
    estimates: Sequence[LogSource],
    sources: Sequence[LogSource],
    stated: Mapping[str, Any],
    doubts: Mapping[str, Doubt],
) -> list[Row]:
    """Compute the coverage table of a replay from its estimates logs and their source logs.

    `stated` contains the estimators' settings by label, and `doubts` contains the doubts about truths.
    If an estimator cannot be bound to the logs, its row states this.
    """
    rows: list[Row] = []
    bound: list[Bound] = []
    spans = [_replayed(each, source) for each, source in zip(estimates, sources, strict=True)]
    for label, settings in stated.items():
        try:
            bound += bind(label, sources, settings)
        except BadInput as error:
            rows.append(Row(label, "all topics", 0, None, None, 0, f"not counted: {error}"))
    usages: dict[str, Usage] = {}
    for each, (source, order) in zip(estimates, spans, strict=True):
        for name, usage in _recounted(each, source, order, bound).items():
            if name in usages:
                usages[name].merge(usage)
            else:
                usages[name] = usage
    labels = dict.fromkeys(each.name.partition("/")[0] for each in bound)
    orders = {order for _, order in spans}
    if len(orders) == 1:
        rows += untaken([source for source, _ in spans], labels, bound, orders.pop())
    left_out = Rejections().plus(source.rejections for source, _ in spans)
    return rows_of(usages, rows, doubts, left_out)


def _replayed(estimates: LogSource, source: LogSource) -> tuple[LogSource, Clock]:
    """Return the span of a log that was replayed, and the clock of the replay."""
    notes = estimates.run.notes if estimates.run else {}
    start_ns, end_ns, order = _noted(notes.get(REPLAYED, ""))
    return replace(source, start_ns=start_ns, end_ns=end_ns), order


def replayed_note(source: Source, order: Clock) -> dict[str, str]:
    """Return the note REPLAYED for a source's estimates, or {} for a whole log in publish order."""
    ends = source.start_ns, getattr(source, "end_ns", None)
    text = json.dumps([*ends, order])
    return {} if (*ends, order) == (None, None, "publish_time") else {REPLAYED: text}


def _noted(note: str) -> tuple[int | None, int | None, Clock]:
    try:
        start_ns, end_ns, order = parse_json(note)
    except (ValueError, TypeError):
        return None, None, "publish_time"
    ends = [
        each if isinstance(each, int) and abs(each) < 1 << 63 else None for each in (start_ns, end_ns)
    ]
    return ends[0], ends[1], "log_time" if order == "log_time" else "publish_time"


def _recounted(
    estimates: LogSource, source: LogSource, order: Clock, bound: Sequence[Bound]
) -> dict[str, Usage]:
    """Count the messages of one run for each estimator, and how many were used up to the last output."""
    usages = {each.name: Usage(each.name) for each in bound}
    maps = {
        topic: gather([source.read([topic])[topic]])
        for topic in {topic for each in bound for topic in each.static}
        if topic in source.topics and source.topics[topic].schema_name in (LANDMARK, PRIOR)
    }
    own_maps = {
        each.name: {topic: maps[topic] for topic in each.static if topic in maps} for each in bound
    }
    for name, usage in usages.items():
        usage.note_start(own_maps[name])
    streamed = sorted({topic for each in bound for topic in each.streams})
    empty = {topic: source.empty(topic) for topic in streamed}
    counted = [
        topic
        for topic, about in estimates.topics.items()
        if about.schema_name in (INNOVATION, SKIPPED) and topic.rpartition("/")[0] in _places(bound)
    ]
    for topic in counted:  # a topic without messages also shows that the estimator has innovations
        usages[_places(bound)[topic.rpartition("/")[0]]].note_outputs([gather([estimates.empty(topic)])])
    outputs = estimates.blocks(counted, "publish_time", BLOCK_MESSAGES) if counted else iter(())
    inputs = source.blocks(streamed, order, BLOCK_MESSAGES) if streamed else iter(())
    reached_ns = -1

    def read_up_to(time_ns: float) -> None:
        nonlocal reached_ns
        while reached_ns < time_ns:
            block = next(inputs, None)
            if block is None:
                return
            reached_ns = max(int(each.times(order)[-1]) for each in block.values())
            streams = {topic: gather([block.get(topic, empty[topic])]) for topic in streamed}
            for each in bound:
                given = {topic: streams[topic] for topic in each.streams}
                usages[each.name].note_given(given, own_maps[each.name], order)

    for block in outputs:
        read_up_to(max(int(each.publish_time_ns[-1]) for each in block.values()))
        for topic, stream in block.items():
            usages[_places(bound)[topic.rpartition("/")[0]]].note_outputs([gather([stream])])
    read_up_to(math.inf)
    for usage in usages.values():
        usage.shares.end()
    return usages


def _places(bound: Iterable[Bound]) -> dict[str, str]:
    """Map the prefix of each bound estimator's topics to its name."""
    return {f"/estimates/{each.name}": each.name for each in bound}


def rows_of(
    usages: Mapping[str, Usage],
    others: Sequence[Row],
    doubts: Mapping[str, Doubt],
    left_out: Rejections,
) -> list[Row]:
    """Collect the rows of counted messages, other topics and doubtful truths, by estimator and topic.

    Messages that were dropped because their values are impossible are included in the counts.
    """
    rows = [_whole(row, left_out) for usage in usages.values() for row in usage.rows()]
    there = {(row.estimator, row.topic) for row in rows}
    rows += [row for row in others if (row.estimator, row.topic) not in there]
    labels = dict.fromkeys(name.partition("/")[0] for name in usages)
    doubtful = [
        Row(label, topic, doubt.messages, None, None, 0, doubt.why)
        for label in labels
        for topic, doubt in doubts.items()
    ]
    rejected = [
        Row(label, topic, counts.total(), None, None, 0, left_out.sentence(topic))
        for label in labels
        for topic, counts in left_out.items()
        if (label, topic) not in there
    ]
    return [*rows, *doubtful, *rejected]


def _whole(row: Row, left_out: Rejections) -> Row:
    """Add to the row the messages that were dropped before they reached an estimator."""
    if row.topic not in left_out:
        return row
    why = "; ".join(filter(None, (row.why, left_out.sentence(row.topic))))
    return row._replace(messages=row.messages + left_out[row.topic].total(), why=why)


def added(rows: Sequence[Row], more: Sequence[Row]) -> list[Row]:
    """Add rows on unused topics of later runs to the rows of earlier runs."""
    counts = {(row.estimator, row.topic): row for row in rows}
    for row in more:
        before = counts.get((row.estimator, row.topic))
        counts[row.estimator, row.topic] = (
            row if before is None else row._replace(messages=row.messages + before.messages)
        )
    return list(counts.values())


def stored_rows(folder: Path) -> list[Row]:
    """Read the table `coverage` of a result; older results do not have this table."""
    path = folder / "tables" / "coverage.parquet"
    if not path.is_file():
        return []
    table = read_table(path).astype(object)
    return [Row(*row) for row in table.where(table.notna(), None)[[*Row._fields]].to_numpy().tolist()]


def rows_of_candidate(coverage: Sequence[Row], label: str, name: str) -> list[Row]:
    """Return the rows of one estimator, under a candidate's name."""
    return [row._replace(estimator=name) for row in coverage if row.estimator == label]


def coverage_table(rows: Sequence[Row]) -> "pd.DataFrame":
    """Make a table with a row per estimator and topic; see `Row`."""
    import pandas as pd  # slow to import

    return pd.DataFrame(rows, columns=COLUMNS).astype({"used": "Int64", "gated": "Int64"})


def sentences(rows: Sequence[Row]) -> list[str]:
    """Describe the messages that were not used, with one sentence per estimator for all unused topics.

    An estimator that uses no measurements at all does so by design and is not reported.
    """
    measuring = {
        row.estimator for row in rows if row.used is not None and not row.why.startswith(UNTAKEN)
    }
    untaken: dict[str, list[Row]] = {}
    for row in rows:
        if row.why == UNTAKEN and row.sentence and row.estimator in measuring:
            untaken.setdefault(row.estimator, []).append(row)
    found: dict[str, None] = {}
    for row in rows:
        if row.why != UNTAKEN:
            found[row.sentence] = None
        elif row.estimator in untaken:
            found[_of_untaken(untaken[row.estimator])] = None
    return [sentence for sentence in found if sentence]


def _of_untaken(rows: Sequence[Row]) -> str:
    """Name the topics that one estimator does not use, or the first few of many."""
    if len(rows) == 1:
        return rows[0].sentence
    named = some_of([row.topic for row in rows], MOST_TOPICS)
    return f"{rows[0].estimator}: {len(rows)} topics not used: it does not take {named}"
