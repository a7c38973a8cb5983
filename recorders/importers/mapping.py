"""The language of mappings: how fields of fuselog's messages are made from data in other formats.

The mappings of ROS messages (`importers.ros.mapping`) and of tables (`importers.tables`) share it; each
defines what a source is: a field of a message, or a column.

becomes = "InertialSample"                        # one of fuselog's messages
fields = { specific_force_mps2 = ["ax", "ay", "az"], turn_rate_radps = ["gx", "gy", "gz"] }
units = { specific_force_mps2 = "g", turn_rate_radps = "deg/s" }   # of the sources
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat
from scipy.spatial.transform import Rotation

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import Schema, schemas
from fuselog.recorders.models.orientation import compose
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.units import conversion

Floats = NDArray[np.float64]
Value = TypeVar("Value")
Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
# Latitude and longitude in deg, and optionally the height above the ellipsoid in m.
Place = tuple[Latitude, Longitude] | tuple[Latitude, Longitude, float]
# The name of a source, or a constant for every message.
Source = str | float
OneOrMore: TypeAlias = Value | list[Value]
# Reads the numbers (n,) or (n, width) of a source.
Read = Callable[[str], NDArray]
# Tests for each of n messages whether a source has one of the given values.
Holds = Callable[[str, Sequence[Source]], NDArray[np.bool_]]

# How to treat messages whose quaternions are far from unit length.
Quaternions = Literal["refuse", "normalise", "skip"]
NOT_UNIT = "a quaternion that is not of unit length"
SCALED = "a quaternion that was scaled to unit length"

# The width of vectors that may be missing.
_WIDTHS = {"covariance_m2": 9, "covariance_m2ps2": 9, "covariance": 36, "covariance_ut2": 9}
_WIDTHS |= {"magnetic_field_ut": 3}
# The widths of other vectors; positions and velocities may be two-dimensional.
_LENGTHS: dict[str, tuple[int, ...]] = {
    "specific_force_mps2": (3,), "turn_rate_radps": (3,), "magnetic_field_ut": (3,),
    "position_m": (2, 3), "velocity_mps": (2, 3), "quaternion": (4,),
}  # fmt: skip
# Vectors whose components are stated by the channel.
# Fields in the axes of the body, by message, and the covariances of these fields.
_STATED = ("value", "state", "mean")
_UNIT_TOLERANCE = 1e-3
# Fields in the axes of the body, by message, and the covariances of these.
_IN_BODY = {
    "InertialSample": (("specific_force_mps2", "turn_rate_radps", "magnetic_field_ut"), ""),
    "MagneticField": (("magnetic_field_ut",), "covariance_ut2"),
    "Twist": (("velocity_mps", "turn_rate_radps"), "covariance"),
}


class Inflation(Parameters):
    """Conditions under which standard deviations are larger than stated.

    Attributes:
        where: the values of each source at which standard deviations are larger.
        by: factor by which the standard deviations are multiplied under these conditions.
    """

    where: dict[str, OneOrMore[Source]] = Field(min_length=1)
    by: PositiveFloat


class StreamMapping(Parameters):
    """The source of one of fuselog's streams, and how it is converted.

    Attributes:
        becomes: name of the message.
        fields: for each field of the message, a source, or a list of sources for a vector. Numbers are
            constants, and an empty list is a vector without numbers.
        factors: factors of sources, by field.
        offsets: numbers added after the multiplication, by field.
        units: units of the sources (with factors and offsets), by field; by default fuselog's units.
        deviations: for a covariance, the standard deviations, given as in `fields`.
        cross_deviations: for a covariance, the square roots of the off-diagonal entries (1, 2), (1, 3)
            and (2, 3), with the signs of the entries.
        inflated: conditions under which standard deviations are larger than stated.
        where: for each source, the values that a row must have to be imported.
        missing: numbers that mark a missing value.
        each: further fields, with one entry per message; every row makes one message for each entry.
        mounting_deg: roll, pitch, yaw that rotate the sensor's axes into the body's (Rz Ry Rx); vectors
            are rotated, and orientations are converted to those of the body.
        components: names of a vector's components, separated by commas, for messages whose channels
            state them.
        kinds: kinds of these components, separated by commas; linear by default.
        rotation_axes: axes of the rotations in the covariance of an estimate: the body's axes, or the
            world's axes as in ROS.
        states: values of model parameters that the channel states, such as noise densities.
    """

    becomes: str
    fields: dict[str, OneOrMore[Source]] = {}
    factors: dict[str, OneOrMore[float]] = {}
    offsets: dict[str, OneOrMore[float]] = {}
    units: dict[str, OneOrMore[str]] = {}
    deviations: dict[str, list[Source]] = {}
    cross_deviations: dict[str, Annotated[list[Source], Field(min_length=3, max_length=3)]] = {}
    inflated: list[Inflation] = []
    where: dict[str, OneOrMore[Source]] = {}
    missing: list[float] = []
    each: list[dict[str, OneOrMore[Source]]] = []
    mounting_deg: tuple[float, float, float] | None = None
    components: str = ""
    kinds: str = ""
    rotation_axes: Literal["body", "world"] = "body"
    states: dict[str, float] = {}

    def sources(self) -> Iterator[str]:
        """Yield the names of all sources of numbers; names may repeat."""
        for fields in (self.fields, *self.each):
            for given in fields.values():
                yield from (source for source in _listed(given) if isinstance(source, str))
        for listed in (*self.deviations.values(), *self.cross_deviations.values()):
            yield from (source for source in listed if isinstance(source, str))

    def conditions(self) -> Iterator[tuple[str, list[Source]]]:
        """Yield the sources in conditions, each with the values that fulfil its condition."""
        for where in (self.where, *(each.where for each in self.inflated)):
            for source, values in where.items():
                yield source, _listed(values)

    @property
    def metadata(self) -> dict[str, str]:
        """Return the metadata of the stream's channel."""
        stated = {name: repr(number) for name, number in self.states.items()}
        if not self.components:
            return stated
        linear = ",".join("linear" for _ in self.components.split(","))
        axes = {"rotation_axes": "world"} if self.rotation_axes == "world" else {}
        return {**stated, "components": self.components, "kinds": self.kinds or linear, **axes}


