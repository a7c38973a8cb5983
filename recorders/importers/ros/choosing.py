"""Choice of the topics to import from a bag, how to read them, and how to name their streams.

A stream is named after the namespace of its topic and after its own kind: /odom gives /odometry,
/robot1/imu gives /robot1/inertial. If two topics would give the same name, both include the topic:
/odom/odometry, /wheels/odometry. Names of poses without a covariance always include the topic, since
such poses may be goals: /goal_pose/pose.
"""

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import BeforeValidator, PositiveFloat

from fuselog.recorders.errors import BadInput, choices, some_of
from fuselog.recorders.importers.mapping import Place, Quaternions
from fuselog.recorders.importers.ros.files.bags import Bag
from fuselog.recorders.importers.ros.files.raw import Connection
from fuselog.recorders.importers.ros.layouts import MessageType, Undecodable, definitions_of
from fuselog.recorders.importers.ros.mapping import MessageMapping, read_mapping, taken
from fuselog.recorders.importers.ros.messages import FRAME, STAMP, TRANSFORM_TYPES, TYPES, Taken
from fuselog.recorders.parameters import Parameters

Clock = Literal["header", "bag"]
Distribution = Literal[
    "ros1_noetic", "ros2_dashing", "ros2_eloquent", "ros2_foxy", "ros2_galactic", "ros2_humble",
    "ros2_iron", "ros2_jazzy", "ros2_kilted", "ros2_lyrical",
]  # fmt: skip


def _as_list(value: object) -> object:
    return [value] if isinstance(value, str) else value


Names = Annotated[list[str], BeforeValidator(_as_list)]


class RosParameters(Parameters):
    """The topics to import, and the clock to use.

    Attributes:
        clock: source of the publish time: the message's header, or the bag.
        topics: topics to import; by default all that can be imported.
        transforms: pairs of frames such as "map:base_link", whose poses are composed from TF; by default
            every transform is imported as it was sent.
        names: replaces namespaces: {"/amcl_pose" = "/robot1"} puts the streams of that topic under
            /robot1.
        truth: topic whose poses become the stream `truth`, with which estimates are compared.
        estimates: topics with the poses of another filter, such as /odometry/filtered. These poses
            become estimates, which `fuselog evaluate` judges, not measurements.
        mapping: TOML file with mappings of user-defined messages.
        distribution: distribution whose definitions are used for messages that the bag does not define.
        clock_tolerance_s: each topic has an offset between the clocks of its headers and of the bag; if
            the offsets of topics differ by more than this, the topics' clocks are unrelated, and the
            import stops.
        origin: latitude and longitude (deg) and optionally height (m) of the origin of the local tangent
            plane of poses and positions, regardless of the names of their frames. It does not apply to
            transforms, nor to poses that odometry integrates.
        quaternions: what to do with messages whose quaternions are not of unit length: "refuse" stops
            the import, "normalise" scales them, "skip" leaves such messages out.
    """

    clock: Clock = "header"
    topics: Names = []
    transforms: Names = []
    names: dict[str, str] = {}
    truth: str | None = None
    estimates: Names = []
    mapping: str | None = None
    distribution: Distribution = "ros2_humble"
    clock_tolerance_s: PositiveFloat = 60.0
    origin: Place | None = None
    quaternions: Quaternions = "refuse"


class Reader(NamedTuple):
    """The way in which the messages of a connection are read; `taken` is None for transforms."""

    type: MessageType
    taken: Taken | None
    stamp: str
    frame: str
    is_static: bool


class Choice(NamedTuple):
    """The readers of the chosen connections and, by topic, why other connections are not read."""

    readers: dict[Connection, Reader]
    not_taken: dict[str, str]


def choose(bag: Bag, parameters: RosParameters) -> Choice:
    """Choose what is imported from a bag.

    Raises BadInput if a requested topic is missing or cannot be read, or nothing can be imported.
    """
    connections = bag.connections
    mappings = _mappings(bag, parameters)
    _check_topics(bag, parameters)
    found = Choice({}, {})
    known: dict[tuple, Reader | str] = {}
    for each in connections:
        if parameters.topics and each.topic not in parameters.topics:
            found.not_taken[each.topic] = f"{each.type_name}, not requested"
            continue
        key = (each.type_name, each.encoding, each.definition, each.topic.endswith("_static"))
        if key not in known:
            known[key] = _reader(each, mappings.get(each.type_name), parameters)
        reader = known[key]
        if isinstance(reader, Reader):
            found.readers[each] = reader
            continue
        found.not_taken[each.topic] = f"{each.type_name or 'without a type'}{reader}"
        if parameters.topics:
            raise BadInput(
                f"{bag.path}: topic {each.topic} cannot be imported: it is "
                f"{found.not_taken[each.topic]}; describe it with --set mapping=FILE.toml"
            )
    for option, topic in _poses_of(parameters):
        _check_poses(bag, option, topic, found.readers)
    if not found.readers:
        left_out = some_of([f"{topic} ({why})" for topic, why in sorted(found.not_taken.items())])
        raise BadInput(f"{bag.path}: has no topic that can be imported: {left_out or 'no topics'}")
    return found


