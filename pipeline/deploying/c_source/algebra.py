"""The Kalman update in C, operation by operation that of `replay.inference.kalman.update`.

NAME, T and M stand for the filter's name, its tangent space's size, and the most components of a sensor;
REAL and what ends numbers and functions of libm, _S, for the precision.
"""

ALGEBRA = """/* A = L L' in place, of the first `size` rows and columns; 0 where A is indefinite. */
static int cholesky(REAL A[M][M], int size)
{
    for (int column = 0; column < size; column++)
        for (int row = column; row < size; row++) {
            REAL entry = A[row][column];
            for (int k = 0; k < column; k++)
                entry -= A[row][k] * A[column][k];
            if (row > column)
                A[row][column] = entry / A[column][column];
            else if (entry > 0.0_S)
                A[row][row] = sqrt_S(entry);
            else
                return 0;
        }
    return 1;
}

/* Moves the components that were measured to the front; returns how many there are. */
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

/* How many times larger the covariance of an innovation counts, by the options of robust updates. */
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

/* x (+) K v and P - K S K'. The gain K is not formed: with S = L L' and W = C L^-T, K v is W L^-1 v, and
 * K S K' is W W'. Components that are NaN in v are left out; v, S and C are used up. */
static int update(NAME *filter, int sensor, int components, REAL v[M], REAL S[M][M], REAL C[T][M],
                  const NAME_gate *gate, NAME_innovation *innovation)
{
    const double waited_s = (double)(filter->time_ns - filter->accepted_ns[sensor]) * 1e-9;
    const int is_open = waited_s > gate->reopens_s;
    const int size = drop_missing(components, v, S, C);
    REAL step[T], nis = 0.0_S, factor;
    if (!cholesky(S, size))
        return NAME_NOT_POSITIVE_DEFINITE;
    for (int i = 0; i < size; i++) {
        for (int k = 0; k < i; k++)
            v[i] -= S[i][k] * v[k];
        v[i] /= S[i][i];
        nis += v[i] * v[i];
    }
    innovation->nis = nis;
    innovation->is_accepted = size > 0 && (is_open || nis <= gate->nis[size]);
    if (isnan(nis))
        return NAME_NOT_POSITIVE_DEFINITE;
    if (!innovation->is_accepted)
        return NAME_WELL;
    filter->accepted_ns[sensor] = filter->time_ns;
    factor = inflation(nis, size, gate);
    if (factor != 1.0_S) {
        const REAL root = sqrt_S(factor);
        for (int i = 0; i < size; i++) {
            v[i] /= root;
            for (int k = 0; k <= i; k++)
                S[i][k] *= root;
        }
    }
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
    for (int row = 0; row < T; row++)
        for (int column = 0; column <= row; column++) {
            REAL entry = filter->covariance[row][column];
            for (int i = 0; i < size; i++)
                entry -= C[row][i] * C[column][i];
            filter->covariance[row][column] = filter->covariance[column][row] = entry;
        }
    correct(filter, step);
    return NAME_WELL;
}

/* Keeps an innovation for whoever looks at it: each component at its place, NaN where it is missing. */
static void keep(NAME_innovation *innovation, int components, const int *places, REAL v[M], REAL S[M][M])
{
    for (int i = 0; i < NAME_INNOVATION; i++) {
        innovation->difference[i] = NAN;
        for (int j = 0; j < NAME_INNOVATION; j++)
            innovation->covariance[i][j] = NAN;
    }
    for (int i = 0; i < components; i++) {
        innovation->difference[places[i]] = v[i];
        for (int j = 0; j < components; j++)
            innovation->covariance[places[i]][places[j]] = isnan(v[i] + v[j]) ? NAN : S[i][j];
    }
}
"""
