"""The command `fuselog`. Commands import what they need when they run: `--help` answers at once."""

import inspect
import io
import logging
import math
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import click

from recorders.errors import BadInput, printable

if TYPE_CHECKING:
    from pipeline.surgery import Changed


class OutputFile(click.Path):
    """A file to write: a new one, or a regular one that is replaced; never a device or a folder."""

    def __init__(self) -> None:
        super().__init__(path_type=Path, dir_okay=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path."""
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        if path.exists() and not path.is_file():
            self.fail(f"{path} is no regular file", param, ctx)
        return path


class Seconds(click.ParamType):
    """A time in seconds that fits the stamps of a log."""

    name = "seconds"

    def __init__(self, minimum: float = -1e9) -> None:
        self._minimum = minimum

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number."""
        seconds = float(click.FLOAT.convert(value, param, ctx))
        if not self._minimum <= seconds <= 1e9:
            self.fail(
                f"{seconds:g} is not between {self._minimum:.0f} and 1000000000 seconds", param, ctx
            )
        return seconds


class TimeOffset(Seconds):
    """A time in seconds, or the word that asks to find it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number or the word."""
        return value if value == "estimate" else super().convert(value, param, ctx)


FOLDER = click.Path(path_type=Path, file_okay=False)
FILE = OutputFile()
ANY_PATH = click.Path(path_type=Path)
COUNT = click.IntRange(min=0)
FORMAT = click.Choice(["tum", "kitti", "euroc"])

settings_option = click.option(
    "--settings",
    "settings_file",
    type=ANY_PATH,
    metavar="FILE",
    help="Parameters of estimators from this TOML file, as fuselog tune writes it; --set overrides it.",
)
set_option = click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a parameter (repeatable)."
)
errors_option = click.option(
    "--errors", is_flag=True, help="Keep every error of every estimate, as Parquet files."
)
workers_option = click.option(
    "--workers", type=click.IntRange(min=1), help="Share the work among N processes, each on one core."
)
scheduler_option = click.option(
    "--scheduler",
    metavar="ADDRESS|local:N",
    help="Share the work among the workers of a Dask scheduler, or of one with N on this machine.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
parameters_option = click.option(
    "--parameters", "tells_parameters", is_flag=True, help="Print all parameters, defaults included."
)
recover_option = click.option(
    "--recover", is_flag=True, help="Read the intact part of a log that was cut off or damaged."
)
out_log_option = click.option("-o", "--out", type=FILE, required=True, help="The log to write.")
gap_option = click.option(
    "--gap-limit",
    "gap_limit_s",
    type=Seconds(0),
    default=0.2,
    show_default=True,
    help="The longest gap over which truth is interpolated.",
)


arrival_option = click.option(
    "--arrival-order",
    is_flag=True,
    help="Process messages in the order in which they arrived (log time).",
)
late_option = click.option(
    "--late",
    metavar="drop|wait:SECONDS|rewind:SECONDS",
    help="With --arrival-order: process measurements in the order of their stamps all the same; drop "
    "late ones, wait SECONDS for them, or rewind by up to SECONDS to take them in.",
)


foxglove_option = click.option(
    "--foxglove",
    is_flag=True,
    help="Also write the messages that Foxglove's viewer shows.",
)


def _with_examples(text: str, *examples: str) -> str:
    """A help text that ends with commands to try, which click does not wrap."""
    return "\n".join([inspect.cleandoc(text), "", "\b", *(f"    {each}" for each in examples)])


@click.group(
    context_settings={"help_option_names": ["-h", "--help"]},
    help=_with_examples(
        "Record, replay, judge and look at estimators for sensor fusion.",
        "fuselog record landmarks --seed 7 -o run.mcap",
        "fuselog replay run.mcap -e ekf -e ukf -o est.mcap",
        "fuselog view est.mcap",
    ),
)
@click.version_option(package_name="fuselog")
def fuselog() -> None:
    """All commands."""


def _command(
    short_help: str, *examples: str, name: str | None = None
) -> Callable[[Callable[..., None]], click.Command]:
    """Add a command, whose help is its docstring, or the short one, and examples of it."""

    def added(function: Callable[..., None]) -> click.Command:
        text = _with_examples(function.__doc__ or short_help, *examples)
        return fuselog.command(name=name, short_help=short_help, help=text)(function)

    return added


@_command(
    "Simulate a scenario and write its log.",
    "fuselog record landmarks --seed 7 -o run.mcap",
    "fuselog record landmarks --set duration_s=120 -o long.mcap",
    "fuselog record --again run.mcap -o again.mcap",
)
@click.argument("scenario", required=False)
@click.option("-o", "--out", type=FILE, help="The log to write [default: SCENARIO.mcap].")
@click.option("--seed", type=COUNT, help="Seed of the random numbers [default: 0].")
@click.option("--run", type=COUNT, help="Which run of the seed [default: 0].")
@click.option("--again", type=ANY_PATH, help="Record the run of this log again, by its own metadata.")
@click.option(
    "--compression",
    type=click.Choice(["zstd", "lz4", "none"]),
    default="zstd",
    show_default=True,
    help="Of the log's chunks.",
)
@foxglove_option
@set_option
def record(
    scenario: str | None,
    out: Path | None,
    seed: int | None,
    run: int | None,
    again: Path | None,
    compression: str,
    foxglove: bool,
    settings: tuple[str, ...],
) -> None:
    """Simulate SCENARIO, a name or a TOML file, and write its log."""
    from pipeline.commands import companions_if
    from pipeline.experiment import load_scenario
    from pipeline.outputs import RECORDED, check_files
    from recorders.log import open_log, write_log
    from recorders.parameters import merge, parse_settings
    from recorders.recording import record_run

    if (scenario is None) == (again is None):
        raise BadInput("give either a scenario, one that fuselog scenarios lists, or --again LOG")
    if again is not None:
        source = open_log(again).run
        if source is None or source.seed is None:
            raise BadInput(f"{again}: the log does not say how it was simulated; name a scenario")
        name, values, label = source.scenario, source.parameters, f"{again.stem}-again"
        seed = source.seed if seed is None else seed
        run = source.run if run is None else run
    else:
        name, values, label = load_scenario(scenario or "")
    values = merge(values, parse_settings(settings))
    path = out or Path(f"{label}.mcap")
    check_files([(path, RECORDED)], {"log": [] if again is None else [again]})
    recording, metadata = record_run(name, values, seed or 0, run or 0)
    beside = companions_if(foxglove)
    write_log(path, recording.streams, metadata, compression=compression, companions=beside)
    _say_written(path, sum(map(len, recording.streams)))


@_command(
    "Import real data and write their log.",
    "fuselog import ros drive.bag -o drive.mcap",
    "fuselog import table drive.csv --guess -o mapping.toml",
    "fuselog import table drive.csv --mapping mapping.toml -o drive.mcap",
    name="import",
)
@click.argument("source")
@click.argument("paths", metavar="PATH...", nargs=-1, required=True, type=ANY_PATH)
@click.option("-o", "--out", type=FILE, help="The log to write [default: SOURCE.mcap].")
@click.option(
    "--clock",
    type=click.Choice(["header", "bag"]),
    help="For ROS: what says when a message was published, its header or the bag [default: header].",
)
@click.option(
    "--mapping",
    help="What becomes of messages or columns: a TOML file, or the name of one that ships; "
    "import table without it lists these.",
)
@click.option(
    "--guess", is_flag=True, help="For tables: write a mapping to start from to -o FILE.toml instead."
)
@set_option
def import_(
    source: str,
    paths: tuple[Path, ...],
    out: Path | None,
    clock: str | None,
    mapping: str | None,
    guess: bool,
    settings: tuple[str, ...],
) -> None:
    """Import real data of kind SOURCE from PATH, as published, and write their log.

    Tables (SOURCE table) may be several files and folders, which become one log.
    """
    from pipeline.outputs import MAPPING, check_files, imported
    from recorders.atomic import whole_file
    from recorders.parameters import parse_settings
    from recorders.recording import import_log

    if guess:
        from recorders.importers.tables.guessing import guess as guessed

        if source != "table":
            raise BadInput(f"--guess: is for tables, not for {source}; use: fuselog import table PATH")
        target = out or Path("mapping.toml")
        check_files([(target, MAPPING)], {"data": paths})
        text = guessed(paths)
        with whole_file(target) as file:
            file.write_text(text, encoding="utf-8")
        command = shlex.join(["fuselog", "import", "table", *map(str, paths), "--mapping", str(target)])
        click.echo(f"{target}: read it, then: {command}")
        return
    if len(paths) > 1 and source != "table":
        raise BadInput(f"{paths[1]}: {source} data are one file or folder; give the first alone")
    target = out or Path(f"{source}.mcap")
    check_files([(target, imported(source))], {"data": paths})
    more = [str(path) for path in paths[1:]]
    chosen = {"clock": clock, "mapping": mapping, "more": more or None}
    given = {name: value for name, value in chosen.items() if value is not None}
    metadata, messages = import_log(source, paths[0], parse_settings(settings) | given, target)
    for subject, fact in metadata.notes.items():
        click.echo(printable(f"{subject}: {fact}" if fact else subject))
    _say_written(target, messages)


def _say_written(path: Path, messages: int) -> None:
    click.echo(f"{path}: {messages} messages, {path.stat().st_size / 1e6:.1f} MB")


@_command(
    "Replay estimators over logs and write their estimates.",
    "fuselog replay run.mcap -e ekf -e ukf -o est.mcap",
    "fuselog replay run.mcap -e ekf --set sigma_range_m=0.3",
    "fuselog replay run.mcap -e ekf --arrival-order --late rewind:0.5",
)
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@click.option(
    "-e", "--estimator", "names", multiple=True, required=True, help="An estimator (repeatable)."
)
@click.option(
    "-o",
    "--out",
    type=ANY_PATH,
    help="The folder for LOG.estimates.mcap, or for one log a file .mcap [default: beside the log].",
)
@click.option("--model", help="The model to estimate, where several fit the logs.")
@click.option(
    "--every",
    "every_s",
    type=Seconds(0),
    help="Give estimates every so many seconds, not only at measurements.",
)
@arrival_option
@late_option
@click.option("--start", "start_s", type=Seconds(), help="Begin this many seconds into the run.")
@click.option(
    "--start-from",
    "origins",
    multiple=True,
    metavar="truth|ESTIMATES",
    help="What filters start with at --start: the log's truth, or the estimates log of an earlier "
    "replay (one per log).",
)
@click.option(
    "--start-sigma",
    "sigmas",
    multiple=True,
    metavar="COMPONENT=SIGMA",
    help="Standard deviation of a component for --start-from truth (repeatable) [default: the prior's].",
)
@click.option("--end", "end_s", type=Seconds(), help="End this many seconds into the run.")
@click.option("--save", type=FILE, help="Also write the timeline of the first log to this .rrd.")
@click.option("--connect", metavar="URL", help="Also stream the timeline to this Rerun viewer.")
@foxglove_option
@recover_option
@gap_option
@parameters_option
@json_option
@settings_option
@set_option
def replay(logs: tuple[Path, ...], names: tuple[str, ...], **options: Any) -> None:
    """Replay estimators over LOGS, the runs of one ensemble, and write their estimates.

    --set gate_probability=1 sets a parameter of all estimators that have it, --set
    ekf.gate_probability=1 of one.
    """
    from pipeline.commands import replay_logs

    replay_logs(list(logs), list(names), **options)


@_command(
    "Search the parameters of an estimator that explain logs best.",
    "fuselog tune run.mcap -e ekf --free sigma_range_m --free sigma_bearing_rad",
)
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@click.option("-e", "--estimator", "label", required=True, help="The estimator.")
@click.option("--free", multiple=True, required=True, help="A parameter to search for (repeatable).")
@click.option(
    "--by",
    type=click.Choice(["likelihood", "nis", "nees", "rmse"]),
    default="likelihood",
    show_default=True,
    help="What to optimise: the likelihood, NIS or NEES (nearest to their expectation), or RMSE.",
)
@click.option(
    "--bound",
    "bounds",
    multiple=True,
    metavar="NAME=LOW:HIGH",
    help="The bounds of a parameter (repeatable) [default: 1e-4 to 1e4 times its start].",
)
@click.option(
    "--grid",
    type=click.IntRange(min=1),
    default=1,
    help="Start the search from the best of N values of each parameter between its bounds.",
)
@click.option(
    "--validate",
    "held_out",
    multiple=True,
    type=ANY_PATH,
    help="A log that is held out, to judge the values by (repeatable).",
)
@click.option(
    "--folds",
    type=COUNT,
    default=0,
    help="Cross-validate: cut the logs into N parts, and judge by each what the others gave.",
)
@click.option(
    "--out", type=FOLDER, default=Path("out/tune"), show_default=True, help="The result folder."
)
@click.option("--model", help="The model to estimate, where several fit the logs.")
@workers_option
@scheduler_option
@recover_option
@gap_option
@json_option
@settings_option
@set_option
def tune(logs: tuple[Path, ...], **options: Any) -> None:
    """Search the parameters of an estimator that explain LOGS best, with their 95 % intervals.

    The search starts from --set NAME=VALUE, else from what the log's channels state. It needs no truth,
    but for --by nees and rmse. Ctrl-C ends it with the best values so far. settings.toml in the result
    folder is for --settings of fuselog replay and run.
    """
    from pipeline.tuning.command import tune_logs

    tune_logs(list(logs), **options)


@_command(
    "Say why an estimator is inconsistent.",
    "fuselog diagnose run.mcap -e ekf",
)
@click.argument("log", type=ANY_PATH)
@click.option("-e", "--estimator", "label", help="The estimator; by default the only one of estimates.")
@click.option("--out", type=FOLDER, help="A result folder to write, for fuselog report.")
@click.option("--save", type=FILE, help="A timeline (.rrd) to write, with the sentences as events.")
@click.option("--model", help="The model to estimate, where several fit the log.")
@recover_option
@gap_option
@json_option
@settings_option
@set_option
def diagnose(log: Path, **options: Any) -> None:
    """Say what is likely wrong with LOG or the settings of an estimator, and what to try.

    LOG is a log, or an estimates log beside the log that it is of. At most five sentences, the likeliest
    cause first: that without which the log-likelihood gains most.
    """
    from pipeline.diagnosing.command import diagnose_log

    diagnose_log(log, **options)


@_command(
    "Say how well the measurements of logs determine a model's state.",
    "fuselog observability run.mcap --window 10",
)
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@click.option("--model", help="The model, where several fit the logs.")
@click.option(
    "--window",
    "window_s",
    type=Seconds(),
    help="The length of a window; one follows another [default: the whole run].",
)
@click.option(
    "--scale",
    "scales",
    multiple=True,
    metavar="COMPONENT=SIGMA",
    help="The standard deviation that counts as one, instead of the prior's (repeatable).",
)
@click.option("--end", "end_s", type=Seconds(), help="End this many seconds into the run.")
@recover_option
@json_option
@set_option
def observability(logs: tuple[Path, ...], **options: Any) -> None:
    """Say how well the measurements of LOGS determine the state, and which direction least.

    For every run and window: the rank and the eigenvalues of the local Gramian along the smoothed
    trajectory, in units of the prior's information.
    """
    from pipeline.observing import show_observability

    show_observability(list(logs), **options)


@_command(
    "Judge estimates against the truth.",
    "fuselog evaluate est.mcap",
    "fuselog evaluate est.txt --truth gt.txt --align se3",
)
@click.argument("estimates", nargs=-1, required=True, type=ANY_PATH)
@click.option("--log", "logs", multiple=True, type=ANY_PATH, help="The log with the truth, per run.")
@click.option("--truth", type=ANY_PATH, help="The true trajectory, where ESTIMATES is one as a file.")
@click.option(
    "--format", type=FORMAT, help="The format of trajectory files [default: found from their content]."
)
@click.option(
    "--truth-format", type=FORMAT, help="The format of the true one [default: found from its content]."
)
@click.option(
    "--align",
    type=click.Choice(["none", "yaw", "se2", "se3", "sim3"]),
    help="Bring estimates nearest to the truth first: yaw turns about the vertical and shifts, se2 too "
    "but for the height, se3 turns and shifts, sim3 scales as well [default: none].",
)
@click.option("--delta", type=float, help="What way relative pose errors are over [default: 1].")
@click.option(
    "--delta-unit", type=click.Choice(["m", "frames", "s"]), help="Its unit [default: frames]."
)
@click.option(
    "--association",
    type=click.Choice(["nearest", "interpolated"]),
    help="Which true pose belongs to an estimated one: the nearest in time, or one between two "
    "[default: nearest for files, interpolated for logs].",
)
@click.option(
    "--max-difference",
    "max_difference_s",
    type=Seconds(0),
    help="Seconds up to which the nearest belong together [default: 0.01].",
)
@click.option(
    "--time-offset",
    "time_offset_s",
    type=TimeOffset(),
    metavar="SECONDS|estimate",
    help="Add this to the stamps of the estimated trajectory, or find it [default: 0].",
)
@click.option("--metric", "metrics", multiple=True, help="A metric (repeatable) [default: all].")
@click.option("--out", type=FOLDER, help="Write a result folder, as fuselog run does.")
@errors_option
@recover_option
@gap_option
@json_option
def evaluate(
    estimates: tuple[Path, ...],
    logs: tuple[Path, ...],
    truth: Path | None,
    format: str | None,  # noqa: A002
    truth_format: str | None,
    align: str | None,
    delta: float | None,
    delta_unit: str | None,
    association: str | None,
    max_difference_s: float | None,
    time_offset_s: float | str | None,
    **options: Any,
) -> None:
    """Judge ESTIMATES logs against the truth of the logs they were replayed from.

    With --truth, ESTIMATES is a trajectory file (TUM, KITTI or EuRoC) that is judged against another:
    absolute and relative pose errors, APE and RPE, as evo has them. With --align or --delta, so are
    estimated positions of logs; all other metrics are then of the aligned estimates.
    """
    from pipeline.commands import evaluate_logs, evaluate_trajectory

    given = {
        "align": align,
        "delta": delta,
        "delta_unit": delta_unit,
        "association": association,
        "max_difference_s": max_difference_s,
        "time_offset_s": time_offset_s,
    }
    comparison = {name: value for name, value in given.items() if value is not None}
    formats = {"format": format, "truth_format": truth_format}
    if truth is not None:
        evaluate_trajectory(list(estimates), truth, formats, comparison, logs=logs, **options)
        return
    if any(formats.values()):
        raise BadInput(
            "--format and --truth-format: are for trajectory files; give the true one, --truth"
        )
    evaluate_logs(list(estimates), list(logs), comparison=comparison, **options)


@_command(
    "Write a log's streams as TUM, KITTI, MOT, CSV, Parquet or Foxglove files.",
    "fuselog export est.mcap --to tum",
    "fuselog export run.mcap --to csv --topic /robot1/odometry -o odometry.csv",
)
@click.argument("path", type=ANY_PATH)
@click.option(
    "--to",
    type=click.Choice(["tum", "kitti", "mot", "csv", "parquet", "foxglove"]),
    required=True,
    help="The format.",
)
@click.option(
    "-o",
    "--out",
    type=ANY_PATH,
    help="The folder to write, or with one --topic the file [default: named after PATH].",
)
@click.option("--topic", "topics", multiple=True, help="A topic (repeatable) [default: all that fit].")
@recover_option
def export(path: Path, to: Any, **options: Any) -> None:
    """Write streams of PATH, a log or an estimates log, for other tools.

    To tum and kitti go the estimates and truths that state a position, as trajectories; to mot tracks
    and truths frame by frame, as TrackEval reads them; to csv and parquet any stream, as a table; to
    foxglove one log of the messages that Foxglove and Rerun show.
    """
    from pipeline.exporting import export as export_log

    done = export_log(path, to=to, **options)
    for note in done.notes:
        click.echo(printable(f"fuselog: {note}"), err=True)
    for topic, file in done.files.items():
        click.echo(printable(f"{file}: {topic}"))


@_command(
    "Write a span, some topics or fewer messages of a log.",
    "fuselog cut run.mcap --start 10 --end 20 -o part.mcap",
    "fuselog cut run.mcap --decimate '/robot1/odometry=5Hz' -o slow.mcap",
)
@click.argument("path", type=ANY_PATH)
@out_log_option
@click.option("--start", "start_s", type=Seconds(), help="Begin this many seconds into the run.")
@click.option("--end", "end_s", type=Seconds(), help="End this many seconds into the run.")
@click.option(
    "--topics",
    multiple=True,
    metavar="TOPIC",
    help="A topic, or a pattern such as '/robot1/*' (repeatable) [default: all].",
)
@click.option(
    "--decimate",
    multiple=True,
    metavar="TOPIC=N|TOPIC=RATEHz",
    help="Keep every Nth stamp of a topic or pattern, or at most so many a second (repeatable).",
)
@recover_option
def cut(path: Path, decimate: tuple[str, ...], **options: Any) -> None:
    """Write a part of PATH, a log or an estimates log, as a log of its own.

    Maps, priors and what was said at the first stamp of the log stay whole, whatever the span.
    """
    from pipeline.surgery import cut as cut_log

    _say_changed(cut_log(path, decimate=_pairs("--decimate", decimate), **options))


@_command(
    "Write one log of several, whose clocks may differ.",
    "fuselog merge a.mcap b.mcap --offset b.mcap=-0.5 -o both.mcap",
)
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@out_log_option
@click.option(
    "--offset",
    "offsets",
    multiple=True,
    metavar="LOG=SECONDS",
    help="Add this to all stamps of one of LOGS (repeatable) [default: 0].",
)
@recover_option
def merge(logs: tuple[Path, ...], offsets: tuple[str, ...], **options: Any) -> None:
    """Write one log of LOGS, which have no topic in common: fuselog relabel renames topics."""
    from pipeline.surgery import merge as merge_logs

    offsets_s = {}
    for log, text in _pairs("--offset", offsets).items():
        try:
            offsets_s[log] = float(text)
        except ValueError:
            raise BadInput(f"--offset {log}={text}: expected LOG=SECONDS, as {log}=-0.5") from None
    _say_changed(merge_logs(list(logs), offsets_s=offsets_s, **options))


@_command(
    "Write a log with what its inertial unit says of standing and rolling.",
    "fuselog constrain run.mcap -o constrained.mcap --set rolling_hz=10",
)
@click.argument("path", type=ANY_PATH)
@out_log_option
@click.option("--unit", metavar="TOPIC", help="The inertial samples [default: the only unit].")
@set_option
@recover_option
def constrain(path: Path, settings: tuple[str, ...], **options: Any) -> None:
    """Write PATH with topics that say when its body stands and, with --set rolling_hz=10, that it rolls.

    The model inertial takes them as it takes sensors: a body that stands has no velocity, and one that
    rolls on wheels moves neither to the side nor up.
    """
    from pipeline.surgery import constrain as constrain_log
    from recorders.parameters import parse_settings

    _say_changed(constrain_log(path, settings=parse_settings(settings), **options))


@_command(
    "Write a log with other names of topics and components.",
    "fuselog relabel run.mcap --topic /robot1/=/left/ -o left.mcap",
)
@click.argument("path", type=ANY_PATH)
@out_log_option
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="OLD=NEW",
    help="Rename a topic, or as /robot1/=/robot2/ all that begin so (repeatable).",
)
@click.option(
    "--component",
    "components",
    multiple=True,
    metavar="OLD=NEW",
    help="Rename a component of states, as x_m=east_m, in all topics (repeatable).",
)
@recover_option
def relabel(path: Path, topics: tuple[str, ...], components: tuple[str, ...], **options: Any) -> None:
    """Write PATH, a log or an estimates log, with other names; what refers to them follows."""
    from pipeline.surgery import relabel as relabel_log

    done = relabel_log(
        path, topics=_pairs("--topic", topics), components=_pairs("--component", components), **options
    )
    _say_changed(done)


