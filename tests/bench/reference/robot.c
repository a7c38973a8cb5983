/* Reference: the extended Kalman filter of a robot among landmarks by hand, as a C compiler makes it.
   The state is (x, y, heading). Run r owns the events offsets[r] ... offsets[r + 1] - 1: odometry, whose
   value (forward, turn) holds until the next, or the sighting (range, bearing) of a place, whose sensor is
   not negative. Mean (3) and covariance (9) are put out after the last event of a stamp, run after run. */
#include <math.h>

typedef struct { double xx, xy, xh, yy, yh, hh; } symmetric;

static double wrapped(double angle) { return angle - 2 * M_PI * floor(angle / (2 * M_PI) + .5); }

static void drive(double *m, symmetric *P, const double *velocity, const double *density, double t) {
  double half = .5 * velocity[1] * t, ratio = half == 0 ? 1 : sin(half) / half;
  double c = cos(m[2] + half), s = sin(m[2] + half), chord = velocity[0] * t * ratio;
  double slope = fabs(half) < 1e-4 ? -half / 3 : (cos(half) - ratio) / half;
  double stretch = velocity[0] * t * slope, fx = -chord * s, fy = chord * c;
  double gx = t * ratio * c, gy = t * ratio * s;
  double hx = .5 * t * (stretch * c - chord * s), hy = .5 * t * (stretch * s + chord * c);
  double q = density[0] * density[0] / t, r = density[1] * density[1] / t;
  m[0] += chord * c; m[1] += chord * s; m[2] += velocity[1] * t;
  double a = P->xh + fx * P->hh, b = P->yh + fy * P->hh;
  P->xx += fx * (P->xh + a) + q * gx * gx + r * hx * hx;
  P->xy += fy * P->xh + fx * b + q * gx * gy + r * hx * hy;
  P->yy += fy * (P->yh + b) + q * gy * gy + r * hy * hy;
  P->xh = a + r * hx * t; P->yh = b + r * hy * t; P->hh += r * t * t;
}

static void see(double *m, symmetric *P, const double *seen, const double *place, const double *variance) {
  double dx = place[0] - m[0], dy = place[1] - m[1], squared = dx * dx + dy * dy, d = sqrt(squared);
  double ax = -dx / d, ay = -dy / d, bx = dy / squared, by = -dx / squared;
  double v = seen[0] - d, w = wrapped(seen[1] - atan2(dy, dx) + m[2]);
  double cx = ax * P->xx + ay * P->xy, cy = ax * P->xy + ay * P->yy, ch = ax * P->xh + ay * P->yh;
  double ex = bx * P->xx + by * P->xy - P->xh, ey = bx * P->xy + by * P->yy - P->yh;
  double eh = bx * P->xh + by * P->yh - P->hh;
  double S = ax * cx + ay * cy + variance[0], T = bx * cx + by * cy - ch;
  double U = bx * ex + by * ey - eh + variance[1], det = S * U - T * T;
  double kx = (cx * U - ex * T) / det, ky = (cy * U - ey * T) / det, kh = (ch * U - eh * T) / det;
  double lx = (ex * S - cx * T) / det, ly = (ey * S - cy * T) / det, lh = (eh * S - ch * T) / det;
  m[0] += kx * v + lx * w; m[1] += ky * v + ly * w; m[2] += kh * v + lh * w;
  P->xx -= kx * cx + lx * ex; P->xy -= kx * cy + lx * ey; P->xh -= kx * ch + lx * eh;
  P->yy -= ky * cy + ly * ey; P->yh -= ky * ch + ly * eh; P->hh -= kh * ch + lh * eh;
}

void filter_runs(int runs, const long long *offsets, const long long *time_ns, const long long *sensor,
                 const double *value, const double *place, const unsigned char *is_last,
                 const double *density, const double *variance, const double *start_mean,
                 const double *start_covariance, const long long *start_ns, double *mean,
                 double *covariance) {
  long long row = 0;
  for (int r = 0; r < runs; r++) {
    const double *p = start_covariance + 9 * r, *first = start_mean + 3 * r;
    double m[3] = {first[0], first[1], first[2]}, velocity[2] = {0, 0};
    symmetric P = {p[0], p[1], p[2], p[4], p[5], p[8]};
    long long now = start_ns[r];
    for (long long k = offsets[r]; k < offsets[r + 1]; k++) {
      if (time_ns[k] > now) drive(m, &P, velocity, density, (time_ns[k] - now) * 1e-9);
      now = time_ns[k];
      if (sensor[k] < 0) { velocity[0] = value[2 * k]; velocity[1] = value[2 * k + 1]; }
      else see(m, &P, value + 2 * k, place + 2 * k, variance);
      if (!is_last[k]) continue;
      double *o = mean + 3 * row, *c = covariance + 9 * row++;
      o[0] = m[0]; o[1] = m[1]; o[2] = wrapped(m[2]);
      c[0] = P.xx; c[1] = c[3] = P.xy; c[2] = c[6] = P.xh; c[4] = P.yy; c[5] = c[7] = P.yh; c[8] = P.hh;
    }
  }
}
