"""The functions of a filter in C that update it: what its sensors measure, and how the state moves."""

import re

from pipeline.deploying.c_source.algebra import ALGEBRA, ITERATE, UPDATE
from pipeline.deploying.c_source.header import update_signature
from pipeline.deploying.c_source.names import CFilter, filled
from pipeline.deploying.c_source.statements import (
    Inputs,
    body,
    entries,
    guards,
    jacobian_loops,
    moved_state,
    turned_axes,
)
from replay.inference.kalman.iterated_update import SETTLED
from replay.tracing.c_text import c_lines


def correcting_text(made: CFilter) -> list[str]:
    """Write what moves the state, and what finds how it bends."""
    if not made.sensors:
        return []
    step, direction = made.steps.correct, made.steps.direction
    texts = []
    if direction is not None:
        names, declared = Inputs(made, "").names(direction)
        text = "/* Along what the state bends when it is moved. */\n"
        text += "static void bend(NAME *filter, REAL slope[T])\n{\n"
        text += body([*declared, "REAL a[T];"])
        text += body(c_lines(entries(direction, "a"), names, made.precision))
        texts.append(filled(made, text + "    find_slope(filter->covariance, a, slope);\n}\n"))
    names, declared = Inputs(made, "").names(step, "step", "slope")
    named, assigned = moved_state(made, step)
    if step.has("F"):
        call = "propagate(filter->covariance, F, columns_of_F);"
        loops = jacobian_loops(step, "F", made.tangent, call, "P", "states")
        declared = [*loops.declared, *declared]
        named |= loops.named
        assigned = [*loops.calls, *assigned]
    assigned += [f"turn(filter->covariance, step, {at});" for at in turned_axes(made)]
    head = (
        "/* Moves the state by a step of its tangent space, and the covariance with it. */\n"
        "static void correct(NAME *filter, const REAL step[T], const REAL slope[T])\n{\n"
    )
    lines = c_lines(named, names, made.precision)
    text = filled(made, head + body(declared)) + body(lines) + body(assigned) + "}\n"
    return [*texts, _bending(made, text)]


def _bending(made: CFilter, text: str) -> str:
    """Write what bends, or leave it out where nothing does."""
    if made.steps.direction is not None:
        return text.replace("FIND_SLOPE;", filled(made, "REAL slope[T];\n    bend(filter, slope);"))
    text = re.sub(r"\n *FIND_SLOPE;", "", text)
    return re.sub(r",\s*(const \w+ )?slope(\[\w+\])?(?=[,)])", "", text)


def algebra_text(made: CFilter) -> list[str]:
    """Write the update that all sensors have in common."""
    if not made.sensors:
        return []
    settled = made.precision.number(1e-6 if made.precision.ending else SETTLED)
    own = ITERATE.replace("LEAST_CHANGE", settled) if made.steps.is_iterated else UPDATE
    return [filled(made, ALGEBRA), _bending(made, filled(made, own))]


def update_text(made: CFilter, number: int) -> str:
    """Write the update by a sensor."""
    (name, sensor), step = made.sensors[number], made.steps.innovate[number]
    m = len(sensor.measured)
    names, declared = Inputs(made, name).names(step, "data", "", "step", "slope")
    named, calls = entries(step, "v"), []
    if step.has("S"):
        named |= {f"S[{i}][{j}]": step.outputs["S", (i, j)] for i in range(m) for j in range(i + 1)}
        named |= entries(step, "C")
        calls = [f"S[{j}][{i}] = S[{i}][{j}];" for i in range(m) for j in range(i)]
    else:
        call = f"measure(filter->covariance, H, columns_of_H, {m}, C, S); /* C = P H', S = H C */"
        loops = jacobian_loops(step, "H", m, call, "S", "components")
        declared = [*(filled(made, each) for each in loops.declared), *declared]
        named, calls = named | loops.named, loops.calls
    innovated = body(guards(made, step, names))
    innovated += body([*c_lines(named, names, made.precision), *calls])
    places = [made.innovation.index(each) for each in sensor.measured]
    missing = " && ".join(f"isnan(data[{index}])" for index in range(m))
    begin = (
        f"{update_signature(name)}\n{{\n"
        f"    static const int places[] = {{{', '.join(map(str, places))}}};\n"
        "    REAL v[M], S[M][M], C[T][M];\n"
    )
    given = f"    if ({missing})\n        return NAME_NOTHING_MEASURED;\n"
    if made.steps.is_iterated:
        return _linearise(made, name, body(declared) + innovated) + _bending(
            made,
            filled(
                made,
                f"{begin}    REAL step[T] = {{0}}, factor = 1.0_S;\n"
                f"    int outcome = UNSETTLED;\n{given}"
                "    FIND_SLOPE;\n    for (int iteration = 0; outcome == UNSETTLED; iteration++) {\n"
                f"        linearise_{name}(filter, step, slope, data, parameters, v, S, C);\n"
                f"        keep(innovation, {m}, places, v, S);\n"
                f"        outcome = iterate(filter, NAME_SENSOR_{name.upper()}, {m}, iteration,\n"
                "                          v, S, C, step, slope, &factor,\n"
                f"                          &parameters->{name}.gate, innovation);\n"
                "    }\n    return outcome;\n}\n",
            ),
        )
    end = (
        f"    keep(innovation, {m}, places, v, S);\n"
        f"    return update(filter, NAME_SENSOR_{name.upper()}, {m}, v, S, C,\n"
        f"                  &parameters->{name}.gate, innovation);\n}}\n"
    )
    return filled(made, begin) + body(declared) + filled(made, given) + innovated + filled(made, end)


def _linearise(made: CFilter, name: str, body: str) -> str:
    """Write the innovation of a sensor that is linearised at every iterate."""
    head = f"""/* The innovation about the mean, of the sensor linearised at the mean moved by a step. */
static void linearise_{name}(NAME *filter, const REAL step[T], const REAL slope[T], const REAL *data,
    const NAME_parameters *parameters, REAL v[M], REAL S[M][M], REAL C[T][M])
{{
"""
    unused = "" if "parameters->" in body else "    (void)parameters;\n"
    return _bending(made, filled(made, head) + unused + body + "}\n\n")
