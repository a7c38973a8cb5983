"""The source of a filter in C99, of the graphs of its steps."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from pipeline.deploying.c_source.algebra import ALGEBRA
from pipeline.deploying.c_source.header import predict_signature, update_signature
from pipeline.deploying.c_source.names import CFilter, filled, identifier
from pipeline.deploying.c_source.products import (
    MEASURE,
    PROPAGATE,
    SLOPE,
    TURN,
    add_through,
    columns_text,
)
from replay.inference.linear_algebra.manifold import manifold_blocks, right_jacobian_factors
from replay.inference.whole_steps import Step
from replay.tracing.c_text import Precision, c_lines, helpers_of, truth_text
from replay.tracing.functions import trace
from replay.tracing.graph import INPUT, Graph, Node, needed


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
        _predict(made),
        _correct(made),
        *([filled(made, ALGEBRA)] if made.sensors else []),
        *(_update(made, number) for number in range(len(made.sensors))),
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


class _Inputs:
    """Names what a step is given, and declares what it uses."""

    def __init__(self, made: CFilter, part: str) -> None:
        model = made.filtering.stage.model
        self.state = [identifier(name) for name in model.state]
        self.controls = [identifier(name) for name in made.controls]
        self.part, self.made = part, made

    def names(self, step: Step, last: str) -> tuple[dict[Any, str], list[str]]:
        """Return the names by place, and the lines that declare them."""
        names: dict[Any, str] = {}
        lines: dict[str, str] = {}
        nodes = needed([*step.outputs.values(), *step.conditions])
        real = self.made.precision.real
        uses_covariance = False
        for node in nodes:
            if node.operation is not INPUT:
                continue
            argument, place = node.value
            declared = ""
            if argument == 0:
                name = self.state[place[0]]
                declared = f"filter->mean[{self.made.name.upper()}_{name.upper()}]"
            elif argument == 1:
                name, uses_covariance = f"P[{place[0]}][{place[1]}]", True
            elif isinstance(place, str):
                name = identifier(place)
                name = f"{name}_" if name in (*self.state, *self.controls) else name
                declared = f"parameters->{self.part}.{identifier(place)}"
            elif place is None:
                name = "duration_s"
            elif last == "control":
                name = self.controls[place[0]]
                declared = f"filter->control[{self.made.name.upper()}_CONTROL_{name.upper()}]"
            else:
                name = f"{'slope' if argument == 3 and last == 'step' else last}[{place[0]}]"
            names[node.value] = name
            if declared:
                lines[name] = f"const {real} {name} = {declared};"
        if uses_covariance:
            lines["P"] = f"{real} (*const P)[{self.made.name.upper()}_TANGENT] = filter->covariance;"
        return names, list(lines.values())


def _moved(made: CFilter, step: Step) -> tuple[dict[str, Node], list[str]]:
    """Name what a step makes of mean and covariance, and write the assignments."""
    state = [identifier(name) for name in made.filtering.stage.model.state]
    named: dict[str, Node] = {}
    lines: list[str] = []
    for (array, place), node in step.outputs.items():
        if array == "mean":
            name = f"next_{state[place[0]]}"
            named[name] = node
            lines.append(f"filter->mean[{made.name.upper()}_{state[place[0]].upper()}] = {name};")
        elif array == "P" and place[0] >= place[1]:
            row, column = place
            name = f"next_P{row}_{column}"
            named[name] = node
            twin = f"P[{column}][{row}] = " if row != column else ""
            lines.append(f"P[{row}][{column}] = {twin}{name};")
    return named, lines


class _Loops(NamedTuple):
    """Holds what loops over a Jacobian go by: declarations, what the graph gives, and the calls."""

    declared: list[str]
    named: dict[str, Node]
    calls: list[str]


def _loops(step: Step, jacobian: str, rows: int, multiply: str, into: str, what: str) -> _Loops:
    """Write what is done with a step's Jacobian, and the noise that is added to the product.

    Args:
        step: it gives the Jacobian, G and u, N.
        jacobian: its name, F or H.
        rows: how many it has.
        multiply: the call that forms the product.
        into: the matrix that becomes the product.
        what: `states` or `components`, for the size of that matrix.
    """
    size = "T" if what == "states" else "M"
    declared = [f"REAL {jacobian}[{size}][T];"]
    declared.insert(0, columns_text(f"columns_of_{jacobian}", step.columns(jacobian, rows), size))
    named = _entries(step, jacobian)
    calls = [multiply]
    gains = _gains(step)
    if gains:
        declared.append(f"REAL G[{size}][GAINS] = {{{{0}}}}, u[GAINS];")
        named |= _entries(step, "G") | _entries(step, "u")
        calls.append(f"add_through_{what}({into}, {rows}, G, u, {gains});")
    for (array, (row, *column)), node in step.outputs.items():
        if array == "N" and row >= column[0]:
            name = f"noise_{row}_{column[0]}"
            named[name] = node
            calls.append(f"{into}[{row}][{column[0]}] += {name};")
            if row > column[0]:
                calls.append(f"{into}[{column[0]}][{row}] = {into}[{row}][{column[0]}];")
    return _Loops(declared, named, calls)


def _entries(step: Step, array: str) -> dict[str, Node]:
    return {
        array + "".join(f"[{each}]" for each in place): node
        for (name, place), node in step.outputs.items()
        if name == array
    }


def _gains(step: Step) -> int:
    return sum(name == "u" for name, _ in step.outputs)


def _products(made: CFilter) -> list[str]:
    """Write the loops that the steps use."""
    steps = made.steps
    jacobians = [name for step in made.all_steps for name in ("F", "H") if step.has(name)]
    sizes = {"states": "T"} if _gains(steps.predict) else {}
    sizes |= {"components": "M"} if any(map(_gains, steps.innovate)) else {}
    texts = [PROPAGATE] if "F" in jacobians else []
    texts += [MEASURE] if "H" in jacobians else []
    texts += add_through(sizes, max(map(_gains, made.all_steps)))
    texts += [SLOPE] if steps.direction is not None else []
    if _turns(made):
        graph = Graph()
        factors = trace(graph, right_jacobian_factors, (None,)).returned
        lines = c_lines(dict(zip("fg", factors, strict=True)), {(0, None): "squared"}, made.precision)
        texts.append(TURN.replace("FACTORS\n", _body(lines)))
    return [filled(made, text) for text in texts]


def _turns(made: CFilter) -> list[int]:
    """List where the covariance of an orientation begins that is turned with it."""
    model = made.filtering.stage.model
    blocks = manifold_blocks(model.kinds) if made.sensors and model.correct is None else ()
    return [tangent for kind, _, tangent, _ in blocks if kind == "quaternion"]


def _body(lines: Iterable[str]) -> str:
    return "".join(f"    {each}\n" for each in lines)


def _guard(made: CFilter, step: Step, names: Mapping[Any, str]) -> list[str]:
    """Return early where the step's conditions do not hold."""
    return [
        f"if (!({truth_text(each, names, made.precision)}))\n"
        f"        return {made.name.upper()}_NOT_POSITIVE_DEFINITE;"
        for each in step.conditions
    ]


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
        if (!isnan(filter->control[0]))
            for (int k = 0; k < NAME_CONTROLS; k++)
                filter->control[k] = 0.5_S * (filter->control[k] + control[k]);
        outcome = predict(filter, time_ns, parameters);
    }
    for (int k = 0; k < NAME_CONTROLS; k++)
        if (!isnan(control[k]))
            filter->control[k] = control[k];
    return outcome;
}
"""


def _predict(made: CFilter) -> str:
    step = made.steps.predict
    names, declared = _Inputs(made, "motion").names(step, "control")
    named, assigned = _moved(made, step)
    if step.has("F"):
        call = "propagate(filter->covariance, F, columns_of_F); /* P = F P F' */"
        loops = _loops(step, "F", made.tangent, call, "P", "states")
        named |= loops.named
        declared = [*(filled(made, each) for each in loops.declared), *declared]
        assigned = [*loops.calls, *assigned]
    declared = _declares_covariance(made, declared, assigned)
    real = made.precision.real
    span = "(double)(time_ns - filter->time_ns) * 1e-9"
    if "duration_s" in names.values():
        declared.append(
            f"const {real} duration_s = " + (f"({real})({span});" if real != "double" else f"{span};")
        )
    begin = ["if (time_ns <= filter->time_ns)\n        return NAME_WELL;"]
    if made.is_interpolated:
        outer = filled(made, f"{predict_signature(made)}\n{_BETWEEN_CONTROLS}")
        signature = (
            "static int predict(NAME *filter, int64_t time_ns, const NAME_parameters *parameters)"
        )
        begin = []
    else:
        outer = ""
        signature = predict_signature(made)
    unused = [] if "parameters->" in "".join(declared) else ["(void)parameters;"]
    lines = [*c_lines(named, names, made.precision)]
    text = filled(made, f"{signature}\n{{\n{_body(begin)}") + _body(declared)
    text += _body(unused) + _body(_guard(made, step, names)) + _body(lines) + _body(assigned)
    text += filled(made, "    filter->time_ns = time_ns;\n    return NAME_WELL;\n}\n")
    return text + ("\n" + outer if outer else "")


def _correct(made: CFilter) -> str:
    if not made.sensors:
        return ""
    step, direction = made.steps.correct, made.steps.direction
    lines: list[str] = []
    names, declared = _Inputs(made, "").names(step, "step")
    named, assigned = _moved(made, step)
    if direction is not None:
        own, also = _Inputs(made, "").names(direction, "step")
        declared = list(dict.fromkeys([*also, *declared]))
        declared.append("REAL a[T], slope[T];")
        lines += [*c_lines(_entries(direction, "a"), own, made.precision)]
        lines.append("find_slope(filter->covariance, a, slope);")
    if step.has("F"):
        call = "propagate(filter->covariance, F, columns_of_F);"
        loops = _loops(step, "F", made.tangent, call, "P", "states")
        declared = [*loops.declared, *declared]
        named |= loops.named
        assigned = [*loops.calls, *assigned]
    assigned += [f"turn(filter->covariance, step, {at});" for at in _turns(made)]
    declared = [filled(made, each) for each in declared]
    lines += c_lines(named, names, made.precision, of="w" if direction is not None else "v")
    head = filled(
        made,
        "/* Moves the state by a step of its tangent space, and the covariance with it. */\n"
        "static void correct(NAME *filter, const REAL step[T])\n{\n",
    )
    return head + _body(declared) + _body(lines) + _body(assigned) + "}\n"


def _update(made: CFilter, number: int) -> str:
    (name, sensor), step = made.sensors[number], made.steps.innovate[number]
    m = len(sensor.measured)
    names, declared = _Inputs(made, name).names(step, "data")
    named, calls = _entries(step, "v"), []
    if step.has("S"):
        named |= {f"S[{i}][{j}]": step.outputs["S", (i, j)] for i in range(m) for j in range(i + 1)}
        named |= _entries(step, "C")
        calls = [f"S[{j}][{i}] = S[{i}][{j}];" for i in range(m) for j in range(i)]
    else:
        call = f"measure(filter->covariance, H, columns_of_H, {m}, C, S); /* C = P H', S = H C */"
        loops = _loops(step, "H", m, call, "S", "components")
        declared = [*(filled(made, each) for each in loops.declared), *declared]
        named, calls = named | loops.named, loops.calls
    places = [made.innovation.index(each) for each in sensor.measured]
    missing = " && ".join(f"isnan(data[{index}])" for index in range(m))
    begin = (
        f"{update_signature(name)}\n{{\n"
        f"    static const int places[] = {{{', '.join(map(str, places))}}};\n"
        "    REAL v[M], S[M][M], C[T][M];\n"
    )
    end = (
        f"    keep(innovation, {m}, places, v, S);\n"
        f"    return update(filter, NAME_SENSOR_{name.upper()}, {m}, v, S, C,\n"
        f"                  &parameters->{name}.gate, innovation);\n}}\n"
    )
    text = filled(made, begin) + _body(declared)
    text += filled(made, f"    if ({missing})\n        return NAME_NOTHING_MEASURED;\n")
    text += _body(_guard(made, step, names))
    text += _body([*c_lines(named, names, made.precision), *calls])
    return text + filled(made, end)
