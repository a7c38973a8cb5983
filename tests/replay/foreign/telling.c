/* A filter whose estimates are what it was told: its seed, parameters, prior, map and last message.
 *
 * It keeps the prior's covariance, rejects ranges beyond 50 m, says nothing of those beyond 90 m, and fails
 * at those below zero.
 */
#include "fuselog_filter.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { STATE = 9, MARKS, RANGE = 1, BOTH };

typedef struct {
    double mean[STATE], covariance[STATE * STATE], innovation[2];
} Filter;

int32_t fuselog_filter_version(void) { return FUSELOG_FILTER_VERSION; }
const char *fuselog_filter_describe(void) { return DESCRIPTION; }

void *fuselog_filter_create(const double *parameters, uint64_t seed)
{
    Filter *own = calloc(1, sizeof *own);
    own->mean[0] = (double)seed;
    own->mean[1] = parameters[0];
    own->mean[2] = parameters[1];
    return own;
}

void fuselog_filter_destroy(void *filter) { free(filter); }

void *fuselog_filter_copy(const void *filter)
{
    return memcpy(malloc(sizeof(Filter)), filter, sizeof(Filter));
}

int32_t fuselog_filter_start(void *filter, int64_t time_ns, const double *mean, const double *covariance)
{
    Filter *own = filter;
    own->mean[3] = (double)time_ns;
    for (int k = 0; k < STATE; k++)
        own->mean[4] += (k + 1) * mean[k];
    memcpy(own->covariance, covariance, sizeof own->covariance);
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_take(void *filter, int32_t topic, int64_t time_ns, const double *fields)
{
    Filter *own = filter;
    if (topic == 0) {
        own->mean[5] = 10.0 * own->mean[5] + fields[0] + 0.1 * fields[1] + 0.01 * fields[2];
        return FUSELOG_FILTER_WELL;
    }
    if (fields[0] < 0.0)
        return 2;
    own->mean[6] = topic;
    own->mean[7] = (double)time_ns;
    own->mean[8] = topic == RANGE ? fields[0] : fields[0] + 100.0 * fields[1];
    own->innovation[0] = fields[0];
    own->innovation[1] = topic == RANGE ? NAN : fields[1];
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_predict(void *filter, int64_t time_ns)
{
    Filter *own = filter;
    own->mean[6] = -1.0;
    own->mean[7] = (double)time_ns;
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_state(const void *filter, double *mean, double *covariance)
{
    const Filter *own = filter;
    memcpy(mean, own->mean, sizeof own->mean);
    memcpy(covariance, own->covariance, sizeof own->covariance);
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_innovation(const void *filter, double *innovation, double *covariance)
{
    static const double spread[4] = {2.0, 0.5, 0.5, 3.0};
    const Filter *own = filter;
    memcpy(innovation, own->innovation, sizeof own->innovation);
    memcpy(covariance, spread, sizeof spread);
    return own->innovation[0] > 90.0   ? FUSELOG_FILTER_NOTHING
           : own->innovation[0] > 50.0 ? FUSELOG_FILTER_REJECTED
                                       : FUSELOG_FILTER_WELL;
}
