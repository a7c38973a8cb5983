"""Measured vectors and their covariances, selected by the component names that streams state."""

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
# Components of a field if the channel does not state them, by their number.
_IMPLIED = {
    ("position_m", 2): "x_m,y_m",
    ("position_m", 3): "x_m,y_m,z_m",
    ("velocity_mps", 2): "vx_mps,vy_mps",
    ("velocity_mps", 3): "vx_mps,vy_mps,vz_mps",
}


class Vectors(NamedTuple):
    """Specification of the vectors to read from a topic.

    Attributes:
        fields: by field, the components, or the number of components if the schema defines them.
        covariance: field with the covariance of the first field, row-major, or "" if there is no such
            field.
        sigma: parameter that is used if the log lacks a covariance.
    """

    fields: Mapping[str, Components | int]
    covariance: str = ""
    sigma: str = ""

    def complaint(self, topic: str) -> str:
        """Return a sentence about messages of `topic` without a covariance; "" without such a field."""
        remedy = f"; give --set {self.sigma}=..." if self.sigma else ""
        return f"topic {topic}: {self.covariance} is missing{remedy}" if self.covariance else ""


class MeasuredVectors(NamedTuple):
    """Measured vectors (n, d), their covariances (n, d, d), and which covariances are missing (n,).

    If the log lacks a covariance (NaN, or a variance of zero), it is computed from the given sigma;
    without a sigma, it is missing. Components of the vector that are NaN need no covariance.
    """

    value: Floats
    covariance: Floats
    missing: NDArray[np.bool_]


def read_vectors(stream: Stream, field: str, wanted: Components) -> Floats:
    """Read the wanted components (n, d) of a vector field, in the wanted order.

    The channel's metadata names the components; positions with two or three components need no names.
    Raises BadInput if a component is missing, or if the vectors' width differs from the width that the
    channel states.

    Args:
        stream: the messages.
        field: field of the vector.
        wanted: components by name, with their kinds.
    """
    if not len(stream):
        return np.empty((0, len(wanted)))
    columns = match_components(_stated(stream, field), wanted, f"topic {stream.topic}: {field}")
    return np.ascontiguousarray(stream[field][:, columns])


def read_fixes(
    stream: Stream, field: str, covariance: str, wanted: Components, sigma: float | None
) -> MeasuredVectors:
    """Read wanted components of a vector field, and their covariance from another field.

    The covariance may be full (row-major) or diagonal. A horizontal position is accepted if a 3D
    position is wanted; its height is NaN. Raises BadInput as `read_vectors` does, and if the
    covariance's width does not fit the vector.

    Args:
        stream: the messages.
        field: field of the vector.
        covariance: field of its covariance.
        wanted: components by name, with their kinds.
        sigma: standard deviation of every component if a message states no covariance; None if unknown.
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
    """Find covariances (n, d, d) that have a NaN or a variance that is not positive."""
    smallest = over_columns(np.minimum, np.diagonal(covariance, axis1=1, axis2=2))
    entries = covariance.reshape(len(covariance), covariance.shape[1] ** 2)
    is_none: Booleans = ~(smallest > 0.0) | np.isnan(over_columns(np.add, entries))
    return is_none


def matrices(stream: Stream, field: str, covariance: str) -> Floats:
    """Read the covariances (n, d, d) of a vector field of d components, stored in full or as diagonals.

    Raises BadInput if the matrices have another width.

    Args:
        stream: the messages.
        field: field of the vector.
        covariance: field of its covariance.
    """
    size, width = stream[field].shape[1], stream[covariance].shape[1]
    if width == size**2:
        return stream[covariance].reshape(-1, size, size)
    if width == size:
        return stream[covariance][:, :, None] * np.eye(size)
    raise BadInput(
        f"topic {stream.topic}: {covariance} has {width} numbers; {size**2} are needed for the {size} "
        f"numbers of {field}"
    )


def covariances_of(stream: Stream, wanted: Components) -> Floats:
    """Read the covariances (n, t, t) of the wanted components of states, in the tangent space.

    Raises BadInput if the channel lacks one of the components.

    Args:
        stream: stream of states.
        wanted: components by name, with their kinds.
    """
    at = match_tangent(stream.metadata, wanted, f"topic {stream.topic}")
    size = isqrt(stream["covariance"].shape[1])
    whole: Floats = stream["covariance"].reshape(-1, size, size)
    return whole[:, at][:, :, at]


def _in_space(stream: Stream, field: str, covariance: str, wanted: Components) -> Stream:
    """Convert horizontal positions to 3D positions of unknown height, if 3D positions are wanted."""
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
    """Combine the fields after the sensor's clock in a table (n, width), and find missing covariances.

    Raises BadInput if vectors do not have the wanted form.

    Args:
        stream: the messages.
        vectors: how to read vector fields; None to read them as they are.
        parameters: the estimator's parameters.

    Returns:
        The table, and whether each row (n,) lacks a covariance.
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
    """Raise BadInput if a vector field does not have `width` numbers.

    Args:
        stream: the messages.
        field: field of the vector.
        width: required number of components.
    """
    if len(stream) and stream[field].shape[1] != width:
        raise BadInput(
            f"topic {stream.topic}: {field} has {stream[field].shape[1]} numbers; {width} are needed"
        )


def _stated(stream: Stream, field: str) -> Mapping[str, str]:
    """Return the components' names and kinds, as stated or as the field implies; check their number."""
    width = stream[field].shape[1]
    stated = stream.metadata
    if "components" not in stated:
        stated = {"components": _IMPLIED.get((field, width), "")}
    named = sum(1 for name in stated["components"].split(",") if name)
    if named not in (0, width):
        raise BadInput(
            f"topic {stream.topic}: the channel names {named} components ({stated['components']}), but "
            f"{field} has {width} numbers; name one component for each number"
        )
    return stated