def _pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    """What an option gives as NAME=VALUE, each name once."""
    pairs: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.rpartition("=")
        if not (name and equals and value) or name in pairs:
            raise BadInput(f"{option} {text}: expected NAME=VALUE, with every name once")
        pairs[name] = value
    return pairs


def _say_changed(done: "Changed") -> None:
    for note in done.notes:
        click.echo(printable(f"fuselog: {note}"), err=True)
    _say_written(done.path, sum(done.messages.values()))


@_command(
    "Open a log, estimates or a result in the Rerun viewer.",
    "fuselog view est.mcap",
    "fuselog view run.mcap --start 10 --end 20",
    "fuselog view out/landmarks --screenshot picture.png --at 30",
)
@click.argument("path", type=ANY_PATH)
@click.option("--screenshot", type=FILE, help="Take the viewer's picture, headless, as PNG.")
@click.option("--at", "at_s", type=Seconds(), help="Put the time cursor this many seconds into the run.")
@click.option("--start", "start_s", type=Seconds(), help="Draw from this many seconds into the run on.")
@click.option("--end", "end_s", type=Seconds(), help="Draw up to this many seconds into the run.")
@click.option("--save", type=FILE, help="Write the timeline to this .rrd instead of opening it.")
@click.option("--connect", metavar="URL", help="Stream the timeline to this Rerun viewer.")
@click.option("--focus", help="What to show first, such as robot3.")
@recover_option
@gap_option
def view(path: Path, **options: Any) -> None:
    """Open PATH (a log, an estimates log, a result folder or an .rrd) in the Rerun viewer."""
    from pipeline.commands import view_path

    view_path(path, **options)


