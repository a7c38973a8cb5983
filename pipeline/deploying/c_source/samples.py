"""C functions evaluated at weighted samples, as in `fuselog.replay.inference.kalman.regression`."""

from collections.abc import Collection
from typing import Any

import numpy as np

from fuselog.pipeline.deploying.c_source.names import CFilter
from fuselog.pipeline.deploying.c_source.statements import Inputs, body, entries
from fuselog.replay.inference.kalman.regression import MEANS
from fuselog.replay.inference.kalman.wide_angles import QUARTER_RAD, UNIFORM_RAD, WIDE_RAD
from fuselog.replay.inference.linear_algebra.manifold import SETTLED
from fuselog.replay.inference.sampled_steps import SETTLING, SampledFunction
from fuselog.replay.tracing.c_text import c_lines, truth_text
from fuselog.replay.tracing.graph import Node, steady

SETTLED_IN_SINGLE = 1e-7  # see `manifold.SETTLED`


def samples(made: CFilter) -> dict[str, Any]:
    """Write the tables of samples, and the functions that evaluate motion and sensors at the samples."""
    functions = [each for each in made.steps.sampled if each is not None]
    if not functions:
        return {"tables": ""}
    sizes = {
        "SAMPLES": max(len(each.points) for each in functions),
        "DRAWN": max(each.points.shape[1] for each in functions),
        "VALUES": max(each.size for each in functions),
        "PLACES": max(len(each.centre.outputs) for each in functions),
    }
    listed = ", ".join(f"{name} = {size}" for name, size in sizes.items())
    tables = {each.points.shape[1]: _table(made, each) for each in functions}
    on_axes = [] if made.is_root else [each for each in functions if len(each.axes)]
    axes = {each.points.shape[1]: _axes_table(each) for each in on_axes}
    return {
        "tables": "\n".join([f"enum {{ {listed} }};\n", *tables.values(), *axes.values()]),
        "axes": axes,
        "functions": [
            text
            for number, each in enumerate(made.steps.sampled)
            if each is not None
            for text in (*_settling(made, number), _sampling(made, number)[0])
        ],
        **_turns(made, functions[0]),
    }


def _turns(made: CFilter, sampled: SampledFunction) -> dict[str, Any]:
    """List the angles of samples, which are kept within half a turn, with the limits."""
    first, width, times = zip(*sampled.turns, strict=True) if sampled.turns else ((), (), ())
    limits = {
        "uniform_rad": UNIFORM_RAD,
        "quarter_rad": QUARTER_RAD,
        "wide_rad": WIDE_RAD,
        "half_rad": np.pi,
    }
    number = made.precision.number
    return {
        "turns": len(first),
        "first": ", ".join(map(str, first)),
        "width": ", ".join(map(str, width)),
        "times": ", ".join(map(number, times)),
        **{name: number(limit) for name, limit in limits.items()},
    }


def _table(made: CFilter, sampled: SampledFunction) -> str:
    count, size = sampled.points.shape
    number = made.precision.number
    rows = ",\n".join(
        f"    {{{', '.join(number(float(each)) for each in row)}}}" for row in sampled.points
    )
    weights = ",\n    ".join(
        ", ".join(number(float(each)) for each in sampled.weights[first : first + 4])
        for first in range(0, count, 4)
    )
    return f"""/* Samples of N(0, I) in {size} dimensions, and their weights. */
static const REAL points_{size}[{count}][{size}] = {{
{rows}
}};
static const REAL weights_{size}[{count}] = {{
    {weights}
}};
"""


def _axes_table(sampled: SampledFunction) -> str:
    count, size = sampled.points.shape
    return f"static const int axes_{size}[{count}] = {{{', '.join(map(str, sampled.axes))}}};\n"


def weighed(sampled: SampledFunction) -> str:
    """Write the arguments for the number of samples and their weights."""
    count, size = sampled.points.shape
    return f"{count}, weights_{size}"


def moments_call(sampled: SampledFunction, filled_in: str) -> str:
    """Write the call that computes covariances; `filled_in` names the arrays that receive them."""
    if not len(sampled.axes):
        return f"find_moments(&samples, {weighed(sampled)}, {sampled.size}, {filled_in});"
    size = sampled.points.shape[1]
    kept = ", ".join(map(str, sampled.kept))
    table = f"(const int[]){{{kept}}}, {len(sampled.kept)}" if kept else "NULL, 0"
    return (
        f"find_moments_on_axes(&samples, {weighed(sampled)}, &points_{size}[0][0], {size}, axes_{size}, "
        f"{sampled.size}, {filled_in}, {table});"
    )


def sampling_call(made: CFilter, number: int) -> str:
    """Write the call that evaluates the motion (0) or a sensor at `samples`."""
    return _sampling(made, number)[1]


