"""How many parameters functions may have, and what every package opens with.

Functions with more parameters are listed here; the list can only shrink.
"""

import ast
import re
from pathlib import Path

from tests.house.sources import PATHS, ROOT, text_of, tree_of

FILES = {path.as_posix(): text_of(path) for path in PATHS}
PARAMETERS = 8

# Functions of more parameters: what the door offers by keyword, commands and what they call, and others.
WIDER = {
    "pipeline/api/api.py": {"run", "sweep"},
    "pipeline/api/planning.py": {"plan_replay"},
    "pipeline/api/replays.py": {"replay"},
    "pipeline/api/trajectories.py": {"evaluate"},
    "pipeline/checking/command.py": {"check_path"},
    "pipeline/command_line/commands.py": {
        "evaluate_logs",
        "evaluate_trajectory",
        "replay_logs",
        "view_path",
    },
    "pipeline/command_line/experiment_commands.py": {"run_named", "sweep_named"},
    "pipeline/comparing/command.py": {"compare_candidates"},
    "pipeline/comparing/comparing.py": {"compare"},
    "pipeline/diagnosing/command.py": {"diagnose_log"},
    "pipeline/runs/ensemble.py": {"replay_parts"},
    "pipeline/stressing/command.py": {"stress_logs"},
    "pipeline/tuning/command.py": {"tune_logs"},
    "pipeline/tuning/tuning.py": {"tune"},
    "replay/engine/api/functions.py": {"batch", "recursive"},
}


def parameters_of(function: ast.FunctionDef) -> int:
    """How many parameters a function has, beside `self`."""
    given = function.args
    named = [each.arg for each in [*given.posonlyargs, *given.args, *given.kwonlyargs]]
    return len([each for each in named if each not in ("self", "cls")])


def functions_of(tree: ast.Module) -> list[ast.FunctionDef]:
    """Functions and methods; kernels are made inside functions, and commands get their options."""
    classes = [each for each in tree.body if isinstance(each, ast.ClassDef)]
    bodies = [tree.body, *(each.body for each in classes)]
    return [each for body in bodies for each in body if isinstance(each, ast.FunctionDef)]


def is_command(function: ast.FunctionDef) -> bool:
    return any(ast.unparse(each).startswith("command(") for each in function.decorator_list)


def is_kernel(name: str, function: ast.FunctionDef) -> bool:
    """Whether its file compiles it, or one that imports from it."""
    imported = f"from {name.removesuffix('.py').replace('/', '.')} import"
    return any(
        f"compile_over_runs({function.name}" in text and (imported in text or other == name)
        for other, text in FILES.items()
    )


def test_functions_have_few_parameters() -> None:
    wide: dict[str, set[str]] = {}
    for name in FILES:
        for each in functions_of(tree_of(Path(name))):
            if parameters_of(each) > PARAMETERS and not is_command(each) and not is_kernel(name, each):
                wide.setdefault(name, set()).add(each.name)
    assert wide == WIDER


def test_packages_open_with_what_belongs_there_and_where_to_begin() -> None:
    """What they name as the beginning is a file or a room in them."""
    for name in FILES:
        folder, _, file = name.rpartition("/")
        if file == "__init__.py" and folder != "fuselog":
            opening = ast.get_docstring(tree_of(Path(name))) or ""
            assert opening.partition("\n\n")[0].endswith("."), name
            begin = re.search(
                r"\b[Bb]egin (?:reading in|here|with) ?((?:`[\w.]+`|, then | and )*)", opening
            )
            assert begin, f"{name}: says nothing of where to begin"
            for first in re.findall(r"`([\w.]+)`", begin[1]):
                place = ROOT / folder / first.replace(".", "/")
                assert place.is_dir() or place.with_suffix(".py").exists(), f"{name}: {first}"
