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
                f"--where: the column {node.id} has lists; compare those of a topic or model, such as "
                "fix_messages and fits_robot"
            )
        if isinstance(node, ast.BinOp):  # a text times a number could fill the memory
            for side in (node.left, node.right):
                is_text = isinstance(side, ast.Name) and not pd.api.types.is_numeric_dtype(
                    table[side.id]
                )
                if is_text or not isinstance(getattr(side, "value", 0), int | float):
                    raise BadInput(f"--where {condition}: {ast.unparse(side)} is not a number")
    try:
        found = table.eval(ast.unparse(tree), engine="python")
    except (TypeError, ValueError, AttributeError, NotImplementedError, OverflowError) as error:
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
