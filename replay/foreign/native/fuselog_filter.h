/* fuselog_filter.h: your filter in fuselog's replay. Version 1; C99, for C++, Rust and Ada as well.
 *
 * A shared library with these functions is an estimator: fuselog replay run.mcap -e lib:./libmine.so
 * Each function is documented below; docs/your-filter.md explains an example.
 *
 * Keep the whole state of a filter behind the pointer that `create` returns: several filters exist at the
 * same time, each used by one thread at a time. Times are in nanoseconds. Matrices are row-major. The
 * covariance is in the tangent space: it has one row for each component of the state, but three rows for
 * the four components of a quaternion.
 */
#ifndef FUSELOG_FILTER_H
#define FUSELOG_FILTER_H

#include <stdint.h>

#define FUSELOG_FILTER_VERSION 1

/* Return values. A positive number is a failure: it is the number, counted from 1, of a sentence in
 * `failures` of the description, and ends the run. Any other negative number also ends the run. */
#define FUSELOG_FILTER_WELL 0
#define FUSELOG_FILTER_NOTHING (-1)  /* there is no estimate or innovation now */
#define FUSELOG_FILTER_REJECTED (-2) /* for an innovation: a gate rejected the measurement */

#if defined(_WIN32)
#define FUSELOG_FILTER_EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define FUSELOG_FILTER_EXPORT __attribute__((visibility("default")))
#else
#define FUSELOG_FILTER_EXPORT
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* Returns the FUSELOG_FILTER_VERSION with which the library was compiled. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_version(void);

/* Returns the description, JSON in UTF-8, whose memory must stay valid: the topics and fields that the
 * filter reads, the components of its state, its parameters. */
FUSELOG_FILTER_EXPORT const char *fuselog_filter_describe(void);

/* Creates a filter; returns NULL on failure. `parameters` are in the order of the description; `seed` is
 * for random numbers. */
FUSELOG_FILTER_EXPORT void *fuselog_filter_create(const double *parameters, uint64_t seed);

/* Starts from a prior. If the log has no prior, both pointers are NULL and the time is that of the first
 * message. The messages of static topics, such as a map, are passed before it. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_start(void *filter, int64_t time_ns, const double *mean,
                                                   const double *covariance);

/* Processes one message: the index of its topic in the description, from 0, the time of measurement,
 * and its fields in the order of the description. Times never go back; several messages may have the same
 * time. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_take(void *filter, int32_t topic, int64_t time_ns,
                                                  const double *fields);

/* Predicts to a time without a measurement. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_predict(void *filter, int64_t time_ns);

/* Writes the state and its covariance. Called after the last message of every time. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_state(const void *filter, double *mean, double *covariance);

/* Optional. Writes the innovation (measured minus predicted) of the message that was processed last, and
 * its covariance before the update, for all components in the description. In the innovation, components
 * that the message did not measure are NaN. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_innovation(const void *filter, double *innovation,
                                                        double *covariance);

/* Makes an independent copy of a filter with the same state; returns NULL on failure. */
FUSELOG_FILTER_EXPORT void *fuselog_filter_copy(const void *filter);

/* Destroys a filter. */
FUSELOG_FILTER_EXPORT void fuselog_filter_destroy(void *filter);

#ifdef __cplusplus
}
#endif
#endif
