"""The command `fuselog`. Commands import what they need when they run: `--help` answers at once."""

import sys
from pathlib import Path
from typing import Any

import click

from recorders.errors import BadInput

FOLDER = click.Path(path_type=Path, file_okay=False)
FILE = click.Path(path_type=Path, dir_okay=False)
ANY_PATH = click.Path(path_type=Path)

set_option = click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a parameter (repeatable)."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
recover_option = click.option(
    "--recover", is_flag=True, help="Read what is whole of a log that was cut off or damaged."
)
gap_option = click.option(
    "--gap-limit",
    "gap_limit_s",
    default=0.2,
    show_default=True,
    help="Seconds over which truth is interpolated at most.",
)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fuselog")
def fuselog() -> None:
    """Record, replay, judge and look at estimators for sensor fusion."""


@fuselog.command()
@click.argument("scenario", required=False)
@click.option("-o", "--out", type=FILE, help="The log to write [default: SCENARIO.mcap].")
@click.option("--seed", default=0, show_default=True, help="Seed of the random numbers.")
@click.option("--run", default=0, show_default=True, help="Which run of the seed.")
@click.option("--again", type=FILE, help="Record the run of this log again, from its own metadata.")
@click.option("--compression", default="zstd", show_default=True, help="zstd, lz4 or none.")
@set_option
def record(
    scenario: str | None,
    out: Path | None,
    seed: int,
    run: int,
    again: Path | None,
    compression: str,
    settings: tuple[str, ...],
) -> None:
    """Simulate SCENARIO, a name or a TOML file, and write its log."""
    from pipeline.experiment import load_scenario
    from recorders.log import open_log, write_log
    from recorders.parameters import merge, parse_settings
    from recorders.recording import record_run

    if (scenario is None) == (again is None):
        raise BadInput("give a scenario or --again LOG; fuselog scenarios lists what there is")
    if again is not None:
        source = open_log(again).run
        if source is None or source.seed is None:
            raise BadInput(f"{again}: the log does not say how it was simulated; name a scenario")
        name, values, seed, run = source.scenario, source.parameters, source.seed, source.run
        label = f"{again.stem}-again"
    else:
        name, values, label = load_scenario(scenario or "")
    recording, metadata = record_run(name, merge(values, parse_settings(settings)), seed, run)
    path = out or Path(f"{label}.mcap")
    write_log(path, recording.streams, metadata, compression=compression)
    _say_written(path, sum(map(len, recording.streams)))


@fuselog.command(name="import")
@click.argument("source")
@click.argument("path", type=ANY_PATH)
@click.option("-o", "--out", type=FILE, help="The log to write [default: SOURCE.mcap].")
@set_option
def import_(source: str, path: Path, out: Path | None, settings: tuple[str, ...]) -> None:
    """Import real data of kind SOURCE from PATH, as published, and write its log."""
    from recorders.log import write_log
    from recorders.parameters import parse_settings
    from recorders.recording import import_run

    recording, metadata = import_run(source, path, parse_settings(settings))
    target = out or Path(f"{source}.mcap")
    write_log(target, recording.streams, metadata)
    for subject, fact in metadata.notes.items():
        click.echo(f"{subject}: {fact}")
    _say_written(target, sum(map(len, recording.streams)))


def _say_written(path: Path, messages: int) -> None:
    click.echo(f"{path}: {messages} messages, {path.stat().st_size / 1e6:.1f} MB")


@fuselog.command()
@click.argument("logs", nargs=-1, required=True, type=ANY_PATH)
@click.option(
    "-e", "--estimator", "names", multiple=True, required=True, help="An estimator (repeatable)."
)
@click.option(
    "-o", "--out", type=ANY_PATH, help="Estimates log, or a folder for several [default: beside]."
)
@click.option("--arrival-order", is_flag=True, help="Go by log time, as the messages arrived.")
@click.option("--start", "start_s", type=float, help="Begin this many seconds into the run.")
@click.option("--end", "end_s", type=float, help="End this many seconds into the run.")
@click.option("--save", type=FILE, help="Also write the timeline of the first log to this .rrd.")
@click.option("--connect", metavar="URL", help="Also stream the timeline to this Rerun viewer.")
@recover_option
@gap_option
@json_option
@set_option
def replay(logs: tuple[Path, ...], names: tuple[str, ...], **options: Any) -> None:
    """Replay estimators over LOGS (the runs of one ensemble) and write their estimates."""
    from pipeline.commands import replay_logs

    replay_logs(list(logs), list(names), **options)


