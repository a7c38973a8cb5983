"""Diagnosis of an estimator over a selection of logs, each by itself."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from fuselog.pipeline.api.over_logs import GAIN
from fuselog.pipeline.diagnosing.diagnosis import diagnose
from fuselog.pipeline.runs.batches import Row
from fuselog.recorders.log import open_log
from fuselog.replay.engine.streams.sources import LogSource


@dataclass(frozen=True)
class Diagnosing:
    """The diagnosis of a log: one row with the likeliest cause, and its gain in log-likelihood.

    Attributes:
        label: the estimator; None for the only one of an estimates log.
        settings: its settings, and alterations of topics.
        gap_limit_s: longest gap over which the truth is interpolated.
        recover: whether the readable part of a damaged log is used.
    """

    label: str | None
    settings: Mapping[str, Any]
    gap_limit_s: float
    recover: bool
    doing: ClassVar[str] = "diagnosing"

    def __call__(self, log: Path, number: int, folder: Path) -> list[Row]:  # noqa: ARG002
        """Return the row of a log."""
        source = LogSource(open_log(log, recover=self.recover))
        found = diagnose(source, self.label, set=self.settings, gap_limit_s=self.gap_limit_s)
        gain = float(found.causes["gain"].max()) if len(found.causes) else 0.0
        row: Row = {"estimator": found.label, "causes": len(found.sentences), GAIN: gain}
        for first in found.sentences[:1]:
            row |= {"kind": first.kind, "where": first.where, "setting": first.setting or None}
            row["finding"] = first.sentence
        return [row]
