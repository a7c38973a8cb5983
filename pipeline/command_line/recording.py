"""The commands that create logs from simulated scenarios or from real data."""

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import click

from fuselog.pipeline.command_line.help import command
from fuselog.pipeline.command_line.options import (
    ANY_PATH,
    COUNT,
    LOG,
    PLACE,
    SCENARIO,
    foxglove_option,
    set_option,
)
from fuselog.recorders.errors import BadInput, printable


@command(
    "Simulate a scenario as a log.",
    "fuselog record landmarks --seed 7 -o run.mcap",
    "fuselog record landmarks --set duration_s=120 -o long.mcap",
    "fuselog record --again run.mcap -o again.mcap",
)
@click.argument("scenario", required=False, type=SCENARIO)
@click.option("-o", "--out", type=LOG, help="The log to write [default: SCENARIO.mcap].")
@click.option("--seed", type=COUNT, help="Seed of the random numbers [default: 0].")
@click.option("--run", type=COUNT, help="Number of the run with this seed [default: 0].")
@click.option("--again", type=ANY_PATH, help="Record the run of this log again, from its metadata.")
@click.option(
    "--compression",
    type=click.Choice(["zstd", "lz4", "none"]),
    default="zstd",
    show_default=True,
    help="Compression of the log's chunks.",
)
@foxglove_option
@set_option("recorder")
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
    from fuselog.pipeline.command_line.commands import mirrors_if, say_left_out
    from fuselog.pipeline.output.outputs import RECORDED, check_files, replaced, run_written
    from fuselog.pipeline.output.terminal import warn
    from fuselog.pipeline.runs.inputs import load_scenario
    from fuselog.recorders.log import open_log, write_log
    from fuselog.recorders.parameters import merge, parse_settings
    from fuselog.recorders.recording import record_run

    if (scenario is None) == (again is None):
        raise BadInput("give either a scenario (fuselog scenarios lists them) or --again LOG")
    if again is not None:
        source = open_log(again).run
        if source is None or source.seed is None:
            raise BadInput(f"{again}: the log has no metadata of a simulation; give a scenario instead")
        name, values, label = source.scenario, source.parameters, f"{again.stem}-again"
        seed = source.seed if seed is None else seed
        run = source.run if run is None else run
    else:
        name, values, label = load_scenario(scenario or "")
    values = merge(values, parse_settings(settings))
    path = out or Path(f"{label}.mcap")
    check_files([(path, RECORDED)], {"log": [] if again is None else [again]})
    before = run_written(path)
    recording, metadata = record_run(name, values, seed or 0, run or 0)
    beside = mirrors_if(foxglove)
    write_log(path, recording.streams, metadata, compression=compression, mirrors=beside)
    say_left_out(path, foxglove)
    if sentence := replaced(path, before, open_log(path).run):
        warn(sentence)
    say_written(path, sum(map(len, recording.streams)))


