"""The networks of the paper in torch: joint signals, λ and θ into link motion and torques.

This is the definition; `kernels` has the same formulas compiled. Built from the tree alone,
batched over samples, differentiable in everything. Equations are numbered as in the paper, read as
the reading notes mend them:

- 8c, which its text lost, is the derivative of 8a:
  a_j = Rᵀ (a_i + dw_i × p_j + w_i × (w_i × p_j)). All of link j in frame j, R = R_ij.
  Accelerations `a` are those an accelerometer at the frame's origin reads (a_0 = -g on a base at
  rest), so that gravity needs no further term anywhere.
- A joint that slides along its z has R_ij = R0 and p_ij = p + q R0 z; its dq z and ddq z stand in
  8a and 8c, with 2 w_j x dq z, instead of in 8b and 8d, and its force is f_z where eq. 16 has m_z.
- τ = Y θ is linear in θ. The first row of eq. 13 is w_x w_y w_z; eq. 14c sums over the links that
  hang on link j, whatever their numbers. Twists are [v; w], wrenches [f; m].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from adapter.model.inertia import PARAMETERS
from adapter.model.spatial import Array
from adapter.model.tree import BASE, Tree

PER_BODY = len(PARAMETERS)  # of θ, eq. 4b
FORCE_Z, MOMENT_Z = 2, 5  # of a wrench [f; m], what a joint that slides or turns takes, eq. 16

# q, dq, ddq, (m, n) each: rad, rad/s, rad/s².
Joints = tuple[Tensor, Tensor, Tensor]


class FrameMotion(NamedTuple):
    """Motion of a link frame, or of several (then with a dimension of bodies before the last).

    Attributes:
        v: (..., 3) velocity of the origin, m/s.
        w: (..., 3) angular velocity, rad/s.
        a: (..., 3) acceleration of the origin with gravity (accelerometer convention), m/s².
        dw: (..., 3) angular acceleration, rad/s².
    """

    v: Tensor
    w: Tensor
    a: Tensor
    dw: Tensor

    @classmethod
    def of(cls, rows: Array) -> FrameMotion:
        """From motion rows [v w a dw] (..., 12)."""
        return cls(*torch.from_numpy(rows).split(3, dim=-1))


def joint_rotation(lam_j: Tensor) -> Tensor:
    """R0 = Rz(α) Rx(β) Rz(γ) of λ_j (..., 6): frame j in frame i at q = 0, (..., 3, 3)."""
    (ca, cb, cg), (sa, sb, sg) = (f(lam_j[..., :3]).unbind(-1) for f in (torch.cos, torch.sin))
    rows = [
        torch.stack([ca * cg - sa * cb * sg, -ca * sg - sa * cb * cg, sa * sb], dim=-1),
        torch.stack([sa * cg + ca * cb * sg, -sa * sg + ca * cb * cg, -ca * sb], dim=-1),
        torch.stack([sb * sg, sb * cg, cb], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def turn_z(q: Tensor, x: Tensor) -> Tensor:
    """Rz(q) x for q (m,), x (m, 3)."""
    c, s = torch.cos(q), torch.sin(q)
    x0, x1, x2 = x.unbind(-1)
    return torch.stack([c * x0 - s * x1, s * x0 + c * x1, x2.expand_as(c)], dim=-1)


def link_step(
    parent: FrameMotion, joint: Joints, lam_j: Tensor, slides: bool = False
) -> FrameMotion:
    """k_j(k_i, q_j, dq_j, ddq_j; λ_j): the motion of link j from that of its parent (eq. 10a).

    Args:
        parent: motion of link i in frame i, (m, 3) each.
        joint: q_j, dq_j, ddq_j (m,): rad, rad/s, rad/s², or m, m/s, m/s².
        lam_j: (6,) λ_j = [α β γ p].
        slides: whether it slides along its z or turns about it.

    Returns:
        Motion of link j in frame j, (m, 3) each.
    """
    v, w, a, dw = parent
    q_j, *rates = joint
    along, ahead = (torch.nn.functional.pad(x[..., None], (2, 0)) for x in rates)  # on z
    p, r0 = placed_at(q_j, lam_j, slides)
    p, cross = p.expand_as(w), torch.linalg.cross

    def into_j(x: Tensor) -> Tensor:
        return x @ r0 if slides else turn_z(-q_j, x @ r0)  # R_ijᵀ x, eq. 9

    v_j = into_j(v + cross(w, p))  # 8a
    w_i = into_j(w)  # 8b
    a_j = into_j(a + cross(dw, p) + cross(w, cross(w, p)))  # 8c
    dw_i = into_j(dw)  # 8d
    if slides:
        return FrameMotion(v_j + along, w_i, a_j + 2.0 * cross(w_i, along) + ahead, dw_i)
    return FrameMotion(v_j, w_i + along, a_j, dw_i + cross(w_i, along) + ahead)


def placed_at(q_j: Tensor, lam_j: Tensor, slides: bool) -> tuple[Tensor, Tensor]:
    """Origin of frame j in frame i, (3,) or (m, 3) where the joint slides, and R0 (3, 3)."""
    r0 = joint_rotation(lam_j)
    return (lam_j[3:] + q_j[:, None] * r0[:, 2] if slides else lam_j[3:]), r0


def base_motion(base: Tensor | FrameMotion, like: Tensor) -> FrameMotion:
    """The motion k_0 of the base (m, 3) each: measured, or at rest under gravity.

    Args:
        base: a LinkMotion with (m, 3) each, in the base's frame, its `a` with gravity (a - g); or
            the acceleration of gravity (3,) in base axes of a base at rest.
        like: (m, n) joint angles; number of samples, type and device are taken from it.
    """
    if isinstance(base, FrameMotion):
        return base
    zero = like.new_zeros((like.shape[0], 3))
    return FrameMotion(zero, zero, -base.to(like).expand_as(zero), zero)


def link_motion(tree: Tree, lam: Tensor, joints: Joints, base: Tensor | FrameMotion) -> FrameMotion:
    """Motion of every body, (m, bodies, 3) each (eq. 10b); the base first if it floats.

    Args:
        tree: N and A.
        lam: (n, 6) λ.
        joints: q, dq, ddq.
        base: gravity (3,) in base axes or the base's motion, see `base_motion`.
    """
    q, dq, ddq = joints
    k_base = base_motion(base, q)
    k: list[FrameMotion] = []
    for j, i in enumerate(tree.parent):
        parent = k_base if i == BASE else k[i]
        joint = q[:, j], dq[:, j], ddq[:, j]
        k.append(link_step(parent, joint, lam[j], tree.slides[j]))
    bodies = [k_base, *k] if tree.floating else k
    return FrameMotion(*(torch.stack(list(part), dim=1) for part in zip(*bodies, strict=True)))


def skew(x: Tensor) -> Tensor:
    """[x ×] of (..., 3), (..., 3, 3)."""
    x0, x1, x2 = x.unbind(-1)
    zero = torch.zeros_like(x0)
    rows = [[zero, -x2, x1], [x2, zero, -x0], [-x1, x0, zero]]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def bullet(w: Tensor) -> Tensor:
    """[• w] of (..., 3), (..., 3, 6): I w = [• w] [XX XY XZ YY YZ ZZ] (eq. 13, mended)."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [[x, y, z, zero, zero, zero], [zero, x, zero, y, z, zero], [zero, zero, x, zero, y, z]]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def body_wrench_regressor(k: FrameMotion) -> Tensor:
    """W (..., 6, 10): wrench [f; m] at the frame's origin = W θ (eqs. 11, 12)."""
    cross = skew(k.w)
    force = torch.cat(
        [k.a[..., None], skew(k.dw) + cross @ cross, k.a.new_zeros((*k.a.shape, 6))], dim=-1
    )
    moment = torch.cat(
        [torch.zeros_like(k.a)[..., None], -skew(k.a), bullet(k.dw) + cross @ bullet(k.w)], dim=-1
    )
    return torch.cat([force, moment], dim=-2)


