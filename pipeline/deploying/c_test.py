"""Makes a recorded log a test of a filter in C: what it is handed, and what ours makes of it."""

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np

from pipeline.deploying.c_source.braces import braced
from pipeline.deploying.c_source.names import CFilter, filled
from recorders.errors import BadInput
from replay.engine.arrays import Floats, Integers
from replay.engine.replaying.estimator import Recursive
from replay.engine.replaying.replaying import replay
from replay.engine.streams.sources import LogSource
from replay.inference.kalman.update import message_layout
from replay.inference.run.filtering import Filter
from replay.inference.run.recursion import CONTROL

MOST_EVENTS = 400


class Vectors(NamedTuple):
    """Holds a log as a filter takes it, and the estimates that it gives.

    Attributes:
        start_ns, mean, covariance: the prior.
        time_ns, source, data: of the events (n,), (n,), (n, width).
        means, covariances: after the events that are `judged` (n,).
    """

    start_ns: int
    mean: Floats
    covariance: Floats
    time_ns: Integers
    source: Integers
    data: Floats
    judged: Integers
    means: Floats
    covariances: Floats


def vectors_of(source: LogSource, bound: Recursive, filtering: Filter) -> Vectors:
    """Replay a log, and keep what the filter was handed and gave.

    Raises BadInput where the log has no prior for it.
    """
    handed: list[Any] = []
    given: list[Any] = []
    begun: list[Any] = []

    class Listening(Filter):
        """Filters, and keeps what it is handed and what it gives."""

        def filtered(self, state: Any, events: Any) -> Any:
            found = super().filtered(state, events)
            handed.append(events)
            given.append(found[1][0])
            return found

    def start(static: Any) -> Any:
        state = bound.start(static)
        begun.append(state.carried)
        return state

    listening = Listening(*(getattr(filtering, each.name) for each in fields(Filter)))
    heard = replace(bound, start=start, run=listening.run, finish=listening.finish)
    for _ in replay([source], [heard]):
        pass
    if not begun:
        raise BadInput(
            f"{source.name}: has nothing that the filter starts from; give a log with a prior"
        )
    time_ns, sources, data = (
        np.concatenate([getattr(each, name) for each in handed])
        for name in ("time_ns", "source", "data")
    )
    stamps = np.concatenate([each.time_ns for each in given])
    chosen = slice(0, MOST_EVENTS)
    last = np.append(np.diff(time_ns) > 0, True)
    rows = np.searchsorted(stamps, time_ns).clip(max=max(len(stamps) - 1, 0))
    is_there = last & (stamps[rows] == time_ns)
    first = begun[0]
    covariance = first.belief.covariance[0].copy()
    filtering.form.to_covariance(covariance)
    return Vectors(
        int(first.time_ns[0]),
        first.belief.mean[0],
        covariance,
        time_ns[chosen],
        sources[chosen],
        data[chosen],
        np.where(is_there, rows, -1)[chosen],
        np.concatenate([each.mean for each in given]),
        np.concatenate([each.covariance for each in given]),
    )


def vectors_text(made: CFilter, vectors: Vectors) -> str:
    """Write vectors.h."""
    upper, width = made.name.upper(), vectors.data.shape[1]
    count, n, t = len(vectors.time_ns), made.states, made.tangent
    rows = [row for row in vectors.judged if row >= 0]
    place = {row: index for index, row in enumerate(rows)}
    judged = [place.get(row, -1) for row in vectors.judged]
    lines = [
        "/* A recorded log as the filter takes it, and what fuselog's own filter made of it. */",
        f"#define VECTORS_EVENTS {count}",
        f"#define VECTORS_WIDTH {width}\n",
        f"static const int64_t start_ns = {vectors.start_ns};",
        *_array(made, "prior_mean", vectors.mean, f"[{n}]"),
        *_array(made, "prior_covariance", vectors.covariance.ravel(), f"[{t * t}]"),
        *_whole("int64_t", "event_time_ns", vectors.time_ns),
        *_whole("int", "event_source", vectors.source),
        *_whole("int", "event_estimate", judged),
        *_array(made, "event_data", vectors.data, "[][VECTORS_WIDTH]"),
        *_array(made, "expected_mean", vectors.means[rows], f"[][{upper}_STATES]"),
        *_array(
            made,
            "expected_covariance",
            vectors.covariances[rows].reshape(-1, t * t),
            f"[][{upper}_TANGENT * {upper}_TANGENT]",
        ),
    ]
    return "\n".join(lines) + "\n"


