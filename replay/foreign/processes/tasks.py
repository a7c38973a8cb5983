"""Tasks for worker processes, with the input of a run and its results in files."""

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

LOADING = -1  # progress of a process that has not started its task
IN_ORDER = -1  # window of a run whose messages are in order of their stamps


class RunGiven(NamedTuple):
    """Input of a filter for one run.

    Attributes:
        static: messages for the filter before its start.
        events: all other messages.
        prior: stamp, mean (n,) and covariance (t, t); None if the log has none.
        parameters: values of the parameters, in the order of the description.
        seed: seed of random numbers.
        window_ns: largest delay of out-of-sequence messages if messages are in order of arrival;
            IN_ORDER if they are in order of their stamps.
    """

    static: Static
    events: FilterEvents
    prior: tuple[int, Floats, Floats] | None
    parameters: Sequence[float]
    seed: int
    window_ns: int = IN_ORDER

    def from_time(self, time_ns: int) -> "RunGiven":
        """Return the input without messages older than `time_ns`."""
        return self._replace(events=select_events(self.events, self.events.time_ns >= time_ns))

    def save(self, path: Path) -> None:
        """Write the input to a file."""
        prior = {} if self.prior is None else dict(zip(_PRIOR, self.prior, strict=True))
        static = {f"static_{name}": each for name, each in self.static._asdict().items()}
        numbers = {"parameters": self.parameters, "seed": self.seed, "window_ns": self.window_ns}
        arrays: dict[str, Any] = {**static, **self.events._asdict(), **prior, **numbers}
        np.savez(path, **arrays)

    @classmethod
    def load(cls, path: Path) -> "RunGiven":
        """Read the input from a file that `save` wrote."""
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
    """Return the numbers of components of states and innovations."""
    return Sizes(len(description.state), description.tangent, len(description.innovation))


def mapped(folder: Path, due: np.ndarray, recorded: np.ndarray, description: Description) -> Results:
    """Map the results of a task to memory that both processes share."""
    return results(due, recorded, sizes_of(description), in_file(folder / "results"))


def follow_given(
    library: Library, given: RunGiven, description: Description, made: Results
) -> tuple[int, int] | None:
    """Process a run with a filter and fill the results; return code and stamp of a failure, or None."""
    prior = None
    if given.prior is not None:
        time_ns, mean, covariance = given.prior
        prior = np.array([time_ns]), mean[None], covariance[None]
    carried = filters_of(library, given.parameters, given.seed, prior, 1, description)
    follow = follow_all
    if given.window_ns != IN_ORDER:
        follow = partial(follow_all_as_arrived, given.window_ns)
    nobody = of_runs(carried, slice(0))
    follow(library, description, given.static, given.events, nobody, made)  # only compiles
    made.progress[0] = 0
    follow(library, description, given.static, given.events, carried, made)
    library.destroy_all(carried.handle.tolist())
    code = int(carried.failure[0])
    return None if code == ALL_WELL else (code, int(carried.time_ns[0]))


def follow_task(library: Library, folder: Path) -> dict[str, Any]:
    """Process the run in a folder with a filter of the library; report its outcome."""
    description = read_description(library.description, str(library.path))
    given = RunGiven.load(folder / "given.npz")
    due, recorded = offsets_of(description, given.events)
    made = begun(mapped(folder, due, recorded, description), due, recorded)
    return {"failure": follow_given(library, given, description, made)}
