/* fuselog_filter.h: your filter in fuselog's replay. Version 1; C99, for C++, Rust and Ada as well.
 *
 * A shared library that has these functions is an estimator: fuselog replay run.mcap -e lib:./libmine.so
 * What each has to do stands beside it; docs/your-filter.md leads through an example.
 *
 * Keep all that a filter knows behind the pointer that `create` gives: several filters live at once, each
 * used by one thread at a time. Times are in nanoseconds. Matrices are row-major. The covariance is in the
 * tangent space, that is of as many rows as the state has components, but three for a quaternion's four.
 */
#ifndef FUSELOG_FILTER_H
#define FUSELOG_FILTER_H

#include <stdint.h>

#define FUSELOG_FILTER_VERSION 1

/* What functions return. A number from 1 on is a failure: it counts in `failures` of the description, and
 * ends the run with that sentence. A number below zero that is not one of these ends it, too. */
#define FUSELOG_FILTER_WELL 0
#define FUSELOG_FILTER_NOTHING (-1)  /* there is none now: no estimate, no innovation */
#define FUSELOG_FILTER_REJECTED (-2) /* of an innovation: a gate kept the measurement out */

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

/* Returns FUSELOG_FILTER_VERSION, as the library was compiled with. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_version(void);

/* Returns JSON, in UTF-8, that stays where it is: the topics and fields that the filter reads, the
 * components of its state, its parameters. */
FUSELOG_FILTER_EXPORT const char *fuselog_filter_describe(void);

/* Makes a filter; NULL where that fails. `parameters` are in the order of the description; `seed` is for
 * random numbers. */
FUSELOG_FILTER_EXPORT void *fuselog_filter_create(const double *parameters, uint64_t seed);

/* Starts from a prior; both pointers are NULL where the log has none: then the time is that of the first
 * message. The messages of static topics, such as a map, were taken before. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_start(void *filter, int64_t time_ns, const double *mean,
                                                   const double *covariance);

/* Takes one message: of which topic, in the description's order from 0 on, when it was measured, and its
 * fields in the description's order. Times never go back; several messages may have one time. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_take(void *filter, int32_t topic, int64_t time_ns,
                                                  const double *fields);

/* Predicts to a time at which nothing was measured. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_predict(void *filter, int64_t time_ns);

/* Gives the state and its covariance. It is asked for after the last message of every time. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_state(const void *filter, double *mean, double *covariance);

/* Optional. Gives the innovation, measured minus predicted, of the message that was taken last, and its
 * covariance before the update: all components of the description; NaN in the former where that message
 * did not measure one. */
FUSELOG_FILTER_EXPORT int32_t fuselog_filter_innovation(const void *filter, double *innovation,
                                                        double *covariance);

/* Makes another filter that knows the same; NULL where that fails. */
FUSELOG_FILTER_EXPORT void *fuselog_filter_copy(const void *filter);

/* Ends a filter. */
FUSELOG_FILTER_EXPORT void fuselog_filter_destroy(void *filter);

#ifdef __cplusplus
}
#endif
#endif
