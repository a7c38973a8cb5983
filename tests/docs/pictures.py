"""`python -m tests.docs.pictures --data FOLDER [NAME ...]`: the gallery's pictures, of goldens' logs.

A Vulkan driver is needed, as for `fuselog view --screenshot`.
"""

import tempfile
from pathlib import Path

import click
from PIL import Image

from pipeline.experiment import shipped
from pipeline.replays import replay
from recorders.errors import choices
from replay.timeline.viewer import screenshot
from tests.docs.gallery import DOCS
from tests.goldens.recipes import DATA, RECIPES, data_option, first_log, unpack

WINDOW = (960, 600)
VIEWS = (0, 36, 960, 570)  # without the viewer's own bars


@click.command()
@click.argument("names", nargs=-1)
@data_option
def main(names: tuple[str, ...], data: Path) -> None:
    """Draw the first logs of the experiments NAMES, or of all that have some."""
    known = [name for name in shipped("experiments") if name in RECIPES and RECIPES[name].has_log]
    for name in names:
        if name not in known:
            raise click.BadParameter(f"no experiment '{name}' that has logs; {choices(name, known)}")
    with tempfile.TemporaryDirectory() as scratch:
        places = unpack(data, DATA, Path(scratch))
        for name in names or known:
            recipe, rrd, picture = (
                RECIPES[name],
                Path(scratch) / "timeline.rrd",
                Path(scratch) / "view.png",
            )
            replay(first_log(recipe, places), recipe.settings).view(save=rrd)
            for complaint in screenshot(rrd, picture, size=WINDOW):
                click.echo(f"{name}: {complaint}")
            with Image.open(picture) as image:
                image.crop(VIEWS).convert("RGB").quantize(128).save(
                    DOCS / "gallery" / f"{name}.png", optimize=True
                )
            click.echo(DOCS / "gallery" / f"{name}.png")


if __name__ == "__main__":
    main()
