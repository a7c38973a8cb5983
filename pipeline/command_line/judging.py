"""The commands that judge estimates, compare estimators, and explain inconsistency."""

from pathlib import Path
from typing import Any

import click

from fuselog.pipeline.command_line.help import command
from fuselog.pipeline.command_line.options import (
    ANY_PATH,
    FORMAT,
    METRIC,
    RESULT,
    TIMELINE,
    Seconds,
    TimeOffset,
    errors_option,
    estimator_option,
    gap_option,
    json_option,
    model_option,
    recover_option,
    replay_options,
    selecting,
    selection_options,
    set_option,
)
from fuselog.recorders.errors import BadInput

_OF_COMPARISON = ("align", "delta", "delta_unit", "association", "max_difference_s", "time_offset_s")


@command(
    "Judge estimates against the truth.",
    "fuselog evaluate est.mcap",
    "fuselog evaluate est.txt --truth gt.txt --align se3",
)
@click.argument("estimates", nargs=-1, required=True, type=ANY_PATH)
@click.option(
    "--log",
    "logs",
    multiple=True,
    type=ANY_PATH,
    help="The log with the truth, one per run (repeatable).",
)
@click.option(
    "--truth",
    type=ANY_PATH,
    help="The true trajectory, if ESTIMATES is a trajectory file.",
)
@click.option(
    "--format",
    type=FORMAT,
    help="The format of trajectory files [default: detected from their content].",
)
@click.option(
    "--truth-format",
    type=FORMAT,
    help="The format of the true trajectory [default: detected from its content].",
)
@click.option(
    "--align",
    type=click.Choice(["none", "yaw", "se2", "se3", "sim3"]),
    help="Align estimates with the truth first: yaw rotates about the vertical axis and translates, se2 "
    "does so without changing the height, se3 rotates and translates, sim3 also scales [default: none].",
)
@click.option(
    "--delta", type=float, help="The distance over which relative pose errors are computed [default: 1]."
)
@click.option(
    "--delta-unit",
    type=click.Choice(["m", "frames", "s"]),
    help="The unit of --delta [default: frames].",
)
@click.option(
    "--association",
    type=click.Choice(["nearest", "interpolated"]),
    help="How an estimated pose is matched with a true one: nearest in time, or interpolated "
    "[default: nearest for files, interpolated for logs].",
)
@click.option(
    "--max-difference",
    "max_difference_s",
    type=Seconds(0),
    help="The largest time difference, in seconds, between matched poses [default: 0.01].",
)
@click.option(
    "--time-offset",
    "time_offset_s",
    type=TimeOffset(),
    metavar="SECONDS|estimate",
    help="Add this to the stamps of the estimated trajectory, or estimate it [default: 0].",
)
@click.option(
    "--metric", "metrics", type=METRIC, multiple=True, help="A metric (repeatable) [default: all]."
)
@click.option("--out", type=RESULT, help="Write a result folder, as fuselog run does.")
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
    **options: Any,
) -> None:
    """Judge ESTIMATES logs against the truth in the logs they were replayed from.

    With --truth, judge one trajectory file (TUM, KITTI or EuRoC) against another: absolute and relative
    pose errors (APE and RPE), computed as in evo. With --align or --delta, also compute pose errors for
    the estimated positions of logs; all other metrics then refer to the aligned estimates.
    """
    from fuselog.pipeline.command_line.commands import evaluate_logs, evaluate_trajectory

    given = {name: options.pop(name) for name in _OF_COMPARISON}
    comparison = {name: value for name, value in given.items() if value is not None}
    formats = {"format": format, "truth_format": truth_format}
    if truth is not None:
        evaluate_trajectory(list(estimates), truth, formats, comparison, logs=logs, **options)
        return
    if any(formats.values()):
        raise BadInput(
            "--format and --truth-format apply to trajectory files; give the true trajectory with "
            "--truth"
        )
    evaluate_logs(list(estimates), list(logs), comparison=comparison, **options)


