"""The dynamics network: link motion and θ into wrenches and joint torques (paper, eqs. 11-16).

Linear in θ: τ = Y θ. Eq. 13 is used with its printing error mended (first row w_x w_y w_z), eq.
14c sums over the links that hang on link j, whatever their numbers. Wrenches are [f; m].
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from adapter.kinematics import DTYPE, Motion, joint_rotation, link_motion
from adapter.tree import BASE, Tree

MOMENT_Z = 5  # place of the moment about the joint axis in a wrench [f; m], eq. 16


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


def body_regressor(k: Motion) -> Tensor:
    """W (..., 6, 10): wrench [f; m] at the frame's origin = W θ (eqs. 11, 12)."""
    cross = skew(k.w)
    force = torch.cat(
        [k.a[..., None], skew(k.dw) + cross @ cross, k.a.new_zeros((*k.a.shape, 6))], dim=-1
    )
    moment = torch.cat(
        [torch.zeros_like(k.a)[..., None], -skew(k.a), bullet(k.dw) + cross @ bullet(k.w)], dim=-1
    )
    return torch.cat([force, moment], dim=-2)


def to_parent(wrench: Tensor, q_j: Tensor, lam_j: Tensor) -> Tensor:
    """T_j w: a wrench at frame j, (m, 6, ...), as one at frame i (eq. 14a)."""
    r0 = joint_rotation(lam_j)
    cos, sin = torch.cos(q_j), torch.sin(q_j)
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    turn = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1)
    rotation = r0 @ turn.reshape(-1, 3, 3)
    force = rotation @ wrench[:, :3]
    return torch.cat([force, rotation @ wrench[:, 3:] + skew(lam_j[3:]) @ force], dim=1)


def wrenches(tree: Tree, lam: Tensor, theta: Tensor, q: Tensor, k: Motion) -> Tensor:
    """Total wrench [f; m] on every body, (m, bodies, 6), in its frame (eqs. 14c, 15).

    Args:
        tree: N and A.
        lam: (n, 6) λ.
        theta: (bodies, 10) θ.
        q: (m, n) joint angles, rad.
        k: motion of the bodies, (m, bodies, 3) each.
    """
    own = torch.einsum("mbij,bj->mbi", body_regressor(k), theta)
    first = int(tree.floating)
    total = list(own.unbind(dim=1))
    for j in reversed(range(tree.n)):
        i = tree.parent[j]
        if i != BASE or tree.floating:
            on_parent = to_parent(total[j + first][..., None], q[:, j], lam[j])[..., 0]
            total[i + first] = total[i + first] + on_parent
    return torch.stack(total, dim=1)


def torques(tree: Tree, wrench: Tensor) -> Tensor:
    """τ (m, rows) from wrenches (m, bodies, 6) (eq. 16); base wrench first if it floats."""
    if tree.floating:
        return torch.cat([wrench[:, 0], wrench[:, 1:, MOMENT_Z]], dim=1)
    return wrench[..., MOMENT_Z]


def inverse_dynamics(
    tree: Tree,
    lam: Tensor,
    theta: Tensor,
    q: Tensor,
    dq: Tensor,
    ddq: Tensor,
    base: Tensor | Motion,
) -> Tensor:
    """τ (m, rows), N m; the base's wrench [f; m] in its frame first if it floats (eq. 5).

    Args:
        tree: N and A.
        lam: (n, 6) λ.
        theta: (bodies, 10) θ.
        q: (m, n) joint angles, rad; dq (rad/s) and ddq (rad/s²) likewise.
        base: gravity (3,) in base axes or the base's Motion, see `kinematics.base_motion`.
    """
    k = link_motion(tree, lam, q, dq, ddq, base)
    return torques(tree, wrenches(tree, lam, theta, q, k))


def regressor(
    tree: Tree, lam: Tensor, q: Tensor, dq: Tensor, ddq: Tensor, base: Tensor | Motion
) -> Tensor:
    """Y (m, rows, 10 bodies): τ = Y θ with θ's rows one after the other; arguments as above."""
    own = body_regressor(link_motion(tree, lam, q, dq, ddq, base)).unbind(dim=1)
    first = int(tree.floating)
    columns = []
    for body, block in enumerate(own):
        rows: list[Tensor | None] = [None] * tree.n
        j = body - first
        while j != BASE:
            rows[j] = block[:, MOMENT_Z : MOMENT_Z + 1]
            if tree.parent[j] != BASE or tree.floating:
                block = to_parent(block, q[:, j], lam[j])
            j = tree.parent[j]
        nothing = block.new_zeros((block.shape[0], 1, block.shape[2]))
        joint_rows = [nothing if row is None else row for row in rows]
        columns.append(torch.cat(([block] if tree.floating else []) + joint_rows, dim=1))
    return torch.cat(columns, dim=2)


class DynamicsNetwork(nn.Module):
    """The networks of eqs. 5b and 5c, with θ as the parameter `theta` (bodies, 10)."""

    def __init__(self, tree: Tree, theta: Tensor | None = None) -> None:
        """Built from the tree; `theta` starts at zero where not given."""
        super().__init__()
        self.tree = tree
        start = torch.zeros(tree.bodies, 10, dtype=DTYPE) if theta is None else theta
        self.theta = nn.Parameter(torch.as_tensor(start).to(DTYPE).clone())

    def wrenches(self, lam: Tensor, q: Tensor, k: Motion) -> Tensor:
        """Total wrench on every body (m, bodies, 6), see `wrenches`."""
        return wrenches(self.tree, lam, self.theta, q, k)

    def forward(self, lam: Tensor, q: Tensor, k: Motion) -> Tensor:
        """τ (m, rows) from λ (n, 6), joint angles (m, n) and the kinematics network's output."""
        return torques(self.tree, self.wrenches(lam, q, k))


def theta_from_log_cholesky_torch(x: Tensor) -> Tensor:
    """As `inertia.theta_from_log_cholesky`, differentiable; (..., 10) in and out."""
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
