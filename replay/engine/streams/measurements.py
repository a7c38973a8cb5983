"""Reads vectors that sensors measure, and their covariances, by the components that streams state."""

from collections.abc import Mapping
from dataclasses import replace
from math import isqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.replay.engine.arrays import Booleans, over_columns
from fuselog.replay.engine.vectors.components import Components, match_components, match_tangent

Floats = NDArray[np.float64]
PLANE: Components = {"x_m": "linear", "y_m": "linear"}
SPACE: Components = {**PLANE, "z_m": "linear"}
# What the numbers of a field are where the channel does not say, by how many there are.
_IMPLIED = {
    ("position_m", 2): "x_m,y_m",
    ("position_m", 3): "x_m,y_m,z_m",
    ("velocity_mps", 2): "vx_mps,vy_mps",
    ("velocity_mps", 3): "vx_mps,vy_mps,vz_mps",
}


class Vectors(NamedTuple):
    """Holds what is wanted of the vectors of a topic.

    Attributes:
        fields: by field, the components, or how many numbers where the schema says what they are.
        covariance: the field that holds the covariance of the first, row-major; "" where none does.
        sigma: the parameter that stands where the log lacks a covariance.
    """

    fields: Mapping[str, Components | int]
    covariance: str = ""
    sigma: str = ""

    def complaint(self, topic: str) -> str:
        """Say why messages of `topic` were not used; "" where no covariance could be missing."""
        mend = f"; give --set {self.sigma}=..." if self.sigma else ""
        return f"topic {topic}: {self.covariance} is missing{mend}" if self.covariance else ""


class MeasuredVectors(NamedTuple):
    """Holds measured vectors (n, d), their covariances (n, d, d), and what is missing (n,) of these.

    A covariance that the log lacks (NaN, or a variance of zero) is that of the given sigma, and missing
    where none is given. Components of the vector that are NaN need none.
    """

    value: Floats
    covariance: Floats
    missing: NDArray[np.bool_]


def read_vectors(stream: Stream, field: str, wanted: Components) -> Floats:
    """Return the wanted components (n, d) of a vector field, in the order wanted.

    The channel's metadata names them; positions of two or three numbers need no names. Raises BadInput
    where a component is missing, or the vectors have another width than the channel states.

    Args:
        stream: the messages.
        field: the vector's.
        wanted: components by name, with their kinds.
    """
    if not len(stream):
        return np.empty((0, len(wanted)))
    columns = match_components(_stated(stream, field), wanted, f"topic {stream.topic}: {field}")
    return np.ascontiguousarray(stream[field][:, columns])


def read_fixes(
    stream: Stream, field: str, covariance: str, wanted: Components, sigma: float | None
) -> MeasuredVectors:
    """Read wanted components of a vector field and its covariance, row-major or diagonal in another.

    `sigma` of every component stands where the covariance is unknown. A position in the plane serves
    where one in space is wanted: its height is NaN. Raises BadInput as `read_vectors`, and where the
    covariance has another width than the vector.

    Args:
        stream: the messages.
        field: the vector's.
        covariance: the field of its covariance.
        wanted: components by name, with their kinds.
        sigma: of every component where a message states no covariance; None for unknown.
    """
    stream = _in_space(stream, field, covariance, wanted)
    value = read_vectors(stream, field, wanted)
    if not len(stream):
        return MeasuredVectors(value, np.empty((0, len(wanted), len(wanted))), np.empty(0, bool))
    rows = match_tangent(_stated(stream, field), wanted, f"topic {stream.topic}: {field}")
    found = matrices(stream, field, covariance)[:, rows][:, :, rows]
    if len(rows) == len(wanted):
        is_absent = np.isnan(value)
        if is_absent.any():
            found[is_absent[:, :, None] | is_absent[:, None, :]] = 0.0
            found[:, range(len(rows)), range(len(rows))] += is_absent
    missing = unknown(found)
    if sigma is not None:
        found[missing] = sigma**2 * np.eye(len(rows))
        missing = np.zeros(len(stream), bool)
    return MeasuredVectors(value, found, missing)


def unknown(covariance: Floats) -> NDArray[np.bool_]:
    """Find which covariances (n, d, d) are none: NaN, or with a variance that is not positive."""
    smallest = over_columns(np.minimum, np.diagonal(covariance, axis1=1, axis2=2))
    entries = covariance.reshape(len(covariance), covariance.shape[1] ** 2)
    is_none: Booleans = ~(smallest > 0.0) | np.isnan(over_columns(np.add, entries))
    return is_none