@_command(
    "Run an experiment: record, replay, evaluate, draw.",
    "fuselog run landmarks --runs 1000 --workers 4",
    "fuselog run landmarks --set ekf.gate_probability=0.999 --set duration_s=30",
    "fuselog run a.mcap b.mcap -e ekf -e ukf --out out/mine",
)
@click.argument("experiment", nargs=-1, required=True)
@click.option("-e", "--estimator", "labels", multiple=True, help="For logs: an estimator (repeatable).")
@click.option("--runs", type=int, help="Number of Monte Carlo runs.")
@click.option("--seed", type=int, help="Seed of the random numbers.")
@click.option(
    "--logs", type=COUNT, default=20, show_default=True, help="Write the logs of the first K runs."
)
@arrival_option
@late_option
@errors_option
@click.option("--data", type=ANY_PATH, help="Where the real data are, for experiments that import.")
@click.option("--out", type=FOLDER, help="The result folder [default: out/EXPERIMENT].")
@workers_option
@scheduler_option
@parameters_option
@json_option
@settings_option
@set_option
def run(
    experiment: tuple[str, ...],
    labels: tuple[str, ...],
    runs: int | None,
    seed: int | None,
    arrival_order: bool,
    late: str | None,
    **options: Any,
) -> None:
    """Run EXPERIMENT, a shipped name or a TOML file: record or import, replay, evaluate, draw.

    Or replay logs of your own as an experiment, LOG.mcap ... with -e for each estimator.

    --set ekf.gate_probability=1 sets a parameter of an estimator, --set duration_s=30 of the scenario,
    --set gap_limit_s=1 an entry of the experiment.
    """
    from pipeline.commands import run_named

    stated = {"runs": runs, "seed": seed, "arrival_order": arrival_order or None, "late": late}
    over = {key: value for key, value in stated.items() if value is not None}
    run_named(experiment, labels, over, **options)


