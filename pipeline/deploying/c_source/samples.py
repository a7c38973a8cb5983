"""C functions evaluated at weighted samples, as in `fuselog.replay.inference.kalman.regression`.

Placeholders are those of `algebra`. SAMPLES is the largest number of samples, and DRAWN the largest
number of entries in a sample. VALUES is the largest number of tangent components of a function's value,
and PLACES the largest number of its components.
"""

import re
from collections.abc import Collection
from typing import Any

import numpy as np

from fuselog.pipeline.deploying.c_source.names import CFilter, filled
from fuselog.pipeline.deploying.c_source.statements import Inputs, body, entries
from fuselog.replay.inference.kalman.regression import MEANS
from fuselog.replay.inference.kalman.wide_angles import QUARTER_RAD, UNIFORM_RAD, WIDE_RAD
from fuselog.replay.inference.linear_algebra.manifold import SETTLED
from fuselog.replay.inference.sampled_steps import SETTLING, SampledFunction
from fuselog.replay.tracing.c_text import c_lines, truth_text
from fuselog.replay.tracing.graph import Node, steady

SETTLED_IN_SINGLE = 1e-7  # see `manifold.SETTLED`

TYPE = """\
/* The results of a function at samples: tangent vectors of the samples from the mean, followed by noise,
 * and of its values from their centre, minus a shift. */
typedef struct {
    REAL factor[DRAWN][DRAWN]; /* of the covariance of state and noise */
    REAL offsets[SAMPLES][DRAWN], values[SAMPLES][VALUES];
    REAL centre[PLACES], shift[VALUES];
} drawn_samples;

/* A sample's offset: the factor times a point. */
static void draw(drawn_samples *samples, int index, int size, const REAL *point)
{
    for (int row = 0; row < size; row++) {
        REAL entry = samples->factor[row][0] * point[0];
        for (int k = 1; k <= row; k++)
            entry += samples->factor[row][k] * point[k];
        samples->offsets[index][row] = entry;
    }
}

/* The mean of the values becomes the shift. */
static void find_shift(drawn_samples *samples, int count, const REAL *weights, int size)
{
    for (int i = 0; i < size; i++) {
        REAL entry = 0.0_S;
        for (int k = 0; k < count; k++)
            entry += weights[k] * samples->values[k][i];
        samples->shift[i] = entry;
    }
}
"""

NARROWING = """\
/* The sum of the variances of `width` tangent components. */
static REAL squared_length(const drawn_samples *samples, int first, int width)
{
    REAL squared = 0.0_S;
    for (int row = first; row < first + width; row++)
        for (int k = 0; k <= row; k++)
            squared += samples->factor[row][k] * samples->factor[row][k];
    return squared;
}

/* The share of the factor at which samples are taken, so that no angle wraps: 1 unless an angle is
 * hardly known. A motion (`bounded`) samples no angle wider than uniform. */
static REAL narrow(drawn_samples *samples, int count, int size, const REAL *points, REAL unsuspected,
                   int bounded)
{
    static const int first[TURNS] = {FIRST}, width[TURNS] = {WIDTH};
    static const REAL times[TURNS] = {TIMES};
    REAL widest = 0.0_S, reach = 0.0_S;
    int suspected = 0;
    for (int turn = 0; turn < TURNS; turn++)
        if (times[turn] * times[turn] * squared_length(samples, first[turn], width[turn]) >
            unsuspected * unsuspected)
            suspected = 1;
    if (!suspected)
        return 1.0_S;
    for (int turn = 0; turn < TURNS; turn++) {
        REAL most = 0.0_S;
        for (int row = first[turn]; row < first[turn] + width[turn]; row++) {
            REAL wide = times[turn] * sqrt_S(squared_length(samples, row, 1));
            if (bounded && wide > UNIFORM_RAD) {
                for (int k = 0; k <= row; k++)
                    samples->factor[row][k] *= UNIFORM_RAD / wide;
                wide = UNIFORM_RAD;
            }
            widest = wide > widest ? wide : widest;
        }
        for (int index = 0; index < count; index++) {
            REAL squared = 0.0_S;
            for (int row = first[turn]; row < first[turn] + width[turn]; row++) {
                REAL away = 0.0_S;
                for (int k = 0; k <= row; k++)
                    away += samples->factor[row][k] * points[index * size + k];
                squared += away * away;
            }
            most = squared > most ? squared : most;
        }
        most = times[turn] * sqrt_S(most);
        reach = most > reach ? most : reach;
    }
    if (reach <= QUARTER_RAD || (widest <= WIDE_RAD && reach <= HALF_RAD))
        return 1.0_S;
    const REAL share = QUARTER_RAD / reach;
    for (int row = 0; row < size; row++)
        for (int k = 0; k <= row; k++)
            samples->factor[row][k] *= share;
    return share;
}

/* Rescales offsets and values of narrowed samples to their full width. */
static void widen(drawn_samples *samples, int count, int drawn, int size, REAL share)
{
    for (int index = 0; index < count; index++) {
        for (int row = 0; row < drawn; row++)
            samples->offsets[index][row] /= share;
        for (int i = 0; i < size; i++)
            samples->values[index][i] /= share;
    }
    for (int i = 0; i < size; i++)
        samples->shift[i] /= share;
    for (int row = 0; row < drawn; row++)
        for (int k = 0; k <= row; k++)
            samples->factor[row][k] /= share;
}
"""

