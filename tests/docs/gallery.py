"""The gallery: a card for every shipped experiment, with its picture, its command and its page."""

import re
from functools import cache
from pathlib import Path

import fuselog as fl
from fuselog.pipeline.api.catalog import Entry

DOCS = Path(__file__).parents[2] / "docs"
HEAD = """---
hide: [navigation, toc]
---

# Gallery

All experiments of fuselog. Each picture is the timeline of the experiment's first run, or its figure,
and links to the page that explains it.

<div class="grid cards gallery" markdown>

"""


@cache
def gallery() -> str:
    """The text of the page."""
    return HEAD + "\n".join([_card(each) for each in fl.experiments.values()]) + "\n</div>\n"


def page_of(experiment: str) -> Path:
    """The page that has an experiment's results, or its command: those of families first."""
    told = re.compile(rf"\{{{experiment}[.\[]|fuselog run ([\w. -]* )?{experiment}(?![\w-])")
    pages = [*sorted((DOCS / "families").glob("*.md")), *sorted(DOCS.glob("*.md"))]
    return next(page for page in pages if told.search(page.read_text(encoding="utf-8")))


def picture_of(experiment: str) -> Path | None:
    """Its first run, which `tests.docs.pictures` draws, its figure, or the first of its page, if any."""
    page = page_of(experiment)
    shown = re.findall(r"!\[.*?\]\((.*?)\)", page.read_text(encoding="utf-8"))
    of_run, figure = DOCS / "gallery" / f"{experiment}.png", DOCS / "figures" / f"{experiment}.svg"
    of_page = [(page.parent / each).resolve() for each in shown]
    return next((path for path in (of_run, figure, *of_page) if path.exists()), None)


def _card(entry: Entry) -> str:
    page, picture = page_of(entry.name).relative_to(DOCS).as_posix(), picture_of(entry.name)
    shown = "" if picture is None else _shown(entry, picture.relative_to(DOCS).as_posix(), page)
    command = f"fuselog run {entry.name}" + (" --data FOLDER" if "imports" in entry.facts else "")
    return f"-   {shown}**[{entry.name}]({page})**\n\n    {entry.what}\n\n    `{command}`\n"


def _shown(entry: Entry, picture: str, page: str) -> str:
    return f"[![{entry.name}: {entry.what}]({picture}){{ loading=lazy }}]({page})\n\n    "