@_command(
    "Run an experiment at many points of its parameters.",
    "fuselog sweep landmarks --over ekf.sigma_range_m=0.05:0.8:log9 --runs 50",
    "fuselog sweep landmarks --over robots=1,2 --over duration_s=10:60:6",
)
@click.argument("experiment", nargs=-1, required=True)
@click.option("-e", "--estimator", "labels", multiple=True, help="For logs: an estimator (repeatable).")
@click.option(
    "--over",
    "swept",
    multiple=True,
    required=True,
    metavar="KEY=LOW:HIGH:N|logN or KEY=A,B,...",
    help="A parameter and its values, evenly between two ends, or evenly in the logarithm (repeatable).",
)
@click.option(
    "--samples",
    type=click.IntRange(min=1),
    help="Draw N points from the ranges instead of taking the whole grid.",
)
@click.option("--sampling", type=click.Choice(["sobol", "random"]), default="sobol", show_default=True)
@click.option("--runs", type=int, help="Number of Monte Carlo runs at each point.")
@click.option("--seed", type=int, help="Seed of the random numbers.")
@click.option("--out", type=FOLDER, help="The result folder [default: out/EXPERIMENT-sweep].")
@workers_option
@scheduler_option
@json_option
@settings_option
@set_option
def sweep(
    experiment: tuple[str, ...],
    labels: tuple[str, ...],
    runs: int | None,
    seed: int | None,
    **options: Any,
) -> None:
    """Run EXPERIMENT, or replay logs, at all points of a grid of parameters, or at samples of it.

    A table has every metric at every point, and within what nine in ten runs lie; figures show them as
    curves, or as heat maps over two parameters. A key is as --set has it.
    """
    from pipeline.commands import sweep_named

    over = {key: value for key, value in {"runs": runs, "seed": seed}.items() if value is not None}
    sweep_named(experiment, labels, over, **options)


