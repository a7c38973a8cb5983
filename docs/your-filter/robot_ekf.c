/* A robot among landmarks: a hand-written extended Kalman filter with the interface of fuselog_filter.h.
 *
 *     cc -std=c99 -O2 -shared -fPIC -I "$(fuselog header)" robot_ekf.c -lm -o robot_ekf.so
 *     fuselog replay run.mcap -e lib:./robot_ekf.so -e ekf
 *
 * The state is x, y in m and the heading in rad; each odometry message is valid until the next. The estimates
 * are those of fuselog's own `ekf` of the model `robot`.
 */
#include "fuselog_filter.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define TAU 6.283185307179586476925
#define MOST_LANDMARKS 1024

enum { LANDMARKS, ODOMETRY, RANGE_BEARING, RANGE, BEARING };
enum { FORWARD_DENSITY, TURN_DENSITY, SIGMA_RANGE, SIGMA_BEARING, BIAS_RANGE, BIAS_BEARING, SCALE,
       TURN_BIAS, GATE, PARAMETERS };

typedef struct {
    double parameters[PARAMETERS];
    double mean[3], covariance[3][3];
    double forward, turn;
    int64_t time_ns;
    int landmarks;
    double number[MOST_LANDMARKS], place[MOST_LANDMARKS][2];
    int measured; /* number of components of the last message */
    int outcome;  /* outcome of its update */
    double innovation[2], spread[2][2];
} Robot;

static const char description[] =
    "{\"summary\": \"a robot's extended Kalman filter, by hand in C\","
    " \"topics\": ["
    "  {\"topic\": \"/landmarks\", \"message\": \"fuselog.Landmark\", \"static\": true,"
    "   \"fields\": [\"landmark_id\", \"position_m[2]\"]},"
    "  {\"topic\": \"odometry\", \"message\": \"fuselog.Odometry\","
    "   \"fields\": [\"forward_mps\", \"turn_radps\"]},"
    "  {\"topic\": \"range_bearing\", \"message\": \"fuselog.RangeBearing\", \"optional\": true,"
    "   \"fields\": [\"target_id\", \"range_m\", \"bearing_rad\"], \"target\": \"target_id\"},"
    "  {\"topic\": \"range\", \"message\": \"fuselog.Range\", \"optional\": true,"
    "   \"fields\": [\"target_id\", \"range_m\"], \"target\": \"target_id\"},"
    "  {\"topic\": \"bearing\", \"message\": \"fuselog.Bearing\", \"optional\": true,"
    "   \"fields\": [\"target_id\", \"bearing_rad\"], \"target\": \"target_id\"}],"
    " \"prior\": \"prior\", \"truth\": \"truth\", \"output\": \"pose\","
    " \"state\": {\"x_m\": \"linear\", \"y_m\": \"linear\", \"heading_rad\": \"angle\"},"
    " \"innovation\": {\"range_m\": \"linear\", \"bearing_rad\": \"angle\"},"
    " \"parameters\": {"
    "  \"forward_noise_density\": {\"default\": null, \"minimum\": 0, \"role\": \"process noise\","
    "   \"unit\": \"m/s/sqrt(Hz)\"},"
    "  \"turn_noise_density\": {\"default\": null, \"minimum\": 0, \"role\": \"process noise\","
    "   \"unit\": \"rad/s/sqrt(Hz)\"},"
    "  \"sigma_range_m\": {\"default\": null, \"exclusiveMinimum\": 0,"
    "   \"role\": \"measurement noise\"},"
    "  \"sigma_bearing_rad\": {\"default\": null, \"exclusiveMinimum\": 0,"
    "   \"role\": \"measurement noise\"},"
    "  \"bias_range_m\": {\"default\": 0},"
    "  \"bias_bearing_rad\": {\"default\": 0},"
    "  \"forward_scale\": {\"default\": 1, \"meaning\": \"the robot drives so many times the odometry\"},"
    "  \"turn_bias_radps\": {\"default\": 0},"
    "  \"gate_probability\": {\"default\": 1, \"exclusiveMinimum\": 0, \"maximum\": 1,"
    "   \"meaning\": \"a measurement beyond this quantile of chi-square is not used\"}},"
    " \"failures\": [\"the filter needs a prior\", \"there are more landmarks than it has room for\","
    "  \"the covariance is no longer positive definite\"]}";

enum { NEEDS_PRIOR = 1, TOO_MANY_LANDMARKS, NOT_POSITIVE_DEFINITE };

int32_t fuselog_filter_version(void) { return FUSELOG_FILTER_VERSION; }

const char *fuselog_filter_describe(void) { return description; }

void *fuselog_filter_create(const double *parameters, uint64_t seed)
{
    Robot *robot = calloc(1, sizeof *robot);
    (void)seed;
    if (robot != NULL)
        memcpy(robot->parameters, parameters, sizeof robot->parameters);
    return robot;
}

