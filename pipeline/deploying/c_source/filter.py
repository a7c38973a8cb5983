"""The source of a filter in C99, of the graphs of its steps."""

import re
from collections.abc import Sequence

from pipeline.deploying.c_source.header import predict_signature
from pipeline.deploying.c_source.names import CFilter, filled, identifier
from pipeline.deploying.c_source.products import (
    MEASURE,
    PROPAGATE,
    SLOPE,
    TURN,
    add_through,
)
from pipeline.deploying.c_source.statements import (
    Inputs,
    body,
    count_gains,
    guards,
    jacobian_loops,
    moved_state,
    noise_loops,
    turned_axes,
)
from pipeline.deploying.c_source.updates import algebra_text, correcting_text, update_text
from replay.inference.linear_algebra.manifold import right_jacobian_factors
from replay.tracing.c_text import Precision, c_lines, helpers_of
from replay.tracing.functions import trace
from replay.tracing.graph import Graph, needed


def source(made: CFilter) -> str:
    """Write NAME.c."""
    every = [
        node for step in made.all_steps for node in needed([*step.outputs.values(), *step.conditions])
    ]
    parts = [
        f"/* {made.origin} Made by fuselog deploy; see {made.name}.h.\n"
        " * Compile it with -ffp-contract=off to have fuselog's bits. */",
        f'#include "{made.name}.h"\n\n#include <math.h>\n',
        _as_tuned(made),
        *helpers_of(every, made.precision),
        *_products(made),
        _init(made),
        *([] if made.steps.gap is None else [_pass_gap(made)]),
        _predict(made),
        *correcting_text(made),
        *algebra_text(made),
        *(update_text(made, number) for number in range(len(made.sensors))),
    ]
    return "\n".join(parts)


def _as_tuned(made: CFilter) -> str:
    number, lines = made.precision.number, []
    for row, (part, values) in enumerate(made.values.items()):
        entries = [f".{identifier(name)} = {number(value)}" for name, value in values.items()]
        if part != "motion":
            bounds = [number(each) for each in made.filtering.gates[row - 1][: made.most + 1]]
            options = made.robustness(row)
            said = [
                f".{name} = {number(value) if name != 'reopens_s' else repr_double(value)}"
                for name, value in options.items()
            ]
            entries.append(f".gate = {{.nis = {{{', '.join(bounds)}}}, {', '.join(said)}}}")
        entries = entries or [".unused = 0"]
        lines.append(
            f"    .{part} = {{" + ",".join(f"\n        {each}" for each in entries) + "\n    },"
        )
    return f"const {made.name}_parameters {made.name}_as_tuned = {{\n" + "\n".join(lines) + "\n};\n"


def repr_double(value: float) -> str:
    """Write a number in double precision."""
    return Precision().number(value)


def _init(made: CFilter) -> str:
    control = made.filtering.initial
    driven = "".join(
        f"    filter->control[{index}] = {made.precision.number(value)};\n"
        for index, value in enumerate(control)
    )
    if made.is_interpolated:  # what drives it from the prior on is not known before its first message
        driven = "".join(f"    filter->control[{index}] = NAN;\n" for index in range(len(control)))
        driven += "    filter->is_in_gap = 0;\n" if made.has_gaps else ""
    return filled(
        made,
        """void NAME_init(NAME *filter, int64_t time_ns, const REAL *mean, const REAL *covariance)
{
    filter->time_ns = time_ns;
    for (int i = 0; i < NAME_STATES; i++)
        filter->mean[i] = mean[i];
    for (int row = 0; row < NAME_TANGENT; row++)
        for (int column = 0; column < NAME_TANGENT; column++)
            filter->covariance[row][column] = covariance[row * NAME_TANGENT + column];
    for (int sensor = 0; sensor < NAME_SENSORS + 1; sensor++)
        filter->accepted_ns[sensor] = time_ns;
DRIVEN}
""".replace("DRIVEN", driven),
    )


def _products(made: CFilter) -> list[str]:
    """Write the loops that the steps use."""
    steps = made.steps
    jacobians = [name for step in made.all_steps for name in ("F", "H") if step.has(name)]
    sizes = {"states": "T"} if count_gains(steps.predict) else {}
    sizes |= {"components": "M"} if any(map(count_gains, steps.innovate)) else {}
    texts = [PROPAGATE] if "F" in jacobians else []
    texts += [MEASURE] if "H" in jacobians else []
    texts += add_through(sizes, max(map(count_gains, made.all_steps)))
    texts += [SLOPE] if steps.direction is not None else []
    if turned_axes(made):
        graph = Graph()
        factors = trace(graph, right_jacobian_factors, (None,)).returned
        lines = c_lines(dict(zip("fg", factors, strict=True)), {(0, None): "squared"}, made.precision)
        texts.append(TURN.replace("FACTORS\n", body(lines)))
    return [filled(made, text) for text in texts]