@_command(
    "Compare estimators over the same runs, with a verdict on every metric.",
    "fuselog compare out/before out/after",
    "fuselog compare a.mcap b.mcap -e ekf -e ukf",
)
@click.argument("sides", nargs=-1, required=True, type=ANY_PATH)
@click.option("-e", "--estimator", "labels", multiple=True, help="Which estimators (repeatable).")
@click.option("--truth", type=ANY_PATH, help="The true trajectory, where SIDES are trajectory files.")
@click.option("--case", help="What trajectory files are of, such as robot2, where a log has several.")
@click.option(
    "--margin",
    type=click.FloatRange(min=0),
    default=0.02,
    show_default=True,
    help="The relative difference of a metric that does not matter.",
)
@click.option("--out", type=FOLDER, help="Write a result folder: tables, figures, the timeline.")
@click.option("--save", type=FILE, help="Write the timeline, side by side, to this .rrd file.")
@recover_option
@gap_option
@json_option
@settings_option
@set_option
def compare(sides: tuple[Path, ...], labels: tuple[str, ...], **options: Any) -> None:
    """Compare SIDES: result folders, estimates logs or folders of them, trajectory files.

    Or estimators over logs, LOG.mcap ... with -e for each estimator. All others are compared with the
    first, metric by metric over the runs that both have, with intervals of 95 % by the bootstrap over
    runs.
    """
    from pipeline.comparing.command import compare_sides

    compare_sides(list(sides), list(labels), **options)


