"""The most likely cause of each inconsistent estimator of a result, and the effect of correcting it."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fuselog.pipeline.comparing.comparing import compare
from fuselog.pipeline.diagnosing.diagnosis import diagnose
from fuselog.pipeline.output.alarms import Cause
from fuselog.pipeline.output.report.evidence import findings
from fuselog.pipeline.output.results import RUNS, Result, read_table
from fuselog.pipeline.output.words import count, meaning_alone, number, quantity, scale
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import merge, parse_settings
from fuselog.recorders.remote.paths import located
from fuselog.replay.judging.verdicts import Consistency

MENDED = "mended"
STILL_WRONG = 1.5  # there are other causes if NEES or NIS is above its expectation by this factor


def likeliest_causes(folder: Path, result: Result) -> list[Cause]:
    """Diagnose each inconsistent estimator of a result over its first run.

    Estimators without a log, innovations or a cause are omitted.
    """
    logs = _logs(folder, result)
    tables = {"runs": read_table(folder / RUNS)} if (folder / RUNS).is_file() else {}
    found = findings(result, tables)
    settings = result.settings.get("estimators") or {}
    causes = []
    for label, evidence in found.of.items():
        is_off = evidence.verdict in (Consistency.OVERCONFIDENT, Consistency.CONSERVATIVE)
        if not logs or label not in settings or not is_off:
            continue
        own = {"kind": label, **settings[label]}
        gap_limit_s = float(result.settings.get("gap_limit_s", 0.2))
        try:
            sentences = diagnose(logs[0], {label: own}, gap_limit_s=gap_limit_s).sentences
        except BadInput:  # an estimator without innovations cannot be diagnosed
            continue
        if sentences:
            mended = _mended(logs, label, own, sentences[0], found.main)
            causes.append(_cause(label, sentences[0], mended))
    return causes


def _logs(folder: Path, result: Result) -> list[Path]:
    """List the logs of the runs that are kept, or of the runs that were replayed."""
    kept = sorted(folder.glob("logs/run-*.mcap"))
    stated = result.settings.get("logs")
    files = stated.get("files", []) if isinstance(stated, Mapping) else []
    return kept or [path for path in map(located, files) if path.is_file()]


def _cause(label: str, found: Finding, mended: str) -> Cause:
    words = found.sentence.partition("; try ")[0]
    setting = found.setting
    if setting and not setting.startswith("/"):
        setting = f"{label}.{setting}"
    short = meaning_alone(words.partition(";")[0].partition(", so that")[0])
    return Cause(label, f"{words}.", short, setting, mended)


def _mended(logs: list[Path], label: str, own: dict[str, Any], first: Finding, main: str) -> str:
    """Describe the effect of a correction on the same runs; "" if no parameter corrects the fault."""
    if not first.setting or first.setting.startswith("/"):
        return ""
    remedy = merge(own, parse_settings([first.setting]))
    table = compare(*logs, estimators=[{label: own}, {MENDED: remedy}]).table
    effects, left = [], []
    for key in (main, "nees", "nis_per_component"):
        rows = table[table["quantity"] == key].to_dict("records")[:1]
        known = [row for row in rows if math.isfinite(row["second_mean"])]
        effects += [_change(key, row) for row in known]
        if key != main:
            left += [row["second_mean"] / float(row["aim"]) for row in known]
    if not effects:
        return ""
    told = f"With that, over {count(len(logs), 'run')}: {'; '.join(effects)}."
    if max(left, default=0.0) > STILL_WRONG:
        told += (
            f" That is still {number(max(left), 2)} times the expected value: there are other causes."
        )
    return told


def _change(key: str, row: Mapping[Any, Any]) -> str:
    words, second = quantity(key), float(row["second_mean"])
    own = scale(words.unit, second)
    aim = f", expected {number(float(row['aim']))}" if key.startswith("n") else ""
    return f"{words.name} {own.with_unit(second)}{aim}"
