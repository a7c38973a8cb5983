"""Makes streams of what estimators return: states, innovations, skipped messages, failures."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.log.streams import stream_of
from fuselog.recorders.models.planar import wrap_angle
from fuselog.replay.engine.arrays import AnyArray
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import Failure, failure_stream, reason_stream
from fuselog.replay.engine.vectors.components import Components

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

ALL_WELL = -1  # of a run; what is not negative counts in a list of reasons


def named(components: Mapping[str, str]) -> dict[str, str]:
    """Return components and their kinds as a channel states them."""
    return {"components": ",".join(components), "kinds": ",".join(components.values())}


def state_stream(
    topic: str,
    time_ns: Integers,
    components: Components,
    truth: str | None,
    mean: Floats,
    covariance: Floats,
) -> Stream:
    """Return means (n, d), their angles wrapped, and covariances (n, t, t) in the tangent space.

    `truth` is the topic that they are compared with; None where there is nothing to compare.

    Args:
        topic: to be written.
        time_ns: (n,) stamps.
        components: by name, with their kinds.
        truth: the topic of the truth, "" for none.
        mean: (n, d).
        covariance: (n, t, t).
    """
    mean = wrapped(mean, components)
    metadata = named(components) if truth is None else {**named(components), "truth": truth}
    return gaussian_stream(topic, time_ns, mean, covariance, metadata)


def wrapped(mean: Floats, components: Components) -> Floats:
    """Return means (n, d) with their angles wrapped to [-pi, pi).

    Args:
        mean: (n, d).
        components: the d names and their kinds.
    """
    given = mean
    for index in (index for index, kind in enumerate(components.values()) if kind == "angle"):
        beyond = ~(np.abs(mean[:, index]) < np.pi)
        if beyond.any():  # those in range stay as they are, to the last bit
            mean = mean.copy() if mean is given else mean
            mean[beyond, index] = wrap_angle(mean[beyond, index])
    return mean


def gaussian_stream(
    topic: str, time_ns: Integers, mean: Floats, covariance: Floats, metadata: Mapping[str, str]
) -> Stream:
    """Return means (n, d) and covariances (n, t, t); what is no number ends its run, see `monitor`.

    Args:
        topic: to be written.
        time_ns: (n,) stamps.
        mean: (n, d).
        covariance: (n, t, t).
        metadata: of the channel.
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
    """Make the states in some rows, in order, of columns whose run r owns offsets[r]:offsets[r + 1].

    Args:
        rows: (k,), the rows to take, in order.
        topic: the name of the stream.
        time_ns: (n,), the stamps.
        offsets: (runs + 1,), where the runs begin in the columns.
        components: those of the state by name, with their kinds.
        truth: the topic of the truth; None where there is none.
        mean: (n, d).
        covariance: (n, t, t).

    Returns:
        The stream of the k states, run by run.
    """
    stream = state_stream(topic, time_ns[rows], components, truth, mean[rows], covariance[rows])
    return Ragged(stream, np.searchsorted(rows, offsets))


class InnovationColumns(NamedTuple):
    """Holds innovations as their stream has them.

    Attributes:
        time_ns: (n,) stamps.
        target_id, accepted: (n,) what each was about, and whether a gate let it in.
        innovation, covariance: (n, m), (n, m, m).
        squared: (n,), the NIS.
        log_likelihood: (n,); None where it is not known.
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
    """Make the stream of innovations, of the components that are measured together."""
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
    """Return matrices (n, m, m) as rows (n, m m)."""
    return covariance.reshape(len(covariance), covariance.shape[1] * covariance.shape[2])


def failures_of(
    topic: str, before: Integers, after: Integers, time_ns: Integers, reasons: Sequence[str]
) -> Ragged:
    """Return the runs that failed in a block, on `topic`/failure; one message each, at its own time.

    Args:
        topic: the estimator's, /estimates/NAME and its case.
        before: ALL_WELL or an index of `reasons` for every run up to the block, (runs,).
        after: the same with the block.
        time_ns: when, (runs,).
        reasons: a sentence for each index.
    """
    failed = np.flatnonzero((after >= 0) & (before == ALL_WELL))
    stream = reason_stream(f"{topic}/failure", schemas.FAILURE, time_ns[failed], after[failed], reasons)
    return Ragged(stream, np.searchsorted(failed, np.arange(len(after) + 1)))


def failures_by_run(topic: str, failures: Mapping[int, Failure], runs: int) -> Ragged:
    """Return the failures of some of the runs, by their numbers, on `topic`/failure.

    Args:
        topic: of the estimator.
        failures: by run.
        runs: how many there are.
    """
    failed = sorted(failures)
    stream = failure_stream(f"{topic}/failure", [failures[run] for run in failed])
    return Ragged(stream, np.searchsorted(failed, np.arange(runs + 1)))
