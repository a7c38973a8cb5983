"""The page of `fuselog explore` in words: all that is on it, what its buttons say, and its errors."""

import re
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from pipeline.api.api import record
from pipeline.exploring import markup
from pipeline.exploring.newest import NewestFirst
from pipeline.exploring.session import open_session
from recorders.errors import BadInput
from tests.words.results import in_numbers


def in_words() -> Iterator[str]:
    """Yield a line per thing on the page of two filters, then what follows from what a person does."""
    from bokeh.document import Document

    from pipeline.exploring.page import Page

    source = record("landmarks", seed=3, duration_s=2.0, landmarks=4)
    document = Document()
    with (
        patch.object(NewestFirst, "ask", lambda _, work: work(lambda: False)),
        patch.object(document, "add_next_tick_callback", lambda act: act()),
        patch.object(markup, "SLOW_S", 1e9),
    ):
        page = Page(open_session(source, ["ekf", "ukf"]), document)
        yield from sorted(filter(None, {_line(each) for each in document.roots[0].references()}))
        said = {"said": page._sentences, "saved": page._saved, "head": page._head}
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
            ("command", page._command),
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


def _line(model: Any) -> str:
    """What is set of a thing on the page: numbers, words, and between what numbers its data are."""
    told = []
    for key, value in sorted(model.properties_with_values(include_defaults=False).items()):
        if key == "data":
            told += [f"{name} {in_numbers(column)}" for name, column in sorted(value.items())]
        elif isinstance(value, bool) or value is None:
            told.append(f"{key} {value}")
        elif isinstance(value, str | int | float):
            told.append(f"{key} {in_numbers([value]) if not isinstance(value, str) else _plain(value)}")
        elif isinstance(value, list | tuple | dict):
            told.append(f"{key} {_plain(str(value))}")
    return f"{type(model).__name__}: {', '.join(told)}" if told else ""


def _plain(text: str) -> str:
    """A text in one line, without what names things by chance."""
    return re.sub(r"\s+", " ", re.sub(r"\bp\d{4,}\b|id='[^']*'", "ID", text))
