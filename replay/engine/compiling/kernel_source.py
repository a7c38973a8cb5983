"""Gathers the sources of a kernel's functions and of all that they call, for numba."""

import ast
import copy
import inspect
import sys
from collections.abc import Mapping
from hashlib import sha256
from types import FunctionType, ModuleType
from typing import TypeGuard

import numpy as np

from fuselog.recorders import environment
from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.compiling.kernels.program import definition_of
from fuselog.replay.engine.compiling.kinds import Value

# What a version names, which is part of every key; of any other module the sources are needed.
_VERSIONED = {*sys.stdlib_module_names, "numpy", "numba"}
# In place of a definition's name, which has the hash of the definition.
_NAME = "_defined_here"


class DoesNotCompile(BadInput):
    """Says which function numba cannot compile, with its line and the reason."""


class KernelSource:
    """Gathers sources in the order they are needed, each under a name that says what it is.

    The name has the hash of the source, in which the names of all that it needs stand: two closures of
    one function, over different models, are two, and what two kernels need is one and compiled once.
    """

    def __init__(self) -> None:
        # a division by zero gives infinity, which is a failure of its run, and no exception
        inner = "error_model='numpy', no_cpython_wrapper=True, no_cfunc_wrapper=True"
        inner += ", pipeline_class=Inlined"
        bounds = ", boundscheck=True" if environment.is_on(environment.BOUNDSCHECK) else ""
        self.options = f"_nrt=True{bounds}"
        self._decorator = f"@numba.njit({inner}, {self.options})"
        self.definitions: dict[str, str] = {}
        # where a definition's lines come from, in words
        self.places: dict[tuple[str, int], str] = {}
        self._names: dict[Value, str] = {}

    def add(self, name: str, value: Value) -> str:
        """Define a value, called `name` where it is used, and before it what it needs; its own name."""
        value = inspect.unwrap(value)  # what has been compiled already is compiled with the rest
        literal = _literal(value)
        origin = getattr(value, "__qualname__", "<locals>")
        if literal is None and "<locals>" in origin and not isinstance(value, FunctionType | ModuleType):
            raise BadInput(
                f"a kernel uses '{name}', a {type(value).__name__}, which is neither a function, a "
                "number "
                "nor a tuple, and cannot be imported by name: pass it as an argument"
            )
        key = value if literal is None else (name, literal)
        if key not in self._names:
            self._names[key] = self._define(name, value, origin, literal)
        return self._names[key]

    def _define(self, name: str, value: Value, origin: str, literal: str | None) -> str:
        lines: dict[int, str] = {}
        if isinstance(value, FunctionType) and not _is_known_to_numba(value):
            name = value.__name__
            source, lines = self._source(value)
            definition = f"{self._decorator}\n{source}"
        elif isinstance(value, ModuleType):
            if value.__name__.partition(".")[0] not in _VERSIONED:
                raise BadInput(
                    f"a kernel uses the module {value.__name__}: import what it needs by name, "
                    "so that a change in the module is noticed"
                )
            definition = f"import {value.__name__} as {_NAME}"
        elif literal is not None:
            definition = f"{_NAME} = {literal}"
        elif _is_made_here(value):
            definition = f"{_NAME} = collections.namedtuple({name!r}, {value._fields})"
        else:
            definition = f"from {value.__module__} import {origin} as {_NAME}  # {_stamp(value)}"
        own = f"{name}_{sha256(definition.encode()).hexdigest()[:16]}"
        self.definitions[own] = definition.replace(_NAME, own)
        self.places |= {(own, 1 + line): place for line, place in lines.items()}
        return own

    def _source(self, function: FunctionType) -> tuple[str, dict[int, str]]:
        """Make a function called `_NAME`, and where its lines, counted from 1, come from."""
        closure = inspect.getclosurevars(function)
        needed = {**closure.globals, **closure.nonlocals}
        definition = _definition(function)
        file, above = function.__code__.co_filename, function.__code__.co_firstlineno - 1
        for node in ast.walk(definition):
            if _is_global_random(node, needed):
                raise DoesNotCompile(
                    f"{function.__qualname__} uses np.random ({file}, line {above + node.lineno}): its "
                    "numbers would depend on how runs are shared among cores; draw from the generator "
                    "that the run is given (draws=True)"
                )
        names = {name: self.add(name, value) for name, value in needed.items()}
        definition.name = _NAME
        for node in ast.walk(definition):
            if isinstance(node, ast.Name):
                node.id = names.get(node.id, node.id)
        source = ast.unparse(definition)
        before, after = (
            [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
            for tree in (definition, ast.parse(source).body[0])
        )
        return source, {
            new.lineno: f" ({file}, line {above + old.lineno})"
            for old, new in zip(before, after, strict=True)
        }


def _is_global_random(node: ast.AST, needed: Mapping[str, Value]) -> TypeGuard[ast.expr]:
    """Tell whether an expression is NumPy's module of generators that are nobody's own."""
    if isinstance(node, ast.Attribute) and node.attr == "random":
        return isinstance(node.value, ast.Name) and needed.get(node.value.id) is np
    if isinstance(node, ast.Name):
        found = needed.get(node.id)
        return found is np.random or getattr(found, "__self__", None) is np.random.mtrand._rand
    return False


def _is_made_here(value: Value) -> bool:
    """Tell whether it is a NamedTuple that was made at run time, which no import by name finds."""
    made = isinstance(value, type) and issubclass(value, tuple) and hasattr(value, "_fields")
    return made and getattr(sys.modules.get(value.__module__), value.__name__, None) is not value


def _is_known_to_numba(function: FunctionType) -> bool:
    """Tell whether numba has an implementation of its own for it (`numba.extending.overload`)."""
    from numba.core.registry import cpu_target  # which takes long to import

    context = cpu_target.typing_context
    context.refresh()
    try:
        context.resolve_value_type(function)
    except ValueError:
        return False
    return True


def _stamp(value: Value) -> str:
    """Return what changes with a thing that is imported by name, and so makes another kernel.

    Of a NamedTuple the order of its fields; of what numba has an implementation of, the module's source.
    """
    if hasattr(value, "_fields"):
        return " ".join(value._fields)
    if value.__module__.partition(".")[0] in _VERSIONED:
        return ""
    try:
        return sha256(inspect.getsource(sys.modules[value.__module__]).encode()).hexdigest()
    except (OSError, TypeError):  # written in C
        return ""


def _literal(value: Value) -> str | None:
    """Return a number, text, tuple of these or read-only array as source; None for anything else."""
    if isinstance(value, float):
        return f"float('{float(value)!r}')"  # infinity and NaN too
    if isinstance(value, tuple):
        entries = [_literal(entry) for entry in value]
        return None if None in entries else f"({''.join(f'{entry}, ' for entry in entries)})"
    if isinstance(value, np.ndarray) and not value.flags.writeable and not value.dtype.hasobject:
        content = f"bytes.fromhex('{value.tobytes().hex()}'), '{value.dtype.str}'"
        return f"numpy.frombuffer({content}).reshape({value.shape})"
    return repr(value) if isinstance(value, bool | int | str) else None


def _definition(function: FunctionType) -> ast.FunctionDef:
    """Make a function's source without its decorators and docstring."""
    definition = copy.deepcopy(definition_of(function)[0])  # which is changed here
    definition.decorator_list = []
    if ast.get_docstring(definition) is not None:
        definition.body = definition.body[1:]
    return definition
