"""First messages of every run, and the states that these messages determine."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fuselog.recorders.log import Clock, Stream, schemas
from fuselog.replay.engine.arrays import Booleans, Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged, ragged_rows, run_of_rows
from fuselog.replay.engine.streams.failures import reason_stream
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.engine.vectors.tangent import manifold_blocks, named_now, tangent_components
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.start import Start

WIDER = 30.0  # times a message's sigma: such a prior has a thousandth of its weight


class Begun(NamedTuple):
    """Initial states of runs, to fill: stamps (runs,), FOREVER_NS if unknown; means; covariances."""

    time_ns: Integers
    mean: Floats
    covariance: Floats


class Fact(NamedTuple):
    """Sentence to report, its stamp in each run (runs,), and whether it is true for each run (runs,)."""

    text: str
    time_ns: Integers
    is_so: Booleans


def diagonal_places(size: int) -> Integers:
    """Return the indices of the diagonal in the flattened lower triangle."""
    rows = np.arange(1, size + 1)
    return np.cumsum(rows) - 1


def run_count(first: Mapping[str, Ragged]) -> int:
    """Count the runs."""
    return next(iter(first.values())).runs


def unknown(state: Components, start: Start | None) -> tuple[Floats, Floats]:
    """Make the mean (n,) and sigmas (t,) of an unknown state; NaN for sigmas that are not given."""
    kinds = list(state.values())
    sigmas = named_now(start.sigmas, list(state), kinds) if start else {}
    mean = np.zeros(len(kinds))
    for kind, columns in manifold_blocks(kinds):
        if kind in ("axis", "quaternion"):
            mean[columns.start] = 1.0
    names = [name for name, _ in tangent_components(list(state), kinds)]
    return mean, np.array([sigmas.get(name, np.nan) for name in names])


def state_by_message(bound_model: BoundModel, number: int, data: Floats) -> tuple[Floats, Floats]:
    """Compute the mean (n,) and wide sigmas (t,) of a state that one message measures.

    Args:
        bound_model: the bound model with its sensors.
        number: index of the sensor.
        data: measurement and noise of the message, as a row of `sensor_table`.
    """
    model, sensor = bound_model.model, bound_model.sensors[number]
    mean, sigma = unknown(model.state, model.start)
    components = [name for name, _ in tangent_components(list(model.state), model.kinds)]
    size = len(sensor.measured)
    for place, (name, variance) in enumerate(
        zip(sensor.measured, data[size + diagonal_places(size)], strict=True)
    ):
        if not np.isnan(data[place]):
            mean[list(model.state).index(name)] = data[place]
            row = components.index(name)
            sigma[row] = min(WIDER * np.sqrt(variance), sigma[row])
    return mean, sigma


def first_of_runs(
    ragged: Ragged, clock: Clock, usable: Booleans | None
) -> tuple[Integers, Booleans, Integers]:
    """Find the first usable message of every run: its stamp, whether it exists, and its row.

    Args:
        ragged: messages of a topic, in all runs.
        clock: clock of the stamps.
        usable: (n,) whether each message may be used; None for all.
    """
    every = np.arange(len(ragged)) if usable is None else np.flatnonzero(usable)
    place = np.searchsorted(every, ragged.offsets)
    has_one = place[1:] > place[:-1]
    rows = np.zeros(ragged.runs, np.int64)
    rows[has_one] = every[place[:-1][has_one]]
    time_ns = np.zeros(ragged.runs, np.int64)
    time_ns[has_one] = ragged.stream.times(clock)[rows[has_one]]
    return time_ns, has_one, rows


def heads_of_runs(ragged: Ragged, count: int) -> Ragged:
    """Return the first messages of every run, at most `count` per run."""
    is_early = np.arange(len(ragged)) < (ragged.offsets[:-1] + count)[run_of_rows(ragged.offsets)]
    return Ragged(ragged.stream.take(is_early), ragged_rows(is_early, ragged.offsets))


def of_runs(stream: Stream, has_one: Booleans) -> Ragged:
    """Divide a stream into runs, given which of the runs have a message in it.

    Args:
        stream: the messages, at most one per run, in the order of their runs.
        has_one: (runs,) whether a run has a message.
    """
    return Ragged(stream, np.append(0, np.cumsum(has_one)))


def started(name: str, facts: list[Fact]) -> list[Ragged]:
    """Make the stream `started` of an estimator, with one message per fact and run."""
    if not facts:
        return []
    texts, times, which = zip(*facts, strict=True)
    holds = np.stack(which, axis=1)
    stream = reason_stream(
        f"/estimates/{name}/started",
        schemas.STARTED,
        np.stack(times, axis=1)[holds],
        np.nonzero(holds)[1],
        texts,
    )
    return [Ragged(stream, np.append(0, np.cumsum(holds.sum(axis=1))))]
