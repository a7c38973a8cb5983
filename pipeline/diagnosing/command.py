"""The command `fuselog diagnose`, which prints likely faults and what to try against them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fuselog.pipeline.api.over_logs import campaign_of, opening, show_over_logs
from fuselog.pipeline.diagnosing.consistency import comparable
from fuselog.pipeline.diagnosing.diagnosis import diagnose
from fuselog.pipeline.diagnosing.over_logs import Diagnosing
from fuselog.pipeline.output.outputs import check_outputs
from fuselog.pipeline.output.results import plain
from fuselog.pipeline.output.terminal import print_json, print_metrics, print_table, say, status
from fuselog.pipeline.runs.estimates import recorded_estimators
from fuselog.pipeline.runs.settings import settings_of_estimators, split_texts
from fuselog.pipeline.selecting.selection import SelectionOptions
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import open_log
from fuselog.recorders.parameters import parse_settings
from fuselog.replay.engine.streams.sources import LogSource


def diagnose_log(
    logs: Sequence[Path],
    *,
    label: str | None,
    out: Path | None,
    save: Path | None,
    model: str | None,
    recover: bool,
    gap_limit_s: float,
    as_json: bool,
    tells_tried: bool,
    settings_file: Path | None,
    settings: Sequence[str],
) -> None:
    """Diagnose, write the requested files, and print sentences, components and metrics."""
    log, *others = logs
    if others:
        raise BadInput(
            f"{len(logs)} logs: give one log; diagnose takes one at a time, and fuselog tune takes all "
            "of them together"
        )
    check_outputs(out, save, {"log": [log], "settings": list(filter(None, [settings_file]))})
    alterations, own = split_texts(settings)
    opened = open_log(log, recover=recover)
    if label is not None and label in recorded_estimators(opened):
        given = parse_settings(own)
    elif label is not None:
        [(label, given)] = settings_of_estimators([label], own, settings_file, model=model).items()
    elif settings_file is not None:
        raise BadInput(f"--settings {settings_file}: settings are for one estimator; name it with -e")
    else:
        given = parse_settings(own) | ({} if model is None else {"model": model})
    with status() as show:
        show("replaying with each fault corrected in turn")
        found = diagnose(
            LogSource(opened),
            label,
            set=given | alterations,
            gap_limit_s=gap_limit_s,
        )
    written = [str(found.save(out).folder)] if out is not None else []
    if save is not None:
        found.view(save)
        written.append(str(save))
    judge = found.replay.judge
    metrics = comparable(plain(judge.metrics), found.log_likelihood)
    if as_json:
        print_json(
            {
                "found": found.told,
                "hypotheses": found.hypotheses,
                "least_gain": found.least_gain if found.hypotheses else None,
                "tried": found.tried.replace({np.nan: None}).to_dict("records"),
                "sentences": found.causes.replace({np.nan: None}).to_dict("records"),
                "components": found.components.replace({np.nan: None}).to_dict("records"),
                "notes": list(found.notes),
                "metrics": metrics,
                "bounds": judge.bounds,
                "written": written,
            }
        )
        return
    print_metrics(metrics, judge.bounds)
    columns = ("component", "mean", "mean square", "beyond 3 sigma", "autocorrelation", "p if white")
    print_table(
        columns,
        [
            [
                " ".join(filter(None, (row["case"], row["component"]))),
                *(row[name] for name in ("mean", "mean_square", "beyond_3_sigma")),
                *(row[name] for name in ("next_correlation", "probability_white")),
            ]
            for row in found.components.to_dict("records")
        ],
    )
    if tells_tried:
        print_table(
            ("fault", "value", "gain"),
            [
                [
                    " ".join(filter(None, (row["kind"], row["topic"], row["part"]))),
                    row["value"],
                    row["gain"],
                ]
                for row in found.tried.to_dict("records")
            ],
        )
    say(*found.told, *found.notes, *written)


def diagnose_selection(
    selection: SelectionOptions,
    *,
    label: str | None,
    out: Path | None,
    save: Path | None,
    model: str | None,
    recover: bool,
    gap_limit_s: float,
    as_json: bool,
    tells_tried: bool,
    settings_file: Path | None,
    settings: Sequence[str],
) -> bool:
    """Diagnose each log of a selection; return whether at least one could be diagnosed."""
    if save is not None or tells_tried:
        raise BadInput("--save and --tried apply to a single log; leave them out for a selection")
    alterations, own = split_texts(settings)
    given: dict[str, Any] = {}
    if label is not None:
        [(label, given)] = settings_of_estimators([label], own, settings_file, model=model).items()
    elif own or settings_file is not None or model is not None:
        raise BadInput("settings are for one estimator; name it with -e")
    campaign = campaign_of(selection, out or Path("out/diagnose"))
    task = Diagnosing(label, given | alterations, gap_limit_s, recover)
    found = campaign.run(task, "diagnose", {"estimators": {label: given} if label else {}})
    opens = opening("diagnose", [label] if label else [], settings_file, settings)
    return show_over_logs(found, as_json=as_json, opens=opens)
