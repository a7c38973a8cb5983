/*# Square-root forms, with the same operations as `fuselog.replay.inference.kalman.square_root`. ROWS and
 * COLUMNS are the size of the largest array to factorise. #*/
enum { SIDE = ${side}, ROWS = ${rows}, COLUMNS = ${columns} };

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
        least = ${nothing_left} * (whole + fabs_S(squared));
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
        REAL largest = ${rounding} * (REAL)size;
        for (int i = 0; i < size; i++) {
            const REAL variance = covariance[i * stride + i];
            if (!(variance >= -${rounding} * (REAL)size * whole[i]))
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

/* The lower factor of the same covariance as that of any factor. */
static void retriangulate(NAME *filter)
{
    factorisation found;
    add_factor(filter, 0, &found);
    orthogonalise(&found, T, T);
    take_factor(filter, &found);
}
