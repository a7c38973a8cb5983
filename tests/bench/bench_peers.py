"""The programs on the pages for users of other tools: the peer's and ours, with how far they are apart.

Needs the extra `bench`. Run it with `make bench`, or `python -m tests.bench peers`.
"""

import re
import shlex
import tempfile
from contextlib import chdir, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fuselog.pipeline.command_line.process import main as fuselog

DOCS = Path(__file__).parents[2] / "docs"
PEERS = {"from-filterpy": "FilterPy", "from-stone-soup": "Stone Soup", "from-evo": "evo"}
_PROGRAM = re.compile(r"^```(python|sh)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Row(NamedTuple):
    """The largest number that both programs give, and the largest difference."""

    what: str
    ours: float
    theirs: float
    difference: float


def main() -> list[Row]:
    """A row for each page."""
    return [compared(page, peer) for page, peer in PEERS.items()]


def compared(page: str, peer: str) -> Row:
    """Run all that a page shows; its last numbers are `ours` and `theirs`."""
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, chdir(folder), redirect_stdout(StringIO()):
        for language, text in _PROGRAM.findall((DOCS / f"{page}.md").read_text(encoding="utf-8")):
            if language == "python":
                exec(text, names)
            else:
                run(text)
    ours, theirs = (np.abs(np.asarray(names[name])).max() for name in ("ours", "theirs"))
    apart = np.abs(names["ours"] - np.asarray(names["theirs"])).max()
    return Row(f"{page}: largest number; {peer}, and the largest difference", ours, theirs, apart)


def run(text: str) -> None:
    """Run the commands of a block."""
    for line in re.findall(r"^fuselog (.*)$", text.replace("\\\n", " "), re.MULTILINE):
        if code := fuselog(shlex.split(line)):
            raise SystemExit(code)
