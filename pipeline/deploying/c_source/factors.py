"""Square-root forms in C, with the same operations as `fuselog.replay.inference.kalman.square_root`.

Placeholders are those of `algebra`; ROWS and COLUMNS are the size of the largest array to factorise.
"""

FACTORISING = """\
/* Rows to factorise, the weights of their columns, and the resulting factor. */
typedef struct {
    REAL rows[ROWS][COLUMNS], weights[COLUMNS], factor[ROWS][ROWS];
} factorisation;

/* The lower factor L of A diag(w) A' = L L', of rows A, which are used up, by modified Gram-Schmidt; 0
 * where the product is indefinite. */
static int orthogonalise(factorisation *found, int size, int columns)
{
    for (int i = 0; i < size; i++) {
        REAL *const own = found->rows[i];
        REAL squared = 0.0_S, whole = 0.0_S, least, pivot;
        for (int k = 0; k < columns; k++)
            squared += own[k] * found->weights[k] * own[k];
        for (int k = 0; k < i; k++)
            whole += found->factor[i][k] * found->factor[i][k];
        least = NOTHING_LEFT * (whole + fabs_S(squared));
        if (!(squared >= -least))
            return 0;
        pivot = squared > least ? sqrt_S(squared) : 0.0_S;
        found->factor[i][i] = pivot;
        for (int j = i + 1; j < size; j++) {
            REAL entry = 0.0_S;
            if (pivot > 0.0_S) {
                for (int k = 0; k < columns; k++)
                    entry += found->rows[j][k] * found->weights[k] * own[k];
                for (int k = 0; k < columns; k++)
                    found->rows[j][k] -= entry / squared * own[k];
                entry /= pivot;
            }
            found->factor[j][i] = entry;
            found->factor[i][j] = 0.0_S;
        }
    }
    return 1;
}

/* Columns of the rows become a factor N of a covariance N N', which is used up: by Cholesky, the largest
 * pivot first, since it may be singular. 0 where it is indefinite. */
static int fill_root(factorisation *found, int first, int size, REAL *covariance, int stride)
{
    REAL whole[SIDE];
    for (int i = 0; i < size; i++)
        whole[i] = covariance[i * stride + i];
    for (int k = 0; k < size; k++) {
        int best = -1;
        REAL largest = ROUNDING * (REAL)size;
        for (int i = 0; i < size; i++) {
            const REAL variance = covariance[i * stride + i];
            if (!(variance >= -ROUNDING * (REAL)size * whole[i]))
                return 0;
            if (variance > largest * whole[i]) {
                best = i;
                largest = variance / whole[i];
            }
        }
        if (best >= 0) {
            const REAL pivot = sqrt_S(covariance[best * stride + best]);
            for (int i = 0; i < size; i++)
                found->rows[i][first + k] = covariance[i * stride + best] / pivot;
            for (int i = 0; i < size; i++)
                for (int j = 0; j < size; j++)
                    covariance[i * stride + j] -=
                        found->rows[i][first + k] * found->rows[j][first + k];
        }
    }
    return 1;
}

/* Factorises rows of `columns` columns, followed by those of a noise; returns 0 if that fails. */
static int factorise(factorisation *found, int size, int columns, int noises, REAL *noise, int stride)
{
    for (int k = 0; k < noises; k++) {
        found->weights[columns + k] = 1.0_S;
        for (int row = 0; row < size; row++)
            found->rows[row][columns + k] = 0.0_S;
    }
    return fill_root(found, columns, noises, noise, stride) &&
           orthogonalise(found, size, columns + noises);
}

/* Rows from `first` on become the state's factor, whose columns weigh one. */
static void add_factor(const NAME *filter, int first, factorisation *found)
{
    for (int k = 0; k < T; k++) {
        found->weights[k] = 1.0_S;
        for (int row = 0; row < T; row++)
            found->rows[first + row][k] = filter->factor[row][k];
    }
}

/* The first rows that were factorised become the state's factor. */
static void take_factor(NAME *filter, const factorisation *found)
{
    for (int row = 0; row < T; row++)
        for (int column = 0; column < T; column++)
            filter->factor[row][column] = found->factor[row][column];
}

/* The covariance L L' of a lower factor. */
static void square(const REAL *factor, int stride, int size, REAL *covariance, int wide)
{
    for (int row = size - 1; row >= 0; row--)
        for (int column = row; column >= 0; column--) {
            REAL entry = 0.0_S;
            for (int k = 0; k <= column; k++)
                entry += factor[row * stride + k] * factor[column * stride + k];
            covariance[row * wide + column] = covariance[column * wide + row] = entry;
        }
}

void NAME_covariance(const NAME *filter, REAL covariance[T][T])
{
    square(&filter->factor[0][0], T, T, &covariance[0][0], T);
}
"""

START = """\
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
"""

CARRYING = """\
/* Rows become J L, of a Jacobian J and the state's factor L. */
static void carry(const NAME *filter, const REAL (*J)[T], const signed char (*columns)[T + 1], int size,
                  factorisation *found)
{
    for (int k = 0; k < T; k++) {
        found->weights[k] = 1.0_S;
        for (int i = 0; i < size; i++) {
            REAL entry = 0.0_S;
            for (const signed char *row = columns[i]; *row >= 0; row++)
                if (*row >= k)
                    entry += J[i][*row] * filter->factor[*row][k];
            found->rows[i][k] = entry;
        }
    }
}
"""

SAMPLING = """\
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
"""

RETRIANGULATE = """\
/* The lower factor of the same covariance as that of any factor. */
static void retriangulate(NAME *filter)
{
    factorisation found;
    add_factor(filter, 0, &found);
    orthogonalise(&found, T, T);
    take_factor(filter, &found);
}
"""

UPDATE = """\
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
"""
