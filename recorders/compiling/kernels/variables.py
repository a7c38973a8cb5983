"""Search for the names in a function that need memory because their values differ between uses."""

import ast
from collections.abc import Sequence
from functools import cache

from fuselog.recorders.compiling.kinds import Value


class _Names(ast.NodeVisitor):
    """A visitor that lists assignments and uses of names in order, with their branches and loops."""

    def __init__(self) -> None:
        self.given: dict[str, list[tuple[tuple[Value, ...], int]]] = {}
        self.used: dict[str, list[tuple[tuple[Value, ...], int]]] = {}
        self._region: tuple[Value, ...] = ()
        self._order = 0

    def visit_Name(self, node: ast.Name) -> None:
        self._order += 1
        found = self.used if isinstance(node.ctx, ast.Load) else self.given
        found.setdefault(node.id, []).append((self._region, self._order))

    def visit_Assign(self, node: ast.Assign) -> None:
        for each in (node.value, *node.targets):
            self.visit(each)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self.visit(node.value)
        if isinstance(node.target, ast.Name):
            self.visit_Name(ast.Name(node.target.id, ast.Load()))
        self.visit(node.target)

    def visit_If(self, node: ast.If) -> None:
        self.visit(node.test)
        self.within((node, 0), node.body)
        self.within((node, 1), node.orelse)

    def visit_While(self, node: ast.While) -> None:
        self.within((node, 0), [node.test, *node.body])

    def visit_For(self, node: ast.For) -> None:
        self.visit(node.iter)
        self.within((node, 0), [node.target, *node.body])

    def visit_GeneratorExp(self, node: ast.GeneratorExp) -> None:
        own = {
            each.id
            for part in node.generators
            for each in ast.walk(part.target)
            if isinstance(each, ast.Name)
        }
        for each in ast.walk(node):
            if isinstance(each, ast.Name) and each.id not in own:
                self.visit_Name(each)

    def within(self, region: Value, nodes: Sequence[ast.AST]) -> None:
        """Visit the nodes in a branch or a loop."""
        before, self._region = self._region, (*self._region, region)
        for each in nodes:
            self.visit(each)
        self._region = before


@cache
def placed_names(definition: ast.FunctionDef) -> frozenset[str]:
    """Find the names that need memory: those assigned twice, or used where they may be unassigned."""
    names = _Names()
    for argument in ast.walk(definition.args):
        if isinstance(argument, ast.arg):
            names.given[argument.arg] = [((), 0)]
    for statement in definition.body:
        names.visit(statement)
    return frozenset(
        name for name, given in names.given.items() if _is_placed(given, names.used.get(name, []))
    )


def _is_placed(
    given: list[tuple[tuple[Value, ...], int]], used: list[tuple[tuple[Value, ...], int]]
) -> bool:
    """Test whether a use may see a value other than the one assigned directly before it."""
    for region, order in used:
        before = [each for each in given if each[1] < order]
        if not before or before[-1][0] != region[: len(before[-1][0])]:
            return True
        own = before[-1][0]
        for other, later in given:
            if later < order:
                continue
            shared = [mine for mine, its in zip(region, other, strict=False) if mine == its]
            if any(isinstance(each[0], ast.For | ast.While) and each not in own for each in shared):
                return True
    return False
