"""Commands over selections of logs: each log by itself, the worst first, and verdicts over all of them.

A selection is divided among workers and resumed after an interruption; see
`fuselog.pipeline.runs.batches`. The result is a folder with the table `logs`, which has a row for each
log and estimator, also for a log that could not be read or replayed, with the reason.
"""

import hashlib
import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.api.planning import plan_replay
from fuselog.pipeline.logs.cataloguing import select
from fuselog.pipeline.output.alarming import alarms_of
from fuselog.pipeline.output.outputs import check_outputs
from fuselog.pipeline.output.results import (
    Kind,
    Outcome,
    hash_of,
    result_folder,
    split_metric,
    write_outcome,
)
from fuselog.pipeline.output.terminal import print_json, print_table, progress, say, say_next
from fuselog.pipeline.output.words import count, is_error
from fuselog.pipeline.runs.batches import Row, Task, batches_of, over_logs
from fuselog.pipeline.runs.checkpoints import checkpoints_of
from fuselog.pipeline.runs.ensemble import Pass, Progress, Settings, no_progress
from fuselog.pipeline.runs.executors import PoolFactory, pool_for
from fuselog.pipeline.selecting.selection import Selection, SelectionOptions
from fuselog.recorders.errors import BadInput, without_warnings_of_numbers
from fuselog.recorders.log import open_log
from fuselog.recorders.remote.paths import seen_from
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.judging.errors.evaluation import chi_square_interval
from fuselog.replay.judging.intervals import (
    FEWEST_RUNS,
    Interval,
    mean_interval,
    rms_interval,
    root_mean_square,
    too_few,
)
from fuselog.replay.judging.verdicts import Squares

NIS, COMPONENTS = "nis_per_component", "components"
SIZES = {"nees": COMPONENTS, "position_nees": "position_components"}  # of which they are the aims
FAILED = "failed_runs"
FAULTS, GAIN = "faults", "gain"  # by which logs are sorted without errors
# Columns that identify a row, and columns with texts; all others are metrics.
KEYS = ("log", "group", "estimator", "case")
TEXTS = ("problem", "doubt", "kind", "where", "setting", "finding", "estimates", "sha256")
LOG = "LOG"  # stands for the log in the words of a command
OTHERS = (*KEYS, *TEXTS, *SIZES.values())
PRINTED = ("nees", NIS, FAULTS, GAIN)
SAID = ("problem", "finding", "doubt")  # printed with the command that opens a log
MOST_ROWS, MOST_OPENED = 10, 5  # largest numbers of rows and of commands that are printed


@dataclass(frozen=True)
class Replaying:
    """The replay of a log by estimators: a row per estimator and case, with its metrics.

    Attributes:
        estimators: settings by label.
        options: other arguments of `plan_replay`.
        recover: whether the readable part of a damaged log is used.
        place: the result folder, to which estimates are written; None to write none.
        programs: sizes and modification times of the programs that the estimators run.
    """

    estimators: Settings
    options: Mapping[str, Any]
    recover: bool = False
    place: Path | None = None
    programs: Sequence[Any] = ()
    doing: ClassVar[str] = "replaying"

    @without_warnings_of_numbers()
    def __call__(self, log: Path, number: int, folder: Path) -> list[Row]:
        """Return the rows of a log, and write its estimates."""
        name = Path("estimates", f"{number:04d}-{log.stem}.estimates.mcap")
        refused: dict[str, str] = {}
        try:
            done = self._replay(log, self.estimators, folder / name)
        except BadInput:
            refused = {label: why for label in self.estimators if (why := self._refusal(log, label))}
            others = {label: of for label, of in self.estimators.items() if label not in refused}
            if not others:
                return [{"estimator": label, "problem": why} for label, why in refused.items()]
            done = self._replay(log, others, folder / name)
        rows = [*_rows_of(done), *({"estimator": of, "problem": why} for of, why in refused.items())]
        about = {"sha256": hash_of(log), "estimates": None if self.place is None else name.as_posix()}
        return [row | about for row in rows]

    def _refusal(self, log: Path, label: str) -> str:
        """Return the reason why an estimator cannot replay a log, or "" if it can."""
        try:
            replace(self, place=None)._replay(log, {label: self.estimators[label]}, Path())
        except BadInput as error:
            return str(error).removeprefix(f"{log}: ")
        return ""

    def _replay(self, log: Path, estimators: Settings, path: Path) -> Pass:
        source = LogSource(open_log(log, recover=self.recover))
        plan = plan_replay([source], estimators, **self.options)
        places = []
        if self.place is not None:
            places = [(path, seen_from(path, self.place / "estimates" / path.name, log))]
        return plan.replay(places)