@command(
    "Import real data (ROS, CSV, ULog, ...) as a log.",
    "fuselog import ros drive.bag -o drive.mcap",
    "fuselog import table drive.csv --guess -o mapping.toml",
    "fuselog import table drive.csv --mapping mapping.toml -o drive.mcap",
    name="import",
)
@click.argument("source", type=SCENARIO)
@click.argument("paths", metavar="PATH...", nargs=-1, required=True, type=ANY_PATH)
@click.option("-o", "--out", type=LOG, help="The log to write [default: SOURCE.mcap].")
@click.option(
    "--clock",
    type=click.Choice(["header", "bag"]),
    help="For ROS: take a message's publish time from its header or from the bag [default: header].",
)
@click.option(
    "--mapping",
    help="The mapping of messages or columns: a TOML file, or the name of a shipped one; "
    "without it, import table lists the shipped ones.",
)
@click.option(
    "--origin",
    type=PLACE,
    metavar="LATITUDE,LONGITUDE[,HEIGHT]",
    help="For ROS and tables: the origin, in deg and m, of the local tangent plane of positions.",
)
@click.option(
    "--guess",
    is_flag=True,
    help="For tables: write a first mapping to -o FILE.toml instead of importing; with -o FILE.mcap, "
    "import "
    "with it and write it next to the log.",
)
@set_option("recorder")
def import_(
    source: str,
    paths: tuple[Path, ...],
    out: Path | None,
    clock: str | None,
    mapping: str | None,
    origin: list[float] | None,
    guess: bool,
    settings: tuple[str, ...],
) -> None:
    """Import real data of format SOURCE from PATH, and write them as a log.

    For tables (SOURCE table), PATH may be several files and folders; they become one log.
    """
    from fuselog.pipeline.output.outputs import check_files, imported

    if guess:
        if source != "table":
            raise BadInput(
                f"--guess works only for tables, not for {source}; use: fuselog import table PATH"
            )
        if out is None or out.suffix != ".mcap":
            place = out or Path("mapping.toml")
            with _guessed(paths, place):
                pass
            again = shlex.join(["fuselog", "import", "table", *map(str, paths), "--mapping", str(place)])
            click.echo(printable(f"{place}: check this mapping, then run: {again}"))
            return
        check_files([(out, imported(source))], {"data": paths})
        place = out.with_suffix(".toml")
        with _guessed(paths, place) as new:
            click.echo(printable(f"{place}: the guessed mapping that is used for this import; check it"))
            chosen = {"mapping": str(new), "origin": origin}
            _import(source, paths, out, chosen, settings, stated={"mapping": str(place)})
        return
    chosen = {"clock": clock, "mapping": mapping, "origin": origin}
    _import(source, paths, out, chosen, settings)


def _import(
    source: str,
    paths: tuple[Path, ...],
    out: Path | None,
    chosen: Mapping[str, object],
    settings: tuple[str, ...],
    *,
    stated: Mapping[str, object] | None = None,
) -> None:
    """Import data and write a log whose metadata contains `stated` instead of the used parameters."""
    from fuselog.pipeline.output.outputs import check_files, imported
    from fuselog.recorders.log import open_log
    from fuselog.recorders.parameters import parse_settings
    from fuselog.recorders.recording import import_log
    from fuselog.replay.engine.streams.linting import lint_source, worst
    from fuselog.replay.engine.streams.sources import LogSource

    if len(paths) > 1 and source != "table":
        raise BadInput(f"{paths[1]}: {source} data are one file or folder; give only one path")
    target = out or Path(f"{source}.mcap")
    check_files([(target, imported(source))], {"data": paths})
    more = [str(path) for path in paths[1:]]
    given = {
        name: value for name, value in {**chosen, "more": more or None}.items() if value is not None
    }
    metadata, messages = import_log(source, paths[0], parse_settings(settings) | given, target, stated)
    for subject, fact in metadata.notes.items():
        click.echo(printable(f"{subject}: {fact}" if fact else subject))
    for sentence in worst(lint_source(LogSource(open_log(target)), portions=1), target):
        click.echo(printable(sentence))
    say_written(target, messages)


@contextmanager
def _guessed(paths: tuple[Path, ...], mapping: Path) -> Iterator[Path]:
    """Write a first mapping of tables, and print what it assumes.

    Yields the temporary path of the mapping; the mapping is moved to its final place only if no error
    occurs.
    """
    from fuselog.pipeline.output.outputs import MAPPING, check_files
    from fuselog.recorders.atomic import whole_file
    from fuselog.recorders.importers.tables.guessing import assumptions, guess

    check_files([(mapping, MAPPING)], {"data": paths})
    text = guess(paths)
    with whole_file(mapping) as new:
        new.write_text(text, encoding="utf-8")
        for sentence in assumptions(text):
            click.echo(printable(sentence))
        yield new


def say_written(path: Path, messages: int) -> None:
    """Print the path, message count and size of a new log, then a command to run next."""
    from fuselog.pipeline.output.terminal import say, say_next

    say(f"{path}: {messages} messages, {path.stat().st_size / 1e6:.1f} MB")
    say_next("info", str(path))
