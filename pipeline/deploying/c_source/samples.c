/*# Functions at weighted samples. SAMPLES is the largest number of samples, DRAWN the largest number of
 * entries in a sample, VALUES the largest number of tangent components of a function's value, and PLACES the
 * largest number of its components. #*/
/* The results of a function at samples: tangent vectors of the samples from the mean, followed by noise,
 * and of its values from their centre, minus a shift. */
typedef struct {
    REAL factor[DRAWN][DRAWN]; /* of the covariance of state and noise */
    REAL offsets[SAMPLES][DRAWN], values[SAMPLES][VALUES];
    REAL centre[PLACES], shift[VALUES];
} drawn_samples;

/* A sample's offset: the factor times a point. */
static void draw(drawn_samples *samples, int index, int size, const REAL *point)
{
    for (int row = 0; row < size; row++) {
        REAL entry = samples->factor[row][0] * point[0];
        for (int k = 1; k <= row; k++)
            entry += samples->factor[row][k] * point[k];
        samples->offsets[index][row] = entry;
    }
}

/* The mean of the values becomes the shift. */
static void find_shift(drawn_samples *samples, int count, const REAL *weights, int size)
{
    for (int i = 0; i < size; i++) {
        REAL entry = 0.0_S;
        for (int k = 0; k < count; k++)
            entry += weights[k] * samples->values[k][i];
        samples->shift[i] = entry;
    }
}

/*% if turns %*/
/* The sum of the variances of `width` tangent components. */
static REAL squared_length(const drawn_samples *samples, int first, int width)
{
    REAL squared = 0.0_S;
    for (int row = first; row < first + width; row++)
        for (int k = 0; k <= row; k++)
            squared += samples->factor[row][k] * samples->factor[row][k];
    return squared;
}

/* The share of the factor at which samples are taken, so that no angle wraps: 1 unless an angle is
 * hardly known. A motion (`bounded`) samples no angle wider than uniform. */
static REAL narrow(drawn_samples *samples, int count, int size, const REAL *points, REAL unsuspected,
                   int bounded)
{
    static const int first[${turns}] = {${first}}, width[${turns}] = {${width}};
    static const REAL times[${turns}] = {${times}};
    REAL widest = 0.0_S, reach = 0.0_S;
    int suspected = 0;
    for (int turn = 0; turn < ${turns}; turn++)
        if (times[turn] * times[turn] * squared_length(samples, first[turn], width[turn]) >
            unsuspected * unsuspected)
            suspected = 1;
    if (!suspected)
        return 1.0_S;
    for (int turn = 0; turn < ${turns}; turn++) {
        REAL most = 0.0_S;
        for (int row = first[turn]; row < first[turn] + width[turn]; row++) {
            REAL wide = times[turn] * sqrt_S(squared_length(samples, row, 1));
            if (bounded && wide > ${uniform_rad}) {
                for (int k = 0; k <= row; k++)
                    samples->factor[row][k] *= ${uniform_rad} / wide;
                wide = ${uniform_rad};
            }
            widest = wide > widest ? wide : widest;
        }
        for (int index = 0; index < count; index++) {
            REAL squared = 0.0_S;
            for (int row = first[turn]; row < first[turn] + width[turn]; row++) {
                REAL away = 0.0_S;
                for (int k = 0; k <= row; k++)
                    away += samples->factor[row][k] * points[index * size + k];
                squared += away * away;
            }
            most = squared > most ? squared : most;
        }
        most = times[turn] * sqrt_S(most);
        reach = most > reach ? most : reach;
    }
    if (reach <= ${quarter_rad} || (widest <= ${wide_rad} && reach <= ${half_rad}))
        return 1.0_S;
    const REAL share = ${quarter_rad} / reach;
    for (int row = 0; row < size; row++)
        for (int k = 0; k <= row; k++)
            samples->factor[row][k] *= share;
    return share;
}

/* Rescales offsets and values of narrowed samples to their full width. */
static void widen(drawn_samples *samples, int count, int drawn, int size, REAL share)
{
    for (int index = 0; index < count; index++) {
        for (int row = 0; row < drawn; row++)
            samples->offsets[index][row] /= share;
        for (int i = 0; i < size; i++)
            samples->values[index][i] /= share;
    }
    for (int i = 0; i < size; i++)
        samples->shift[i] /= share;
    for (int row = 0; row < drawn; row++)
        for (int k = 0; k <= row; k++)
            samples->factor[row][k] /= share;
}

