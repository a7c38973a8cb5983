"""The command `fuselog compare`, which prints verdicts with intervals and writes the chosen outputs."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fuselog.pipeline.api.over_logs import Replaying, campaign_of, opening, show_worst
from fuselog.pipeline.comparing.comparing import Differences, Paired, compare
from fuselog.pipeline.comparing.groups import recorded_labels, with_logs_of_folders
from fuselog.pipeline.comparing.over_logs import compare_over_logs
from fuselog.pipeline.output.alarms import NOT_TESTED
from fuselog.pipeline.output.outputs import check_outputs
from fuselog.pipeline.output.terminal import print_json, print_table, progress, say, warn
from fuselog.pipeline.runs.executors import states_of
from fuselog.pipeline.runs.settings import settings_of_estimators, split_texts
from fuselog.pipeline.selecting.selection import SelectionOptions
from fuselog.recorders.errors import BadInput
from fuselog.replay.foreign.naming import program_files

COLUMNS = {
    "quantity": "metric",
    "aim": "aim",
    "first_mean": "{first}",
    "second_mean": "{second}",
    "difference": "difference",
    "low": "95 % from",
    "high": "to",
    "verdict": "verdict",
    "sure": "sure",
    "runs": "runs",
}


def compare_candidates(
    candidates: Sequence[Path],
    labels: Sequence[str],
    *,
    truth: Path | None,
    out: Path | None,
    save: Path | None,
    recover: bool,
    as_json: bool,
    fail_if_worse: bool,
    settings_file: Path | None,
    settings: Sequence[str],
    **options: Any,
) -> bool:
    """Compare candidates, print tables and verdicts, and write the result folder and the timeline.

    The other options are those of `compare`. Returns False if `fail_if_worse` is set and a candidate is
    worse than the first (see `Differences.worse`), otherwise True.
    """
    check_outputs(out, save, {"input": [*candidates, *filter(None, [truth, settings_file])]})
    alterations, own = split_texts(settings)
    given = candidates
    candidates = with_logs_of_folders(candidates, labels, recover=recover)
    has = recorded_labels(candidates, recover=recover)
    recorded = [label for label in labels if label in has]
    chosen = settings_of_estimators([label for label in labels if label not in has], own, settings_file)
    found = compare(
        *candidates,
        estimators=[*recorded, *({label: values} for label, values in chosen.items())],
        truth=truth,
        set=alterations,
        recover=recover,
        progress=progress,
        **options,
    )
    worse = found.worse() if fail_if_worse else []
    written = []
    if out is not None:
        written.append(found.save(out).folder)
    if save is not None:
        found.draw(save)
        written.append(save)
    stress_tests = [NOT_TESTED] if found.stress is None else found.stress.sentences
    _show(found, worse, written, stress_tests, as_json=as_json)
    if not (as_json or labels) and all(each.is_dir() or each.suffix == ".mcap" for each in given):
        say(f"to see each run with all results in one scene: fuselog view {shlex.join(map(str, given))}")
    return not worse


def compare_selection(
    selection: SelectionOptions,
    labels: Sequence[str],
    *,
    margin: float,
    out: Path | None,
    recover: bool,
    gap_limit_s: float,
    as_json: bool,
    fail_if_worse: bool,
    settings_file: Path | None,
    settings: Sequence[str],
    **others: Any,
) -> bool:
    """Compare estimators over the logs of a selection; see `compare_candidates`."""
    for name, value in others.items():
        if value:
            raise BadInput(f"--{name}: does not apply to a selection of logs; leave it out")
    alterations, own = split_texts(settings)
    estimators = settings_of_estimators(labels, own, settings_file)
    options = {"gap_limit_s": gap_limit_s, "set": alterations}
    task = Replaying(estimators, options, recover, programs=states_of(program_files(estimators)))
    campaign = campaign_of(selection, out or Path("out/compare"))
    found = compare_over_logs(task, campaign, margin, gap_limit_s, fail_if_worse=fail_if_worse)
    worse = found.worse() if fail_if_worse else []
    if not as_json:
        opens = opening("replay", labels, settings_file, settings)
        show_worst(found.tables["logs"], campaign.out, opens)
    _show(found, worse, [campaign.out], [], as_json=as_json)
    return not worse


def _show(
    found: Differences,
    worse: Sequence[Paired],
    written: Sequence[Path],
    stress_tests: Sequence[str],
    *,
    as_json: bool,
) -> None:
    """Print the differences, the verdicts and the notes."""
    warn(*found.notes)
    if worse:
        warn("worse than the first: " + ", ".join(f"{each.second} in {each.quantity}" for each in worse))
    if as_json:
        print_json(
            {
                "differences": found.table.replace({np.nan: None}).to_dict("records"),
                "sentences": found.sentences,
                "notes": found.notes,
                "stress": list(stress_tests),
                "coverage": [row._asdict() for row in found.coverage],
                "written": [str(path) for path in written],
            }
            | {
                name: rows.replace({np.nan: None}).to_dict("records")
                for name, rows in found.tables.items()
            }
        )
        return
    table = found.table.replace({np.nan: None})
    for (first, second, case_), rows in table.groupby(["first", "second", "case"], sort=False):
        columns = [title.format(first=first, second=second) for title in COLUMNS.values()]
        title = " ".join(filter(None, (str(case_), f"{second} against {first}")))
        print_table(columns, rows[list(COLUMNS)].to_numpy().tolist(), title)
    say(*found.sentences)
    say(*stress_tests)
    say(*map(str, written))
