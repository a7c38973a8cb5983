"""One topic of a log in memory, as columns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log.schemas import NUMPY_TYPES, Kind, Schema

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    import pyarrow as pa

Clock = Literal["publish_time", "log_time"]

# Positions in a short stream, shared by all of them.
_FIRST_POSITIONS = np.arange(1 << 13)
_FIRST_POSITIONS.flags.writeable = False


@dataclass(frozen=True, repr=False)
class Stream:
    """The n messages of one topic; the first axis of all arrays is the message.

    Attributes:
        topic: name of the topic.
        schema: schema of the messages.
        publish_time_ns, log_time_ns: (n,), when the quantity was measured and when it reached the
            recorder, never negative.
        columns: one array per field of the schema, (n,), or (n, width) for a vector.
        position: (n,), position in the file, for a stable order of equal stamps.
        metadata: metadata of the channel, as text.

    >>> from fuselog.recorders.log import make_stream, schemas
    >>> seen = make_stream("/range", schemas.RANGE, [0, 10, 20], target_id=[1, 2, 1], range_m=[5, 3, 4])
    >>> len(seen), seen["range_m"].tolist()
    (3, [5.0, 3.0, 4.0])
    >>> of_first = seen.take(seen["target_id"] == 1)
    >>> of_first.publish_time_ns.tolist()
    [0, 20]
    >>> of_first.pandas()[["publish_time_ns", "range_m"]]
       publish_time_ns  range_m
    0                0      5.0
    1               20      4.0
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
        """Return the column of one field."""
        return self.columns[name]

    @property
    def components(self) -> list[str]:
        """Return the names of a state's or estimate's components, such as `x_m`."""
        return [name for name in self.metadata.get("components", "").split(",") if name]

    def times(self, clock: Clock) -> NDArray[np.int64]:
        """Return the stamps (n,) of `clock`, "publish_time" or "log_time", in ns."""
        return self.publish_time_ns if clock == "publish_time" else self.log_time_ns

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_] | slice) -> "Stream":
        """Select the messages of `rows`, in that order."""
        stamps_ns = self.publish_time_ns[rows]
        if isinstance(rows, np.ndarray):  # np.take copies rows ten times as fast as indexing does
            places = np.flatnonzero(rows) if rows.dtype == bool else rows.astype(np.intp, copy=False)
            columns = {name: column.take(places, axis=0) for name, column in self.columns.items()}
        else:
            columns = {name: column[rows] for name, column in self.columns.items()}
        logged_ns, position = self.log_time_ns[rows], self.position[rows]
        return Stream(self.topic, self.schema, stamps_ns, logged_ns, columns, position, self.metadata)

    def pandas(self) -> "pd.DataFrame":
        """Convert to a data frame with a row for every message: both stamps in ns, then the fields.

        A vector has a column for every entry, such as `mean_x_m`; entries without names have numbers,
        such as `covariance_0`.
        """
        import pandas as pd

        return pd.DataFrame(self._flat())

    def arrow(self) -> "pa.Table":
        """Convert to an Arrow table with the same columns as `pandas`."""
        import pyarrow as pa

        return pa.table(self._flat())

    def polars(self) -> "pl.DataFrame":
        """Convert to a polars data frame like `pandas`; raise BadInput if polars is not installed."""
        try:
            import polars as pl
        except ImportError:
            raise BadInput(
                "polars is not installed: run pip install polars, or use .pandas() or .arrow()"
            ) from None
        return pl.from_arrow(self.arrow())

    def _flat(self) -> dict[str, NDArray]:
        """Return columns with one axis, by name."""
        columns = {"publish_time_ns": self.publish_time_ns, "log_time_ns": self.log_time_ns}
        for name, column in self.columns.items():
            if column.ndim == 1:
                columns[name] = column
                continue
            width = column.shape[1]
            entries = self.components if len(self.components) == width else range(width)
            columns |= {f"{name}_{entry}": column[:, index] for index, entry in enumerate(entries)}
        return columns

    def __repr__(self) -> str:
        of = "1 message" if len(self) == 1 else f"{len(self)} messages"
        return f"<Stream {self.topic}, {self.schema.full_name}, {of}: {', '.join(self._flat())}>"


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
    """Make a stream; a clock that is not given is set to `publish_time_ns`.

    A vector that may be absent can be omitted. Raises BadInput if another column is missing, unknown, or
    has the wrong length or number of axes; if it contains NaN that its field does not allow, or a number
    that its type cannot represent (such as a fraction of a nanosecond); or if a time is negative.

    Args:
        topic: name of the topic.
        schema: schema of the messages.
        publish_time_ns: (n,), when the quantity was measured.
        log_time_ns: (n,), when it reached the recorder.
        sensor_time_ns: (n,), stamp of the sensor's own clock.
        metadata: metadata of the channel, as text.
        columns: columns by field, (n,), or (n, width) for a vector.

    Returns:
        The stream, with its messages in the order given.

    >>> from fuselog.recorders.log import schemas
    >>> make_stream("/gyro", schemas.RANGE, [0, 10], target_id=[1, 1], range_m=[5.0])
    Traceback (most recent call last):
    fuselog.recorders.errors.BadInput: topic /gyro: field range_m has 1 values for 2 messages
    """
    clock = publish_time_ns if sensor_time_ns is None else sensor_time_ns
    given = {"sensor_time_ns": clock, **columns}
    return stream_of(topic, schema, publish_time_ns, given, log_time_ns=log_time_ns, metadata=metadata)


