"""λ the paper's way (eq. 18): N independent networks, mini-batches, from random starts.

Every joint's network takes its parent's measured motion, so all joints, and several starts of
each, are one batch of tensors. A first-order descent crawls where a link's motion shows one
direction of its frame far less than another, and ends wherever its rate has run out; with 6
unknowns a joint, Gauss-Newton's curvature costs next to nothing, and its recursive form (the
curvature a running mean over mini-batches, the step as much of Newton's as the newest batch is of
the mean) goes down alike in all directions.

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

from adapter.errors import ModelError
from adapter.learning.tree_data import TreeData, check_motion
from adapter.model.spatial import Array, matrix_from_zxz, zxz_from_matrix
from adapter.model.tree import BASE
from adapter.physics.networks import skew, turn_z

# A cost below this share of the signal's is rounding: motion right to 1e-8 of its size.
ROUNDING = 1e-16
# A frame is at its minimum where Newton's step would take off less than this share of the cost;
# the last digits of a descent by mini-batches take off 1e-3 or less.
STATIONARY = 0.05
# ... and the minimum is the frame's where it leaves less than this share of the signal: noise
# leaves far less, a wrong frame (a saddle) the better part.
UNEXPLAINED = 0.05
# Added to a curvature whose diagonal is 1: where samples show nothing, nothing moves.
LEVENBERG = 1e-10
POSITION_SPAN = 0.5  # starting positions are uniform within ± this, m; angles within ±π


@dataclass(frozen=True)
class NetworkSettings:
    """How eq. 18 is descended.

    Attributes:
        minibatch: samples an iteration; cycles: passes over all samples (the paper: 10 and 10).
        starts: random starts of each joint, the best of which is kept: a rotation can start
            close to a saddle.
        gain: weight of the newest batch in slope and curvature, above 0 and at most 1.
        constant: share of the iterations (0 to 1) in which it stays; then it falls so that all
            later batches count alike, which averages noise out.
        snapshots: iterations ("epochs") at which λ is kept, beside the last.
    """

    minibatch: int = 10
    cycles: int = 10
    starts: int = 6
    gain: float = 0.3
    constant: float = 0.5
    snapshots: tuple[int, ...] = (0, 50, 100)


@dataclass
class NetworkResult:
    """What the networks learned.

    Attributes:
        lam: (n, 6) λ at the end, of the best start of each joint; angles are canonical.
        snapshots: λ (n, 6) of those starts by epoch, the last one included.
        loss: (epochs,) mean cost of the batch over joints, of those starts.
        final_loss: (n, starts) mean cost over all samples of every start at the end.
        converged: (n,) bool, whether the joint's cost is rounding, or at a minimum that leaves
            what noise may leave; λ of other joints is the best found and may be far off.
    """

    lam: Array
    snapshots: dict[int, Array]
    loss: Array
    final_loss: Array
    converged: np.ndarray


def schema_by_networks(
    data: TreeData, seed: int = 0, settings: NetworkSettings | None = None
) -> NetworkResult:
    """λ by stochastic descent of eq. 18, all joints at once.

    Args:
        data: with measured motion of the links.
        seed: of the starts and of the order of the samples.
        settings: see `NetworkSettings`.

    Raises:
        ModelError: no link motion, fewer samples than a mini-batch, numbers that are not finite.
    """
    settings = settings or NetworkSettings()
    if data.links is None:
        raise ModelError("the body schema is learned from the links' motion, and none is given")
    if len(data) < settings.minibatch:
        raise ModelError(
            f"{len(data)} samples don't fill a mini-batch of {settings.minibatch}; give more"
        )
    check_motion(data)
    signals = network_signals(data, _channels(data))
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-np.pi, np.pi, (data.tree.n, settings.starts, 3))
    p = rng.uniform(-POSITION_SPAN, POSITION_SPAN, angles.shape)
    frames = StartFrames(torch.from_numpy(matrix_from_zxz(angles)), torch.from_numpy(p))
    batches = len(data) // settings.minibatch  # of a cycle; a rest is left out
    total = settings.cycles * batches
    kept, losses = {}, np.empty((total, data.tree.n, settings.starts))
    curvature, gain = torch.zeros(()), 1.0
    for epoch in range(total):
        if epoch % batches == 0:
            order = rng.permutation(len(data))[: batches * settings.minibatch]
            shuffled = order.reshape(batches, settings.minibatch)
        if epoch in settings.snapshots:
            kept[epoch] = _lam(frames)
        batch = signals.take(shuffled[epoch % batches])
        cost, slope, own = slope_and_curvature(frames, batch)
        # the newest batch weighs 1, 1/2, 1/3, ... down to `gain`, and on so where that may fall
        least = settings.gain if epoch / total < settings.constant else 0.0
        gain = max(least, gain / (1.0 + gain)) if epoch else 1.0
        curvature = (1.0 - gain) * curvature + gain * own
        step = (gain * newton_step(slope, curvature)).unflatten(-1, (2, 3))
        length = step.norm(dim=-1, keepdim=True)  # of the turn and of the shift
        share = (0.05 / length.clamp_min(1e-300)).clamp_max(1.0)  # of an iteration, rad and m
        frames = frames.moved((step * share).flatten(-2))
        losses[epoch] = cost.numpy()
    kept[total] = _lam(frames)
    final = costs(frames, signals).numpy()
    joints, best = np.arange(data.tree.n), final.argmin(axis=1)
    chosen = {epoch: x[joints, best] for epoch, x in kept.items()}
    found = StartFrames(frames.r0[joints, best][:, None], frames.p[joints, best][:, None])
    loss = losses[:, joints, best].mean(axis=1)
    cost, slope, curvature = slope_and_curvature(found, signals)
    left = -0.5 * (slope * newton_step(slope, curvature)).sum(dim=-1)
    power = signals.power()[:, None]
    at_minimum = (left <= STATIONARY * cost) & (cost <= UNEXPLAINED * power)
    converged = ((cost <= ROUNDING * power) | at_minimum)[:, 0].numpy()
    return NetworkResult(chosen[total], chosen, loss, final, converged)


def _channels(data: TreeData) -> list[str]:
    """What is compared of w, v and a: the latter only where twists can't show every frame (no
    measured v, or a base at rest)."""
    assert data.links is not None
    with_speed = data.links.v is not None and data.base.v is not None
    by_twist = with_speed and data.tree.floating
    return ["w", *(["v"] if with_speed else []), *([] if by_twist else ["a"])]


def _lam(frames: StartFrames) -> Array:
    """λ (n, starts, 6) with canonical angles."""
    return np.concatenate([zxz_from_matrix(frames.r0.numpy()), frames.p.numpy()], axis=-1)


# --- the networks of all joints and starts as one batch of tensors ------------------------------


@dataclass
class NetworkSignals:
    """What the networks of n joints compare, over m samples and c channels.

    Attributes:
        y: (m, n, c, 3) of the link, turned by Rz(q).
        z: (m, n, c, 3) of its parent; w: (m, n, c, 3, 3) what carries p.
    """

    y: Tensor
    z: Tensor
    w: Tensor

    def take(self, rows: Array) -> NetworkSignals:
        """Some of the samples."""
        index = torch.from_numpy(rows)
        return NetworkSignals(self.y[index], self.z[index], self.w[index])

    def power(self) -> Tensor:
        """Half the mean square (n,) of y."""
        return 0.5 * (self.y**2).sum(dim=(2, 3)).mean(dim=0)


@dataclass
class StartFrames:
    """Frames of n joints, several starts of each: r0 (n, starts, 3, 3), p (n, starts, 3)."""

    r0: Tensor
    p: Tensor

    def moved(self, step: Tensor) -> StartFrames:
        """The frames after (turn, shift) (n, starts, 6) in the parent's axes."""
        angle = step[..., :3].norm(dim=-1)[..., None, None]
        k = skew(step[..., :3])
        half = torch.sinc(angle / (2.0 * torch.pi))
        turn = torch.eye(3, dtype=k.dtype) + torch.sinc(angle / torch.pi) * k
        turn = turn + 0.5 * half**2 * (k @ k)
        return StartFrames(turn @ self.r0, self.p + step[..., 3:])


