/* fuselog replays the filter with this: see docs/your-filter.md, fuselog_filter.h. */
#include "fuselog_filter.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "NAME.h"

${"enum { MOST_POINTS = 4096 };" if maps else ""}
enum { NEEDS_PRIOR = 1, LOST, NO_ROOM, BAD_PRIOR };

typedef struct {
    NAME filter;
    NAME_parameters parameters;
    NAME_innovation innovation;
    int32_t outcome; /* of the last message */
/*% for map in maps %*/
    double point${loop.index0}[MOST_POINTS][${1 + map.size}];
    int points${loop.index0};
/*% endfor %*/
} Own;

/* Converts numbers of the interface to those of the filter. */
static void take(REAL *to, const double *from, int count)
{
    for (int i = 0; i < count; i++)
        to[i] = (REAL)from[i];
}

/* Converts them back. */
static void give(double *to, const REAL *from, int count)
{
    for (int i = 0; i < count; i++)
        to[i] = (double)from[i];
}

int32_t fuselog_filter_version(void) { return FUSELOG_FILTER_VERSION; }

const char *fuselog_filter_describe(void)
{
    return
DESCRIPTION;
}

void *fuselog_filter_create(const double *parameters, uint64_t seed)
{
    Own *own = calloc(1, sizeof *own);
    (void)seed;
    (void)parameters;
    if (own == NULL)
        return NULL;
    own->parameters = NAME_as_tuned;
/*% for place in places %*/
    own->parameters.${place[1]} = (REAL)parameters[${place[0]}];
/*% endfor %*/
    return own;
}

void fuselog_filter_destroy(void *filter) { free(filter); }

void *fuselog_filter_copy(const void *filter)
{
    Own *copy = malloc(sizeof *copy);
    return copy != NULL ? memcpy(copy, filter, sizeof *copy) : NULL;
}

int32_t fuselog_filter_start(void *filter, int64_t time_ns, const double *mean, const double *covariance)
{
    Own *own = filter;
    REAL state[NAME_STATES], spread[NAME_TANGENT * NAME_TANGENT];
    if (mean == NULL)
        return NEEDS_PRIOR;
    take(state, mean, NAME_STATES);
    take(spread, covariance, NAME_TANGENT * NAME_TANGENT);
    return NAME_init(&own->filter, time_ns, state, spread) == NAME_WELL ? FUSELOG_FILTER_WELL
                                                                          : BAD_PRIOR;
}

int32_t fuselog_filter_predict(void *filter, int64_t time_ns)
{
    Own *own = filter;
    const NAME_outcome outcome = NAME_predict(&own->filter, time_ns, &own->parameters);
    return outcome == NAME_WELL || outcome == NAME_BACKWARD ? FUSELOG_FILTER_WELL : LOST;
}

static int32_t told(Own *own, NAME_outcome outcome)
{
    if (outcome == NAME_NOT_POSITIVE_DEFINITE || outcome == NAME_NOT_FINITE)
        return LOST;
    if (outcome == NAME_WELL)
        own->outcome = own->innovation.is_accepted ? FUSELOG_FILTER_WELL : FUSELOG_FILTER_REJECTED;
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_take(void *filter, int32_t topic, int64_t time_ns, const double *fields)
{
    Own *own = filter;
    own->outcome = FUSELOG_FILTER_NOTHING;
/*% for map in maps %*/
    if (topic == ${loop.index0}) { /* ${map.topic}, before the start */
        if (own->points${loop.index0} == MOST_POINTS)
            return NO_ROOM;
        memcpy(own->point${loop.index0}[own->points${loop.index0}++], fields,
               ${1 + map.size} * sizeof *fields);
        return FUSELOG_FILTER_WELL;
    }
/*% endfor %*/
    if (fuselog_filter_predict(filter, time_ns) != FUSELOG_FILTER_WELL)
        return LOST;
/*% if made.controls %*/
    if (topic == ${maps | length}) { /* the control */
        for (int k = 0; k < NAME_CONTROLS; k++)
            if (!isnan(fields[k]))
                own->filter.control[k] = (REAL)fields[k];
        return FUSELOG_FILTER_WELL;
    }
/*% endif %*/
/*% for topic, sensor_topic, lines in updates %*/
    if (topic == ${topic}) { /* ${sensor_topic} */
${lines}    }
/*% endfor %*/
    return FUSELOG_FILTER_WELL;
}

/*% if angles %*/
/* The equal angle in [-pi, pi). */
static double wrapped(double angle)
{
    const double pi = 3.141592653589793;
    double turned;
    if (fabs(angle) < pi)
        return angle;
    turned = fmod(angle + pi, 2.0 * pi);
    return (turned < 0.0 ? turned + 2.0 * pi : turned) - pi;
}

/*% endif %*/
int32_t fuselog_filter_state(const void *filter, double *mean, double *covariance)
{
    const Own *own = filter;
/*% if made.is_root %*/
    REAL spread[NAME_TANGENT][NAME_TANGENT];
    NAME_covariance(&own->filter, spread);
    give(covariance, &spread[0][0], NAME_TANGENT * NAME_TANGENT);
/*% else %*/
    give(covariance, &own->filter.covariance[0][0], NAME_TANGENT * NAME_TANGENT);
/*% endif %*/
    give(mean, own->filter.mean, NAME_STATES);
/*% for index in angles %*/
    mean[${index}] = wrapped(mean[${index}]);
/*% endfor %*/
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_innovation(const void *filter, double *innovation, double *covariance)
{
    const Own *own = filter;
    if (own->outcome == FUSELOG_FILTER_NOTHING)
        return FUSELOG_FILTER_NOTHING;
    give(innovation, own->innovation.difference, NAME_INNOVATION);
    give(covariance, &own->innovation.covariance[0][0], NAME_INNOVATION * NAME_INNOVATION);
    return own->outcome;
}
