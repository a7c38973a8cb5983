"""Mappings of user-defined messages: a TOML file states which of their fields become which stream.

[messages."my_robot_msgs/msg/Wheels"]
becomes = "VectorMeasurement"                 # one of fuselog's messages
fields = { value = ["left.speed", "right.speed"] }
units = { value = "km/h" }
components = "left_mps,right_mps"
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.importers.mapping import Source, StreamMapping, mapped, schema_of
from fuselog.recorders.importers.ros.layouts import Messages
from fuselog.recorders.importers.ros.messages import FRAME, STAMP, Part, Taken
from fuselog.recorders.parameters import Parameters, build
from fuselog.recorders.parsing import read_toml


class MessageMapping(StreamMapping):
    """How messages of one type are converted; sources are paths of their fields.

    Attributes:
        name: last part of the stream's name.
        stamp: path of the field that states when the message was measured: a time, or a whole number of
            ns.
        frame: path of the field with the name of the frame.
    """

    name: str = "value"
    stamp: str = STAMP
    frame: str = FRAME

    def paths(self) -> list[str]:
        """Return the paths of all fields that are used."""
        return [*self.sources(), *(source for source, _ in self.conditions())]


class Mapping(Parameters):
    """The mappings in a file.

    Attributes:
        messages: mappings by the name of the type, such as `my_robot_msgs/msg/Wheels`.
    """

    messages: dict[str, MessageMapping] = Field(min_length=1)


def read_mapping(path: Path) -> dict[str, MessageMapping]:
    """Read a file of mappings; raise BadInput if it is invalid, or names unknown messages or fields."""
    found = build(Mapping, read_toml(path), str(path)).messages
    for name, mapping in found.items():
        schema_of(mapping, f"{path}: the mapping of {name}")
    return found


def taken(mapping: MessageMapping, where: str) -> Taken:
    """Make the reader of messages for a mapping; it raises BadInput if a message lacks a field."""
    schema = schema_of(mapping, where)

    def parts(messages: Messages) -> Iterator[Part]:
        def read(path: str) -> NDArray:
            if path not in messages.layout.numbers:
                known = list(messages.layout.numbers)
                raise BadInput(
                    f"{where}: this message has no numeric field '{path}'; {choices(path, known)}"
                )
            return messages.numbers(path)

        def holds(path: str, values: Sequence[Source]) -> NDArray[np.bool_]:
            return np.isin(read(path), [value for value in values if isinstance(value, float)])

        found = mapped(mapping, len(messages), read, holds, where)
        yield Part(
            mapping.name,
            schema,
            found.columns,
            mapping.metadata,
            rows=found.rows if mapping.each else None,
            dropped=found.dropped,
        )

    return Taken((mapping.name,), parts)
