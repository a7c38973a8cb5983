"""The commands for experiments: run one, run it at many points, report results."""

from pathlib import Path
from typing import Any

import click

from fuselog.pipeline.command_line.help import command
from fuselog.pipeline.command_line.options import (
    ANY_PATH,
    COUNT,
    EXPERIMENT,
    PAGE,
    RESULT,
    arrival_option,
    errors_option,
    estimator_option,
    json_option,
    late_option,
    parameters_alone_option,
    scheduler_option,
    set_option,
    settings_option,
    where_option,
    workers_option,
)

diagnose_option = click.option(
    "--diagnose", is_flag=True, help="Explain why an estimator is inconsistent, from its first run."
)
stress_option = click.option(
    "--stress",
    is_flag=True,
    help="Test whether each estimator's result is robust to changes that should not matter, and "
    "withhold verdicts on differences smaller than the effect of these changes.",
)


@command(
    "Run an experiment: record, replay, evaluate, draw.",
    "fuselog run landmarks --runs 1000 --workers 4",
    "fuselog run landmarks --set ekf.gate_probability=0.999 --set duration_s=30",
    "fuselog run a.mcap b.mcap -e ekf -e ukf --out out/mine",
)
@click.argument("experiment", nargs=-1, required=True, type=EXPERIMENT)
@estimator_option("labels", "For logs: an estimator (repeatable).", many=True)
@click.option("--runs", type=int, help="Number of Monte Carlo runs.")
@click.option("--seed", type=int, help="Seed of the random numbers.")
@click.option(
    "--logs", type=COUNT, default=20, show_default=True, help="Write the logs of the first K runs."
)
@arrival_option
@late_option
@errors_option
@click.option(
    "--data", type=ANY_PATH, help="The folder or file of real data, for experiments that import."
)
@click.option("--out", type=RESULT, help="The result folder [default: out/EXPERIMENT].")
@where_option
@workers_option
@scheduler_option
@diagnose_option
@stress_option
@parameters_alone_option
@json_option
@settings_option
@set_option("experiment")
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

    To run your own logs as an experiment, give LOG.mcap ..., folders or a catalog, and -e for each
    estimator.

    --set duration_s=30 sets a parameter of the scenario, --set ekf.gate_probability=1 sets a parameter
    of one estimator, --set gate_probability=1 sets it for all estimators that have it, and --set
    gap_limit_s=1 sets an entry of the experiment.
    """
    from fuselog.pipeline.command_line.experiment_commands import run_named

    stated = {"runs": runs, "seed": seed, "arrival_order": arrival_order or None, "late": late}
    over = {key: value for key, value in stated.items() if value is not None}
    run_named(experiment, labels, over, **options)


@command(
    "Run an experiment at many points of its parameters.",
    "fuselog sweep landmarks --over ekf.sigma_range_m=0.05:0.8:log9 --runs 50",
    "fuselog sweep landmarks --over robots=1,2 --over duration_s=10:60:6",
)
@click.argument("experiment", nargs=-1, required=True, type=EXPERIMENT)
@estimator_option("labels", "For logs: an estimator (repeatable).", many=True)
@click.option(
    "--over",
    "swept",
    multiple=True,
    required=True,
    metavar="KEY=LOW:HIGH:N|logN or KEY=A,B,...",
    help="A parameter and its values: a list, or N values from LOW to HIGH, linear or logarithmic "
    "(repeatable).",
)
@click.option(
    "--samples",
    type=click.IntRange(min=1),
    help="Draw N points from the ranges instead of taking the whole grid.",
)
@click.option("--sampling", type=click.Choice(["sobol", "random"]), default="sobol", show_default=True)
@click.option("--runs", type=int, help="Number of Monte Carlo runs at each point.")
@click.option("--seed", type=int, help="Seed of the random numbers.")
@click.option("--out", type=RESULT, help="The result folder [default: out/EXPERIMENT-sweep].")
@where_option
@workers_option
@scheduler_option
@json_option
@settings_option
@set_option("experiment")
def sweep(
    experiment: tuple[str, ...],
    labels: tuple[str, ...],
    runs: int | None,
    seed: int | None,
    **options: Any,
) -> None:
    """Run EXPERIMENT, or replay logs, at all points of a parameter grid, or at samples of it.

    A table contains every metric at every point, with the range of the middle 90 % of runs; figures show
    the metrics as curves, or as heat maps over two parameters. Keys are written as for --set.
    """
    from fuselog.pipeline.command_line.experiment_commands import sweep_named

    over = {key: value for key, value in {"runs": runs, "seed": seed}.items() if value is not None}
    sweep_named(experiment, labels, over, **options)


@command(
    "Render results as one self-contained HTML page.",
    "fuselog report out/landmarks -o report.html",
)
@click.argument("results", nargs=-1, required=True, type=ANY_PATH)
@click.option("-o", "--out", type=PAGE, default=Path("report.html"), show_default=True)
@click.option("--viewer", is_flag=True, help="Add viewer pictures of the first runs; takes 15 s each.")
@diagnose_option
def report(results: tuple[Path, ...], out: Path, viewer: bool, diagnose: bool) -> None:
    """Render RESULTS, folders that `fuselog run` wrote, as one self-contained HTML page."""
    from fuselog.pipeline.output.outputs import REPORT, check_files
    from fuselog.pipeline.output.report import write_report
    from fuselog.pipeline.output.terminal import say, say_next

    check_files([(out, REPORT)], {"result": [path for each in results for path in each.rglob("*")]})
    seek = None
    if diagnose:
        from fuselog.pipeline.diagnosing.likeliest import likeliest_causes

        seek = likeliest_causes
    write_report(list(results), out, viewer=viewer, diagnose=seek)
    say(f"{out}: {out.stat().st_size / 1e6:.1f} MB; open it in any browser")
    say_next("view", str(results[0]))
