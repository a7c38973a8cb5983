"""Collection of a bag's messages in streams, block by block, with counts for the notes."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.importers.mapping import (
    NOT_UNIT,
    SCALED,
    Quaternions,
    checked,
    not_finite,
    off_unit,
    with_unit_quaternions,
)
from fuselog.recorders.importers.ros.choosing import Clock
from fuselog.recorders.importers.ros.messages import SIGMAS, Part
from fuselog.recorders.log import Schema, Stream, make_stream
from fuselog.recorders.log.planes import Origin, is_planar

# Names of frames, and the messages (n,) that have them.
Frames = Sequence[tuple[Mapping[str, str], NDArray[np.bool_]]]


class Sent(NamedTuple):
    """Messages (n,) of a topic: their rows in it, and stamps; `stamp_ns` is None without a header."""

    topic: str
    rows: NDArray[np.int64]
    stamp_ns: NDArray[np.int64] | None
    log_time_ns: NDArray[np.int64]


class _Piece(NamedTuple):
    """Some messages of a stream within a block."""

    rows: NDArray[np.int64]
    publish_time_ns: NDArray[np.int64]
    log_time_ns: NDArray[np.int64]
    sensor_time_ns: NDArray[np.int64]
    columns: dict[str, NDArray]


@dataclass
class _Written:
    """The state of a stream that is kept from its first block to its last."""

    schema: Schema
    metadata: dict[str, str]
    widths: dict[str, int]
    constants: Mapping[str, NDArray]
    noise: dict[str, NDArray[np.float64]]
    messages: int = 0
    last_ns: int = -1
    pieces: list[_Piece] = field(default_factory=list)


class StreamMaker:
    """A maker of streams, block by block, that counts dropped and doubtful messages.

    Attributes:
        counts: number of messages by subject and fact, for the notes.
        came_of: names of the streams made from each topic, in the order of their first messages.
        first_ns: first publish time of all streams.
        noise: the noise stated for a topic, or the reason why it states no noise.
    """

    def __init__(
        self,
        path: Path,
        clock: Clock,
        names: Mapping[tuple[str, str], str],
        origin: Origin | None = None,
        quaternions: Quaternions = "refuse",
    ) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self.came_of: dict[str, dict[str, None]] = defaultdict(dict)
        self.first_ns: int | None = None
        self.noise: dict[str, str] = {}
        self._path, self._clock, self._names = path, clock, names
        self._origin, self._quaternions = origin, quaternions
        self._written: dict[str, _Written] = {}
        self._streams: dict[tuple[str, ...], str] = {}

    @property
    def messages(self) -> int:
        """Count the messages made from the bag so far."""
        return sum(written.messages for written in self._written.values())

    @property
    def described(self) -> dict[str, tuple[str, Mapping[str, str]]]:
        """Return the names of messages and the metadata of all streams, by topic."""
        return {topic: (each.schema.full_name, each.metadata) for topic, each in self._written.items()}

    def tell(self, subject: str, fact: str, count: int) -> None:
        """Add to the count of a fact, such as dropped messages, for the notes."""
        if count:
            self.counts[subject, fact] += count

    def add(self, sent: Sent, part: Part, frames: Frames, name: str = "") -> None:
        """Add a part of messages (n,) to the stream `name`, or to the one of their topic and frames."""
        keep = self._kept(sent, part)
        for frame, which in frames:
            rows = np.flatnonzero(keep & (which if part.rows is None else which[part.rows]))
            if len(rows):
                self._put(name or self._name(sent.topic, part.kind, frame), sent, part, rows, frame)

    def block(self) -> list[Stream]:
        """Make the streams of all collected messages."""
        return [
            self._stream(topic, written) for topic, written in self._written.items() if written.pieces
        ]

    def _kept(self, sent: Sent, part: Part) -> NDArray[np.bool_]:
        """Test which messages (k,) of a part are kept; count those left out by reason."""
        size = len(next(iter(part.columns.values())))
        keep = np.ones(size, bool)
        dropped = dict(part.dropped)
        known = dict(part.columns)
        for name, lacks in part.lacking.items():
            known[name] = np.where(lacks[:, None], 0.0, known[name])
        dropped["NaN or infinite"] = not_finite(part.schema, known)
        if sent.stamp_ns is not None and self._clock == "header":
            own = sent.stamp_ns if part.rows is None else sent.stamp_ns[part.rows]
            dropped["without a stamp in the header (--clock bag takes the bag's)"] = own == 0
        for reason, which in dropped.items():
            self.tell(sent.topic, f"{part.kind} dropped: {reason}", int((which & keep).sum()))
            keep &= ~which
        where, kinds = f"{self._path}: topic {sent.topic}", part.metadata.get("kinds", "")
        off = off_unit(where, part.columns, kinds, keep, self._quaternions)
        self.tell(sent.topic, f"{part.kind} dropped: {NOT_UNIT}", int(off.left_out.sum()))
        keep &= ~off.left_out
        doubtful = {**part.doubtful, f"with {SCALED}": off.scaled}
        for reason, which in doubtful.items():
            self.tell(sent.topic, f"{part.kind} kept {reason}", int((which & keep).sum()))
        return keep

    def _name(self, topic: str, kind: str, frame: Mapping[str, str]) -> str:
        """Name the stream of a topic, kind and frames; further frames get their own streams."""
        key = (topic, kind, *frame.values())
        if key not in self._streams:
            name = self._names[topic, kind]
            is_first = name not in self._streams.values()
            self._streams[key] = name if is_first else "/".join([name, *filter(None, frame.values())])
        return self._streams[key]

    def _plane_of(self, topic: str, part: Part, metadata: Mapping[str, str]) -> dict[str, str]:
        """Return the origin for a stream's channel; empty for transforms and poses from odometry."""
        is_own = part.kind == "odometry_pose" or (topic, part.kind) not in self._names
        if self._origin is None or is_own or not is_planar(part.schema.full_name, metadata):
            return {}
        return self._origin.metadata

    def _put(
        self,
        name: str,
        sent: Sent,
        part: Part,
        rows: NDArray[np.int64],
        frame: Mapping[str, str],
    ) -> None:
        """Add rows (k,) of a part to a stream."""
        size = len(next(iter(part.columns.values())))
        which = slice(None) if len(rows) == size else rows
        where = f"{self._path}: topic {sent.topic}"
        columns = {key: column[which] for key, column in part.columns.items()}
        columns = with_unit_quaternions(columns, part.metadata.get("kinds", ""))
        columns = {key: checked(where, key, column) for key, column in columns.items()}
        constants = {key: column[which] for key, column in part.constants.items()}
        widths = {key: column.shape[1] for key, column in columns.items() if column.ndim == 2}
        if name not in self._written:
            stated = {key: in_words(value[0]) for key, value in constants.items()}
            metadata = {**{key: each for key, each in frame.items() if each}, **part.metadata, **stated}
            metadata |= self._plane_of(sent.topic, part, metadata)
            first = {key: value[:1].copy() for key, value in constants.items()}
            noise = {key: each[which] for key, each in part.noise.items()}
            self._written[name] = _Written(part.schema, metadata, widths, first, noise)
        written = self._written[name]
        if widths != written.widths:
            self.tell(sent.topic, f"{part.kind} dropped: length differs from the first", len(rows))
            return
        for key, value in constants.items():
            known = written.constants[key]
            same = ((value == known) | (np.isnan(value) & np.isnan(known))).all(axis=1)
            fact = f"{part.kind} kept although {key} differs from the first, which is stated"
            self.tell(sent.topic, fact, int((~same).sum()))
        of = rows if part.rows is None else part.rows[rows]
        log_time_ns = sent.log_time_ns[of]
        sensed = log_time_ns if sent.stamp_ns is None else sent.stamp_ns[of]
        published = log_time_ns if self._clock == "bag" else sensed
        written.pieces.append(_Piece(sent.rows[of], published, log_time_ns, sensed, columns))
        self.came_of[sent.topic][name] = None

    def _state_noise(self, topic: str, written: _Written, steps_ns: NDArray[np.int64]) -> None:
        """State the noise densities of a stream, computed from the first known variance of each."""
        step_s = 1e-9 * float(np.median(steps_ns[steps_ns > 0])) if (steps_ns > 0).any() else 0.0
        for name, variances in written.noise.items():
            known = variances[variances > 0.0]  # not zero, NaN or negative
            if not len(known) or not step_s:
                continue
            sigma, (least, most, unit) = float(np.sqrt(known[0])), SIGMAS[name]
            of = f"a standard deviation of {sigma:.3g} {unit}"
            if least <= sigma <= most:
                written.metadata[name] = f"{sigma * step_s**0.5:.6g}"
                statement = f"{written.metadata[name]}, of {of} every {step_s:.3g} s"
            else:
                statement = f"not stated, since {of} is implausible for a sensor"
            self.noise[f"{topic}: {name}"] = statement

    def _stream(self, topic: str, written: _Written) -> Stream:
        """Make a stream of the collected messages, in the order of the bag."""
        parts = written.pieces
        log_time_ns = np.concatenate([part.log_time_ns for part in parts])
        rows = np.concatenate([part.rows for part in parts])
        is_sorted = (np.diff(log_time_ns) >= 0).all() and (np.diff(rows) >= 0).all()
        order = slice(None) if is_sorted else np.lexsort((rows, log_time_ns))
        published = np.concatenate([part.publish_time_ns for part in parts])[order]
        steps_ns = np.diff(
            published, prepend=published[0] - 1 if written.last_ns < 0 else written.last_ns
        )
        self.tell(topic, "stamps repeat, but are kept", int((steps_ns == 0).sum()))
        self.tell(topic, "stamps go back in time, so they are sorted", int((steps_ns < 0).sum()))
        if not written.messages:
            self._state_noise(topic, written, np.diff(np.sort(published)))
        written.last_ns = int(published[-1])
        written.messages += len(published)
        first_ns = int(published.min())
        self.first_ns = first_ns if self.first_ns is None else min(self.first_ns, first_ns)
        stream = make_stream(
            topic,
            written.schema,
            published,
            log_time_ns=log_time_ns[order],
            sensor_time_ns=np.concatenate([part.sensor_time_ns for part in parts])[order],
            metadata=written.metadata,
            **{
                name: np.concatenate([part.columns[name] for part in parts])[order]
                for name in parts[0].columns
            },
        )
        written.pieces.clear()
        return stream


def in_words(values: NDArray) -> str:
    """Format numbers (n,) separated by commas."""
    return ",".join(f"{value:.9g}" for value in values.tolist())
