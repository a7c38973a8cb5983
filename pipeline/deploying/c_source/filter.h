/* ${made.origin}
 * Made by fuselog deploy; graphs and numbers ${made.digest}. Licence: Apache-2.0, or yours.
 *
 * No heap, no recursion, no arrays of varying length. Times are in nanoseconds. The
 * covariance is in the tangent space, which has three components for a quaternion. */
#ifndef NAME_H
#define NAME_H

#include <stdint.h>

#define NAME_DIGEST "${made.digest}"

/*% set upper = made.name | upper %*/
/*% for part, names, count in enums %*/
enum {
/*% for name in names %*/
    ${upper}_${part}${name | upper},
/*% endfor %*/
    ${upper}_${count}
};

/*% endfor %*/
enum { NAME_MOST = ${made.most} }; /* components of the widest sensor */
typedef enum {
/*% for outcome, meaning in outcomes.items() %*/
    ${upper}_${outcome}, /* ${meaning} */
/*% endfor %*/
} NAME_outcome;

/* A measurement with a larger NIS than nis[its components] is not used, unless the last
 * used one is more than reopens_s ago; the other options reduce the weight of used ones. NAN: off. */
typedef struct {
    REAL nis[NAME_MOST + 1];
    double reopens_s;
    REAL inflate_nis, student_freedom, switch_nis;
} NAME_gate;

typedef struct {
/*% for part, values in parameters.items() %*/
    struct {
/*% for name, comment in values.items() %*/
        REAL ${name};${" /* " ~ comment ~ " */" if comment else ""}
/*% endfor %*/
/*% if part != "motion" %*/
        NAME_gate gate;
/*% elif not values %*/
        char unused; /* it has no parameters */
/*% endif %*/
    } ${part};
/*% endfor %*/
} NAME_parameters;

extern const NAME_parameters NAME_as_tuned;

typedef struct {
    int64_t time_ns;
    REAL mean[NAME_STATES];
    REAL ${made.carried}[NAME_TANGENT][NAME_TANGENT];
    REAL control[NAME_CONTROLS + 1];
    int64_t accepted_ns[NAME_SENSORS + 1]; /* when a measurement was last used */
/*% if made.has_gaps %*/
    int is_in_gap; /* whether the control is silent */
/*% endif %*/
} NAME;

/* Measured minus predicted, and its covariance before the update; NAN if a component is missing. */
typedef struct {
    REAL difference[NAME_INNOVATION];
    REAL covariance[NAME_INNOVATION][NAME_INNOVATION];
    REAL nis;
    int is_accepted; /* 1 if the measurement changed the state; only together with NAME_WELL */
} NAME_innovation;

/* Starts at a prior, without a control. An invalid prior leaves a state that is not finite. */
NAME_outcome NAME_init(NAME *filter, int64_t time_ns, const REAL *mean,
    const REAL *covariance);

/*% if made.is_root %*/
/* The covariance L L' from the lower factor L that the filter carries. */
void NAME_covariance(const NAME *filter, REAL covariance[NAME_TANGENT][NAME_TANGENT]);
/*% endif %*/

/*% if not made.is_interpolated %*/
/* Predicts to a time${"; filter->control holds until you change it" if made.controls else ""}. */
/*% elif not made.has_gaps %*/
/* Predicts to a time with the mean of the last control and the control at that time. */
/*% else %*/
/* Predicts to a time with the mean of the last control and the control at that time.
 * Pass NAN while ${control.topic} is silent for longer than ${control.gap},
 * ${silent_s} s, up to its first message then: NAME_NOT_DRIVEN says that the
/*% if made.steps.gap is not none %*/
 * estimate is unknown, messages must not be used, and the next prediction with a control covers the whole gap. */
/*% else %*/
 * estimate is unknown, messages must not be used, and the filter has to be started again. */
/*% endif %*/
/*% endif %*/
NAME_outcome NAME_predict(NAME *filter, int64_t time_ns${", const REAL *control" if made.is_interpolated else ""},
    const NAME_parameters *parameters);

/*% for name, sensor in made.sensors %*/
/* Updates by ${sensor.topic}, at the filter's time: data is ${data_of(sensor) | join(", ")}. */
NAME_outcome NAME_update_${name}(NAME *filter, const REAL *data,
    const NAME_parameters *parameters, NAME_innovation *innovation);

/*% endfor %*/
#endif /* NAME_H */
