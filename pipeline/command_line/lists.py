"""The commands that list scenarios, estimators, metrics, models and more."""

import click

from fuselog.pipeline.command_line.help import command
from fuselog.pipeline.command_line.options import MODEL, Name, json_option
from fuselog.recorders.errors import BadInput


def _listing(kind: str, text: str, example: str) -> click.Command:
    @command(text, f"fuselog {kind}s", f"fuselog {kind}s {example}", name=f"{kind}s")
    @click.argument("name", required=False, type=Name(f"{kind}s"))
    @json_option
    def listing(name: str | None, as_json: bool) -> None:
        _show(kind, name, as_json=as_json)

    return listing


def _show(kind: str, name: str | None, *, as_json: bool) -> None:
    if name is None and not as_json:
        from fuselog.pipeline.api.lists import show_list

        show_list(f"{kind}s")
    else:
        from fuselog.pipeline.api import catalog

        catalog.show(kind, name, as_json=as_json)


scenarios = _listing("scenario", "List what can be recorded or imported, or describe NAME.", "landmarks")
estimators = _listing("estimator", "List the estimators, or describe NAME.", "ekf")
metrics = _listing("metric", "List the metrics, or describe NAME.", "consistency")
experiments = _listing("experiment", "List the shipped experiments, or describe NAME.", "landmarks")


@command(
    "List the models and their methods, or describe NAME.",
    "fuselog models",
    "fuselog models robot",
    "fuselog models robot --formulas",
)
@click.argument("name", required=False, type=MODEL)
@click.option(
    "--formulas", is_flag=True, help="Print the formulas of NAME's functions and their derivatives."
)
@json_option
def models(name: str | None, formulas: bool, as_json: bool) -> None:
    """List the models and the methods that can estimate them, or describe NAME in full."""
    if formulas:
        from fuselog.pipeline.api.catalog import show_formulas

        show_formulas(name, as_json=as_json)
    else:
        _show("model", name, as_json=as_json)


@command(
    "Show, clear or fill the cache of compiled kernels.",
    "fuselog cache",
    "fuselog cache --clear",
    "fuselog cache --warm robot inertial:smoother:ekf",
)
@click.argument("pairs", nargs=-1, metavar="[MODEL[:METHOD]]...")
@click.option("--clear", is_flag=True, help="Remove the files that fuselog wrote to the cache.")
@click.option(
    "--warm",
    is_flag=True,
    help="Compile the kernels that the first replay of these models needs, on all cores.",
)
@json_option
def cache(pairs: tuple[str, ...], clear: bool, warm: bool, as_json: bool) -> None:
    """Show the size of the cache of compiled kernels and samples, which can be deleted safely.

    --warm compiles the kernels of the named models and methods. If a model is named without a method, it
    is compiled for ekf, ukf and smoother:ekf. If nothing is named, all models are compiled. --warm
    replays short recordings of scenarios that fit a model. A log with other sensors compiles its own
    kernels on its first replay, in 0.3 to 2 s.
    """
    if pairs and not warm:
        raise BadInput(f"fuselog cache {pairs[0]}: add --warm to compile it in advance")
    if clear and warm:
        raise BadInput("fuselog cache --clear --warm: give the options in two separate commands")
    if warm:
        from fuselog.pipeline.api.precompiling import show_precompiling

        show_precompiling(pairs, as_json=as_json)
        return
    from fuselog.pipeline.logs.information import show_cache

    show_cache(clear=clear, as_json=as_json)


@command(
    "Print the folder of fuselog_filter.h, for a compiler.",
    "fuselog header",
)
def header() -> None:
    """Print the folder of the header for filters of your own in C, C++ or Rust.

    cc -shared -fPIC -I "$(fuselog header)" mine.c -o mine.so
    """
    from fuselog.replay.foreign.native.library import HEADER

    click.echo(HEADER.parent)
