"""`python -m tests.docs.notebooks` runs the notebooks and keeps what they print and draw."""

import tempfile
from pathlib import Path
from typing import Any

import nbclient
import nbformat

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def executed(path: Path) -> Any:
    """A notebook, run from top to bottom in an empty folder; raises where a cell does."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        place = {"metadata": {"path": folder}}
        nbclient.NotebookClient(notebook, resources=place, record_timing=False).execute()
    return notebook


def printed(notebook: Any) -> list[str]:
    """What the cells printed and gave, as text."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return [each.text if each.output_type == "stream" else each.data["text/plain"] for each in outputs]


if __name__ == "__main__":
    for each in NOTEBOOKS:
        nbformat.write(executed(each), each)
        print(each)
