"""Binding of a model to a log: search for the topics of a model by their names in the model.

All models are bound in the same way: the topics of a model are searched under every prefix with a prior,
such as `/robot1/odometry` next to `/robot1/prior`. Sensors without a topic are left out.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import takewhile
from typing import NamedTuple

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.log import Schema, Topic, schemas
from fuselog.recorders.log.planes import FRAME, frame_of, plane_in_words, stated_in
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.channels import resolved
from fuselog.replay.engine.streams.geodetic import GEODETIC, stated_origin
from fuselog.replay.engine.streams.results import named
from fuselog.replay.inference.model.model import (
    Control,
    Model,
    Sensor,
)

START = "start"  # frame of estimates that begin at zero because the initial position is unknown


class Found(NamedTuple):
    """Topics of a log that a model uses.

    Attributes:
        prefix: prefix of the names of its topics, such as `/robot1`.
        prior: topic of the prior; in a log without a prior, the name that it would have.
        truth: topic with which estimates are compared.
        control: topic that drives the motion.
        sensors: sensors of the model that are in the log, with their topics.
        has_prior: whether the log has the prior; otherwise see
            `fuselog.replay.inference.run.initialization`.
        fallbacks: topics that replace some components of the control.
        origin: latitude, longitude (deg) and altitude (m) of the origin of the local tangent plane (3,),
            if the log contains it.
        frame: separate frame of the positions; empty if they are in the log's local tangent plane.
    """

    prefix: str
    prior: Topic
    truth: str
    control: Topic | None
    sensors: tuple[tuple[Sensor, Topic], ...]
    has_prior: bool = True
    fallbacks: tuple[tuple[Control, Topic], ...] = ()
    origin: Floats | None = None
    frame: str = ""

    @property
    def geodetic(self) -> tuple[Topic, ...]:
        """Topics of position fixes in latitude and longitude."""
        return tuple(topic for _, topic in self.sensors if topic.schema_name == GEODETIC)


def roles_of(model: Model) -> list[str]:
    """Return the model's names for all topics that it can use."""
    control = [model.control, *model.control.fallbacks] if model.control else []
    maps = [each.topic for sensor in model.all_sensors for each in sensor.maps]
    sensors = [sensor.topic for sensor in model.all_sensors]
    drives = [each.topic for each in control]
    return list(dict.fromkeys([model.prior, model.truth, *drives, *maps, *sensors]))


class UnderPrefix(NamedTuple):
    """Topics under one prefix of a log; `names` maps names in the model to names of topics."""

    topics: Mapping[str, Topic]
    prefix: str
    names: Mapping[str, str]

    def place(self, name: str) -> str:
        """Return the full name of a topic."""
        return resolved(self.names.get(name, name), self.prefix)

    def topic(self, name: str, schema: Schema) -> Topic | None:
        """Return the topic of this name if its messages have the schema, or can be converted to it."""
        found = self.topics.get(self.place(name))
        return found if found is not None and found.schema_name in serving(schema) else None

    def has(self, name: str) -> bool:
        """Test whether the log has a topic of this name, of any type."""
        return self.place(name) in self.topics


def serving(schema: Schema) -> tuple[str, ...]:
    """Return the full names of the schemas whose messages a sensor of this schema accepts."""
    geodetic = (GEODETIC,) if schema is schemas.POSITION_FIX else ()
    return (schema.full_name, *geodetic)


