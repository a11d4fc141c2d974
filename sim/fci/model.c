/* Kinematics and dynamics of one arm, for clients of the simulated robot.

   `sim.fci.model` puts FLANGE (m) and the tables R0[N][3][3], P0[N][3] (m) and THETA[N][10] before
   this, and the thirty functions that clients call behind it. Matrices are column-major there.
*/
static void cross(const double *a, const double *b, double *out) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}
static void times(const double A[3][3], const double *x, double *out) {
  for (int i = 0; i < 3; i++) out[i] = A[i][0] * x[0] + A[i][1] * x[1] + A[i][2] * x[2];
}
static void times_t(const double A[3][3], const double *x, double *out) {
  for (int i = 0; i < 3; i++) out[i] = A[0][i] * x[0] + A[1][i] * x[1] + A[2][i] * x[2];
}
static void turned(int j, double q, double out[3][3]) {
  double c = cos(q), s = sin(q);
  for (int i = 0; i < 3; i++) {
    out[i][0] = c * R0[j][i][0] + s * R0[j][i][1];
    out[i][1] = c * R0[j][i][1] - s * R0[j][i][0];
    out[i][2] = R0[j][i][2];
  }
}
/* Axes and origins of all joint frames; R and p become those of frame `count` (8 the flange). */
static void walk(const double *q, int count, double R[3][3], double *p, double axes[N][3],
                 double origins[N][3]) {
  double E[3][3], next[3][3], step[3];
  memset(R, 0, 9 * sizeof(double));
  for (int i = 0; i < 3; i++) R[i][i] = 1.0, p[i] = 0.0;
  for (int j = 0; j < (count < N ? count : N); j++) {
    times((const double(*)[3])R, P0[j], step);
    turned(j, q[j], E);
    for (int i = 0; i < 3; i++) {
      p[i] += step[i];
      for (int k = 0; k < 3; k++)
        next[i][k] = R[i][0] * E[0][k] + R[i][1] * E[1][k] + R[i][2] * E[2][k];
    }
    memcpy(R, next, sizeof next);
    for (int i = 0; i < 3; i++) origins[j][i] = p[i], axes[j][i] = R[i][2];
  }
  if (count > N)
    for (int i = 0; i < 3; i++) p[i] += FLANGE * R[i][2];
}
static void append(const double *T, double R[3][3], double *p) {
  double next[3][3], step[3];
  times((const double(*)[3])R, T + 12, step);
  for (int i = 0; i < 3; i++) {
    p[i] += step[i];
    for (int k = 0; k < 3; k++)
      next[i][k] = R[i][0] * T[4 * k] + R[i][1] * T[4 * k + 1] + R[i][2] * T[4 * k + 2];
  }
  memcpy(R, next, sizeof next);
}
static void pose(const double *q, int count, const double *tool, double *out) {
  double R[3][3], p[3], axes[N][3], origins[N][3];
  walk(q, count, R, p, axes, origins);
  if (tool) append(tool, R, p);
  for (int k = 0; k < 3; k++) {
    for (int i = 0; i < 3; i++) out[4 * k + i] = R[i][k];
    out[4 * k + 3] = 0.0;
    out[12 + k] = p[k];
  }
  out[15] = 1.0;
}
static void jacobian(const double *q, int count, const double *tool, int body, double *out) {
  double R[3][3], p[3], axes[N][3], origins[N][3], lever[3], at[3];
  walk(q, count, R, p, axes, origins);
  if (tool) append(tool, R, p);
  memset(out, 0, 42 * sizeof(double));
  for (int j = 0; j < (count < N ? count : N); j++) {
    for (int i = 0; i < 3; i++) at[i] = p[i] - origins[j][i];
    cross(axes[j], at, lever);
    if (body) {
      times_t((const double(*)[3])R, lever, out + 6 * j);
      times_t((const double(*)[3])R, axes[j], out + 6 * j + 3);
    } else {
      memcpy(out + 6 * j, lever, sizeof lever);
      memcpy(out + 6 * j + 3, axes[j], sizeof lever);
    }
  }
}
/* The last link's ten numbers with a load: mass m, centre x and inertia I about it, flange axes. */
static void loaded(const double *I, double m, const double *x, double *out) {
  double c[3] = {x[0], x[1], x[2] + FLANGE}, cc = 0.0;
  for (int i = 0; i < 3; i++) cc += c[i] * c[i];
  memcpy(out, THETA[N - 1], 10 * sizeof(double));
  out[0] += m;
  for (int i = 0, at = 4; i < 3; i++) {
    out[1 + i] += m * c[i];
    for (int k = i; k < 3; k++) out[at++] += I[i + 3 * k] + m * ((i == k) * cc - c[i] * c[k]);
  }
}
static void newton_euler(const double *last, const double *g, const double *q, const double *dq,
                         const double *ddq, double *tau) {
  double E[N][3][3], force[N][3], moment[N][3];
  double w[3] = {0}, dw[3] = {0}, a[3], t[3], u[3], v[3], h[3];
  for (int i = 0; i < 3; i++) a[i] = -g[i];
  for (int j = 0; j < N; j++) {
    const double *b = j < N - 1 ? THETA[j] : last, *c = b + 1;
    turned(j, q[j], E[j]);
    cross(dw, P0[j], t);
    cross(w, P0[j], u);
    cross(w, u, v);
    for (int i = 0; i < 3; i++) u[i] = a[i] + t[i] + v[i];
    times_t((const double(*)[3])E[j], u, a);
    times_t((const double(*)[3])E[j], w, t);
    times_t((const double(*)[3])E[j], dw, u);
    dw[0] = u[0] + t[1] * dq[j], dw[1] = u[1] - t[0] * dq[j], dw[2] = u[2] + ddq[j];
    w[0] = t[0], w[1] = t[1], w[2] = t[2] + dq[j];
    const double I[3][3] = {{b[4], b[5], b[6]}, {b[5], b[7], b[8]}, {b[6], b[8], b[9]}};
    cross(dw, c, t);
    cross(w, c, u);
    cross(w, u, v);
    for (int i = 0; i < 3; i++) force[j][i] = b[0] * a[i] + t[i] + v[i];
    times(I, w, h);
    cross(w, h, t);
    cross(c, a, u);
    times(I, dw, v);
    for (int i = 0; i < 3; i++) moment[j][i] = v[i] + t[i] + u[i];
  }
  for (int j = N - 1; j >= 0; j--) {
    tau[j] = moment[j][2];
    if (j == 0) break;
    times((const double(*)[3])E[j], force[j], t);
    times((const double(*)[3])E[j], moment[j], u);
    cross(P0[j], t, v);
    for (int i = 0; i < 3; i++) force[j - 1][i] += t[i], moment[j - 1][i] += u[i] + v[i];
  }
}
void M_NE(const double *q, const double *I, double m, const double *x, double *out) {
  const double still[N] = {0}, none[3] = {0};
  double last[10];
  loaded(I, m, x, last);
  for (int j = 0; j < N; j++) {
    double one[N] = {0};
    one[j] = 1.0;
    newton_euler(last, none, q, still, one, out + N * j);
  }
}
void c_NE(const double *q, const double *dq, const double *I, double m, const double *x,
          double *out) {
  const double still[N] = {0}, none[3] = {0};
  double last[10];
  loaded(I, m, x, last);
  newton_euler(last, none, q, dq, still, out);
}
void g_NE(const double *q, const double *g, double m, const double *x, double *out) {
  const double still[N] = {0}, none[9] = {0};
  double last[10];
  loaded(none, m, x, last);
  newton_euler(last, g, q, still, still, out);
}
