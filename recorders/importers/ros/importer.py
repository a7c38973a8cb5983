"""The importer of ROS logs: topics become streams, and what is not taken is told.

A stream is named by the namespace of its topic and by what it is: /odom gives /odometry, /robot1/imu
gives /robot1/inertial. Where two topics would give the same name, both are named by the topic:
/odom/odometry, /wheels/odometry. So are poses without a covariance, which may be goals: /goal_pose/pose.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, PositiveFloat

from recorders.errors import BadInput, choices
from recorders.importers.mapping import checked, not_finite
from recorders.importers.ros.bags import Bag, open_bag
from recorders.importers.ros.layouts import Messages, MessageType, Undecodable, by_size, definitions_of
from recorders.importers.ros.mapping import MessageMapping, read_mapping, taken
from recorders.importers.ros.messages import (
    CHILD_FRAME,
    FRAME,
    STAMP,
    TRANSFORM_TYPES,
    TYPES,
    Part,
    Taken,
    as_truth,
    stamps_ns,
)
from recorders.importers.ros.raw import Batch, Connection
from recorders.importers.ros.transforms import Chain, Pair, Transforms, transforms_of
from recorders.log import Schema, Stream, make_stream, schemas
from recorders.parameters import Parameters
from recorders.recording import Blocks, Importer

Clock = Literal["header", "bag"]
Distribution = Literal[
    "ros1_noetic", "ros2_dashing", "ros2_eloquent", "ros2_foxy", "ros2_galactic", "ros2_humble",
    "ros2_iron", "ros2_jazzy", "ros2_kilted", "ros2_lyrical",
]  # fmt: skip
# A block ends when it has so many messages, or bytes.
_BLOCK_MESSAGES = 1 << 17
_BLOCK_BYTES = 1 << 24


def _as_list(value: object) -> object:
    return [value] if isinstance(value, str) else value


Names = Annotated[list[str], BeforeValidator(_as_list)]


class RosParameters(Parameters):
    """Which topics are taken, and by which clock.

    `clock` says what the publish time is: the message's header, or the bag. Without `topics` all are
    taken that can be. `transforms` names pairs of frames, "map:base_link", whose poses are composed of
    what TF has; without any, every transform that is sent is taken as it is. `names` gives what stands
    in place of the namespace in the streams of a topic: {"/amcl_pose" = "/robot1"}. The poses of the
    topic `truth` are what estimates are compared with, as the stream `truth`. `mapping` is a TOML file
    for messages of one's own. `distribution` says whose definitions hold where the bag has none.
    Headers that differ by more than `clock_tolerance_s` from one another's clock are of several clocks.
    """

    clock: Clock = "header"
    topics: Names = []
    transforms: Names = []
    names: dict[str, str] = {}
    truth: str | None = None
    mapping: str | None = None
    distribution: Distribution = "ros2_humble"
    clock_tolerance_s: PositiveFloat = 60.0


@dataclass
class _Pending:
    """Messages of one size that wait to be read together: their bytes (n, size), rows and stamps."""

    raw: list[NDArray[np.uint8]] = field(default_factory=list)
    rows: list[NDArray[np.int64]] = field(default_factory=list)
    log_time_ns: list[NDArray[np.int64]] = field(default_factory=list)


class _Piece(NamedTuple):
    """Some messages of a stream, which are one of its parts of a block."""

    rows: NDArray[np.int64]
    publish_time_ns: NDArray[np.int64]
    log_time_ns: NDArray[np.int64]
    sensor_time_ns: NDArray[np.int64]
    columns: dict[str, NDArray]


@dataclass
class _Written:
    """What a stream keeps from its first block to its last."""

    schema: Schema
    metadata: dict[str, str]
    widths: dict[str, int]
    constants: Mapping[str, NDArray]
    messages: int = 0
    last_ns: int = -1
    pieces: list[_Piece] = field(default_factory=list)


@dataclass
class _Clocks:
    """By topic, the span of the header's stamps, of the bag's, and of their difference, in ns."""

    header: dict[str, tuple[int, int]] = field(default_factory=dict)
    bag: dict[str, tuple[int, int]] = field(default_factory=dict)
    offset: dict[str, tuple[int, int]] = field(default_factory=dict)

    def note(
        self, topic: str, stamp_ns: NDArray[np.int64] | None, log_time_ns: NDArray[np.int64]
    ) -> None:
        """Take up the stamps of some messages (n,); without a header the bag's stand for both."""
        if not len(log_time_ns):
            return
        if stamp_ns is not None:
            _widen(self.header, topic, stamp_ns)
        _widen(self.bag, topic, log_time_ns)
        _widen(self.offset, topic, log_time_ns - (log_time_ns if stamp_ns is None else stamp_ns))

    def check(self, path: Path, tolerance_s: float) -> None:
        """Raise BadInput where topics are stamped by clocks that have nothing to do with one another."""
        early = min(self.offset, key=lambda topic: self.offset[topic][1], default="")
        late = max(self.offset, key=lambda topic: self.offset[topic][0], default="")
        apart_s = (self.offset[late][0] - self.offset[early][1]) * 1e-9 if self.offset else 0.0
        if apart_s > tolerance_s:
            what = [
                each if each in self.header else f"{each} (no header, the bag's)"
                for each in (early, late)
            ]
            raise BadInput(
                f"{path}: mixed time bases: the stamps of {what[0]} and of {what[1]} are "
                f"{apart_s:.6g} s apart; use --clock bag, or topics of one clock with --set topics=[...]"
            )

    def notes(self) -> dict[str, str]:
        """Both clocks and their offset, in words."""
        found = {}
        for name, spans in (("header", self.header), ("bag", self.bag)):
            if spans:
                found[f"{name} clock"] = " to ".join(_date(each) for each in _span(spans.values()))
        if self.header:
            low, high = _span(self.offset[topic] for topic in self.header)
            found["bag clock minus header clock"] = f"{low * 1e-9:.3f} to {high * 1e-9:.3f} s"
        return found


