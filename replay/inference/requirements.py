"""Descriptions of what models require of a log, for lists and for errors about missing topics."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from fuselog.recorders.log import Schema, Topic, schemas
from fuselog.replay.engine.streams.channels import resolved
from fuselog.replay.inference.model.binding import UnderPrefix, measures_state, serving, topics_of
from fuselog.replay.inference.model.model import (
    Model,
)

# Advice if no registered model fits a log; see docs/your-model.md.
OWN_MODEL = (
    'use a model of your own from Python, fl.modelled(MODEL, "ekf"), or register it: see Your model '
    "in the documentation"
)


def requirements_of(model: Model) -> str:
    """Describe the topics that a model requires or, if it can start without a prior, may use."""
    words = [part.words for part in parts_of(model, UnderPrefix({}, "...", {}))]
    if model.start is None or model.control is None or not model.needs_sensor:
        return "; ".join(words)
    control, *maps, sensors = words
    of_maps = [f"sensors with a map need {each}" for each in maps]
    return "; ".join([control, sensors.replace("one of", "any of", 1), *of_maps])


def nearest(models: Mapping[str, Model], topics: Mapping[str, Topic]) -> str:
    """Describe the model that a log most nearly fits, and the topics that the log lacks for it."""
    tried = [(name, nearest_parts(model, topics)) for name, model in models.items()]
    name, parts = max(tried, key=lambda one: _fit(one[1]))
    if not any(part.is_here for part in parts):
        which = f"{name} needs" if len(models) == 1 else "a registered model needs"
        return f"it has no topic that {which}"
    missing = "; ".join(part.words for part in parts if not part.is_here)
    if not missing:
        return f"model {name} fits it, but is used only if you name it: --model {name}"
    return f"model {name} is the closest one, but lacks {missing}"


def elsewhere(models: Mapping[str, Model], topics: Mapping[str, Topic], names: Mapping[str, str]) -> str:
    """Explain that the prior fits a model, but its control has another name in this log, or return "".

    An example is a log with several inertial units, from which the user must choose one.
    """
    for name, model in models.items():
        control = model.control
        if control is None or control.topic in names:
            continue
        others = [
            each for each, topic in topics.items() if topic.schema_name == control.schema.full_name
        ]
        end = f"/{names.get(model.prior, model.prior)}"
        priors = [each for each in topics if each.endswith(end)]
        for prior in priors:
            place = resolved(control.topic, prior.rpartition("/")[0])
            is_of_model = names_state(topics[prior], model, exactly=True)
            if others and place not in topics and is_of_model and not topics_of(model, topics, names):
                return (
                    f"{prior} belongs to model {name}, which needs {place} ({control.schema.full_name}"
                    f"); the log has {', '.join(others)} of that type: choose one, for example with "
                    f"--set topics.{control.topic}={others[0]}"
                )
    return ""


def nearest_parts(model: Model, topics: Mapping[str, Topic]) -> list["Requirement"]:
    """Return the requirements of a model under the prefix for which the log meets most of them."""
    prefixes = dict.fromkeys(["...", *(topic.rpartition("/")[0] for topic in topics)])
    return max((parts_of(model, UnderPrefix(topics, each, {})) for each in prefixes), key=_fit)


def _fit(parts: Sequence["Requirement"]) -> int:
    return sum(1 if part.is_here else -1 for part in parts)


class Requirement(NamedTuple):
    """Requirement of a model, and whether a log satisfies it."""

    words: str
    is_here: bool


def parts_of(model: Model, here: UnderPrefix) -> list[Requirement]:
    """Return all requirements of a model under one prefix."""

    def part(name: str, schema: Schema, system: str = "") -> Requirement:
        place, known = here.place(name), here.topics.get(here.place(name))
        words = f"{place} ({schema.full_name}"
        words += f" of system {system})" if system else ")"
        if known is not None and known.schema_name not in serving(schema):
            return Requirement(f"{words}, which has type {known.schema_name} in this log", is_here=False)
        is_of = known is not None and known.metadata.get("system", system) == system
        return Requirement(words, is_here=is_of)

    parts = []
    sensing = [sensor for sensor in model.all_sensors if here.has(sensor.topic)]
    starts = not sensing or model.finds_start or any(measures_state(model, each) for each in sensing)
    if model.start is None or here.has(model.prior) or not starts:
        words, is_here = part(model.prior, schemas.GAUSSIAN_ESTIMATE)
        if is_here:
            is_here = names_state(here.topics[here.place(model.prior)], model)
        parts.append(Requirement(f"{words} of {', '.join(model.state)}", is_here))
    if model.control is not None:
        parts.append(part(model.control.topic, model.control.schema))
    seeing = [sensor for sensor in model.sensors if not here.topics or here.has(sensor.topic)]
    maps = {each.topic: each for sensor in seeing for each in sensor.maps}
    parts += [part(topic, each.schema) for topic, each in maps.items()]
    sensors = [part(each.topic, each.schema, model.system) for each in model.all_sensors]
    if sensors and model.needs_sensor:
        own = len(model.sensors)
        words = ("one of " if own > 1 else "") + ", ".join(each.words for each in sensors[:own])
        words = ", or ".join([words, *(each.words for each in sensors[own:])])
        parts.append(Requirement(words, any(each.is_here for each in sensors)))
    return parts


def names_state(prior: Topic, model: Model, *, exactly: bool = False) -> bool:
    """Test whether a prior names all components of a model's state and, if `exactly`, no others."""
    named = set(prior.metadata.get("components", "").split(","))
    return named == set(model.state) if exactly else named >= set(model.state)
