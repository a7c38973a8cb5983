"""Names the kinds of what kernels take and are made of, where no narrower type is known."""

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

# (run, *arguments): does the work of one run; what it takes is up to the kernel.
RunOnce = Callable[..., None]  # type: ignore[explicit-any]
# A function that is compiled, or one that does the same compiled.
KernelFunction = Callable[..., Any]  # type: ignore[explicit-any]
# A kernel's entry in machine code: takes the numbers and addresses of its arguments, returns a fault.
Entry = Callable[..., int]  # type: ignore[explicit-any]
# What a kernel takes: arrays, numbers, and tuples of them.
KernelArgument = Any  # type: ignore[explicit-any]
# What an expression of a kernel is while it is lowered: a number or an array at run time, a tuple or a
# record of such, or any object of Python that is known already.
Value = Any  # type: ignore[explicit-any]
# An array that is known while a kernel is made, or that holds what it gives: of any kind.
AnyArray = NDArray[Any]  # type: ignore[explicit-any]
