"""The update functions of a filter in C, which correct the state with measurements."""

import re

from fuselog.pipeline.deploying.c_source.names import CFilter
from fuselog.pipeline.deploying.c_source.samples import moments_call, sampling_call, weighed
from fuselog.pipeline.deploying.c_source.statements import (
    Inputs,
    Loops,
    body,
    entries,
    jacobian_loops,
    moved_state,
    noise_loops,
    retriangulates,
    turned_axes,
)
from fuselog.replay.tracing.c_text import c_lines


def corrections(made: CFilter) -> list[str]:
    """Write the function that corrects the state and, for a curved state, one for its curvature."""
    if not made.sensors:
        return []
    step, direction = made.steps.correct, made.steps.direction
    texts = []
    if direction is not None:
        names, declared = Inputs(made, "").names(direction)
        head = (
            "/* Finds how the state changes in the direction in which it is curved. */\n"
            "static void bend(NAME *filter, REAL slope[T])\n{\n"
        )
        lines = c_lines(entries(direction, "a"), names, made.precision)
        find = f"find_slope((const REAL(*)[T])filter->{made.carried}, a, slope);"
        texts.append(head + body([*declared, "REAL a[T];", *lines, find]) + "}\n")
    names, declared = Inputs(made, "").names(step, "step", "slope")
    named, assigned = moved_state(made, step)
    if step.has("F"):
        t, call = made.tangent, f"propagate(filter->{made.carried}, (const REAL(*)[T])F, columns_of_F);"
        if made.is_root:
            call = f"carry(filter, (const REAL(*)[T])F, columns_of_F, {t}, &found);"
            declared = ["factorisation found;", *declared]
            assigned = [f"orthogonalise(&found, {t}, {t});", "take_factor(filter, &found);", *assigned]
        loops = jacobian_loops(step, "F", t, call, "P", "states")
        declared = [*loops.declared, *declared]
        named |= loops.named
        assigned = [*loops.calls, *assigned]
    assigned += [f"turn(filter->{made.carried}, step, {at});" for at in turned_axes(made)]
    assigned += ["retriangulate(filter);"] if made.is_root and retriangulates(made) else []
    head = (
        "/* Moves the state by a step of its tangent space, and the covariance with it. */\n"
        "static void correct(NAME *filter, const REAL step[T], const REAL slope[T])\n{\n"
    )
    lines = c_lines(named, names, made.precision)
    return [*texts, head + body([*declared, *lines, *assigned]) + "}\n"]


def bent(made: CFilter, text: str) -> str:
    """Write the calls for curvature, or remove them if the state is not curved."""
    if made.steps.direction is not None:
        return text.replace("FIND_SLOPE;", f"{made.precision.real} slope[T];\n    bend(filter, slope);")
    text = re.sub(r"\n *FIND_SLOPE;", "", text)
    return re.sub(r",\s*(const \w+ )?slope(\[\w+\])?(?=[,)])", "", text)


