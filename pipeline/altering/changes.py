"""Parser of `--set /TOPIC.WHAT=VALUE`, which alters the topics of a run."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.altering import alterations as alter
from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import Stream, Topic, schemas
from fuselog.recorders.log.planes import EXAMPLE, is_planar, origin_of, stated_in
from fuselog.recorders.parameters import merge, nested
from fuselog.recorders.units import conversion, parted, unit_of
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.inference.estimators import registered_models
from fuselog.replay.inference.model.own_parameters import read_by
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.judging.errors.truths import COVERS

AXES = "xyz"
ENDINGS = ("scale", "bias", "drift", "axes", "matrix", "turn")  # endings of alterations of a field
STATED_ENTRIES = ("mean", "state", "value")  # vectors whose entries are named by the channel
STATED = "covariance_rad2"  # variances that a channel of orientations states
ALL_TOPICS = "/*"
# Alterations of a topic with their meanings; each corrects the fault that its number describes.
WHATS = {
    "delay_s": "The delay of the stamps, which is subtracted; messages that would be before 1970 "
    "are left out.",
    "clock_gain": "The stamps' clock gains this many seconds per second, from the start of the run.",
    "FIELD_scale": "The field is multiplied by this factor; covariance_scale multiplies variances.",
    "FIELD_bias": "The field is too large by this bias, which is subtracted.",
    "FIELD_drift": "The field's bias grows by this much per second from the start of the run, and is "
    "subtracted.",
    "FIELD_axes": "The order of the vector's entries: yx if x and y are swapped.",
    "FIELD_matrix": "The vector is multiplied by this matrix: nine numbers, row by row, for example "
    "from `fuselog ellipsoid`.",
    "FIELD_turn": "The angle (rad) by which the vector is wrongly rotated about the vertical; this "
    "rotation is reversed.",
    "heading_bias": "The heading of orientations, or of a prior, is too large by this angle (rad), "
    "which is subtracted; orientations also have heading_scale and heading_drift.",
    "heading_convention": "north, if orientations have compass headings, clockwise from north.",
    "origin": "For geodetic fixes, the origin of the tangent plane: latitude and longitude in deg, "
    "altitude in m. For positions, the position (m) of their origin in the plane, which is added to "
    "them.",
    "plane": "For positions and states, the origin of their tangent plane, as if the log stated it: "
    "latitude and longitude in deg, altitude in m. /*.plane sets all such topics that state none.",
    "covers": "For a truth: some, if targets in the log lack a truth (their tracks then do not count "
    "as false), or all, if none do; this overrides the log.",
    "exchanged": "The two numbers to swap, such as 3,9, or the topic to swap with this one.",
}
_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")


class _Setting(NamedTuple):
    """A setting of a topic: the full key, its last part, the value, and an empty stream of the topic."""

    key: str
    what: str
    value: Any
    empty: Stream

    def refused(self, expected: str) -> BadInput:
        """Return the error for an invalid value."""
        return BadInput(f"--set {self.key}={self.value}: expected {expected}")

    def number(self, name: str, example: str) -> float:
        """Parse the value; its unit is that of `name` unless the text states one, such as `300 ms`."""
        found = _NUMBER.fullmatch(str(self.value))
        if isinstance(self.value, bool) or found is None:
            raise self.refused(example)
        number = float(found[1])
        try:
            number *= conversion(found[2], name) if found[2] else 1.0
        except BadInput as error:
            raise BadInput(f"--set {self.key}={self.value}: {error}") from None
        if not np.isfinite(number):
            raise self.refused(example)
        return number

    def several(self, counts: Sequence[int], example: str) -> list[str]:
        """Parse the value as a list; the value may also be text with commas."""
        is_list = isinstance(self.value, list | tuple)
        parts = list(self.value) if is_list else str(self.value).strip("[] ").split(",")
        if len(parts) not in counts:
            raise self.refused(example)
        return [str(each).strip() for each in parts]


@dataclass(frozen=True)
class Change:
    """The alteration of a topic.

    Attributes:
        topic: its name.
        stored: name of the topic in the log; it differs from `topic` only if two topics are swapped.
        first_ns: the start of the run, at which the drift of a clock begins.
        columns: alterations of the topic's columns, in the order in which they are applied.
        metadata: metadata to add to the topic's metadata in the log.
        gain, delay_ns: the clock's gain since `first_ns`, and the delay, which are removed from the
            stamps.
    """

    topic: str
    stored: str
    first_ns: int = 0
    columns: Sequence[Callable[[Stream], Stream]] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)
    gain: float = 0.0
    delay_ns: float = 0.0

    @property
    def is_moving(self) -> bool:
        """Test whether the change affects the stamps."""
        return self.gain != 0.0 or self.delay_ns != 0.0

    def moved(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Remove the clock's gain and the delay from stamps (n,) in ns."""
        since_ns = (stamps_ns - self.first_ns) * alter.pace(-self.gain) - self.delay_ns
        return self.first_ns + np.rint(since_ns).astype(np.int64)

    def before(self, stamp_ns: int) -> int:
        """Return the stamp from which a corrected stamp was computed, up to rounding."""
        since_ns = (stamp_ns - self.first_ns + self.delay_ns) * alter.pace(self.gain)
        return self.first_ns + round(since_ns)

    def stated(self, topic: Topic) -> Topic:
        """Return a stored topic with the name and metadata of the altered topic."""
        return replace(topic, name=self.topic, metadata={**topic.metadata, **self.metadata})

    def altered(self, stream: Stream) -> Stream:
        """Alter the messages of the stored topic.

        Messages that would be before 1970 are omitted, because logs have no such stamps.
        """
        metadata = {**stream.metadata, **self.metadata}
        stream = replace(stream, topic=self.topic, metadata=metadata)
        if self.is_moving:
            stamps_ns = self.moved(stream.publish_time_ns)
            stream = replace(stream, publish_time_ns=stamps_ns).take(stamps_ns >= 0)
        for alteration in self.columns:
            stream = alteration(stream)
        return stream


