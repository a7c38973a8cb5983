"""What a function prints, as lines."""

import io
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from typing import Any


def printed(function: Callable[..., Any], *arguments: Any) -> Iterator[str]:
    """The lines that a function prints to standard output, set in by two."""
    out = io.StringIO()
    with redirect_stdout(out):
        function(*arguments)
    yield from (f"  {line}".rstrip() for line in out.getvalue().splitlines())
