"""Reader of ULog files in blocks: definitions at the beginning, then the rows of topics.

Unreadable parts are counted in `losses`. After a broken message, reading continues at the next
synchronisation message or sequence of rows; appended sections are read from their stated offsets.
"""

import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.ulog.loops import (
    BEYOND_BYTES,
    HEAD_BYTES,
    NUMBERS,
    Known,
    resume,
    sort,
    walk,
)

MAGIC = bytes.fromhex("554c6f67011235")
_SYNC = bytes.fromhex("080053") + bytes.fromhex("2f731320250cbb12")
_PIECE_BYTES = 1 << 23
_NUMBER_BYTES = 2
_NEVER = 1 << 62
_PASSED_OVER = "bytes that are not messages, skipped"
_RECENT_US = 1_000_000
_MONTH_US = 30 * 86_400_000_000
_LEVELS = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")

TYPES = {
    "int8_t": "<i1", "uint8_t": "<u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4",
    "uint32_t": "<u4", "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8",
    "bool": "<i1", "char": "<i1",
}  # fmt: skip
# A message's size has 16 bits, and two of its bytes are its number.
_MOST_BYTES = 0xFFFF - 2


class Damaged(Exception):
    """An error for a definition that cannot be used; the text gives the reason."""


class FormatField(NamedTuple):
    """One field of a format: its type, the length of its array (0: no array), and its name."""

    type: str
    length: int
    name: str


class Layout(NamedTuple):
    """The layout of a topic's messages in a file.

    `dtype` has a field for every number, such as `q[0]` or `esc[1].rpm`. It excludes padding at the end,
    which a message may lack: a message has between `dtype.itemsize` and `most_bytes` bytes. `stamp` is
    the position of its stamp.
    """

    dtype: np.dtype
    most_bytes: int
    stamp: int


def parsed(text: str) -> tuple[str, list[FormatField]]:
    """Parse the name and fields of a format; raise Damaged if this fails."""
    name, colon, rest = text.partition(":")
    if not colon or not name:
        raise Damaged("a format has no name")
    return name, [_field(name, each) for each in rest.split(";") if each]


def _field(of: str, text: str) -> FormatField:
    stated, _, name = text.partition(" ")
    kind, bracket, count = stated.partition("[")
    if not name or not kind or (bracket and not (count.endswith("]") and count[:-1].isdecimal())):
        raise Damaged(f"format {of} has a field that cannot be read")
    if len(count) > len("65535]"):
        raise Damaged(f"format {of} has an array of {count[:-1]}")
    return FormatField(kind, int(count[:-1]) if bracket else 0, name)


def layout_of(name: str, formats: Mapping[str, list[FormatField]]) -> Layout:
    """Determine a topic's layout; raise Damaged if its format is unknown, too long or recursive."""
    entries: list[tuple[str, str]] = []
    size = 0
    for entry, kind in _flat(name, formats, ()):
        entries.append((entry, TYPES[kind]))
        size += np.dtype(TYPES[kind]).itemsize
        if size > _MOST_BYTES:
            raise Damaged(f"format {name} is longer than a message can be")
    while entries and entries[-1][0].startswith("_padding"):
        entries.pop()
    try:
        dtype = np.dtype(entries)
    except ValueError:
        raise Damaged(f"format {name} has a field twice") from None
    if "timestamp" not in (dtype.names or ()) or dtype["timestamp"] != np.dtype("<u8"):
        raise Damaged(f"format {name} has no stamp")
    assert dtype.fields is not None
    return Layout(dtype, size, dtype.fields["timestamp"][1])


def _flat(
    name: str, formats: Mapping[str, list[FormatField]], within: tuple[str, ...], prefix: str = ""
) -> Iterator[tuple[str, str]]:
    """Yield the name and type of every number in a format."""
    if name in within:
        raise Damaged(f"format {name} refers to itself")
    if name not in formats:
        raise Damaged(f"format {name} is not defined")
    if not formats[name]:
        raise Damaged(f"format {name} has no fields")  # so that nesting ends
    for field in formats[name]:
        named = [f"{field.name}[{index}]" for index in range(field.length)] or [field.name]
        for each in named:
            if field.type in TYPES:
                yield prefix + each, field.type
            else:
                yield from _flat(field.type, formats, (*within, name), f"{prefix}{each}.")


class Rows(NamedTuple):
    """Some rows (n,) of an instance of a topic, in the order of the file or of their stamps.

    `time_us` are their stamps. A row without a stamp gets one between the stamps of its neighbours in
    the file; `untimed` counts these rows.
    """

    topic: str
    instance: int
    data: NDArray
    time_us: NDArray[np.int64]
    untimed: int


