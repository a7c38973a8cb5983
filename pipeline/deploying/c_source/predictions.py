"""The prediction functions of a filter in C: over a step, between two controls, over a gap."""

import re

from fuselog.pipeline.deploying.c_source.header import predict_signature
from fuselog.pipeline.deploying.c_source.names import CFilter, filled
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

_BETWEEN_CONTROLS = """{
    NAME_outcome outcome = checked(filter);
    if (time_ns < filter->time_ns)
        return NAME_BACKWARD;
    for (int k = 0; k < NAME_CONTROLS; k++)
        if (isinf(control[k]) || isinf(filter->control[k]))
            return NAME_BAD_INPUT;
    if (time_ns > filter->time_ns) {
GAP        if (!is_finite(control, NAME_CONTROLS))
            return NAME_BAD_INPUT;
        for (int k = 0; k < NAME_CONTROLS; k++) /* the first control holds from the start on */
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
            if (!is_finite(control, NAME_CONTROLS))
                return NAME_BAD_INPUT;
            for (int k = 0; k < NAME_CONTROLS; k++)
                filter->control[k] = control[k];
            return pass_gap(filter, time_ns, parameters);
        }
"""
_ONWARD = """\
    if (time_ns < filter->time_ns)
        return NAME_BACKWARD;
    if (time_ns == filter->time_ns)
        return checked(filter);
"""
_DRIVEN = """\
    if (!is_finite(filter->control, NAME_CONTROLS))
        return NAME_BAD_INPUT;
"""
_STEP = "static NAME_outcome predict(NAME *filter, int64_t time_ns, const NAME_parameters *parameters)"
_PASS_GAP = """/* Over a gap of the control, the mean stays and the covariance grows. */
static NAME_outcome pass_gap(NAME *filter, int64_t time_ns, const NAME_parameters *parameters)"""


def predicting_text(made: CFilter) -> list[str]:
    """Write the prediction and the functions that it calls."""
    gap = [] if made.steps.gap is None else [_pass_gap(made)]
    if not made.is_interpolated:
        begin = _ONWARD + (_DRIVEN if made.controls else "")
        return [*gap, filled(made, f"{predict_signature(made)}\n{{\n{begin}{_step(made)}")]
    return [*gap, filled(made, f"{_STEP}\n{{\n{_step(made)}"), _between_controls(made)]


def _between_controls(made: CFilter) -> str:
    """Write the prediction of a filter whose control is interpolated."""
    gap = ""
    if made.has_gaps:
        lost = "isnan(control[0])" if made.steps.gap is not None else "filter->is_in_gap"
        gap = _INTO_A_GAP.replace("LOST", lost) + (_OUT_OF_A_GAP if made.steps.gap is not None else "")
    return filled(made, f"{predict_signature(made)}\n{_BETWEEN_CONTROLS.replace('GAP', gap)}")


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


def _pass_gap(made: CFilter) -> str:
    """Write the prediction over a gap in the controls, after which the filter continues."""
    step, t = made.steps.gap, made.tangent
    assert step is not None
    names, declared = Inputs(made, "motion").names(step, "control")
    loops: Loops = noise_loops(step, t, "noise" if made.is_root else "P", "states")
    lines = [*c_lines(loops.named, names, made.precision), *loops.calls]
    if made.is_root:
        lines = ["add_factor(filter, 0, &found);", *lines, *_factorising(made, t)]
    lines.append("filter->is_in_gap = 0;")
    return filled(made, f"{_PASS_GAP}\n{{\n{_whole(made, [*loops.declared, *declared], lines)}")


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
    return (
        body([*first, *declared, *lines, "filter->time_ns = time_ns;", "return checked(filter);"])
        + "}\n"
    )
