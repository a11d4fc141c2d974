"""The arm as clients get it: a model library (protocol 5) or URDF (protocol 10).

The library's source is C with one arm's numbers, built once with the machine's own compiler. It has
thirty functions by name (libfranka 0.9.2): `Ji_J_Jk` and `O_J_Jk`, Jacobians in the frame's own and
in base axes; `O_T_Jk`, poses; k = 1..7 joints, 8 flange, 9 end effector; `M_NE`, `c_NE`, `g_NE`,
mass matrix, Coriolis and gravity torques with a load. Matrices are column-major.

libfranka 0.21 demands of the URDF seven movable joints with `joint1` to `joint7` in their names,
each with its limits and with `position_based_velocity_limits`, and a link that is called exactly
`link8`, the flange.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path
from xml.sax.saxutils import quoteattr

from sim.scenarios import FLANGE_M
from sim.truth import Array, Truth, body_of, to_rpy

_HEAD = """#include <math.h>
#include <string.h>
#define N 7
"""

_BODY = """
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
"""


def model_source(truth: Truth) -> str:
    """The whole source for one arm."""
    tables = (
        _table("R0[N][3][3]", truth.R.ravel()),
        _table("P0[N][3]", truth.p.ravel()),
        _table("THETA[N][10]", truth.theta.ravel()),
    )
    return "".join((_HEAD, f"#define FLANGE {FLANGE_M!r}\n", *tables, _BODY, *_frames()))


def _table(name: str, values: Iterable[float]) -> str:
    return f"static const double {name} = {{{', '.join(repr(float(x)) for x in values)}}};\n"


def _frames() -> list[str]:
    """The functions that differ only in the frame; the first joint's Jacobians take no posture."""
    out = []
    for k in range(1, 10):
        tool, given = ("tool", "const double *tool, ") if k == 9 else ("0", "")
        q, posture = ("0", "") if k == 1 else ("q", "const double *q, ")
        if k == 1:
            out.append("static const double ZERO[N];\n")
            q = "ZERO"
        count = min(k, 8)
        for name, body in (("Ji_J_J", 1), ("O_J_J", 0)):
            call = f"jacobian({q}, {count}, {tool}, {body}, out)"
            out.append(f"void {name}{k}({posture}{given}double *out) {{ {call}; }}\n")
        call = f"pose(q, {count}, {tool}, out)"
        out.append(f"void O_T_J{k}(const double *q, {given}double *out) {{ {call}; }}\n")
    return out


COMPILERS = ("cc", "gcc", "clang")
OPTIONS = ("-O2", "-shared", "-fPIC", "-x", "c", "-", "-lm")
TIMEOUT_S = 60.0


def model_library(truth: Truth) -> bytes | None:
    """The library's bytes; None without a C compiler, or where it does not build for x64 Linux."""
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None or (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        return None
    source = model_source(truth)
    key = hashlib.sha256("\n".join((compiler, *OPTIONS, source)).encode()).hexdigest()
    folder = _cache_folder()
    kept = folder / f"{key}.so"
    if not kept.is_file():
        with tempfile.TemporaryDirectory(dir=folder) as work:
            built = Path(work) / "model.so"
            try:
                subprocess.run(
                    [compiler, *OPTIONS, "-o", str(built)],
                    input=source.encode(),
                    capture_output=True,
                    timeout=TIMEOUT_S,
                    check=True,
                )
            except (OSError, subprocess.SubprocessError):
                return None
            built.replace(kept)
    return kept.read_bytes()


def _cache_folder() -> Path:
    """A folder of this user alone: what is in it will be run by clients."""
    folder = Path(tempfile.gettempdir()) / f"simulated-fci-models-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    facts = folder.lstat()
    if folder.is_symlink() or facts.st_uid != os.getuid() or facts.st_mode & 0o077:
        return Path(tempfile.mkdtemp(prefix="simulated-fci-models-"))
    return folder


NAME = "simulated_arm"
# The margin by which the speed limit is lowered near a position limit: v <= sqrt(2 a d) + offset.
VELOCITY_OFFSET = 0.0  # rad/s


def robot_urdf(truth: Truth) -> str:
    """The arm without payloads and losses."""
    parts = [f"<robot name={quoteattr(NAME)}>", '<link name="link0"/>']
    for j in range(truth.n):
        parts.append(_link(f"link{j + 1}", *body_of(truth.theta[j])))
        parts.append(_joint(truth, j))
    parts.append('<link name="link8"/>')
    parts.append(
        f'<joint name="joint8" type="fixed"><origin xyz="0 0 {FLANGE_M!r}" rpy="0 0 0"/>'
        '<parent link="link7"/><child link="link8"/></joint>'
    )
    return "\n".join([*parts, "</robot>"])


def _joint(truth: Truth, j: int) -> str:
    limits = truth.limits
    numbers = {
        "lower": limits.lower[j],
        "upper": limits.upper[j],
        "velocity": limits.velocity[j],
        "effort": limits.effort[j],
    }
    said = " ".join(f'{key}="{float(value)!r}"' for key, value in numbers.items())
    slowing = float(limits.acceleration[j])
    return (
        f'<joint name="joint{j + 1}" type="revolute">'
        f'<origin xyz="{_row(truth.p[j])}" rpy="{_row(to_rpy(truth.R[j]))}"/>'
        f'<parent link="link{j}"/><child link="link{j + 1}"/><axis xyz="0 0 1"/><limit {said}/>'
        f'<position_based_velocity_limits velocity_offset="{VELOCITY_OFFSET!r}"'
        f' deceleration_limit="{slowing!r}"/></joint>'
    )


def _link(name: str, m: float, com: Array, inertia: Array) -> str:
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.tolist()
    return (
        f'<link name="{name}"><inertial><origin xyz="{_row(com)}" rpy="0 0 0"/>'
        f'<mass value="{m!r}"/><inertia ixx="{xx!r}" ixy="{xy!r}" ixz="{xz!r}" iyy="{yy!r}"'
        f' iyz="{yz!r}" izz="{zz!r}"/></inertial></link>'
    )


def _row(values: Array | tuple[float, ...]) -> str:
    return " ".join(repr(float(x)) for x in values)
