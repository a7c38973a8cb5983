"""`python -m tests.docs.notebooks` runs the notebooks and keeps what they print and draw."""

import tempfile
from pathlib import Path
from typing import Any

import nbclient
import nbformat

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def executed(*paths: Path, before: str = "") -> list[Any]:
    """Notebooks, run from top to bottom, each in an empty folder; raises where a cell does.

    One kernel runs all, and code `before` them; it forgets every name between two. Without the
    notices of what is compiled, which depend on what is in the cache.
    """
    all_in_one = nbformat.v4.new_notebook()
    all_in_one.cells.append(nbformat.v4.new_code_cell(before))
    notebooks = [nbformat.read(path, as_version=4) for path in paths]
    with tempfile.TemporaryDirectory() as folder:
        for path, notebook in zip(paths, notebooks, strict=True):
            place = Path(folder, path.stem)
            place.mkdir()
            apart = nbformat.v4.new_code_cell(f"%reset -f\nimport os\nos.chdir({str(place)!r})\ndel os")
            all_in_one.cells += [apart, *notebook.cells]
        nbclient.NotebookClient(all_in_one, record_timing=False).execute()
    for cell in (cell for notebook in notebooks for cell in notebook.cells):
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if not _is_notice(output)]
    return notebooks


def _is_notice(output: Any) -> bool:
    lines = output.text.splitlines() if output.get("name") == "stderr" else [""]
    return all(line.startswith(("fuselog: compiling ", "fuselog: compiled ")) for line in lines)


def printed(notebook: Any) -> list[str]:
    """What the cells printed and gave, as text."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return [each.text if each.output_type == "stream" else each.data["text/plain"] for each in outputs]


if __name__ == "__main__":
    for each in NOTEBOOKS:
        nbformat.write(*executed(each), each)
        print(each)
