"""Output of `fuselog tune`, and functions that `calibrate` shares with it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fuselog.pipeline.logs.cataloguing import logs_meant
from fuselog.pipeline.output.outputs import check_outputs
from fuselog.pipeline.output.results import plain
from fuselog.pipeline.output.terminal import print_json, print_metrics, print_table, say, status, warn
from fuselog.pipeline.runs.settings import pairs_of, settings_of_estimators, split_texts
from fuselog.pipeline.tuning.objective import Best
from fuselog.pipeline.tuning.outcome import SETTINGS, Tuning
from fuselog.pipeline.tuning.tuning import tune
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import open_log
from fuselog.replay.engine.streams.sources import LogSource


def tune_logs(
    logs: Sequence[Path],
    *,
    label: str,
    search: Callable[..., Tuning] | None = None,
    bounds: Sequence[str],
    held_out: Sequence[Path],
    out: Path,
    model: str | None,
    recover: bool,
    as_json: bool,
    settings_file: Path | None,
    settings: Sequence[str],
    where: str | None = None,
    **options: Any,
) -> None:
    """Tune on logs, write the result folder, and print the names of the logs and the result.

    The other options are those of `search`, by default `tune`.
    """
    chosen_logs, others = logs_meant(logs, where), logs_meant(held_out)
    logs, held_out = chosen_logs.logs, others.logs
    _check_apart(logs, held_out)
    check_outputs(
        out, None, {"log": [*logs, *held_out], "settings": list(filter(None, [settings_file]))}
    )
    alterations, own = split_texts(settings)
    chosen = settings_of_estimators([label], own, settings_file, model=model)
    if not as_json:
        say(f"tuning on {_in_words(logs)}; held out: {_in_words(held_out)}")
    with status() as show:
        found = (search or tune)(
            [LogSource(open_log(path, recover=recover)) for path in logs],
            chosen,
            set=alterations,
            bounds=pairs_of("--bound", bounds, _ends, "NAME=LOW:HIGH, for example sigma_range_m=0.01:1"),
            validate=[LogSource(open_log(path, recover=recover)) for path in held_out],
            on_best=lambda best: show(progress_of(best)),
            **options,
        )
    found = replace(found, unreadable={**chosen_logs.unreadable, **others.unreadable})
    saved = found.save(out)
    parameters = found.parameters.replace({np.nan: None}).to_dict("records")
    if as_json:
        print_json(
            {
                "logs": [str(path) for path in logs],
                "held_out": [str(path) for path in held_out],
                "parameters": parameters,
                "correlation": found.correlation.replace({np.nan: None}).to_dict(),
                "notes": found.notes,
                "metrics": saved.result.metrics,
                "bounds": saved.result.bounds,
                "written": [str(out)],
            }
        )
        return
    columns = ("parameter", "start", "value", "95 % from", "to")
    print_table(columns, [list(row.values()) for row in parameters])
    if len(found.correlation) > 1:
        rows = found.correlation.reset_index().to_numpy().tolist()
        print_table(("correlation", *found.correlation), rows)
    say(*found.notes)
    for each in found.replays:
        print_metrics(plain(each.judge.metrics), each.judge.bounds, each.judge.runs_table)
    say(f"{out / SETTINGS}: settings for --settings; {out}: tables, figures, timeline, result.json")


def _check_apart(logs: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Reject, or warn about, logs for tuning that were probably meant to be held out.

    The shell expands `--validate test/*.mcap` to several words, and the option receives only the first.
    """
    folders = {path.resolve().parent for path in held_out}
    beside = [path for path in logs if path.resolve().parent in folders]
    remedy = (
        "to hold out several logs, give their folder to --validate, or repeat --validate for each log"
    )
    for path in logs:
        if path.resolve() in {each.resolve() for each in held_out}:
            raise BadInput(f"{path}: is among both the tuned and the held-out logs; remove it from one")
    if beside and len(beside) < len(logs):
        more = f", together with {len(beside) - 1} more from its folder" if len(beside) > 1 else ""
        raise BadInput(
            f"{beside[0]}: would be tuned on{more}, although {held_out[0]} in the same folder is held "
            f"out; {remedy}"
        )
    if len(beside) > 1:
        warn(f"the {len(beside)} logs to tune on are in the same folder as those held out; {remedy}")


def progress_of(best: Best) -> str:
    """Describe the progress of a search: the number of evaluations and the best values so far."""
    named = zip(best.names, best.point, strict=True)
    values = ", ".join(f"{name} {value:.4g}" for name, value in named)
    found = (
        f"best so far: {values}" if values else "no values found yet with which all logs can be replayed"
    )
    return f"{best.evaluations} evaluations; {found}"


def _in_words(logs: Sequence[Path]) -> str:
    """Describe logs by their number, and by the names of the first and the last log."""
    if len(logs) > 1:
        return f"{len(logs)} logs, {logs[0]} to {logs[-1]}"
    return f"1 log, {logs[0]}" if logs else "none"


def _ends(text: str) -> tuple[float, float]:
    low, _, high = text.partition(":")
    if not (ends := (float(low), float(high)))[0] < ends[1]:
        raise ValueError
    return ends
