"""What the commands do: the work between the command line and the library."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipeline.ensemble import Replayed, judge, replay_to_logs
from pipeline.experiment import load_experiment, read_toml, run_experiment, shipped
from pipeline.results import write_tables
from pipeline.studies.localization import summarise
from pipeline.terminal import err, out, print_json, print_metrics, print_table, progress
from recorders.errors import BadInput
from recorders.log import Log, open_log
from recorders.parameters import parse_settings
from recorders.recording import Importer
from recorders.registry import available, load
from replay.blocks import Ragged, gather
from replay.sources import LogSource
from replay.timeline import viewer
from replay.timeline.show import recorded_outputs, show


def _source(
    path: Path, *, recover: bool, start_s: float | None = None, end_s: float | None = None
) -> LogSource:
    """A log as a source, with a span in seconds from its epoch."""
    log = open_log(path, recover=recover)
    epoch_ns = log.run.epoch_ns if log.run else 0
    start_ns = None if start_s is None else epoch_ns + round(start_s * 1e9)
    end_ns = None if end_s is None else epoch_ns + round(end_s * 1e9)
    return LogSource(log, start_ns, end_ns)


def _state_losses(sources: Sequence[LogSource]) -> None:
    for source in sources:
        if source.log.loss_statement:
            err.print(f"fuselog: {source.log.loss_statement}", highlight=False)


def _estimator_settings(names: Sequence[str], settings: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Parameters by estimator: `ekf.gate_probability=1` goes to ekf, `gate_probability=1` to all."""
    values = parse_settings(settings)
    own = {name: values.pop(name) for name in names if isinstance(values.get(name), dict)}
    return {name: {**values, **own.get(name, {})} for name in names}


def replay_logs(
    logs: list[Path],
    names: list[str],
    *,
    out: Path | None,
    arrival_order: bool,
    start_s: float | None,
    end_s: float | None,
    save: Path | None,
    connect: str | None,
    recover: bool,
    gap_limit_s: float,
    as_json: bool,
    settings: Sequence[str],
) -> None:
    """Replay, write the estimates logs, judge them where there is truth, print the metrics."""
    sources = [_source(path, recover=recover, start_s=start_s, end_s=end_s) for path in logs]
    estimators = _estimator_settings(names, settings)
    paths = _estimate_paths(logs, out)
    replay_to_logs(
        sources,
        estimators,
        paths,
        order="log_time" if arrival_order else "publish_time",
        progress=progress,
    )
    _state_losses(sources)
    replayed = _judge_logs(sources, [open_log(path) for path in paths], gap_limit_s)
    if save is not None or connect is not None:
        _show(replayed, save, connect)
    _print_outcome(replayed, as_json=as_json, written=paths)


def _estimate_paths(logs: Sequence[Path], out: Path | None) -> list[Path]:
    """Where the estimates of each log go: beside it, to the one file given, or into a folder."""
    if out is None:
        return [path.with_suffix(".estimates.mcap") for path in logs]
    if len(logs) == 1 and out.suffix == ".mcap":
        return [out]
    if len({path.name for path in logs}) < len(logs):
        raise BadInput("the logs share file names; replay them in turn with --out for each")
    return [out / path.name for path in logs]


def evaluate_logs(
    estimates: list[Path],
    logs: list[Path],
    *,
    out: Path | None,
    recover: bool,
    gap_limit_s: float,
    as_json: bool,
) -> None:
    """Judge estimates logs; the truth is in the logs given, else in those they were replayed from."""
    if logs and len(logs) != len(estimates):
        raise BadInput(f"{len(estimates)} estimates logs and {len(logs)} --log; give one for each")
    opened = [open_log(path, recover=recover) for path in estimates]
    sources = [_source(path, recover=recover) for path in logs or [source_path(each) for each in opened]]
    replayed = _judge_logs(sources, opened, gap_limit_s)
    if not replayed.errors and not replayed.innovations:
        raise BadInput(f"{estimates[0]}: nothing to judge: no estimates with truth, no innovations")
    if out is not None:
        write_tables(out, summarise(replayed).tables)
    _print_outcome(replayed, as_json=as_json, written=[out] if out else [])


def source_path(estimates: Log) -> Path:
    """The log that an estimates log was replayed from; raises BadInput where it is not to be found."""
    named = estimates.run.notes.get("log") if estimates.run else None
    if named is None:
        raise BadInput(f"{estimates.path}: does not say which log it is of; give it with --log")
    path = (estimates.path.parent / named).resolve()
    if not path.exists():
        raise BadInput(f"{estimates.path}: its log {path} is not there; give it with --log")
    return path


def read_outputs(logs: Sequence[Log]) -> dict[str, Ragged]:
    """The streams of an ensemble's estimates logs."""
    sources = [LogSource(log) for log in logs]
    topics = list(logs[0].topics)
    for log in logs[1:]:
        if list(log.topics) != topics:
            raise BadInput(f"{log.path}: holds other topics than {logs[0].path}; judge it on its own")
    read = [source.read(topics) for source in sources]
    return {topic: gather([streams[topic] for streams in read]) for topic in topics}


