"""Conditions on the columns of a catalog, such as `fix_rate_hz > 4 and duration_s > 60`.

A condition may come from someone else, so it is parsed, and evaluated only if it consists of comparisons
of columns with numbers and texts. Calls, attributes, subscripts and powers are refused.
"""

import ast
from typing import TYPE_CHECKING

from fuselog.recorders.errors import BadInput, choices

if TYPE_CHECKING:
    import pandas as pd

EXAMPLE = '"fix_rate_hz > 4 and duration_s > 60"'
ALLOWED = (
    *(ast.Expression, ast.BoolOp, ast.And, ast.Or, ast.UnaryOp, ast.Not, ast.USub, ast.Compare, ast.Lt),
    *(ast.LtE, ast.Gt, ast.GtE, ast.Eq, ast.NotEq, ast.In, ast.NotIn, ast.BinOp, ast.Add, ast.Sub),
    *(ast.Mult, ast.Div, ast.Name, ast.Load, ast.Constant, ast.List, ast.Tuple),
)
CONSTANTS = (bool, int, float, str)
LONGEST = 10_000  # characters of a condition


def rows_where(table: "pd.DataFrame", condition: str) -> "pd.DataFrame":
    """Select the rows of a table that meet a condition; a missing value meets no comparison.

    The row of a log with a problem stays if the condition names a column that is unknown for this log.

    Raises BadInput if the condition has a typo, an unknown column, or anything except comparisons.
    """
    import pandas as pd

    tree = _parsed(condition)
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id not in table:
            known = [str(name) for name in table]
            raise BadInput(f"--where: no column '{node.id}' in the catalog; {choices(node.id, known)}")
        if isinstance(node, ast.Name) and table[node.id].map(pd.api.types.is_list_like).any():
            raise BadInput(
                f"--where: the column {node.id} contains lists; compare columns of a single topic or "
                "model, such as fix_messages and fits_robot"
            )
    for node in reversed([*ast.walk(tree)]):
        _check_kinds(node, table, condition)
    try:
        found = table.eval(ast.unparse(tree), engine="python")
    except RecursionError:
        raise BadInput(f"--where {condition[:200]}: has too many parts; shorten it") from None
    except (TypeError, ValueError, AttributeError, NotImplementedError, ArithmeticError) as error:
        raise BadInput(
            f"--where {condition}: these values cannot be compared ({error}); compare numbers with "
            "numbers and texts with texts"
        ) from None
    if not isinstance(found, pd.Series) or not pd.api.types.is_bool_dtype(found):
        raise BadInput(f"--where {condition}: is not a comparison; write one, such as {EXAMPLE}")
    named = [node.id for node in ast.walk(tree) if isinstance(node, ast.Name)]
    is_unknown = table["problem"].notna() & table[named].isna().any(axis="columns")
    return table[found.fillna(False).astype(bool) | is_unknown]


def _parsed(condition: str) -> ast.Expression:
    """Parse a condition; raise BadInput if it contains anything except comparisons of columns."""
    try:
        if len(condition) > LONGEST:
            raise ValueError(f"longer than {LONGEST} characters")
        tree = ast.parse(condition.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        why = error.msg if isinstance(error, SyntaxError) else error
        raise BadInput(
            f"--where {condition[:200]}: cannot be parsed ({why}); compare columns with values, such as "
            f"{EXAMPLE}"
        ) from None
    for node in ast.walk(tree):
        is_value = not isinstance(node, ast.Constant) or isinstance(node.value, CONSTANTS)
        if not isinstance(node, ALLOWED) or not is_value:
            raise BadInput(
                f"--where {condition}: {type(node).__name__} is not allowed; use columns, numbers, "
                "texts, comparisons, in, and, or, not, + - * /"
            )
    return tree


def _check_kinds(node: ast.AST, table: "pd.DataFrame", condition: str) -> None:
    """Raise BadInput if a part of a condition combines values that pandas would misunderstand."""
    why = ""
    if isinstance(node, ast.BinOp):  # a text times a number could fill the memory
        sides = [side for side in (node.left, node.right) if _kind(side, table) not in ("number", "")]
        why = f"{ast.unparse(sides[0])} is not a number" if sides else ""
        if not why and _largest(node, table) >= 1 << 63:
            why = "its numbers exceed 64 bits; write one of them with a decimal point"
    elif isinstance(node, ast.BoolOp | ast.UnaryOp) and not isinstance(node.op, ast.USub):
        for side in (each for each in ast.iter_child_nodes(node) if isinstance(each, ast.expr)):
            is_flag = isinstance(side, ast.Name) and table[side.id].dtype in ("bool", "boolean")
            if not (is_flag or _kind(side, table) == "condition"):
                why = f"{ast.unparse(side)} is not a comparison"
    elif isinstance(node, ast.Compare):
        lists = [isinstance(side, ast.List | ast.Tuple) for side in (node.left, *node.comparators)]
        if lists != [False, *(isinstance(each, ast.In | ast.NotIn) for each in node.ops)]:
            why = "after `in`, and only there, write a list, such as folder in ['a', 'b']"
        values = [
            each for side in (node.left, *node.comparators) for each in getattr(side, "elts", [side])
        ]
        if len({_kind(each, table) for each in values} - {""}) > 1:
            why = "these values cannot be compared; compare numbers with numbers and texts with texts"
    if why:
        raise BadInput(f"--where {condition}: {why}")


def _kind(node: ast.AST, table: "pd.DataFrame") -> str:
    """Return the kind of an expression's value, or an empty text for a column without values."""
    import pandas as pd

    if isinstance(node, ast.Constant):
        return "text" if isinstance(node.value, str) else "number"
    if isinstance(node, ast.Name):
        column = table[node.id]
        is_number = pd.api.types.is_numeric_dtype(column)
        return "number" if is_number else "text" if column.notna().any() else ""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return _kind(node.operand, table)
    return "number" if isinstance(node, ast.BinOp) else "condition"


def _largest(node: ast.AST, table: "pd.DataFrame") -> float:
    """Return a bound on the size of an integer expression; 0 if it is computed with decimals."""
    import pandas as pd

    if isinstance(node, ast.BinOp):
        sides = _largest(node.left, table), _largest(node.right, table)
        if isinstance(node.op, ast.Div) or not all(sides):
            return 0
        return sides[0] * sides[1] if isinstance(node.op, ast.Mult) else sum(sides)
    if isinstance(node, ast.UnaryOp):
        return _largest(node.operand, table)
    if isinstance(node, ast.Name) and pd.api.types.is_integer_dtype(table[node.id]):
        return int(table[node.id].abs().max() or 1) if table[node.id].notna().any() else 1
    value = getattr(node, "value", 0.0)
    return max(abs(value), 1) if isinstance(value, int) else 0
