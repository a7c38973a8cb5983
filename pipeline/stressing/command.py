"""The command `fuselog stress`, which prints whether a result is robust, and which changes affect it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fuselog.pipeline.output.outputs import check_outputs
from fuselog.pipeline.output.terminal import print_json, print_table, say, status
from fuselog.pipeline.runs.settings import settings_of_estimators, split_texts
from fuselog.pipeline.stressing.changes import CHANGES
from fuselog.pipeline.stressing.stressing import stress
from fuselog.recorders.log import open_log
from fuselog.replay.engine.streams.sources import LogSource

COLUMNS = {
    "verdict": "verdict",
    "amplification": "sigmas",
    "metres": "m",
    "degrees": "deg",
    "growth": "growth",
    "halved": "ratio to half",
    "parted_s": "diverge at (s)",
    "topic": "by",
    "note": "note",
}


def stress_logs(
    logs: Sequence[Path],
    labels: Sequence[str],
    *,
    model: str | None,
    seed: int,
    recover: bool,
    gap_limit_s: float,
    save: Path | None,
    as_json: bool,
    settings_file: Path | None,
    settings: Sequence[str],
) -> None:
    """Stress estimators, and print the verdicts, followed by a table for each run and estimator."""
    check_outputs(None, save, {"log": [*logs, *filter(None, [settings_file])]})
    alterations, own = split_texts(settings)
    chosen = settings_of_estimators(labels, own, settings_file, model=model)
    with status() as show:
        show("replaying under changes that should not matter")
        found = stress(
            [LogSource(open_log(log, recover=recover)) for log in logs],
            [{label: values} for label, values in chosen.items()],
            seed=seed,
            gap_limit_s=gap_limit_s,
            set=alterations,
        )
    if save is not None:
        found.draw(save)
    if as_json:
        rows = found.table.replace({np.nan: None}).to_dict("records")
        print_json({"sentences": found.sentences, "changes": rows})
        return
    say(*found.sentences)
    for each in found.stressed:
        shown = [
            [CHANGES[row["change"]].words, *(_shown(row[name]) for name in COLUMNS)] for row in each.rows
        ]
        print_table(["change", *COLUMNS.values()], shown, f"{each.estimator} of {each.run}")
    if save is not None:
        say(str(save))


def _shown(value: object) -> object:
    return None if isinstance(value, float) and np.isnan(value) else value
