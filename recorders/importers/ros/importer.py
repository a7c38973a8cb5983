"""Importer of ROS logs: topics become streams, and notes report what is not imported.

The notes also compare the clocks of a bag: stamps of headers and of the bag, by topic.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.ros.choosing import RosParameters, choose, stream_names
from fuselog.recorders.importers.ros.files.bags import Bag, open_bag
from fuselog.recorders.importers.ros.files.raw import Batch, Connection
from fuselog.recorders.importers.ros.layouts import Messages, Undecodable, by_size
from fuselog.recorders.importers.ros.messages import CHILD_FRAME, Part, as_estimate, as_truth, stamps_ns
from fuselog.recorders.importers.ros.streams import Frames, Sent, StreamMaker, in_words
from fuselog.recorders.importers.ros.transforms import Chain, Mountings, Pair, Transforms, transforms_of
from fuselog.recorders.importers.stamps import to_ns
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.log.planes import Origin
from fuselog.recorders.recording import Blocks, Importer

# A block ends after this number of messages, or of bytes.
_BLOCK_MESSAGES = 1 << 17
_BLOCK_BYTES = 1 << 24


@dataclass
class _Pending:
    """Messages of one size that wait to be read together: bytes (n, size), rows and stamps."""

    raw: list[NDArray[np.uint8]] = field(default_factory=list)
    rows: list[NDArray[np.int64]] = field(default_factory=list)
    log_time_ns: list[NDArray[np.int64]] = field(default_factory=list)


class _Import:
    """The import of one bag: the chosen topics, the messages that wait to be read, and the notes."""

    def __init__(self, bag: Bag, parameters: RosParameters) -> None:
        self.path, self._bag, self._parameters = bag.path, bag, parameters
        self._readers, self._not_taken = choose(bag, parameters)
        names = stream_names(self._readers, parameters)
        self._truth = names.get((parameters.truth or "", "truth"), "/truth")
        origin = None if parameters.origin is None else Origin(*parameters.origin)
        self._streams = StreamMaker(bag.path, parameters.clock, names, origin, parameters.quaternions)
        self._pending: dict[tuple[Connection, int], _Pending] = defaultdict(_Pending)
        self._waiting_messages = self._waiting_bytes = 0
        self._read: Counter[str] = Counter()
        self._clocks, self._mountings = Clocks(), Mountings()
        self._chains = self._named_chains()

    # Reading.

    def is_wanted(self, connection: Connection) -> bool:
        """Test whether the messages of a connection are read."""
        return connection in self._readers

    @property
    def is_full(self) -> bool:
        """Test whether enough messages wait for a block."""
        return self._waiting_messages >= _BLOCK_MESSAGES or self._waiting_bytes >= _BLOCK_BYTES

    def add(self, batch: Batch) -> None:
        """Add messages, which wait until there are enough for a block."""
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
        """Make the streams of all waiting messages."""
        for (connection, _), pending in self._pending.items():
            rows, log_time_ns = np.concatenate(pending.rows), np.concatenate(pending.log_time_ns)
            for found in self._readers[connection].type.read(np.concatenate(pending.raw), rows):
                if isinstance(found, Undecodable):
                    fact = f"cannot be decoded ({found}) and are left out"
                    self._streams.tell(connection.topic, fact, 1)
                else:
                    logged = log_time_ns[np.searchsorted(rows, found.rows)]
                    self._take(connection, found, logged)
        self._pending.clear()
        self._waiting_messages = self._waiting_bytes = 0
        for chain in self._chains:
            composed = chain.composed(is_last=is_last)
            if composed is not None:
                name = f"/tf/{'/'.join(chain.pair)}"
                self._add_transforms(name, "named transforms", chain.pair, composed)
        return self._streams.block()

    def _take(self, connection: Connection, messages: Messages, log_time_ns: NDArray[np.int64]) -> None:
        topic, reader = connection.topic, self._readers[connection]
        if reader.taken is None:
            self._take_transforms(topic, messages, log_time_ns, is_static=reader.is_static)
            return
        stamps = stamps_ns(messages, reader.stamp, f"{self.path}: topic {topic}: ")
        sent = Sent(topic, messages.rows, stamps, log_time_ns)
        self._clocks.note(topic, sent.stamp_ns, log_time_ns)
        frames = _frames_of(messages, reader.frame)
        for part in reader.taken.parts(messages):
            is_truth = topic == self._parameters.truth
            if not is_truth and topic not in self._parameters.estimates:
                self._streams.add(sent, part, frames)
            elif part.schema is schemas.POSE:
                own = as_truth(part) if is_truth else as_estimate(part, self._truth)
                self._streams.add(sent, own, frames)
            else:
                whose = "the truth" if is_truth else "another filter"
                fact = f"{part.kind} left out, since filters must not use data from {whose}"
                self._streams.tell(topic, fact, len(messages))

    # Transforms.

    def _has_transforms(self, connection: Connection) -> bool:
        return connection in self._readers and self._readers[connection].taken is None

    def _transforms(
        self,
        topic: str,
        messages: Messages,
        log_time_ns: NDArray[np.int64],
        tell: Callable[[str, int], None],
    ) -> Iterator[tuple[Pair, Transforms]]:
        where, quaternions = f"{self.path}: topic {topic}", self._parameters.quaternions
        return transforms_of(messages, log_time_ns, where, quaternions, tell)

    def _named_chains(self) -> list[Chain]:
        """Make the chains of the requested pairs of frames; this reads all transforms once."""
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
                        continue  # counted when it is read for the streams
                    logged_ns = batch.log_time_ns[messages.rows]
                    for pair, found in self._transforms(
                        batch.connection.topic, messages, logged_ns, lambda *_: None
                    ):
                        if reader.is_static:
                            static[pair] = found
                        else:
                            sent[pair] += len(found)
        try:
            return [Chain(pair, sent, static) for pair in pairs]
        except BadInput as error:
            raise BadInput(f"{self.path}: {error}") from None

    def _take_transforms(
        self, topic: str, messages: Messages, log_time_ns: NDArray[np.int64], *, is_static: bool
    ) -> None:
        tell = partial(self._streams.tell, topic)
        for pair, transforms in self._transforms(topic, messages, log_time_ns, tell):
            self._mountings.add(pair, transforms)
            if is_static:
                what = "a part of named transforms and mountings"
                self._streams.came_of[topic][what] = None
                continue
            self._clocks.note(topic, transforms.stamp_ns, transforms.log_time_ns)
            for chain in self._chains:
                chain.add(pair, transforms)
            if not self._chains:
                self._add_transforms("/".join([topic, *pair]), topic, pair, transforms)

    def _add_transforms(self, name: str, topic: str, pair: Pair, found: Transforms) -> None:
        unknown = np.full((len(found), 36), np.nan)
        columns = {"position_m": found.position_m, "quaternion": found.quaternion, "covariance": unknown}
        part = Part(name.removeprefix(topic + "/"), schemas.POSE, columns)
        frame = dict(zip(("frame_id", "child_frame_id"), pair, strict=True))
        sent = Sent(topic, found.rows, found.stamp_ns, found.log_time_ns)
        self._streams.add(sent, part, [(frame, np.ones(len(found), bool))], name)

    # Notes.

    @property
    def first_ns(self) -> int:
        """Return the first publish time; zero if there is none."""
        return self._streams.first_ns or 0

    def check(self) -> None:
        """Raise BadInput if stamps are of several clocks, or nothing could be imported."""
        if self._parameters.clock == "header":
            self._clocks.check(self.path, self._parameters.clock_tolerance_s)
        if not self._streams.messages:
            facts = "; ".join(f"{key}: {fact}" for key, fact in self.notes().items())
            raise BadInput(f"{self.path}: none of its topics could be imported: {facts}")

    def notes(self) -> dict[str, str]:
        """Write notes on the contents of the bag, by subject."""
        notes = self._clocks.notes()
        counts: Counter[str] = Counter()
        types = {}
        for each in self._bag.connections:
            counts[each.topic] += each.messages
            types[each.topic] = each.type_name
        for topic, names in self._streams.came_of.items():
            what = f"{self._read[topic]} {types[topic]}" if topic in types else "composed"
            notes[topic] = f"{what} as {', '.join(names)}"
        for chain in self._chains:
            static = chain.static
            if static is not None:
                place, turn = (in_words(each[0]) for each in (static.position_m, static.quaternion))
                notes[":".join(chain.pair)] = (
                    f"is static, so it is not a stream: {place} m, quaternion {turn}"
                )
            if chain.left_out:
                notes[":".join(chain.pair)] = (
                    f"{chain.left_out} stamps left out, since a transform of the chain is unknown"
                )
        notes |= dict(self._mountings.notes(self._streams.described))
        notes |= self._streams.noise
        for (subject, fact), count in self._streams.counts.items():
            notes[f"{subject}: {fact}"] = str(count)
        for topic, why in sorted(self._not_taken.items()):
            notes[f"not taken, {topic}"] = f"{counts[topic]} {why}"
        for what, count in Counter(self._bag.others).items():
            notes[f"not taken, {what}"] = f"{count}, not a topic"
        for number, loss in enumerate(self._bag.losses, start=1):
            notes[f"lost ({number})"] = loss.removeprefix(f"{self.path}: ")
        for topic, stated in self._bag.stated.items():
            missing = stated - self._read[topic]
            if topic in self._read and missing > 0:
                notes[f"lost, {topic}"] = f"{missing} of {stated} messages that metadata.yaml states"
        return notes


def _frames_of(messages: Messages, frame: str) -> Frames:
    """Return the frames and child frames that messages (n,) name, and which messages name them."""
    stated = {
        name: messages.text(path)
        for name, path in (("frame_id", frame), ("child_frame_id", CHILD_FRAME))
        if path in messages.layout.texts
    }
    if not stated:
        return [({}, np.ones(len(messages), bool))]
    is_one = all((values == values[0]).all() for values in stated.values())
    shown = [values[:1] if is_one else values for values in stated.values()]
    found = []
    for key in dict.fromkeys(zip(*(values.tolist() for values in shown), strict=True)):
        which = np.ones(len(messages), bool)
        for values, value in zip(stated.values(), key, strict=True):
            which &= values == value
        names = [value.decode(errors="replace") for value in key]
        found.append((dict(zip(stated, names, strict=True)), which))
    return found


def read(path: Path, parameters: RosParameters) -> Blocks:
    """Read a bag block by block; notes report what is dropped, doubtful, lost or not imported.

    Iterating the blocks raises BadInput if the bag cannot be read, a requested topic is missing, or the
    data are impossible: quaternions not of unit length, latitudes beyond 90 deg, stamps of several
    clocks.
    """
    found = Blocks(iter(()))
    found.blocks = _blocks(path, parameters, found)
    return found


def _blocks(path: Path, parameters: RosParameters, result: Blocks) -> Iterator[list[Stream]]:
    with open_bag(path) as bag:
        work = _Import(bag, parameters)
        for batch in bag.batches(work.is_wanted):
            work.add(batch)
            if work.is_full:
                yield work.block()
        yield work.block(is_last=True)
        work.check()
        result.notes.update(work.notes())
        result.epoch_ns = work.first_ns


ROS = Importer(
    "logs of ROS 1 and ROS 2: a .bag, .db3 or .mcap file, or the folder of a bag, split or not",
    RosParameters,
    read,
)


@dataclass
class Clocks:
    """The spans of the header's stamps, the bag's stamps and their difference, in ns, by topic."""

    header: dict[str, tuple[int, int]] = field(default_factory=dict)
    bag: dict[str, tuple[int, int]] = field(default_factory=dict)
    offset: dict[str, tuple[int, int]] = field(default_factory=dict)

    def note(
        self, topic: str, stamp_ns: NDArray[np.int64] | None, log_time_ns: NDArray[np.int64]
    ) -> None:
        """Add the stamps of some messages (n,); without headers, only the bag's stamps."""
        if stamp_ns is not None:  # zero means no stamp
            stamp_ns, log_time_ns = stamp_ns[stamp_ns != 0], log_time_ns[stamp_ns != 0]
        if not len(log_time_ns):
            return
        if stamp_ns is not None:
            _widen(self.header, topic, stamp_ns)
        _widen(self.bag, topic, log_time_ns)
        behind = 0 * log_time_ns if stamp_ns is None else to_ns(log_time_ns, 1, -stamp_ns, where=topic)
        _widen(self.offset, topic, behind)

    def check(self, path: Path, tolerance_s: float) -> None:
        """Raise BadInput if topics have stamps of unrelated clocks."""
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
        """Describe the header's clock and the bag's clock, and the offset between them."""
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
    """Format a stamp as a date, or in seconds if it is before 2000, as in simulations."""
    if stamp_ns < 946_684_800_000_000_000:
        return f"{stamp_ns * 1e-9:.3f} s"
    return f"{datetime.fromtimestamp(stamp_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S} UTC"
