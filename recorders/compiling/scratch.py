"""Working memory for each core in a loop, reused between calls."""

from collections.abc import Callable, Sequence

from fuselog.recorders.compiling.kinds import KernelArgument


class Memory:
    """The working memory of one core, with its description for a kernel.

    `is_kept` states whether it is kept for later calls, and so shares no arrays with other arguments.
    """

    __slots__ = ("described", "is_kept", "value")

    def __init__(self, value: KernelArgument, *, is_kept: bool = False) -> None:
        self.value, self.is_kept = value, is_kept
        self.described: KernelArgument = None


class Scratch:
    """A pool of working memory for the argument `scratch` of a loop, kept for later calls.

    One instance serves one loop with arguments of the same sizes. The memory shares no arrays with them.
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
            return Memory(self._make(), is_kept=True)

    def take_back(self, memories: Sequence[Memory]) -> None:
        """Return memories to the pool when they are no longer in use."""
        self._free += memories
