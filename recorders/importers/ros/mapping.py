"""Messages of one's own: a TOML file says which of their fields become which stream.

[messages."my_robot_msgs/msg/Wheels"]
becomes = "VectorMeasurement"                 # one of fuselog's messages
fields = { value = ["left.speed", "right.speed"] }
factors = { value = 0.2777777777777778 }      # km/h to m/s
components = "left_mps,right_mps"
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recorders.errors import BadInput, choices
from recorders.importers.ros.layouts import Messages
from recorders.importers.ros.messages import FRAME, STAMP, Part, Taken
from recorders.log import Schema, schemas
from recorders.parameters import Parameters, build
from recorders.parsing import read_toml

# How many numbers a vector has that may be missing.
_WIDTHS = {"covariance_m2": 9, "covariance": 36, "covariance_ut2": 9, "magnetic_field_ut": 3}


class MessageMapping(Parameters):
    """What messages of one type become.

    `becomes` is the name of one of fuselog's messages; `fields` has for each of its fields the path of a
    field of the ROS message, or a list of them for a vector, and `factors` what they are multiplied by.
    `name` is the last part of the stream's name, `stamp` where a time or a whole number of ns is.
    """

    becomes: str
    fields: dict[str, str | list[str]] = Field(min_length=1)
    factors: dict[str, float] = {}
    components: str = ""
    name: str = "value"
    stamp: str = STAMP
    frame: str = FRAME

    def paths(self) -> list[str]:
        """Those of all fields."""
        return [path for paths in self.fields.values() for path in _listed(paths)]


class Mapping(Parameters):
    """The mappings of a file, by the names of the types, such as `my_robot_msgs/msg/Wheels`."""

    messages: dict[str, MessageMapping]


def read_mapping(path: Path) -> dict[str, MessageMapping]:
    """A file of mappings; raises BadInput where it is none, or names what fuselog has not."""
    found = build(Mapping, read_toml(path), str(path)).messages
    for name, mapping in found.items():
        where = f"{path}: the mapping of {name}"
        schema = _schema(mapping, where)
        known = {entry.name: entry for entry in list(schema)[1:]}
        for field in {**mapping.fields, **mapping.factors}:
            if field not in known:
                raise BadInput(f"{where}: {schema.name} has no field '{field}'; {choices(field, known)}")
        for entry in known.values():
            is_needed = not (entry.may_be_nan or entry.may_be_absent or entry.kind == "identifier")
            if is_needed and entry.name not in mapping.fields:
                raise BadInput(f"{where}: gives no field for {schema.name}'s {entry.name}")
    return found


def taken(mapping: MessageMapping, where: str) -> Taken:
    """What reads messages by a mapping; it raises BadInput where they lack a field."""
    schema = _schema(mapping, where)
    metadata = {}
    if mapping.components:
        kinds = ",".join("linear" for _ in mapping.components.split(","))
        metadata = {"components": mapping.components, "kinds": kinds}

    def parts(messages: Messages) -> Iterator[Part]:
        columns = {}
        for entry in list(schema)[1:]:
            if entry.name in mapping.fields:
                parts = [_numbers(messages, path, where) for path in _listed(mapping.fields[entry.name])]
                factor = mapping.factors.get(entry.name, 1)
                joined = np.concatenate(parts, axis=1) * factor
                columns[entry.name] = joined if entry.kind == "vector" else joined[:, 0]
            elif entry.kind == "identifier":
                columns[entry.name] = np.zeros(len(messages), np.uint32)
            elif entry.kind == "real":
                columns[entry.name] = np.full(len(messages), np.nan)
            else:
                columns[entry.name] = np.full((len(messages), _WIDTHS.get(entry.name, 0)), np.nan)
        yield Part(mapping.name, schema, columns, metadata)

    return Taken((mapping.name,), parts)


def _schema(mapping: MessageMapping, where: str) -> Schema:
    known = {schema.name: schema for schema in schemas.SCHEMAS.values()}
    if mapping.becomes not in known:
        raise BadInput(
            f"{where}: fuselog has no message '{mapping.becomes}'; {choices(mapping.becomes, known)}"
        )
    return known[mapping.becomes]


def _listed(paths: str | list[str]) -> list[str]:
    return [paths] if isinstance(paths, str) else paths


def _numbers(messages: Messages, path: str, where: str) -> NDArray:
    """A field (n, width)."""
    if path not in messages.layout.numbers:
        known = list(messages.layout.numbers)
        raise BadInput(f"{where}: the message has no number '{path}'; {choices(path, known)}")
    found = messages.numbers(path)
    return found if found.ndim == 2 else found[:, None]