void fuselog_filter_destroy(void *filter) { free(filter); }

void *fuselog_filter_copy(const void *filter)
{
    Robot *copy = malloc(sizeof *copy);
    if (copy != NULL)
        memcpy(copy, filter, sizeof *copy);
    return copy;
}

int32_t fuselog_filter_start(void *filter, int64_t time_ns, const double *mean, const double *covariance)
{
    Robot *robot = filter;
    if (mean == NULL)
        return NEEDS_PRIOR;
    memcpy(robot->mean, mean, sizeof robot->mean);
    memcpy(robot->covariance, covariance, sizeof robot->covariance);
    robot->time_ns = time_ns;
    return FUSELOG_FILTER_WELL;
}

static double wrapped(double angle)
{
    if (fabs(angle) < TAU / 2)
        return angle;
    return angle - TAU * floor((angle + TAU / 2) / TAU);
}

/* x + an arc; P = F P F' + G diag(density^2 / T) G' */
int32_t fuselog_filter_predict(void *filter, int64_t time_ns)
{
    Robot *robot = filter;
    const double *parameters = robot->parameters;
    double duration_s = (double)(time_ns - robot->time_ns) * 1e-9;
    if (duration_s <= 0.0)
        return FUSELOG_FILTER_WELL;
    double half = 0.5 * (robot->turn + parameters[TURN_BIAS]) * duration_s;
    double speed = parameters[SCALE] * robot->forward;
    double sinc = half == 0.0 ? 1.0 : sin(half) / half;
    double slope = fabs(half) < 1e-4 ? -half / 3.0 : (cos(half) - sinc) / half; /* derivative of sinc */
    double chord = speed * duration_s * sinc, direction = robot->mean[2] + half;
    double c = cos(direction), s = sin(direction);
    double by_half = speed * duration_s * slope, half_by_turn = 0.5 * duration_s;
    double transition[3][3] = {{1, 0, -chord * s}, {0, 1, chord * c}, {0, 0, 1}};
    double gain[3][2] = {
        {parameters[SCALE] * duration_s * sinc * c, half_by_turn * (by_half * c - chord * s)},
        {parameters[SCALE] * duration_s * sinc * s, half_by_turn * (by_half * s + chord * c)},
        {0, duration_s},
    };
    double variances[2] = {
        parameters[FORWARD_DENSITY] * parameters[FORWARD_DENSITY] / duration_s,
        parameters[TURN_DENSITY] * parameters[TURN_DENSITY] / duration_s,
    };
    double product[3][3], moved[3][3];
    robot->mean[0] += chord * c;
    robot->mean[1] += chord * s;
    robot->mean[2] += (robot->turn + parameters[TURN_BIAS]) * duration_s;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            product[i][j] = 0.0;
            for (int k = 0; k < 3; k++)
                product[i][j] += transition[i][k] * robot->covariance[k][j];
        }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            moved[i][j] = 0.0;
            for (int k = 0; k < 3; k++)
                moved[i][j] += product[i][k] * transition[j][k];
            for (int k = 0; k < 2; k++)
                moved[i][j] += gain[i][k] * variances[k] * gain[j][k];
        }
    memcpy(robot->covariance, moved, sizeof moved);
    robot->time_ns = time_ns;
    return FUSELOG_FILTER_WELL;
}

/* x + K v, P - K S K' for the measured components: H has one row for each of them */
static int32_t update(Robot *robot, int size, double rows[2][3], const double *difference,
                      const double *variances)
{
    double cross[3][2], spread[2][2], inverse[2][2], gain[3][2], squared = 0.0;
    for (int i = 0; i < size; i++)
        for (int k = 0; k < 3; k++) {
            cross[k][i] = 0.0;
            for (int j = 0; j < 3; j++)
                cross[k][i] += robot->covariance[k][j] * rows[i][j];
        }
    for (int i = 0; i < size; i++)
        for (int j = 0; j < size; j++) {
            spread[i][j] = i == j ? variances[i] : 0.0;
            for (int k = 0; k < 3; k++)
                spread[i][j] += rows[i][k] * cross[k][j];
            robot->spread[i][j] = spread[i][j];
        }
    double determinant = size == 1 ? spread[0][0]
                                   : spread[0][0] * spread[1][1] - spread[0][1] * spread[1][0];
    if (!(spread[0][0] > 0.0 && determinant > 0.0))
        return NOT_POSITIVE_DEFINITE;
    if (size == 1) {
        inverse[0][0] = 1.0 / spread[0][0];
    } else {
        inverse[0][0] = spread[1][1] / determinant;
        inverse[1][1] = spread[0][0] / determinant;
        inverse[0][1] = inverse[1][0] = -spread[0][1] / determinant;
    }
    for (int i = 0; i < size; i++)
        for (int j = 0; j < size; j++)
            squared += difference[i] * inverse[i][j] * difference[j];
    double below = size == 1 ? erf(sqrt(0.5 * squared)) : 1.0 - exp(-0.5 * squared); /* chi-square distribution */
    if (robot->parameters[GATE] < 1.0 && below > robot->parameters[GATE]) {
        robot->outcome = FUSELOG_FILTER_REJECTED;
        return FUSELOG_FILTER_WELL;
    }
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < size; i++) {
            gain[k][i] = 0.0;
            for (int j = 0; j < size; j++)
                gain[k][i] += cross[k][j] * inverse[j][i];
        }
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < size; i++)
            robot->mean[k] += gain[k][i] * difference[i];
    for (int k = 0; k < 3; k++)
        for (int j = 0; j <= k; j++) {
            for (int i = 0; i < size; i++)
                robot->covariance[k][j] -= gain[k][i] * cross[j][i];
            robot->covariance[j][k] = robot->covariance[k][j];
        }
    return FUSELOG_FILTER_WELL;
}