def stream_of(
    topic: str,
    schema: Schema,
    publish_time_ns: ArrayLike,
    given: Mapping[str, ArrayLike],
    *,
    log_time_ns: ArrayLike | None = None,
    metadata: Mapping[str, str] | None = None,
    allow_nan: bool = False,
) -> Stream:
    """Make a stream like `make_stream`, from a mapping of columns.

    Args:
        topic: name of the topic.
        schema: schema of the messages.
        publish_time_ns: (n,), when the quantity was measured.
        given: columns by field, (n,), or (n, width) for a vector; one that may be absent can be omitted.
        log_time_ns: (n,), when it reached the recorder; by default the time of the measurement.
        metadata: metadata of the channel, as text.
        allow_nan: whether any column may contain NaN.

    Raises BadInput like `make_stream`.
    """
    published = _as_column(topic, "publish_time_ns", publish_time_ns)
    logged = published if log_time_ns is None else _as_column(topic, "log_time_ns", log_time_ns)
    # an absent vector is stored as an empty one
    absent = {
        entry.name: np.empty((len(published), 0))
        for entry in schema
        if entry.may_be_absent and entry.kind == "vector"
    }
    given = {**absent, **given}
    if given.keys() != {entry.name for entry in schema}:
        raise BadInput(f"topic {topic}: {_misfit(schema, given)}")
    found = {
        entry.name: _as_column(topic, f"field {entry.name}", given[entry.name], entry.kind)
        for entry in schema
    }
    position = np.arange(len(published), dtype=np.int64)
    stream = Stream(topic, schema, published, logged, found, position, dict(metadata or {}))
    check_stream(stream, allow_nan=allow_nan)
    return stream


def _misfit(schema: Schema, given: Mapping[str, ArrayLike]) -> str:
    """Describe how the given fields differ from the fields of the schema."""
    name, clock = schema.full_name, "sensor_time_ns"
    own = [entry.name for entry in schema if entry.name != clock]
    if clock not in {entry.name for entry in schema}:
        return (
            f"the schema {name} lacks the sensor's own clock, which every message needs; declare "
            f'Field("{clock}", "time_ns") as its first field'
        )
    unknown = [each for each in given if each not in (clock, *own)]
    if unknown:
        return f"{name} has no field {unknown[0]}; {choices(unknown[0], own)}"
    missing = [entry for entry in schema if entry.name not in given]
    may = [entry.name for entry in missing if entry.may_be_nan]
    fix = f"; fill {', '.join(may)} with NaN if nothing was measured" if may else ""
    return f"{name} also needs {', '.join(entry.name for entry in missing)}{fix}"


def computed_stream(
    topic: str,
    schema: Schema,
    time_ns: NDArray[np.int64],
    columns: Mapping[str, NDArray],
    metadata: Mapping[str, str],
) -> Stream:
    """Make a stream from columns that a kernel filled according to the schema, without checks.

    Args:
        topic: name of the topic.
        schema: schema of the messages.
        time_ns: (n,), stamps of both clocks.
        columns: columns by field, (n,) or (n, width).
        metadata: metadata of the channel, as text.
    """
    count = len(time_ns)
    position = _FIRST_POSITIONS[:count] if count <= len(_FIRST_POSITIONS) else np.arange(count)
    return Stream(topic, schema, time_ns, time_ns, columns, position, metadata)