@_command(
    "Check that estimators still give what a golden has.",
    "fuselog check run.mcap --against ekf.golden.xz --update -e ekf",
    "fuselog check run.mcap --against ekf.golden.xz",
)
@click.argument("path", type=ANY_PATH)
@click.option("--against", "golden", type=FILE, required=True, help="The golden, a .golden.xz file.")
@click.option("--update", "is_update", is_flag=True, help="Write the golden instead of checking.")
@click.option("-e", "--estimator", "labels", multiple=True, help="With --update: of what (repeatable).")
@arrival_option
@late_option
@click.option(
    "--keep",
    "columns",
    multiple=True,
    metavar="PATTERN",
    help="With --update: keep these of all 'TOPIC COLUMN' (repeatable) [default: all].",
)
@click.option(
    "--tolerance",
    "tolerances",
    multiple=True,
    metavar="PATTERN=RELATIVE",
    help="With --update: how far apart, relative to its size, such a 'TOPIC COLUMN' may be (repeatable) "
    "[default: 1e-12, 1e-6 on another CPU].",
)
@click.option("--junit", type=FILE, help="Write the results for continuous integration, as JUnit's XML.")
@json_option
@settings_option
@set_option
def check(path: Path, golden: Path, **options: Any) -> None:
    """Replay PATH, a log, a folder of logs or a result, and compare with a golden field by field.

    It exits with 1 where something is different, and prints the first difference with its stamp. An
    intended change updates the golden in the same commit.
    """
    from pipeline.checking.command import check_path

    if not check_path(path, golden, **options):
        click.get_current_context().exit(1)


