"""Candidates of a comparison, whose estimates of every run are compared with the truth.

The estimates of a candidate come from logs written by `fuselog replay`, from a replay with the settings
of a result, or from a trajectory file, which is converted to a stream of estimates.
"""

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fuselog.pipeline.api.replays import Replay, replay
from fuselog.pipeline.comparing.renamed import Renamed
from fuselog.pipeline.output.coverage import recounted, rows_of_candidate, stored_rows
from fuselog.pipeline.output.results import Result, read_result, read_table, split_metric
from fuselog.pipeline.runs.ensemble import Progress, judge_logs, parts_of
from fuselog.pipeline.runs.estimates import labels_of, source_of_estimates, stated_estimators
from fuselog.pipeline.runs.initial_states import check_same_run
from fuselog.pipeline.runs.inputs import load_scenario
from fuselog.pipeline.runs.runner import NO_REPLAY, runner_again
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import RunMetadata, open_log
from fuselog.recorders.parameters import flat
from fuselog.recorders.trajectories import read_trajectory
from fuselog.replay.engine.replaying.estimator import configure
from fuselog.replay.engine.replaying.replaying import BLOCK_MESSAGES
from fuselog.replay.engine.replaying.usage import Row
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, Source
from fuselog.replay.judging.errors.evaluation import POSITION
from fuselog.replay.judging.errors.trajectory_streams import estimates_of
from fuselog.replay.judging.errors.truths import Doubt
from fuselog.replay.judging.metrics.measuring import find_metrics
from fuselog.replay.judging.metrics.metrics import rmse_of
from fuselog.replay.judging.tables import joined

# The mean age of estimates, which the judge leaves out if it is zero.
AGE = "estimate_age_s"
# Relative tolerance between a result and its replay, because CPUs differ in the last digits.
SAME = 1e-6
# Entries of an experiment that affect its results.
DECIDING = ("record", "import", "logs", "alterations", "gap_limit_s", "arrival_order", "late")


Pairs = Mapping[str, tuple[Source, Source]]


@dataclass(frozen=True, eq=False)
class Candidate:
    """The estimates of one estimator, compared with the truth run by run.

    Attributes:
        name: name in the comparison.
        label: label of its estimates in their logs.
        rows: a row per run, case and quantity: `run`, `case`, `quantity`, `value`.
        times: a row per run, case and time span; see `Judge.times`.
        sizes: expected mean NEES by quantity and case.
        settings: settings that affect the estimates, by dotted name; None for recorded estimates.
        truths: hash of the truth by run.
        pairs: log and estimates by run, for the runs that can be drawn.
        notes: sentences about the origin of the estimates.
        replay: the replay that made the estimates of `pairs`, if any; it keeps their files alive.
        doubts: reasons to doubt the truth, by topic.
        coverage: counts of used and unused messages per topic.
    """

    name: str
    label: str
    rows: pd.DataFrame
    times: pd.DataFrame
    sizes: Mapping[tuple[str, str], float]
    settings: Mapping[str, Any] | None
    truths: Mapping[str, str] = field(default_factory=dict)
    pairs: Pairs = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    replay: Replay | None = None
    doubts: Mapping[str, Doubt] = field(default_factory=dict)
    coverage: Sequence[Row] = ()

    def estimates(self, run: str) -> Renamed:
        """Return the estimates of a run of `pairs`, under this candidate's name."""
        return Renamed(self.pairs[run][1], self.label, self.name)


@dataclass(frozen=True)
class Given:
    """One side of a comparison.

    Attributes:
        name: name in the comparison.
        labels: labels of its estimators.
        candidate: function that makes a candidate from a label and a name.
        sources: its runs by key, if they are logs.
    """

    name: str
    labels: Sequence[str]
    candidate: Callable[[str, str], Candidate]
    sources: Mapping[str, Source] = field(default_factory=dict)


