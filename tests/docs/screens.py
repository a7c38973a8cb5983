"""`python -m tests.docs.screens [NAME ...]`: pictures of report and explorer, light and dark.

They lie in docs/figures. Chromium is needed, as for tests that open a page. They show the same again,
of the same seeds, but for what estimators cost on this machine.
"""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any

import click
from PIL import Image

import fuselog as fl
from fuselog.pipeline.command_line import main as fuselog
from tests.docs.gallery import DOCS

SCHEMES = ("light", "dark")
SIZE = {"width": 1280, "height": 900}
MOST_BYTES = 200_000
# A run as docs/start.md has it: the EKF's range noise is stated too small.
RUN = "run landmarks --runs 20 --set ekf.sigma_range_m=0.025 --diagnose --out result"
PINNED_M, DRAGGED_M = 0.025, 0.043  # of the range noise, as docs/explore.md says
SET = "([name, place]) => { Bokeh.documents[0].get_model_by_name(name).value = place; }"


def draw_report() -> None:
    """The first screen of a report on an EKF that is too sure of itself."""
    for words in (RUN, "report result -o report.html"):
        if code := fuselog(words.split()):
            raise SystemExit(code)
    for scheme in SCHEMES:
        with _page(scheme) as page:
            page.goto(Path("report.html").resolve().as_uri())
            page.wait_for_selector(".js-plotly-plot")
            _save(page, "report", scheme)


def draw_explorer() -> None:
    """One range noise pinned, another dragged to."""
    log = Path("run.mcap")
    fl.write(log, fl.record("landmarks", seed=7, duration_s=60.0))
    for scheme in SCHEMES:
        explorer = fl.explore(log, "ekf", show=False)
        slider = explorer.session.slider("sigma_range_m")
        with _page(scheme) as page:
            page.goto(explorer.url)
            page.wait_for_selector("text=No problem found.")
            page.evaluate(SET, [slider.name, slider.place(PINNED_M)])
            page.wait_for_selector("text=Overconfident.")
            page.get_by_text("Pin", exact=True).click()
            page.evaluate(SET, [slider.name, slider.place(DRAGGED_M)])
            page.wait_for_selector(f"text={slider.words(DRAGGED_M)}")
            page.wait_for_timeout(3000)  # the likelihood comes last
            _save(page, "explore", scheme)
        explorer.close()


@contextmanager
def _page(scheme: str) -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser.new_page(viewport=SIZE, color_scheme=scheme)
        browser.close()


def _save(page: Any, name: str, scheme: str) -> None:
    place = DOCS / "figures" / f"{name}-{scheme}.webp"
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "page.png"
        page.screenshot(path=picture)
        with Image.open(picture) as image:
            image.convert("RGB").save(place, quality=80, method=6)
    if place.stat().st_size > MOST_BYTES:
        raise SystemExit(f"{place}: is larger than {MOST_BYTES} bytes")
    click.echo(place)


@click.command()
@click.argument("pages", nargs=-1, type=click.Choice(["report", "explore"]))
def main(pages: tuple[str, ...]) -> None:
    """Draw PAGES, or both."""
    draws = {"report": draw_report, "explore": draw_explorer}
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        for name in pages or draws:
            draws[name]()


if __name__ == "__main__":
    main()