def _judge_logs(sources: Sequence[LogSource], estimates: Sequence[Log], gap_limit_s: float) -> Replayed:
    return judge(sources, read_outputs(estimates), gap_limit_s)


def _print_outcome(replayed: Replayed, *, as_json: bool, written: Sequence[Path]) -> None:
    outcome = summarise(replayed)
    if as_json:
        print_json({"metrics": outcome.metrics, "written": [str(path) for path in written]})
        return
    if outcome.metrics:
        print_metrics(outcome.metrics)
    for path in written:
        out.print(str(path), highlight=False, soft_wrap=True)


def _show(replayed: Replayed, save: Path | None, connect: str | None) -> None:
    """Draw the first run."""
    show(replayed.sources[0], replayed.outputs, replayed.errors, save=save, connect=connect)


def view_path(
    path: Path,
    *,
    screenshot: Path | None,
    at_s: float | None,
    focus: str | None,
    save: Path | None,
    connect: str | None,
    gap_limit_s: float,
    recover: bool,
) -> None:
    """Open what a path holds in the viewer, take its picture, or send its timeline elsewhere."""
    with TemporaryDirectory(prefix="fuselog-view-") as folder:
        rrd = path / "timeline.rrd" if path.is_dir() else path
        if rrd.suffix != ".rrd":
            rrd = save or Path(folder) / "timeline.rrd"
            _draw_log(path, rrd, connect, focus, gap_limit_s, recover=recover)
        elif save is not None or connect is not None or focus is not None:
            raise BadInput(f"{rrd}: is drawn already; give --save, --connect and --focus with a log")
        if screenshot is not None:
            for complaint in viewer.screenshot(rrd, screenshot, at_s=at_s):
                err.print(f"fuselog: {complaint}", highlight=False)
        elif save is None and connect is None:
            viewer.view(rrd)


def _draw_log(
    path: Path, rrd: Path, connect: str | None, focus: str | None, gap_limit_s: float, *, recover: bool
) -> None:
    """Draw a log, or an estimates log together with the log that it is of."""
    log = open_log(path, recover=recover)
    source = LogSource(log)
    outputs = recorded_outputs(source)
    if outputs and log.run is not None and "log" in log.run.notes:
        source = _source(source_path(log), recover=recover)
    replayed = judge([source], outputs, gap_limit_s)
    show(source, outputs, replayed.errors, focus=focus, save=rrd, connect=connect)
    _state_losses([source])


def run_named(
    name: str,
    over: Mapping[str, Any],
    *,
    logs: int,
    data: Path | None,
    out: Path | None,
    as_json: bool,
    settings: Sequence[str],
) -> None:
    """Run an experiment and print its metrics and claims."""
    label, experiment = load_experiment(name, parse_settings(settings), over)
    folder = out or Path("out") / label
    result = run_experiment(label, experiment, folder, data=data, logs=logs, progress=progress)
    if as_json:
        print_json(result)
        return
    print_metrics(result["metrics"])
    if result["claims"]:
        columns = ["claim", "paper", "ours", "verdict", "why"]
        print_table("Claims", columns, [[row[key] for key in columns] for row in result["claims"]])
    _say(f"{folder}: logs, estimates, tables, figures, result.json")


def _say(text: str) -> None:
    out.print(text, highlight=False, soft_wrap=True)


def log_info(path: Path, *, recover: bool, as_json: bool) -> None:
    """Print what a log holds."""
    log = open_log(path, recover=recover)
    run = asdict(log.run) if log.run else None
    topics = [
        {
            "topic": topic.name,
            "schema": topic.schema_name,
            "messages": topic.messages,
            "metadata": dict(topic.metadata),
        }
        for topic in log.topics.values()
    ]
    if as_json:
        print_json({"path": str(path), "run": run, "topics": topics, "lost": log.loss_statement})
        return
    for key, value in (run or {}).items():
        _say(f"{key}: {value}")
    print_table(
        "",
        ["topic", "schema", "messages"],
        [[row["topic"], row["schema"], row["messages"]] for row in topics],
    )
    if log.loss_statement:
        _say(log.loss_statement)


def scenarios() -> list[dict[str, str]]:
    """Recorders, and the scenario files that ship."""
    rows = []
    for name in available("recorders"):
        recorder = load("recorders", name)
        how = "import" if isinstance(recorder, Importer) else "record"
        rows.append({"scenario": name, "how": how, "what": recorder.summary})
    for name, path in shipped("scenarios").items():
        rows.append({"scenario": name, "how": "record", "what": read_toml(path).get("title", "")})
    return rows


def estimators() -> list[dict[str, str]]:
    """Estimators with what they need and their parameters."""
    rows = []
    for name in available("estimators"):
        estimator = load("estimators", name)
        fields = estimator.parameters.model_fields.items()
        rows.append(
            {
                "estimator": name,
                "what": estimator.summary,
                "needs": estimator.needs,
                "parameters": ", ".join(f"{key}={entry.default}" for key, entry in fields),
            }
        )
    return rows


def experiments() -> list[dict[str, str]]:
    """Shipped experiments."""
    return [
        {"experiment": name, "what": read_toml(path).get("title", "")}
        for name, path in shipped("experiments").items()
    ]