@_command(
    "Render results as one self-contained HTML page.",
    "fuselog report out/landmarks -o report.html",
)
@click.argument("results", nargs=-1, required=True, type=ANY_PATH)
@click.option("-o", "--out", type=FILE, default=Path("report.html"), show_default=True)
@click.option("--viewer", is_flag=True, help="Show the first runs in the viewer; takes 15 s each.")
def report(results: tuple[Path, ...], out: Path, viewer: bool) -> None:
    """Render RESULTS, folders that `fuselog run` wrote, as one self-contained HTML page."""
    from pipeline.outputs import REPORT, check_files
    from pipeline.report import write_report

    check_files([(out, REPORT)], {"result": [path for each in results for path in each.rglob("*")]})
    write_report(list(results), out, viewer=viewer)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


@_command(
    "Say what a log holds.",
    "fuselog info run.mcap",
)
@click.argument("log", type=ANY_PATH)
@recover_option
@json_option
def info(log: Path, recover: bool, as_json: bool) -> None:
    """Say what LOG holds: the run, its topics, schemas, message counts."""
    from pipeline.information import show_log

    show_log(log, recover=recover, as_json=as_json)


def _list_command(kind: str, text: str, example: str) -> None:
    @_command(text, f"fuselog {kind}s", f"fuselog {kind}s {example}", name=f"{kind}s")
    @click.argument("name", required=False)
    @json_option
    def listing(name: str | None, as_json: bool) -> None:
        from pipeline import catalog

        catalog.show(getattr(catalog, f"{kind}s")(), kind, name, as_json=as_json)