def _rows_of(done: Pass) -> list[Row]:
    """Return the metrics of a replay of one log, with a row per estimator and case."""
    rows: dict[tuple[str, str], Row] = {}
    for key, value in done.judge.metrics.items():
        label, quantity, case = split_metric(key)
        rows.setdefault((label, case), {"estimator": label, "case": case})[quantity] = value
    for errors in done.judge.judged.values():
        if (errors.estimator, errors.case) in rows and not errors.is_bound:
            sizes = len(errors.components), len(errors.position)
            rows[errors.estimator, errors.case] |= dict(zip(SIZES.values(), sizes, strict=True))
    doubts = {}
    for alarm in reversed(alarms_of(done.judge, done.parameters, done.coverage)):
        doubts[alarm.where, alarm.part] = alarm.sentence
    failures = [sentence for _, sentence in done.judge.failed_runs]
    for (label, case), row in rows.items():
        row["doubt"] = doubts.get((label, case))
        name = " ".join(filter(None, (label, case)))
        own = [each for each in failures if each.startswith((f"{name} ", f"{name}:"))]
        row["problem"] = "; ".join(own) or None
    return list(rows.values())


class OverLogs(NamedTuple):
    """The findings of a command in each log of a selection.

    Attributes:
        table: a row per log and estimator, those of the worst log first.
        verdicts: a row per estimator, case and metric, with its interval over logs or groups.
        folder: the result folder.
    """

    table: pd.DataFrame
    verdicts: pd.DataFrame
    folder: Path


class Campaign(NamedTuple):
    """A selection of logs, the result folder, the workers, and the options that define the selection."""

    selection: Selection
    out: Path
    open_pool: PoolFactory
    stated: Mapping[str, Any] = MappingProxyType({})
    progress: Progress = no_progress

    def run(self, task: Task, kind: Kind, settings: Mapping[str, Any]) -> OverLogs:
        """Run a task over the logs, and write its rows and verdicts to the result folder."""
        with self.table(task) as (table, hand_over), result_folder(self.out) as part:
            hand_over(part)
            outcome = Outcome(tables={"logs": table}, kind=kind)
            verdicts = pd.DataFrame(measured(table, outcome))
            if len(verdicts):
                outcome.tables["verdicts"] = verdicts
            if "sha256" in table:
                digests = table["sha256"].fillna("").groupby(table["log"]).first()
                outcome.input_sha256 = hashlib.sha256("".join(digests).encode()).hexdigest()
            if "runs" in outcome.tables:
                settings = {**settings, "runs": outcome.tables["runs"]["unit"].nunique()}
            title = f"{kind} of {count(table['log'].nunique(), 'log')}"
            write_outcome(part, kind, {"title": title, **self.stated, **settings}, outcome)
        return OverLogs(table, verdicts, self.out)

    @contextmanager
    def table(self, task: Task) -> Iterator[tuple[pd.DataFrame, Callable[[Path], None]]]:
        """Yield the rows of a task, the worst log first, and a function that moves the task's files.

        The function takes the folder. Rows and files are kept until the block has succeeded.
        """
        check_outputs(self.out, None, {"log": self.selection.logs})
        with checkpoints_of(self.out) as checkpoints:
            batches = batches_of(task, self.selection.logs)
            found = list(over_logs(batches, self.open_pool, checkpoints, self.progress))
            hand_over = partial(checkpoints.hand_over, [batch.key for batch in batches])
            yield worst_first(_table_of(self.selection, found)), hand_over


def campaign_of(options: SelectionOptions, out: Path) -> Campaign:
    """Select logs and workers by the options of a command."""
    found = select(options.paths, options.where, options.group)
    pool = pool_for(options.workers, options.scheduler, len(found.logs))
    return Campaign(found, out, pool, options.stated, progress)