MOMENTS = """\
/* The state's factor, with room for noise behind it; 0 if its covariance is indefinite. */
static int start_samples(const NAME *filter, drawn_samples *samples)
{
    for (int row = 0; row < DRAWN; row++)
        for (int column = 0; column < DRAWN; column++)
            samples->factor[row][column] =
                row < T && column <= row ? filter->covariance[row][column] : 0.0_S;
    return cholesky(&samples->factor[0][0], DRAWN, T);
}

/* The covariance of the values and, if `cross` is not NULL, that of the state with them. */
static void find_moments(const drawn_samples *samples, int count, const REAL *weights, int size,
                         REAL *spread, int stride, REAL (*cross)[M])
{
    for (int i = 0; i < size; i++)
        for (int j = 0; j <= i; j++) {
            REAL entry = 0.0_S;
            for (int k = 0; k < count; k++)
                entry += weights[k] * (samples->values[k][i] - samples->shift[i]) *
                         (samples->values[k][j] - samples->shift[j]);
            spread[i * stride + j] = spread[j * stride + i] = entry;
        }
    for (int row = 0; cross != NULL && row < T; row++)
        for (int i = 0; i < size; i++) {
            REAL entry = 0.0_S;
            for (int k = 0; k < count; k++)
                entry += samples->offsets[k][row] *
                         (weights[k] * (samples->values[k][i] - samples->shift[i]));
            cross[row][i] = entry;
        }
}
"""

ON_AXES = """\
/* The same for samples on axes: the covariance of the state with the values is the factor of the state's
 * covariance times that of the points with the values. The values `kept` are unchanged states. */
static void find_moments_on_axes(const drawn_samples *samples, int count, const REAL *weights,
                                 const REAL *points, int drawn, const int *axes, int size, REAL *spread,
                                 int stride, REAL (*cross)[M], const int *kept, int number)
{
    REAL joint[DRAWN][VALUES], mixed[T][VALUES];
    find_moments(samples, count, weights, size, spread, stride, NULL);
    for (int k = 0; k < drawn; k++)
        for (int i = 0; i < size; i++)
            joint[k][i] = 0.0_S;
    for (int k = 0; k < count; k++) {
        const int axis = axes[k];
        const REAL weighted = weights[k] * points[k * drawn + axis];
        for (int i = 0; i < size; i++)
            joint[axis][i] += weighted * (samples->values[k][i] - samples->shift[i]);
    }
    for (int row = 0; row < T; row++)
        for (int i = 0; i < size; i++) {
            REAL entry = 0.0_S;
            for (int k = 0; k <= row; k++)
                entry += samples->factor[row][k] * joint[k][i];
            mixed[row][i] = entry;
        }
    for (int row = 0; cross != NULL && row < T; row++)
        for (int i = 0; i < size; i++)
            cross[row][i] = mixed[row][i];
    for (int k = 0; k < number; k++)
        for (int i = 0; i < size; i++)
            spread[kept[k] * stride + i] = spread[i * stride + kept[k]] = mixed[kept[k]][i];
}
"""


def samples_text(made: CFilter) -> list[str]:
    """Write the tables of samples, and the functions that evaluate motion and sensors at the samples."""
    functions = [each for each in made.steps.sampled if each is not None]
    if not functions:
        return []
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
    return [
        f"enum {{ {listed} }};\n",
        *tables.values(),
        *axes.values(),
        filled(made, TYPE),
        *_narrowing(made, functions[0]),
        *(
            text
            for number, each in enumerate(made.steps.sampled)
            if each is not None
            for text in (*_settling(made, number), _sampling(made, number)[0])
        ),
    ]


def _narrowing(made: CFilter, sampled: SampledFunction) -> list[str]:
    """Write the functions that keep angles of samples within half a turn; [] if there are no angles."""
    if not sampled.turns:
        return []
    first, width, times = zip(*sampled.turns, strict=True)
    number = made.precision.number
    words = {
        "TURNS": str(len(first)),
        "FIRST": ", ".join(map(str, first)),
        "WIDTH": ", ".join(map(str, width)),
        "TIMES": ", ".join(map(number, times)),
        "UNIFORM_RAD": number(UNIFORM_RAD),
        "QUARTER_RAD": number(QUARTER_RAD),
        "WIDE_RAD": number(WIDE_RAD),
        "HALF_RAD": number(np.pi),
    }
    text = re.sub(r"\b(" + "|".join(words) + r")\b", lambda found: words[found[0]], NARROWING)
    return [filled(made, text)]


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
    text = f"""/* Samples of N(0, I) in {size} dimensions, and their weights. */
static const REAL points_{size}[{count}][{size}] = {{
{rows}
}};
static const REAL weights_{size}[{count}] = {{
    {weights}
}};
"""
    return made.precision.text(text)


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
    return filled(made, head + text + "}\n"), f"sample_{name}({call});"


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
    return [filled(made, head + body(lines) + "}\n")]
