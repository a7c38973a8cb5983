"""What the page of `fuselog explore` says when a person moves, presses and errs."""

import re
from collections.abc import Iterator
from html import unescape
from importlib.util import find_spec
from types import SimpleNamespace
from unittest.mock import patch

from fuselog.pipeline.api.api import record
from fuselog.pipeline.exploring.session import open_session
from fuselog.recorders.errors import BadInput


def pressed() -> Iterator[str]:
    """What follows from what a person does on the page of two filters."""
    if find_spec("bokeh") is None:
        return
    from bokeh.document import Document

    from fuselog.pipeline.exploring import widgets
    from fuselog.pipeline.exploring.page import NewestFirst, Page

    source = record("landmarks", seed=3, duration_s=2.0, landmarks=4)
    document = Document()
    with (
        patch.object(NewestFirst, "ask", lambda _, work: work(lambda: False)),
        patch.object(document, "add_next_tick_callback", lambda act: act()),
        patch.object(widgets, "SLOW_S", 1e9),
    ):
        page = Page(open_session(source, ["ekf", "ukf"]), document)
        said = {"said": page._sentences, "saved": page._saved, "head": page._head}
        said["command"] = page._command
        said["lens"] = page.plots["lens"].figure.title
        page._pin()
        sigma, bias = (page._widgets[name][1] for name in ("sigma_range_m", "bias_range_m"))
        for name, act in (
            ("pointer", lambda: page._move_cursor(SimpleNamespace(x=0.5))),
            ("a smaller sigma", lambda: setattr(sigma, "value", 0.25)),
            ("tune", page._tune),
            ("estimate a noise", page._estimate),
            ("a bias", lambda: setattr(bias, "value", 0.6)),
            ("estimate a bias", page._estimate),
            ("no longer", page._estimate),
            ("toml", page._save),
            ("reset", page._reset),
            ("bad input", lambda: page._say_error(BadInput("no such log"))),
            ("failure", lambda: page._say_error(ValueError("no such log"))),
        ):
            before = {place: div.text for place, div in said.items()}
            act()
            for place, div in said.items():
                if div.text != before[place]:
                    yield f"{name}: {place}: {_plain(div.text)}"
        page.end()


def _plain(text: str) -> str:
    """A text in one line, without its markup."""
    return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]*>", " ", text))).strip()


EXPLORED = (pressed,)
