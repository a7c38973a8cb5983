"""`python -m tests.docs.first_views [NAME ...]`: the pictures of docs/scenarios.md.

Each is the first view after the commands that the page has below the scenario's name. A Vulkan driver is
needed, as for `fuselog view --screenshot`.
"""

import re
import shlex
import tempfile
from contextlib import chdir
from pathlib import Path

import click
from PIL import Image

from fuselog.pipeline.command_line import main as fuselog
from fuselog.recorders.errors import choices
from tests.docs.gallery import DOCS

PAGE = DOCS / "scenarios.md"
PICTURES = DOCS / "scenarios"
SIZE = (1200, 750)


def sections() -> dict[str, str]:
    """The page's text by scenario."""
    _, *parts = re.split(r"^## (\S+)\n", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def draw(name: str, section: str) -> None:
    """Run a scenario's commands, and keep the first view of the estimates."""
    for file, text in re.findall(
        r'^```toml title="(.*?)"\n(.*?)^```$', section, re.DOTALL | re.MULTILINE
    ):
        Path(file).write_text(text, encoding="utf-8")
    lines = re.findall(r"^fuselog (.*)$", section, re.MULTILINE)
    for line in [*lines, "view estimates.mcap --screenshot view.png"]:
        if code := fuselog(shlex.split(line)):
            raise SystemExit(code)
    place = PICTURES / f"{name}.webp"
    with Image.open("view.png") as image:
        image.convert("RGB").resize(SIZE, Image.Resampling.LANCZOS).save(place, quality=60, method=6)
    click.echo(f"{name}: {place}")


@click.command()
@click.argument("names", nargs=-1)
def main(names: tuple[str, ...]) -> None:
    """Draw the first views of the scenarios NAMES, or of all."""
    found = sections()
    for name in names:
        if name not in found:
            raise click.BadParameter(f"no scenario '{name}' on the page; {choices(name, found)}")
    for name in names or found:
        with tempfile.TemporaryDirectory() as folder, chdir(folder):
            draw(name, found[name])


if __name__ == "__main__":
    main()
