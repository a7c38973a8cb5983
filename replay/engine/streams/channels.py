"""Reads what the channels of a log state, and finds the topics that estimators bind to."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np
from pydantic import PositiveFloat

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Schema, Topic
from fuselog.recorders.parameters import Parameters, build


def stated(
    topics: Sequence[Topic],
    name: str,
    parameters: type[Parameters] | None = None,
    *,
    needed: bool = True,
    stands_for: str = "",
) -> float:
    """Return the first number of this name that one of the channels states; NaN where none needs to.

    A channel may state `sigma_m` as its square, `variance_m2`, and the other way round.

    Where it stands for a parameter, that is of the type `parameters`, and called `stands_for` there if
    that is another name. Raises BadInput where none states it though it is needed, it is no number, or
    the parameter does not take it.
    """
    for topic in topics:
        if name in topic.metadata:
            return _number(topic.name, name, topic.metadata[name], parameters, stands_for or name)
        other, power = _POWERS.get(name, ("", 1.0))
        if other in topic.metadata:
            number: float = _number(topic.name, other, topic.metadata[other], _Noise, other) ** power
            return number
    if needed:
        mend = "record it again, with it" if parameters is None else f"give it with --set {name}=..."
        raise BadInput(f"topic {topics[0].name} does not state {name}; {mend}")
    return np.nan


# Of a number, another name that channels have for a power of it, and which power that takes back.
_POWERS = {"sigma_m": ("variance_m2", 0.5), "variance_m2": ("sigma_m", 2.0)}


class _Noise(Parameters):  # type: ignore[explicit-any]
    """States what these are: positive numbers."""

    sigma_m: PositiveFloat = 1.0
    variance_m2: PositiveFloat = 1.0


@lru_cache(maxsize=256)
def _number(
    topic: str, name: str, text: str, parameters: type[Parameters] | None, stands_for: str
) -> float:
    try:
        value = float(text)
    except ValueError:
        raise BadInput(
            f"topic {topic} states {name} = {text}, which is not a number; state a number"
        ) from None
    if parameters is not None:
        build(parameters, {stands_for: value}, f"topic {topic}")
    return value


def heading_variance(metadata: Mapping[str, str]) -> float:
    """Return the variance (rad^2) that a channel of orientations states about up; NaN where it is none.

    It states one number for all axes, or the covariance about x, y and z.
    """
    numbers = [float(each) for each in metadata.get("covariance_rad2", "nan").split(",")]
    return numbers[-1] if numbers[-1] > 0.0 else np.nan


def given_or_stated(values: Parameters, topics: Sequence[Topic], name: str) -> float:
    """Return a parameter; where it is None, what a channel states for it. Errors as `stated`.

    Args:
        values: the parameters.
        topics: asked in this order.
        name: of the parameter.
    """
    value = getattr(values, name)
    return stated(topics, name, type(values)) if value is None else float(value)


def numbered(topics: Mapping[str, Topic], stem: str, leaf: str, schema: Schema) -> dict[int, Topic]:
    """Return the topics /STEM<N>/LEAF of a schema, by N in order.

    Args:
        topics: of the log, by name.
        stem: in front of the number.
        leaf: behind it.
        schema: that the topics have to have.
    """
    found = {}
    for topic in topics.values():
        number = topic.name.removeprefix(f"/{stem}").removesuffix(f"/{leaf}")
        is_one = topic.name == f"/{stem}{number}/{leaf}" and topic.schema_name == schema.full_name
        if is_one and number.isdigit():
            found[int(number)] = topic
    return dict(sorted(found.items()))


def bindings(
    topics: Mapping[str, Topic], asked: Mapping[str, Schema], optional: Collection[str] = ()
) -> Iterator[tuple[str, dict[str, Topic]]]:
    """Find where a log has all the topics asked for, with their schemas: prefix, and topics by name.

    Those that are optional may be absent.

    A name with a slash in front, such as `/landmarks`, is a topic for all; others, such as `odometry`,
    are looked for under every prefix: `/robot1/odometry`, `/robot2/odometry`.
    """
    own = [name for name in asked if not name.startswith("/") and name not in optional]
    end = f"/{own[0]}" if own else ""
    prefixes = [name.removesuffix(end) for name in topics if name.endswith(end)] if own else [""]
    for prefix in prefixes:
        found = {
            name: topics[full]
            for name, schema in asked.items()
            if (full := resolved(name, prefix)) in topics
            and topics[full].schema_name == schema.full_name
        }
        if set(asked) - set(optional) <= set(found):
            yield prefix, found


def resolved(name: str, prefix: str) -> str:
    """Return a topic's full name under a prefix; one with a slash in front is the same for all.

    Args:
        name: as an estimator or model has it.
        prefix: such as `/robot1`.
    """
    return name if name.startswith("/") or not name else f"{prefix}/{name}"