def network_signals(data: TreeData, channels: Sequence[str]) -> NetworkSignals:
    """NetworkSignals of all joints; the joint's own speed is taken off as eq. 8b has it.

    Args:
        data: with measured motion of the links.
        channels: of "w", "v" and "a" (eqs. 8b, 8a, 8c).
    """
    assert data.links is not None
    q = torch.from_numpy(np.ascontiguousarray(data.q))
    up, parents = {}, [i - BASE for i in data.tree.parent]
    for name in {"w", "dw", *channels}:
        bodies = getattr(data.base, name)[:, None], getattr(data.links, name)
        every = np.concatenate(bodies, axis=1)[:, parents]
        up[name] = torch.from_numpy(np.ascontiguousarray(every))
    spin = skew(up["w"])
    carried = {"w": torch.zeros_like(spin), "v": spin, "a": skew(up["dw"]) + spin @ spin}
    y = []
    for name in channels:
        own = torch.from_numpy(np.array(getattr(data.links, name)))
        if name == "w":
            own[:, :, 2] -= torch.from_numpy(data.dq)
        y.append(turn_z(q, own))
    z, w = [up[name] for name in channels], [carried[name] for name in channels]
    return NetworkSignals(*(torch.stack(parts, dim=2) for parts in (y, z, w)))


def residuals(frames: StartFrames, s: NetworkSignals) -> tuple[Tensor, Tensor]:
    """R0 y - z - W p and R0 y, (n, starts, m c, 3) each."""
    n, starts = frames.p.shape[:2]
    y, z = (x.transpose(0, 1).reshape(n, 1, -1, 3) for x in (s.y, s.z))
    turned = y @ frames.r0.transpose(-1, -2)
    lever = s.w.transpose(0, 1).reshape(n, -1, 3) @ frames.p.transpose(1, 2)
    lever = lever.reshape(n, -1, 3, starts).movedim(-1, 1)
    return turned - z - lever, turned


def costs(frames: StartFrames, s: NetworkSignals) -> Tensor:
    """Half the mean squared error (n, starts) over samples (eq. 18)."""
    return 0.5 * (residuals(frames, s)[0] ** 2).sum(dim=(2, 3)) / len(s.y)


def slope_and_curvature(frames: StartFrames, s: NetworkSignals) -> tuple[Tensor, Tensor, Tensor]:
    """`costs`, their gradient (n, starts, 6) and Gauss-Newton's curvature (n, starts, 6, 6)."""
    left, turned = residuals(frames, s)
    n, starts = frames.p.shape[:2]
    by_turn = -skew(turned).flatten(2, 3)
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
