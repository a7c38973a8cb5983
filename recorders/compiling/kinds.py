"""Names for types that cannot be declared more precisely: kernels and their arguments."""

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

# A function (run, *arguments) that processes one run; the arguments depend on the kernel.
RunOnce = Callable[..., None]  # type: ignore[explicit-any]
# A function that is compiled, or its compiled form.
KernelFunction = Callable[..., Any]  # type: ignore[explicit-any]
# A kernel's entry in machine code, which takes numbers and addresses of arguments and returns a fault.
Entry = Callable[..., int]  # type: ignore[explicit-any]
# An argument of a kernel: arrays, numbers, and tuples of them.
KernelArgument = Any  # type: ignore[explicit-any]
# The value of an expression while a kernel is lowered: a number or an array at run time, a tuple or
# record of such values, or any Python object that is already known.
Value = Any  # type: ignore[explicit-any]
# An array of any kind that is known while a kernel is made, or that holds its results.
AnyArray = NDArray[Any]  # type: ignore[explicit-any]