def stream_names(
    readers: Mapping[Connection, Reader], parameters: RosParameters
) -> dict[tuple[str, str], str]:
    """Return the names of streams by topic and kind."""

    def below(topic: str, taken: Taken) -> str:
        own = topic if taken.is_doubtful else topic.rpartition("/")[0]
        return parameters.names.get(topic, own).rstrip("/")

    wanted = {
        (each.topic, kind): f"{below(each.topic, reader.taken)}/{kind}"
        for each, reader in readers.items()
        if reader.taken is not None and each.topic not in (parameters.truth, *parameters.estimates)
        for kind in reader.taken.kinds
    }
    if (truth := parameters.truth) is not None:
        above = parameters.names.get(truth, truth.rpartition("/")[0]).rstrip("/")
        wanted[truth, "truth"] = f"{above}/truth"
    for topic in parameters.estimates:
        label = re.sub(r"\W", "_", topic.strip("/"))
        wanted[topic, "estimate"] = f"/estimates/{label}/pose"
    counts = Counter(wanted.values())
    return {
        (topic, kind): name if counts[name] == 1 else f"{topic}/{kind}"
        for (topic, kind), name in wanted.items()
    }


def _mappings(bag: Bag, parameters: RosParameters) -> dict[str, MessageMapping]:
    """Return the mappings of user-defined messages, by type."""
    if parameters.mapping is None:
        return {}
    mappings = read_mapping(Path(parameters.mapping))
    types = sorted({each.type_name for each in bag.connections})
    for name in mappings:
        if name not in types:
            raise BadInput(
                f"{parameters.mapping}: no topic of {bag.path} is of type {name}; {choices(name, types)}"
            )
    return mappings


def _check_topics(bag: Bag, parameters: RosParameters) -> None:
    """Raise BadInput if a topic that a parameter names is missing."""
    topics = sorted({each.topic for each in bag.connections})
    poses = [topic for _, topic in _poses_of(parameters)]
    for topic in [*parameters.topics, *parameters.names, *poses]:
        if topic not in topics:
            raise BadInput(f"{bag.path}: has no topic {topic}; {choices(topic, topics)}")


def _poses_of(parameters: RosParameters) -> list[tuple[str, str]]:
    """List the topics whose poses are the truth or estimates, each with the option that names it."""
    truth = [] if parameters.truth is None else [("truth", parameters.truth)]
    return [*truth, *(("estimates", topic) for topic in parameters.estimates)]


def _check_poses(bag: Bag, option: str, topic: str, readers: Mapping[Connection, Reader]) -> None:
    """Raise BadInput if a topic that should have poses has none."""
    reader = next((each for of, each in readers.items() if of.topic == topic), None)
    if not reader or not reader.taken or not any("pose" in kind for kind in reader.taken.kinds):
        raise BadInput(
            f"{bag.path}: {option} = {topic}: this topic has no poses; name a topic with poses"
        )


def _reader(
    connection: Connection, mapping: MessageMapping | None, parameters: RosParameters
) -> Reader | str:
    """Choose how a connection is read; return the reason if it is not imported."""
    name = connection.type_name
    where = f"{parameters.mapping}: the mapping of {name}"
    is_transforms = name in TRANSFORM_TYPES
    if connection.encoding not in ("cdr", "ros1"):
        return f", in the encoding '{connection.encoding}', which is not an encoding of ROS"
    if mapping is None and not is_transforms and name not in TYPES:
        return ""
    try:
        definitions = definitions_of(name, connection.definition, parameters.distribution)
    except Undecodable as error:
        return f": {error}"
    kind = MessageType(name, definitions, "cdr" if connection.encoding == "cdr" else "ros1")
    if mapping is not None:
        known = kind.fields()
        for path in mapping.paths():
            if path not in known and not any(part.isdigit() for part in path.split(".")):
                raise BadInput(
                    f"{where}: this type has no numeric field '{path}'; {choices(path, known)}"
                )
        return Reader(kind, taken(mapping, where), mapping.stamp, mapping.frame, is_static=False)
    is_static = connection.topic.endswith("_static")
    return Reader(kind, TYPES.get(name), STAMP, FRAME, is_static)
