"""The sqlite3 files of ROS 2 (.db3), opened so that nothing beside them is made or changed.

Source: rosbag2_storage_sqlite3; definitions of the types are in it since version 4 of its tables.
"""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import zstandard
from rosbags.interfaces import MessageDefinition

from recorders.errors import BadInput
from recorders.importers.ros.raw import FORMATS, UNDEFINED, Batch, Connection

_ROWS = 4096


class SqliteFile:
    """A .db3 file; see `BagFile`. Raises BadInput where it is none, or cannot be read.

    With `zstd`, every message is compressed by itself.
    """

    def __init__(self, path: Path, *, zstd: bool = False) -> None:
        self.path = path
        self._zstd = zstd
        self.losses: list[str] = []
        try:
            with closing(self._open()) as database:
                self._by_id = dict(_connections(database))
        except sqlite3.Error as error:
            raise BadInput(f"{path}: cannot be read as a sqlite3 bag of ROS 2 ({error})") from None
        self.connections = list(self._by_id.values())
        journal = path.with_name(path.name + "-wal")
        if journal.exists() and journal.stat().st_size:
            self.losses.append(
                f"{path}: was not closed; the messages in {journal.name} are not read, "
                "until ros2 bag reindex has put them into it"
            )

    def _open(self) -> sqlite3.Connection:
        uri = f"{self.path.resolve().as_uri()}?immutable=1"
        return sqlite3.connect(uri, uri=True)

    def batches(self, wanted: Callable[[Connection], bool]) -> Iterator[Batch]:
        """The messages of the wanted connections, some thousand rows at a time."""
        chosen = [number for number, each in self._by_id.items() if wanted(each)]
        places = ",".join("?" * len(chosen))
        query = (
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({places}) ORDER BY id"
        )
        last = "none"
        with closing(self._open()) as database:
            try:
                rows = database.execute(query, chosen)
                while found := rows.fetchmany(_ROWS):
                    last = str(found[-1][1])
                    for number in dict.fromkeys(row[0] for row in found):
                        yield self._batch(number, [row for row in found if row[0] == number])
            except sqlite3.Error as error:
                self.losses.append(
                    f"{self.path}: is damaged ({error}); what follows the message of time {last} is lost"
                )

    def _batch(self, number: int, rows: list[tuple[int, int, bytes]]) -> Batch:
        parts = [zstandard.decompress(row[2]) if self._zstd else row[2] for row in rows]
        lengths = np.array([len(part) for part in parts], np.int64)
        data = np.frombuffer(b"".join(parts), np.uint8)
        stamps_ns = np.array([row[1] for row in rows], np.int64)
        return Batch(self._by_id[number], data, np.cumsum(lengths) - lengths, lengths, stamps_ns)


def _connections(database: sqlite3.Connection) -> Iterator[tuple[int, Connection]]:
    """The topics by their numbers, with the definitions of their types where the file has them."""
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
    try:
        counts = dict(database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
    except sqlite3.DatabaseError:
        counts = {}  # it is damaged, which the reading tells
    for number, topic, name, encoding in database.execute(
        "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
    ):
        definition = definitions.get(name, UNDEFINED)
        yield number, Connection(topic, name, encoding, definition, counts.get(number, 0))
