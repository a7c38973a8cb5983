"""Output streams of batch estimators: estimates, convergence statistics and failures."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, Topic, make_stream, schemas
from fuselog.replay.engine.arrays import Booleans, Integers
from fuselog.replay.engine.streams.blocks import Ragged, run_of_rows
from fuselog.replay.engine.streams.channels import stated
from fuselog.replay.engine.streams.failures import reason_stream
from fuselog.replay.engine.streams.results import state_stream
from fuselog.replay.engine.vectors.components import components_of
from fuselog.replay.estimators.localization.least_squares import SENTENCES, Solution


class Batches(NamedTuple):
    """Batches that are solved together: the run and the last stamp of each batch, ordered by run."""

    runs: int
    run: Integers
    time_ns: Integers

    def ragged(self, stream: Stream, rows: Booleans) -> Ragged:
        """Assign the messages of an output stream, one for each selected batch, to their runs."""
        return Ragged(stream, np.searchsorted(self.run[rows], np.arange(self.runs + 1)))


def table_of(streams: Sequence[Ragged], fields: Sequence[str]) -> pd.DataFrame:
    """Combine the messages of all sensors in a table with columns for run, sensor, time and fields."""
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "run": run_of_rows(ragged.offsets),
                    "sensor": sensor,
                    "time_ns": ragged.stream.publish_time_ns,
                    **{field: ragged[field] for field in fields},
                }
            )
            for sensor, ragged in enumerate(streams)
        ],
        ignore_index=True,
    )


def batches_of(table: pd.DataFrame, key: str, runs: int) -> tuple[Batches, Integers]:
    """Return the batches of a table, one per run and value of `key`, and the batch of each row.

    A run's batches are in the order of their last stamps.
    """
    groups = table.groupby(["run", key])
    last = groups["time_ns"].max()
    run = last.index.get_level_values("run").to_numpy()
    in_order = np.lexsort((last, run))
    place = np.argsort(in_order)
    return Batches(runs, run[in_order], last.to_numpy()[in_order]), place[groups.ngroup()]


def solution_streams(
    topic: str, truth: str, components: Sequence[str], batches: Batches, solution: Solution
) -> list[Ragged]:
    """Make the streams TOPIC/state, TOPIC/solution and TOPIC/failure, with one solution per batch.

    A batch that failed has no state; its failure is one of `SENTENCES`.
    """
    found, time_ns = solution.converged, batches.time_ns
    state = state_stream(
        f"{topic}/state",
        time_ns[found],
        components_of(components),
        truth,
        solution.parameters[found],
        solution.covariance[found],
    )
    ended = make_stream(
        f"{topic}/solution",
        schemas.SOLUTION,
        time_ns,
        metadata={"parameters": str(len(components))},
        iterations=solution.iterations,
        converged=found,
        rank=solution.rank,
        cost=np.nan_to_num(solution.cost, nan=0.0, posinf=np.finfo(float).max),
    )
    failure = reason_stream(
        f"{topic}/failure", schemas.FAILURE, time_ns[~found], solution.status[~found], SENTENCES.values()
    )
    return [
        batches.ragged(state, found),
        batches.ragged(ended, np.ones(len(found), bool)),
        batches.ragged(failure, ~found),
    ]


def positive(topic: Topic, name: str) -> float:
    """Return a positive number from the channel's metadata; raise BadInput for any other value."""
    value = stated([topic], name)
    if not 0.0 < value < np.inf:
        raise BadInput(f"topic {topic.name} states {name} = {value:g}; expected a positive number")
    return value