def schema_of(mapping: StreamMapping, where: str) -> Schema:
    """Return the schema of a mapping's messages; raise BadInput if the message or a field is unknown."""
    known = {schema.name: schema for schema in schemas.SCHEMAS.values()}
    if mapping.becomes not in known:
        raise BadInput(
            f"{where}: fuselog has no message '{mapping.becomes}'; {choices(mapping.becomes, known)}"
        )
    schema = known[mapping.becomes]
    entries = {entry.name: entry for entry in list(schema)[1:]}
    given = {*mapping.fields, *mapping.deviations}.union(*mapping.each)
    scaled = {*mapping.factors, *mapping.offsets, *mapping.units, *mapping.cross_deviations}
    for field in sorted(given | scaled):
        if field not in entries:
            raise BadInput(f"{where}: {schema.name} has no field '{field}'; {choices(field, entries)}")
    for entry in entries.values():
        is_needed = not (entry.may_be_nan or entry.may_be_absent or entry.kind == "identifier")
        if is_needed and entry.name not in given:
            raise BadInput(f"{where}: {schema.name} needs the field {entry.name}; add it to `fields`")
    return schema


class Mapped(NamedTuple):
    """Columns of k messages, the row of each message, and the messages that are left out, by reason."""

    columns: dict[str, NDArray]
    rows: NDArray[np.int64]
    dropped: dict[str, NDArray[np.bool_]]


