"""Campaigns over logs: a command processes each log by itself, and returns rows of a table.

Logs are divided into batches, which are distributed, kept and resumed like the cells of an experiment;
see `fuselog.pipeline.runs.campaigns`. A log that cannot be processed has a row with the reason.
"""

import hashlib
import json
import pickle
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Protocol

from fuselog.pipeline.runs.campaigns import Pace, work_off
from fuselog.pipeline.runs.checkpoints import Checkpoints
from fuselog.pipeline.runs.ensemble import Progress, no_progress
from fuselog.pipeline.runs.executors import PoolFactory, keep_freed_memory, states_of, version_of_code
from fuselog.recorders.errors import BadInput, CannotWrite

# The number of logs in a batch, and the number of batches below which each log has its own.
BATCH, FEW = 32, 64
Row = dict[str, Any]


class Task(Protocol):
    """The work of a command on one log: a dataclass, whose fields determine the rows.

    Attributes:
        doing: what the command does, for the progress.
    """

    doing: ClassVar[str]

    def __call__(self, log: Path, number: int, folder: Path) -> list[Row]:
        """Return the rows of the log with this number; write files to the folder."""


@dataclass(frozen=True)
class Batch:
    """The logs from `first` on that a task processes in one piece; see `Work`."""

    task: Task
    logs: Sequence[Path]
    first: int

    @property
    def end(self) -> int:
        """Return the number of the log after the last."""
        return self.first + len(self.logs)

    @property
    def runs(self) -> int:
        """Return the number of logs."""
        return len(self.logs)

    @property
    def files(self) -> Sequence[Path]:
        """Return the logs."""
        return self.logs

    @cached_property
    def key(self) -> str:
        """Hash the task, its logs and the code."""
        task = [type(self.task).__qualname__, asdict(self.task)]  # type: ignore[call-overload]
        contents = [task, [str(log) for log in self.logs], states_of(self.logs), version_of_code()]
        return hashlib.sha256(json.dumps(contents, sort_keys=True, default=str).encode()).hexdigest()

    def packed(self, folder: Path) -> bytes:
        """Process the logs, and pickle the rows of each."""
        keep_freed_memory()
        shutil.rmtree(folder, ignore_errors=True)  # files of a worker that was killed
        return pickle.dumps(
            [
                rows_of(self.task, log, number, folder)
                for number, log in enumerate(self.logs, start=self.first)
            ]
        )


def rows_of(task: Task, log: Path, number: int, folder: Path) -> list[Row]:
    """Return the rows of a log, or one row with the reason if it cannot be processed.

    Raises CannotWrite if a file of the result cannot be written, which ends the command.
    """
    try:
        return task(log, number, folder)
    except CannotWrite:
        raise
    except (BadInput, OSError) as error:
        return [{"problem": str(error).removeprefix(f"{log}: ")}]


def batches_of(task: Task, logs: Sequence[Path]) -> list[Batch]:
    """Divide logs into batches, depending only on their number."""
    size = max(1, min(BATCH, len(logs) // FEW))
    absolute = [log.absolute() for log in logs]
    return [Batch(task, absolute[first : first + size], first) for first in range(0, len(logs), size)]


def over_logs(
    batches: Sequence[Batch],
    open_pool: PoolFactory,
    checkpoints: Checkpoints,
    progress: Progress = no_progress,
) -> Iterator[list[Row]]:
    """Yield the rows of each log in order, computed by workers or kept from an interrupted command."""
    if not batches:
        return
    pace = Pace(batches[-1].end, doing=batches[0].task.doing, what="logs")
    found = work_off(batches, open_pool, checkpoints, pace)
    for rows in progress(found, pace, len(batches)):
        yield from rows
