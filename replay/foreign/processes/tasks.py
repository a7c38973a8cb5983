"""What a process is given of a run in files, and gives back: both sides of `isolation`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from replay.engine.arrays import Floats
from replay.engine.streams.blocks import of_runs
from replay.engine.streams.results import ALL_WELL
from replay.foreign.description import Description, read_description
from replay.foreign.native.following import (
    Static,
    filters_of,
    follow_all,
    offsets_of,
)
from replay.foreign.native.library import Library
from replay.foreign.results import Results, Sizes, begun, in_file, results
from replay.inference.run.recursion import FilterEvents
from replay.inference.run.timing import select_events

LOADING = -1  # the progress of a process that has not begun


class RunGiven(NamedTuple):
    """Holds what a filter is given of one run.

    Attributes:
        static: what it takes before the start.
        events: its messages.
        prior: stamp, mean (n,) and covariance (t, t); None where the log has none.
        parameters: in the description's order.
        seed: of random numbers.
    """

    static: Static
    events: FilterEvents
    prior: tuple[int, Floats, Floats] | None
    parameters: Sequence[float]
    seed: int

    def from_time(self, time_ns: int) -> "RunGiven":
        """Return the same without messages that are older."""
        return self._replace(events=select_events(self.events, self.events.time_ns >= time_ns))

    def save(self, path: Path) -> None:
        """Write the arrays to a file."""
        prior = {} if self.prior is None else dict(zip(_PRIOR, self.prior, strict=True))
        static = {f"static_{name}": each for name, each in self.static._asdict().items()}
        arrays: dict[str, Any] = {**static, **self.events._asdict(), **prior}
        np.savez(path, **arrays)


_PRIOR = ("prior_ns", "prior_mean", "prior_covariance")


def sizes_of(description: Description) -> Sizes:
    """Return the numbers of components."""
    return Sizes(len(description.state), description.tangent, len(description.innovation))


def mapped(folder: Path, due: np.ndarray, recorded: np.ndarray, description: Description) -> Results:
    """Return the results of a task, which both processes see."""
    return results(due, recorded, sizes_of(description), in_file(folder / "results"))


def follow_task(library: Library, folder: Path, parameters: list[float], seed: int) -> dict[str, Any]:
    """Take the run that a folder has through the library's filter; the answer says how it ended."""
    description = read_description(library.description, str(library.path))
    with np.load(folder / "given.npz", allow_pickle=False) as given:
        static = Static(*(given[f"static_{name}"] for name in Static._fields))
        events = FilterEvents(*(given[name] for name in FilterEvents._fields))
        prior = tuple(given[name][None] for name in _PRIOR) if _PRIOR[0] in given else None
    due, recorded = offsets_of(description, events)
    made = begun(mapped(folder, due, recorded, description), due, recorded)
    carried = filters_of(library, parameters, seed, prior, 1, description)
    nobody = of_runs(carried, slice(0))
    follow_all(library, description, static, events, nobody, made)  # which compiles
    made.progress[0] = 0
    follow_all(library, description, static, events, carried, made)
    library.destroy_all(carried.handle.tolist())
    code = int(carried.failure[0])
    return {"failure": None if code == ALL_WELL else [code, int(carried.time_ns[0])]}