def _sampling(made: CFilter, number: int) -> tuple[str, str]:
    """Write the function that `sampling_call` calls, and the call."""
    sampled = made.steps.sampled[number]
    assert sampled is not None
    name, (count, size) = made.parts[number], sampled.points.shape
    arrays = ("control", "", "", "away", "centre") if number == 0 else ("data", "", "away", "centre")
    names: dict[Any, str] = {}
    declared: dict[str, None] = {}
    for step in (sampled.variances, sampled.centre, sampled.value):
        found, lines = Inputs(made, name).names(step, *arrays)
        names |= found
        declared |= dict.fromkeys(lines)
    variances = {f"variance_{place[0]}": node for (_, place), node in sampled.variances.outputs.items()}
    at_mean = {f"samples->{each}": node for each, node in entries(sampled.centre, "centre").items()}
    values = {
        f"samples->values[index][{place[0]}]": node for (_, place), node in sampled.value.outputs.items()
    }
    before, inside = _in_loop(made, values, names, sampled.varying)
    own = {"away": "samples->offsets[index]", "centre": "samples->centre"}
    used = [each for each in own if any(text.startswith(f"{each}[") for text in names.values())]
    first = size - len(variances)
    drawn = f"samples, {count}, {size}"
    narrow = f"narrow({drawn}, &points_{size}[0][0], {made.precision.number(sampled.unsuspected)}, "
    lines = [
        *declared,
        *c_lines(variances, names, made.precision, "u"),
        *(
            f"samples->factor[{first + k}][{first + k}] = sqrt_S({each});"
            for k, each in enumerate(variances)
        ),
        *([f"const REAL share = {narrow}{int(number == 0)});"] if sampled.turns else []),
        *c_lines(at_mean, names, made.precision),
        *before,
        f"for (int index = 0; index < {count}; index++) {{",
        *(f"    const REAL *const {each} = {own[each]};" for each in used),
        f"    draw(samples, index, {size}, points_{size}[index]);",
        *(f"    {each}" for each in inside),
        "}",
    ]
    if sampled.recentre is not None:
        lines.append(f"settle_{name}(samples);")
    else:
        lines.append(f"find_shift(samples, {weighed(sampled)}, {sampled.size});")
        lines.append(f"for (int i = 0; i < {sampled.size}; i++)")
        lines.append("    samples->centre[i] += samples->shift[i];")
    if sampled.turns:
        lines += ["if (share < 1)", f"    widen({drawn}, {sampled.size}, share);"]
    given = {
        "filter->": ("const NAME *filter", "filter"),
        "duration_s": ("REAL duration_s", "duration_s"),
        "data[": ("const REAL *data", "data"),
        "parameters->": ("const NAME_parameters *parameters", "parameters"),
    }
    text = body(lines)
    needed = [each for sign, each in given.items() if sign in text]
    typed = ", ".join([*(each for each, _ in needed), "drawn_samples *samples"])
    call = ", ".join([*(each for _, each in needed), "&samples"])
    what = "the motion gives" if number == 0 else f"{name} measures"
    head = f"/* What {what} at samples, and the mean of it. */\nstatic void sample_{name}({typed})\n{{\n"
    return head + text + "}\n", f"sample_{name}({call});"


def _in_loop(
    made: CFilter, named: dict[str, Node], names: dict[Any, str], varying: Collection[int]
) -> tuple[list[str], list[str]]:
    """Write the lines of a loop over samples, preceded by lines that are the same for all samples.

    `varying` are the arguments that differ from sample to sample.
    """
    outputs = list(named.values())
    same = {node: f"same{i}" for i, node in enumerate(steady(outputs, lambda at: at[0] in varying), 1)}
    before = c_lines({name: node for node, name in same.items()}, names, made.precision, "s")
    return [*before], [*c_lines(named, names, made.precision, "w", same)]


def _settling(made: CFilter, number: int) -> list[str]:
    """Write the iteration that moves a centre to the mean of values with angles or orientations."""
    sampled, name = made.steps.sampled[number], made.parts[number]
    assert sampled is not None
    if sampled.recentre is None:
        return []
    outputs = sampled.recentre.outputs
    moved = {f"moved_{place[0]}": node for (_, place), node in sampled.move.outputs.items()}
    turned = {name: moved[name] for name in (f"moved_{i}" for i in sampled.curved)}
    values = {f"value_{i}": outputs["value", (i,)] for i in sampled.curved_values}
    move_names, _ = Inputs(made, name).names(sampled.move, "shift", "centre")
    names, _ = Inputs(made, name).names(sampled.recentre, "shift", "value")
    before, inside = _in_loop(made, values, names, SETTLING)
    again = truth_text(outputs["again", (0,)], names, made.precision)
    if made.precision.ending:
        again = again.replace(made.precision.number(SETTLED), made.precision.number(SETTLED_IN_SINGLE))
    find = f"find_shift(samples, {weighed(sampled)}, {sampled.size});"
    lines = [
        "REAL *const centre = samples->centre, *const shift = samples->shift;",
        find,
        "{",
        *(f"    {each}" for each in c_lines(moved, move_names, made.precision)),
        *(f"    centre[{i}] = moved_{i};" for i in range(len(moved))),
        "}",
        f"for (int round = 0; round < {MEANS}; round++) {{",
        "    int again = 0;",
        *(f"    {each}" for each in before),
        f"    for (int index = 0; index < {len(sampled.points)}; index++) {{",
        "        REAL *const value = samples->values[index];",
        *(f"        {each}" for each in inside),
        f"        again = again || ({again});",
        *(f"        value[{i}] = value_{i};" for i in sampled.curved_values),
        "    }",
        *(f"    shift[{i}] = 0.0_S;" for i in sampled.curved_values),
        "    if (!again)",
        "        return;",
        f"    {find}",
        *(f"    {each}" for each in c_lines(turned, move_names, made.precision)),
        *(f"    centre[{i}] = moved_{i};" for i in sampled.curved),
        "}",
    ]
    head = (
        "/* The centre becomes the mean of the values: their deviations from it sum to zero. */\n"
        f"static void settle_{name}(drawn_samples *samples)\n{{\n"
    )
    return [head + body(lines) + "}\n"]
