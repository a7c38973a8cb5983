"""Files next to a filter in C: build instructions and a description."""

from collections.abc import Mapping
from textwrap import fill
from typing import Any

from fuselog.pipeline.deploying.c_replay import why_no_replay
from fuselog.pipeline.deploying.c_source.header import data_of, outcomes
from fuselog.pipeline.deploying.c_source.names import CFilter, identifier
from fuselog.pipeline.deploying.c_target import target_lines
from fuselog.pipeline.deploying.certificate import OPTIONS, Certificate
from fuselog.pipeline.deploying.costs import Cost
from fuselog.replay.inference.kalman.iterated_update import ITERATIONS
from fuselog.replay.inference.kalman.regression import MEANS


def cmake_text(made: CFilter) -> str:
    """Write the text of CMakeLists.txt."""
    name = made.name
    lines = [
        "cmake_minimum_required(VERSION 3.13)",
        f"project({name} C)",
        "set(CMAKE_C_STANDARD 99)",
        "set(CMAKE_C_STANDARD_REQUIRED ON)",
        "set(CMAKE_C_EXTENSIONS OFF)",
        "if(NOT CMAKE_BUILD_TYPE)",
        "  set(CMAKE_BUILD_TYPE Release)",
        "endif()",
        "add_compile_options(-ffp-contract=off)  # a fused multiply-add rounds differently from fuselog",
        f"add_library({name} STATIC {name}.c)",
        f"target_link_libraries({name} m)",
        f"add_executable(test_{name} test_{name}.c)",
        f"target_link_libraries(test_{name} {name})",
        "enable_testing()",
        f"add_test(NAME recorded_log COMMAND test_{name}{' 0.01' if made.precision.ending else ''})",
    ]
    if not why_no_replay(made):
        lines += [
            f"add_library({name}_replay MODULE {name}_replay.c {name}.c)",
            f"target_link_libraries({name}_replay m)",
        ]
    return "\n".join(lines) + "\n"


def _costs(made: CFilter, certificate: Certificate) -> str:
    """Write the section on the cost of a step."""
    rows: dict[str, Cost] = {f"`{name}`": cost for name, cost in certificate.steps.items()}
    rows["worst case: `predict` and the costliest update"] = certificate.worst
    table = "\n".join(f"| {name} | {' | '.join(map(str, cost))} |" for name, cost in rows.items())
    memory = certificate.memory
    bytes_in_words = (
        "Without GCC, the sizes of code and stack are unknown."
        if memory is None
        else f"{memory.compiler}, {' '.join(OPTIONS)}: {memory.text} bytes of code and\nconstants, "
        f"and {memory.stack} bytes of stack in the deepest chain of calls, without those of libm's own."
    )
    of = "F L and H L of the\nfactor L" if made.is_root else "F P F', P H' and\nH P H'"
    saved = (
        f" The products {of} take {certificate.sparse} flops instead of {certificate.dense}, because "
        "known zeros and ones are skipped."
        if certificate.dense
        else ""
    )
    iterated = f", and all {ITERATIONS} iterations of an update" if made.steps.is_iterated else ""
    bent = any(each is not None and each.recentre is not None for each in made.steps.sampled)
    iterated += f",\nand all {MEANS} rounds to a mean of angles or orientations" if bent else ""
    return f"""| function | flops | square roots | other calls of libm |
|---|---|---|---|
{table}

These are upper bounds: the more expensive side of every branch is counted{iterated}.{saved}

{bytes_in_words}"""


def _single(made: CFilter, certificate: Certificate, log: str) -> str:
    """Write the section on single precision."""
    if not made.precision.ending:
        return ""
    single = certificate.single
    if single is None:
        sentence = f"The test was not run because GCC is missing; `test_{made.name}` shows the effect."
    elif single.lost_event is not None:
        lost = lost_sentence(single._asdict(), is_root=made.is_root)
        sentence = f"{lost[0].upper()}{lost[1:]}."
    else:
        sentence = (
            f"Over the first {single.estimates} estimates of {log}, means and covariances are within "
            f"{single.furthest:.1g} of those in double precision, relative to the number if it is "
            "larger than one."
        )
    more = (
        "To compare libraries of both precisions over whole logs, with intervals, use "
        "`fuselog compare LOG ... -e lib:A.so -e lib:B.so`."
    )
    text = fill(f"{sentence} {more}", 100, break_on_hyphens=False, break_long_words=False)
    return f"\n## Effect of single precision\n\n{text}\n"


