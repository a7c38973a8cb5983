"""The source of a filter in C99, generated from the graphs of its steps."""

import math
import re

from fuselog.pipeline.deploying.c_source.algebra import CHOLESKY
from fuselog.pipeline.deploying.c_source.braces import braced
from fuselog.pipeline.deploying.c_source.factors import (
    CARRYING,
    FACTORISING,
    RETRIANGULATE,
    SAMPLING,
    START,
)
from fuselog.pipeline.deploying.c_source.names import CFilter, filled, identifier
from fuselog.pipeline.deploying.c_source.predictions import predicting_text
from fuselog.pipeline.deploying.c_source.products import (
    MEASURE,
    PROPAGATE,
    add_through,
    slope_text,
    turn_text,
)
from fuselog.pipeline.deploying.c_source.samples import MOMENTS, ON_AXES, samples_text
from fuselog.pipeline.deploying.c_source.statements import (
    body,
    count_gains,
    turned_axes,
)
from fuselog.pipeline.deploying.c_source.updates import algebra_text, correcting_text, update_text
from fuselog.replay.inference.linear_algebra.factors import NOTHING_LEFT, ROUNDING
from fuselog.replay.inference.linear_algebra.manifold import right_jacobian_factors
from fuselog.replay.tracing.c_text import Precision, c_lines, helpers_of
from fuselog.replay.tracing.functions import trace
from fuselog.replay.tracing.graph import Graph, needed

IN_SINGLE = 5e-7, 3e-11  # ROUNDING is this multiple of the rounding error, NOTHING_LEFT its square


def source(made: CFilter) -> str:
    """Write the text of NAME.c."""
    every = [node for step in made.steps.all for node in needed([*step.outputs.values()])]
    parts = [
        f"/* {made.origin} Made by fuselog deploy; see {made.name}.h.\n"
        " * Compile it with -ffp-contract=off to have fuselog's bits. */",
        f'#include "{made.name}.h"\n\n#include <math.h>\n#include <string.h>\n',
        filled(made, "enum { T = NAME_TANGENT, M = NAME_MOST };\n"),
        _as_tuned(made),
        *helpers_of(every, made.precision),
        _checks(made),
        *_products(made),
        *samples_text(made),
        *_moments(made),
        _init(made),
        *predicting_text(made),
        *correcting_text(made),
        *algebra_text(made),
        *(update_text(made, number) for number in range(len(made.sensors))),
    ]
    return braced(_without_unused("\n".join(parts)))


_FUNCTION = re.compile(
    r"(?:/\*(?:(?!\*/).)*\*/\n)?static [^;={}]*?\b(\w+)\([^;{}]*\)\n\{\n.*?^\}\n\n?", re.S | re.M
)


def _without_unused(text: str) -> str:
    """Remove functions that are never called, and those that only these functions call."""
    for found in reversed([*_FUNCTION.finditer(text)]):
        if len(re.findall(rf"\b{found[1]}\(", text)) == 1:
            text = text[: found.start()] + text[found.end() :]
    return text


def _as_tuned(made: CFilter) -> str:
    number, lines = made.precision.number, []
    for row, (part, values) in enumerate(made.values.items()):
        entries = [f".{identifier(name)} = {number(value)}" for name, value in values.items()]
        if part != "motion":
            bounds = [number(each) for each in made.filtering.gates[row - 1][: made.most + 1]]
            options = made.robustness(row)
            settings = [
                f".{name} = {number(value) if name != 'reopens_s' else repr_double(value)}"
                for name, value in options.items()
            ]
            entries.append(f".gate = {{.nis = {{{', '.join(bounds)}}}, {', '.join(settings)}}}")
        entries = entries or [".unused = 0"]
        lines.append(
            f"    .{part} = {{" + ",".join(f"\n        {each}" for each in entries) + "\n    },"
        )
    return f"const {made.name}_parameters {made.name}_as_tuned = {{\n" + "\n".join(lines) + "\n};\n"


def repr_double(value: float) -> str:
    """Write a number in double precision."""
    return Precision().number(value)


_COPY = """\
    REAL factor[T][T];
    for (int row = 0; row < T; row++)
        for (int column = 0; column < T; column++)
            factor[row][column] = filter->covariance[row][column] = covariance[row * T + column];
    if (!cholesky(&factor[0][0], T, T))
        outcome = NAME_NOT_POSITIVE_DEFINITE;
"""


