"""Products of covariances with Jacobians in C, as loops over entries that are not known to be zero.

Sums have the same order as in `fuselog.replay.inference.linear_algebra.sparse`. Placeholders are those
of `algebra`. `columns` lists, for each row of a matrix, the columns of entries that are not known to be
zero, followed by -1.
"""

from collections.abc import Mapping

PROPAGATE = """/* P = F P F'. */
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
"""

ADD_THROUGH = """/* A = A + G diag(u) G'. */
static void add_through_WHAT(REAL A[SIZE][SIZE], int size, const REAL G[SIZE][GAINS], const REAL *u,
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
"""

MEASURE = """/* C = P H', S = H C. */
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
"""

TURN = """/* WHAT for the rotation whose axes begin at `at`, with its right Jacobian at the step d,
 * J = I - f [d]x + g [d]x^2: it goes over into the tangent space of the moved orientation. */
static void turn(REAL P[T][T], const REAL step[T], int at)
{
    const REAL x = step[at], y = step[at + 1], z = step[at + 2];
    const REAL squared = x * x + y * y + z * z;
FACTORS
    for (int side = 0; side < SIDES; side++)
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
"""

SLOPE = """/* P a / (a' P a): how the state changes along a, in which it is curved. */
static void find_slope(const REAL P[T][T], const REAL a[T], REAL slope[T])
{
    REAL variance = 0.0_S;
    for (int row = 0; row < T; row++)
        slope[row] = 0.0_S;
PRODUCT    for (int row = 0; row < T; row++)
        variance += a[row] * slope[row];
    for (int row = 0; row < T; row++)
        slope[row] = variance > 0.0_S ? slope[row] / variance : 0.0_S;
}
"""
_TIMES = """\
    for (int row = 0; row < T; row++)
        for (int column = 0; column < T; column++)
            slope[row] += P[row][column] * a[column];
"""
_TIMES_FACTOR = """\
    for (int k = 0; k < T; k++) { /* P P' a, of the factor P */
        REAL entry = 0.0_S;
        for (int row = k; row < T; row++)
            entry += P[row][k] * a[row];
        for (int row = k; row < T; row++)
            slope[row] += P[row][k] * entry;
    }
"""


def slope_text(*, is_root: bool) -> str:
    """Write the code that finds how a curved state changes along the direction of its curvature."""
    return SLOPE.replace("PRODUCT", _TIMES_FACTOR if is_root else _TIMES)


def add_through(sizes: Mapping[str, str], gains: int) -> list[str]:
    """Write the functions that add noise with at most `gains` components to matrices of `sizes`."""
    if not sizes:
        return []
    texts = [ADD_THROUGH.replace("WHAT", what).replace("SIZE", size) for what, size in sizes.items()]
    return [f"enum {{ GAINS = {gains} }}; /* numbers of noise that enter, at most */\n", *texts]


def columns_text(name: str, columns: list[list[int]], size: str) -> str:
    """Write the table that lists columns row by row; see the module."""
    rows = ", ".join("{" + ", ".join(map(str, [*row, -1])) + "}" for row in columns)
    return f"static const signed char {name}[{size}][T + 1] = {{{rows}}};"


def turn_text(factors: str, *, is_root: bool) -> str:
    """Write the rotation of a covariance with an orientation; a factor is rotated on one side only."""
    what, sides = ("A factor P = J P", "1") if is_root else ("P = J P J'", "2")
    return TURN.replace("WHAT", what).replace("SIDES", sides).replace("FACTORS\n", factors)