def lost_sentence(single: Mapping[str, Any], *, is_root: bool) -> str:
    """Describe when single precision loses the covariance, and what to use instead."""
    remedy = "" if is_root else "; use a square-root form, sqrt:ekf or sqrt:ukf"
    return (
        f"from event {single['lost_event']} of the test on, after {single['lost_s']:g} s, the "
        f"covariance in single precision is no longer positive definite, unlike in double{remedy}"
    )


def _loop(made: CFilter) -> str:
    """Write an example loop over messages, with control, prediction, update and handling of outcomes."""
    name, upper = made.name, made.name.upper()
    driven = [
        f"filter.control[{upper}_CONTROL_{identifier(each).upper()}] = message.{identifier(each)};"
        for each in (() if made.is_interpolated else made.controls)
    ]
    control = ", message.control" if made.is_interpolated else ""
    lines = [
        f"{name} filter;",
        f"{name}_innovation innovation;",
        f"{name}_outcome outcome = {name}_init(&filter, time_ns, mean, covariance);",
        f"while (outcome != {upper}_NOT_POSITIVE_DEFINITE && outcome != {upper}_NOT_FINITE) {{",
        "    /* wait for the next message, in the order of the stamps */",
        f"    outcome = {name}_predict(&filter, message.time_ns{control}, &{name}_as_tuned);",
    ]
    if driven:
        lines.append("    if (message.is_control) { /* it holds from here on */")
        lines += [*(f"        {each}" for each in driven), "    }"]
    for each, _ in made.sensors[:1]:
        lines += [
            f"    if (outcome == {upper}_WELL && message.is_{each}) {{ /* the same for each sensor */",
            f"        outcome = {name}_update_{each}(&filter, message.data, &{name}_as_tuned,",
            "            &innovation);",
            "    }",
        ]
    return "\n".join([*lines, "}"])


def readme_text(made: CFilter, log: str, certificate: Certificate) -> str:
    """Write the text of README.md."""
    name, upper = made.name, made.name.upper()
    updates = [
        f"| `{name}_update_{each}` | {sensor.topic} | {', '.join(data_of(sensor))} |"
        for each, sensor in made.sensors
    ]
    codes = "\n".join(f"| `{upper}_{code}` | {meaning} |" for code, meaning in outcomes(made).items())
    why_not = why_no_replay(made)
    back = (
        f"fuselog cannot replay it: {why_not}."
        if why_not
        else f"""fuselog can replay it next to its own filter (`fuselog_filter.h` is the interface):

```
cc -std=c99 -O2 -ffp-contract=off -shared -fPIC {name}_replay.c {name}.c -lm -o {name}.so
fuselog replay PATH/{log} -e lib:./{name}.so
```"""
    )
    return f"""# {name}

{made.origin} Made by `fuselog deploy` from {log}; graphs and numbers `{made.digest}`.

C99 and libm: no heap, no recursion, no arrays of varying length. The filter is a struct that you own.

```c
{_loop(made)}
```

| function | message | `data`, NAN if a component is missing |
|---|---|---|
{chr(10).join(updates)}

An update applies at the filter's time, so predict to a message's stamp first. Every function returns a
`{name}_outcome`:

| outcome | meaning |
|---|---|
{codes}

`innovation.is_accepted` is 1 if the measurement changed the state, and 0 with every outcome except
`{upper}_WELL`. Angles of the state are not wrapped. The parameters that it was tuned with are in
`{name}_as_tuned`; copy it to change them.

## Test

```
cc -std=c99 -O2 -ffp-contract=off test_{name}.c {name}.c -lm -o test_{name}
./test_{name}{" 0.01" if made.precision.ending else ""}
```

It runs over the first messages of {log} from the filter's start, with an outlier for every gate. It
fails if there are no estimates or no accepted measurements. It prints how many measurements of each
sensor were accepted and rejected, which sensors and gates the log does not test, and the largest
difference from fuselog's own filter. The difference is zero with the same libm, in double precision
and without fused multiply-adds, which `-ffp-contract=off` forbids. With Debian's gcc-arm-none-eabi,
libnewlib-arm-none-eabi and qemu-system-arm, the test also runs on an emulated Cortex-M4F and prints the
number of instructions per message. QEMU does not count cycles.

```
{chr(10).join(target_lines(name, argument="0.01" if made.precision.ending else "1e-12"))}
```

{back}

## Cost

{_costs(made, certificate)}
{_single(made, certificate, log)}"""
