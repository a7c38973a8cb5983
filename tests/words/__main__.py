"""Keep the texts anew: `python -m tests.words --update`."""

import tempfile
from pathlib import Path

import click

from tests.words import texts
from tests.words.everything import everything


@click.command()
@click.option(
    "--update", is_flag=True, help="Keep what is said now; look at the diff before you commit."
)
def main(*, update: bool) -> None:
    """Print in what words differ from those that are kept."""
    with tempfile.TemporaryDirectory() as folder:
        found = everything(Path(folder))
    for path in sorted(texts.FOLDER.glob("*.txt")):
        if update and path.stem not in found:
            path.unlink()
    for command, text in found.items():
        path = texts.path_of(command)
        told = texts.differences(path.read_text(encoding="utf-8") if path.exists() else "", text)
        click.echo(told, nl=bool(told))
        if update and told:
            path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
