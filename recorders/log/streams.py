"""One topic of a log, held in memory as columns."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recorders.errors import BadInput
from recorders.log.schemas import Field, Schema


@dataclass(frozen=True)
class Stream:
    """The messages of one topic: first axis = message.

    `publish_time_ns` says when the quantity was measured, `log_time_ns` when it reached the recorder,
    both (n,) int64 and never negative. `columns` has one array per schema field, (n,), or (n, width)
    for a vector. `position` is the place in the file, for a stable order among equal stamps.
    """

    topic: str
    schema: Schema
    publish_time_ns: NDArray[np.int64]
    log_time_ns: NDArray[np.int64]
    columns: Mapping[str, NDArray]
    position: NDArray[np.int64]
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.publish_time_ns)

    def __getitem__(self, name: str) -> NDArray:
        """The column of one field."""
        return self.columns[name]

    @property
    def components(self) -> list[str]:
        """The names of a state's or estimate's components, such as `x_m`."""
        return [name for name in self.metadata.get("components", "").split(",") if name]

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_] | slice) -> "Stream":
        """The messages of `rows`, in that order."""
        return replace(
            self,
            publish_time_ns=self.publish_time_ns[rows],
            log_time_ns=self.log_time_ns[rows],
            columns={name: column[rows] for name, column in self.columns.items()},
            position=self.position[rows],
        )


def make_stream(
    topic: str,
    schema: Schema,
    publish_time_ns: ArrayLike,
    *,
    log_time_ns: ArrayLike | None = None,
    sensor_time_ns: ArrayLike | None = None,
    metadata: Mapping[str, str] | None = None,
    **columns: ArrayLike,
) -> Stream:
    """Build a stream; clocks that are not given equal `publish_time_ns`.

    Raises BadInput where a column is missing or unknown, has another length, has the wrong number of
    axes, holds NaN that its field does not allow, or a time is negative.
    """
    published = np.asarray(publish_time_ns, dtype=np.int64)
    logged = published if log_time_ns is None else np.asarray(log_time_ns, dtype=np.int64)
    clock = published if sensor_time_ns is None else sensor_time_ns
    given: dict[str, ArrayLike] = {"sensor_time_ns": clock, **columns}
    names = [entry.name for entry in schema]
    if set(given) != set(names):
        raise BadInput(
            f"topic {topic}: {schema.full_name} has the fields {', '.join(names)}; "
            f"got {', '.join(given)}"
        )
    stream = Stream(
        topic,
        schema,
        published,
        logged,
        {entry.name: _as_column(topic, entry, given[entry.name]) for entry in schema},
        np.arange(len(published), dtype=np.int64),
        dict(metadata or {}),
    )
    check_stream(stream)
    return stream


def _as_column(topic: str, entry: Field, values: ArrayLike) -> NDArray:
    try:
        column = np.asarray(values, dtype=entry.dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(f"topic {topic}: field {entry.name} is not numeric ({error})") from error
    axes = 2 if entry.kind == "vector" else 1
    if column.ndim != axes:
        raise BadInput(f"topic {topic}: field {entry.name} wants {axes} axes, got shape {column.shape}")
    return column


def check_stream(stream: Stream, where: str = "") -> None:
    """Raise BadInput where lengths differ, a time is negative, or NaN stands where none may."""
    label = f"{where}topic {stream.topic}"
    clocks = {"publish_time": stream.publish_time_ns, "log_time": stream.log_time_ns}
    for name, times in clocks.items():
        if len(times) and times.min() < 0:
            raise BadInput(f"{label}: {name} is negative; shift the run to an epoch after zero")
    for entry in stream.schema:
        column = stream.columns[entry.name]
        if len(column) != len(stream):
            raise BadInput(
                f"{label}: field {entry.name} has {len(column)} values for {len(stream)} messages"
            )
        if column.dtype.kind == "f" and not entry.may_be_nan:
            bad = np.isnan(column) if column.ndim == 1 else np.isnan(column).any(axis=1)
            if bad.any():
                raise BadInput(
                    f"{label}: field {entry.name} is NaN in message {int(np.argmax(bad))} "
                    f"({int(bad.sum())} in all), which {stream.schema.full_name} does not allow; "
                    "drop these messages before recording"
                )


def concatenate(parts: Sequence[Stream]) -> Stream:
    """Join parts of one topic, in the order given."""
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    return replace(
        first,
        publish_time_ns=np.concatenate([part.publish_time_ns for part in parts]),
        log_time_ns=np.concatenate([part.log_time_ns for part in parts]),
        columns={name: np.concatenate([part.columns[name] for part in parts]) for name in first.columns},
        position=np.concatenate([part.position for part in parts]),
    )


def empty_stream(topic: str, schema: Schema, metadata: Mapping[str, str]) -> Stream:
    """A stream without messages; its vectors have width 0."""
    times = np.empty(0, np.int64)
    columns = {
        entry.name: np.empty((0, 0) if entry.kind == "vector" else 0, entry.dtype) for entry in schema
    }
    return Stream(topic, schema, times, times, columns, times, metadata)


def total_messages(streams: Iterable[Stream]) -> int:
    """How many messages the streams have together."""
    return sum(len(stream) for stream in streams)
