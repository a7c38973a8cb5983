"""Gives the files of the product, each read and parsed once for all tests of the house."""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
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
    return ast.parse(text_of(path))


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    return list(ast.walk(tree_of(path)))
