"""Holds what cores work in while they go through a loop, and keeps it for the next time."""

from collections.abc import Callable, Sequence

from fuselog.recorders.compiling.kinds import KernelArgument


class Memory:
    """Holds what one core works in, and how a kernel describes that."""

    __slots__ = ("described", "value")

    def __init__(self, value: KernelArgument) -> None:
        self.value = value
        self.described: KernelArgument = None


class Scratch:
    """Makes what cores work in, as the option `scratch` of a loop: each is kept for later calls.

    For one loop with arguments of the same sizes.
    """

    def __init__(self, make: Callable[[], KernelArgument]) -> None:
        self._make = make
        self._free: list[Memory] = []

    def __call__(self) -> KernelArgument:
        """Make new memory."""
        return self._make()

    def lend(self) -> Memory:
        """Return memory that nobody works in."""
        try:
            return self._free.pop()
        except IndexError:
            return Memory(self._make())

    def take_back(self, memories: Sequence[Memory]) -> None:
        """Keep memories in which nobody works any more."""
        self._free += memories
