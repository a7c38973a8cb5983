"""`python -m tests.docs.pictures --data FOLDER [NAME ...]`: the gallery's pictures, of goldens' logs.

A Vulkan driver is needed, as for `fuselog view --screenshot`.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path

import click
from PIL import Image

from fuselog.pipeline.api.api import record
from fuselog.pipeline.api.replays import replay
from fuselog.pipeline.diagnosing.diagnosis import diagnose
from fuselog.pipeline.runs.inputs import shipped
from fuselog.recorders.errors import choices
from fuselog.replay.timeline.viewer import screenshot
from tests.docs.gallery import DOCS
from tests.goldens.recipes import DATA, RECIPES, data_option, first_log, unpack

WINDOW = (960, 564)
VIEWS = (0, 0, 960, 534)  # without the time panel


def draw(name: str, places: Mapping[str, Path], rrd: Path) -> None:
    """Write the timeline of an experiment's first log; of diagnoses, that of docs/diagnose.md."""
    if name == "diagnosis":
        fault = {"bias_bearing_rad": 0.035}
        diagnose(record("landmarks", seed=7, range_bearing=fault), "ekf").view(save=rrd)
    else:
        replay(first_log(RECIPES[name], places), RECIPES[name].settings).view(save=rrd)


@click.command()
@click.argument("names", nargs=-1)
@data_option
def main(names: tuple[str, ...], data: Path) -> None:
    """Draw the first logs of the experiments NAMES, or of all that have some."""
    drawn = {"diagnosis", *(name for name, recipe in RECIPES.items() if recipe.has_log)}
    known = [name for name in shipped("experiments") if name in drawn]
    for name in names:
        if name not in known:
            raise click.BadParameter(f"no experiment '{name}' that has logs; {choices(name, known)}")
    with tempfile.TemporaryDirectory() as scratch:
        places = unpack(data, DATA, Path(scratch))
        rrd, picture = Path(scratch) / "timeline.rrd", Path(scratch) / "view.png"
        for name in names or known:
            draw(name, places, rrd)
            for complaint in screenshot(rrd, picture, size=WINDOW):
                click.echo(f"{name}: {complaint}")
            card = DOCS / "gallery" / f"{name}.png"
            with Image.open(picture) as image:
                image.crop(VIEWS).convert("RGB").quantize(128).save(card, optimize=True)
            click.echo(card)


if __name__ == "__main__":
    main()