def _widen(spans: dict[str, tuple[int, int]], topic: str, values: NDArray[np.int64]) -> None:
    own = int(values.min()), int(values.max())
    spans[topic] = _span([own, spans.get(topic, own)])


def _span(spans: Iterable[tuple[int, int]]) -> tuple[int, int]:
    lows, highs = zip(*spans, strict=True)
    return min(lows), max(highs)


def _date(stamp_ns: int) -> str:
    """A stamp as a date, or in seconds where it is none of this century, as of a simulation."""
    if stamp_ns < 946_684_800_000_000_000:
        return f"{stamp_ns * 1e-9:.3f} s"
    return f"{datetime.fromtimestamp(stamp_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S} UTC"


class _Reader(NamedTuple):
    """How the messages of a connection are read; `taken` is None for transforms."""

    type: MessageType
    taken: Taken | None
    stamp: str
    frame: str
    is_static: bool


class _Import:
    """The import of one bag: what is chosen of it, what waits to be written, and what is to be told."""

    def __init__(self, bag: Bag, parameters: RosParameters) -> None:
        self.path, self._bag, self._parameters = bag.path, bag, parameters
        self._readers: dict[Connection, _Reader] = {}
        self._not_taken: dict[str, str] = {}
        self._choose()
        self._names = self._stream_names()
        self._pending: dict[tuple[Connection, int], _Pending] = defaultdict(_Pending)
        self._waiting_messages = self._waiting_bytes = 0
        self._written: dict[str, _Written] = {}
        self._streams: dict[tuple[str, ...], str] = {}
        self._came_of: dict[str, dict[str, None]] = defaultdict(dict)
        self._told: Counter[tuple[str, str]] = Counter()
        self._read: Counter[str] = Counter()
        self._clocks = _Clocks()
        self._chains = self._named_chains()
        self.first_ns: int | None = None

    # What is chosen.

    def _choose(self) -> None:
        mapping = self._parameters.mapping
        mappings = {} if mapping is None else read_mapping(Path(mapping))
        connections = self._bag.connections
        types = {each.type_name for each in connections}
        for name in mappings.keys() - types:
            raise BadInput(
                f"{mapping}: no topic of {self.path} is of type {name}; {choices(name, types)}"
            )
        asked, topics = self._parameters.topics, {each.topic for each in connections}
        truth = [] if self._parameters.truth is None else [self._parameters.truth]
        for topic in [*asked, *self._parameters.names, *truth]:
            if topic not in topics:
                raise BadInput(f"{self.path}: has no topic {topic}; {choices(topic, topics)}")
        known: dict[tuple, _Reader | str] = {}
        for each in connections:
            if asked and each.topic not in asked:
                self._not_taken[each.topic] = f"{each.type_name}, not asked for"
                continue
            key = (each.type_name, each.encoding, each.definition, each.topic.endswith("_static"))
            if key not in known:
                known[key] = self._reader(each, mappings.get(each.type_name))
            found = known[key]
            if isinstance(found, str):
                self._not_taken[each.topic] = f"{each.type_name or 'of no type'}{found}"
                if asked:
                    raise BadInput(
                        f"{self.path}: topic {each.topic} cannot be taken: it is "
                        f"{self._not_taken[each.topic]}; describe it with --set mapping=FILE.toml"
                    )
            else:
                self._readers[each] = found
        for topic in truth:
            reader = next((each for of, each in self._readers.items() if of.topic == topic), None)
            if not reader or not reader.taken or not any("pose" in kind for kind in reader.taken.kinds):
                raise BadInput(f"{self.path}: truth = {topic}: has no poses; name a topic that has some")
        if not self._readers:
            listed = (
                ", ".join(f"{topic} ({why})" for topic, why in sorted(self._not_taken.items()))
                or "no topics"
            )
            raise BadInput(f"{self.path}: holds nothing that can be imported: {listed}")

    def _reader(self, connection: Connection, mapping: MessageMapping | None) -> _Reader | str:
        """How a connection is read, or why it is not taken."""
        name = connection.type_name
        where = f"{self._parameters.mapping}: the mapping of {name}"
        is_transforms = name in TRANSFORM_TYPES
        if connection.encoding not in ("cdr", "ros1"):
            return f", in the encoding '{connection.encoding}', which is none of ROS"
        if mapping is None and not is_transforms and name not in TYPES:
            return ""
        try:
            definitions = definitions_of(name, connection.definition, self._parameters.distribution)
        except Undecodable as error:
            return f": {error}"
        kind = MessageType(name, definitions, "cdr" if connection.encoding == "cdr" else "ros1")
        if mapping is not None:
            known = kind.fields()
            for path in mapping.paths():
                if path not in known and not any(part.isdigit() for part in path.split(".")):
                    raise BadInput(f"{where}: the type has no number '{path}'; {choices(path, known)}")
            return _Reader(kind, taken(mapping, where), mapping.stamp, mapping.frame, is_static=False)
        is_static = connection.topic.endswith("_static")
        return _Reader(kind, TYPES.get(name), STAMP, FRAME, is_static)

    def _stream_names(self) -> dict[tuple[str, str], str]:
        """The name of a stream by topic and kind."""

        def below(topic: str, taken: Taken) -> str:
            own = topic if taken.is_doubtful else topic.rpartition("/")[0]
            return self._parameters.names.get(topic, own).rstrip("/")

        wanted = {
            (each.topic, kind): f"{below(each.topic, reader.taken)}/{kind}"
            for each, reader in self._readers.items()
            if reader.taken is not None
            for kind in reader.taken.kinds
        }
        if (truth := self._parameters.truth) is not None:
            above = self._parameters.names.get(truth, truth.rpartition("/")[0]).rstrip("/")
            wanted[truth, "truth"] = f"{above}/truth"
        counts = Counter(wanted.values())
        return {
            (topic, kind): name if counts[name] == 1 else f"{topic}/{kind}"
            for (topic, kind), name in wanted.items()
        }

    def is_wanted(self, connection: Connection) -> bool:
        """Whether the messages of a connection are read."""
        return connection in self._readers

    def _has_transforms(self, connection: Connection) -> bool:
        return connection in self._readers and self._readers[connection].taken is None

    def _transforms(
        self, topic: str, messages: Messages, log_time_ns: NDArray[np.int64]
    ) -> list[tuple[Pair, Transforms]]:
        try:
            return list(transforms_of(messages, log_time_ns))
        except BadInput as error:
            raise BadInput(f"{self.path}: topic {topic}: {error}") from None

    def _named_chains(self) -> list[Chain]:
        """The chains of the named pairs; all transforms of the bag are read once to find them."""
        pairs = []
        for text in self._parameters.transforms:
            parent, colon, child = text.partition(":")
            if not colon or not parent or not child:
                raise BadInput(
                    f"--set transforms={text}: expected a pair of frames, such as map:base_link"
                )
            pairs.append((parent, child))
        if not pairs:
            return []
        sent: Counter[Pair] = Counter()
        static: dict[Pair, Transforms] = {}
        for batch in self._bag.batches(self._has_transforms):
            reader = self._readers[batch.connection]
            for which, raw in by_size(batch.data, batch.begins, batch.lengths):
                for messages in reader.type.read(raw, which):
                    if isinstance(messages, Undecodable):
                        continue  # told when it is read for the streams
                    for pair, found in self._transforms(
                        batch.connection.topic, messages, batch.log_time_ns[messages.rows]
                    ):
                        if reader.is_static:
                            static[pair] = found
                        else:
                            sent[pair] += len(found)
        try:
            return [Chain(pair, sent, static) for pair in pairs]
        except BadInput as error:
            raise BadInput(f"{self.path}: {error}") from None

    # What is read.

    @property
    def is_full(self) -> bool:
        """Whether what waits is enough for a block."""
        return self._waiting_messages >= _BLOCK_MESSAGES or self._waiting_bytes >= _BLOCK_BYTES

    def add(self, batch: Batch) -> None:
        """Take up messages; they wait until there are enough for a block."""
        topic = batch.connection.topic
        for which, raw in by_size(batch.data, batch.begins, batch.lengths):
            pending = self._pending[batch.connection, raw.shape[1]]
            pending.raw.append(raw)
            pending.rows.append(which + self._read[topic])
            pending.log_time_ns.append(batch.log_time_ns[which])
            self._waiting_bytes += raw.nbytes
        self._read[topic] += len(batch.begins)
        self._waiting_messages += len(batch.begins)

    def block(self, *, is_last: bool = False) -> list[Stream]:
        """The streams of all that waits."""
        for (connection, _), pending in self._pending.items():
            rows, log_time_ns = np.concatenate(pending.rows), np.concatenate(pending.log_time_ns)
            reader = self._readers[connection]
            for found in reader.type.read(np.concatenate(pending.raw), rows):
                if isinstance(found, Undecodable):
                    self._told[connection.topic, f"cannot be decoded ({found}) and are left out"] += 1
                else:
                    logged = log_time_ns[np.searchsorted(rows, found.rows)]
                    self._take(connection.topic, reader, found, logged)
        self._pending.clear()
        self._waiting_messages = self._waiting_bytes = 0
        for chain in self._chains:
            composed = chain.composed(is_last=is_last)
            if composed is not None:
                self._put_transforms(
                    f"/tf/{'/'.join(chain.pair)}", "named transforms", chain.pair, composed
                )
        return [
            self._stream(topic, written) for topic, written in self._written.items() if written.pieces
        ]

    def _take(
        self, topic: str, reader: _Reader, messages: Messages, log_time_ns: NDArray[np.int64]
    ) -> None:
        if reader.taken is None:
            self._take_transforms(topic, messages, log_time_ns, is_static=reader.is_static)
            return
        stamp_ns = stamps_ns(messages, reader.stamp)
        self._clocks.note(topic, *_stamped(stamp_ns, log_time_ns))
        frames = [
            (name, messages.text(path) if path in messages.layout.texts else None)
            for name, path in (("frame_id", reader.frame), ("child_frame_id", CHILD_FRAME))
        ]
        for part in reader.taken.parts(messages):
            if topic == self._parameters.truth and part.schema is schemas.POSE:
                part = as_truth(part)
            keep = self._kept(topic, part, stamp_ns)
            for frame, which in _by_frame(frames, len(messages)):
                rows = np.flatnonzero(keep & (which if part.rows is None else which[part.rows]))
                if len(rows):
                    name = self._stream_name(topic, part.kind, frame)
                    of = rows if part.rows is None else part.rows[rows]
                    own = None if stamp_ns is None else stamp_ns[of]
                    taken_of = messages.rows[of]
                    self._put(name, topic, part, rows, own, log_time_ns[of], taken_of, frame)

    def _kept(self, topic: str, part: Part, stamp_ns: NDArray[np.int64] | None) -> NDArray[np.bool_]:
        """Which (k,) of a part are kept; the others are counted by reason."""
        size = len(next(iter(part.columns.values())))
        keep = np.ones(size, bool)
        dropped = dict(part.dropped)
        dropped["NaN or infinite"] = not_finite(part.schema, part.columns)
        if stamp_ns is not None and self._parameters.clock == "header":
            own = stamp_ns if part.rows is None else stamp_ns[part.rows]
            dropped["without a stamp in the header (--clock bag takes the bag's)"] = own == 0
        for reason, which in dropped.items():
            self._tell(topic, f"{part.kind} dropped: {reason}", int((which & keep).sum()))
            keep &= ~which
        for reason, which in part.doubtful.items():
            self._tell(topic, f"{part.kind} kept {reason}", int((which & keep).sum()))
        return keep

    def _stream_name(self, topic: str, kind: str, frame: Mapping[str, str]) -> str:
        """The stream of a topic, a kind and its frames; a second frame of the topic has its own."""
        key = (topic, kind, *frame.values())
        if key not in self._streams:
            name = self._names[topic, kind]
            is_first = name not in self._streams.values()
            self._streams[key] = name if is_first else "/".join([name, *filter(None, frame.values())])
        return self._streams[key]

    def _put(
        self,
        name: str,
        topic: str,
        part: Part,
        rows: NDArray[np.int64],
        stamp_ns: NDArray[np.int64] | None,
        log_time_ns: NDArray[np.int64],
        places: NDArray[np.int64],
        frame: Mapping[str, str],
    ) -> None:
        """Take up the rows (k,) of a part for a stream, with their stamps and places in the topic."""
        size = len(next(iter(part.columns.values())))
        which = slice(None) if len(rows) == size else rows
        where = f"{self.path}: topic {topic}"
        columns = {key: checked(where, key, column[which]) for key, column in part.columns.items()}
        constants = {key: column[which] for key, column in part.constants.items()}
        widths = {key: column.shape[1] for key, column in columns.items() if column.ndim == 2}
        if name not in self._written:
            stated = {key: _in_words(value[0]) for key, value in constants.items()}
            metadata = {**{key: each for key, each in frame.items() if each}, **part.metadata, **stated}
            first = {key: value[:1].copy() for key, value in constants.items()}
            self._written[name] = _Written(part.schema, metadata, widths, first)
        written = self._written[name]
        if widths != written.widths:
            self._tell(topic, f"{part.kind} dropped: of another length than the first", len(rows))
            return
        for key, value in constants.items():
            known = written.constants[key]
            same = ((value == known) | (np.isnan(value) & np.isnan(known))).all(axis=1)
            fact = f"{part.kind} kept whose {key} is not the first one's, which is stated"
            self._tell(topic, fact, int((~same).sum()))
        sensed = log_time_ns if stamp_ns is None else stamp_ns
        published = log_time_ns if self._parameters.clock == "bag" else sensed
        written.pieces.append(_Piece(places, published, log_time_ns, sensed, columns))
        self._came_of[topic][name] = None

    def _take_transforms(
        self, topic: str, messages: Messages, log_time_ns: NDArray[np.int64], *, is_static: bool
    ) -> None:
        if is_static:
            self._came_of[topic]["what named transforms are composed with"] = None
            return
        for pair, transforms in self._transforms(topic, messages, log_time_ns):
            self._clocks.note(topic, *_stamped(transforms.stamp_ns, transforms.log_time_ns))
            for chain in self._chains:
                chain.add(pair, transforms)
            if not self._chains:
                self._put_transforms("/".join([topic, *pair]), topic, pair, transforms)

    def _put_transforms(self, name: str, topic: str, pair: Pair, found: Transforms) -> None:
        unknown = np.full((len(found), 36), np.nan)
        columns = {"position_m": found.position_m, "quaternion": found.quaternion, "covariance": unknown}
        part = Part(name.removeprefix(topic + "/"), schemas.POSE, columns)
        rows = np.flatnonzero(self._kept(topic, part, found.stamp_ns))
        if len(rows):
            frame = dict(zip(("frame_id", "child_frame_id"), pair, strict=True))
            kept = found.take(rows)
            self._put(name, topic, part, rows, kept.stamp_ns, kept.log_time_ns, kept.rows, frame)

    def _stream(self, topic: str, written: _Written) -> Stream:
        """What waits for a stream, in the order in which the bag has it."""
        parts = written.pieces
        log_time_ns = np.concatenate([part.log_time_ns for part in parts])
        rows = np.concatenate([part.rows for part in parts])
        is_sorted = (np.diff(log_time_ns) >= 0).all() and (np.diff(rows) >= 0).all()
        order = slice(None) if is_sorted else np.lexsort((rows, log_time_ns))
        published = np.concatenate([part.publish_time_ns for part in parts])[order]
        steps_ns = np.diff(
            published, prepend=published[0] - 1 if written.last_ns < 0 else written.last_ns
        )
        self._tell(topic, "stamps repeat, and are kept", int((steps_ns == 0).sum()))
        self._tell(topic, "stamps go back, and are sorted", int((steps_ns < 0).sum()))
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

    # What is told.

    def _tell(self, subject: str, fact: str, count: int) -> None:
        if count:
            self._told[subject, fact] += count

    def check(self) -> None:
        """Raise BadInput where the stamps are of several clocks, or nothing has come of the bag."""
        if self._parameters.clock == "header":
            self._clocks.check(self.path, self._parameters.clock_tolerance_s)
        if not any(written.messages for written in self._written.values()):
            facts = "; ".join(f"{key}: {fact}" for key, fact in self.notes().items())
            raise BadInput(f"{self.path}: nothing of it could be imported: {facts}")

    def notes(self) -> dict[str, str]:
        """What the bag had, by subject."""
        notes = self._clocks.notes()
        counts: Counter[str] = Counter()
        types = {}
        for each in self._bag.connections:
            counts[each.topic] += each.messages
            types[each.topic] = each.type_name
        for topic, names in self._came_of.items():
            what = f"{self._read[topic]} {types[topic]}" if topic in types else "composed"
            notes[topic] = f"{what} as {', '.join(names)}"
        for chain in self._chains:
            static = chain.static
            if static is not None:
                place, turn = (_in_words(each[0]) for each in (static.position_m, static.quaternion))
                notes[":".join(chain.pair)] = f"is static, and no stream: {place} m, quaternion {turn}"
            if chain.left_out:
                notes[":".join(chain.pair)] = (
                    f"{chain.left_out} stamps left out at which a transform of the chain is not known"
                )
        for (subject, fact), count in self._told.items():
            notes[f"{subject}: {fact}"] = str(count)
        for topic, why in sorted(self._not_taken.items()):
            notes[f"not taken, {topic}"] = f"{counts[topic]} {why}"
        for number, loss in enumerate(self._bag.losses, start=1):
            notes[f"lost ({number})"] = loss.removeprefix(f"{self.path}: ")
        for topic, stated in self._bag.stated.items():
            missing = stated - self._read[topic]
            if topic in self._read and missing > 0:
                notes[f"lost, {topic}"] = f"{missing} of {stated} messages that metadata.yaml states"
        return notes