def _table_of(selection: Selection, found: Sequence[Sequence[Row]]) -> pd.DataFrame:
    """Make a table of the rows of all logs, and of the logs that cannot be read."""
    groups: Sequence[str | None] = selection.groups or [None] * len(selection.logs)
    rows = [
        {"log": str(log), "group": group, "estimator": None, "case": None, **row}
        for log, group, of_log in zip(selection.logs, groups, found, strict=True)
        for row in of_log
    ]
    rows += [{"log": str(log), "problem": why} for log, why in selection.unreadable.items()]
    table = pd.DataFrame(rows)
    texts = [name for name in TEXTS if name in table]
    table = table[[*table.columns.drop(texts), *texts]].dropna(axis="columns", how="all")
    return table.assign(problem=table.get("problem"))


def worst_first(table: pd.DataFrame) -> pd.DataFrame:
    """Sort the rows of logs: logs with a problem first, then by error of the most accurate estimator.

    Without errors, logs are sorted by their faults or gains, or by how far their NIS is from 1.
    """
    logs = table["log"]
    by = next((name for name in map(str, table) if is_error(name) and table[name].notna().any()), None)
    badness = pd.Series(0.0, table.index)
    if by is not None:
        own = table[table[COMPONENTS].notna()] if COMPONENTS in table else table  # no bounds
        best = own.groupby("estimator")[by].mean().idxmin()
        badness = table[by].where(table["estimator"] == best)
    elif severe := next((name for name in (FAULTS, GAIN) if name in table), None):
        badness = table[severe]
    elif NIS in table:
        badness = np.log(table[NIS]).abs()
    failed = table["problem"].notna()
    keys = pd.DataFrame({"failed": failed, "badness": badness.fillna(0.0)}).groupby(logs).max()
    keys = keys.reset_index().sort_values(["failed", "badness", "log"], ascending=[False, False, True])
    place = {log: number for number, log in enumerate(keys["log"])}
    return table.iloc[np.argsort(logs.map(place).to_numpy(), kind="stable")].reset_index(drop=True)


def measured(table: pd.DataFrame, outcome: Outcome) -> Iterator[Row]:
    """Add each metric over the logs, and its values by unit, to the outcome; yield a row per metric.

    The unit of an interval is the log, or the group of logs; see docs/judge.md.
    """
    if "estimator" not in table or "case" not in table:  # nothing was judged
        return
    metrics = [str(name) for name in table if name not in OTHERS]
    table = table.assign(unit=table["group"] if "group" in table else table["log"])
    numbers = {unit: number for number, unit in enumerate(sorted(table["unit"].dropna().unique()))}
    runs: list[pd.DataFrame] = []
    for what, rows in table.fillna({"case": ""}).groupby(["estimator", "case"], sort=False):
        label, case = map(str, what)
        failed = table[(table["estimator"] == label) & table["problem"].notna()]
        aims = {NIS: 1.0, **aims_of(rows)}
        of_units: dict[str, pd.Series] = {}
        for name in metrics:
            known, is_rms = rows[rows[name].notna()], "rmse" in name
            if not len(known):
                continue
            own = of_units[name] = by_unit(known[name], known["unit"], is_rms=is_rms)
            number = (rms_interval if is_rms else mean_interval)(own.to_numpy())
            if name == FAILED:
                number = Interval(float(failed["unit"].nunique()))
            key, aim = ".".join(filter(None, (label, name, case))), aims.get(name, math.nan)
            outcome.measure(key, number)
            usual = (-math.inf, math.inf)
            if name in SIZES and name in aims:
                usual = outcome.bounds[key] = chi_square_interval(int(aim), len(own))
            is_judged = name in aims and (number.is_bounded or key in outcome.bounds)
            yield {
                "estimator": label,
                "case": case,
                "quantity": name,
                "value": number.value,
                "low": number.low,
                "high": number.high,
                "aim": aim,
                "verdict": str(Squares(name, number, aim, usual).verdict) if is_judged else None,
                "logs": known["log"].nunique(),
                "units": len(own),
            }
        about = {"estimator": label, "case": case}
        runs.append(pd.DataFrame(of_units).rename_axis("unit").reset_index().assign(**about))
    of_all = pd.concat(runs, ignore_index=True)
    outcome.tables["runs"] = of_all.assign(run=of_all["unit"].map(numbers))


def aims_of(rows: pd.DataFrame) -> dict[str, float]:
    """Return the expected NEES of the state and of the position, if it is the same in all rows."""
    sizes = {name: {*rows[of].dropna()} for name, of in SIZES.items() if of in rows}
    return {name: float(own.pop()) for name, own in sizes.items() if len(own) == 1 and any(own)}


