/* Frozen reference: the batch reactor's sampling filter as a C compiler makes it.
   run r owns the measurements z[offsets[r]] ... z[offsets[r + 1] - 1]; s and w are `count` samples. */
#include <math.h>

static void filter(int steps, const double *z, int count, const double *s, const double *w, double *out) {
  double m[2] = {.5, 3.5}, P[4] = {10, 0, 0, 10}, v[count][2];
  for (int k = 0; k < steps; k++) {
    double a = sqrt(P[0]), b = P[2] / a, c = sqrt(P[3] - b * b), mm[2] = {0, 0};
    for (int i = 0; i < count; i++) {
      double x = m[0] + a * s[2 * i], y = m[1] + b * s[2 * i] + c * s[2 * i + 1], r = .1 * x * x;
      v[i][0] = x - .32 * r; v[i][1] = y + .16 * r;
      for (int j = 0; j < 2; j++) mm[j] += w[i] * v[i][j];
    }
    P[0] = P[3] = 1e-5; P[1] = 0;
    for (int i = 0; i < count; i++) {
      double d = v[i][0] - mm[0], e = v[i][1] - mm[1];
      P[0] += w[i] * d * d; P[1] += w[i] * d * e; P[3] += w[i] * e * e;
    }
    double g = P[0] + P[1], h = P[1] + P[3], S = g + h + .1, n = z[k] - mm[0] - mm[1];
    m[0] = out[2 * k] = mm[0] + g / S * n; m[1] = out[2 * k + 1] = mm[1] + h / S * n;
    P[0] -= g * g / S; P[1] -= g * h / S; P[2] = P[1]; P[3] -= h * h / S;
  }
}

void filter_runs(int runs, const long long *offsets, const double *z, int count, const double *s,
                 const double *w, double *out) {
  for (int r = 0; r < runs; r++)
    filter((int)(offsets[r + 1] - offsets[r]), z + offsets[r], count, s, w, out + 2 * offsets[r]);
}
