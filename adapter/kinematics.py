"""The kinematics network: joint signals and λ into the motion of every link (paper, eqs. 8-10).

Built from the tree alone, batched over samples, differentiable in everything. The equations are
numbered as in the paper; 8c, which its text lost, is the derivative of 8a:
a_j = Rᵀ (a_i + dw_i × p_j + w_i × (w_i × p_j)). All of link j in frame j, R = R_ij. Accelerations
`a` are those an accelerometer at the frame's origin reads (a_0 = -g on a base at rest), so that
gravity needs no further term anywhere.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from adapter.tree import BASE, Tree

DTYPE = torch.float64


class Motion(NamedTuple):
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

    def twist(self) -> Tensor:
        """[v; w], (..., 6)."""
        return torch.cat([self.v, self.w], dim=-1)

    def accel(self) -> Tensor:
        """[a; dw], (..., 6)."""
        return torch.cat([self.a, self.dw], dim=-1)


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


def link_step(parent: Motion, q_j: Tensor, dq_j: Tensor, ddq_j: Tensor, lam_j: Tensor) -> Motion:
    """k_j(k_i, q_j, dq_j, ddq_j; λ_j): the motion of link j from that of its parent (eq. 10a).

    Args:
        parent: motion of link i in frame i, (m, 3) each.
        q_j: (m,) joint angles, rad; dq_j (rad/s) and ddq_j (rad/s²) likewise.
        lam_j: (6,) λ_j = [α β γ p].

    Returns:
        Motion of link j in frame j, (m, 3) each.
    """
    v, w, a, dw = parent
    p = lam_j[3:].expand_as(w)
    r0 = joint_rotation(lam_j)
    cross = torch.linalg.cross

    def into_j(x: Tensor) -> Tensor:
        return turn_z(-q_j, x @ r0)  # R_ijᵀ x, eq. 9

    v_j = into_j(v + cross(w, p))  # 8a
    w_i = into_j(w)
    w_j = w_i + _along_z(dq_j)  # 8b
    a_j = into_j(a + cross(dw, p) + cross(w, cross(w, p)))  # 8c
    dw_j = into_j(dw) + cross(w_i, _along_z(dq_j)) + _along_z(ddq_j)  # 8d
    return Motion(v_j, w_j, a_j, dw_j)


def _along_z(x: Tensor) -> Tensor:
    zero = torch.zeros_like(x)
    return torch.stack([zero, zero, x], dim=-1)


def base_motion(base: Tensor | Motion, like: Tensor) -> Motion:
    """The motion k_0 of the base (m, 3) each: measured, or at rest under gravity.

    Args:
        base: a Motion with (m, 3) each, in the base's frame, its `a` with gravity (a - g); or
            the acceleration of gravity (3,) in base axes of a base at rest.
        like: (m, n) joint angles; number of samples, type and device are taken from it.
    """
    if isinstance(base, Motion):
        return base
    zero = like.new_zeros((like.shape[0], 3))
    return Motion(zero, zero, -base.to(like).expand_as(zero), zero)


def link_motion(
    tree: Tree, lam: Tensor, q: Tensor, dq: Tensor, ddq: Tensor, base: Tensor | Motion
) -> Motion:
    """Motion of every body, (m, bodies, 3) each (eq. 10b); the base first if it floats.

    Args:
        tree: N and A.
        lam: (n, 6) λ.
        q: (m, n) joint angles, rad; dq (rad/s) and ddq (rad/s²) likewise.
        base: gravity (3,) or the base's Motion, see `base_motion`.
    """
    k_base = base_motion(base, q)
    k: list[Motion] = []
    for j, i in enumerate(tree.parent):
        parent = k_base if i == BASE else k[i]
        k.append(link_step(parent, q[:, j], dq[:, j], ddq[:, j], lam[j]))
    bodies = [k_base, *k] if tree.floating else k
    return Motion(*(torch.stack(list(part), dim=1) for part in zip(*bodies, strict=True)))


class KinematicsNetwork(nn.Module):
    """The network of eq. 5a: k = f(q, dq, ddq; N, A, λ), with λ as its parameter `lam` (n, 6)."""

    def __init__(self, tree: Tree, lam: Tensor | None = None) -> None:
        """Built from the tree; `lam` starts at zero where not given."""
        super().__init__()
        self.tree = tree
        start = torch.zeros(tree.n, 6, dtype=DTYPE) if lam is None else torch.as_tensor(lam)
        self.lam = nn.Parameter(start.to(DTYPE).clone())

    def forward(self, q: Tensor, dq: Tensor, ddq: Tensor, base: Tensor | Motion) -> Motion:
        """Motion of every body, see `link_motion`."""
        return link_motion(self.tree, self.lam, q, dq, ddq, base)