def is_of_topic(key: str) -> bool:
    """Test whether a setting belongs to a topic, not to an estimator or experiment."""
    return key.startswith("/")


def is_parameter(key: str) -> bool:
    """Test whether a setting of a topic is a parameter of its sensor, not an alteration of the log.

    A parameter's name is never a field's name followed by the suffix of an alteration.
    """
    _, dot, what = key.rpartition(".")
    if not (is_of_topic(key) and dot) or what in (*WHATS, "delay"):
        return False
    return what in (_read_by_sensors() if what.rpartition("_")[2] in ENDINGS else _parameters())


def by_topic(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Move each parameter `/TOPIC.NAME` to the entry NAME of the table `/TOPIC`."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        found = merge(found, nested(key, value) if is_parameter(key) else {key: value})
    return found


@cache
def _read_by_sensors() -> frozenset[str]:
    """Collect the names of the parameters that the sensors of registered models read."""
    return frozenset(
        name
        for model in registered_models().values()
        for sensor in model.all_sensors
        for name in read_by(model, sensor)
    )


def _parameters() -> set[str]:
    """Collect the parameters of all models, including unregistered ones."""
    registered_models()
    kinds: list[type[ModelParameters]] = [ModelParameters]
    for kind in kinds:
        kinds += kind.__subclasses__()
    return {name for kind in kinds if not kind.OWNED for name in kind.model_fields}


def bare(name: str) -> str:
    """Return the name of a field or component without its unit: `x` for `x_m`."""
    return parted(name)[0]


def names_in(stream: Stream, field_: str) -> list[str]:
    """Name a vector's entries as its channel does, or `position_x_m` and so on for `position_m`."""
    if field_ in STATED_ENTRIES and stream.components:
        return stream.components
    stem = bare(field_)
    return [f"{stem}_{axis}{field_.removeprefix(stem)}" for axis in AXES]


def changes_of(source: LogSource | MemorySource, settings: Mapping[str, Any]) -> dict[str, Change]:
    """Parse settings of topics into changes of a run, keyed by topic, in the order of the settings.

    `WHATS` lists the possible settings. Fields are given by their full name without the unit, or by an
    unambiguous prefix of it. Entries of vectors are given with their axis, such as `position_x_bias`,
    and entries of states by their component. A number may have a unit, such as `300 ms` or `4.5 deg`.

    Raises BadInput if the topic or field does not exist, or if a value is invalid.
    """
    changes: dict[str, Change] = {}
    for key, value in _of_one_topic(source, settings):
        topic, dot, what = key.rpartition(".")
        if not dot or not what:
            raise BadInput(
                f"--set {key}={value}: expected /TOPIC.WHAT=VALUE, such as /fix.delay_s=0.3; WHAT is "
                f"one of {', '.join(WHATS)}"
            )
        if topic not in source.topics:
            raise BadInput(
                f"--set {key}: {source.name} has no topic {topic}; {choices(topic, source.topics)}"
            )
        before = changes.get(topic) or Change(topic, topic, source.extent("publish_time")[0])
        given = _Setting(key, what, value, source.empty(before.stored))
        changes[topic] = _with(before, given)
        if changes[topic].stored != before.stored:
            other = changes[topic].stored
            _check_exchange(source, given, other, changes)
            changes[other] = Change(other, topic, before.first_ns)
    return changes


def _of_one_topic(
    source: LogSource | MemorySource, settings: Mapping[str, Any]
) -> Iterator[tuple[str, Any]]:
    """Yield settings; replace `/*.plane` with a setting for each topic that states no plane."""
    of_all = f"{ALL_TOPICS}.plane"
    for key, value in settings.items():
        if key != of_all:
            yield key, value
            continue
        for name, topic in source.topics.items():
            is_stated = stated_in(name, topic.metadata) or f"{name}.plane" in settings
            if is_planar(topic.schema_name, topic.metadata) and not is_stated:
                yield f"{name}.plane", value


def _with(change: Change, given: _Setting) -> Change:
    """Add one more setting to the change of its topic."""
    what = given.what
    if what in ("delay_s", "delay"):
        delay_ns = 1e9 * given.number("delay_s", "seconds, such as 0.3 or 300 ms")
        return replace(change, delay_ns=change.delay_ns + delay_ns)
    if what == "clock_gain":
        gain = given.number("clock_gain", "seconds that the clock gains per second, such as 1e-4")
        if not abs(gain) < 1.0:
            raise given.refused("seconds that the clock gains per second, less than 1, such as 1e-4")
        return replace(change, gain=change.gain + gain)
    if what == "origin":
        return _origin(change, given)
    if what == "plane":
        return _plane(change, given)
    if what == "exchanged":
        return _exchange(change, given)
    if what == "covers":
        return _covers(change, given)
    own = change.metadata.get(STATED, given.empty.metadata.get(STATED, ""))
    if what == "covariance_scale" and own and "covariance" not in given.empty.columns:
        factor = given.number("scale", "a positive factor of variances, such as 4")
        if factor <= 0.0:
            raise given.refused("a positive factor of variances, such as 4")
        return replace(change, metadata={**change.metadata, STATED: alter.spread_variances(own, factor)})
    return replace(change, columns=(*change.columns, _of_column(given, change.first_ns)))


def _of_heading(given: _Setting, first_ns: int) -> Callable[[Stream], Stream] | None:
    """Return the alteration of headings of orientations or Gaussian estimates, or None."""
    has_field = "quaternion" in given.empty.columns
    if given.what == "heading_bias" and (
        has_field or "quaternion" in given.empty.metadata.get("kinds", "")
    ):
        angle = given.number("heading_rad", "an angle in rad, such as 0.1 or 5 deg")
        return partial(alter.heading_turned, angle=-angle)
    if not has_field:
        return None
    if given.what == "heading_scale":
        return partial(alter.heading_multiplied, factor=given.number("scale", "a factor, such as -1"))
    if given.what == "heading_drift":
        rate = given.number("heading_radps", "a turn rate in rad/s, such as 1e-4")
        return partial(_by, alter.heading_ramped(first_ns), -rate)
    if given.what == "heading_convention":
        if str(given.value) != "north":
            raise given.refused("north, for headings clockwise from north")
        return partial(_by, alter.heading_from_north, 0.0)
    return None


def _of_column(given: _Setting, first_ns: int) -> Callable[[Stream], Stream]:
    """Return the alteration of a field."""
    name, _, what = given.what.rpartition("_")
    of_heading = _of_heading(given, first_ns)
    if of_heading is not None:
        return of_heading
    if not name or what not in ENDINGS:
        known = f"settings of a topic are {', '.join(WHATS)}"
        raise BadInput(f"--set {given.key}: {known}; {choices(given.what, list(WHATS))}")
    full, (field_, entry) = _field(given, name)
    if what == "scale":
        factor = given.number("scale", "a factor, such as -1 or 3.6")
        if field_.startswith("covariance") and factor <= 0.0:
            raise given.refused("a positive factor of variances, such as 4")
        return partial(_by, alter.scaled(field_, entry), factor)
    if what == "bias":
        unit = f" in {unit_of(full)}" if unit_of(full) else ""
        return partial(_by, alter.shifted(field_, entry), -given.number(full, f"a number{unit}"))
    if what == "drift":
        unit = f" in {unit_of(full)} a second" if unit_of(full) else ""
        rate = given.number("drift", f"a number{unit}")
        return partial(_by, alter.ramped(first_ns, field_, entry), -rate)
    if what == "axes":
        return partial(_by, alter.permuted(field_, _order(given, field_)), 0.0)
    if what == "matrix":
        return _matrix(given, field_)
    if entry is not None or not field_.startswith(("position", "velocity")):
        raise BadInput(f"--set {given.key}: expected a position or velocity, such as position_turn")
    angle = given.number("turn_rad", "an angle in rad, such as 0.1 or 5 deg")
    return partial(_by, alter.turned(field_), -angle)


def _order(given: _Setting, field_: str) -> list[int]:
    """Parse the order of axes."""
    text = str(given.value)
    order = [AXES.find(each) for each in text]
    if sorted(order) != list(range(len(order))) or len(order) < 2:
        raise given.refused(f"the order of the entries of {field_}, such as yx or yxz")
    return order


def _matrix(given: _Setting, field_: str) -> Callable[[Stream], Stream]:
    """Parse the matrix that multiplies a vector of three entries."""
    example = "nine numbers, row by row, such as 1,0,0,0,1,0,0,0,1"
    if given.empty[field_].shape[1:] != (3,):
        raise BadInput(f"--set {given.key}: {field_} is not a vector of three entries; remove it")
    numbers = [_plain(given, text, example) for text in given.several((9,), example)]
    return alter.mixed(field_, np.reshape(numbers, (3, 3)))


def _by(alteration: alter.Alteration, value: float, stream: Stream) -> Stream:
    return alteration(stream, value)


def _field(given: _Setting, name: str) -> tuple[str, tuple[str, int | None]]:
    """Find the field or entry that a name denotes; raise BadInput if there is none."""
    fields: dict[str, tuple[str, int | None]] = {}
    for each in given.empty.schema:
        if each.kind not in ("real", "vector") or each.name not in given.empty.columns:
            continue
        if each.name not in ("mean", "state"):
            fields[each.name] = each.name, None
        if each.kind == "vector" and not each.name.startswith("covariance"):
            names = names_in(given.empty, each.name)
            fields |= {name: (each.name, place) for place, name in enumerate(names)}
    for fits in (
        [each for each in fields if each == name],
        [each for each in fields if bare(each) == name],
        [each for each in fields if each.startswith(f"{name}_") and fields[each][1] is None],
        [each for each in fields if each.startswith(f"{name}_")],
    ):
        if len(fits) == 1:
            return fits[0], fields[fits[0]]
        if fits:
            raise BadInput(
                f"--set {given.key}: {name} could mean {' or '.join(fits)}; give the full name"
            )
    topic = given.key.rpartition(".")[0]
    raise BadInput(f"--set {given.key}: {topic} has no field {name}; {choices(name, list(fields))}")


def _origin(change: Change, given: _Setting) -> Change:
    if given.empty.schema.full_name == schemas.GEODETIC_FIX.full_name:
        return _plane(change, given)
    if "position_m" not in given.empty.columns:
        raise BadInput(
            f"--set {given.key}: only positions and geodetic fixes have an origin; remove this setting"
        )
    example = "a position in m, such as -0.65,0.3"
    place = [_plain(given, text, example) for text in given.several((2, 3), example)]
    added = [
        partial(_by, alter.shifted("position_m", entry), value) for entry, value in enumerate(place)
    ]
    return replace(change, columns=(*change.columns, *added))


def _plane(change: Change, given: _Setting) -> Change:
    if not is_planar(given.empty.schema.full_name, given.empty.metadata):
        raise BadInput(f"--set {given.key}: this topic has no positions in a plane; remove the setting")
    texts = given.several((2, 3), EXAMPLE)
    origin = origin_of(texts)
    if origin is None:
        raise given.refused(EXAMPLE)
    stated = dict(list(origin.metadata.items())[: len(texts)])
    return replace(change, metadata={**change.metadata, **stated})


def _covers(change: Change, given: _Setting) -> Change:
    if given.empty.schema.full_name != schemas.TRUTH_STATE.full_name:
        raise BadInput(f"--set {given.key}: this setting applies only to truths; remove it")
    if given.value not in ("some", "all"):
        raise given.refused("some or all")
    return replace(change, metadata={**change.metadata, COVERS: f"{given.value} targets"})


def _plain(given: _Setting, text: str, example: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise given.refused(example)
    return number


def _exchange(change: Change, given: _Setting) -> Change:
    text = str(given.value)
    if is_of_topic(text):
        return replace(change, stored=text)
    example = "two numbers, such as 3,9, or another topic"
    first, second = given.several((2,), example)
    fields = [each.name for each in given.empty.schema if each.kind == "identifier"]
    if len(fields) != 1 or not (first.isdigit() and second.isdigit()):
        raise given.refused(example if fields else "another topic, because this one has no numbers")
    renumber = alter.renumbered(fields[0], int(first), int(second))
    return replace(change, columns=(*change.columns, partial(_by, renumber, 0.0)))


def _check_exchange(
    source: LogSource | MemorySource, given: _Setting, other: str, changes: Mapping[str, Change]
) -> None:
    """Refuse to swap with a topic that is missing, of another type, or already altered."""
    if other not in source.topics:
        raise BadInput(
            f"--set {given.key}={other}: {source.name} has no topic {other}; "
            f"{choices(other, source.topics)}"
        )
    if source.topics[other].schema_name != given.empty.schema.full_name:
        raise BadInput(
            f"--set {given.key}={other}: one is {given.empty.schema.full_name}, the other "
            f"{source.topics[other].schema_name}; only topics of the same type can be swapped"
        )
    if other in changes:
        raise BadInput(
            f"--set {given.key}={other}: {other} has other settings too; give only the swap, and only "
            "once"
        )