# a small processor tests the bits of a `double` faster than it adds; `float` it adds in hardware
_FINITE = """\
/* Whether numbers are finite: no exponent has all of its bits set. */
static int is_finite(const double *numbers, int count)
{
    const uint64_t exponent = 0x7FF0000000000000U;
    for (int i = 0; i < count; i++) {
        uint64_t bits;
        memcpy(&bits, &numbers[i], sizeof bits);
        if ((bits & exponent) == exponent)
            return 0;
    }
    return 1;
}
"""
_FINITE_IN_SINGLE = """\
/* Whether numbers are finite: then sum - sum is 0, and otherwise NaN. */
static int is_finite(const float *numbers, int count)
{
    float sum = 0.0f;
    for (int i = 0; i < count; i++)
        sum += numbers[i];
    return !isnan(sum - sum);
}
"""
_CHECKS = """\
/* NAME_WELL if the state is finite. */
static NAME_outcome checked(const NAME *filter)
{
    return is_finite(filter->mean, NAME_STATES) && is_finite(&filter->CARRIED[0][0], T * T)
               ? NAME_WELL
               : NAME_NOT_FINITE;
}

/* The time from a stamp to a later or equal one. */
static double seconds(int64_t from_ns, int64_t to_ns)
{
    return (double)((uint64_t)to_ns - (uint64_t)from_ns) * 1e-9;
}
"""


def _checks(made: CFilter) -> str:
    """Write the functions that check numbers and compute times."""
    checks = _CHECKS.replace("CARRIED", "factor" if made.is_root else "covariance")
    return "\n".join([_FINITE_IN_SINGLE if made.precision.ending else _FINITE, filled(made, checks)])


def _init(made: CFilter) -> str:
    control = made.filtering.initial
    driven = "".join(
        f"    filter->control[{index}] = {made.precision.number(value)};\n"
        for index, value in enumerate(control)
    )
    if made.is_interpolated:  # the control between the prior and its first message is unknown
        unknown = made.precision.number(math.nan)
        driven = "".join(f"    filter->control[{index}] = {unknown};\n" for index in range(len(control)))
        driven += "    filter->is_in_gap = 0;\n" if made.has_gaps else ""
    return filled(
        made,
        """NAME_outcome NAME_init(NAME *filter, int64_t time_ns, const REAL *mean,
    const REAL *covariance)
{
    NAME_outcome outcome = NAME_WELL;
    filter->time_ns = time_ns;
BELIEF    if (!is_finite(mean, NAME_STATES) || !is_finite(covariance, T * T))
        outcome = NAME_BAD_INPUT;
    for (int i = 0; i < NAME_STATES; i++)
        filter->mean[i] = outcome == NAME_WELL ? mean[i] : (REAL)NAN;
    for (int sensor = 0; sensor < NAME_SENSORS + 1; sensor++)
        filter->accepted_ns[sensor] = time_ns;
DRIVEN    return outcome;
}
""".replace("DRIVEN", driven).replace("BELIEF", START if made.is_root else _COPY),
    )


def _products(made: CFilter) -> list[str]:
    """Write the loops that the steps use."""
    steps, is_root = made.steps, made.is_root
    gained = [steps.predict, *([] if steps.gap is None else [steps.gap])]
    sizes = {"states": "T"} if any(map(count_gains, gained)) else {}
    sizes |= {"components": "M"} if any(map(count_gains, steps.innovate)) else {}
    texts: list[str] = []
    if is_root:
        texts += [_factorising(made), CARRYING, RETRIANGULATE]
    else:
        texts += [CHOLESKY, PROPAGATE, MEASURE]
    texts += add_through(sizes, max(map(count_gains, steps.all)))
    texts += [slope_text(is_root=is_root)] if steps.direction is not None else []
    if turned_axes(made):
        graph = Graph()
        factors = trace(graph, right_jacobian_factors, (None,)).returned
        lines = c_lines(dict(zip("fg", factors, strict=True)), {(0, None): "squared"}, made.precision)
        texts.append(turn_text(body(lines), is_root=is_root))
    return [filled(made, text) for text in texts]


def _moments(made: CFilter) -> list[str]:
    """Write the functions that compute moments of samples."""
    if not any(made.steps.sampled):
        return []
    if made.is_root:
        return [filled(made, SAMPLING)]
    is_on_axes = any(each is not None and len(each.axes) for each in made.steps.sampled)
    return [filled(made, MOMENTS + ON_AXES * is_on_axes)]


def _factorising(made: CFilter) -> str:
    """Write the factorisation of rows, with arrays that are large enough for every step."""
    t, m, number = made.tangent, made.most if made.sensors else 0, made.precision.number
    counts = [len(each.points) if each is not None else t for each in made.steps.sampled]
    columns = [counts[0] + t, *(count + m for count in counts[1:])]
    sizes = f"enum {{ SIDE = {max(t, m)}, ROWS = {t + m}, COLUMNS = {max(columns)} }};\n\n"
    rounding, nothing = IN_SINGLE if made.precision.ending else (ROUNDING, NOTHING_LEFT)
    return sizes + FACTORISING.replace("ROUNDING", number(rounding)).replace(
        "NOTHING_LEFT", number(nothing)
    )
