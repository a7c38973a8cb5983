"""The commands that describe, check, view, export, cut, merge or rename logs."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fuselog.pipeline.command_line.help import command
from fuselog.pipeline.command_line.options import (
    ANY_PATH,
    CATALOG,
    LOG_OR_FOLDER,
    PICTURE,
    RESULT,
    TIMELINE_OR_FOLDER,
    Instant,
    Seconds,
    gap_option,
    json_option,
    out_log_option,
    recover_option,
    scheduler_option,
    selecting,
    selection_options,
    set_option,
    where_option,
    workers_option,
)
from fuselog.pipeline.command_line.recording import say_written
from fuselog.recorders.errors import BadInput, printable

if TYPE_CHECKING:
    from fuselog.pipeline.logs.rewriting import Changed


@command(
    "Show what a log contains.",
    "fuselog info run.mcap",
)
@click.argument("log", type=ANY_PATH)
@click.option("--all", "is_all", is_flag=True, help="Also list what the log lacks for each model.")
@recover_option
@json_option
def info(log: Path, is_all: bool, recover: bool, as_json: bool) -> None:
    """Show what LOG contains: the run, its topics, schemas, message counts, and the models that fit it.

    LOG may be a log, an estimates log, a ROS bag, a result folder, a catalog or a timeline (.rrd). If it
    is the URL of a log, only its summary is fetched.
    """
    if selecting([log], {}):
        from fuselog.pipeline.logs.cataloguing import show_catalog

        show_catalog([log], as_json=as_json)
        return
    from fuselog.pipeline.logs.information import show_log

    show_log(log, is_all=is_all, recover=recover, as_json=as_json)


@command(
    "List the logs in folders, with what each contains.",
    "fuselog catalog drives -o logs.parquet",
    "fuselog catalog logs.parquet --where 'fix_rate_hz > 4 and duration_s > 60'",
)
@click.argument("folders", nargs=-1, required=True, type=ANY_PATH)
@click.option("-o", "--out", type=CATALOG, help="The catalog to write or to update (.parquet).")
@click.option(
    "--deep",
    is_flag=True,
    help="Also read the messages: gaps, findings of lint, a hash of the file.",
)
@where_option
@workers_option
@scheduler_option
@json_option
def catalog(folders: tuple[Path, ...], **options: Any) -> None:
    """List the logs in FOLDERS and in the folders in them, or the logs of one catalog.

    A catalog has a row for each log: its topics, rates, span, run and the models that fit, read from its
    summary. An existing catalog is updated: only new and changed logs are read. A log that cannot be
    read has a row with the reason.
    """
    from fuselog.pipeline.logs.cataloguing import show_catalog

    show_catalog(folders, **options)


@command(
    "Estimate the noise of sensors at rest, with intervals.",
    "fuselog noise rest.mcap",
    "fuselog noise rest.mcap --topic /imu --out noise",
)
@click.argument("log", type=ANY_PATH)
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="TOPIC|TOPIC.FIELD",
    help="A topic, or one of its fields (repeatable) [default: all inertial units].",
)
@click.option(
    "--sheet",
    multiple=True,
    metavar="FIELD=VALUE UNIT",
    help="A data sheet's value to compare with (repeatable); append 'one-sided' to a one-sided density.",
)
@click.option(
    "--tau",
    "taus",
    multiple=True,
    type=click.FloatRange(min=0, min_open=True),
    help="Also print the Allan deviation at this averaging time in s (repeatable).",
)
@click.option(
    "--out",
    type=RESULT,
    help="A result folder to write: curves, tables, and the numbers for fuselog, Kalibr, PX4, GTSAM and "
    "robot_localization.",
)
@recover_option
@json_option
def noise(log: Path, topics: tuple[str, ...], sheet: tuple[str, ...], **options: Any) -> None:
    """Estimate sensor noise from LOG, recorded while stationary: white noise, random walk and more.

    Parameters are estimated by maximum likelihood, with intervals. The Allan deviation is computed as
    well, and fuselog reports where it departs from the model. If LOG is the output of imu_utils or
    allan_variance_ros, fuselog explains what its numbers mean.
    """
    from fuselog.pipeline.sensing.command import show_noise

    show_noise(log, list(topics), _pairs("--sheet", sheet), **options)


@command(
    "Calibrate a magnetometer or accelerometer by rotating it.",
    "fuselog ellipsoid turned.mcap --field /imu.magnetic_field_ut --length 48.5",
    "fuselog ellipsoid positions.mcap --field /imu.specific_force_mps2",
)
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@click.option("--field", required=True, metavar="TOPIC.FIELD", help="The vector to calibrate.")
@click.option(
    "--length",
    type=click.FloatRange(min=0, min_open=True),
    help="The length of the vector, in the field's unit [default: gravity's, or the mean of the "
    "readings].",
)
@click.option(
    "--out", type=RESULT, help="A result folder to write: a table, and a figure of the lengths."
)
@recover_option
@json_option
def ellipsoid(logs: tuple[Path, ...], field: str, **options: Any) -> None:
    """Estimate offsets, scales and cross terms of a sensor that was recorded in many orientations.

    The Earth's magnetic field and gravity have constant magnitudes, so raw readings lie on an ellipsoid.
    Hold an accelerometer still in each position. Terms that the rotations do not determine are named and
    get no value.
    """
    from fuselog.pipeline.calibrating.command import show_ellipsoid

    show_ellipsoid(list(logs), field, **options)


@command(
    "Find wrong units, signs, stamps and frames in a log.",
    "fuselog lint run.mcap",
    "fuselog lint run.mcap --set /imu.turn_rate_scale=0.01745",
    "fuselog lint drives --workers 4",
)
@click.argument("logs", metavar="LOG", nargs=-1, required=True, type=ANY_PATH)
@click.option("--out", type=RESULT, help="For several logs: the result folder [default: out/lint].")
@selection_options
@recover_option
@json_option
@set_option("lint")
def lint(logs: tuple[Path, ...], out: Path | None, **options: Any) -> None:
    """Find errors in LOG before any filter runs: units, stamps, frames, covariances, values, names.

    Each finding has a confidence, its evidence and a fix, which you can try with --set. The exit code is
    1 if there is a finding that is more than a hint. With several logs, a folder or a catalog, a result
    folder has a row for each log.
    """
    if selection := selecting(logs, options, always=len(logs) > 1 or logs[0].is_dir()):
        from fuselog.pipeline.command_line.selections import lint_selection

        is_good = lint_selection(selection, out=out, **options)
    else:
        from fuselog.pipeline.api.linting import show_lint

        if out is not None:
            raise BadInput(f"--out {out}: applies to several logs; leave it out")
        is_good = show_lint(logs[0], **options)
    if not is_good:
        click.get_current_context().exit(1)


@command(
    "Open a log, estimates or a result in the Rerun viewer.",
    "fuselog view est.mcap",
    "fuselog view run.mcap --start 10 --end 20",
    "fuselog view est.mcap --at worst:ekf",
    "fuselog view out/landmarks --runs worst:50",
    "fuselog view out/landmarks --runs 731 --screenshot picture.png --at 30",
)
@click.argument("paths", nargs=-1, required=True, type=ANY_PATH)
@click.option(
    "--runs",
    metavar="worst:N|all|RUN,...",
    help="The runs to draw; the table lists all of them [default: worst:20].",
)
@click.option(
    "--port",
    type=click.IntRange(1, 65535),
    help="Port of the dataset's server [default: any free port].",
)
@click.option(
    "--screenshot", type=PICTURE, help="Save a screenshot of the viewer as PNG, without a window."
)
@click.option(
    "--at",
    type=Instant(),
    metavar="SECONDS|worst[:ESTIMATOR]",
    help="Set the time cursor to this many seconds into the run, or to the largest NEES (without NEES, "
    "the largest error) of all estimators or of one.",
)
@click.option("--start", "start_s", type=Seconds(), help="Draw from this many seconds into the run.")
@click.option("--end", "end_s", type=Seconds(), help="Draw up to this many seconds into the run.")
@click.option(
    "--save",
    type=TIMELINE_OR_FOLDER,
    help="Write the timeline to this .rrd, or the dataset of several runs to this folder, instead of "
    "opening it.",
)
@click.option("--connect", metavar="URL", help="Stream the timeline to this Rerun viewer.")
@click.option(
    "--web", is_flag=True, help="Serve the timeline to a browser on this machine until Ctrl-C."
)
@click.option("--focus", help="Entity to show first, for example robot3.")
@where_option
@recover_option
@gap_option
def view(paths: tuple[Path, ...], where: str | None, **options: Any) -> None:
    """Open PATHS in the Rerun viewer: a log, an estimates log, a result, an .rrd, or a folder of logs.

    Results with several runs and folders of logs open as a sortable table of runs, the worst first.
    Several results of the same runs, or several estimates logs of one log, are drawn in one scene.
    """
    from fuselog.pipeline.presenting.command import view_path
    from fuselog.pipeline.presenting.options import Options

    if selecting(paths, {"where": where}):
        from fuselog.pipeline.logs.cataloguing import select_together

        paths = tuple(select_together(paths, where).logs)
    kept = [path / "estimates" for path in paths if (path / "tables" / "logs.parquet").is_file()]
    view_path(kept if len(kept) == len(paths) else paths, Options(**options))
    _say_next_of_view(paths[0], recover=options["recover"])


def _say_next_of_view(path: Path, *, recover: bool) -> None:
    """Suggest the next command after a result, a log or an estimates log was viewed."""
    from fuselog.pipeline.output import RESULT_FILE
    from fuselog.pipeline.output.terminal import say_next
    from fuselog.pipeline.runs.inputs import shipped
    from fuselog.recorders.log import open_log

    if path.is_dir():
        if (path / RESULT_FILE).is_file():
            say_next("report", str(path))
    elif path.suffix != ".rrd":
        log = open_log(path, recover=recover)
        if not any(topic.startswith("/estimates/") for topic in log.topics):
            say_next("info", str(path))
        elif log.run and log.run.scenario in shipped("experiments"):
            say_next("run", log.run.scenario, "--runs", "20")
        else:
            say_next("evaluate", str(path))


@command(
    "Export streams as TUM, KITTI, ROS 2, MOT, CSV, Parquet or Foxglove.",
    "fuselog export est.mcap --to tum",
    "fuselog export est.mcap --to ros2 -o bag",
    "fuselog export run.mcap --to csv --topic /robot1/odometry -o odometry.csv",
)
@click.argument("path", type=ANY_PATH)
@click.option(
    "--to",
    type=click.Choice(["tum", "kitti", "ros2", "ros2-sqlite3", "mot", "csv", "parquet", "foxglove"]),
    required=True,
    help="The format.",
)
@click.option(
    "-o",
    "--out",
    type=LOG_OR_FOLDER,
    help="The folder to write, or with one --topic the file [default: named after PATH].",
)
@click.option("--topic", "topics", multiple=True, help="A topic (repeatable) [default: all that fit].")
@recover_option
def export(path: Path, to: Any, **options: Any) -> None:
    """Write streams of PATH, a log or an estimates log, for other tools.

    tum and kitti write trajectories: poses, and estimates and truths with a position. ros2 writes
    trajectories and geodetic fixes as messages and TF to an MCAP bag, and ros2-sqlite3 writes them to a
    .db3 bag. mot writes tracks and truths frame by frame, in the form that TrackEval reads. csv and
    parquet write any stream as a table. foxglove writes one log with messages that Foxglove and Rerun
    show.
    """
    from fuselog.pipeline.logs.exporting import export as export_log

    done = export_log(path, to=to, **options)
    for note in done.notes:
        click.echo(printable(f"fuselog: {note}"), err=True)
    for topic, file in done.files.items():
        click.echo(printable(f"{file}: {topic}"))


@command(
    "Write part of a log: a time span, some topics or fewer messages.",
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
    help="Keep every Nth stamp of a topic or pattern, or at most RATE per second (repeatable).",
)
@recover_option
def cut(path: Path, decimate: tuple[str, ...], **options: Any) -> None:
    """Write part of PATH, a log or an estimates log, as a new log.

    Maps, priors and the messages at the first stamp of the log are copied completely, regardless of
    the span.
    """
    from fuselog.pipeline.logs.edit import cut as cut_log

    _say_changed(cut_log(path, decimate=_pairs("--decimate", decimate), **options))


@command(
    "Merge several logs, whose clocks may differ, into one.",
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
    """Merge LOGS, which must have no topic in common, into one log; fuselog relabel renames topics."""
    from fuselog.pipeline.logs.edit import merge as merge_logs
    from fuselog.pipeline.runs.settings import pairs_of

    offsets_s = pairs_of("--offset", offsets, float, "LOG=SECONDS, for example left.mcap=-0.5")
    _say_changed(merge_logs(list(logs), offsets_s=offsets_s, **options))


@command(
    "Add zero-velocity and non-holonomic pseudo-measurements to a log.",
    "fuselog constrain run.mcap -o constrained.mcap --set rolling_hz=10",
)
@click.argument("path", type=ANY_PATH)
@out_log_option
@click.option(
    "--unit",
    metavar="TOPIC",
    help="The topic of the inertial samples [default: the only inertial unit].",
)
@set_option("constraints")
@recover_option
def constrain(path: Path, settings: tuple[str, ...], **options: Any) -> None:
    """Write PATH with zero-velocity and, with --set rolling_hz=10, non-holonomic pseudo-measurements.

    The model inertial uses these pseudo-measurements like sensors: a stationary vehicle has no velocity,
    and a vehicle that rolls on wheels moves neither sideways nor up.
    """
    from fuselog.pipeline.logs.edit import constrain as constrain_log
    from fuselog.recorders.parameters import parse_settings

    _say_changed(constrain_log(path, settings=parse_settings(settings), **options))


@command(
    "Rename topics and components of a log.",
    "fuselog relabel run.mcap --topic /robot1/=/left/ -o left.mcap",
)
@click.argument("path", type=ANY_PATH)
@out_log_option
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="OLD=NEW",
    help="Rename a topic, or a prefix, such as /robot1/=/robot2/ (repeatable).",
)
@click.option(
    "--component",
    "components",
    multiple=True,
    metavar="OLD=NEW",
    help="Rename a component of states in all topics, such as x_m=east_m (repeatable).",
)
@recover_option
def relabel(path: Path, topics: tuple[str, ...], components: tuple[str, ...], **options: Any) -> None:
    """Write PATH, a log or an estimates log, with renamed topics or components; update references."""
    from fuselog.pipeline.logs.edit import relabel as relabel_log

    done = relabel_log(
        path, topics=_pairs("--topic", topics), components=_pairs("--component", components), **options
    )
    _say_changed(done)


def _pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    """Convert an option's NAME=VALUE texts to a dictionary."""
    from fuselog.pipeline.runs.settings import pairs_of

    return pairs_of(option, texts, _text, "NAME=VALUE")


def _text(value: str) -> str:
    if not value:
        raise ValueError
    return value


def _say_changed(done: "Changed") -> None:
    for note in done.notes:
        click.echo(printable(f"fuselog: {note}"), err=True)
    say_written(done.path, sum(done.messages.values()))
