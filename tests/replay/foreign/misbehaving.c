/* A filter of one number that does what its messages say: a range below zero is a command. */
#define _DEFAULT_SOURCE
#include "fuselog_filter.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#ifndef VERSION
#define VERSION FUSELOG_FILTER_VERSION
#endif
#ifndef TOPIC
#define TOPIC "/range"
#endif
#ifndef DESCRIPTION
#define DESCRIPTION                                                                                      \
    "{\"summary\": \"does as it is told\", \"topics\": [{\"topic\": \"" TOPIC "\","                     \
    "  \"fields\": [\"range_m\"]}], \"state\": {\"range_m\": \"linear\"},"                              \
    " \"innovation\": {\"range_m\": \"linear\"}, \"parameters\": {\"sigma_m\": {\"default\": 1,"         \
    "  \"exclusiveMinimum\": 0, \"maximum\": 10}}, \"failures\": [\"it was told to fail\"]}"
#endif

enum { UNDEFINED = -9, LEAVE, FAIL, NEGATIVE, NOT_A_NUMBER, PRINT, LEAK, LOOP, CRASH };

typedef struct {
    double mean, variance, innovation, spread;
} Filter;

int32_t fuselog_filter_version(void) { return VERSION; }
const char *fuselog_filter_describe(void) { return DESCRIPTION; }

void *fuselog_filter_create(const double *parameters, uint64_t seed)
{
    Filter *filter = calloc(1, sizeof *filter);
    (void)seed;
    filter->spread = parameters[0] * parameters[0];
    return filter;
}

void fuselog_filter_destroy(void *filter) { free(filter); }

void *fuselog_filter_copy(const void *filter)
{
    return memcpy(malloc(sizeof(Filter)), filter, sizeof(Filter));
}

int32_t fuselog_filter_start(void *filter, int64_t time_ns, const double *mean, const double *covariance)
{
    (void)time_ns, (void)mean, (void)covariance;
    ((Filter *)filter)->variance = 1e6;
    return FUSELOG_FILTER_WELL;
}

#ifndef WITHOUT_TAKE
int32_t fuselog_filter_take(void *filter, int32_t topic, int64_t time_ns, const double *fields)
{
    Filter *own = filter;
    (void)topic, (void)time_ns;
    switch ((int)fields[0]) {
    case CRASH:
        *(volatile int *)0 = 1;
        break;
    case LOOP:
        for (;;)
            usleep(1000);
    case LEAK:
        for (;;)
            memset(malloc(1 << 20), 1, 1 << 20);
    case PRINT:
        printf("{\"failure\": null}\n%0100000d\n", 1);
        fflush(stdout);
        break;
    case NOT_A_NUMBER:
        own->mean = NAN;
        return FUSELOG_FILTER_WELL;
    case NEGATIVE:
        own->variance = -1.0;
        return FUSELOG_FILTER_WELL;
    case FAIL:
        return 1;
    case UNDEFINED:
        return -22; /* as -EINVAL */
    case LEAVE:
        exit(3);
    }
    double total = own->variance + own->spread, gain = own->variance / total;
    own->innovation = fields[0] - own->mean;
    own->mean += gain * own->innovation;
    own->variance -= gain * own->variance;
    return FUSELOG_FILTER_WELL;
}
#endif

int32_t fuselog_filter_predict(void *filter, int64_t time_ns)
{
    (void)time_ns;
    ((Filter *)filter)->variance += 0.01;
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_state(const void *filter, double *mean, double *covariance)
{
    const Filter *own = filter;
    *mean = own->mean;
    *covariance = own->variance;
    return FUSELOG_FILTER_WELL;
}