def _as_column(topic: str, name: str, values: ArrayLike, kind: Kind = "time_ns") -> NDArray:
    """Convert values to an array of this type, which must represent all of them."""
    dtype, axes = NUMPY_TYPES[kind], 1 + (kind == "vector")
    if isinstance(values, np.ndarray) and values.dtype == dtype and values.ndim == axes:
        return values if values.flags.aligned else values.copy()  # kernels need aligned numbers
    what = f"topic {topic}: {name}"
    try:
        column = given = np.asarray(values)
        if given.dtype != dtype:
            with np.errstate(invalid="ignore"):
                column = given.astype(dtype)
        is_kept = column is given or dtype.kind == "f" or np.array_equal(column, given)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(f"{what} is not numeric ({error})") from error
    if column.ndim != axes:
        raise BadInput(
            f"{what} needs {axes} {'axis' if axes == 1 else 'axes'}, but has shape {column.shape}"
        )
    if not is_kept:
        lost = given[np.argmax(column != given)]
        raise BadInput(
            f"{what} contains {lost}, which {dtype.name} cannot store; round the values, or scale them "
            "into its range"
        )
    return column


def check_stream(stream: Stream, where: str = "", *, allow_nan: bool = False) -> None:
    """Raise BadInput if lengths differ, a time is out of range, or NaN is not allowed.

    The name of the topic must be printable, since it is used in figures, file names and terminals.
    """
    if not stream.topic.isprintable():
        raise BadInput(
            f"{where}topic {stream.topic!r}: its name has characters that cannot be printed; give it "
            "another name"
        )
    label = f"{where}topic {stream.topic}"
    published, logged = stream.publish_time_ns, stream.log_time_ns
    clocks = {"publish_time": published} | ({} if logged is published else {"log_time": logged})
    for name, times in clocks.items():
        if len(times) != len(stream):
            raise BadInput(f"{label}: {name} has {len(times)} values for {len(stream)} messages")
        if len(times) and times.min() < 0:
            raise BadInput(
                f"{label}: {name} is before 1970 or after the year 2262; shift the run to an epoch "
                "between"
            )
    for entry in stream.schema:
        column = stream.columns[entry.name]
        if len(column) != len(stream):
            raise BadInput(
                f"{label}: field {entry.name} has {len(column)} values for {len(stream)} messages"
            )
        if (
            allow_nan
            or entry.may_be_nan
            or entry.may_be_partial
            or column.dtype.kind != "f"
            or not column.size
        ):
            continue
        if np.isnan(column.min()):  # the minimum is NaN if any number is: a single fast pass
            bad = np.isnan(column).reshape(len(column), -1).any(axis=1)
            raise BadInput(
                f"{label}: field {entry.name} is NaN in message {int(np.argmax(bad))} "
                f"({int(bad.sum())} in all), which {stream.schema.full_name} does not allow; "
                "drop these messages before recording"
            )


def concatenate(parts: Sequence[Stream], where: str = "") -> Stream:
    """Join parts of one topic, in the order given; raise BadInput if a vector changes its width."""
    first = parts[0]
    if len(parts) == 1:
        return first
    for name in (name for name, column in first.columns.items() if column.ndim == 2):
        widths = {part.columns[name].shape[1] for part in parts}
        if len(widths) > 1:
            raise BadInput(
                f"{where}topic {first.topic}: field {name} has vectors of different lengths "
                f"{sorted(widths)}; a stream has one length, so split the topic"
            )
    return replace(
        first,
        publish_time_ns=np.concatenate([part.publish_time_ns for part in parts]),
        log_time_ns=np.concatenate([part.log_time_ns for part in parts]),
        columns={name: np.concatenate([part.columns[name] for part in parts]) for name in first.columns},
        position=np.concatenate([part.position for part in parts]),
    )


def divide(stream: Stream, cuts: Sequence[int]) -> list[Stream]:
    """Divide a stream that holds several recordings, each with positions from zero.

    Args:
        stream: the recordings, one after the other.
        cuts: (recordings + 1,), first message of each.
    """
    return [
        Stream(
            stream.topic,
            stream.schema,
            stream.publish_time_ns[first:end],
            stream.log_time_ns[first:end],
            {name: column[first:end] for name, column in stream.columns.items()},
            np.arange(end - first, dtype=np.int64),
            stream.metadata,
        )
        for first, end in pairwise(cuts)
    ]


def empty_stream(topic: str, schema: Schema, metadata: Mapping[str, str]) -> Stream:
    """Return a stream without messages; its vectors have width 0."""
    times = np.empty(0, np.int64)
    columns = {
        entry.name: np.empty((0, 0) if entry.kind == "vector" else 0, entry.dtype) for entry in schema
    }
    return Stream(topic, schema, times, times, columns, times, metadata)
