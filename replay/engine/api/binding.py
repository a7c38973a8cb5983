"""Binding of function-based estimators to a log's topics, and descriptions of the topics they need."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

from fuselog.recorders.log import Schema, Topic, schemas
from fuselog.recorders.parameters import Parameters, ParametersType
from fuselog.replay.engine.api.inputs import AnyParameters, Binding
from fuselog.replay.engine.replaying.estimator import Bound, Estimator
from fuselog.replay.engine.streams.channels import bindings, resolved
from fuselog.replay.engine.vectors.components import Components

Find = Callable[[str, Mapping[str, Topic], AnyParameters], Iterable[Binding]]


def bindings_by_name(
    streams: Mapping[str, Schema],
    static: Mapping[str, Schema],
    optional: Collection[str],
    components: Components,
    _name: str,
    topics: Mapping[str, Topic],
    _values: Parameters,
) -> Iterator[Binding]:
    """Yield a binding for every prefix under which the log has all required topics."""
    for prefix, found in bindings(topics, {**streams, **static}, optional):
        followed, needed = (
            {name: found[name] for name in names if name in found} for names in (streams, static)
        )
        priors = [name for name in needed if static[name] is schemas.GAUSSIAN_ESTIMATE]
        yield Binding(followed, needed, prefix, dict.fromkeys(priors, components))


def requirements_of(asked: Mapping[str, Schema], optional: Collection[str]) -> str:
    """Describe the topics that a log must have, with their schemas."""
    return ", ".join(
        f"{resolved(name, '...')} ({schema.full_name}{', optional' if name in optional else ''})"
        for name, schema in asked.items()
    )


def topics_of(bound: Binding) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the topics that are processed, and of the static topics."""
    streams, static = (
        tuple(topic.name for topic in each.values()) for each in (bound.streams, bound.static)
    )
    return streams, static


def priors_of(bound: Binding) -> dict[str, Components]:
    """Return the components to read from each prior, by topic."""
    return {bound.static[name].name: components for name, components in bound.priors.items()}


def estimator_of(
    summary: str,
    requirements: str,
    parameters: type[ParametersType],
    variant: str | None,
    find: Find,
    bind_one: Callable[[str, Binding, ParametersType], Bound],
) -> Estimator[ParametersType]:
    """Make an estimator that calls `bind_one` for every binding that `find` yields."""

    def bind(label: str, topics: Mapping[str, Topic], values: ParametersType) -> list[Bound]:
        return [bind_one(f"{label}{each.suffix}", each, values) for each in find(label, topics, values)]

    return Estimator(summary, requirements, parameters, bind, variant)
