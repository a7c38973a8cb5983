"""The source of a filter in C99: the template filter.c with the graphs of the filter's steps."""

import math
import re
from typing import Any

from fuselog.pipeline.deploying.c_source.braces import braced
from fuselog.pipeline.deploying.c_source.names import CFilter, identifier, rendered
from fuselog.pipeline.deploying.c_source.predictions import predictions
from fuselog.pipeline.deploying.c_source.samples import samples
from fuselog.pipeline.deploying.c_source.statements import body, count_gains, turned_axes
from fuselog.pipeline.deploying.c_source.updates import bent, corrections, update_text
from fuselog.replay.inference.kalman.iterated_update import SETTLED
from fuselog.replay.inference.linear_algebra.factors import NOTHING_LEFT, ROUNDING
from fuselog.replay.inference.linear_algebra.manifold import right_jacobian_factors
from fuselog.replay.tracing.c_text import Precision, c_lines, helpers_of
from fuselog.replay.tracing.functions import trace
from fuselog.replay.tracing.graph import Graph, needed

IN_SINGLE = 5e-7, 3e-11  # ROUNDING is this multiple of the rounding error, NOTHING_LEFT its square
SETTLED_IN_SINGLE = 1e-6  # see `iterated_update.SETTLED`


def source(made: CFilter) -> str:
    """Write the text of NAME.c."""
    every = [node for step in made.steps.all for node in needed([*step.outputs.values()])]
    number = made.precision.number
    # the control between the prior and its first message is unknown
    control = [math.nan if made.is_interpolated else value for value in made.filtering.initial]
    text = rendered(
        made,
        "filter.c",
        as_tuned=_as_tuned(made),
        helpers=[*helpers_of(every, made.precision)],
        control=[number(value) for value in control],
        least_change=number(SETTLED_IN_SINGLE if made.precision.ending else SETTLED),
        turn_factors=_turn_factors(made),
        corrections=corrections(made),
        updates=[update_text(made, number) for number in range(len(made.sensors))],
        **_gains(made),
        **_sizes_of_factors(made),
        **samples(made),
        **predictions(made),
    )
    return braced(_without_unused(bent(made, text.rstrip("\n") + "\n")))


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


def _gains(made: CFilter) -> dict[str, Any]:
    """List the matrices to which noises with gains are added, with their sizes, and the most gains."""
    steps = made.steps
    predicted = [steps.predict, *([] if steps.gap is None else [steps.gap])]
    gained = [("states", "T")] if any(map(count_gains, predicted)) else []
    gained += [("components", "M")] if any(map(count_gains, steps.innovate)) else []
    return {"gained": gained, "gains": max(map(count_gains, steps.all)) if gained else 0}


def _turn_factors(made: CFilter) -> str:
    """Write the factors with which a correction turns a covariance; "" if there are no orientations."""
    if not turned_axes(made):
        return ""
    factors = trace(Graph(), right_jacobian_factors, (None,)).returned
    return body(c_lines(dict(zip("fg", factors, strict=True)), {(0, None): "squared"}, made.precision))


def _sizes_of_factors(made: CFilter) -> dict[str, Any]:
    """Return sizes of arrays that are large enough for the factorisation of every step, and rounding."""
    t, m, number = made.tangent, made.most if made.sensors else 0, made.precision.number
    counts = [len(each.points) if each is not None else t for each in made.steps.sampled]
    rounding, nothing = IN_SINGLE if made.precision.ending else (ROUNDING, NOTHING_LEFT)
    return {
        "side": max(t, m),
        "rows": t + m,
        "columns": max(counts[0] + t, *(count + m for count in counts[1:])),
        "rounding": number(rounding),
        "nothing_left": number(nothing),
    }