def _array(made: CFilter, name: str, values: Floats, sizes: str) -> Iterator[str]:
    kind = "double" if name.startswith("expected") else made.precision.real
    number = made.precision._replace(ending="").number if kind == "double" else made.precision.number
    yield f"static const {kind} {name}{sizes} = {{"
    for row in np.atleast_2d(values):
        text = ", ".join(number(float(each)) for each in row)
        yield f"    {text}," if values.ndim == 1 else f"    {{{text}}},"
    yield "};"


def _whole(kind: str, name: str, values: Sequence[Any] | Integers) -> Iterator[str]:
    yield f"static const {kind} {name}[] = {{"
    for first in range(0, len(values), 8):
        yield "    " + ", ".join(str(int(each)) for each in values[first : first + 8]) + ","
    yield "};"


def test_text(made: CFilter) -> str:
    """Write test_NAME.c."""
    control = len(made.controls)
    cases = []
    for number, (name, sensor) in enumerate(made.sensors):
        width = message_layout(sensor).width
        cases.append(
            f"        case {number}: /* {sensor.topic}, {width} numbers */\n"
            f"            outcome = NAME_update_{name}(&filter, data, &NAME_as_tuned, &innovation);\n"
            "            break;\n"
        )
    if made.is_interpolated:
        driving = f"data + VECTORS_WIDTH - {control}"
        predict = f"NAME_predict(&filter, event_time_ns[event], {driving}, &NAME_as_tuned)"
        cases.append("        default:\n            break;\n")
    else:
        predict = "NAME_predict(&filter, event_time_ns[event], &NAME_as_tuned)"
        cases.append(
            f"        case {CONTROL}: /* what drives it */\n"
            "            for (int k = 0; k < NAME_CONTROLS; k++)\n"
            f"                if (!isnan(data[CONTROL_AT + k]))\n"
            "                    filter.control[k] = data[CONTROL_AT + k];\n"
            "            break;\n        default:\n            break;\n"
            if control
            else "        default:\n            break;\n"
        )
    gap = "        if (outcome == NAME_NOT_DRIVEN)\n            continue;\n" if made.has_gaps else ""
    factor = "            double own[NAME_TANGENT][NAME_TANGENT];\n"
    kept = "                    own[row][column] = (double)filter.covariance[row][column];\n"
    definite = "is_definite(own)"
    if made.is_root:  # whose covariance is a square: it is definite where the factor has all its pivots
        factor = (
            "            REAL covariance[NAME_TANGENT][NAME_TANGENT];\n"
            "            int has_pivots = 1;\n"
            "            NAME_covariance(&filter, covariance);\n"
            "            for (int i = 0; i < NAME_TANGENT; i++)\n"
            "                has_pivots = has_pivots && filter.factor[i][i] > 0.0_S;\n"
        )
        kept, definite = "", "has_pivots"
    text = filled(
        made,
        """/* Runs the filter over a recorded log; prints where it is furthest from fuselog's own, in
 * units of the number itself, or of one where that is larger. Returns 0 where that is within the first
 * argument, which is 0 unless given. */
#include "NAME.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "vectors.h"

enum { CONTROL_AT = 0 }; /* of an event's numbers */

#ifdef INSTRUCTIONS /* the name of a function of the target that counts them */
unsigned long INSTRUCTIONS(void);
#else
#define INSTRUCTIONS() 0UL
#endif

static double furthest = 0.0;
static int furthest_event = -1, lost_event = -1;

static void compare(int event, REAL found, double expected)
{
    const double size = fabs(expected) > 1.0 ? fabs(expected) : 1.0;
    const double away = fabs((double)found - expected) / size;
    if (away > furthest || isnan(away)) {
        furthest = isnan(away) ? (double)INFINITY : away;
        furthest_event = event;
    }
}

/* Whether a covariance, which is used up, is positive definite: whether it has a Cholesky factor. */
static int is_definite(double A[NAME_TANGENT][NAME_TANGENT])
{
    for (int column = 0; column < NAME_TANGENT; column++)
        for (int row = column; row < NAME_TANGENT; row++) {
            for (int k = 0; k < column; k++)
                A[row][column] -= A[row][k] * A[column][k];
            if (row > column)
                A[row][column] /= A[column][column];
            else if (!(A[row][row] > 0.0))
                return 0;
            else
                A[row][row] = sqrt(A[row][row]);
        }
    return 1;
}

/* Says from when on the covariance, which fuselog's own filter has, is none any more. */
static int lost(int event)
{
    printf("event %d, after %.3f s: the covariance is no longer positive definite\\n", event,
           (double)(event_time_ns[event] - start_ns) * 1e-9);
    return 1;
}

int main(int argc, char **argv)
{
    const double limit = argc > 1 ? strtod(argv[1], NULL) : 0.0;
    NAME filter;
    NAME_innovation innovation;
    int estimates = 0, updates = 0, messages = 0;
    unsigned long taken = 0, most = 0;
    if (NAME_init(&filter, start_ns, prior_mean, prior_covariance) != NAME_WELL)
        return lost(0);
    for (int event = 0; event < VECTORS_EVENTS; event++) {
        const REAL *data = event_data[event];
        NAME_outcome outcome;
        if (event_time_ns[event] < filter.time_ns)
            continue;
        const unsigned long begin = INSTRUCTIONS();
        outcome = PREDICT;
GAP        if (outcome != NAME_WELL)
            return lost(event);
        switch (event_source[event]) {
CASES        }
        const unsigned long step = INSTRUCTIONS() - begin;
        taken += step;
        most = step > most ? step : most;
        messages++;
        updates += event_source[event] >= 0;
        if (outcome == NAME_NOT_POSITIVE_DEFINITE || outcome == NAME_NOT_FINITE)
            return lost(event);
        if (event_estimate[event] >= 0) {
            estimates++;
            for (int i = 0; i < NAME_STATES; i++)
                compare(event, filter.mean[i], expected_mean[event_estimate[event]][i]);
            double fuselogs[NAME_TANGENT][NAME_TANGENT];
COVARIANCE            for (int row = 0; row < NAME_TANGENT; row++)
                for (int column = 0; column < NAME_TANGENT; column++) {
KEPT                    fuselogs[row][column] =
                        expected_covariance[event_estimate[event]][row * NAME_TANGENT + column];
                    compare(event, ENTRY[row][column], fuselogs[row][column]);
                }
            if (lost_event < 0 && is_definite(fuselogs) && !WHETHER)
                lost_event = event;
        }
    }
    (void)innovation;
    printf("%d updates, %d estimates: furthest %.3g, at event %d\\n", updates, estimates, furthest,
           furthest_event);
    if (lost_event >= 0)
        lost(lost_event);
    if (messages > 0 && most > 0)
        printf("%lu instructions for a message, at most %lu\\n", taken / (unsigned long)messages, most);
    return furthest <= limit && lost_event < 0 ? 0 : 1;
}
""".replace("GAP", gap)
        .replace("COVARIANCE", factor)
        .replace("KEPT", kept)
        .replace("WHETHER", definite)
        .replace("ENTRY", "covariance" if made.is_root else "filter.covariance")
        .replace("PREDICT", predict)
        .replace("CASES", "".join(cases)),
    )
    return braced(text)