def to_parent(wrench: Tensor, q_j: Tensor, lam_j: Tensor, slides: bool = False) -> Tensor:
    """T_j w: a wrench at frame j, (m, 6, ...), as one at frame i (eq. 14a)."""
    p, rotation = placed_at(q_j, lam_j, slides)
    if not slides:
        cos, sin = torch.cos(q_j), torch.sin(q_j)
        zero, one = torch.zeros_like(cos), torch.ones_like(cos)
        turn = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1)
        rotation = rotation @ turn.reshape(-1, 3, 3)
    force = rotation @ wrench[:, :3]
    return torch.cat([force, rotation @ wrench[:, 3:] + skew(p) @ force], dim=1)


def wrenches(tree: Tree, lam: Tensor, theta: Tensor, q: Tensor, k: FrameMotion) -> Tensor:
    """Total wrench [f; m] on every body, (m, bodies, 6), in its frame (eqs. 14c, 15).

    Args:
        tree: N and A.
        lam: (n, 6) λ.
        theta: (bodies, 10) θ.
        q: (m, n) joint angles, rad.
        k: motion of the bodies, (m, bodies, 3) each.
    """
    own = torch.einsum("mbij,bj->mbi", body_wrench_regressor(k), theta)
    first = int(tree.floating)
    total = list(own.unbind(dim=1))
    for j in reversed(range(tree.n)):
        i = tree.parent[j]
        if i != BASE or tree.floating:
            on_parent = to_parent(total[j + first][..., None], q[:, j], lam[j], tree.slides[j])
            total[i + first] = total[i + first] + on_parent[..., 0]
    return torch.stack(total, dim=1)