def matrices(stream: Stream, field: str, covariance: str) -> Floats:
    """Read the covariances (n, d, d) of a vector field of d numbers, stated whole or as diagonals.

    Raises BadInput where they have another width.

    Args:
        stream: the messages.
        field: the vector's.
        covariance: the field of its covariance.
    """
    size, width = stream[field].shape[1], stream[covariance].shape[1]
    if width == size**2:
        return stream[covariance].reshape(-1, size, size)
    if width == size:
        return stream[covariance][:, :, None] * np.eye(size)
    raise BadInput(
        f"topic {stream.topic}: {covariance} has {width} numbers; {size**2} are needed for the {size} "
        f"of {field}"
    )


def covariances_of(stream: Stream, wanted: Components) -> Floats:
    """Compute the covariances (n, t, t) of the wanted components of states, in the tangent space.

    Raises BadInput where the channel lacks one of the components.

    Args:
        stream: of states.
        wanted: components by name, with their kinds.
    """
    at = match_tangent(stream.metadata, wanted, f"topic {stream.topic}")
    size = isqrt(stream["covariance"].shape[1])
    whole: Floats = stream["covariance"].reshape(-1, size, size)
    return whole[:, at][:, :, at]


def _in_space(stream: Stream, field: str, covariance: str, wanted: Components) -> Stream:
    """Return positions in the plane as such in space, of unknown height, where that is wanted."""
    is_plane = field == "position_m" and len(stream) and stream[field].shape[1] == 2
    if not is_plane or "z_m" not in wanted or "components" in stream.metadata:
        return stream
    spread = np.full((len(stream), 3, 3), np.nan)
    spread[:, :2, :2] = matrices(stream, field, covariance)
    place = np.concatenate([stream[field], np.full((len(stream), 1), np.nan)], axis=1)
    columns = {**stream.columns, field: place, covariance: spread.reshape(-1, 9)}
    return replace(stream, columns=columns)


def numbers_of(
    stream: Stream, vectors: Vectors | None, parameters: object
) -> tuple[Floats, NDArray[np.bool_]]:
    """Lay the fields after the sensor's clock side by side (n, width); which (n,) lack a covariance.

    Raises BadInput where vectors are not what is wanted.

    Args:
        stream: the messages.
        vectors: how vector fields are read; None for as they are.
        parameters: the estimator's.
    """
    fields = {} if vectors is None else vectors.fields
    columns = {entry.name: stream[entry.name] for entry in stream.schema}
    missing = np.zeros(len(stream), bool)
    for name, wanted in fields.items():
        if isinstance(wanted, int):
            check_width(stream, name, wanted)
        elif vectors is None or not vectors.covariance:
            columns[name] = read_vectors(stream, name, wanted)
        else:
            sigma = getattr(parameters, vectors.sigma) if vectors.sigma else None
            fixes = read_fixes(stream, name, vectors.covariance, wanted, sigma)
            columns[name], missing = fixes.value, fixes.missing
            columns[vectors.covariance] = fixes.covariance.reshape(len(stream), len(wanted) ** 2)
    parts = [column for name, column in columns.items() if name != "sensor_time_ns"]
    wide = [column if column.ndim == 2 else column[:, None] for column in parts]
    return np.concatenate(wide, axis=1, dtype=np.float64), missing


def check_width(stream: Stream, field: str, width: int) -> None:
    """Raise BadInput where a vector field does not have so many numbers.

    Args:
        stream: the messages.
        field: the vector's.
        width: how many numbers it has to have.
    """
    if len(stream) and stream[field].shape[1] != width:
        raise BadInput(
            f"topic {stream.topic}: {field} has {stream[field].shape[1]} numbers; {width} are needed"
        )


def _stated(stream: Stream, field: str) -> Mapping[str, str]:
    """Read the channel's names and kinds, or those that the field implies; checked against the width."""
    width = stream[field].shape[1]
    stated = stream.metadata
    if "components" not in stated:
        stated = {"components": _IMPLIED.get((field, width), "")}
    named = sum(1 for name in stated["components"].split(",") if name)
    if named not in (0, width):
        raise BadInput(
            f"topic {stream.topic}: its channel names {named} components "
            f"({stated['components']}), {field} has {width} numbers"
        )
    return stated
