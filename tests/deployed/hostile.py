"""Calls a deployed filter with what no caller should hand over, and looks at every outcome and state."""

import re
import subprocess
from pathlib import Path

from tests.deployed.building import COMPILERS, SANITIZERS, STRICT, sanitizes

_PROGRAM = """\
#include "NAME.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "vectors.h"

#define CHECK(condition) \\
    do { if (!(condition)) { printf("line %d: " #condition "\\n", __LINE__); wrong++; } } while (0)
static const REAL not_finite[] = {(REAL)NAN, (REAL)INFINITY, (REAL)-INFINITY};
static const REAL odd[] = {(REAL)1e38, (REAL)-1e38, (REAL)0, (REAL)-1, (REAL)1e-38};
static int wrong = 0, calls = 0;
static NAME_innovation innovation;

static int is_state_finite(const NAME *filter)
{
    int finite = 1;
    for (int i = 0; i < UPPER_STATES; i++)
        finite = finite && isfinite(filter->mean[i]);
    for (int i = 0; i < UPPER_TANGENT; i++)
        for (int j = 0; j < UPPER_TANGENT; j++)
            finite = finite && isfinite(filter->CARRIED[i][j]);
    return finite;
}

static int is_same(const NAME *a, const NAME *b)
{
    return a->time_ns == b->time_ns && memcmp(a->mean, b->mean, sizeof a->mean) == 0 &&
           memcmp(a->CARRIED, b->CARRIED, sizeof a->CARRIED) == 0;
}

static NAME_outcome judged(NAME_outcome outcome, const NAME *before, const NAME *after)
{
    calls++;
    CHECK(outcome >= UPPER_WELL && outcome <= LAST);
    CHECK(outcome != UPPER_WELL || is_state_finite(after));
    if (outcome == UPPER_BAD_INPUT || outcome == UPPER_BACKWARD || outcome == UPPER_NOTHING_MEASURED)
        CHECK(is_same(before, after));
    return outcome;
}

static NAME_outcome update(const NAME *filter, int sensor, const REAL *data)
{
    NAME own = *filter;
    NAME_outcome outcome = UPPER_WELL;
    memset(&innovation, 0x55, sizeof innovation);
    switch (sensor) {
UPDATES    default: break;
    }
    CHECK(innovation.is_accepted == 0 || (innovation.is_accepted == 1 && outcome == UPPER_WELL));
    return judged(outcome, filter, &own);
}

static NAME_outcome predict(NAME *filter, int64_t time_ns, const REAL *control)
{
    const NAME before = *filter;
    (void)control;
    return judged(NAME_predict(filter, time_ns, ARGUMENT&NAME_as_tuned), &before, filter);
}

static void attack(const NAME *filter, int sensor, const REAL *message)
{
    static const int measured[] = {MEASURED}, size[] = {SIZES};
    REAL data[VECTORS_WIDTH];
    for (int k = 0; k < size[sensor]; k++) {
        memcpy(data, message, sizeof data);
        for (int i = 0; i < 3; i++) {
            data[k] = not_finite[i];
            const NAME_outcome outcome = update(filter, sensor, data);
            if (i > 0 || k >= measured[sensor])
                CHECK(outcome == UPPER_BAD_INPUT || outcome == UPPER_NOTHING_MEASURED);
            else
                CHECK(outcome == UPPER_WELL || outcome == UPPER_NOTHING_MEASURED);
        }
        for (int i = 0; i < 5; i++) {
            data[k] = odd[i];
            update(filter, sensor, data);
        }
    }
    for (int k = 0; k < UPPER_STATES + UPPER_TANGENT * UPPER_TANGENT; k++)
        for (int i = 0; i < 3; i++) {
            NAME own = *filter;
            if (k < UPPER_STATES)
                own.mean[k] = not_finite[i];
            else
                (&own.CARRIED[0][0])[k - UPPER_STATES] = not_finite[i];
            update(&own, sensor, message);
        }
}

int main(void)
{
    NAME filter, own;
    static REAL control[UPPER_CONTROLS + 1];
    REAL mean[UPPER_STATES], covariance[UPPER_TANGENT * UPPER_TANGENT];
    int attacked[UPPER_SENSORS + 1] = {0};
    for (int k = 0; k < UPPER_STATES + UPPER_TANGENT * UPPER_TANGENT; k++)
        for (int i = 0; i < 3; i++) {
            memcpy(mean, prior_mean, sizeof mean);
            memcpy(covariance, prior_covariance, sizeof covariance);
            if (k < UPPER_STATES)
                mean[k] = not_finite[i];
            else
                covariance[k - UPPER_STATES] = not_finite[i];
            CHECK(NAME_init(&own, start_ns, mean, covariance) == UPPER_BAD_INPUT);
            CHECK(predict(&own, start_ns, control) == UPPER_NOT_FINITE);
        }
    memcpy(covariance, prior_covariance, sizeof covariance);
    covariance[0] = -covariance[0];
    CHECK(NAME_init(&own, start_ns, prior_mean, covariance) == UPPER_NOT_POSITIVE_DEFINITE);
    CHECK(predict(&own, start_ns, control) == UPPER_NOT_FINITE);
    CHECK(NAME_init(&filter, start_ns, prior_mean, prior_covariance) == UPPER_WELL);
    for (int event = 0; event < VECTORS_EVENTS; event++) {
        const int sensor = event_source[event];
        const REAL *const data = event_data[event];
        (void)predict(&filter, event_time_ns[event], data + VECTORS_WIDTH - UPPER_CONTROLS);
        if (event_accepted[event] == 1 && !attacked[sensor]++)
            attack(&filter, sensor, data);
    }
    CHECK(is_state_finite(&filter));
    for (int k = 0; k < UPPER_CONTROLS; k++)
        for (int i = 0; i < 3; i++) {
            own = filter;
            memset(control, 0, sizeof control);
            SET = not_finite[i];
            const NAME_outcome outcome = predict(&own, filter.time_ns + 1000000, control);
            CHECK(outcome == UPPER_BAD_INPUTGAP);
        }
    memset(control, 0, sizeof control);
    own = filter;
    CHECK(predict(&own, filter.time_ns, control) == UPPER_WELL);
    CHECK(predict(&own, filter.time_ns - 1, control) == UPPER_BACKWARD);
    CHECK(predict(&own, INT64_MIN, control) == UPPER_BACKWARD);
    own = filter;
    predict(&own, INT64_MAX, control);
    own = filter;
    own.time_ns = INT64_MIN;
    predict(&own, INT64_MAX, control);
    printf("%d calls, %d wrong\\n", calls, wrong);
    return wrong ? 1 : 0;
}
"""