def update_text(made: CFilter, number: int) -> str:
    """Write the update by a sensor."""
    name, sensor = made.sensors[number]
    m, loops, lines = len(sensor.measured), *_innovation(made, number)
    places = [made.innovation.index(each) for each in sensor.measured]
    missing = " && ".join(f"isnan(data[{index}])" for index in range(m))
    begin = [f"static const int places[] = {{{', '.join(map(str, places))}}};"]
    references = sensor.reference_size
    usable = f"is_usable(data, {m}, {references})"
    if sensor.covariance:
        usable += f" || !is_noise_usable(data, {m}, data + {m + references})"
    given = [
        "forget(innovation);",
        f"if ({missing})",
        "    return NAME_NOTHING_MEASURED;",
        f"if (!{usable})",
        "    return NAME_BAD_INPUT;",
    ]
    head = (
        f"NAME_outcome NAME_update_{name}(NAME *filter, const REAL *data,\n"
        "    const NAME_parameters *parameters, NAME_innovation *innovation)\n{\n"
    )
    gate = f"&parameters->{name}.gate, innovation"
    if made.steps.is_iterated:
        calls = [
            "REAL v[M], S[M][M], C[T][M];",
            "REAL step[T] = {0}, factor = 1.0_S;",
            "int outcome = UNSETTLED;",
            *given,
            "FIND_SLOPE;",
            "for (int iteration = 0; outcome == UNSETTLED; iteration++) {",
            f"    linearise_{name}(filter, step, slope, data, parameters, v, S, C);",
            f"    keep(innovation, {m}, places, v, (const REAL(*)[M])S);",
            f"    outcome = iterate(filter, NAME_SENSOR_{name.upper()}, {m}, iteration,",
            f"                      v, S, C, step, slope, &factor, {gate});",
            "}",
            "return finished(filter, outcome, innovation);",
        ]
        own = head + body([*begin, *calls]) + "}\n"
        return _linearise(name, body([*loops.declared, *lines])) + own
    if made.is_root:
        sampled = made.steps.sampled[number + 1]
        columns = made.tangent if sampled is None else len(sampled.points)
        begin.append("REAL v[M], noise[M][M] = {{0}};")
        begin.append("factorisation found;")
        end = [
            f"const int outcome = update(filter, NAME_SENSOR_{name.upper()}, {m}, {columns}, places,",
            f"                           v, noise, &found, {gate});",
        ]
    else:
        begin.append("REAL v[M], S[M][M], C[T][M];")
        end = [
            f"keep(innovation, {m}, places, v, (const REAL(*)[M])S);",
            f"const int outcome = update(filter, NAME_SENSOR_{name.upper()}, {m}, v, S, C,",
            f"                           {gate});",
        ]
    end.append("return finished(filter, outcome, innovation);")
    return head + body([*begin, *loops.declared, *given, *lines, *end]) + "}\n"


def _innovation(made: CFilter, number: int) -> tuple[Loops, list[str]]:
    """Write the innovation of a sensor, as loops with their declarations and lines."""
    (name, sensor), step = made.sensors[number], made.steps.innovate[number]
    m, t, sampled = len(sensor.measured), made.tangent, made.steps.sampled[number + 1]
    into = "noise" if made.is_root else "S"
    first: list[str] = []
    if sampled is None:
        names, declared = Inputs(made, name).names(step, "data", "", "step", "slope")
        call = (
            f"carry(filter, (const REAL(*)[T])H, columns_of_H, {m}, &found);"
            if made.is_root
            else f"measure((const REAL(*)[T])filter->covariance, (const REAL(*)[T])H, columns_of_H, {m},"
            " C, S); /* C = P H', S = H C */"
        )
        loops = jacobian_loops(step, "H", m, call, into, "components")
        if made.is_root:
            loops = loops._replace(calls=[*loops.calls, f"add_factor(filter, {m}, &found);"])
    else:
        names, declared = Inputs(made, name).names(step, "data", "", "samples.centre")
        loops = noise_loops(step, m, into, "components")
        declared = ["drawn_samples samples;", *declared]
        call = sampling_call(made, number + 1)
        if made.is_root:
            first = ["start_samples(filter, &samples);", call]
            first.append(f"spread(&samples, {weighed(sampled)}, {m}, {t}, &found);")
        else:
            first = ["if (!start_samples(filter, &samples))", "    return NAME_NOT_POSITIVE_DEFINITE;"]
            first.append(call)
            first.append(moments_call(sampled, "&S[0][0], M, C"))
    named = entries(step, "v") | loops.named
    lines = [*first, *c_lines(named, names, made.precision), *loops.calls]
    return loops._replace(declared=[*loops.declared, *declared]), lines


def _linearise(name: str, text: str) -> str:
    """Write the innovation of a sensor that is linearised in every iteration."""
    head = f"""/* The innovation about the mean, of the sensor linearised at the mean moved by a step. */
static void linearise_{name}(NAME *filter, const REAL step[T], const REAL slope[T], const REAL *data,
    const NAME_parameters *parameters, REAL v[M], REAL S[M][M], REAL C[T][M])
{{
"""
    unused = "" if "parameters->" in text else "    (void)parameters;\n"
    return head + unused + text + "}\n\n"
