/* ${made.origin} Made by fuselog deploy; see NAME.h.
 * Compile it with -ffp-contract=off to have fuselog's bits. */
#include "NAME.h"

#include <math.h>
#include <string.h>

enum { T = NAME_TANGENT, M = NAME_MOST };

${as_tuned}
/*% for text in helpers %*/
${text}
/*% endfor %*/
/*% if made.precision.ending %*/
/* Whether numbers are finite: then sum - sum is 0, and otherwise NaN. */
static int is_finite(const float *numbers, int count)
{
    float sum = 0.0f;
    for (int i = 0; i < count; i++)
        sum += numbers[i];
    return !isnan(sum - sum);
}
/*% else %*/
/*# a small processor tests the bits of a `double` faster than it adds; `float` it adds in hardware #*/
/* Whether numbers are finite: no exponent has all of its bits set. */
static int is_finite(const double *numbers, int count)
{
    const uint64_t exponent = 0x7FF0000000000000U;
    for (int i = 0; i < count; i++) {
        uint64_t bits;
        memcpy(&bits, &numbers[i], sizeof bits);
        if ((bits & exponent) == exponent)
            return 0;
    }
    return 1;
}
/*% endif %*/

/* NAME_WELL if the state is finite. */
static NAME_outcome checked(const NAME *filter)
{
    return is_finite(filter->mean, NAME_STATES) && is_finite(&filter->${made.carried}[0][0], T * T)
               ? NAME_WELL
               : NAME_NOT_FINITE;
}

/* The time from a stamp to a later or equal one. */
static double seconds(int64_t from_ns, int64_t to_ns)
{
    return (double)((uint64_t)to_ns - (uint64_t)from_ns) * 1e-9;
}

/*% include "factor.c" if made.is_root else "covariance.c" %*/

/*% if gains %*/
enum { GAINS = ${gains} }; /* numbers of noise that enter, at most */

/*% endif %*/
/*% for what, size in gained %*/
/* A = A + G diag(u) G'. */
static void add_through_${what}(REAL A[${size}][${size}], int size, const REAL G[${size}][GAINS], const REAL *u,
                             int gains)
{
    for (int row = 0; row < size; row++)
        for (int column = 0; column <= row; column++) {
            REAL entry = A[row][column];
            for (int k = 0; k < gains; k++)
                entry += G[row][k] * u[k] * G[column][k];
            A[row][column] = A[column][row] = entry;
        }
}

/*% endfor %*/
/*% if made.steps.direction is not none %*/
/* P a / (a' P a): how the state changes along a, in which it is curved. */
static void find_slope(const REAL P[T][T], const REAL a[T], REAL slope[T])
{
    REAL variance = 0.0_S;
    for (int row = 0; row < T; row++)
        slope[row] = 0.0_S;
/*% if made.is_root %*/
    for (int k = 0; k < T; k++) { /* P P' a, of the factor P */
        REAL entry = 0.0_S;
        for (int row = k; row < T; row++)
            entry += P[row][k] * a[row];
        for (int row = k; row < T; row++)
            slope[row] += P[row][k] * entry;
    }
/*% else %*/
    for (int row = 0; row < T; row++)
        for (int column = 0; column < T; column++)
            slope[row] += P[row][column] * a[column];
/*% endif %*/
    for (int row = 0; row < T; row++)
        variance += a[row] * slope[row];
    for (int row = 0; row < T; row++)
        slope[row] = variance > 0.0_S ? slope[row] / variance : 0.0_S;
}

/*% endif %*/
/*% if turn_factors %*/
/* ${"A factor P = J P" if made.is_root else "P = J P J'"} for the rotation whose axes begin at `at`, with its right Jacobian at the step d,
 * J = I - f [d]x + g [d]x^2: it goes over into the tangent space of the moved orientation. */
static void turn(REAL P[T][T], const REAL step[T], int at)
{
    const REAL x = step[at], y = step[at + 1], z = step[at + 2];
    const REAL squared = x * x + y * y + z * z;
${turn_factors}    for (int side = 0; side < ${1 if made.is_root else 2}; side++)
        for (int column = 0; column < T; column++) {
            REAL *const first = side == 0 ? &P[at][column] : &P[column][at];
            REAL *const second = side == 0 ? &P[at + 1][column] : &P[column][at + 1];
            REAL *const third = side == 0 ? &P[at + 2][column] : &P[column][at + 2];
            const REAL a = *first, b = *second, c = *third;
            const REAL u = y * c - z * b, v = z * a - x * c, w = x * b - y * a;
            *first = a - f * u + g * (y * w - z * v);
            *second = b - f * v + g * (z * u - x * w);
            *third = c - f * w + g * (x * v - y * u);
        }
}

/*% endif %*/
/*% if tables %*/
${tables}
/*% include "samples.c" %*/

/*% endif %*/
NAME_outcome NAME_init(NAME *filter, int64_t time_ns, const REAL *mean,
    const REAL *covariance)
{
    NAME_outcome outcome = NAME_WELL;
    filter->time_ns = time_ns;
/*% if made.is_root %*/
    for (int column = 0; column < T; column++) /* by Cholesky */
        for (int row = 0; row < T; row++) {
            REAL entry = covariance[row * T + column];
            for (int k = 0; k < column; k++)
                entry -= filter->factor[row][k] * filter->factor[column][k];
            if (row < column)
                entry = 0.0_S;
            else if (row > column)
                entry /= filter->factor[column][column];
            else if (entry > 0.0_S)
                entry = sqrt_S(entry);
            else
                outcome = NAME_NOT_POSITIVE_DEFINITE;
            filter->factor[row][column] = entry;
        }
/*% else %*/
    REAL factor[T][T];
    for (int row = 0; row < T; row++)
        for (int column = 0; column < T; column++)
            factor[row][column] = filter->covariance[row][column] = covariance[row * T + column];
    if (!cholesky(&factor[0][0], T, T))
        outcome = NAME_NOT_POSITIVE_DEFINITE;
/*% endif %*/
    if (!is_finite(mean, NAME_STATES) || !is_finite(covariance, T * T))
        outcome = NAME_BAD_INPUT;
    for (int i = 0; i < NAME_STATES; i++)
        filter->mean[i] = outcome == NAME_WELL ? mean[i] : (REAL)NAN;
    for (int sensor = 0; sensor < NAME_SENSORS + 1; sensor++)
        filter->accepted_ns[sensor] = time_ns;
/*% for value in control %*/
    filter->control[${loop.index0}] = ${value};
/*% endfor %*/
/*% if made.is_interpolated and made.has_gaps %*/
    filter->is_in_gap = 0;
/*% endif %*/
    return outcome;
}

/*% include "predict.c" %*/

/*% for text in corrections %*/
${text}
/*% endfor %*/
/*% if made.sensors %*/
/*% include "update.c" %*/

/*% for text in updates %*/
${text}
/*% endfor %*/
/*% endif %*/
