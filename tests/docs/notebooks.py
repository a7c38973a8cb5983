"""`python -m tests.docs.notebooks` runs the notebooks and keeps what they print and draw."""

import tempfile
from pathlib import Path
from typing import Any

import nbclient
import nbformat

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def executed(path: Path) -> Any:
    """A notebook, run from top to bottom in an empty folder; raises where a cell does.

    Without the notices of what is compiled, which depend on what is in the cache.
    """
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        place = {"metadata": {"path": folder}}
        nbclient.NotebookClient(notebook, resources=place, record_timing=False).execute()
    for cell in notebook.cells:
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if not _is_notice(output)]
    return notebook


def _is_notice(output: Any) -> bool:
    lines = output.text.splitlines() if output.get("name") == "stderr" else [""]
    return all(line.startswith(("fuselog: compiling ", "fuselog: compiled ")) for line in lines)


def printed(notebook: Any) -> list[str]:
    """What the cells printed and gave, as text."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return [each.text if each.output_type == "stream" else each.data["text/plain"] for each in outputs]


if __name__ == "__main__":
    for each in NOTEBOOKS:
        nbformat.write(executed(each), each)
        print(each)
