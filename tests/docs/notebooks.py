"""`python -m tests.docs.notebooks` runs the notebooks and keeps what they print and draw."""

import ast
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import nbclient
import nbformat

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def executed(path: Path) -> Any:
    """Return a notebook, run from top to bottom in an empty folder; raises where a cell does.

    Without the notices of what is compiled, which depend on what is in the cache.
    """
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        place = {"metadata": {"path": folder}}
        nbclient.NotebookClient(notebook, record_timing=False, resources=place).execute()
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


def printed_here(path: Path) -> list[str]:
    """Run a notebook in this process, in the current folder; return what its cells print and give."""
    texts, names = list[str](), dict[str, Any]()
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type != "code":
            continue
        # without what speaks to the kernel, such as `%matplotlib inline`
        source = "\n".join(line for line in cell.source.splitlines() if not line.startswith("%"))
        tree, given = ast.parse(source), None
        *statements, last = tree.body
        with redirect_stdout(StringIO()) as out:
            if isinstance(last, ast.Expr):
                exec(compile(ast.Module(statements, []), "cell.py", "exec"), names)
                given = eval(compile(ast.Expression(last.value), "cell.py", "eval"), names)
            else:
                exec(compile(tree, "cell.py", "exec"), names)
        texts += filter(None, [out.getvalue()])
        if given is not None and not source.endswith(";"):
            texts.append(repr(given))
    return texts


if __name__ == "__main__":
    for each in NOTEBOOKS:
        nbformat.write(executed(each), each)
        print(each)