def by_unit(values: pd.Series, units: pd.Series, *, is_rms: bool) -> pd.Series:
    """Compute the value of each unit, such as a robot: the mean or root mean square over its logs.

    Args:
        values: (n,) one value per log.
        units: (n,) the unit of each log.
        is_rms: whether the values are root mean squares.
    """
    found: pd.Series = values.groupby(units).agg(root_mean_square if is_rms else "mean")
    return found


def show_over_logs(found: OverLogs, *, as_json: bool, opens: Sequence[str] = ("info", LOG)) -> bool:
    """Print the worst logs, the commands that open them, and the verdicts over all logs.

    `opens` are the words of the command that opens a log without estimates. Returns whether every
    estimator, or the command itself, succeeded on at least one log.
    """
    table, verdicts = (each.replace({np.nan: None}) for each in found[:2])
    failed = table["problem"].notna()
    by = table["estimator"].dropna() if "estimator" in table else table["log"]
    is_good = bool((~failed).groupby(by).any().all()) if "estimator" in table else not failed.all()
    if as_json:
        of_logs, over_all = (each.to_dict("records") for each in (table, verdicts))
        print_json({"logs": of_logs, "verdicts": over_all, "written": [str(found.folder)]})
        return is_good
    show_worst(table, found.folder, opens)
    rows = [
        [
            each["estimator"],
            each["case"] or None,
            each["quantity"],
            str(Interval(each["value"], each["low"], each["high"])),
            *(each[name] for name in ("aim", "verdict", "logs", "units")),
        ]
        for each in found.verdicts.to_dict("records")
        if each["quantity"] in (*_shown_error(table), "nees", NIS)
    ]
    if rows:
        columns = ["estimator", "case", "metric", "value", "aim", "verdict", "logs", "units"]
        print_table(columns, rows)
    if rows and (few := min(row[-1] for row in rows)) < FEWEST_RUNS:
        say(f"a unit is a run or a group of runs: {too_few(few)}")
    if "estimates" in table:
        say(f"to view all estimates: fuselog view {shlex.quote(str(found.folder / 'estimates'))}")
    bad = table["log"][failed].nunique()
    say(f"{bad} of {count(table['log'].nunique(), 'log')} failed; {found.folder}: tables, result.json")
    say_next("report", str(found.folder))
    return is_good


def opening(
    command: str, labels: Sequence[str], settings_file: Path | None, settings: Sequence[str]
) -> list[str]:
    """Return the words of a command that processes one log with the same estimators and settings."""
    options = [("-e", label) for label in labels]
    options += [("--settings", str(file)) for file in filter(None, [settings_file])]
    options += [("--set", text) for text in settings]
    return [command, LOG, *(word for option in options for word in option)]


def show_worst(table: pd.DataFrame, folder: Path, opens: Sequence[str]) -> None:
    """Print the rows of the worst logs, and the commands that open them; see `show_over_logs`."""
    table = table.replace({np.nan: None})
    columns = [
        name
        for name in (*KEYS, *_shown_error(table), *PRINTED)
        if name in table and table[name].notna().any()
    ]
    print_table(columns, table[columns].head(MOST_ROWS).to_numpy().tolist())
    if len(table) > MOST_ROWS:
        say(f"the worst {MOST_ROWS} of {len(table)} rows; all are in {folder}/tables")
    failed = table["problem"].notna()
    is_bad = failed | (table[FAULTS].fillna(0) > 0) if FAULTS in table else failed | True
    for log, own in list(table[is_bad].groupby("log", sort=False))[:MOST_OPENED]:
        told = [each for name in SAID if name in own for each in own[name].dropna()]
        written = own["estimates"].dropna().tolist() if "estimates" in own else []
        view = ["view", *(str(folder / name) for name in written[:1]), "--at", "worst"]
        words = view if written else [str(log) if word == LOG else word for word in opens]
        for sentence in told[:1]:
            say(f"{log}: {sentence}")
        say(shlex.join(["fuselog", *words]))


def _shown_error(table: pd.DataFrame) -> list[str]:
    """Return a list with the name of the error to print, which is empty if no log has truth."""
    return [name for name in map(str, table) if is_error(name)][:1]
