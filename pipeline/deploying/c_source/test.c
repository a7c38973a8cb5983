/* Runs the filter over a recorded log; prints the largest difference from fuselog's own,
 * relative to the number itself or, if larger, to one, and what was accepted and rejected.
 * Returns 0 if the difference is within the first argument (default 0), and there are estimates and
 * accepted measurements. */
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

/*% if made.sensors %*/
static const char *const sensors[] = {"${made.sensors | map("first") | join('", "')}"};
static const int gated[] = {${gates | join(", ")}};
static int accepted[NAME_SENSORS], rejected[NAME_SENSORS];

/*% endif %*/
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

/* Prints when the covariance stops being positive definite, unlike that of fuselog's filter. */
static int lost(int event)
{
    printf("event %d, after %.3f s: the covariance is no longer positive definite\n", event,
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
        outcome = NAME_predict(&filter, event_time_ns[event]${", data + VECTORS_WIDTH - " ~ made.controls | length if made.is_interpolated else ""}, &NAME_as_tuned);
/*% if made.has_gaps %*/
        if (outcome == NAME_NOT_DRIVEN)
            continue;
/*% endif %*/
        if (outcome != NAME_WELL)
            return lost(event);
        switch (event_source[event]) {
/*% for name, sensor in made.sensors %*/
        case ${loop.index0}: /* ${sensor.topic}, ${layout(sensor).width} numbers */
            outcome = NAME_update_${name}(&filter, data, &NAME_as_tuned, &innovation);
            break;
/*% endfor %*/
/*% if made.controls and not made.is_interpolated %*/
        case ${control}: /* the control */
            for (int k = 0; k < NAME_CONTROLS; k++)
                if (!isnan(data[CONTROL_AT + k]))
                    filter.control[k] = data[CONTROL_AT + k];
            break;
/*% endif %*/
        default:
            break;
        }
        const unsigned long step = INSTRUCTIONS() - begin;
        taken += step;
        most = step > most ? step : most;
        messages++;
        updates += event_source[event] >= 0;
/*% if made.sensors %*/
        if (event_accepted[event] >= 0) {
            int *const count = innovation.is_accepted ? accepted : rejected;
            count[event_source[event]]++;
/*% if not made.precision.ending %*/
            compare(event, innovation.nis, event_nis[event]);
/*% endif %*/
            if (outcome != NAME_WELL || innovation.is_accepted != event_accepted[event])
                compare(event, (REAL)NAN, 0.0);
        }
/*% endif %*/
        if (outcome == NAME_NOT_POSITIVE_DEFINITE || outcome == NAME_NOT_FINITE)
            return lost(event);
        if (event_estimate[event] >= 0) {
            estimates++;
            for (int i = 0; i < NAME_STATES; i++)
                compare(event, filter.mean[i], expected_mean[event_estimate[event]][i]);
            double fuselogs[NAME_TANGENT][NAME_TANGENT];
/*% if made.is_root %*/
            /*# the covariance is L L', so it is positive definite if all pivots of the factor are positive #*/
            REAL covariance[NAME_TANGENT][NAME_TANGENT];
            int has_pivots = 1;
            NAME_covariance(&filter, covariance);
            for (int i = 0; i < NAME_TANGENT; i++)
                has_pivots = has_pivots && filter.factor[i][i] > 0.0_S;
/*% else %*/
            double own[NAME_TANGENT][NAME_TANGENT];
/*% endif %*/
            for (int row = 0; row < NAME_TANGENT; row++)
                for (int column = 0; column < NAME_TANGENT; column++) {
/*% if not made.is_root %*/
                    own[row][column] = (double)filter.covariance[row][column];
/*% endif %*/
                    fuselogs[row][column] =
                        expected_covariance[event_estimate[event]][row * NAME_TANGENT + column];
                    compare(event, ${"covariance" if made.is_root else "filter.covariance"}[row][column], fuselogs[row][column]);
                }
            if (lost_event < 0 && is_definite(fuselogs) && !${"has_pivots" if made.is_root else "is_definite(own)"})
                lost_event = event;
        }
    }
    (void)innovation;
    printf("%d updates, %d estimates: furthest %.3g, at event %d\n", updates, estimates, furthest,
           furthest_event);
    if (lost_event >= 0)
        lost(lost_event);
    if (messages > 0 && most > 0)
        printf("%lu instructions for a message, at most %lu\n", taken / (unsigned long)messages, most);
/*% if made.sensors %*/
    int shown = 0;
    for (int sensor = 0; sensor < NAME_SENSORS; sensor++) {
        printf("%s: %d accepted, %d rejected%s\n", sensors[sensor], accepted[sensor], rejected[sensor],
               accepted[sensor] == 0                     ? ": the log does not test it"
               : gated[sensor] && rejected[sensor] == 0 ? ": the log does not test its gate"
                                                         : "");
        shown += accepted[sensor];
    }
/*% else %*/
    const int shown = 1;
/*% endif %*/
    return furthest <= limit && lost_event < 0 && estimates > 0 && shown > 0 ? 0 : 1;
}