class Text(NamedTuple):
    """A message of the autopilot: time, severity and text."""

    time_us: int
    level: str
    text: str


class _Subscription(NamedTuple):
    """The topic, instance and layout of the rows with one message number."""

    topic: str
    instance: int
    layout: Layout


class UlogFile:
    """A ULog that is read once, from beginning to end.

    Attributes:
        path: the file.
        start_us: stamp at which logging began.
        info: information messages, by key.
        parameters: the autopilot's parameters at the beginning; `defaults` has their default values, if
            stated.
        changes: changed parameters: time, name, value.
        texts: messages of the autopilot.
        dropouts: stamp and length, both in us, of the losses that the logger reported.
        rows: number of rows of each topic and instance so far.
        losses: number of unreadable parts, by description.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.info: dict[str, str] = {}
        self.parameters: dict[str, float] = {}
        self.defaults: dict[str, float] = {}
        self.changes: list[tuple[int, str, float]] = []
        self.texts: list[Text] = []
        self.dropouts: list[tuple[int, int]] = []
        self.rows: Counter[tuple[str, int]] = Counter()
        self.losses: Counter[str] = Counter()
        self._formats: dict[str, list[FormatField]] = {}
        self._subscriptions: dict[int, _Subscription] = {}
        bounds = (0, 1 << 16, 0, _NEVER, _NEVER)
        self._known = Known(*(np.full(NUMBERS, each, np.int64) for each in bounds))
        self._appended: list[int] = []
        try:
            self._size = path.stat().st_size
            with path.open("rb") as file:
                self._begins = self._read_definitions(file)
        except OSError as error:
            raise BadInput(f"{path}: cannot be read ({error.strerror}); give a .ulg file") from error

    def blocks(self, is_wanted: Callable[[str], bool]) -> Iterator[list[Rows]]:
        """Yield the rows of the wanted topics, in blocks of a few megabytes of the file."""
        ends = sorted({each for each in self._appended if self._begins <= each < self._size})
        if len(ends) < len(self._appended):
            self.losses["appended section outside the file"] += 1
        try:
            with self.path.open("rb") as file:
                for begin, end in zip([self._begins, *ends], [*ends, self._size], strict=True):
                    yield from self._section(file, begin, end, is_wanted)
        except OSError as error:
            raise BadInput(f"{self.path}: cannot be read ({error.strerror}); copy it again") from error

    # Definitions.

    def _read_definitions(self, file: BinaryIO) -> int:
        """Read everything before the first subscription; return the position of that subscription."""
        head = file.read(16)
        if head[:7] != MAGIC or len(head) < 16:
            what = "is empty" if not head else "is not a ULog file"
            raise BadInput(f"{self.path}: {what}; give a .ulg file of PX4")
        self.start_us = int.from_bytes(head[8:], "little")
        if self.start_us >= 1 << 62:
            raise BadInput(
                f"{self.path}: its first stamp is invalid, so its header is damaged; copy the file again"
            )
        self._last_us = self.start_us
        position = len(head)
        while len(head := file.read(HEAD_BYTES)) == HEAD_BYTES:
            size, kind = struct.unpack("<HB", head)
            if chr(kind) in "ADLCSOR":
                break
            body = file.read(size)
            if len(body) < size:
                break
            if not size or not 65 <= kind <= 90:
                raise BadInput(
                    f"{self.path}: no message begins at byte {position}: the definitions are damaged, "
                    "and nothing after them can be read; copy the file again"
                )
            try:
                self._define(chr(kind), body)
            except Damaged as why:
                self.losses[str(why)] += 1
            position += HEAD_BYTES + size
        if not self._formats:
            raise BadInput(f"{self.path}: ends in its definitions, at byte {position}; copy it again")
        return position

    def _define(self, kind: str, body: bytes) -> None:
        if kind == "F":
            name, fields = parsed(_text(body))
            self._formats[name] = fields
        elif kind == "B" and len(body) >= 40 and body[8] & 1:
            self._appended = [each for each in struct.unpack("<3Q", body[16:40]) if each]
        elif kind == "P":
            name, value = _parameter(body)
            self.parameters[name] = value
        elif kind == "Q":
            name, value = _parameter(body[1:])
            self.defaults[name] = value
        elif kind == "I":
            stated, value_bytes = _keyed(body)
            of, _, key = stated.partition(" ")
            self.info[key] = (
                _text(value_bytes) if of.startswith("char") else str(_number(of, value_bytes))
            )

    # Data.

    def _section(
        self, file: BinaryIO, begin: int, end: int, is_wanted: Callable[[str], bool]
    ) -> Iterator[list[Rows]]:
        """Yield the rows between two bytes of the file; a message that crosses the end is ignored."""
        piece = min(_PIECE_BYTES, end - begin)
        held = bytearray(piece + BEYOND_BYTES)
        data, free = np.frombuffer(held, np.uint8), memoryview(held)[:piece]
        size, place, is_lost = 0, begin, False
        file.seek(begin)
        while True:
            size += file.readinto(free[size : max(end - place, 0)])  # type: ignore[attr-defined]
            is_last = place + size >= end or size < piece
            if is_lost:
                found = self._resumption(data, held, 0, size, place)
                is_lost = found < 0
                done = max(size - len(_SYNC), 0) if is_lost else found
                self.losses[_PASSED_OVER] += done
                if is_lost and is_last:
                    self.losses[_PASSED_OVER] += size - done
                    return
            else:
                done, is_broken, rows = self._walked(data, size, place, is_wanted)
                if rows:
                    yield rows
                is_lost = is_broken or (
                    is_last and self._resumption(data, held, done + 1, size, place) >= 0
                )
                if is_lost:
                    self.losses[_PASSED_OVER] += 1
                    done += 1
                elif is_last:
                    if done < size and end == self._size:
                        self.losses["bytes at the end that are not a complete message"] += size - done
                    return
            held[: size - done] = held[done:size]
            size, place = size - done, place + done

    def _resumption(
        self, data: NDArray[np.uint8], held: bytearray, begin: int, size: int, place: int
    ) -> int:
        """Return the position of the next sync message (old firmware has none) or row; -1 if neither."""
        found = [held.find(_SYNC, begin, size), resume(data, begin, size, place, self._known)]
        return min((each for each in found if each >= 0), default=-1)

    def _walked(
        self, data: NDArray[np.uint8], size: int, place: int, is_wanted: Callable[[str], bool]
    ) -> tuple[int, bool, list[Rows]]:
        """Parse a piece at `place`; return where messages end, whether one is broken, and the rows."""
        found = walk(data, size)
        others = [(each, *_message(data, each)) for each in found.others.tolist()]
        for position, kind, body in others:
            if kind == "A":
                self._subscribe(body, place + position)
        times = (self.start_us - _MONTH_US, self.start_us + _MONTH_US, self._last_us)
        of = sort(data, found.data, place, self._known, times)
        at, end, is_broken = found.data[: len(of.order)], found.end, found.is_broken
        if len(at) < len(found.data):
            self.losses["rows whose length does not match their format"] += 1
            end, is_broken = int(found.data[len(at)]), True
            others = [each for each in others if each[0] < end]
        time_us = of.stamps if of.is_timed.all() else self._times(at, of.stamps, of.is_timed)
        rows = []
        ends = np.cumsum(of.counts)
        for number in np.flatnonzero(of.counts[:NUMBERS]).tolist():
            subscription = self._subscriptions[number]
            which = of.order[ends[number] - of.counts[number] : ends[number]]
            untimed, count = 0, len(which)
            if not of.is_timed[which].all():
                has_stamp = of.stamps[which] != 0
                untimed = int((~has_stamp).sum())
                which = which[of.is_timed[which] | ~has_stamp]
                self.losses["rows whose stamp is more than a month from the log's beginning"] += (
                    count - len(which)
                )
            key = (subscription.topic, subscription.instance)
            self.rows[key] += len(which)
            if is_wanted(subscription.topic) and len(which):
                begins = at[which] + (HEAD_BYTES + _NUMBER_BYTES)
                values = _gathered(data, begins, subscription.layout.dtype)
                rows.append(Rows(*key, values, time_us[which], untimed))
        self._count_strays(of.order[ends[NUMBERS - 1] :], data, at)
        for position, kind, body in others:
            self._take(kind, body, int(of.reached[np.searchsorted(at, position)]))
        self._last_us = int(of.reached[-1])
        return end, is_broken, _joined(rows)

    def _count_strays(
        self, which: NDArray[np.int64], data: NDArray[np.uint8], at: NDArray[np.int64]
    ) -> None:
        """Count the rows without a topic: no topic has their number, or two topics have it."""
        begins = at[which] + HEAD_BYTES
        numbers = data[begins].astype(np.int64) + (data[begins + 1].astype(np.int64) << 8)
        is_known = self._known.since[numbers] < _NEVER
        self.losses["rows of no topic"] += int((~is_known).sum())
        self.losses["rows with a number that two topics share"] += int(is_known.sum())

    def _times(
        self, at: NDArray[np.int64], stamps: NDArray[np.int64], timed: NDArray[np.bool_]
    ) -> NDArray[np.int64]:
        """Compute the stamps (n,) of rows; missing stamps are interpolated between their neighbours."""
        last_us = self._last_us
        # A topic that stands still may have a stamp from long before.
        recent = np.flatnonzero(timed & (stamps >= last_us - _RECENT_US))
        known = np.concatenate([[0], stamps[recent] - last_us])
        between = np.interp(at, np.concatenate([[-1], at[recent]]), known)
        return np.where(timed, stamps, last_us + np.rint(between).astype(np.int64))

    def _subscribe(self, body: bytes, position: int) -> None:
        """Register the topic of a message number."""
        if len(body) < 4:
            self.losses["subscriptions that are too short"] += 1
            return
        instance, number = struct.unpack("<BH", body[:3])
        topic = _text(body[3:])
        known = self._subscriptions.get(number)
        if known is not None:
            if (known.topic, known.instance) != (topic, instance):
                self._known.until[number] = min(self._known.until[number], position)
                self.losses[f"number of {known.topic} that {topic} also uses"] += 1
            return
        try:
            layout = layout_of(topic, self._formats)
        except Damaged as why:
            self.losses[str(why)] += 1
            return
        self._subscriptions[number] = _Subscription(topic, instance, layout)
        stated = (layout.dtype.itemsize, layout.most_bytes, layout.stamp, position, _NEVER)
        for column, value in zip(self._known, stated, strict=True):
            column[number] = value

    def _take(self, kind: str, body: bytes, time_us: int) -> None:
        """Process a message of the data section that is not a row."""
        try:
            if kind == "P":
                self.changes.append((time_us, *_parameter(body)))
            elif kind == "O" and len(body) == 2:
                self.dropouts.append((time_us, 1000 * int.from_bytes(body, "little")))
            elif kind in "LC":
                begin = 1 if kind == "L" else 3
                level = body[0] - ord("0")
                stamp = int.from_bytes(body[begin : begin + 8], "little")
                if not 0 <= level < len(_LEVELS) or abs(stamp - self.start_us) > _MONTH_US:
                    raise Damaged("text that cannot be read")
                self.texts.append(Text(stamp, _LEVELS[level], _text(body[begin + 8 :])))
            elif kind == "Q":
                name, value = _parameter(body[1:])
                self.defaults[name] = value
            elif kind not in "AIMSR":
                raise Damaged("messages of an unknown type")
        except Damaged as why:
            self.losses[str(why)] += 1


def _joined(rows: list[Rows]) -> list[Rows]:
    """Join the rows of each topic's instance, which may use several message numbers, by stamp."""
    of_key: dict[tuple[str, int], list[Rows]] = {}
    for each in rows:
        of_key.setdefault((each.topic, each.instance), []).append(each)
    joined = []
    for key, parts in of_key.items():
        if len(parts) > 1:
            time_us = np.concatenate([each.time_us for each in parts])
            order = np.argsort(time_us, kind="stable")
            data = np.concatenate([each.data for each in parts])[order]
            parts = [Rows(*key, data, time_us[order], sum(each.untimed for each in parts))]
        joined += parts
    return joined


