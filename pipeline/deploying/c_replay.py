"""The interface through which fuselog replays a filter in C; it implements `fuselog_filter.h`."""

import json
from typing import Any

from fuselog.pipeline.deploying.c_source.braces import braced
from fuselog.pipeline.deploying.c_source.names import CFilter, filled, identifier
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
    parameters = _parameters(made)
    sets = "".join(
        f"    own->parameters.{place} = (REAL)parameters[{index}];\n"
        for index, (_, places, _) in enumerate(parameters)
        for place in places
    )
    cases, topic = [], 0
    for number, each in enumerate(maps):
        cases.append(
            f"    if (topic == {topic}) {{ /* {each.topic}, before the start */\n"
            f"        if (own->points{number} == MOST_POINTS)\n            return NO_ROOM;\n"
            f"        memcpy(own->point{number}[own->points{number}++], fields,\n"
            f"               {1 + each.size} * sizeof *fields);\n"
            "        return FUSELOG_FILTER_WELL;\n    }\n"
        )
        topic += 1
    cases.append(
        "    if (fuselog_filter_predict(filter, time_ns) != FUSELOG_FILTER_WELL)\n        return LOST;\n"
    )
    if made.controls:
        cases.append(
            f"    if (topic == {topic}) {{ /* the control */\n"
            "        for (int k = 0; k < NAME_CONTROLS; k++)\n"
            "            if (!isnan(fields[k]))\n"
            "                own->filter.control[k] = (REAL)fields[k];\n"
            "        return FUSELOG_FILTER_WELL;\n    }\n"
        )
        topic += 1
    for name, sensor in made.sensors:
        cases.append(
            f"    if (topic == {topic}) {{ /* {sensor.topic} */\n{_taking(name, sensor, maps)}    }}\n"
        )
        topic += 1
    points = "".join(
        f"    double point{number}[MOST_POINTS][{1 + each.size}];\n    int points{number};\n"
        for number, each in enumerate(maps)
    )
    angles = "".join(
        f"    mean[{index}] = wrapped(mean[{index}]);\n"
        for index, kind in enumerate(made.filtering.bound_model.model.kinds)
        if kind == "angle"
    )
    wrap = (
        """/* The equal angle in [-pi, pi). */
static double wrapped(double angle)
{
    const double pi = 3.141592653589793;
    double turned;
    if (fabs(angle) < pi)
        return angle;
    turned = fmod(angle + pi, 2.0 * pi);
    return (turned < 0.0 ? turned + 2.0 * pi : turned) - pi;
}

"""
        if angles
        else ""
    )
    text = f"""/* fuselog replays the filter with this: see docs/your-filter.md, fuselog_filter.h. */
#include "fuselog_filter.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "NAME.h"

{"enum { MOST_POINTS = 4096 };" if maps else ""}
enum {{ NEEDS_PRIOR = 1, LOST, NO_ROOM, BAD_PRIOR }};

typedef struct {{
    NAME filter;
    NAME_parameters parameters;
    NAME_innovation innovation;
    int32_t outcome; /* of the last message */
{points}}} Own;

/* Converts numbers of the interface to those of the filter. */
static void take(REAL *to, const double *from, int count)
{{
    for (int i = 0; i < count; i++)
        to[i] = (REAL)from[i];
}}

/* Converts them back. */
static void give(double *to, const REAL *from, int count)
{{
    for (int i = 0; i < count; i++)
        to[i] = (double)from[i];
}}

int32_t fuselog_filter_version(void) {{ return FUSELOG_FILTER_VERSION; }}

const char *fuselog_filter_describe(void)
{{
    return
DESCRIPTION;
}}

void *fuselog_filter_create(const double *parameters, uint64_t seed)
{{
    Own *own = calloc(1, sizeof *own);
    (void)seed;
    (void)parameters;
    if (own == NULL)
        return NULL;
    own->parameters = NAME_as_tuned;
{sets}    return own;
}}

void fuselog_filter_destroy(void *filter) {{ free(filter); }}

void *fuselog_filter_copy(const void *filter)
{{
    Own *copy = malloc(sizeof *copy);
    return copy != NULL ? memcpy(copy, filter, sizeof *copy) : NULL;
}}

int32_t fuselog_filter_start(void *filter, int64_t time_ns, const double *mean, const double *covariance)
{{
    Own *own = filter;
    REAL state[NAME_STATES], spread[NAME_TANGENT * NAME_TANGENT];
    if (mean == NULL)
        return NEEDS_PRIOR;
    take(state, mean, NAME_STATES);
    take(spread, covariance, NAME_TANGENT * NAME_TANGENT);
    return NAME_init(&own->filter, time_ns, state, spread) == NAME_WELL ? FUSELOG_FILTER_WELL
                                                                          : BAD_PRIOR;
}}

int32_t fuselog_filter_predict(void *filter, int64_t time_ns)
{{
    Own *own = filter;
    const NAME_outcome outcome = NAME_predict(&own->filter, time_ns, &own->parameters);
    return outcome == NAME_WELL || outcome == NAME_BACKWARD ? FUSELOG_FILTER_WELL : LOST;
}}

static int32_t told(Own *own, NAME_outcome outcome)
{{
    if (outcome == NAME_NOT_POSITIVE_DEFINITE || outcome == NAME_NOT_FINITE)
        return LOST;
    if (outcome == NAME_WELL)
        own->outcome = own->innovation.is_accepted ? FUSELOG_FILTER_WELL : FUSELOG_FILTER_REJECTED;
    return FUSELOG_FILTER_WELL;
}}

int32_t fuselog_filter_take(void *filter, int32_t topic, int64_t time_ns, const double *fields)
{{
    Own *own = filter;
    own->outcome = FUSELOG_FILTER_NOTHING;
{"".join(cases)}    return FUSELOG_FILTER_WELL;
}}

{wrap}int32_t fuselog_filter_state(const void *filter, double *mean, double *covariance)
{{
    const Own *own = filter;
COVARIANCE    give(mean, own->filter.mean, NAME_STATES);
{angles}    return FUSELOG_FILTER_WELL;
}}

int32_t fuselog_filter_innovation(const void *filter, double *innovation, double *covariance)
{{
    const Own *own = filter;
    if (own->outcome == FUSELOG_FILTER_NOTHING)
        return FUSELOG_FILTER_NOTHING;
    give(innovation, own->innovation.difference, NAME_INNOVATION);
    give(covariance, &own->innovation.covariance[0][0], NAME_INNOVATION * NAME_INNOVATION);
    return own->outcome;
}}
"""
    spread = "    give(covariance, &WHOSE[0][0], NAME_TANGENT * NAME_TANGENT);\n"
    covariance = (
        "    REAL spread[NAME_TANGENT][NAME_TANGENT];\n    NAME_covariance(&own->filter, spread);\n"
        + spread.replace("WHOSE", "spread")
        if made.is_root
        else spread.replace("WHOSE", "own->filter.covariance")
    )
    text = filled(made, text.replace("COVARIANCE", covariance))
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