@fuselog.command()
@click.argument("estimates", nargs=-1, required=True, type=ANY_PATH)
@click.option("--log", "logs", multiple=True, type=ANY_PATH, help="The log with the truth, per run.")
@click.option("--out", type=FOLDER, help="Write tables (Parquet and CSV) to this folder.")
@recover_option
@gap_option
@json_option
def evaluate(estimates: tuple[Path, ...], logs: tuple[Path, ...], **options: Any) -> None:
    """Judge ESTIMATES logs against the truth of the logs they were replayed from."""
    from pipeline.commands import evaluate_logs

    evaluate_logs(list(estimates), list(logs), **options)


@fuselog.command()
@click.argument("path", type=ANY_PATH)
@click.option("--screenshot", type=FILE, help="Take the viewer's picture, headless, as PNG.")
@click.option("--at", "at_s", type=float, help="Put the time cursor this many seconds into the run.")
@click.option("--save", type=FILE, help="Write the timeline to this .rrd instead of opening it.")
@click.option("--connect", metavar="URL", help="Stream the timeline to this Rerun viewer.")
@click.option("--focus", help="What to show first, such as robot3.")
@recover_option
@gap_option
def view(path: Path, **options: Any) -> None:
    """Open PATH (a log, an estimates log, a result folder or an .rrd) in the Rerun viewer."""
    from pipeline.commands import view_path

    view_path(path, **options)


@fuselog.command()
@click.argument("experiment")
@click.option("--runs", type=int, help="Number of Monte Carlo runs.")
@click.option("--seed", type=int, help="Seed of the random numbers.")
@click.option("--logs", default=20, show_default=True, help="Write the logs of the first K runs.")
@click.option("--data", type=ANY_PATH, help="Where the real data are, for experiments that import.")
@click.option("--out", type=FOLDER, help="The result folder [default: out/EXPERIMENT].")
@json_option
@set_option
def run(experiment: str, runs: int | None, seed: int | None, **options: Any) -> None:
    """Run EXPERIMENT, a shipped name or a TOML file: record or import, replay, evaluate, draw."""
    from pipeline.commands import run_named

    over = {key: value for key, value in {"runs": runs, "seed": seed}.items() if value is not None}
    run_named(experiment, over, **options)


@fuselog.command()
@click.argument("results", nargs=-1, required=True, type=ANY_PATH)
@click.option("-o", "--out", type=FILE, default=Path("report.html"), show_default=True)
def report(results: tuple[Path, ...], out: Path) -> None:
    """Render RESULTS, folders that `fuselog run` wrote, as one self-contained HTML page."""
    from pipeline.report import write_report

    write_report(list(results), out)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


@fuselog.command()
@click.argument("log", type=ANY_PATH)
@recover_option
@json_option
def info(log: Path, recover: bool, as_json: bool) -> None:
    """Say what LOG holds: the run, its topics, schemas, message counts."""
    from pipeline.commands import log_info

    log_info(log, recover=recover, as_json=as_json)


def _list_command(name: str, text: str) -> None:
    @fuselog.command(name=name, help=text)
    @json_option
    def listing(as_json: bool) -> None:
        from pipeline import commands
        from pipeline.terminal import print_json, print_table

        rows: list[dict[str, str]] = getattr(commands, name)()
        if as_json:
            print_json(rows)
        elif rows:
            print_table("", list(rows[0]), [list(row.values()) for row in rows])


_list_command("scenarios", "List what can be recorded and imported.")
_list_command("estimators", "List the estimators and their parameters.")
_list_command("experiments", "List the shipped experiments.")


def main() -> None:
    """Run the command line; a user's mistake is one sentence and exit code 2."""
    try:
        fuselog(standalone_mode=False)
    except BadInput as error:
        sys.exit(_fail(str(error)))
    except click.UsageError as error:
        error.show()
        sys.exit(2)
    except click.ClickException as error:
        sys.exit(_fail(error.format_message()))
    except (click.Abort, KeyboardInterrupt):
        click.echo("fuselog: stopped", err=True)
        sys.exit(130)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(141)


def _fail(sentence: str) -> int:
    click.echo(f"fuselog: {sentence}", err=True)
    return 2