def _message(data: NDArray[np.uint8], position: int) -> tuple[str, bytes]:
    """Split a message into type and content."""
    size = int(data[position]) + (int(data[position + 1]) << 8)
    begin = position + HEAD_BYTES
    return chr(data[position + 2]), data[begin : begin + size].tobytes()


def _gathered(data: NDArray[np.uint8], begins: NDArray[np.int64], dtype: np.dtype) -> NDArray:
    """Gather the rows (n,) of a layout that begin at these bytes."""
    count = len(data) - dtype.itemsize + 1
    # As bytes, which NumPy copies several times faster than fields.
    every = np.ndarray((count,), f"V{dtype.itemsize}", data.data, strides=(1,))
    return every[begins].view(dtype)


def _text(body: bytes) -> str:
    return body.decode("utf-8", "replace")


def _keyed(body: bytes) -> tuple[str, bytes]:
    """Split a value's type and name from its bytes; raise Damaged if this fails."""
    if not body or len(body) < 1 + body[0]:
        raise Damaged("value without a name")
    return _text(body[1 : 1 + body[0]]), body[1 + body[0] :]


def _parameter(body: bytes) -> tuple[str, float]:
    """Read the name and value of a parameter; raise Damaged if this fails."""
    stated, value = _keyed(body)
    kind, _, name = stated.partition(" ")
    number = _number(kind, value) if kind in ("int32_t", "float") and name.isprintable() else None
    if not name or number is None:
        raise Damaged("parameter that cannot be read")
    return name, number


def _number(kind: str, value: bytes) -> float | None:
    """Read a number of one of ULog's types; return None if this fails."""
    dtype = np.dtype(TYPES[kind]) if kind in TYPES else None
    if dtype is None or len(value) != dtype.itemsize:
        return None
    return np.frombuffer(value, dtype)[0].item()
