/*# The Kalman update, with the same operations as `fuselog.replay.inference.kalman.update`. `iterate` is the
 * update of iterated filters. Square-root forms share only the functions before `update`. #*/
/* The factor on the covariance of an innovation that the options of robust updates give. */
static REAL inflation(REAL nis, int size, const NAME_gate *gate)
{
    REAL factor = 1.0_S;
    if (nis > gate->inflate_nis)
        factor = nis / gate->inflate_nis;
    if (gate->student_freedom > 0.0_S) {
        const REAL wider = (gate->student_freedom + nis) / (gate->student_freedom + (REAL)size);
        factor = wider > factor ? wider : factor;
    }
    if (nis > gate->switch_nis) {
        const REAL half = 0.5_S * (1.0_S + nis / gate->switch_nis);
        factor = half * half > factor ? half * half : factor;
    }
    return factor;
}

/* Whether a measurement is used: its NIS is below the bound, or the last one was used too long ago. */
static int is_used(NAME *filter, int sensor, int size, REAL nis, const NAME_gate *gate)
{
    if (size == 0 || !(nis <= gate->nis[size] ||
                       seconds(filter->accepted_ns[sensor], filter->time_ns) > gate->reopens_s))
        return 0;
    filter->accepted_ns[sensor] = filter->time_ns;
    return 1;
}

/* Clears an innovation: all numbers are NaN, and it is not accepted. */
static void forget(NAME_innovation *innovation)
{
    for (int i = 0; i < NAME_INNOVATION; i++) {
        innovation->difference[i] = (REAL)NAN;
        for (int j = 0; j < NAME_INNOVATION; j++)
            innovation->covariance[i][j] = (REAL)NAN;
    }
    innovation->nis = (REAL)NAN;
    innovation->is_accepted = 0;
}

/* Whether a message can be used: what was measured is finite or missing, what comes with it finite. */
static int is_usable(const REAL *data, int measured, int references)
{
    for (int i = 0; i < measured; i++)
        if (isinf(data[i]))
            return 0;
    return is_finite(data + measured, references);
}

/* Whether the rows of a covariance that comes with what was measured can be used. */
static int is_noise_usable(const REAL *data, int measured, const REAL *entry)
{
    for (int row = 0; row < measured; row++)
        for (int column = 0; column <= row; column++, entry++)
            if (!isnan(data[row]) && !isnan(data[column]) &&
                (!is_finite(entry, 1) || (row == column && *entry < 0.0_S)))
                return 0;
    return 1;
}

/* What an update returns: NAME_WELL only for a finite state; otherwise nothing is accepted. */
static NAME_outcome finished(const NAME *filter, int outcome, NAME_innovation *innovation)
{
    const NAME_outcome found = outcome == NAME_WELL ? checked(filter) : (NAME_outcome)outcome;
    if (found != NAME_WELL)
        innovation->is_accepted = 0;
    return found;
}

/* Stores an innovation for the caller: each component that is not missing, in its place. */
static void keep(NAME_innovation *innovation, int components, const int *places, const REAL v[M],
                 const REAL S[M][M])
{
    for (int i = 0; i < components; i++) {
        if (isnan(v[i]))
            continue;
        innovation->difference[places[i]] = v[i];
        for (int j = 0; j <= i; j++)
            if (!isnan(v[j]))
                innovation->covariance[places[i]][places[j]] =
                    innovation->covariance[places[j]][places[i]] = S[i][j];
    }
}

/*% if made.is_root %*/
/* Updates by rows that hold the values and behind them the state, in `columns` columns. The factor of
 * these and of the noise holds that of S, K L and that of P: see Kaminski, Bryson and Schmidt, IEEE TAC
 * 16(6), 1971. A component that is NaN counts as one of a noise of its own, which is as predicted. */
static int update(NAME *filter, int sensor, int components, int columns, const int *places, REAL v[M],
                  REAL noise[M][M], factorisation *found, const NAME_gate *gate,
                  NAME_innovation *innovation)
{
    REAL S[M][M], step[T], nis = 0.0_S, wider;
    int size = 0;
    for (int i = 0; i < components; i++) {
        if (!isnan(v[i])) {
            size++;
            continue;
        }
        for (int k = 0; k < columns; k++)
            found->rows[i][k] = 0.0_S;
        for (int k = 0; k < components; k++)
            noise[i][k] = noise[k][i] = 0.0_S;
        noise[i][i] = 1.0_S;
    }
    if (!factorise(found, components + T, columns, components, &noise[0][0], M))
        return NAME_NOT_POSITIVE_DEFINITE;
    square(&found->factor[0][0], ROWS, components, &S[0][0], M);
    keep(innovation, components, places, v, (const REAL(*)[M])S);
    for (int i = 0; i < components; i++) {
        if (!(found->factor[i][i] > 0.0_S))
            return NAME_NOT_POSITIVE_DEFINITE;
        if (isnan(v[i]))
            v[i] = 0.0_S;
    }
    for (int i = 0; i < components; i++) {
        for (int k = 0; k < i; k++)
            v[i] -= found->factor[i][k] * v[k];
        v[i] /= found->factor[i][i];
        nis += v[i] * v[i];
    }
    innovation->nis = nis;
    innovation->is_accepted = is_used(filter, sensor, size, nis, gate);
    if (!innovation->is_accepted)
        return NAME_WELL;
    wider = inflation(nis, size, gate);
    for (int row = 0; row < T; row++) {
        step[row] = 0.0_S;
        for (int i = 0; i < components; i++)
            step[row] += found->factor[components + row][i] * v[i] / wider;
        for (int k = 0; k < components + T; k++)
            found->rows[row][k] = found->factor[components + row][k];
    }
    for (int k = 0; k < components + T; k++)
        found->weights[k] = k < components ? 1.0_S - 1.0_S / wider : 1.0_S;
    orthogonalise(found, T, components + T);
    take_factor(filter, found);
    FIND_SLOPE;
    correct(filter, step, slope);
    return NAME_WELL;
}
/*% else %*/
/* Moves the measured components to the front; returns their number. */
static int drop_missing(int components, REAL v[M], REAL S[M][M], REAL C[T][M])
{
    int size = 0;
    for (int component = 0; component < components; component++) {
        if (isnan(v[component]))
            continue;
        if (size < component) {
            v[size] = v[component];
            for (int row = 0; row < T; row++)
                C[row][size] = C[row][component];
            for (int k = 0; k < components; k++)
                S[size][k] = S[component][k];
            for (int k = 0; k < components; k++)
                S[k][size] = S[k][component];
        }
        size++;
    }
    return size;
}

