"""The commands that replay estimators over logs: for estimates, parameters, or a check."""

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
    set_option,
    settings_option,
    workers_option,
)

validate_option = click.option(
    "--validate",
    "held_out",
    multiple=True,
    type=ANY_PATH,
    help="A log or a folder of logs that are held out, to judge the values by (repeatable).",
)
folds_option = click.option(
    "--folds",
    type=COUNT,
    default=0,
    help="Cross-validate: cut the logs into N parts, and judge by each what the others gave.",
)


@command(
    "Replay estimators over logs and write their estimates.",
    "fuselog replay run.mcap -e ekf -e ukf -o est.mcap",
    "fuselog replay run.mcap -e ekf --set sigma_range_m=0.3",
    "fuselog replay run.mcap -e ekf --arrival-order --late rewind:0.5",
)
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@estimator_option("names", "An estimator (repeatable).", many=True, required=True)
@click.option(
    "-o",
    "--out",
    type=LOG_OR_FOLDER,
    help="The folder for LOG.estimates.mcap, or for one log a file .mcap [default: beside the log].",
)
@model_option
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

    LOGS are logs or folders of logs. The exit code is 1 if an estimator failed in every run.
    --set gate_probability=1 sets a parameter of all estimators that have it, --set
    ekf.gate_probability=1 of one. --set /fix.delay_s=0.3 alters the topic /fix as it is read, here as in
    run, tune, diagnose and compare; --set /fix=? says what can be set.
    """
    from fuselog.pipeline.command_line.commands import replay_logs

    if not replay_logs(list(logs), list(names), **options):
        click.get_current_context().exit(1)


@command(
    "Drag parameters of an estimator and watch the result change.",
    "fuselog explore run.mcap -e ekf",
    "fuselog explore run.mcap -e ekf -e ukf --set gate_probability=1",
)
@click.argument("log", type=ANY_PATH)
@estimator_option("names", "An estimator, or two (repeatable).", many=True, required=True)
@model_option
@click.option("--no-browser", is_flag=True, help="Print the page's address, and open nothing.")
@recover_option
@gap_option
@settings_option
@set_option("estimators")
def explore(log: Path, names: tuple[str, ...], **options: Any) -> None:
    """Serve a page on which LOG is replayed while parameters are dragged.

    The page is served to this machine only, at an address that cannot be guessed. The command ends when
    the page is closed, or by Ctrl-C.
    """
    from fuselog.pipeline.exploring.command import explore_log

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
    help="What to optimise: the likelihood, NIS or NEES (nearest to their expectation), or RMSE. "
    "[default: likelihood; rmse for an estimator without innovations]",
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
@validate_option
@folds_option
@click.option(
    "--out", type=RESULT, default=Path("out/tune"), show_default=True, help="The result folder."
)
@model_option
@workers_option
@scheduler_option
@replay_options
def tune(logs: tuple[Path, ...], **options: Any) -> None:
    """Search the parameters of an estimator that explain LOGS best, with their 95 % intervals.

    LOGS are logs or folders of logs, and --validate takes either, one at a time: --validate test.
    The search starts from --set NAME=VALUE, else from what the log's channels state. It needs no truth,
    but for --by nees and rmse. Ctrl-C ends it with the best values so far. settings.toml in the result
    folder is for --settings of fuselog replay and run.
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
    "--fixed", multiple=True, help="A parameter of the calibration that stays as it is set (repeatable)."
)
@click.option(
    "--next", "next_motion", is_flag=True, help="Say which manoeuvre of a wheeled robot to record next."
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
    """Search the scales, biases, mounting angles, lever arms and delays that explain LOGS best.

    The model says which parameters these are; --set NAME=VALUE is where one starts. What the motion in
    the logs does not determine is named, stays where it started, and has no interval. settings.toml in
    the result folder is for --settings of fuselog replay and run.
    """
    from fuselog.pipeline.calibrating.command import calibrate_logs

    calibrate_logs(list(logs), **options)


@command(
    "Check that estimates are still those of a golden file.",
    "fuselog check run.mcap --against ekf.golden.xz --update -e ekf",
    "fuselog check run.mcap --against ekf.golden.xz",
    "fuselog check run.mcap --against ekf.golden.xz -e lib:./robot_ekf.so",
)
@click.argument("path", type=ANY_PATH)
@click.option("--against", "golden", type=GOLDEN, required=True, help="The golden, a .golden.xz file.")
@click.option("--update", "is_update", is_flag=True, help="Write the golden instead of checking.")
@estimator_option(
    "labels",
    "With --update: an estimator of the golden (repeatable). Without: a program to check in the "
    "place of the golden's estimator, as lib:./robot_ekf.so.",
    many=True,
)
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
@click.option(
    "--junit", type=JUNIT, help="Write the results for continuous integration, as JUnit's XML."
)
@json_option
@settings_option
@set_option("estimators")
def check(path: Path, golden: Path, **options: Any) -> None:
    """Replay PATH, a log, a folder of logs or a result, and compare with a golden field by field.

    It exits with 1 where something is different, and prints the first difference with its stamp. An
    intended change updates the golden in the same commit. A filter that fuselog deploy wrote is checked
    with -e lib:PATH, and has to be made of the golden's filter.
    """
    from fuselog.pipeline.checking.command import check_path
    from fuselog.pipeline.deploying.deploying import in_place_of_golden

    if not check_path(path, golden, **options, in_place=in_place_of_golden):
        click.get_current_context().exit(1)


@command(
    "Write a filter as C99 for a robot, with a log as its test.",
    "fuselog deploy run.mcap -e ekf --model robot -o robot_ekf",
    "fuselog deploy run.mcap -e ekf --settings tuned.toml --single -o robot_ekf",
)
@click.argument("log", type=ANY_PATH)
@estimator_option("name", "The filter: ekf, or ukf.", required=True)
@model_option
@click.option(
    "-o",
    "--out",
    required=True,
    type=RESULT,
    help="The folder to write, new or empty; its name is the filter's in C.",
)
@click.option("--single", is_flag=True, help="In single precision, float.")
@json_option
@settings_option
@set_option("estimators")
def deploy(name: str, settings_file: Path | None, settings: tuple[str, ...], **options: Any) -> None:
    """Write a filter as C99, with what stands in LOG: its sensors, what its channels state, a test.

    The C does what the filter does, operation by operation, so that its estimates are the same to the
    last bit; README.md in the folder says how to build it, to test it and to replay it.
    """
    from fuselog.pipeline.deploying.command import deploy_filter

    deploy_filter(name, settings_file, list(settings), **options)