/* A range or bearing of a landmark, or both; NaN for a missing one. */
static int32_t sight(Robot *robot, double number, double range, double bearing)
{
    const double *parameters = robot->parameters;
    double rows[2][3], difference[2], variances[2];
    int size = 0, at = 0;
    while (at < robot->landmarks && robot->number[at] != number)
        at++;
    if (at == robot->landmarks || (isnan(range) && isnan(bearing)))
        return FUSELOG_FILTER_WELL;
    double dx = robot->place[at][0] - robot->mean[0], dy = robot->place[at][1] - robot->mean[1];
    double squared = dx * dx + dy * dy, distance = sqrt(squared);
    robot->outcome = FUSELOG_FILTER_WELL;
    robot->innovation[0] = robot->innovation[1] = NAN;
    if (!(distance > 0.0)) { /* no derivative at the landmark itself */
        robot->outcome = FUSELOG_FILTER_REJECTED;
        return FUSELOG_FILTER_WELL;
    }
    if (!isnan(range)) {
        double row[3] = {-dx / distance, -dy / distance, 0.0};
        memcpy(rows[size], row, sizeof row);
        difference[size] = range - (distance + parameters[BIAS_RANGE]);
        variances[size++] = parameters[SIGMA_RANGE] * parameters[SIGMA_RANGE];
    }
    if (!isnan(bearing)) {
        double row[3] = {dy / squared, -dx / squared, -1.0};
        memcpy(rows[size], row, sizeof row);
        difference[size] =
            wrapped(bearing - (atan2(dy, dx) - robot->mean[2] + parameters[BIAS_BEARING]));
        variances[size++] = parameters[SIGMA_BEARING] * parameters[SIGMA_BEARING];
    }
    robot->measured = size;
    if (!isnan(range))
        robot->innovation[0] = difference[0];
    if (!isnan(bearing))
        robot->innovation[1] = difference[size - 1];
    return update(robot, size, rows, difference, variances);
}

int32_t fuselog_filter_take(void *filter, int32_t topic, int64_t time_ns, const double *fields)
{
    Robot *robot = filter;
    robot->outcome = FUSELOG_FILTER_NOTHING;
    if (topic == LANDMARKS) { /* the map comes before the start */
        if (robot->landmarks == MOST_LANDMARKS)
            return TOO_MANY_LANDMARKS;
        robot->number[robot->landmarks] = fields[0];
        memcpy(robot->place[robot->landmarks++], fields + 1, 2 * sizeof *fields);
        return FUSELOG_FILTER_WELL;
    }
    fuselog_filter_predict(robot, time_ns);
    switch (topic) {
    case ODOMETRY:
        robot->forward = isnan(fields[0]) ? robot->forward : fields[0];
        robot->turn = isnan(fields[1]) ? robot->turn : fields[1];
        return FUSELOG_FILTER_WELL;
    case RANGE_BEARING:
        return sight(robot, fields[0], fields[1], fields[2]);
    case RANGE:
        return sight(robot, fields[0], fields[1], NAN);
    default:
        return sight(robot, fields[0], NAN, fields[1]);
    }
}

int32_t fuselog_filter_state(const void *filter, double *mean, double *covariance)
{
    const Robot *robot = filter;
    memcpy(mean, robot->mean, sizeof robot->mean);
    memcpy(covariance, robot->covariance, sizeof robot->covariance);
    return FUSELOG_FILTER_WELL;
}

int32_t fuselog_filter_innovation(const void *filter, double *innovation, double *covariance)
{
    const Robot *robot = filter;
    if (robot->outcome == FUSELOG_FILTER_NOTHING)
        return FUSELOG_FILTER_NOTHING;
    memcpy(innovation, robot->innovation, sizeof robot->innovation);
    if (robot->measured == 2)
        memcpy(covariance, robot->spread, sizeof robot->spread);
    else
        covariance[isnan(innovation[0]) ? 3 : 0] = robot->spread[0][0];
    return robot->outcome;
}
