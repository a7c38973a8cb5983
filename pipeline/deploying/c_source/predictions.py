"""The bodies of the prediction functions of a filter in C: over a step, and over a gap."""

import re

from fuselog.pipeline.deploying.c_source.names import CFilter
from fuselog.pipeline.deploying.c_source.samples import moments_call, sampling_call, weighed
from fuselog.pipeline.deploying.c_source.statements import (
    Inputs,
    Loops,
    body,
    jacobian_loops,
    moved_state,
    noise_loops,
)
from fuselog.replay.tracing.c_text import c_lines


def predictions(made: CFilter) -> dict[str, str]:
    """Write the bodies of the prediction over a step and over a gap, for the template predict.c."""
    gap = {} if made.steps.gap is None else {"gap": _gap(made)}
    return {"step": _step(made), **gap}


def _step(made: CFilter) -> str:
    """Write the prediction over a step."""
    step, sampled, t = made.steps.predict, made.steps.sampled[0], made.tangent
    names, declared = Inputs(made, "motion").names(step, "control")
    named, assigned = moved_state(made, step)
    into = "noise" if made.is_root else "P"
    if sampled is None:
        call = (
            f"carry(filter, (const REAL(*)[T])F, columns_of_F, {t}, &found);"
            if made.is_root
            else "propagate(P, (const REAL(*)[T])F, columns_of_F); /* P = F P F' */"
        )
        loops, first, columns = jacobian_loops(step, "F", t, call, into, "states"), [], t
    else:
        loops, columns = noise_loops(step, t, into, "states"), len(sampled.points)
        first = [*_starting(made), sampling_call(made, 0)]
        first.append(
            f"spread(&samples, {weighed(sampled)}, {t}, 0, &found);"
            if made.is_root
            else moments_call(sampled, "&P[0][0], T, NULL")
        )
        assigned = [f"filter->mean[{i}] = samples.centre[{i}];" for i in range(made.states)]
    if made.is_root:
        assigned = [*loops.calls, *_factorising(made, columns), *assigned]
    else:
        assigned = [*loops.calls, *assigned]
    lines = [*first, *c_lines(named | loops.named, names, made.precision), *assigned]
    return _whole(made, [*loops.declared, *declared], lines)


def _starting(made: CFilter) -> list[str]:
    """Write the call that prepares the samples of the belief before the prediction."""
    if made.is_root:
        return ["start_samples(filter, &samples);"]
    return ["if (!start_samples(filter, &samples))", "    return NAME_NOT_POSITIVE_DEFINITE;"]


def _factorising(made: CFilter, columns: int) -> list[str]:
    """Write the calls that factorise a predicted covariance, from its `columns` and the noise."""
    t = made.tangent
    return [
        f"if (!factorise(&found, {t}, {columns}, {t}, &noise[0][0], T))",
        "    return NAME_NOT_POSITIVE_DEFINITE;",
        "take_factor(filter, &found);",
    ]


def _gap(made: CFilter) -> str:
    """Write the prediction over a gap in the controls, after which the filter continues."""
    step, t = made.steps.gap, made.tangent
    assert step is not None
    names, declared = Inputs(made, "motion").names(step, "control")
    loops: Loops = noise_loops(step, t, "noise" if made.is_root else "P", "states")
    lines = [*c_lines(loops.named, names, made.precision), *loops.calls]
    if made.is_root:
        lines = ["add_factor(filter, 0, &found);", *lines, *_factorising(made, t)]
    lines.append("filter->is_in_gap = 0;")
    return _whole(made, [*loops.declared, *declared], lines)


def _whole(made: CFilter, declared: list[str], lines: list[str]) -> str:
    """Write the body of a prediction from its lines, and declare the variables that they use."""
    text = "\n".join([*declared, *lines])
    real, span = made.precision.real, "seconds(filter->time_ns, time_ns)"
    used = {
        r"\bduration_s\b": f"const {real} duration_s = "
        + (f"({real})({span});" if real != "double" else f"{span};"),
        r"\bP[\[,]": "REAL (*const P)[T] = filter->covariance;",
        r"&noise\b": "REAL noise[T][T] = {{0}};",
        r"&found\b": "factorisation found;",
        r"&samples\b": "drawn_samples samples;",
    }
    first = [line for sign, line in used.items() if re.search(sign, text)]
    first += [] if re.search(r"\bparameters\b", text) else ["(void)parameters;"]
    last = ["filter->time_ns = time_ns;", "return checked(filter);"]
    return body([*first, *declared, *lines, *last])