def torques(tree: Tree, wrench: Tensor) -> Tensor:
    """τ (m, rows) from wrenches (m, bodies, 6) (eq. 16); base wrench first if it floats."""
    first, axes = int(tree.floating), [FORCE_Z if x else MOMENT_Z for x in tree.slides]
    own = wrench[:, range(first, tree.bodies), axes]
    return torch.cat([wrench[:, 0], own], dim=1) if first else own


def inverse_dynamics(
    tree: Tree, lam: Tensor, theta: Tensor, joints: Joints, base: Tensor | FrameMotion
) -> Tensor:
    """τ (m, rows), N m; the base's wrench [f; m] in its frame first if it floats (eq. 5).

    Args:
        tree: N and A.
        lam: (n, 6) λ.
        theta: (bodies, 10) θ.
        joints: q, dq, ddq.
        base: gravity (3,) in base axes or the base's motion, see `base_motion`.
    """
    k = link_motion(tree, lam, joints, base)
    return torques(tree, wrenches(tree, lam, theta, joints[0], k))


def bodies_on(tree: Tree) -> list[list[int]]:
    """For every body (row of θ) itself and what hangs on it, in `wrench_regressors`' order."""
    first = int(tree.floating)
    found = [[body] for body in range(tree.bodies)]
    for j in reversed(range(tree.n)):
        if tree.parent[j] != BASE or tree.floating:
            found[tree.parent[j] + first] += found[j + first]
    return found


def wrench_regressors(tree: Tree, lam: Tensor, q: Tensor, k: FrameMotion) -> list[Tensor]:
    """For every body W (m, 6, 10 b): its total wrench is W times the θ of the b `bodies_on` it.

    Eqs. 11 to 14, linear in θ; arguments as for `wrenches`.
    """
    first = int(tree.floating)
    wide = list(body_wrench_regressor(k).unbind(dim=1))
    for j in reversed(range(tree.n)):
        i = tree.parent[j]
        if i != BASE or tree.floating:
            above = to_parent(wide[j + first], q[:, j], lam[j], tree.slides[j])
            wide[i + first] = torch.cat([wide[i + first], above], dim=2)
    return wide


def regressor(tree: Tree, lam: Tensor, joints: Joints, base: Tensor | FrameMotion) -> Tensor:
    """Y (m, rows, 10 bodies): τ = Y θ with θ's rows one after the other.

    Arguments as for `inverse_dynamics`.
    """
    q = joints[0]
    k = link_motion(tree, lam, joints, base)
    Y = q.new_zeros((len(q), tree.rows, tree.bodies, PER_BODY))
    wide = wrench_regressors(tree, lam, q, k)
    for body, seen in enumerate(bodies_on(tree)):
        W = wide[body].unflatten(2, (len(seen), PER_BODY))
        if body < tree.bodies - tree.n:
            Y[:, :6, seen] = W
        else:
            slides = tree.slides[body - int(tree.floating)]
            Y[:, body + tree.rows - tree.bodies, seen] = W[:, FORCE_Z if slides else MOMENT_Z]
    return Y.flatten(2)


def theta_from_log_cholesky_torch(x: Tensor) -> Tensor:
    """Parameters (..., 10) of log-Cholesky vectors [α d1 d2 d3 s12 s23 s13 t1 t2 t3] (..., 10).

    The pseudo-inertia is J = U Uᵀ with U = e^α [[e^d1 s12 s13 t1], [0 e^d2 s23 t2],
    [0 0 e^d3 t3], [0 0 0 1]] (Rucker and Wensing 2022): every vector is a possible body.
    """
    a, d1, d2, d3 = (torch.exp(x[..., k]) for k in range(4))
    s12, s23, s13, t1, t2, t3 = (x[..., k] for k in range(4, 10))
    # Second moments ∫ r rᵀ dm over e^{2α}: the upper left block of U Uᵀ.
    xx = d1 * d1 + s12 * s12 + s13 * s13 + t1 * t1
    yy = d2 * d2 + s23 * s23 + t2 * t2
    zz = d3 * d3 + t3 * t3
    xy = s12 * d2 + s13 * s23 + t1 * t2
    xz = s13 * d3 + t1 * t3
    yz = s23 * d3 + t2 * t3
    parts = [torch.ones_like(a), t1, t2, t3, yy + zz, -xy, -xz, xx + zz, -yz, xx + yy]
    return torch.stack(parts, dim=-1) * (a * a)[..., None]


def theta_from_log_cholesky(vector: ArrayLike) -> Array:
    """As `theta_from_log_cholesky_torch`, for arrays."""
    x = torch.from_numpy(np.array(vector, dtype=np.float64))
    return np.asarray(theta_from_log_cholesky_torch(x).numpy())
