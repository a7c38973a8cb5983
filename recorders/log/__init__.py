"""The log contract: schemas, columns, and the reading and writing of MCAP files."""

from recorders.log.reader import Log, open_log, read_blocks, read_empty, read_streams
from recorders.log.run import RunMetadata
from recorders.log.schemas import Field, Schema
from recorders.log.streams import Stream, make_stream
from recorders.log.writer import LogWriter, write_log

__all__ = [
    "Field",
    "Log",
    "LogWriter",
    "RunMetadata",
    "Schema",
    "Stream",
    "make_stream",
    "open_log",
    "read_blocks",
    "read_empty",
    "read_streams",
    "write_log",
]
