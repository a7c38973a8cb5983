"""For mkdocstrings: the examples in docstrings, which are doctests, become blocks of code."""

import re
from typing import Any

import griffe

_EXAMPLE = re.compile(r"^( *)>>> .*(?:\n\1\S.*)*(?:\n+\1>>> .*(?:\n\1\S.*)*)*", re.MULTILINE)


class Examples(griffe.Extension):
    """Fences every run of prompts and what they print."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Change the docstring of an object."""
        if obj.docstring:
            obj.docstring.value = _EXAMPLE.sub(r"```pycon\n\g<0>\n```", obj.docstring.value)
