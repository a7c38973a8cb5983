"""The log format: schemas, columns, and the reading and writing of MCAP files.

Begin with `streams`, which defines a topic in memory, then `reader` and `writer`.
"""

from fuselog.recorders.log.container.reading import NotMcap
from fuselog.recorders.log.mirrors import Mirror
from fuselog.recorders.log.opening import Log, Topic, open_log, topics_of
from fuselog.recorders.log.reader import read_blocks, read_empty, read_span, read_streams
from fuselog.recorders.log.run import RunMetadata
from fuselog.recorders.log.schemas import Field, Schema
from fuselog.recorders.log.streams import Clock, Stream, make_stream
from fuselog.recorders.log.writer import LogWriter, Mirrors, write_log

__all__ = [
    "Clock",
    "Field",
    "Log",
    "LogWriter",
    "Mirror",
    "Mirrors",
    "NotMcap",
    "RunMetadata",
    "Schema",
    "Stream",
    "Topic",
    "make_stream",
    "open_log",
    "read_blocks",
    "read_empty",
    "read_span",
    "read_streams",
    "topics_of",
    "write_log",
]
