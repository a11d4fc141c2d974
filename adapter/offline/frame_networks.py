"""The kinematics networks of all joints and starts as one batch of tensors, and their descent.

Turned into the parent's axes, eqs. 8a, 8b and 8c of joint j read `R0 y = z + W p`: y is link j's
measured motion turned by Rz(q_j), z and W are its parent's, and only R0 and p vary. So residuals
`R0 y - z - W p` and their derivatives, `-[R0 y]x` to a turn in the parent's axes and `-W` to a
shift, take a few products of tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from adapter.kinematics import turn_z
from adapter.spatial import Array
from adapter.tree import BASE
from adapter.tree_data import BodyMotion, TreeData

# Added to a curvature whose diagonal is 1: where samples show nothing, nothing moves.
LEVENBERG = 1e-10
# [x]× as a linear map of x: row a of the table (3, 9) is that of unit vector a.
_CROSS = torch.zeros(3, 3, 3, dtype=torch.float64)
for _a, _b, _c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _CROSS[_a, _c, _b], _CROSS[_a, _b, _c] = 1.0, -1.0
_CROSS = _CROSS.reshape(3, 9)


def cross_matrix(x: Tensor) -> Tensor:
    """[x]× (..., 3, 3) of vectors (..., 3)."""
    return (x @ _CROSS).unflatten(-1, (3, 3))


@dataclass
class Signals:
    """What the networks of n joints compare, over m samples and c channels.

    Attributes:
        y: (m, n, c, 3) of the link, turned by Rz(q).
        z: (m, n, c, 3) of its parent; w: (m, n, c, 3, 3) what carries p.
    """

    y: Tensor
    z: Tensor
    w: Tensor

    def take(self, rows: Array) -> Signals:
        """Some of the samples."""
        index = torch.from_numpy(rows)
        return Signals(self.y[index], self.z[index], self.w[index])

    def power(self) -> Tensor:
        """Half the mean square (n,) of y."""
        return 0.5 * (self.y**2).sum(dim=(2, 3)).mean(dim=0)


@dataclass
class Frames:
    """Frames of n joints, several starts of each: r0 (n, starts, 3, 3), p (n, starts, 3)."""

    r0: Tensor
    p: Tensor

    def moved(self, step: Tensor) -> Frames:
        """The frames after (turn, shift) (n, starts, 6) in the parent's axes."""
        angle = step[..., :3].norm(dim=-1)[..., None, None]
        k = cross_matrix(step[..., :3])
        half = torch.sinc(angle / (2.0 * torch.pi))
        turn = torch.eye(3, dtype=k.dtype) + torch.sinc(angle / torch.pi) * k
        turn = turn + 0.5 * half**2 * (k @ k)
        return Frames(turn @ self.r0, self.p + step[..., 3:])


def network_signals(data: TreeData, channels: Sequence[str]) -> Signals:
    """Signals of all joints; the joint's own speed is taken off as eq. 8b has it.

    Args:
        data: with measured motion of the links.
        channels: of "w", "v" and "a" (eqs. 8b, 8a, 8c).
    """
    assert data.links is not None
    q = torch.from_numpy(np.ascontiguousarray(data.q))
    up = {
        name: _of_parents(data.tree.parent, data.base, data.links, name)
        for name in {"w", "dw", *channels}
    }
    spin = cross_matrix(up["w"])
    carried = {"w": torch.zeros_like(spin), "v": spin, "a": cross_matrix(up["dw"]) + spin @ spin}
    y = []
    for name in channels:
        own = torch.from_numpy(np.array(getattr(data.links, name)))
        if name == "w":
            own[:, :, 2] -= torch.from_numpy(data.dq)
        y.append(turn_z(q, own))
    z, w = [up[name] for name in channels], [carried[name] for name in channels]
    return Signals(*(torch.stack(parts, dim=2) for parts in (y, z, w)))


def _of_parents(parent: tuple[int, ...], base: BodyMotion, links: BodyMotion, name: str) -> Tensor:
    """A signal (m, n, 3) of the parent of every joint."""
    every = np.concatenate([getattr(base, name)[:, None], getattr(links, name)], axis=1)
    return torch.from_numpy(np.ascontiguousarray(every[:, [i - BASE for i in parent]]))


def residuals(frames: Frames, s: Signals) -> tuple[Tensor, Tensor]:
    """R0 y - z - W p and R0 y, (n, starts, m c, 3) each."""
    n, starts = frames.p.shape[:2]
    y, z = (x.transpose(0, 1).reshape(n, 1, -1, 3) for x in (s.y, s.z))
    turned = y @ frames.r0.transpose(-1, -2)
    lever = s.w.transpose(0, 1).reshape(n, -1, 3) @ frames.p.transpose(1, 2)
    lever = lever.reshape(n, -1, 3, starts).movedim(-1, 1)
    return turned - z - lever, turned


def costs(frames: Frames, s: Signals) -> Tensor:
    """Half the mean squared error (n, starts) over samples (eq. 18)."""
    return 0.5 * (residuals(frames, s)[0] ** 2).sum(dim=(2, 3)) / len(s.y)


def slope_and_curvature(frames: Frames, s: Signals) -> tuple[Tensor, Tensor, Tensor]:
    """`costs`, their gradient (n, starts, 6) and Gauss-Newton's curvature (n, starts, 6, 6)."""
    left, turned = residuals(frames, s)
    n, starts = frames.p.shape[:2]
    by_turn = -cross_matrix(turned).flatten(2, 3)
    by_shift = -s.w.transpose(0, 1).reshape(n, 1, -1, 3).expand(n, starts, -1, 3)
    jacobian = torch.cat([by_turn, by_shift], dim=-1)
    across = jacobian.transpose(-1, -2) / len(s.y)
    flat = left.flatten(2)
    gradient = (across @ flat[..., None])[..., 0]
    return 0.5 * (flat**2).sum(dim=-1) / len(s.y), gradient, across @ jacobian


def newton_step(gradient: Tensor, curvature: Tensor) -> Tensor:
    """-curvature⁻¹ gradient (..., 6), still where the curvature is nothing."""
    size = torch.diagonal(curvature, dim1=-2, dim2=-1)
    floor = LEVENBERG * size.amax(dim=-1, keepdim=True).clamp_min(1e-300)
    scale = size.clamp_min(floor).rsqrt()
    scaled = curvature * scale[..., :, None] * scale[..., None, :]
    scaled = scaled + LEVENBERG * torch.eye(6, dtype=scaled.dtype)
    return -scale * torch.linalg.solve(scaled, scale * gradient)
