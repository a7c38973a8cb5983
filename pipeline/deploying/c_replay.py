"""The interface through which fuselog replays a filter in C; it implements `fuselog_filter.h`."""

import json
from typing import Any

from fuselog.pipeline.deploying.c_source.braces import braced
from fuselog.pipeline.deploying.c_source.names import CFilter, identifier, rendered
from fuselog.recorders.parameters import Role, field_of, meanings
from fuselog.recorders.units import unit_of
from fuselog.replay.engine.replaying.estimator import Reading
from fuselog.replay.inference.model.model import Map, Sensor


def why_no_replay(made: CFilter) -> str:
    """Explain why fuselog cannot replay the C code, or return "" if it can."""
    bound_model, found = made.filtering.bound_model, made.filtering.found
    if made.is_interpolated:
        return "its control is interpolated, so that messages have to wait for the next control"
    if found.fallbacks or (
        bound_model.model.control is not None and bound_model.model.control.read is not None
    ):
        return "its control is computed from messages in Python"
    if found.geodetic:
        return f"{found.geodetic[0].name} has latitudes and longitudes"
    for sensor in bound_model.sensors:
        if sensor.read is not None:
            return f"the measurement of {sensor.topic} is computed from its messages in Python"
        if sensor.is_numbered:
            return f"the measurement of {sensor.topic} depends on which numbered point it refers to"
    return ""


def _maps(made: CFilter) -> list[Map]:
    """List the maps to which sensors refer, without repetitions."""
    found = {each.topic: each for _, sensor in made.sensors for each in sensor.maps}
    return list(found.values())


def _fields(sensor: Sensor) -> list[str]:
    m = len(sensor.measured)
    fields = list(dict.fromkeys(each.of for each in sensor.maps))
    fields += [f"{sensor.vector}[{m}]"] if sensor.vector else list(sensor.measured)
    fields += [name if size == 1 else f"{name}[{size}]" for name, size in sensor.fields.items()]
    return [*fields, f"{sensor.covariance}[{m * m}]"] if sensor.covariance else fields


def _description(made: CFilter, reading: Reading) -> str:
    bound_model = made.filtering.bound_model
    model, single = bound_model.model, " in single precision" if made.precision.ending else ""
    told = {identifier(name): meaning for name, meaning in meanings(model.parameters).items()}
    topics: list[dict[str, Any]] = [
        {
            "topic": each.topic,
            "message": each.schema.full_name,
            "static": True,
            "fields": [each.number, f"{each.point}[{each.size}]"],
        }
        for each in _maps(made)
    ]
    if model.control is not None:
        control = model.control
        topics.append(
            {
                "topic": control.topic,
                "message": control.schema.full_name,
                "fields": list(control.components),
                "estimates": control.estimates,
            }
        )
    for _, sensor in made.sensors:
        topic = {"topic": sensor.topic, "message": sensor.schema.full_name, "fields": _fields(sensor)}
        topics.append(
            {**topic, "optional": True} | ({"target": sensor.maps[0].of} if sensor.maps else {})
        )
    return json.dumps(
        {
            "summary": f"{made.origin.rstrip('.')}, in C{single}",
            "digest": made.digest,
            "topics": topics,
            "prior": model.prior,
            "truth": model.truth,
            "output": model.output,
            "state": dict(model.state),
            "innovation": dict(made.filtering.measured),
            "parameters": {
                name: {
                    "default": value,
                    "unit": unit_of(name),
                    "meaning": told.get(places[0].partition(".")[2], ""),
                    "role": _role(places[0], reading),
                }
                for name, places, value in _parameters(made)
            },
            "failures": [
                "the filter needs a prior",
                "the covariance is no longer positive definite",
                "the map has more points than the filter has room for",
            ],
        }
    )