/*% endif %*/
/*% for text in functions %*/
${text}
/*% endfor %*/
/*% if made.is_root %*/
/* The state's factor, with room for noise behind it. */
static void start_samples(const NAME *filter, drawn_samples *samples)
{
    for (int row = 0; row < DRAWN; row++)
        for (int column = 0; column < DRAWN; column++)
            samples->factor[row][column] =
                row < T && column < T ? filter->factor[row][column] : 0.0_S;
}

/* Sets the rows to the values at the samples, followed by `states` components of the samples. */
static void spread(const drawn_samples *samples, int count, const REAL *weights, int size, int states,
                   factorisation *found)
{
    for (int k = 0; k < count; k++) {
        found->weights[k] = weights[k];
        for (int i = 0; i < size; i++)
            found->rows[i][k] = samples->values[k][i] - samples->shift[i];
        for (int row = 0; row < states; row++)
            found->rows[size + row][k] = samples->offsets[k][row];
    }
}
/*% else %*/
/* The state's factor, with room for noise behind it; 0 if its covariance is indefinite. */
static int start_samples(const NAME *filter, drawn_samples *samples)
{
    for (int row = 0; row < DRAWN; row++)
        for (int column = 0; column < DRAWN; column++)
            samples->factor[row][column] =
                row < T && column <= row ? filter->covariance[row][column] : 0.0_S;
    return cholesky(&samples->factor[0][0], DRAWN, T);
}

/* The covariance of the values and, if `cross` is not NULL, that of the state with them. */
static void find_moments(const drawn_samples *samples, int count, const REAL *weights, int size,
                         REAL *spread, int stride, REAL (*cross)[M])
{
    for (int i = 0; i < size; i++)
        for (int j = 0; j <= i; j++) {
            REAL entry = 0.0_S;
            for (int k = 0; k < count; k++)
                entry += weights[k] * (samples->values[k][i] - samples->shift[i]) *
                         (samples->values[k][j] - samples->shift[j]);
            spread[i * stride + j] = spread[j * stride + i] = entry;
        }
    for (int row = 0; cross != NULL && row < T; row++)
        for (int i = 0; i < size; i++) {
            REAL entry = 0.0_S;
            for (int k = 0; k < count; k++)
                entry += samples->offsets[k][row] *
                         (weights[k] * (samples->values[k][i] - samples->shift[i]));
            cross[row][i] = entry;
        }
}
/*% if axes %*/
/* The same for samples on axes: the covariance of the state with the values is the factor of the state's
 * covariance times that of the points with the values. The values `kept` are unchanged states. */
static void find_moments_on_axes(const drawn_samples *samples, int count, const REAL *weights,
                                 const REAL *points, int drawn, const int *axes, int size, REAL *spread,
                                 int stride, REAL (*cross)[M], const int *kept, int number)
{
    REAL joint[DRAWN][VALUES], mixed[T][VALUES];
    find_moments(samples, count, weights, size, spread, stride, NULL);
    for (int k = 0; k < drawn; k++)
        for (int i = 0; i < size; i++)
            joint[k][i] = 0.0_S;
    for (int k = 0; k < count; k++) {
        const int axis = axes[k];
        const REAL weighted = weights[k] * points[k * drawn + axis];
        for (int i = 0; i < size; i++)
            joint[axis][i] += weighted * (samples->values[k][i] - samples->shift[i]);
    }
    for (int row = 0; row < T; row++)
        for (int i = 0; i < size; i++) {
            REAL entry = 0.0_S;
            for (int k = 0; k <= row; k++)
                entry += samples->factor[row][k] * joint[k][i];
            mixed[row][i] = entry;
        }
    for (int row = 0; cross != NULL && row < T; row++)
        for (int i = 0; i < size; i++)
            cross[row][i] = mixed[row][i];
    for (int k = 0; k < number; k++)
        for (int i = 0; i < size; i++)
            spread[kept[k] * stride + i] = spread[i * stride + kept[k]] = mixed[kept[k]][i];
}
/*% endif %*/
/*% endif %*/
