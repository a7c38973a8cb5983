"""The command that makes goldens."""

import tempfile
from pathlib import Path

import click

from fuselog.pipeline.checking.discrepancies import discrepancies
from fuselog.pipeline.checking.stored import read, write
from fuselog.recorders.errors import choices
from tests.goldens import store
from tests.goldens.recipes import DATA, RECIPES, data_option, index, unpack


@click.command()
@click.argument("names", nargs=-1)
@data_option
def main(names: tuple[str, ...], data: Path) -> None:
    """Make the goldens NAMES anew, or all; what is no longer as it was is printed.

    An intended change of estimates comes with its goldens in the same commit.
    """
    for name in names:
        if name not in RECIPES:
            raise click.BadParameter(f"no golden '{name}'; {choices(name, RECIPES)}")
    with tempfile.TemporaryDirectory() as scratch:
        places = unpack(data, DATA, Path(scratch))
        for name in names or RECIPES:
            done, path = store.replayed(name, places), store.path_of(name)
            if path.exists():
                for each in discrepancies(read(path), done):
                    click.echo(each.sentence)
            write(path, store.kept(done.golden))
            click.echo(f"{path}: {path.stat().st_size / 1e3:.0f} kB")
    (store.FOLDER.parent / "README.md").write_text(index(), encoding="utf-8")


if __name__ == "__main__":
    main()
