"""Working memory for each core in a loop, reused between calls."""

from collections.abc import Callable, Sequence

from fuselog.recorders.compiling.kinds import KernelArgument


class Memory:
    """The working memory of one core, with its description for a kernel."""

    __slots__ = ("described", "value")

    def __init__(self, value: KernelArgument) -> None:
        self.value = value
        self.described: KernelArgument = None


class Scratch:
    """A pool of working memory for the argument `scratch` of a loop, kept for later calls.

    One instance serves one loop with arguments of the same sizes.
    """

    def __init__(self, make: Callable[[], KernelArgument]) -> None:
        self._make = make
        self._free: list[Memory] = []

    def __call__(self) -> KernelArgument:
        """Make new memory."""
        return self._make()

    def lend(self) -> Memory:
        """Lend memory that is not in use."""
        try:
            return self._free.pop()
        except IndexError:
            return Memory(self._make())

    def take_back(self, memories: Sequence[Memory]) -> None:
        """Return memories to the pool when they are no longer in use."""
        self._free += memories
