"""Commands that open a run of a result in the viewer, next to the runs that a report names."""

import re
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from fuselog.pipeline.output.report.evidence import Findings
from fuselog.pipeline.output.results import Result
from fuselog.pipeline.output.words import quantity

_NAMED = re.compile(r"at ([\d.]+) s of run (\d+)")


class NamedRun(NamedTuple):
    """A run that the report names: a sentence about it, and the command that opens it."""

    words: str
    command: str


def worst_runs(folder: Path, result: Result, found: Findings) -> list[NamedRun]:
    """Name the run with the largest error of each estimator, and runs that warnings name.

    Returns an empty list unless the result has several runs that can be opened one by one.
    """
    if result.made_by != "run" or found.runs < 2 or "study" not in result.settings:
        return []
    named = []
    for label in found.compared:
        errors = found.by_run(label, found.main)
        if len(errors):
            run, most = max(errors.items(), key=lambda each: each[1])
            words = f"{label}: the largest {quantity(found.main).name}, {most:.3g}, is that of run {run}"
            named.append(NamedRun(words, _command(folder, run, f"worst:{label}")))
    for alarm in result.alarms:
        if match := _NAMED.search(alarm.sentence):
            words = f"{alarm.where}: a warning is about {match[1]} s of run {match[2]}"
            named.append(NamedRun(words, _command(folder, match[2], match[1])))
    return named


def _command(folder: Path, run: object, at: str) -> str:
    return f"fuselog view {quote(str(folder))} --runs {run} --at {quote(at)}"