def _declares_covariance(made: CFilter, declared: list[str], lines: Sequence[str]) -> list[str]:
    if any(re.search(r"\bP[\[,]", each) for each in lines) and not any(
        "const P)" in each for each in declared
    ):
        upper = made.name.upper()
        declared.append(f"{made.precision.real} (*const P)[{upper}_TANGENT] = filter->covariance;")
    return declared


_BETWEEN_CONTROLS = """{
    int outcome = NAME_WELL;
    if (time_ns < filter->time_ns)
        return NAME_WELL;
    if (time_ns > filter->time_ns) {
GAP        for (int k = 0; k < NAME_CONTROLS; k++) /* the first control holds from the start on */
            filter->control[k] =
                isnan(filter->control[k]) ? control[k] : 0.5_S * (filter->control[k] + control[k]);
        outcome = predict(filter, time_ns, parameters);
    }
    for (int k = 0; k < NAME_CONTROLS; k++)
        if (!isnan(control[k]))
            filter->control[k] = control[k];
    return outcome;
}
"""
_INTO_A_GAP = """\
        if (isnan(control[0]))
            filter->is_in_gap = 1;
        if (LOST)
            return NAME_NOT_DRIVEN;
"""
_OUT_OF_A_GAP = """\
        if (filter->is_in_gap) {
            pass_gap(filter, time_ns, parameters);
            for (int k = 0; k < NAME_CONTROLS; k++)
                filter->control[k] = control[k];
            return NAME_WELL;
        }
"""


def _span(made: CFilter) -> str:
    """Declare how long a prediction goes."""
    real, span = made.precision.real, "(double)(time_ns - filter->time_ns) * 1e-9"
    return f"const {real} duration_s = " + (f"({real})({span});" if real != "double" else f"{span};")


def _between_controls(made: CFilter) -> str:
    """Write the prediction of a filter whose control is interpolated."""
    gap = ""
    if made.has_gaps:
        lost = "isnan(control[0])" if made.steps.gap is not None else "filter->is_in_gap"
        gap = _INTO_A_GAP.replace("LOST", lost) + (_OUT_OF_A_GAP if made.steps.gap is not None else "")
    return filled(made, f"{predict_signature(made)}\n{_BETWEEN_CONTROLS.replace('GAP', gap)}")


def _pass_gap(made: CFilter) -> str:
    """Write the prediction over a gap of the control, after which it goes on."""
    step = made.steps.gap
    assert step is not None
    names, declared = Inputs(made, "motion").names(step, "control")
    loops = noise_loops(step, made.tangent, "P", "states")
    declared = _declares_covariance(made, declared, loops.calls)
    declared += [_span(made)] if "duration_s" in names.values() else []
    declared += [] if "parameters->" in "".join(declared) else ["(void)parameters;"]
    head = """/* Over a gap of what drives it: the mean stays, the covariance widens. */
static void pass_gap(NAME *filter, int64_t time_ns, const NAME_parameters *parameters)
{
"""
    lines = [*c_lines(loops.named, names, made.precision), *loops.calls]
    text = filled(made, head) + body(declared) + body(lines)
    return text + "    filter->is_in_gap = 0;\n    filter->time_ns = time_ns;\n}\n"


def _predict(made: CFilter) -> str:
    step = made.steps.predict
    names, declared = Inputs(made, "motion").names(step, "control")
    named, assigned = moved_state(made, step)
    if step.has("F"):
        call = "propagate(filter->covariance, F, columns_of_F); /* P = F P F' */"
        loops = jacobian_loops(step, "F", made.tangent, call, "P", "states")
        named |= loops.named
        declared = [*(filled(made, each) for each in loops.declared), *declared]
        assigned = [*loops.calls, *assigned]
    declared = _declares_covariance(made, declared, assigned)
    declared += [_span(made)] if "duration_s" in names.values() else []
    begin = ["if (time_ns <= filter->time_ns)\n        return NAME_WELL;"]
    if made.is_interpolated:
        outer = _between_controls(made)
        signature = (
            "static int predict(NAME *filter, int64_t time_ns, const NAME_parameters *parameters)"
        )
        begin = []
    else:
        outer = ""
        signature = predict_signature(made)
    unused = [] if "parameters->" in "".join(declared) else ["(void)parameters;"]
    lines = [*c_lines(named, names, made.precision)]
    text = filled(made, f"{signature}\n{{\n{body(begin)}") + body(declared)
    text += body(unused) + body(guards(made, step, names)) + body(lines) + body(assigned)
    text += filled(made, "    filter->time_ns = time_ns;\n    return NAME_WELL;\n}\n")
    return text + ("\n" + outer if outer else "")
