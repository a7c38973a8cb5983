"""Reads the sqlite3 files of ROS 2 (.db3) so that nothing beside them is made or changed.

Source: rosbag2_storage_sqlite3; definitions of the types are in it since version 4 of its tables.
"""

import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np
from rosbags.interfaces import MessageDefinition

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.ros.files.raw import FORMATS, UNDEFINED, Batch, Connection, joined
from fuselog.recorders.importers.ros.files.sqlite_pages import missing_bytes, whole_rows

_ROWS = 4096
# Topic, stamp in ns, message.
_Row = tuple[int, int, bytes]


class SqliteFile:
    """Reads a .db3 file; see `BagFile`. Raises BadInput where it is none, or cannot be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.others: list[str] = []
        self.losses: list[str] = []
        try:
            self._missing_bytes = missing_bytes(path)
            with closing(self._open()) as database:
                self._by_id = dict(_connections(database, self._counts(database)))
        except OSError as error:
            raise BadInput(f"{path}: cannot be read ({error.strerror})") from None
        except sqlite3.Error as error:
            raise BadInput(f"{path}: cannot be read as a sqlite3 bag of ROS 2 ({error})") from None
        if self._missing_bytes:
            self.losses.append(
                f"{path}: it was cut off: the messages in its last {self._missing_bytes} bytes are lost"
            )
        self.connections = list(self._by_id.values())
        journal = path.with_name(path.name + "-wal")
        if journal.exists() and journal.stat().st_size:
            self.losses.append(
                f"{path}: was not closed; the messages in {journal.name} are not read, "
                "until ros2 bag reindex has put them into it"
            )

    def _counts(self, database: sqlite3.Connection) -> Counter[int]:
        """Count the messages that each topic has."""
        if self._missing_bytes:
            return Counter(row[0] for row in whole_rows(self.path))
        try:
            return Counter(dict(database.execute("SELECT topic_id, count(*) FROM messages GROUP BY 1")))
        except sqlite3.DatabaseError:
            return Counter()  # it is damaged, which the reading tells

    def _open(self) -> sqlite3.Connection:
        uri = f"{self.path.resolve().as_uri()}?immutable=1"
        database = sqlite3.connect(uri, uri=True)
        # nothing is written; but without this, a file that was cut off is refused as a whole
        database.execute("PRAGMA writable_schema = ON")
        return database

    def batches(self, wanted: Callable[[Connection], bool]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections, some thousand rows at a time."""
        chosen = [number for number, each in self._by_id.items() if wanted(each)]
        with closing(self._open()) as database:
            for found in _some_at_a_time(self._rows(database, chosen)):
                for number in dict.fromkeys(row[0] for row in found):
                    yield self._batch(number, [row for row in found if row[0] == number])

    def _rows(self, database: sqlite3.Connection, chosen: Sequence[int]) -> Iterator[_Row]:
        """Yield the rows of some topics, in file order, as far as they can be read."""
        if self._missing_bytes:
            yield from (row for row in whole_rows(self.path) if row[0] in chosen)
            return
        places = ",".join("?" * len(chosen))
        query = (
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({places}) ORDER BY id"
        )
        row, strange = None, 0
        try:
            for row in database.execute(query, chosen):
                if type(row[1]) is int and type(row[2]) is bytes:
                    yield row
                else:
                    strange += 1
        except sqlite3.Error as error:
            behind = "all messages are" if row is None else f"what follows the one of time {row[1]} is"
            self.losses.append(f"{self.path}: is damaged ({error}); {behind} lost")
        if strange:
            self.losses.append(
                f"{self.path}: {strange} rows of messages have no whole stamp or no bytes, and are lost"
            )

    def _batch(self, number: int, rows: list[_Row]) -> Batch:
        stamps_ns = np.array([row[1] for row in rows], np.int64)
        return joined(self._by_id[number], [row[2] for row in rows], stamps_ns)


def _some_at_a_time(rows: Iterator[_Row]) -> Iterator[list[_Row]]:
    while found := list(islice(rows, _ROWS)):
        yield found


def _connections(database: sqlite3.Connection, counts: Counter[int]) -> Iterator[tuple[int, Connection]]:
    """Yield the topics by their numbers, with the definitions of their types where the file has them."""
    definitions = {}
    if database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
        stated = database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        definitions = {
            name: MessageDefinition(FORMATS[encoding], text)
            for name, encoding, text in stated
            if encoding in FORMATS
        }
    for number, topic, name, encoding in database.execute(
        "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
    ):
        definition = definitions.get(name, UNDEFINED)
        yield number, Connection(topic, name, encoding, definition, counts[number])
