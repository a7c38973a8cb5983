"""The models that the pages build, with the logs that they record: they deploy as they stand there."""

import json
import re
import sys
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

import fuselog as fl

DOCS = Path(__file__).parents[2] / "docs"


class OwnModel(NamedTuple):
    """Holds a model of a page, a log of it, and settings beside the method."""

    name: str
    model: Any
    log: Path
    settings: dict[str, Any]


def own_models(folder: Path) -> Iterator[OwnModel]:
    """Run the code of the pages that builds models and logs, in a folder."""
    page = _python_of("your-model")
    swung = _run(page[:2], folder)
    log = folder / "pendulum.mcap"
    yield OwnModel("pendulum", swung["PENDULUM"], log, {})
    [augmented] = [each for each in page if "with_length = " in each]
    with_length = _run([augmented.splitlines()[0]], folder)["with_length"]
    yield OwnModel("pendulum with its length", swung["PENDULUM"], log, with_length)
    notebook = json.loads((DOCS / "notebooks/own-model.ipynb").read_text(encoding="utf-8"))
    code = ["".join(each["source"]) for each in notebook["cells"] if each["cell_type"] == "code"]
    fallen = _run(code[:2], folder)
    yield OwnModel("ball", fallen["BALL"], folder / "fall-0.mcap", {})
    radio = _run(_python_of("your-estimator"), folder)
    log = folder / "walker.mcap"
    heard = radio["simulate"](radio["BeaconsParameters"](), np.random.default_rng(1))
    fl.write(log, heard.streams)
    yield OwnModel("walker", radio["WALKER"], log, {})


def _python_of(page: str) -> list[str]:
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    return re.findall(r"^```python[^\n]*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def _run(blocks: list[str], folder: Path) -> dict[str, Any]:
    """Run code as a module of its own, in a folder."""
    module = ModuleType("of_a_page")
    sys.modules[module.__name__] = module
    with chdir(folder), redirect_stdout(StringIO()):
        for block in blocks:
            exec(block, vars(module))
    return vars(module)