def mapped(mapping: StreamMapping, size: int, read: Read, holds: Holds, where: str) -> Mapped:
    """Make messages from `size` rows.

    Raises BadInput, with a message that begins with `where`, if units do not fit or a list has the wrong
    length. Exceptions from `read` and `holds` are passed on.
    """
    schema = schema_of(mapping, where)
    maker = _Maker(mapping, schema, size, read, where)
    stretch = np.ones(size)
    for inflation in mapping.inflated:
        stretch[_all_hold(inflation.where, size, holds)] *= inflation.by
    left_out = ~_all_hold(mapping.where, size, holds)
    if not mapping.each:
        columns, parts = maker.columns(mapping.fields, stretch), 1
    else:
        made = [maker.columns({**mapping.fields, **fields}, stretch) for fields in mapping.each]
        parts = len(made)
        columns = {
            name: np.stack([each[name] for each in made], axis=1).reshape(
                size * parts, *column.shape[1:]
            )
            for name, column in made[0].items()
        }
    if mapping.mounting_deg is not None:
        _mount(columns, mapping, schema, where)
    dropped = {"not chosen by its 'where'": np.repeat(left_out, parts)} if mapping.where else {}
    return Mapped(columns, np.repeat(np.arange(size), parts), dropped)


class _Maker(NamedTuple):
    """A maker of the columns of messages from the sources."""

    mapping: StreamMapping
    schema: Schema
    size: int
    read: Read
    where: str

    def columns(self, fields: Mapping[str, OneOrMore[Source]], stretch: Floats) -> dict[str, NDArray]:
        """Make a column for every field of the message except the sensor's clock."""
        made: dict[str, NDArray] = {}
        for entry in list(self.schema)[1:]:
            if entry.name in self.mapping.deviations:
                made[entry.name] = self._covariance(entry.name, stretch)
            elif entry.name in fields:
                values = self._values(entry.name, fields[entry.name])
                made[entry.name] = values if entry.kind == "vector" else values[:, 0]
            elif entry.kind == "identifier":
                made[entry.name] = np.zeros(self.size, np.uint32)
            elif entry.kind == "real":
                made[entry.name] = np.full(self.size, np.nan)
            else:
                made[entry.name] = np.full((self.size, _WIDTHS.get(entry.name, 0)), np.nan)
        return made

    def _values(self, name: str, given: OneOrMore[Source]) -> NDArray:
        """Compute the values (n, width) of a field, in fuselog's unit."""
        if given == []:  # a vector that is absent
            return np.empty((self.size, 0))
        values = self._numbers(_listed(given))
        mapping, width = self.mapping, values.shape[1]
        stated = len(mapping.components.split(","))
        lengths = (stated,) if name in _STATED and mapping.components else _LENGTHS.get(name, (width,))
        if width not in lengths:
            wanted = " or ".join(map(str, lengths))
            raise BadInput(f"{self.where}: field {name} is given {width} columns; expected {wanted}")
        if name in {**mapping.factors, **mapping.offsets, **mapping.units}:
            factors = self._spread(mapping.factors.get(name, 1.0), width, f"factors of {name}")
            offsets = self._spread(mapping.offsets.get(name, 0.0), width, f"offsets of {name}")
            values = (values * factors + offsets) * self._conversions(name, width)
        return values

    def _covariance(self, name: str, stretch: Floats) -> Floats:
        """Compute covariances (n, width * width) from standard deviations."""
        mapping = self.mapping
        deviations = self._numbers(mapping.deviations[name])
        width = deviations.shape[1]
        factors = self._spread(mapping.factors.get(name, 1.0), width, f"factors of {name}")
        size = np.outer(stretch, factors * self._conversions(name, width))
        covariance = np.zeros((self.size, width, width))
        covariance[:, range(width), range(width)] = (deviations * size) ** 2
        if name in mapping.cross_deviations:
            if width != 3:
                raise BadInput(
                    f"{self.where}: cross_deviations of {name} need 3 standard deviations, "
                    f"found {width} in `deviations`"
                )
            crossed = self._numbers(mapping.cross_deviations[name])
            for column, (row, other) in enumerate(((0, 1), (0, 2), (1, 2))):
                value = crossed[:, column] * np.abs(crossed[:, column]) * size[:, row] * size[:, other]
                covariance[:, row, other] = covariance[:, other, row] = value
        return covariance.reshape(self.size, -1)

    def _numbers(self, sources: Sequence[Source]) -> NDArray:
        """Read the numbers (n, width) of some sources."""
        parts = []
        for source in sources:
            if isinstance(source, str):
                found = self.read(source)
                if self.mapping.missing:
                    found = np.where(np.isin(found, self.mapping.missing), np.nan, found)
            else:
                found = np.full(self.size, source)
            parts.append(found if found.ndim == 2 else found[:, None])
        return np.concatenate(parts, axis=1)

    def _conversions(self, name: str, width: int) -> Floats:
        """Return the factor for each entry of a field."""
        if name not in self.mapping.units:
            return np.ones(width)
        names = self.mapping.components.split(",")
        if name not in (*_STATED, "covariance") or len(names) != width:
            names = [name] * width
        given = self._spread(self.mapping.units[name], width, f"units of {name}")
        try:
            is_root = name in self.mapping.deviations
            return np.array(
                [conversion(*pair, is_root=is_root) for pair in zip(given, names, strict=True)]
            )
        except BadInput as error:
            raise BadInput(f"{self.where}: {error}") from None

    def _spread(self, given: OneOrMore, width: int, what: str) -> NDArray:
        """Repeat a single value for each entry of a vector."""
        values = _listed(given)
        if len(values) not in (1, width):
            raise BadInput(f"{self.where}: {what}: found {len(values)} values; give 1 or {width}")
        return np.array(values * (width // len(values)))


def _all_hold(where: Mapping[str, OneOrMore[Source]], size: int, holds: Holds) -> NDArray[np.bool_]:
    found = np.ones(size, bool)
    for source, values in where.items():
        found &= holds(source, _listed(values))
    return found


def _mount(columns: dict[str, NDArray], mapping: StreamMapping, schema: Schema, where: str) -> None:
    """Rotate vectors and orientations from the sensor's axes to the body's."""
    turn = Rotation.from_euler("xyz", mapping.mounting_deg, degrees=True)
    vectors, covariance = _IN_BODY.get(schema.name, ((), ""))
    for name in vectors:
        if columns[name].shape[1] != 3:
            raise BadInput(
                f"{where}: field {name} has 2 columns, but mounting_deg rotates vectors of 3; remove "
                "mounting_deg"
            )
        columns[name] = columns[name] @ turn.as_matrix().T
    width = 3 * len(vectors)
    if covariance and columns[covariance].shape[1] == width**2:
        whole = np.kron(np.eye(len(vectors)), turn.as_matrix())
        square = columns[covariance].reshape(-1, width, width)
        columns[covariance] = (whole @ square @ whole.T).reshape(len(square), -1)
    which = _quaternion_of(mapping.kinds)
    if "quaternion" in columns:
        columns["quaternion"] = _turned_back(columns["quaternion"], turn)
    elif "state" in columns and which:
        columns["state"][:, which] = _turned_back(columns["state"][:, which], turn)
    elif not vectors:
        raise BadInput(
            f"{where}: {schema.name} has no vector in the body's axes that could be rotated; remove "
            "mounting_deg"
        )


def _quaternion_of(kinds: str) -> list[int]:
    """Return the indices of a quaternion's parts in a vector, empty if there is no quaternion."""
    return [index for index, kind in enumerate(kinds.split(",")) if kind == "quaternion"]


def _turned_back(quaternion: NDArray, turn: Rotation) -> NDArray:
    """Convert a sensor's orientations (n, 4) to the body's, without normalising them."""
    return compose(quaternion, turn.inv().as_quat(scalar_first=True))


def not_finite(schema: Schema, columns: Mapping[str, NDArray]) -> NDArray[np.bool_]:
    """Find the messages that lack a required number, or have no numbers.

    Args:
        schema: schema of the messages.
        columns: columns by field, (n,) or (n, width) each; some fields may be missing.

    Returns:
        (n,), True for these messages.
    """
    size = len(next(iter(columns.values())))
    lacks, finite = np.zeros(size, bool), []
    for entry in schema:
        column = columns.get(entry.name)
        if column is None or column.dtype.kind != "f":
            continue
        is_finite = np.isfinite(column).reshape(size, -1)
        is_whole = is_finite.all()  # then the slower check of each row is not needed
        if is_finite.size and entry.kind != "identifier":
            finite.append(np.ones(size, bool) if is_whole else is_finite.any(axis=1))
        if not (is_whole or entry.may_be_nan or entry.may_be_partial):
            lacks |= ~is_finite.all(axis=1)
    return lacks | ~np.any(finite, axis=0) if finite else lacks


class OffUnit(NamedTuple):
    """The messages (n,) that are left out because of their quaternions, and those that are scaled."""

    left_out: NDArray[np.bool_]
    scaled: NDArray[np.bool_]


def off_unit(
    where: str,
    columns: Mapping[str, NDArray],
    kinds: str,
    taken: NDArray[np.bool_],
    quaternions: Quaternions,
) -> OffUnit:
    """Find the messages whose quaternions are far from unit length.

    Args:
        where: beginning of error messages.
        columns: columns of messages (n,), as in `with_unit_quaternions`.
        kinds: kinds of the components of a state or estimate, separated by commas.
        taken: (n,), the messages to check.
        quaternions: what to do with messages whose quaternions are far from unit length. A quaternion of
            zeros cannot be scaled.

    Raises BadInput if there are such messages, and they are neither scaled nor left out.
    """
    off, zero = np.zeros((2, len(taken)), bool)
    for name, which in _quaternions_in(columns, kinds):
        length = np.linalg.norm(columns[name][:, which], axis=1)
        is_off = taken & (np.abs(length - 1.0) > _UNIT_TOLERANCE)
        if is_off.any() and quaternions == "refuse":
            count = int(is_off.sum())
            raise BadInput(
                f"{where}: {count} of its quaternions {'is' if count == 1 else 'are'} not of unit "
                f"length, the first of length {length[is_off.argmax()]:.9g}; check the columns, scale "
                "the quaternions with --set quaternions=normalise, or use --set quaternions=skip"
            )
        off |= is_off
        zero |= is_off & (length == 0.0)
    return OffUnit(off, np.zeros_like(off)) if quaternions == "skip" else OffUnit(zero, off & ~zero)


def with_unit_quaternions(columns: Mapping[str, NDArray], kinds: str) -> dict[str, NDArray]:
    """Scale quaternions to unit length, in a field of quaternions or in a state or estimate.

    Args:
        columns: (n,) or (n, width), by field.
        kinds: kinds of the components of a state or estimate, separated by commas.
    """
    made = dict(columns)
    for name, which in _quaternions_in(columns, kinds):
        column = columns[name].astype(float)
        column[:, which] /= np.linalg.norm(column[:, which], axis=1, keepdims=True)
        made[name] = column
    return made


def _quaternions_in(columns: Mapping[str, NDArray], kinds: str) -> Iterator[tuple[str, list[int]]]:
    """Yield the names of columns with quaternions, and the indices of their parts."""
    for name in columns:
        which = (
            list(range(4)) if name == "quaternion" else _quaternion_of(kinds) if name in _STATED else []
        )
        if which:
            yield name, which


def checked(where: str, field: str, column: NDArray) -> NDArray:
    """Check a column's values, and replace infinite ones by NaN if the field may be missing.

    Args:
        where: beginning of error messages.
        field: name of the schema's field.
        column: (n,) or (n, width), in the field's unit.

    Returns:
        The values, in the same shape.

    Raises BadInput for impossible values.
    """
    limit = {"latitude_deg": 90.0, "longitude_deg": 180.0}.get(field)
    if limit is not None and len(column) and np.abs(column).max() > limit:
        worst = column[np.abs(column).argmax()]
        raise BadInput(
            f"{where}: a {field.removesuffix('_deg')} is {worst:.9g} deg, beyond {limit:g}; check the "
            "column and its unit"
        )
    is_infinite = np.isinf(column) if column.dtype.kind == "f" else np.zeros(0, bool)
    return np.where(is_infinite, np.nan, column) if is_infinite.any() else column


def _listed(given: OneOrMore[Value]) -> list[Value]:
    return given if isinstance(given, list) else [given]
