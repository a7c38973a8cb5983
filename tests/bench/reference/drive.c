/* Calls a filter of fuselog_filter.h as fuselog's own loop does, for what the filter itself takes. */
#include "fuselog_filter.h"

int32_t drive(void *filter, int64_t count, const int64_t *time_ns, const double *fields, int64_t width,
              double *mean, double *covariance, double *innovation, double *spread)
{
    int32_t status = 0;
    for (int64_t row = 0; row < count; row++) {
        status |= fuselog_filter_take(filter, 0, time_ns[row], fields + width * row);
        status |= fuselog_filter_innovation(filter, innovation + 2 * row, spread + 4 * row);
        status |= fuselog_filter_state(filter, mean + 2 * row, covariance + 4 * row);
    }
    return status;
}
