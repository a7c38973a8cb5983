"""Comments and docstrings name what is there: modules, their names, classes and their fields, files.

What is looked at stands in backticks with a dot in it, or is a path. What begins with neither a module
nor a class is passed over; behind a variable of the same file must stand a field of some class.
"""

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from tests.house import sources
from tests.house.sources import ROOT, definitions_of, text_of, tree_of

PATHS = [path for path in sources.PATHS if path.parts[0] != "fuselog"]  # whose names are of others
DOTTED = re.compile(r"`([A-Za-z]\w*(?:\.[A-Za-z]\w*)+)(?:\(.*?\))?`")
PATH = re.compile(r"(?<![\w./])(?:recorders|replay|pipeline|tests|docs|data)/[\w./-]*\w")


def bound_in(statements: list[ast.stmt]) -> Iterator[str]:
    """The names that a module or a class binds itself."""
    for each in statements:
        match each:
            case ast.FunctionDef() | ast.ClassDef():
                yield each.name
            case ast.Assign() | ast.AnnAssign():
                targets = each.targets if isinstance(each, ast.Assign) else [each.target]
                for target in targets:
                    yield from (node.id for node in ast.walk(target) if isinstance(node, ast.Name))
            case ast.If() | ast.Try():
                yield from bound_in(each.body + each.orelse)
            case ast.ImportFrom():
                yield from (alias.asname or alias.name for alias in each.names)


@cache
def holders() -> dict[str, set[str]]:
    """What may stand behind a dot, by the last name of every module and by the name of every class."""
    found, bases = defaultdict[str, set[str]](set), defaultdict[str, set[str]](set)
    for path in PATHS:
        *above, module = path.with_suffix("").parts
        if above[:1] != ["fuselog"]:
            above.insert(0, "fuselog")
        if module == "__init__":
            *above, module = above
        for outer, inner in pairwise([*above, module]):
            found[outer].add(inner)
        for node in definitions_of(path):
            if isinstance(node, ast.Module):
                imports_count = path.name == "__init__.py"
                kept = [
                    each for each in node.body if imports_count or not isinstance(each, ast.ImportFrom)
                ]
                found[module] |= set(bound_in(kept))
            elif isinstance(node, ast.ClassDef):
                found[node.name] |= set(bound_in(node.body))
                found[node.name] |= {
                    inner.attr
                    for inner in ast.walk(node)
                    if isinstance(inner, ast.Attribute)
                    and isinstance(inner.value, ast.Name)
                    and inner.value.id == "self"
                }
                bases[node.name] |= {ast.unparse(base).partition("[")[0] for base in node.bases}
    fields = found["a variable"] = set[str]()
    for name in bases:
        fields |= found[name]
    for _ in range(4):  # the longest line of descent
        for name, above_it in bases.items():
            for base in above_it & set(bases):
                found[name] |= found[base]
    return dict(found)


def prose_of(path: Path) -> Iterator[str]:
    text = text_of(path)
    behind = "\n".join(line.partition("#")[2] for line in text.splitlines())
    if DOTTED.search(behind) or PATH.search(behind):  # few files: to take one apart takes long
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                yield token.string
    for node in definitions_of(path):
        yield ast.get_docstring(node) or ""


def is_there(dotted: str) -> bool:
    known = holders()
    first, second = dotted.split(".")[:2]
    if first == "fuselog" and second not in ("pipeline", "recorders", "replay"):
        return True  # a message, or a group of entry points
    for holder, name in pairwise(dotted.split(".")):
        if holder not in known or name == "NAME":  # a value, whose type is not known here
            return True
        if name not in known[holder]:
            return False
    return True


def variables_of(path: Path) -> set[str]:
    nodes = list(ast.walk(tree_of(path)))
    variables = {node.id for node in nodes if isinstance(node, ast.Name)}
    variables |= {node.arg for node in nodes if isinstance(node, ast.arg)}
    return variables - {node.name for node in nodes if isinstance(node, ast.ClassDef | ast.alias)}


def missing_from(path: Path, text: str) -> list[str]:
    """The names in a text that lead nowhere."""
    missing = [each for each in PATH.findall(text) if not (ROOT / each).exists()]
    if dotted := [each for each in DOTTED.findall(text) if not is_there(each)]:
        variables, fields = variables_of(path), holders()["a variable"]
        missing += [
            each
            for each in dotted
            if not (each.split(".")[0] in variables and each.split(".")[1] in fields)
        ]
    return missing


@pytest.mark.paper
def test_what_is_named_is_there() -> None:
    missing = {str(path): missing_from(path, "\n".join(prose_of(path))) for path in PATHS}
    assert not {path: names for path, names in missing.items() if names}


def test_every_attribute_that_is_described_is_one() -> None:
    for path in PATHS:
        for node in definitions_of(path):
            if isinstance(node, ast.ClassDef):
                _, _, section = (ast.get_docstring(node) or "").partition("\nAttributes:\n")
                section = section.partition("\n\n")[0]
                for names in re.findall(r"^    (\w[\w, ]*):", section, re.MULTILINE):
                    for name in names.split(", "):
                        assert name in holders()[node.name], f"{path}: {node.name} has no {name}"


@pytest.mark.parametrize(
    "text",
    [
        "see `fuselog.replay.inference.steps.reading`",
        "see `steps.taking_in`",
        "see `Stream.colums`",
        "see replay/inference/steps.py",
    ],
)
def test_what_has_moved_is_found(text: str) -> None:
    assert missing_from(Path("replay/inference/run/recursion.py"), text)
