"""The commands that replay estimators over logs, such as replay, tune, calibrate and check."""

from pathlib import Path
from typing import Any

import click

from fuselog.pipeline.command_line.help import command
from fuselog.pipeline.command_line.options import (
    ANY_PATH,
    COUNT,
    GOLDEN,
    JUNIT,
    LOG_OR_FOLDER,
    RESULT,
    TIMELINE,
    Seconds,
    arrival_option,
    estimator_option,
    foxglove_option,
    gap_option,
    json_option,
    late_option,
    model_option,
    parameters_option,
    recover_option,
    replay_options,
    scheduler_option,
    selecting,
    selection_options,
    set_option,
    settings_option,
    where_option,
    workers_option,
)

validate_option = click.option(
    "--validate",
    "held_out",
    multiple=True,
    type=ANY_PATH,
    help="A log or folder of logs on which to validate the values; it is not used in the search "
    "(repeatable).",
)
folds_option = click.option(
    "--folds",
    type=COUNT,
    default=0,
    help="Cross-validate: divide the logs into N parts, and validate each part with values tuned on "
    "the others.",
)


@command(
    "Replay estimators over logs and write their estimates.",
    "fuselog replay run.mcap -e ekf -e ukf -o est.mcap",
    "fuselog replay run.mcap -e ekf --set sigma_range_m=0.3",
    "fuselog replay run.mcap -e ekf --arrival-order --late rewind:0.5",
    "fuselog replay logs.parquet --where 'duration_s > 60' -e ekf --workers 4",
)
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@estimator_option("names", "An estimator (repeatable).", many=True, required=True)
@click.option(
    "-o",
    "--out",
    type=LOG_OR_FOLDER,
    help="The folder for LOG.estimates.mcap, or an .mcap file for one log [default: next to the log, "
    "or the current folder if it is a URL]; for a catalog, the result folder [default: out/replay].",
)
@selection_options
@model_option
@click.option(
    "--every",
    "every_s",
    type=Seconds(0),
    help="Also output estimates at this interval in seconds, not only at measurements.",
)
@arrival_option
@late_option
@click.option("--start", "start_s", type=Seconds(), help="Begin this many seconds into the run.")
@click.option(
    "--start-from",
    "origins",
    multiple=True,
    metavar="truth|ESTIMATES",
    help="The initial state of filters at --start: the log's truth, or the estimates log of an earlier "
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
@click.option("--save", type=TIMELINE, help="Also write the timeline of the first log to this .rrd.")
@click.option("--connect", metavar="URL", help="Also stream the timeline to this Rerun viewer.")
@foxglove_option
@recover_option
@gap_option
@parameters_option
@json_option
@settings_option
@set_option("estimators")
def replay(logs: tuple[Path, ...], names: tuple[str, ...], **options: Any) -> None:
    """Replay estimators over LOGS, the runs of one ensemble, and write their estimates.

    LOGS are logs or folders of logs. The exit code is 1 if an estimator failed in every run. With a
    catalog, or with --where, --group, --workers or --scheduler, each log is replayed by itself, and a
    result folder has a row for each log and estimator. --set gate_probability=1 sets a parameter of all
    estimators that have it, and --set ekf.gate_probability=1 sets a parameter of one estimator. --set
    /fix.delay_s=0.3 changes the topic /fix as it is read, also in run, tune, diagnose and compare; --set
    /fix=? lists what can be set.
    """
    if selection := selecting(logs, options):
        from fuselog.pipeline.command_line.selections import replay_selection

        is_good = replay_selection(selection, names, **options)
    else:
        from fuselog.pipeline.command_line.commands import replay_logs

        is_good = replay_logs(list(logs), list(names), **options)
    if not is_good:
        click.get_current_context().exit(1)


@command(
    "Drag parameters of an estimator and watch the result change.",
    "fuselog explore run.mcap -e ekf",
    "fuselog explore run.mcap -e ekf -e ukf --set gate_probability=1",
)
@click.argument("log", type=ANY_PATH)
@estimator_option("names", "An estimator, or two (repeatable).", many=True, required=True)
@model_option
@click.option("--no-browser", is_flag=True, help="Print the page's address and do not open a browser.")
@recover_option
@gap_option
@settings_option
@set_option("estimators")
def explore(log: Path, names: tuple[str, ...], **options: Any) -> None:
    """Serve a page that replays LOG while you drag parameters.

    The page is served to this machine only, at an address that cannot be guessed. The command ends when
    the page is closed, or with Ctrl-C.
    """
    from fuselog.pipeline.exploring.explore import explore_log

    explore_log(log, list(names), **options)


@command(
    "Find the noise and other parameters that explain logs best.",
    "fuselog tune run.mcap -e ekf --free sigma_range_m --free sigma_bearing_rad",
    "fuselog tune train -e ekf --free sigma_range_m --validate test",
)
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@estimator_option("label", "The estimator.", required=True)
@click.option("--free", multiple=True, required=True, help="A parameter to search for (repeatable).")
@click.option(
    "--by",
    type=click.Choice(["likelihood", "nis", "nees", "rmse"]),
    help="Metric to optimise: the likelihood, NIS or NEES (closest to their expectation), or RMSE. "
    "[default: likelihood; rmse for an estimator without innovations]",
)
@click.option(
    "--bound",
    "bounds",
    multiple=True,
    metavar="NAME=LOW:HIGH",
    help="The bounds of a parameter (repeatable) [default: 1e-4 to 1e4 times the start value].",
)
@click.option(
    "--grid",
    type=click.IntRange(min=1),
    default=1,
    help="Start the search from the best of N values of each parameter between its bounds.",
)
@validate_option
@folds_option
@click.option(
    "--out", type=RESULT, default=Path("out/tune"), show_default=True, help="The result folder."
)
@model_option
@where_option
@workers_option
@scheduler_option
@replay_options
def tune(logs: tuple[Path, ...], **options: Any) -> None:
    """Find the estimator parameters that explain LOGS best, with 95 % intervals.

    LOGS are logs, folders or catalogs; --validate takes one of these and can be repeated. The search
    starts from --set NAME=VALUE, or from the values in the log's channels. Truth is needed only for
    --by nees and --by rmse. Ctrl-C ends the search with the best values so far. Use settings.toml from
    the result folder with --settings of fuselog replay and run.
    """
    from fuselog.pipeline.tuning.command import tune_logs

    tune_logs(list(logs), **options)


@command(
    "Find how sensors are mounted, scaled, biased and delayed.",
    "fuselog calibrate run.mcap -e ekf",
    "fuselog calibrate train -e ekf --fixed lever_y_m --validate test",
)
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@estimator_option("label", "The estimator.", required=True)
@click.option(
    "--fixed", multiple=True, help="A calibration parameter that keeps its value (repeatable)."
)
@click.option(
    "--next",
    "next_motion",
    is_flag=True,
    help="Recommend the next manoeuvre of a wheeled robot to record.",
)
@click.option(
    "--bound",
    "bounds",
    multiple=True,
    metavar="NAME=LOW:HIGH",
    help="The bounds of a parameter (repeatable) [default: none].",
)
@validate_option
@folds_option
@click.option(
    "--out", type=RESULT, default=Path("out/calibrate"), show_default=True, help="The result folder."
)
@model_option
@workers_option
@scheduler_option
@replay_options
def calibrate(logs: tuple[Path, ...], **options: Any) -> None:
    """Estimate the scales, biases, mounting angles, lever arms and delays that explain LOGS best.

    The model defines which parameters are calibrated; --set NAME=VALUE sets a start value. A parameter
    that the motion in the logs does not determine is named, keeps its start value, and has no interval.
    Use settings.toml from the result folder with --settings of fuselog replay and run.
    """
    from fuselog.pipeline.calibrating.command import calibrate_logs

    calibrate_logs(list(logs), **options)


@command(
    "Check that estimates still match a golden file.",
    "fuselog check run.mcap --against ekf.golden.xz --update -e ekf",
    "fuselog check run.mcap --against ekf.golden.xz",
    "fuselog check run.mcap --against ekf.golden.xz -e lib:./robot_ekf.so",
)
@click.argument("path", type=ANY_PATH)
@click.option("--against", "golden", type=GOLDEN, required=True, help="The golden, a .golden.xz file.")
@click.option("--update", "is_update", is_flag=True, help="Write the golden instead of checking.")
@estimator_option(
    "labels",
    "With --update: an estimator of the golden (repeatable). Without --update: a program to check "
    "instead of the golden's estimator, for example lib:./robot_ekf.so.",
    many=True,
)
@arrival_option
@late_option
@click.option(
    "--keep",
    "columns",
    multiple=True,
    metavar="PATTERN",
    help="With --update: keep only columns that match, as 'TOPIC COLUMN' (repeatable) [default: all].",
)
@click.option(
    "--tolerance",
    "tolerances",
    multiple=True,
    metavar="PATTERN=RELATIVE",
    help="With --update: the largest relative difference of columns that match, as 'TOPIC COLUMN' "
    "(repeatable) [default: 1e-12, 1e-6 on another CPU].",
)
@click.option("--junit", type=JUNIT, help="Write the results as JUnit XML, for continuous integration.")
@click.option("--out", type=RESULT, help="For a catalog: the result folder [default: out/check].")
@selection_options
@json_option
@settings_option
@set_option("estimators")
def check(path: Path, golden: Path, **options: Any) -> None:
    """Replay PATH, a log, a folder of logs or a result, and compare with a golden field by field.

    The exit code is 1 if anything differs; the first difference is printed with its stamp. For an
    intended change, update the golden in the same commit. To check a filter written by fuselog deploy,
    use -e lib:PATH; the filter must have been deployed from the golden's filter. With a catalog, or with
    --where, --group, --workers or --scheduler, a result folder has a row for each log, also for those
    that are missing or new.
    """
    from fuselog.pipeline.checking.command import check_path
    from fuselog.pipeline.deploying.deploying import in_place_of_golden

    selection = selecting([path], options)
    if not check_path(path, golden, **options, in_place=in_place_of_golden, selection=selection):
        click.get_current_context().exit(1)


@command(
    "Write a filter as C99 for a robot, with a log as its test.",
    "fuselog deploy run.mcap -e ekf --model robot -o robot_ekf",
    "fuselog deploy run.mcap -e ekf --settings tuned.toml --single -o robot_ekf",
)
@click.argument("log", type=ANY_PATH)
@estimator_option("name", "The filter, such as ekf, ukf or sqrt:ekf.", required=True)
@model_option
@click.option(
    "-o",
    "--out",
    required=True,
    type=RESULT,
    help="The folder to write, new or empty; its name becomes the filter's name in C.",
)
@click.option("--single", is_flag=True, help="Use single precision (float).")
@json_option
@settings_option
@set_option("estimators")
def deploy(name: str, settings_file: Path | None, settings: tuple[str, ...], **options: Any) -> None:
    """Write a filter in C99 for the sensors and parameters of LOG, with a test made from LOG.

    The C code performs the same operations as fuselog in the same order, so the estimates are identical
    to the last bit; README.md in the folder explains how to build, test and replay it.
    """
    from fuselog.pipeline.deploying.command import deploy_filter

    deploy_filter(name, settings_file, list(settings), **options)
