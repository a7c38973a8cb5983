"""Checks of a log for errors before any filter is run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from fuselog.pipeline.api.planning import Log, sources_of
from fuselog.pipeline.output.terminal import print_json, say, warn
from fuselog.pipeline.runs.settings import split_texts
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import open_log
from fuselog.replay.engine.streams.linting import lint_source
from fuselog.replay.engine.streams.sources import LogSource

NOTHING = "no errors found in the log itself"


def lint(log: Log, *, set: Mapping[str, Any] | None = None) -> list[Finding]:  # noqa: A002
    """List the errors in a log, the worst first and hints last.

    Args:
        log: a path, a log or a recording.
        set: changes of topics for the check, such as {"/imu.delay_s": 0.1}.

    Returns:
        The findings, each with its topic, the evidence and a remedy; empty if nothing is wrong.

    Raises BadInput if the log cannot be read, or if a change is invalid.

    >>> import fuselog as fl
    >>> run = fl.record("landmarks", seed=7, duration_s=2.0)
    >>> fl.lint(run)
    []
    """
    return lint_source(sources_of([log], set)[0])


@dataclass(frozen=True)
class Linting:
    """The check of a log for errors: one row with its faults and its worst finding."""

    alterations: Mapping[str, Any]
    recover: bool
    doing: ClassVar[str] = "checking"

    def __call__(self, log: Path, number: int, folder: Path) -> list[dict[str, Any]]:  # noqa: ARG002
        """Return the row of a log."""
        found = lint(LogSource(open_log(log, recover=self.recover)), set=self.alterations)
        faults = sum(each.severity != "hint" for each in found)
        first = found[0].sentence if found else None
        return [{"faults": faults, "hints": len(found) - faults, "finding": first}]


def alterations_for_lint(settings: Sequence[str]) -> dict[str, Any]:
    """Parse the settings of lint; raise BadInput unless all of them are about topics."""
    alterations, others = split_texts(settings)
    if others:
        raise BadInput(
            f"--set {others[0]}: lint accepts only settings of topics, such as /imu.delay_s=0.1"
        )
    return alterations


def show_lint(path: Path, settings: Sequence[str], *, recover: bool, as_json: bool) -> bool:
    """Print the findings of a log; return whether all of them are hints."""
    alterations = alterations_for_lint(settings)
    log = open_log(path, recover=recover)
    found = lint(LogSource(log), set=alterations)
    if as_json:
        print_json({"path": str(path), "findings": [each.as_json for each in found]})
    else:
        for each in found:
            say(f"{each.severity}: {each.sentence}")
        if not found:
            say(f"{path}: {NOTHING}")
    if log.loss_statement:
        warn(log.loss_statement)
    return all(each.severity == "hint" for each in found)