def hold_out_by_all(folder: Path) -> int:
    """Run a filter under the hostile caller by all compilers, with sanitizers where they have these."""
    return min(hold_out(folder, each, sanitized=sanitizes(each)) for each in COMPILERS)


def hold_out(folder: Path, compiler: str, *, sanitized: bool) -> int:
    """Run a filter under the hostile caller; returns the number of calls, all of which went well."""
    [header] = (each for each in folder.glob("*.h") if (folder / f"test_{each.stem}.c").exists())
    name, text = header.stem, header.read_text(encoding="utf-8")
    source = (folder / f"{name}.c").read_text(encoding="utf-8")
    upper = name.upper()
    found = re.findall(
        r"_update_(\w+)\(\w+ \*filter(?:(?!^}).)*?is_usable\(data, (\d+), (\d+)\)"
        r"(?: \|\| (!is_noise_usable))?",
        source,
        re.DOTALL | re.MULTILINE,
    )
    measured = [int(each[1]) for each in found]
    sizes = [
        m + int(each[2]) + (m * (m + 1) // 2 if each[3] else 0)
        for m, each in zip(measured, found, strict=True)
    ]
    is_interpolated = "*control," in text
    words = {
        "UPDATES": "".join(
            f"    case {number}: outcome = {name}_update_{each[0]}(&own, data, &{name}_as_tuned, "
            "&innovation); break;\n"
            for number, each in enumerate(found)
        ),
        "MEASURED": ", ".join(map(str, measured)),
        "SIZES": ", ".join(map(str, sizes)),
        "LAST": re.findall(rf"    ({upper}_\w+), /\*[^\n]*\n}} {name}_outcome", text)[0],
        "CARRIED": "factor" if f"{name}_covariance(" in text else "covariance",
        "ARGUMENT": "control, " if is_interpolated else "",
        "SET": "control[k]" if is_interpolated else "own.control[k]",
        "GAP": f" || outcome == {upper}_NOT_DRIVEN" if f"{upper}_NOT_DRIVEN" in text else "",
        "REAL": "float" if "float mean[" in text else "double",
        "UPPER": upper,
        "NAME": name,
    }
    program = _PROGRAM
    for word, value in words.items():
        program = re.sub(rf"\b{word}(?=_|\b)|(?<=INPUT){word}", lambda _, value=value: value, program)
    written = folder / "hostile.c"
    written.write_text(program, encoding="utf-8")
    options = [*STRICT, "-Wno-float-equal", *(SANITIZERS if sanitized else ())]
    out = folder / "hostile"
    subprocess.run([compiler, *options, written, folder / f"{name}.c", "-lm", "-o", out], check=True)
    said = subprocess.run([out], capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stdout[-3000:] + said.stderr[-3000:]
    assert not said.stderr, said.stderr
    return int(said.stdout.split()[0])
