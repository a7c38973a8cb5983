"""Checks of selected logs, each by itself, against the runs of a golden."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from fuselog.pipeline.api.over_logs import FAULTS, Campaign, OverLogs
from fuselog.pipeline.checking.checking import Runs, check
from fuselog.pipeline.checking.stored import Golden, read
from fuselog.pipeline.output.results import hash_of
from fuselog.pipeline.runs.batches import Row
from fuselog.pipeline.runs.ensemble import Settings
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import open_log
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.foreign.naming import of_file

InPlace = Callable[[str, Runs, Golden], Settings]


@dataclass(frozen=True)
class Checking:
    """The check of a log: one row with the number of fields that differ, and the first difference.

    Attributes:
        golden: the path of the golden.
        sha256: its hash.
        estimators: settings of the estimators by label.
    """

    golden: Path
    sha256: str
    estimators: Settings
    doing: ClassVar[str] = "checking"

    def __call__(self, log: Path, number: int, folder: Path) -> list[Row]:  # noqa: ARG002
        """Return the row of a log."""
        stored = _read(self.golden, self.sha256)
        if log.name not in stored["runs"]:
            raise BadInput("is not in the golden; add it with --update")
        of_log = {**stored, "runs": {log.name: stored["runs"][log.name]}, "metrics": {}}
        done = check({log.name: LogSource(open_log(log))}, of_log, self.estimators)
        first = " ".join(done.sentences) or None
        return [{"fields": sum(done.fields.values()), FAULTS: len(done.found), "finding": first}]


@cache
def _read(path: Path, sha256: str) -> Golden:  # noqa: ARG001
    return read(path)


def check_over_logs(
    campaign: Campaign, golden: Path, label: str | None, in_place: InPlace | None
) -> OverLogs:
    """Check each log of a selection against the run of the same name; a missing log also gets a row.

    Raises BadInput if two logs have the same name, or the golden cannot be read.
    """
    stored, selection = read(golden), campaign.selection
    names = Counter(log.name for log in (*selection.logs, *selection.unreadable))
    [(name, times)] = names.most_common(1)
    if times > 1:
        raise BadInput(
            f"{name}: {times} logs have this name, by which a golden names its runs; check them one by "
            "one"
        )
    missing = {
        Path(each): "is missing, although the golden has it"
        for each in stored["runs"]
        if each not in names
    }
    unreadable: Mapping[Path, str] = {**selection.unreadable, **missing}
    campaign = campaign._replace(selection=replace(selection, unreadable=unreadable))
    estimators: Any = of_file(stored["settings"]["estimators"])
    if label is not None and in_place is not None:
        runs = {log.name: LogSource(open_log(log)) for log in selection.logs}
        estimators = in_place(label, runs, stored)
    task = Checking(golden.absolute(), hash_of(golden), estimators)
    return campaign.run(task, "check", {"golden": str(golden), "estimators": estimators})