/* v becomes L^-1 v and S its factor L; the NIS is the square of v. 0 if S is indefinite. */
static int whiten(int size, REAL v[M], REAL S[M][M], REAL *nis)
{
    *nis = 0.0_S;
    if (!cholesky(&S[0][0], M, size))
        return 0;
    for (int i = 0; i < size; i++) {
        for (int k = 0; k < i; k++)
            v[i] -= S[i][k] * v[k];
        v[i] /= S[i][i];
        *nis += v[i] * v[i];
    }
    return !isnan(*nis);
}

/* Makes the covariance of a whitened innovation `factor` times larger. */
static void inflate(int size, REAL v[M], REAL S[M][M], REAL factor)
{
    if (!(factor > 1.0_S))
        return;
    const REAL root = sqrt_S(factor);
    for (int i = 0; i < size; i++) {
        v[i] /= root;
        for (int k = 0; k <= i; k++)
            S[i][k] *= root;
    }
}

/* The step K v = W L^-1 v of a whitened innovation; C becomes W = C L^-T. */
static void find_step(int size, REAL v[M], REAL S[M][M], REAL C[T][M], REAL step[T])
{
    for (int row = 0; row < T; row++) {
        step[row] = 0.0_S;
        for (int i = 0; i < size; i++) {
            REAL entry = C[row][i];
            for (int k = 0; k < i; k++)
                entry -= S[i][k] * C[row][k];
            C[row][i] = entry / S[i][i];
            step[row] += C[row][i] * v[i];
        }
    }
}

/* P - W W'. */
static void downdate(REAL P[T][T], int size, const REAL W[T][M])
{
    for (int row = 0; row < T; row++)
        for (int column = 0; column <= row; column++) {
            REAL entry = P[row][column];
            for (int i = 0; i < size; i++)
                entry -= W[row][i] * W[column][i];
            P[row][column] = P[column][row] = entry;
        }
}

/*% if made.steps.is_iterated %*/
/* One iterate of Gauss-Newton on the posterior: finds the step of an innovation that was linearised at
 * the step before; UNSETTLED while they differ. The gate and the weight of a measurement are decided at
 * the first, whose step before is zero. Bell and Cathey, IEEE TAC 38(2), 1993. */
enum { ITERATIONS = 50, UNSETTLED = -1 };
static int iterate(NAME *filter, int sensor, int components, int iteration, REAL v[M], REAL S[M][M],
                   REAL C[T][M], REAL step[T], const REAL slope[T], REAL *factor,
                   const NAME_gate *gate, NAME_innovation *innovation)
{
    const int size = drop_missing(components, v, S, C);
    REAL before[T], change = 0.0_S;
    if (!whiten(size, v, S, &innovation->nis))
        return NAME_NOT_POSITIVE_DEFINITE;
    if (iteration == 0) {
        *factor = inflation(innovation->nis, size, gate);
        innovation->is_accepted = is_used(filter, sensor, size, innovation->nis, gate);
        if (!innovation->is_accepted)
            return NAME_WELL;
    }
    inflate(size, v, S, *factor);
    for (int row = 0; row < T; row++)
        before[row] = step[row];
    find_step(size, v, S, C, step);
    for (int row = 0; row < T; row++)
        if (fabs_S(step[row] - before[row]) > change)
            change = fabs_S(step[row] - before[row]);
    if (change >= ${least_change} && iteration + 1 < ITERATIONS)
        return UNSETTLED;
    downdate(filter->covariance, size, (const REAL(*)[M])C);
    correct(filter, step, slope);
    return NAME_WELL;
}
/*% else %*/
/* x (+) K v and P - K S K'. The gain K is not formed: with S = L L' and W = C L^-T, K v is W L^-1 v,
 * and K S K' is W W'. Components that are NaN in v are left out; v, S and C are used up. */
static int update(NAME *filter, int sensor, int components, REAL v[M], REAL S[M][M], REAL C[T][M],
                  const NAME_gate *gate, NAME_innovation *innovation)
{
    const int size = drop_missing(components, v, S, C);
    REAL step[T];
    if (!whiten(size, v, S, &innovation->nis))
        return NAME_NOT_POSITIVE_DEFINITE;
    innovation->is_accepted = is_used(filter, sensor, size, innovation->nis, gate);
    if (!innovation->is_accepted)
        return NAME_WELL;
    inflate(size, v, S, inflation(innovation->nis, size, gate));
    find_step(size, v, S, C, step);
    downdate(filter->covariance, size, (const REAL(*)[M])C);
    FIND_SLOPE;
    correct(filter, step, slope);
    return NAME_WELL;
}
/*% endif %*/
/*% endif %*/
