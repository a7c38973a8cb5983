"""Maps messages of one's own: a TOML file says which of their fields become which stream.

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
    """Holds what messages of one type become; sources are paths of their fields.

    Attributes:
        name: last part of the stream's name.
        stamp: path of a time or a whole number of ns that says when it was measured.
        frame: path of the name of the frame.
    """

    name: str = "value"
    stamp: str = STAMP
    frame: str = FRAME

    def paths(self) -> list[str]:
        """Return the paths of all fields."""
        return [*self.sources(), *(source for source, _ in self.conditions())]


class Mapping(Parameters):
    """Holds the mappings of a file.

    Attributes:
        messages: what becomes of messages, by the name of their type, such as
            `my_robot_msgs/msg/Wheels`.
    """

    messages: dict[str, MessageMapping] = Field(min_length=1)


def read_mapping(path: Path) -> dict[str, MessageMapping]:
    """Return a file of mappings; raises BadInput where it is none, or names what fuselog has not."""
    found = build(Mapping, read_toml(path), str(path)).messages
    for name, mapping in found.items():
        schema_of(mapping, f"{path}: the mapping of {name}")
    return found


def taken(mapping: MessageMapping, where: str) -> Taken:
    """Make what reads messages by a mapping; it raises BadInput where they lack a field."""
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
