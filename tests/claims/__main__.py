"""`make docs-claims`: run the experiments, keep their results, and make the pages' tables from them."""

import tempfile
from pathlib import Path

import click

from fuselog.pipeline.command_line import main as fuselog
from fuselog.pipeline.runs.experiment import load_experiment
from fuselog.pipeline.runs.inputs import shipped
from fuselog.recorders.errors import choices
from tests.claims import pages
from tests.goldens.recipes import DATA, data_option, importer_of, unpack


@click.group()
def main() -> None:
    """Results of the shipped experiments, and the pages that are made from them."""


@main.command()
@click.argument("names", nargs=-1)
@data_option
def run(names: tuple[str, ...], data: Path) -> None:
    """Run the experiments NAMES, or all; keep their results."""
    known = shipped("experiments")
    for name in names:
        if name not in known:
            raise click.BadParameter(f"no experiment '{name}'; {choices(name, known)}")
    with tempfile.TemporaryDirectory() as scratch:
        places = unpack(data, DATA, Path(scratch))
        for name in names or known:
            importer = importer_of(load_experiment(name, {}, {})[1])
            source = ["--data", str(places[importer])] if importer else []
            folder = Path(scratch) / "results" / name
            if fuselog(["run", name, "--logs", "0", "--out", str(folder), *source]) != 0:
                raise click.ClickException(f"{name}: its result stays as it was")
            click.echo(pages.store(folder))


@main.command()
def decide() -> None:
    """Decide the claims of all kept results anew, by the numbers that are kept; run nothing."""
    for name in pages.stored():
        pages.decide_anew(name)


@main.command()
def render() -> None:
    """Make what the pages say of results anew."""
    for path in pages.PAGES:
        page = path.read_text(encoding="utf-8")
        path.write_text(pages.rendered(page), encoding="utf-8")


if __name__ == "__main__":
    main()
