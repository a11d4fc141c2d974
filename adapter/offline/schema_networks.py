"""λ the paper's way (eq. 18): N independent networks, mini-batches, from random starts.

Every joint's network takes its parent's measured motion, so all joints, and several starts of
each, are one batch of tensors. A first-order descent crawls where a link's motion shows one
direction of its frame far less than another, and ends wherever its rate has run out; with 6
unknowns a joint, Gauss-Newton's curvature costs next to nothing, and its recursive form (the
curvature a running mean over mini-batches, the step as much of Newton's as the newest batch is of
the mean) goes down alike in all directions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from adapter.errors import ModelError
from adapter.offline.finite import check_motion
from adapter.offline.frame_networks import (
    Frames,
    Signals,
    costs,
    network_signals,
    newton_step,
    slope_and_curvature,
)
from adapter.spatial import Array, matrix_from_zxz, zxz_from_matrix
from adapter.tree_data import TreeData

# Called after every iteration with its number and the mean cost of the batch.
Callback = Callable[[int, float], None]

# A cost below this share of the signal's is rounding: motion right to 1e-8 of its size.
ROUNDING = 1e-16
# A frame is at its minimum where Newton's step would take off less than this share of the cost;
# the last digits of a descent by mini-batches take off 1e-3 or less.
STATIONARY = 0.05
# ... and the minimum is the frame's where it leaves less than this share of the signal: noise
# leaves far less, a wrong frame (a saddle) the better part.
UNEXPLAINED = 0.05


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
        longest_step: of an iteration, rad and m.
        position_span: starting positions are uniform within ± this, m; angles within ±π.
        accelerations: whether accelerations are compared beside the twist. None: only where
            twists can't show every frame (no measured v, or a base at rest).
        snapshots: iterations ("epochs") at which λ is kept, beside the last.
    """

    minibatch: int = 10
    cycles: int = 10
    starts: int = 6
    gain: float = 0.3
    constant: float = 0.5
    longest_step: float = 0.05
    position_span: float = 0.5
    accelerations: bool | None = None
    snapshots: tuple[int, ...] = (0, 50, 100)

    def __post_init__(self) -> None:
        for name in ("minibatch", "cycles", "starts"):
            if getattr(self, name) < 1:
                raise ModelError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0.0 < self.gain <= 1.0:
            raise ModelError(f"gain must be above 0 and at most 1, got {self.gain}")
        if not 0.0 <= self.constant <= 1.0:
            raise ModelError(f"constant must be a share, 0 to 1, got {self.constant}")
        for name in ("longest_step", "position_span"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ModelError(f"{name} must be above 0 and finite, got {getattr(self, name)}")
        if any(epoch < 0 for epoch in self.snapshots):
            raise ModelError(f"snapshots are iterations from 0 on, got {self.snapshots}")


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
    data: TreeData,
    seed: int = 0,
    settings: NetworkSettings | None = None,
    callback: Callback | None = None,
) -> NetworkResult:
    """λ by stochastic descent of eq. 18, all joints at once.

    Args:
        data: with measured motion of the links.
        seed: of the starts and of the order of the samples.
        settings: see `NetworkSettings`.
        callback: told of every iteration.

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
    signals = network_signals(data, _channels(data, settings))
    rng = np.random.default_rng(seed)
    frames = _random_starts(data.tree.n, settings, rng)
    total = settings.cycles * (len(data) // settings.minibatch)
    kept, losses = {}, np.empty((total, data.tree.n, settings.starts))
    curvature, gain = torch.zeros(()), 1.0
    for epoch, rows in enumerate(_batches(len(data), settings, rng)):
        if epoch in settings.snapshots:
            kept[epoch] = _lam(frames)
        cost, slope, own = slope_and_curvature(frames, signals.take(rows))
        gain = _gain(settings, gain, epoch / total)
        curvature = (1.0 - gain) * curvature + gain * own
        frames = frames.moved(_shortened(gain * newton_step(slope, curvature), settings))
        losses[epoch] = cost.numpy()
        if callback is not None:
            callback(epoch, float(losses[epoch].min(axis=1).mean()))
    kept[total] = _lam(frames)
    final = costs(frames, signals).numpy()
    joints, best = np.arange(data.tree.n), final.argmin(axis=1)
    chosen = {epoch: x[joints, best] for epoch, x in kept.items()}
    found = Frames(frames.r0[joints, best][:, None], frames.p[joints, best][:, None])
    loss = losses[:, joints, best].mean(axis=1)
    return NetworkResult(chosen[total], chosen, loss, final, _converged(found, signals))


def _channels(data: TreeData, settings: NetworkSettings) -> list[str]:
    """What is compared of w, v and a."""
    assert data.links is not None
    with_speed = data.links.v is not None and data.base.v is not None
    accelerations = settings.accelerations
    if accelerations is None:
        accelerations = not (with_speed and data.tree.floating)
    return ["w", *(["v"] if with_speed else []), *(["a"] if accelerations else [])]


def _random_starts(n: int, settings: NetworkSettings, rng: np.random.Generator) -> Frames:
    """Uniform angles, positions within ± the span."""
    angles = rng.uniform(-np.pi, np.pi, (n, settings.starts, 3))
    p = rng.uniform(-settings.position_span, settings.position_span, angles.shape)
    return Frames(torch.from_numpy(matrix_from_zxz(angles)), torch.from_numpy(p))


def _batches(
    count: int, settings: NetworkSettings, rng: np.random.Generator
) -> Iterator[np.ndarray]:
    """Rows of every mini-batch of every cycle, shuffled anew each cycle; a rest is left out."""
    whole = count // settings.minibatch
    for _ in range(settings.cycles):
        order = rng.permutation(count)[: whole * settings.minibatch]
        yield from order.reshape(whole, settings.minibatch)


def _gain(settings: NetworkSettings, last: float, done: float) -> float:
    """Weight of the newest batch: 1, 1/2, 1/3, ... to `gain`, and on so where it is to fall."""
    least = settings.gain if done < settings.constant else 0.0
    return max(least, last / (1.0 + last)) if done > 0.0 else 1.0


def _shortened(step: torch.Tensor, settings: NetworkSettings) -> torch.Tensor:
    """Turn and shift (..., 6) no longer than the longest step each."""
    both = step.unflatten(-1, (2, 3))
    length = both.norm(dim=-1, keepdim=True)
    share = (settings.longest_step / length.clamp_min(1e-300)).clamp_max(1.0)
    return (both * share).flatten(-2)


def _converged(frames: Frames, signals: Signals) -> np.ndarray:
    """By joint (n,) of frames with one start each; see `NetworkResult`."""
    cost, slope, curvature = slope_and_curvature(frames, signals)
    gain = -0.5 * (slope * newton_step(slope, curvature)).sum(dim=-1)
    power = signals.power()[:, None]
    at_minimum = (gain <= STATIONARY * cost) & (cost <= UNEXPLAINED * power)
    return ((cost <= ROUNDING * power) | at_minimum)[:, 0].numpy()


def _lam(frames: Frames) -> Array:
    """λ (n, starts, 6) with canonical angles."""
    return np.concatenate([zxz_from_matrix(frames.r0.numpy()), frames.p.numpy()], axis=-1)
