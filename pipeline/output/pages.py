"""HTML from Jinja2 templates, for the report, the page of `explore`, and notebooks."""

from collections.abc import Mapping
from typing import Any
from unicodedata import category

from jinja2 import Environment, PackageLoader, select_autoescape

from fuselog.recorders.errors import printable


def templates(package: str, filters: Mapping[str, Any]) -> Environment:
    """Open the templates of a package. The templates can use these filters, and escape all text."""
    environment = Environment(
        loader=PackageLoader(package, "."),
        autoescape=select_autoescape(),
        finalize=_visible,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= filters
    return environment


def _visible(value: object) -> object:
    """Replace control characters of a text by their codes, everywhere on the page."""
    if not isinstance(value, str) or value.isprintable():
        return value
    hidden = {each for each in {*value} - {*"\n\t"} if not each.isprintable() and category(each) != "Zs"}
    return value.translate({ord(each): printable(each) for each in hidden}) if hidden else value