def measured(
    name: str, label: str, pairs: Pairs, gap_limit_s: float, settings: Mapping[str, Any] | None
) -> Candidate:
    """Judge the estimates of a label run by run; each of the `pairs` is a log with its estimates.

    Estimates in the order of measurement have no metric of their age; an age of zero is added for them.
    """
    metrics = find_metrics()
    rows: list[tuple[object, ...]] = []
    times: list[pd.DataFrame] = []
    sizes: dict[tuple[str, str], float] = {}
    truths: dict[str, str] = {}
    doubts: dict[str, Doubt] = {}
    for run, (source, estimates) in pairs.items():
        own = Renamed(estimates, label, name)
        judge = judge_logs([own], [source], metrics, gap_limit_s=gap_limit_s)
        for key, value in judge.metrics.items():
            _, quantity, case = split_metric(key)
            rows.append((run, case, quantity, value))
        times.append(judge.times.assign(run=run))
        for errors in judge.judged.values():
            sizes["nees", errors.case] = float(len(errors.components))
            sizes["position_nees", errors.case] = float(len(errors.position))
        doubts = judge.doubts | doubts
        truths[run] = _hash_of_truth(source, own)
    aged = {(run, case) for run, case, quantity, _ in rows if quantity == AGE}
    judged = {(run, case): None for run, case, quantity, _ in rows if "rmse" in str(quantity)}
    rows += [(*each, AGE, 0.0) for each in judged if each not in aged]
    values = pd.DataFrame(rows, columns=["run", "case", "quantity", "value"])
    return Candidate(name, label, values, joined(times), sizes, settings, truths, pairs, doubts=doubts)


def _hash_of_truth(source: Source, estimates: Source) -> str:
    """Hash the truths of estimates; the hash does not depend on their division into blocks."""
    named = {topic.metadata.get("truth", "") for topic in estimates.topics.values()}
    digests: list[str] = []
    for topic in sorted(named & source.topics.keys()):
        times, states = hashlib.sha256(), hashlib.sha256()
        for block in source.whole().blocks([topic], "publish_time", BLOCK_MESSAGES):
            times.update(np.ascontiguousarray(block[topic].publish_time_ns).data)
            states.update(np.ascontiguousarray(block[topic]["state"]).data)
        digests += [times.hexdigest(), states.hexdigest()]
    return "".join(digests)


def key_of(source: Source) -> str:
    """Return the key of a run: its scenario, seed and number, or the name of a recorded log."""
    run = source.run
    if run is not None and run.seed is not None:
        return f"{run.scenario}, seed {run.seed}, run {run.run}"
    return Path(source.name).name