@command(
    "Compare estimators run by run, with a verdict on every metric.",
    "fuselog compare out/before out/after",
    "fuselog compare out/landmarks/logs -e ekf -e smoother:ekf",
)
@click.argument("sides", nargs=-1, required=True, type=ANY_PATH)
@estimator_option("labels", "Which estimators (repeatable).", many=True)
@click.option("--truth", type=ANY_PATH, help="The true trajectory, if SIDES are trajectory files.")
@click.option(
    "--case",
    help="The truth to use for trajectory files, such as robot2, if a log has several.",
)
@click.option(
    "--margin",
    type=click.FloatRange(min=0),
    default=0.02,
    show_default=True,
    help="The relative difference of a metric that is considered irrelevant.",
)
@click.option("--out", type=RESULT, help="Write a result folder: tables, figures, the timeline.")
@click.option("--save", type=TIMELINE, help="Write the timelines, side by side, to this .rrd file.")
@click.option(
    "--stress",
    is_flag=True,
    help="Withhold verdicts on differences smaller than the effect of changes that should not matter.",
)
@click.option(
    "--fail-if-worse",
    is_flag=True,
    help="Exit with 1 if a side is worse than the first in an error, in consistency or in failures.",
)
@selection_options
@replay_options
def compare(sides: tuple[Path, ...], labels: tuple[str, ...], **options: Any) -> None:
    """Compare SIDES: result folders, estimates logs or folders of them, trajectory files.

    SIDES can also be logs or folders of logs, with -e for each estimator. Estimates that the logs
    already contain, such as an autopilot's, come first and are not replayed. All other sides are
    compared with the first, metric by metric over the runs that both sides have, with 95 % bootstrap
    intervals over runs. With a catalog, or with --where, --group, --workers or --scheduler, each log is
    replayed by itself.
    """
    from fuselog.pipeline.comparing.command import compare_candidates, compare_selection

    if selection := selecting(sides, options):
        is_good = compare_selection(selection, list(labels), **options)
    else:
        is_good = compare_candidates(list(sides), list(labels), **options)
    if not is_good:
        click.get_current_context().exit(1)


@command(
    "Find out why an estimator is inconsistent.",
    "fuselog diagnose run.mcap -e ekf",
)
@click.argument("logs", metavar="LOG", nargs=-1, required=True, type=ANY_PATH)
@estimator_option("label", "The estimator [default: the only one of an estimates log].")
@click.option("--out", type=RESULT, help="A result folder to write, for fuselog report.")
@click.option(
    "--save", type=TIMELINE, help="Write a timeline to this .rrd, with the findings as events."
)
@model_option
@click.option(
    "--tried", "tells_tried", is_flag=True, help="List every change that was tried, with its gain."
)
@selection_options
@replay_options
def diagnose(logs: tuple[Path, ...], **options: Any) -> None:
    """Explain what is likely wrong with LOG or with an estimator's settings, and what to try.

    LOG is a log, or an estimates log next to its source log. The output has at most five sentences, the
    likeliest cause first: the cause whose correction increases the log-likelihood most. For a folder or
    a catalog, a result folder has a row for each log.
    """
    from fuselog.pipeline.diagnosing.command import diagnose_log, diagnose_selection

    if selection := selecting(logs, options, always=logs[0].is_dir()):
        if not diagnose_selection(selection, **options):
            click.get_current_context().exit(1)
    else:
        diagnose_log(logs, **options)


@command(
    "Test whether a result is robust to irrelevant changes.",
    "fuselog stress run.mcap -e ekf",
)
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=ANY_PATH)
@estimator_option("labels", "Which estimators (repeatable).", many=True, required=True)
@model_option
@click.option(
    "--seed",
    type=int,
    default=0,
    show_default=True,
    help="Seed of the random signs and of the dropped messages.",
)
@click.option(
    "--save",
    type=TIMELINE,
    help="Write a timeline of the first log to this .rrd, with the changed replays next to the "
    "original.",
)
@replay_options
def stress(logs: tuple[Path, ...], labels: tuple[str, ...], **options: Any) -> None:
    """Replay LOG with tiny changes of stamps, order, inputs, start and parameters.

    The verdict is printed first: harmless, sensitive (half the change has half the effect), or
    discontinuous or chaotic (half the change has almost the same effect). Each estimator needs at
    most twelve replays.
    """
    from fuselog.pipeline.stressing.command import stress_logs

    stress_logs(logs, labels, **options)


@command(
    "Show how well measurements determine a model's state.",
    "fuselog observability run.mcap --window 10",
)
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@model_option
@click.option(
    "--window",
    "window_s",
    type=Seconds(),
    help="The length of each of the consecutive windows [default: the whole run].",
)
@click.option(
    "--scale",
    "scales",
    multiple=True,
    metavar="COMPONENT=SIGMA",
    help="The standard deviation to use as the unit of a component, instead of the prior's "
    "(repeatable).",
)
@click.option("--end", "end_s", type=Seconds(), help="End this many seconds into the run.")
@recover_option
@json_option
@set_option("observability")
def observability(logs: tuple[Path, ...], **options: Any) -> None:
    """Show how well the measurements of LOGS determine the state, and the least determined direction.

    For every run and window, print the rank and the eigenvalues of the local Gramian along the smoothed
    trajectory, in units of the prior's information.
    """
    from fuselog.pipeline.api.observability import show_observability

    show_observability(list(logs), **options)
