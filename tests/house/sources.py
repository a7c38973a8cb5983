"""Gives the files of the product, each read and parsed once for all tests of the house."""

import ast
import gc
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
Definition = ast.Module | ast.ClassDef | ast.FunctionDef
PATHS = [
    path.relative_to(ROOT)
    for room in ("fuselog", "pipeline", "recorders", "replay")
    for path in sorted((ROOT / room).rglob("*.py"))
]


@cache
def text_of(path: Path) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


@cache
def tree_of(path: Path) -> ast.Module:
    """The parsed file; visited by garbage collection again and again, trees would take far longer."""
    tree = ast.parse(text_of(path))
    gc.freeze()
    return tree


@cache
def definitions_of(path: Path) -> list[Definition]:
    """The module, its classes and functions, and theirs."""
    return list(definitions_in(tree_of(path)))


def definitions_in(node: ast.AST) -> Iterator[Definition]:
    """A node and what is defined in it. Definitions are in blocks of statements alone."""
    if isinstance(node, Definition):
        yield node
    for block in ("body", "handlers", "orelse", "finalbody", "cases"):
        for each in getattr(node, block, ()):
            yield from definitions_in(each)