def settings_of(source: Source, label: str, stated: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that affect one estimator's estimates, by dotted name."""
    run = source.run or RunMetadata("unknown")
    own = {"scenario": run.scenario, "parameters": run.parameters}
    return dict(flat(own | {"estimator": parameters(label, stated)}))


def parameters(label: str, stated: Mapping[str, Any]) -> dict[str, Any]:
    """Return an estimator's parameters, with the defaults if fuselog has this estimator."""
    try:
        return dict(configure(label, stated)[1].model_dump(mode="json"))
    except BadInput:
        return dict(stated)


def name_of(path: Path) -> str:
    """Convert the name of a path to a label, without dots and slashes."""
    stem = path.resolve().name.removesuffix(".estimates.mcap").removesuffix(path.suffix)
    return re.sub(r"[^\w:=+-]+", "-", stem).strip("-") or "side"


def of_replay(name: str, done: Replay, gap_limit_s: float, recorded: Sequence[str] = ()) -> Given:
    """Return the estimators of a replay, preceded by the estimators whose estimates its logs contain.

    Raises BadInput if two of the logs are of the same run.
    """
    runs = list(map(key_of, done.logs))
    for run in runs:
        if runs.count(run) > 1:
            raise BadInput(f"{run}: two of the logs have this run; give each run once")
    pairs = dict(zip(runs, zip(done.logs, done.estimates, strict=True), strict=True))
    stated = done.done.parameters

    def candidate(label: str, name: str) -> Candidate:
        if label in recorded:
            own = {run: (log, log) for run, (log, _) in pairs.items()}
            return measured(name, label, own, gap_limit_s, None)
        settings = settings_of(done.logs[0], label, stated.get(label, {}))
        found = measured(name, label, pairs, gap_limit_s, settings)
        return replace(found, replay=done, coverage=rows_of_candidate(done.done.coverage, label, name))

    labels = [*recorded, *done.settings]
    return Given(name, labels, candidate, {run: log for run, (log, _) in pairs.items()})


def of_estimates(path: Path, gap_limit_s: float, *, recover: bool) -> Given:
    """Return the estimators of an estimates log, or of a folder with an estimates log for each run.

    Raises BadInput if a log has no estimates, two logs are of one run, or a replayed log is missing.
    """
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if not files:
        raise BadInput(
            f"{path}: has no estimates logs (*.mcap) and is not a result of fuselog run; give a folder "
            "of either kind"
        )
    pairs: dict[str, tuple[Source, LogSource]] = {}
    for file in files:
        log = open_log(file, recover=recover)
        if not labels_of(LogSource(log)):
            raise BadInput(
                f"{file}: has no estimates; name estimators with which to replay it, such as -e ekf -e "
                "ukf"
            )
        source = source_of_estimates(log, recover=recover)
        check_same_run(LogSource(log), source)
        run = key_of(source)
        if run in pairs:
            raise BadInput(f"{file}: {pairs[run][1].name} has estimates of {run} too; give one of them")
        pairs[run] = source, LogSource(log)
    log_of_first, first = next(iter(pairs.values()))
    stated = stated_estimators(first)

    def candidate(label: str, name: str) -> Candidate:
        own = {run: pair for run, pair in pairs.items() if label in labels_of(pair[1])}
        settings = settings_of(log_of_first, label, stated.get(label, {}))
        found = measured(name, label, own, gap_limit_s, settings)
        logs, estimates = zip(*own.values(), strict=True)
        own_settings = {label: stated[label]} if label in stated else {}
        counted = recounted(estimates, logs, own_settings, found.doubts)
        return replace(found, coverage=rows_of_candidate(counted, label, name))

    return Given(
        name_of(path), labels_of(first), candidate, {run: log for run, (log, _) in pairs.items()}
    )


def of_result(folder: Path, progress: Progress) -> Given:
    """Return the estimators of a result folder, replayed with its settings.

    A result contains the RMSE and NEES of every run, but not every metric. If a replay with this version
    reproduces the rows of the result, the other metrics of the replay are used too. Otherwise, only the
    rows of the result are used.
    """
    result = read_result(folder)
    tables = {name: folder / "tables" / f"{name}.parquet" for name in ("runs", "times")}
    if not all(path.is_file() for path in tables.values()):
        raise BadInput(
            f"{folder}: its study {result.settings.get('study', result.experiment)} has no row per run; "
            "compare its estimates logs instead"
        )
    rows, times = (read_table(path) for path in tables.values())
    if not pd.api.types.is_integer_dtype(rows["run"]):
        raise BadInput(
            f"{folder}: its runs have names, so it is the result of a comparison; give the logs or "
            "results that it compared"
        )
    stated = result.settings.get("parameters", {})
    numbers = sorted(set(rows["run"]))
    runs = {number: _run_of_result(result, number) for number in numbers}
    rows, times = (table.assign(run=table["run"].map(runs)) for table in (rows, times))

    def candidate(label: str, name: str) -> Candidate:
        kept = _stored(rows, times, label, name, _settings_of_result(result, label, stated))
        kept = replace(kept, coverage=rows_of_candidate(stored_rows(folder), label, name))
        try:
            again = _replayed(folder, result, progress, kept)
        except BadInput as error:
            return replace(kept, notes=(_without_replay(folder, str(error)),))
        again = replace(again, coverage=kept.coverage)
        difference = _row_that_differs(kept, again)
        return replace(kept, notes=(_without_replay(folder, difference),)) if difference else again

    labels = list(dict.fromkeys(rows["estimator"]))
    return Given(name_of(folder), labels, candidate)


def _run_of_result(result: Result, number: int) -> str:
    """Return the key of a result's run; see `key_of`."""
    settings = result.settings
    if "record" in settings:
        recorder, _, _ = load_scenario(settings["record"]["scenario"])
        return f"{recorder}, seed {settings['seed']}, run {number}"
    logs = settings.get("logs", [])
    files = logs.get("files", []) if isinstance(logs, dict) else logs
    return Path(files[number]).name if number < len(files) else f"run {number}"


def _without_replay(folder: Path, why: str) -> str:
    return f"{folder}: only the RMSE and NEES stored in the result are compared: {why}"


def _settings_of_result(result: Result, label: str, stated: Mapping[str, Any]) -> dict[str, Any]:
    deciding = {name: result.settings[name] for name in DECIDING if name in result.settings}
    return dict(flat(deciding | {"estimator": stated.get(label, {})}))


def _stored(
    rows: pd.DataFrame, times: pd.DataFrame, label: str, name: str, settings: Mapping[str, Any]
) -> Candidate:
    """Make a candidate from the tables that a result contains."""
    own = rows[rows["estimator"] == label].drop(columns=["estimator", "estimates"])
    components = [column for column in map(str, own) if column.startswith("rmse_")]
    sizes = {
        ("nees", str(case)): float(of_case[components].notna().any().sum())
        for case, of_case in own.groupby("case")
    }
    in_position = [f"rmse_{component}" for component in POSITION]
    named = {column: rmse_of(column.removeprefix("rmse_")) for column in components}
    values = (
        own.drop(columns=[column for column in in_position if column in own])
        .rename(columns=named)
        .melt(["case", "run"], var_name="quantity")
        .dropna()
    )
    return Candidate(name, label, values, times[times["estimator"] == label], sizes, settings)


def _replayed(folder: Path, result: Result, progress: Progress, kept: Candidate) -> Candidate:
    """Replay the runs of a result in batches, and compare them with the truth again."""
    label = kept.label
    runner = runner_again(folder, result)
    experiment = runner.experiment
    if label not in experiment.estimators:
        raise BadInput(NO_REPLAY)
    parts: list[Candidate] = []
    chosen = {label: experiment.estimators[label]}
    for now in progress(list(parts_of(experiment.runs)), f"replaying {label} of {folder}", None):
        done = replay(
            runner.obtain(first_run=now.start, runs=now.stop - now.start),
            [chosen],
            gap_limit_s=experiment.gap_limit_s,
            arrival_order=bool(experiment.arrival_order),
            late=experiment.late,
            set=experiment.alterations,
        )
        runs = [_run_of_result(result, number) for number in range(now.start, now.stop)]
        pairs = dict(zip(runs, zip(done.logs, done.estimates, strict=True), strict=True))
        part = measured(kept.name, label, pairs, experiment.gap_limit_s, kept.settings)
        parts.append(replace(part, replay=done) if not parts else replace(part, pairs={}))
    first = parts[0]
    return replace(
        first,
        rows=joined(each.rows for each in parts),
        times=joined(each.times for each in parts),
        truths={run: truth for each in parts for run, truth in each.truths.items()},
    )


def _row_that_differs(kept: Candidate, again: Candidate) -> str:
    """Describe the first row in which a replay differs from a result, or return "" if they agree."""
    both = kept.rows.merge(again.rows, on=["run", "case", "quantity"], suffixes=("", "_again"))
    apart = ~np.isclose(both["value"], both["value_again"], rtol=SAME, atol=0.0)
    if len(both) < len(kept.rows):
        return "a replay does not reproduce all of its rows"
    if not apart.any():
        return ""
    row = both[apart].iloc[0]
    return (
        f"in a new replay, {row['quantity']} of {kept.label}, {row['run']} is {row['value_again']:.6g}, "
        f"not {row['value']:.6g}; the code has changed since"
    )


def of_trajectory(path: Path, source: Source, truth_topic: str, gap_limit_s: float) -> Given:
    """Return the trajectory in a file as estimates of a run, to be compared with a topic of truth."""
    trajectory = read_trajectory(path)
    name = name_of(path)
    truth = source.read([truth_topic])[truth_topic]
    case = truth_topic.rpartition("/")[0].removeprefix("/")
    topic = "/".join(filter(None, ("/estimates", name, case, "pose")))
    stream = estimates_of(trajectory, topic, truth)
    run = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
    pairs: Pairs = {key_of(source): (source, MemorySource({topic: stream}, run, str(path)))}

    def candidate(label: str, name: str) -> Candidate:
        found = measured(name, label, pairs, gap_limit_s, {})
        rows = found.rows[found.rows["quantity"] != AGE]  # a file does not state when poses were known
        return replace(found, rows=rows, notes=trajectory.notes)

    return Given(name, [name], candidate)
