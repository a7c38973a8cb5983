"""Lookup of numbers that the channels of a log state, and of topics to which estimators bind."""

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
    """Return the first number `name` that a channel states, or NaN if it is missing but not needed.

    A channel may state `sigma_m` as its square, `variance_m2`, and vice versa.

    If the number is the value of a parameter, `parameters` is the type that checks it, and `stands_for`
    is the parameter's name if this differs from `name`. Raises BadInput if a needed number is missing,
    if it is not a number, or if the parameter does not accept it.
    """
    for topic in topics:
        if name in topic.metadata:
            return _number(topic.name, name, topic.metadata[name], parameters, stands_for or name)
        other, power = _POWERS.get(name, ("", 1.0))
        if other in topic.metadata:
            number: float = _number(topic.name, other, topic.metadata[other], _Noise, other) ** power
            return number
    if needed:
        remedy = (
            "record the log again with this number"
            if parameters is None
            else f"give it with --set {name}=..."
        )
        raise BadInput(f"topic {topics[0].name} does not state {name}; {remedy}")
    return np.nan


# For a number, the name under which channels state a power of it, and the exponent that inverts this
# power.
_POWERS = {"sigma_m": ("variance_m2", 0.5), "variance_m2": ("sigma_m", 2.0)}


class _Noise(Parameters):  # type: ignore[explicit-any]
    """Validator of stated noise, which must be positive."""

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
            f"topic {topic} states {name} = {text}, which is not a number; give a number"
        ) from None
    if parameters is not None:
        build(parameters, {stands_for: value}, f"topic {topic}")
    return value


def heading_variance(metadata: Mapping[str, str]) -> float:
    """Return the variance (rad^2) about the vertical axis from a channel, or NaN if it is not positive.

    The channel states one number for all axes, or the variances about x, y and z.
    """
    numbers = [float(each) for each in metadata.get("covariance_rad2", "nan").split(",")]
    return numbers[-1] if numbers[-1] > 0.0 else np.nan


def given_or_stated(values: Parameters, topics: Sequence[Topic], name: str) -> float:
    """Return a parameter or, if it is None, the value that a channel states; raise as `stated` does.

    Args:
        values: the parameters.
        topics: topics whose channels are searched, in this order.
        name: name of the parameter.
    """
    value = getattr(values, name)
    return stated(topics, name, type(values)) if value is None else float(value)


def numbered(topics: Mapping[str, Topic], stem: str, leaf: str, schema: Schema) -> dict[int, Topic]:
    """Return the topics /STEM<N>/LEAF of a schema, sorted by N.

    Args:
        topics: topics of the log, by name.
        stem: part of the name before the number.
        leaf: part of the name after the number.
        schema: schema that the topics must have.
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
    """Yield each prefix under which a log has all requested topics, and these topics by name.

    Optional topics may be missing.

    A name with a leading slash, such as `/landmarks`, is the same for all prefixes; other names, such
    as `odometry`, are searched under every prefix: `/robot1/odometry`, `/robot2/odometry`.
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
    """Return a topic's full name under a prefix; a name with a leading slash is not changed.

    Args:
        name: the name as an estimator or model states it.
        prefix: such as `/robot1`.
    """
    return name if name.startswith("/") or not name else f"{prefix}/{name}"
