"""Writes functions at weighted samples in C, as `replay.inference.kalman.regression` has them.

Names as in `algebra`; SAMPLES, DRAWN, VALUES and PLACES are how many samples, numbers of one, tangent
components and components of a function's values there are at most.
"""

from collections.abc import Collection
from typing import Any

from pipeline.deploying.c_source.names import CFilter, filled
from pipeline.deploying.c_source.statements import Inputs, body, entries
from replay.inference.kalman.regression import MEANS
from replay.inference.linear_algebra.manifold import SETTLED
from replay.inference.sampled_steps import SETTLING, SampledFunction
from replay.tracing.c_text import c_lines, truth_text
from replay.tracing.graph import Node, steady

SETTLED_IN_SINGLE = 1e-7  # see `manifold.SETTLED`

TYPE = """\
/* What a function makes of samples: tangent vectors of these from the mean, behind which noise stands,
 * and of its values from their centre, less a shift. */
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

MOMENTS = """\
/* The state's factor, with room for noise behind it; 0 where its covariance is indefinite. */
static int start_samples(const NAME *filter, drawn_samples *samples)
{
    for (int row = 0; row < DRAWN; row++)
        for (int column = 0; column < DRAWN; column++)
            samples->factor[row][column] =
                row < T && column <= row ? filter->covariance[row][column] : 0.0_S;
    return cholesky(&samples->factor[0][0], DRAWN, T);
}

/* The covariance of the values, and where `cross` is not NULL that of the state with them. */
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


def samples_text(made: CFilter) -> list[str]:
    """Write tables of samples, and what motion and sensors make of them."""
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
    return [
        f"enum {{ {listed} }};\n",
        *tables.values(),
        filled(made, TYPE),
        *(
            text
            for number, each in enumerate(made.steps.sampled)
            if each is not None
            for text in (*_settling(made, number), _sampling(made, number)[0])
        ),
    ]


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


def weighed(sampled: SampledFunction) -> str:
    """Write the arguments that say how many samples there are, and what they weigh."""
    count, size = sampled.points.shape
    return f"{count}, weights_{size}"


def sampling_call(made: CFilter, number: int) -> str:
    """Write the call that fills `samples` with what the motion (0) or a sensor makes of them."""
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
    lines = [
        *declared,
        *c_lines(variances, names, made.precision, "u"),
        *(
            f"samples->factor[{first + k}][{first + k}] = sqrt_S({each});"
            for k, each in enumerate(variances)
        ),
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
    what = "the motion makes" if number == 0 else f"{name} measures"
    head = (
        f"/* What {what} of samples, and the mean of that. */\nstatic void sample_{name}({typed})\n{{\n"
    )
    return filled(made, head + text + "}\n"), f"sample_{name}({call});"


def _in_loop(
    made: CFilter, named: dict[str, Node], names: dict[Any, str], varying: Collection[int]
) -> tuple[list[str], list[str]]:
    """Write the lines of a loop over samples, and before it those of calls that are always the same.

    `varying` are the arguments that differ from sample to sample.
    """
    outputs = list(named.values())
    same = {node: f"same{i}" for i, node in enumerate(steady(outputs, lambda at: at[0] in varying), 1)}
    before = c_lines({name: node for node, name in same.items()}, names, made.precision, "s")
    return [*before], [*c_lines(named, names, made.precision, "w", same)]


def _settling(made: CFilter, number: int) -> list[str]:
    """Write the rounds in which a centre becomes the mean of values with angles or orientations."""
    sampled, name = made.steps.sampled[number], made.parts[number]
    assert sampled is not None
    if sampled.recentre is None:
        return []
    outputs = sampled.recentre.outputs
    moved = {f"moved_{place[0]}": node for (_, place), node in sampled.move.outputs.items()}
    values = {f"value_{i}": outputs["value", (i,)] for i in range(sampled.size)}
    move_names, _ = Inputs(made, name).names(sampled.move, "shift", "centre")
    names, _ = Inputs(made, name).names(sampled.recentre, "shift", "value")
    before, inside = _in_loop(made, values, names, SETTLING)
    again = truth_text(outputs["again", (0,)], names, made.precision)
    if made.precision.ending:
        again = again.replace(made.precision.number(SETTLED), made.precision.number(SETTLED_IN_SINGLE))
    lines = [
        "REAL *const centre = samples->centre, *const shift = samples->shift;",
        f"for (int round = 0; round < {MEANS}; round++) {{",
        "    int again = 0;",
        f"    find_shift(samples, {weighed(sampled)}, {sampled.size});",
        *(f"    {each}" for each in c_lines(moved, move_names, made.precision)),
        *(f"    centre[{i}] = moved_{i};" for i in range(len(moved))),
        *(f"    {each}" for each in before),
        f"    for (int index = 0; index < {len(sampled.points)}; index++) {{",
        "        REAL *const value = samples->values[index];",
        *(f"        {each}" for each in inside),
        f"        again = again || ({again});",
        *(f"        value[{i}] = value_{i};" for i in range(sampled.size)),
        "    }",
        f"    for (int i = 0; i < {sampled.size}; i++)",
        "        shift[i] = 0.0_S;",
        "    if (!again)",
        "        return;",
        "}",
    ]
    head = (
        "/* The centre becomes the mean of the values: what they are away from it sums to zero. */\n"
        f"static void settle_{name}(drawn_samples *samples)\n{{\n"
    )
    return [filled(made, head + body(lines) + "}\n")]
