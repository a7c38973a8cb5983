"""The table `coverage`: what became of every topic of a log; nothing is unused in silence."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from replay.engine.replaying.usage import CONTROLS, LANDMARK, TRUTH, Row, Usage
from replay.engine.streams.sources import Source, is_sensed

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = [*Row._fields]
UNTAKEN = "the estimator does not take this topic"


def untaken(source: Source, labels: Iterable[str], bound: Iterable[Any]) -> list[Row]:
    """The topics of a log that an estimator does not take at all; truth, maps and controls are none."""
    taken: dict[str, set[str]] = {label: set() for label in labels}
    for each in bound:
        initialization = getattr(each, "initialization", None)
        own = {
            *each.streams,
            *each.static,
            *each.priors,
            *(initialization.topics if initialization else ()),
        }
        taken.setdefault(each.name.partition("/")[0], set()).update(own)
    rows = []
    for name, topic in source.topics.items():
        if topic.schema_name in (*CONTROLS, LANDMARK, TRUTH) or not topic.messages:
            continue
        if name.endswith("/prior") or not is_sensed(source, name):
            continue
        rows += [
            Row(label, name, topic.messages, 0, 0, 0, UNTAKEN)
            for label, own in taken.items()
            if name not in own
        ]
    return rows


def rows_of(usages: Mapping[str, Usage], others: Sequence[Row]) -> list[Row]:
    """All lines, by estimator and topic; of a topic that is not taken in any run."""
    rows = [row for usage in usages.values() for row in usage.rows()]
    there = {(row.estimator, row.topic) for row in rows}
    return [*rows, *(row for row in others if (row.estimator, row.topic) not in there)]


def coverage_table(rows: Sequence[Row]) -> "pd.DataFrame":
    """A row per estimator and topic; see `Row`."""
    import pandas as pd  # which takes long to import

    return pd.DataFrame(rows, columns=COLUMNS).astype({"used": "Int64", "gated": "Int64"})


def sentences(rows: Sequence[Row]) -> list[str]:
    """On what was not used; that an estimator takes no measurements at all is its nature."""
    measuring = {row.estimator for row in rows if row.used is not None and row.why != UNTAKEN}
    told = [row for row in rows if row.why != UNTAKEN or row.estimator in measuring]
    return list(dict.fromkeys(row.sentence for row in told if row.sentence))
