"""Hands a process what it needs of a run in files, and reads what it gives: both sides."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.blocks import of_runs
from fuselog.replay.engine.streams.results import ALL_WELL
from fuselog.replay.foreign.description import Description, read_description
from fuselog.replay.foreign.native.following import (
    Static,
    filters_of,
    follow_all,
    offsets_of,
)
from fuselog.replay.foreign.native.library import Library
from fuselog.replay.foreign.native.out_of_sequence import follow_all_as_arrived
from fuselog.replay.foreign.results import Results, Sizes, begun, in_file, results
from fuselog.replay.inference.run.recursion import FilterEvents
from fuselog.replay.inference.run.timing import select_events

LOADING = -1  # the progress of a process that has not begun
IN_ORDER = -1  # the window of a run whose messages come in the order of their stamps


class RunGiven(NamedTuple):
    """Holds what a filter is given of one run.

    Attributes:
        static: what it takes before the start.
        events: its messages.
        prior: stamp, mean (n,) and covariance (t, t); None where the log has none.
        parameters: in the description's order.
        seed: of random numbers.
        window_ns: how late messages may be, which come as they arrived; IN_ORDER for none.
    """

    static: Static
    events: FilterEvents
    prior: tuple[int, Floats, Floats] | None
    parameters: Sequence[float]
    seed: int
    window_ns: int = IN_ORDER

    def from_time(self, time_ns: int) -> "RunGiven":
        """Return the same without messages that are older."""
        return self._replace(events=select_events(self.events, self.events.time_ns >= time_ns))

    def save(self, path: Path) -> None:
        """Write it to a file."""
        prior = {} if self.prior is None else dict(zip(_PRIOR, self.prior, strict=True))
        static = {f"static_{name}": each for name, each in self.static._asdict().items()}
        numbers = {"parameters": self.parameters, "seed": self.seed, "window_ns": self.window_ns}
        arrays: dict[str, Any] = {**static, **self.events._asdict(), **prior, **numbers}
        np.savez(path, **arrays)

    @classmethod
    def load(cls, path: Path) -> "RunGiven":
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as given:
            return cls(
                Static(*(given[f"static_{name}"] for name in Static._fields)),
                FilterEvents(*(given[name] for name in FilterEvents._fields)),
                (int(given[_PRIOR[0]]), given[_PRIOR[1]], given[_PRIOR[2]])
                if _PRIOR[0] in given
                else None,
                given["parameters"].tolist(),
                int(given["seed"]),
                int(given["window_ns"]),
            )


_PRIOR = ("prior_ns", "prior_mean", "prior_covariance")


def sizes_of(description: Description) -> Sizes:
    """Return the numbers of components."""
    return Sizes(len(description.state), description.tangent, len(description.innovation))


def mapped(folder: Path, due: np.ndarray, recorded: np.ndarray, description: Description) -> Results:
    """Return the results of a task, which both processes see."""
    return results(due, recorded, sizes_of(description), in_file(folder / "results"))


def follow_given(
    library: Library, given: RunGiven, description: Description, made: Results
) -> tuple[int, int] | None:
    """Take a run through a filter, which fills results; returns what failed and when, if anything."""
    prior = None
    if given.prior is not None:
        time_ns, mean, covariance = given.prior
        prior = np.array([time_ns]), mean[None], covariance[None]
    carried = filters_of(library, given.parameters, given.seed, prior, 1, description)
    follow = follow_all
    if given.window_ns != IN_ORDER:
        follow = partial(follow_all_as_arrived, given.window_ns)
    nobody = of_runs(carried, slice(0))
    follow(library, description, given.static, given.events, nobody, made)  # which compiles
    made.progress[0] = 0
    follow(library, description, given.static, given.events, carried, made)
    library.destroy_all(carried.handle.tolist())
    code = int(carried.failure[0])
    return None if code == ALL_WELL else (code, int(carried.time_ns[0]))


def follow_task(library: Library, folder: Path) -> dict[str, Any]:
    """Take the run that a folder has through the library's filter; the answer says how it ended."""
    description = read_description(library.description, str(library.path))
    given = RunGiven.load(folder / "given.npz")
    due, recorded = offsets_of(description, given.events)
    made = begun(mapped(folder, due, recorded, description), due, recorded)
    return {"failure": follow_given(library, given, description, made)}