def first_and_more(
    named: Mapping[str, str | Sequence[str]],
) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Split the topics for each name in the model into the first topic and the others.

    >>> first_and_more({"pose": "/amcl/pose", "fix": ["/gps1/fix", "/gps2/fix"]})
    ({'pose': '/amcl/pose', 'fix': '/gps1/fix'}, {'fix': ['/gps2/fix']})
    """
    listed = {role: [names] if isinstance(names, str) else list(names) for role, names in named.items()}
    firsts = {role: names[0] if names else "" for role, names in listed.items()}
    return firsts, {role: names[1:] for role, names in listed.items() if names[1:]}


def with_more(
    label: str,
    model: Model,
    found: Found,
    topics: Mapping[str, Topic],
    more: Mapping[str, Sequence[str]],
) -> Found:
    """Add further topics for sensors, each after the first topic of its sensor.

    Raises BadInput if a topic has a type that its sensor does not accept, or if the model does not use
    that sensor with this log.
    """
    sensors = list(found.sensors)
    for role, names in more.items():
        kinds = [sensor for sensor, _ in found.sensors if sensor.topic == role]
        for name in names:
            topic = topics.get(resolved(name, found.prefix))
            serves = [each for each in kinds if topic and topic.schema_name in serving(each.schema)]
            if topic is None or not serves:
                known = [
                    each
                    for each, own in topics.items()
                    for kind in kinds
                    if own.schema_name in serving(kind.schema)
                ]
                why = f"the log has no such topic that can serve as {role}; {choices(name, known)}"
                raise BadInput(f"estimator {label}: topics.{role}: {name}: {why}")
            place = max(place for place, (sensor, _) in enumerate(sensors) if sensor.topic == role)
            sensors[place + 1 : place + 1] = [(each, topic) for each in serves]
    return found._replace(sensors=tuple(sensors))


def topics_of(
    model: Model, topics: Mapping[str, Topic], names: Mapping[str, str] | None = None
) -> list[Found]:
    """Find every object in a log that this model describes.

    The topics of an object share a namespace. If that is impossible because each sensor has its own
    namespace, all topics belong to one object; see `_one_thing`.

    Args:
        model: the model.
        topics: topics of the log, by name.
        names: names of topics, by their names in the model.
    """
    names = names or {}
    one = _one_thing(model, topics, names)
    if one is not None:
        found_one = _found(model, one)
        return [] if found_one is None else [found_one]
    begins = [model.prior]
    if model.start is not None:
        begins += [model.control.topic] if model.control else [each.topic for each in model.all_sensors]
    ends = [f"/{names.get(name, name).removeprefix('/')}" for name in begins]
    prefixes = dict.fromkeys(
        topic.removesuffix(end) for end in ends for topic in topics if topic.endswith(end)
    )
    found = (_found(model, UnderPrefix(topics, prefix, names)) for prefix in prefixes)
    return [each for each in found if each is not None]


def _one_thing(
    model: Model, topics: Mapping[str, Topic], names: Mapping[str, str]
) -> UnderPrefix | None:
    """Return the single object of a model whose topics are in several namespaces; None if there is none.

    A log with one topic for the control has one object, in the namespace of that topic. A log without a
    control has one object if no sensor, prior or truth occurs twice; its namespace is that of the prior,
    or the common part of the sensors' namespaces. A topic that this namespace lacks is taken from
    another namespace if it occurs only once; if it occurs several times, it is not used. Poses are never
    taken from other namespaces, because they may be goals or in a separate frame.
    """
    there = {name: topic for name, topic in topics.items() if not name.startswith("/estimates/")}
    homes: list[str] = []
    if model.control is not None:
        name = names.get(model.control.topic, model.control.topic)
        controls = _named(there, name, model.control.schema)
        homes = [each.removesuffix(f"/{name.removeprefix('/')}") for each in controls]
        if len(homes) != 1:
            return None
    found: dict[str, list[str]] = {}
    for name, schema in {
        **{each.topic: each.schema for each in model.all_sensors if each.schema is not schemas.POSE},
        model.prior: schemas.GAUSSIAN_ESTIMATE,
        model.truth: schemas.TRUTH_STATE,
    }.items():
        if name and name not in names and not name.startswith("/"):
            found[name] = [
                each for each in _named(there, name, schema) if _serves(model, name, there[each])
            ]
            if not homes and len(found[name]) > 1:
                return None
    if not homes:
        spaces = {
            each.removesuffix(f"/{name}")
            for name, own in found.items()
            if name not in (model.prior, model.truth)
            for each in own
        }
        if not spaces:
            return None
        of_prior = [each.removesuffix(f"/{model.prior}") for each in found.get(model.prior, [])]
        homes = of_prior or [_common(spaces)]
    [home] = homes
    elsewhere = {
        name: each[0] for name, each in found.items() if len(each) == 1 and f"{home}/{name}" not in there
    }
    return UnderPrefix(topics, home, {**names, **elsewhere}) if elsewhere else None


def _serves(model: Model, name: str, topic: Topic) -> bool:
    """Test whether a topic belongs to the model's system or, for a prior, has the model's components."""
    if name == model.prior:
        return model.state.keys() <= set(topic.metadata.get("components", "").split(","))
    return topic.metadata.get("system", model.system) == model.system


def _named(topics: Mapping[str, Topic], name: str, schema: Schema) -> list[str]:
    """List the topics of any namespace that end with this name and match the schema."""
    end = f"/{name.removeprefix('/')}"
    return [
        each
        for each, topic in topics.items()
        if each.endswith(end) and topic.schema_name in serving(schema)
    ]


def _common(spaces: Collection[str]) -> str:
    """Return the longest namespace that contains all of these namespaces."""
    parts = zip(*(space.split("/") for space in spaces), strict=False)
    alike = takewhile(lambda each: len(set(each)) == 1, parts)
    return "/".join(each[0] for each in alike)


def offers_of(model: Model, found: Found, topics: Mapping[str, Topic]) -> dict[str, str]:
    """Suggest settings for unused topics that could replace a missing sensor or fallback.

    A topic is suggested if only one sensor or fallback accepts its type, or if its name ends with the
    name in the model.

    Returns:
        By topic, the option that makes the model use it.
    """
    kinds = {sensor.topic: sensor.schema for sensor in model.all_sensors}
    if model.control is not None:
        kinds |= {drive.topic: drive.schema for drive in model.control.fallbacks}
    here = {each.topic for each, _ in found.sensors} | {each.topic for each, _ in found.fallbacks}
    taken = {topic.name for _, topic in found.sensors} | {topic.name for _, topic in found.fallbacks}
    if found.control is not None:
        taken.add(found.control.name)
    offered: dict[str, list[str]] = {}
    for name, topic in topics.items():
        fitting = [each for each, schema in kinds.items() if topic.schema_name in serving(schema)]
        alike = [each for each in fitting if name.endswith(f"/{each}")]
        is_only = len(fitting) == 1 and topic.schema_name != schemas.POSE.full_name
        for role in alike[:1] or (fitting if is_only else []):
            if name not in taken and role not in here and not name.startswith("/estimates/"):
                offered.setdefault(role, []).append(name)
    return {
        name: f"--set topics.{role}={','.join(names)}"
        for role, names in offered.items()
        for name in names
    }


def _found(model: Model, here: UnderPrefix) -> Found | None:
    """Return the topics of a model under one prefix, or None if the model does not fit."""
    control = here.topic(model.control.topic, model.control.schema) if model.control else None
    if model.control is not None and control is None:
        return None
    sensors = tuple(
        (sensor, topic)
        for sensor in model.all_sensors
        if (topic := here.topic(sensor.topic, sensor.schema)) is not None
        and topic.metadata.get("system", model.system) == model.system
        and all(here.topic(each.topic, each.schema) is not None for each in sensor.maps)
    )
    prior = here.topic(model.prior, schemas.GAUSSIAN_ESTIMATE)
    has_prior = prior is not None
    if not _suffices(model, here, sensors, has_prior=has_prior):
        return None
    if prior is None:
        name = schemas.GAUSSIAN_ESTIMATE.full_name
        prior = Topic(here.place(model.prior), name, "protobuf", (), named(model.state), 0)
    fallbacks = tuple(
        (each, topic)
        for each in (model.control.fallbacks if model.control else ())
        if (topic := here.topic(each.topic, each.schema)) is not None
    )
    truth = here.place(model.truth)
    return Found(here.prefix, prior, truth, control, sensors, has_prior, fallbacks)


def _suffices(
    model: Model, here: UnderPrefix, sensors: Sequence[tuple[Sensor, Topic]], *, has_prior: bool
) -> bool:
    """Test whether a model can start from the prior or these sensors, and then has the inputs it needs.

    A log without a prior fits a model that can start without one, if a sensor measures the state itself.
    A log without usable sensors fits only if it also has none of their topics; sightings without a map,
    for example, would remain unused.
    """
    if not has_prior and (model.start is None or here.has(model.prior)):
        return False
    if sensors:
        return has_prior or model.finds_start or any(measures_state(model, each) for each, _ in sensors)
    if not model.needs_sensor:
        return True
    parts = {each.topic for each in model.all_sensors}
    parts |= {each.topic for sensor in model.all_sensors for each in sensor.maps}
    is_driven = model.control is not None and model.start is not None and not model.finds_start
    return is_driven and not any(map(here.has, parts))


def measures_state(model: Model, sensor: Sensor) -> bool:
    """Test whether a sensor measures only state components and its messages contain the covariance."""
    return bool(sensor.covariance) and sensor.measured.items() <= model.state.items()


def in_its_plane(label: str, model: Model, found: Found, topics: Mapping[str, Topic]) -> Found:
    """Determine the frame of the positions: the log's local tangent plane, or a separate frame.

    See also `Filter.start`. Raises BadInput if one sensor measures positions in a separate frame and
    another on earth, or if fixes are used and channels have different origins.
    """
    placing = [(sensor, topic) for sensor, topic in found.sensors if "x_m" in sensor.measured]
    if "x_m" not in model.state:
        placing = []
    own = [
        (sensor, topic)
        for sensor, topic in placing
        if topic not in found.geodetic
        and stated_in(topic.name, topic.metadata) is None
        and (topic.metadata.get(FRAME) or found.geodetic)
    ]
    origin = stated_origin(topics) if found.geodetic else None
    if origin is not None:
        own = [(sensor, topic) for sensor, topic in own if topic.metadata.get(FRAME)]
    if own and len(own) < len(placing):
        (sensor, topic), other = own[0], next(each for each in placing if each not in own)
        raise BadInput(
            f"estimator {label}: {other[1].name} measures positions on earth, {topic.name} positions in "
            f"{plane_in_words(topic.metadata)}, and no channel states its origin on earth; give it "
            f"with --set {topic.name}.plane=LATITUDE,LONGITUDE,HEIGHT, or leave one topic out with "
            f"--set topics.{other[0].topic}= or --set topics.{sensor.topic}="
        )
    if found.has_prior and frame_of(found.prior.metadata) and found.geodetic and "x_m" in model.state:
        raise BadInput(
            f"estimator {label}: {found.geodetic[0].name} measures positions on earth, "
            f"{found.prior.name} is in {plane_in_words(found.prior.metadata)}; give its origin on earth "
            f"with --set {found.prior.name}.plane=LATITUDE,LONGITUDE,HEIGHT, or import it again with "
            "--origin"
        )
    if own:
        return found._replace(frame=own[0][1].metadata[FRAME])
    starts_anywhere = not found.has_prior and not model.finds_start and model.start is not None
    if starts_anywhere and not placing and model.control is not None:
        return found._replace(frame=START)
    return found._replace(origin=origin)