def _stamped(
    stamp_ns: NDArray[np.int64] | None, log_time_ns: NDArray[np.int64]
) -> tuple[NDArray[np.int64] | None, NDArray[np.int64]]:
    """The stamps of header and bag, where there is a header of those messages that have one in it."""
    if stamp_ns is None:
        return None, log_time_ns
    has_stamp = stamp_ns != 0
    return stamp_ns[has_stamp], log_time_ns[has_stamp]


def _by_frame(
    frames: Sequence[tuple[str, NDArray[np.bytes_] | None]], size: int
) -> Iterator[tuple[dict[str, str], NDArray[np.bool_]]]:
    """The frames that messages (n,) name, and which of them name these."""
    stated = [(name, values) for name, values in frames if values is not None]
    if not stated:
        yield {}, np.ones(size, bool)
        return
    is_one = all((values == values[0]).all() for _, values in stated)
    shown = [values[:1] if is_one else values for _, values in stated]
    for key in dict.fromkeys(zip(*(values.tolist() for values in shown), strict=True)):
        which = np.ones(size, bool)
        for (_, values), value in zip(stated, key, strict=True):
            which &= values == value
        names = (name for name, _ in stated)
        yield (
            {name: value.decode(errors="replace") for name, value in zip(names, key, strict=True)},
            which,
        )


def _in_words(values: NDArray) -> str:
    return ",".join(f"{value:.9g}" for value in values.tolist())


def read(path: Path, parameters: RosParameters) -> Blocks:
    """Read a bag block by block; what is dropped, doubtful, lost or not taken is told in the notes.

    The blocks raise BadInput where a bag cannot be read, what is asked for is not in it, or what it
    holds cannot be: quaternions that are not unit, latitudes beyond 90 deg, stamps of several clocks.
    """
    found = Blocks(iter(()))
    found.blocks = _blocks(path, parameters, found)
    return found


def _blocks(path: Path, parameters: RosParameters, told: Blocks) -> Iterator[list[Stream]]:
    with open_bag(path) as bag:
        work = _Import(bag, parameters)
        for batch in bag.batches(work.is_wanted):
            work.add(batch)
            if work.is_full:
                yield work.block()
        yield work.block(is_last=True)
        work.check()
        told.notes.update(work.notes())
        told.epoch_ns = work.first_ns or 0


ROS = Importer(
    "logs of ROS 1 and ROS 2: a .bag, .db3 or .mcap file, or the folder of a bag, split or not",
    RosParameters,
    read,
)
