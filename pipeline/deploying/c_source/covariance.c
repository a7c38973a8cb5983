/*# Products of covariances with Jacobians, whose sums have the same order as in
 * `fuselog.replay.inference.linear_algebra.sparse`. `columns` lists, for each row of a matrix, the columns of
 * entries that are not known to be zero, followed by -1. #*/
/* A = L L' in place, for the first `size` rows and columns; 0 if A is indefinite. */
static int cholesky(REAL *A, int stride, int size)
{
    for (int column = 0; column < size; column++)
        for (int row = column; row < size; row++) {
            REAL entry = A[row * stride + column];
            for (int k = 0; k < column; k++)
                entry -= A[row * stride + k] * A[column * stride + k];
            if (row > column)
                A[row * stride + column] = entry / A[column * stride + column];
            else if (entry > 0.0_S)
                A[row * stride + row] = sqrt_S(entry);
            else
                return 0;
        }
    return 1;
}

/* P = F P F'. */
static void propagate(REAL P[T][T], const REAL F[T][T], const signed char columns[T][T + 1])
{
    REAL FP[T][T];
    for (int row = 0; row < T; row++)
        for (int column = 0; column < T; column++) {
            REAL entry = 0.0_S;
            for (const signed char *k = columns[row]; *k >= 0; k++)
                entry += F[row][*k] * P[*k][column];
            FP[row][column] = entry;
        }
    for (int row = 0; row < T; row++)
        for (int column = row; column < T; column++) {
            REAL entry = 0.0_S;
            for (const signed char *k = columns[row]; *k >= 0; k++)
                entry += FP[column][*k] * F[row][*k];
            P[row][column] = P[column][row] = entry;
        }
}

/* C = P H', S = H C. */
static void measure(const REAL P[T][T], const REAL H[M][T], const signed char (*columns)[T + 1],
                    int components, REAL C[T][M], REAL S[M][M])
{
    for (int i = 0; i < components; i++)
        for (int row = 0; row < T; row++) {
            REAL entry = 0.0_S;
            for (const signed char *k = columns[i]; *k >= 0; k++)
                entry += P[row][*k] * H[i][*k];
            C[row][i] = entry;
        }
    for (int j = 0; j < components; j++)
        for (int i = j; i < components; i++) {
            REAL entry = 0.0_S;
            for (const signed char *k = columns[j]; *k >= 0; k++)
                entry += H[j][*k] * C[*k][i];
            S[i][j] = S[j][i] = entry;
        }
}