def _parameters(made: CFilter) -> list[tuple[str, list[str], float]]:
    """List the parameters' names, the C variables that contain each parameter, and the values.

    A parameter whose value differs between the motion and sensors is listed separately for each.
    """
    places: dict[str, dict[str, float]] = {}
    for part, values in made.values.items():
        for name, value in values.items():
            places.setdefault(name, {})[f"{part}.{identifier(name)}"] = value
    found: list[tuple[str, list[str], float]] = []
    for name, by_place in places.items():
        known = {place: value for place, value in by_place.items() if value == value}
        if len(set(known.values())) == 1:
            found.append((name, list(known), next(iter(known.values()))))
        else:
            found += [(place.replace(".", "_"), [place], value) for place, value in known.items()]
    return found


def _role(place: str, reading: Reading) -> Role:
    """Determine the role of a parameter from the functions of the model that use it."""
    _, _, name = place.partition(".")
    topics = {identifier(field_of(key)): topic for key, topic in reading.noises.items()}
    if name in topics:
        return "measurement noise" if topics[name] else "process noise"
    others = (*reading.augmentable, *reading.biases.values(), *reading.factors.values())
    return "parameter" if name in {identifier(field_of(key)) for key in others} else "setting"


def _literal(text: str) -> str:
    """Write a C string literal over several lines."""
    pieces = [text[first : first + 90] for first in range(0, len(text), 90)]
    return "\n".join(f"    {json.dumps(each)}" for each in pieces)


def replay_text(made: CFilter, reading: Reading) -> str:
    """Write the text of NAME_replay.c."""
    maps = _maps(made)
    first = len(maps) + bool(made.controls)
    kinds = made.filtering.bound_model.model.kinds
    text = rendered(
        made,
        "replay.c",
        maps=maps,
        places=[
            (index, place) for index, (_, places, _) in enumerate(_parameters(made)) for place in places
        ],
        updates=[
            (number, sensor.topic, _taking(name, sensor, maps))
            for number, (name, sensor) in enumerate(made.sensors, first)
        ],
        angles=[index for index, kind in enumerate(kinds) if kind == "angle"],
    )
    return braced(text).replace("DESCRIPTION", _literal(_description(made, reading)))


def _taking(name: str, sensor: Sensor, maps: list[Map]) -> str:
    """Write the code that passes the numbers of a sensor's message to the update."""
    m = len(sensor.measured)
    ids = list(dict.fromkeys(each.of for each in sensor.maps))
    first = len(ids)
    lines = [f"REAL data[{m + sensor.reference_size + (m * (m + 1) // 2 if sensor.covariance else 0)}];"]
    at = m
    for each in sensor.maps:
        number = [one.topic for one in maps].index(each.topic)
        lines.append("int at = 0;" if each is sensor.maps[0] else "at = 0;")
        where = ids.index(each.of)
        is_it = f"fabs(own->point{number}[at][0] - fields[{where}]) <= 0.0"
        lines.append(f"while (at < own->points{number} && !({is_it}))")
        lines.append("    at++;")
        lines.append(f"if (at == own->points{number})")
        lines.append("    return FUSELOG_FILTER_WELL; /* an unknown point is ignored */")
        lines.append(f"take(data + {at}, own->point{number}[at] + 1, {each.size});")
        at += each.size
    lines.append(f"take(data, fields + {first}, {m});")
    extra = sum(sensor.fields.values())
    if extra:
        lines.append(f"take(data + {at}, fields + {first + m}, {extra});")
        at += extra
    if sensor.covariance:
        start = first + m + extra
        for row in range(m):
            for column in range(row + 1):
                lines.append(f"data[{at}] = (REAL)fields[{start + row * m + column}];")
                at += 1
        missing = " || ".join(f"isnan(fields[{start + index}])" for index in range(m * m))
        lines.append(f"if ({missing})")
        lines.append("    return FUSELOG_FILTER_WELL; /* ignored without its covariance */")
    lines.append(
        f"return told(own, NAME_update_{name}(&own->filter, data, &own->parameters, &own->innovation));"
    )
    return "".join(f"        {line}\n" for line in lines)