_list_command("scenario", "List what can be recorded and imported, or all about NAME.", "landmarks")
_list_command("estimator", "List the estimators, or all about NAME.", "ekf")
_list_command("metric", "List the metrics, or all about NAME.", "consistency")
_list_command("experiment", "List the shipped experiments, or all about NAME.", "landmarks")


@_command(
    "List the models, and the methods that estimate each, or all about NAME.",
    "fuselog models",
    "fuselog models robot",
)
@click.argument("name", required=False)
@json_option
def models(name: str | None, as_json: bool) -> None:
    """List the models and whether each method can estimate them or why not, or all about NAME."""
    from pipeline.catalog import show_models

    show_models(name, as_json=as_json)


@_command(
    "Say what the cache of kernels and samples holds, or clear it.",
    "fuselog cache --clear",
)
@click.option("--clear", is_flag=True, help="Remove what fuselog wrote there, and nothing else.")
@json_option
def cache(clear: bool, as_json: bool) -> None:
    """Say how large the cache is: compiled kernels and samples, which fuselog can make again."""
    from pipeline.information import show_cache

    show_cache(clear=clear, as_json=as_json)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: a user's mistake is one sentence and 2.

    FUSELOG_TRACEBACK=1 shows where an error comes from, for who writes an estimator.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a file's name may be beyond the encoding
    logging.basicConfig(format="fuselog: %(message)s")
    if sys.stderr.isatty():  # somebody waits
        logging.getLogger("fuselog").setLevel(logging.INFO)
    try:
        with _stopped_by_signals():
            code = fuselog(arguments, prog_name="fuselog", standalone_mode=False)
            print(end="", flush=True)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return 2
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f" (see {context.command_path} --help)" if context else ""
        return _fail(error.format_message().rstrip(".") + hint)
    except (click.Abort, KeyboardInterrupt) as error:
        click.echo("fuselog: stopped", err=True)
        cause = error.__cause__ or error  # click wraps it
        return 128 + (cause.number if isinstance(cause, Stopped) else signal.SIGINT)
    except BrokenPipeError:
        _drop_output()
        return 1
    except (BadInput, OSError, MemoryError) as error:
        if os.environ.get("FUSELOG_TRACEBACK"):
            raise
        place = "" if _drop_output() else "standard output"
        return _fail(_sentence(error, place or f"fuselog {shlex.join(arguments or sys.argv[1:])}"))
    return code or 0


class Stopped(KeyboardInterrupt):
    """A signal asked the process to end: what holds for Ctrl-C holds for it."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextmanager
def _stopped_by_signals() -> Iterator[None]:
    """Have signals that end the process unwind it, so that what was begun is cleared away."""
    last_s = -math.inf

    def stop(number: int, _: FrameType | None) -> None:
        nonlocal last_s
        before_s, last_s = last_s, time.monotonic()
        if last_s - before_s > 1.0:  # `timeout` sends it twice: to the process and to its group
            raise Stopped(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked = [
        getattr(signal, name)
        for name in ("SIGTERM", "SIGHUP")
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is signal.SIG_DFL
    ]
    for number in asked:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in asked:
            signal.signal(number, signal.SIG_DFL)


def _sentence(error: Exception, place: str) -> str:
    """What went wrong, and where: `place` is for errors that do not say so themselves."""
    if isinstance(error, OSError):
        place = os.fsdecode(error.filename) if error.filename else place
        return f"{place}: {error.strerror or error}"
    if isinstance(error, MemoryError):
        why = f" ({error})" if str(error) else ""
        return f"not enough memory; ask for fewer runs or less time{why}"
    return str(error)


def _fail(sentence: str) -> int:
    line = printable(sentence.strip().replace("\n", " "))
    click.echo(f"fuselog: {line}", err=True)
    return 2


def _drop_output() -> bool:
    """Whether standard output takes more; where not, the interpreter must not try again at its end."""
    try:
        print(end="", flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True
