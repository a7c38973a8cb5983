"""Lookup of the names in a lowered function, and of positions in its source."""

import builtins
from itertools import count
from types import FunctionType

from fuselog.recorders.compiling.kernels.known import (
    from_python,
)
from fuselog.recorders.compiling.kernels.numbers import (
    Emitter,
)
from fuselog.recorders.compiling.kernels.program import Program, definition_of
from fuselog.recorders.compiling.kinds import Value


class Scope:
    """The state of a function's lowering: the current line, and the values of names."""

    def __init__(self, program: Program, function: FunctionType) -> None:
        self.program = program
        self.emitter = Emitter(self.fault if program.is_checked else None)
        self.function = function
        self.line = 0
        self.known: dict[str, Value] = {}
        self._outside = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
        self._globals = function.__globals__
        self._labels = count()

    def place_in_source(self) -> str:
        """Describe the current position: the file and the line."""
        _, file, above = definition_of(self.function)
        return f"{file}, line {above + self.line}"

    def fault(self) -> int:
        """Add a fault for an index out of bounds in the current line; return its number."""
        self.program.faults.append(f"{self.function.__qualname__} ({self.place_in_source()})")
        return len(self.program.faults)

    def label(self, stem: str) -> str:
        """Return a new name for a block."""
        return f"{stem}{next(self._labels)}"

    def lookup(self, name: str) -> Value:
        """Return the value of a name."""
        if name in self.known:
            return self.known[name]
        if name in self._outside:
            return from_python(self._outside[name].cell_contents)
        if name in self._globals:
            return from_python(self._globals[name])
        if hasattr(builtins, name):
            return getattr(builtins, name)
        raise NameError(f"{name} is not defined here")
