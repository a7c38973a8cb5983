"""`python -m tests.docs.many_views`: pictures of many runs in the viewer, for docs/many-runs.md.

They are the table of runs and a scene with two versions of an estimator. A Vulkan driver is needed, as
for `fuselog view --screenshot`.
"""

import tempfile
from contextlib import chdir
from pathlib import Path

import click
from PIL import Image

from fuselog.pipeline.command_line import main as fuselog
from tests.docs.gallery import DOCS

WIDTH = 1200
COMMANDS = {
    "runs-table": (
        "run landmarks --runs 200 --out landmarks",
        "view landmarks --runs worst:20 --screenshot picture.png",
    ),
    "two-versions": (
        "record landmarks --seed 7 --set duration_s=60 -o logs/run.mcap",
        "replay logs/run.mcap -e ekf --set sigma_range_m=1",
        "replay logs/run.mcap -e ekf -o logs/tuned.estimates.mcap",
        "view logs --runs run --screenshot picture.png --at 40",
    ),
}


def main() -> None:
    """Draw both pictures."""
    for name, commands in COMMANDS.items():
        place = DOCS / "figures" / f"{name}.webp"
        with tempfile.TemporaryDirectory() as folder, chdir(folder):
            Path("logs").mkdir()
            for command in commands:
                if code := fuselog(command.split()):
                    raise SystemExit(code)
            with Image.open("picture.png") as image:
                height = round(WIDTH * image.height / image.width)
                image.convert("RGB").resize((WIDTH, height)).save(place, quality=80, method=6)
        click.echo(place)


if __name__ == "__main__":
    main()
