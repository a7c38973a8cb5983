"""Reader of the sqlite3 files of ROS 2 (.db3); it neither creates nor changes files next to them.

Source: rosbag2_storage_sqlite3; definitions of types are included since version 4 of its tables.
"""

import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from shlex import quote

import numpy as np
from rosbags.interfaces import MessageDefinition

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.ros.files.raw import FORMATS, UNDEFINED, Batch, Connection, joined

_ROWS = 4096
# Topic, stamp in ns, message.
_Row = tuple[int, int, bytes]


class SqliteFile:
    """A .db3 file; see `BagFile`. Raises BadInput if the file is not a .db3 file, or cannot be read."""

    def __init__(self, path: Path, scratch: Path) -> None:
        self.path = path
        self.others: list[str] = []
        self._losses: dict[str, str] = {}
        try:
            self._place = _whole_pages(path, scratch)
            with closing(self._open()) as database:
                self._by_id = dict(_connections(database))
                counts = self._counts(database)
        except OSError as error:
            raise BadInput(f"{path}: cannot be read ({error.strerror})") from None
        except sqlite3.Error as error:
            raise BadInput(
                f"{path}: cannot be read as a sqlite3 bag of ROS 2 ({error}){self._remedy(error)}"
            ) from None
        self._by_id = {
            number: each._replace(messages=counts.pop(number, 0)) for number, each in self._by_id.items()
        }
        self.connections = list(self._by_id.values())
        if counts:
            self._losses["topics"] = f"{counts.total()} messages have no topic and are lost"
        journal = path.with_name(path.name + "-wal")
        if journal.exists() and journal.stat().st_size:
            self._losses["journal"] = (
                f"was not closed; the messages in {journal.name} are not read; run ros2 bag reindex to "
                "add them to it"
            )

    @property
    def losses(self) -> list[str]:
        """Return a sentence for each part that cannot be read."""
        return [f"{self.path}: {loss}" for loss in self._losses.values()]

    def _open(self) -> sqlite3.Connection:
        database = sqlite3.connect(f"{self._place.resolve().as_uri()}?immutable=1", uri=True)
        # nothing is written; but without this, SQLite rejects a truncated file as a whole
        database.execute("PRAGMA writable_schema = ON")
        return database

    def _counts(self, database: sqlite3.Connection) -> Counter[int]:
        """Count the messages of each topic; in a damaged file, those that can be read."""
        try:
            return Counter(dict(database.execute("SELECT topic_id, count(*) FROM messages GROUP BY 1")))
        except sqlite3.DatabaseError:
            return Counter(row[0] for row in self._rows(database, "NULL"))

    def _remedy(self, error: sqlite3.Error) -> str:
        """Name a command that may recover more of a damaged file."""
        # Python's own errors, for example on a text that is not UTF-8, have no code
        if getattr(error, "sqlite_errorcode", None) != sqlite3.SQLITE_CORRUPT:
            return ""
        command = f"sqlite3 {quote(str(self.path))} .recover | sqlite3 whole.db3"
        return f"; `{command}` may recover more of it"

    def batches(self, wanted: Callable[[Connection], bool]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections, a few thousand rows at a time."""
        chosen = [number for number, each in self._by_id.items() if wanted(each)]
        with closing(self._open()) as database:
            rows = self._messages(database, chosen)
            while found := list(islice(rows, _ROWS)):
                for number in dict.fromkeys(row[0] for row in found):
                    own = [row for row in found if row[0] == number]
                    stamps_ns = np.array([row[1] for row in own], np.int64)
                    yield joined(self._by_id[number], [row[2] for row in own], stamps_ns)

    def _messages(self, database: sqlite3.Connection, chosen: Sequence[int]) -> Iterator[_Row]:
        """Yield the messages of some topics; count rows that are not messages."""
        strange = 0
        where = f"WHERE topic_id IN ({','.join('?' * len(chosen))})"
        for row in self._rows(database, "data", where, chosen):
            if type(row[1]) is int and type(row[2]) is bytes:
                yield row
            else:
                strange += 1
        if strange:
            self._losses["strange"] = (
                f"{strange} rows of messages have no integer stamp or no bytes, and are lost"
            )

    def _rows(
        self, database: sqlite3.Connection, data: str, where: str = "", values: Sequence[int] = ()
    ) -> Iterator[_Row]:
        """Yield rows in file order, as far as they can be read."""
        query = f"SELECT topic_id, timestamp, {data} FROM messages {where} ORDER BY id"
        row = None
        try:
            for row in database.execute(query, values):
                yield row
        except sqlite3.Error as error:
            behind = (
                "all messages are" if row is None else f"all messages after the one at time {row[1]} are"
            )
            self._losses["damage"] = f"is damaged ({error}); {behind} lost{self._remedy(error)}"


def _whole_pages(path: Path, scratch: Path) -> Path:
    """Return a database without a truncated last page, which SQLite would fill with zeros."""
    with path.open("rb") as file:
        page_bytes = int.from_bytes(file.read(18)[16:], "big")
    size = path.stat().st_size
    # 1 stands for 65536; a file with another invalid size is not a database
    partial = size % (65536 if page_bytes == 1 else page_bytes or 1)
    if not partial:
        return path
    place = scratch / f"whole-{path.name}"
    shutil.copyfile(path, place)
    os.truncate(place, size - partial)
    return place


def _connections(database: sqlite3.Connection) -> Iterator[tuple[int, Connection]]:
    """Yield the topics with their numbers, and the definitions of their types if the file has them."""
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
        yield number, Connection(topic, name, encoding, definitions.get(name, UNDEFINED), 0)
