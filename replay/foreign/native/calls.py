"""Calls of C functions by address from kernels, without any Python code between messages."""

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from fuselog.recorders.compiling.kernels.numbers import REAL, WHOLE, Emitter, Number
from fuselog.recorders.compiling.kernels.program import Program
from fuselog.recorders.compiling.kernels.values import Array

_LLVM = {"i32": "i32", "i64": "i64", "pointer": "ptr", "void": "void"}
_C: dict[str, Any] = {
    "i32": ctypes.c_int32,
    "i64": ctypes.c_int64,
    "pointer": ctypes.c_void_p,
    "void": None,
}


class Call:
    """C function that is called by address, in a kernel or in Python: `call(address, *arguments)`.

    A pointer is an array or an address; the result is 0 for a function without a return value.
    """

    def __init__(self, name: str, *kinds: str, returns: str = "i32") -> None:
        self.__name__ = name
        self._kinds, self._returns = kinds, returns
        self._prototype = ctypes.CFUNCTYPE(_C[returns], *(_C[kind] for kind in kinds))

    def __call__(self, address: int, *arguments: Any) -> int:
        """Call the function from Python."""
        given = (
            each.ctypes.data
            if isinstance(each, np.ndarray)
            else int(each) or (None if kind == "pointer" else 0)
            for each, kind in zip(arguments, self._kinds, strict=True)
        )
        return int(self._prototype(int(address))(*given) or 0)

    def kernel_identity(self) -> str:
        """Return the part of a kernel's key that identifies the call."""
        return f"call of {self.__name__}: {' '.join(self._kinds)} -> {self._returns}"

    def lowered(self, program: Program, emitter: Emitter, arguments: Sequence[Any]) -> Number:  # noqa: ARG002
        """Emit a call in LLVM; see `fuselog.recorders.compiling.kernels.expressions`."""
        address, *others = arguments
        given = ", ".join(
            f"{_LLVM[kind]} {_passed(emitter, each, kind)}"
            for each, kind in zip(others, self._kinds, strict=True)
        )
        function = _passed(emitter, address, "pointer")
        call = f"call {_LLVM[self._returns]} {function}({given})"
        if self._returns == "void":
            emitter.add(call)
            return emitter.as_kind(0, WHOLE)
        wider = "ptrtoint ptr" if self._returns == "pointer" else "sext i32"
        return emitter.number(WHOLE, f"{wider} {emitter.number(WHOLE, call).code} to i64")


def _passed(emitter: Emitter, value: Any, kind: str) -> str:
    """Convert an argument to the C type of a parameter."""
    if isinstance(value, Array):
        if kind != "pointer" or value.dtype != "<f8":
            raise TypeError("a pointer argument of a C function must be an array of real numbers")
        return value.pointer
    if isinstance(value, Number) and value.kind == REAL:
        raise TypeError("an argument of a C function must be a whole number or an array")
    number = emitter.as_kind(value, WHOLE)
    if kind == "i64":
        return number.code
    text = f"trunc i64 {number.code} to i32" if kind == "i32" else f"inttoptr i64 {number.code} to ptr"
    return emitter.number(WHOLE, text).code


START = Call("start", "pointer", "i64", "pointer", "pointer")
TAKE = Call("take", "pointer", "i32", "i64", "pointer")
PREDICT = Call("predict", "pointer", "i64")
STATE = Call("state", "pointer", "pointer", "pointer")
INNOVATION = Call("innovation", "pointer", "pointer", "pointer")
COPY = Call("copy", "pointer", returns="pointer")
DESTROY = Call("destroy", "pointer", returns="void")
