"""A kernel as LLVM IR, in which each function is lowered once for each kind of its arguments."""

import ast
import inspect
import re
import textwrap
from collections.abc import Callable, Sequence
from functools import cache
from itertools import count
from types import FunctionType
from typing import NamedTuple

from fuselog.recorders.compiling.kernels.numbers import WHOLE, Emitter, Number
from fuselog.recorders.compiling.kernels.values import (
    Array,
    is_local,
    leaves,
    placed,
    rebuilt,
    signature,
    table,
)
from fuselog.recorders.compiling.kinds import AnyArray, Value
from fuselog.recorders.errors import BadInput

FEW = 30  # functions with fewer lines are always inlined
FEW_OF_GRAPH = 500  # so are graphs, whose many arguments and results cost as much as their operations


class DoesNotCompile(BadInput):
    """An error that names the line of code that kernels do not support."""


class Instance(NamedTuple):
    """A function lowered for some arguments: its name, and the type and value of its result.

    If `can_fail` is set, the function also returns the number of a fault, or 0.
    """

    name: str
    type: str
    returned: Value
    can_fail: bool


class Program:
    """The LLVM IR of a kernel while it is written.

    If indices are checked, `faults` lists the source lines in which an index may be out of bounds.
    """

    def __init__(
        self,
        lower: Callable[["Program", FunctionType, list[Value]], tuple[Emitter, Value]],
        *,
        is_checked: bool = False,
    ) -> None:
        self._lower = lower
        self.is_checked = is_checked
        self.faults: list[str] = []
        self.functions: list[str] = []
        self.declared: set[str] = set()
        self.tables: dict[Value, tuple[str, Array]] = {}
        self.instances: dict[Value, Instance] = {}
        self._names = count()
        self._open: list[int] = []
        self._kept: list[Value] = []  # keeps objects alive whose ids are keys

    def text(self) -> str:
        """Join the parts of the module."""
        tables = [text for text, _ in self.tables.values()]
        attributes = "attributes #0 = { nounwind willreturn memory(none) }"
        return "\n".join([*tables, *self.functions, *sorted(self.declared), attributes, ""])

    def name(self, stem: str) -> str:
        """Return a unique name for a function or table."""
        # "<lambda>" is not a valid name
        return f"@{re.sub('[^0-9A-Za-z]', '_', stem)}_{next(self._names)}"

    def table(self, numbers: AnyArray) -> Array:
        """Return a constant array, defined once."""
        key = numbers.dtype.str, numbers.shape, numbers.tobytes()
        if key not in self.tables:
            self.tables[key] = table(self.name("table"), numbers)
        return self.tables[key][1]

    def call(self, emitter: Emitter, function: FunctionType, arguments: Sequence[Value]) -> Value:
        """Call a function; lower it first if it was not lowered for such arguments before."""
        key = (id(function), *map(signature, arguments))
        if key not in self.instances:
            if id(function) in self._open:
                raise DoesNotCompile(
                    f"{function.__qualname__} calls itself, which kernels do not support"
                )
            self._open.append(id(function))
            self._kept.append((function, arguments))
            parameters = [self._parameter(index, each) for index, each in enumerate(arguments)]
            own, returned = self._lower(self, function, [value for value, _ in parameters])
            self._open.pop()
            types = [types for _, types in parameters]
            self.instances[key] = self.define(function.__name__, own, types, returned)
        result = called(emitter, self.instances[key], arguments)
        return placed(result, is_local=True) if any(map(is_local, arguments)) else result

    def define(
        self,
        stem: str,
        body: Emitter,
        parameters: Sequence[Sequence[tuple[str, str]]],
        returned: Value,
        few: int = FEW,
    ) -> Instance:
        """Add a function with this body and result, always inlined if it has fewer than `few` lines."""
        found = list(leaves(returned))
        results = [*found, ("i64", "0")] if body.can_fail else found
        kind = "{ " + ", ".join(each for each, _ in results) + " }" if results else "void"
        name = self.name(stem)
        given = ", ".join(f"{kind} {code}" for each in parameters for kind, code in each)
        inlined = " alwaysinline" if len(body.lines) < few else ""
        lines = [
            f"define internal fastcc {kind} {name}({given}) nounwind{inlined} {{",
            "entry:",
            *body.allocated,
            *body.lines,
        ]
        last = "undef"
        for place, (each, code) in enumerate(results):
            lines.append(f"  %out{place} = insertvalue {kind} {last}, {each} {code}, {place}")
            last = f"%out{place}"
        lines.append(f"  ret {kind} {last}" if results else "  ret void")
        if body.can_fail:
            lines += [
                "stop:",
                "  %why = load i64, ptr %fault",
                f"  %stopped = insertvalue {kind} undef, i64 %why, {len(found)}",
                f"  ret {kind} %stopped",
            ]
        self.functions.append("\n".join([*lines, "}"]))
        self.declared |= body.declared
        return Instance(name, kind, returned, body.can_fail)

    def _parameter(self, index: int, value: Value) -> tuple[Value, list[tuple[str, str]]]:
        """Return the value that the called function has for an argument, and the parameter's leaves."""
        found = [(kind, f"%a{index}_{place}") for place, (kind, _) in enumerate(leaves(value))]
        known = placed(_unsure(value), is_local=False)
        return rebuilt(known, iter([code for _, code in found])), found


def _unsure(value: Value) -> Value:
    """Return a number, not assumed to be non-negative, since other calls may pass negative numbers."""
    return value._replace(natural=False) if isinstance(value, Number) else value


def called(emitter: Emitter, instance: Instance, arguments: Sequence[Value]) -> Value:
    """Call a lowered function; return its result."""
    given = ", ".join(f"{kind} {code}" for each in arguments for kind, code in leaves(each))
    if instance.type == "void":
        emitter.add(f"call fastcc void {instance.name}({given})")
        return instance.returned
    result = emitter.fresh()
    emitter.add(f"{result} = call fastcc {instance.type} {instance.name}({given})")
    names = []
    for place, _ in enumerate(leaves(instance.returned)):
        names.append(emitter.fresh())
        emitter.add(f"{names[-1]} = extractvalue {instance.type} {result}, {place}")
    if instance.can_fail:
        fault = emitter.number(WHOLE, f"extractvalue {instance.type} {result}, {len(names)}")
        emitter.stop_if(emitter.truth(fault), fault)
    return rebuilt(instance.returned, iter(names))


@cache
def definition_of(function: FunctionType) -> tuple[ast.FunctionDef, str, int]:
    """Find a function's definition, its file, and the number of lines before it in that file."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError) as error:
        raise BadInput(
            f"the source of {function.__qualname__} cannot be found ({error}); "
            "define it as a function in a file"
        ) from error
    definition = tree.body[0]
    if not isinstance(definition, ast.FunctionDef):
        raise BadInput(
            f"{function.__qualname__} is not a `def` function, as kernels have to be; write it as one"
        )
    first = min([definition.lineno, *(each.lineno for each in definition.decorator_list)])
    return definition, function.__code__.co_filename, function.__code__.co_firstlineno - first
