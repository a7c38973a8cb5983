"""Output streams of estimators: states, innovations, skipped messages, failures."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.compile import compiled
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.log.streams import stream_of
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import AnyArray
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import Failure, failure_stream, reason_stream
from fuselog.replay.engine.vectors.components import Components

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

ALL_WELL = -1  # the state of a run; any other number is an index in a list of reasons


def named(components: Mapping[str, str]) -> dict[str, str]:
    """Return component names and kinds in the form of channel metadata."""
    return {"components": ",".join(components), "kinds": ",".join(components.values())}


def state_stream(
    topic: str,
    time_ns: Integers,
    components: Components,
    truth: str | None,
    mean: Floats,
    covariance: Floats,
) -> Stream:
    """Make a stream of means (n, d), with angles wrapped, and tangent-space covariances (n, t, t).

    Args:
        topic: topic of the stream.
        time_ns: (n,) stamps.
        components: components by name, with their kinds.
        truth: topic of the truth; "" if there is no truth, None to leave the entry out of the metadata.
        mean: (n, d).
        covariance: (n, t, t).
    """
    mean = wrapped(mean, components)
    metadata = named(components) if truth is None else {**named(components), "truth": truth}
    return gaussian_stream(topic, time_ns, mean, covariance, metadata)


def wrapped(mean: Floats, components: Components) -> Floats:
    """Wrap the angles of means (n, d) to [-pi, pi).

    Args:
        mean: (n, d).
        components: the d names and their kinds.
    """
    angles = [index for index, kind in enumerate(components.values()) if kind == "angle"]
    beyond = [index for index in angles if not (np.abs(mean[:, index]) < np.pi).all()]
    if beyond:
        mean = mean.copy()
        _wrap_columns(mean, np.array(beyond))
    return mean


def wrap_columns(values: Floats, columns: Integers) -> None:
    """Wrap angles in place, except angles in range, which are not changed, to the last bit.

    Args:
        values: (n, d).
        columns: (m,), the columns of angles.
    """
    for row in range(len(values)):
        for place in range(len(columns)):
            angle = values[row, columns[place]]
            if not abs(angle) < np.pi:
                values[row, columns[place]] = wrap_angle(angle)


_wrap_columns = compiled(wrap_columns)


def gaussian_stream(
    topic: str, time_ns: Integers, mean: Floats, covariance: Floats, metadata: Mapping[str, str]
) -> Stream:
    """Make a stream of means (n, d) and covariances (n, t, t); a NaN makes a run fail (see `monitor`).

    Args:
        topic: topic of the stream.
        time_ns: (n,) stamps.
        mean: (n, d).
        covariance: (n, t, t).
        metadata: metadata of the channel.
    """
    columns = {"sensor_time_ns": time_ns, "mean": mean, "covariance": rows_of(covariance)}
    schema = schemas.GAUSSIAN_ESTIMATE
    return stream_of(topic, schema, time_ns, columns, metadata=metadata, allow_nan=True)


def states_in(
    rows: Integers,
    topic: str,
    time_ns: Integers,
    offsets: Integers,
    components: Components,
    truth: str | None,
    mean: Floats,
    covariance: Floats,
) -> Ragged:
    """Make a stream of states from chosen rows of columns; run r has the rows offsets[r]:offsets[r + 1].

    Args:
        rows: (k,), the rows to use, in order.
        topic: topic of the stream.
        time_ns: (n,), the stamps.
        offsets: (runs + 1,), first row of each run.
        components: components of the state by name, with their kinds.
        truth: topic of the truth, or None if there is no truth.
        mean: (n, d).
        covariance: (n, t, t).

    Returns:
        The stream of the k states, run by run.
    """
    stream = state_stream(topic, time_ns[rows], components, truth, mean[rows], covariance[rows])
    return Ragged(stream, np.searchsorted(rows, offsets))


class InnovationColumns(NamedTuple):
    """Columns of a stream of innovations.

    Attributes:
        time_ns: (n,) stamps.
        target_id, accepted: (n,) the target of each innovation, and whether a gate accepted the
            innovation.
        innovation, covariance: (n, m), (n, m, m).
        squared: (n,), the NIS.
        log_likelihood: (n,), or None if it is not known.
    """

    time_ns: Integers
    target_id: AnyArray
    accepted: AnyArray
    innovation: Floats
    covariance: Floats
    squared: Floats
    log_likelihood: Floats | None = None


def innovation_stream(
    topic: str, components: Mapping[str, str], truth: str, columns: InnovationColumns
) -> Stream:
    """Make a stream of innovations of components that are measured together."""
    unknown, likelihood = np.full(len(columns.time_ns), np.nan), columns.log_likelihood
    return make_stream(
        topic,
        schemas.INNOVATION,
        columns.time_ns,
        metadata={**named(components), "truth": truth},
        target_id=columns.target_id,
        accepted=columns.accepted,
        innovation=columns.innovation,
        covariance=rows_of(columns.covariance),
        normalised_innovation_squared=columns.squared,
        log_likelihood=unknown if likelihood is None else likelihood,
    )


def rows_of(covariance: Floats) -> Floats:
    """Reshape matrices (n, m, m) to rows (n, m m)."""
    return covariance.reshape(len(covariance), covariance.shape[1] * covariance.shape[2])


def failures_of(
    topic: str, before: Integers, after: Integers, time_ns: Integers, reasons: Sequence[str]
) -> Ragged:
    """Make the stream `topic`/failure of the runs that failed in a block, one message each.

    Args:
        topic: topic prefix of the estimator, /estimates/NAME and its case.
        before: (runs,) status before the block: ALL_WELL or an index in `reasons`.
        after: (runs,) status after the block, in the same form.
        time_ns: (runs,) time of each failure.
        reasons: a sentence for each index.
    """
    failed = np.flatnonzero((after >= 0) & (before == ALL_WELL))
    stream = reason_stream(f"{topic}/failure", schemas.FAILURE, time_ns[failed], after[failed], reasons)
    return Ragged(stream, np.searchsorted(failed, np.arange(len(after) + 1)))


def failures_by_run(topic: str, failures: Mapping[int, Failure], runs: int) -> Ragged:
    """Make the stream `topic`/failure of some failed runs.

    Args:
        topic: topic prefix of the estimator.
        failures: the failures by run number.
        runs: number of runs.
    """
    failed = sorted(failures)
    stream = failure_stream(f"{topic}/failure", [failures[run] for run in failed])
    return Ragged(stream, np.searchsorted(failed, np.arange(runs + 1)))
