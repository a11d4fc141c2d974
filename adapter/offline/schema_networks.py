"""λ the paper's way (eq. 18): N independent networks, mini-batches, ADAM, from random starts.

Every joint's network takes its parent's measured motion, so all joints, and several starts of
each, are one batch of tensors. Compared are the measured and the estimated twist turned by
Rz(q_j), which changes no squared error and leaves R0 and p as all that varies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from adapter.errors import ModelError
from adapter.kinematics import joint_rotation, turn_z
from adapter.spatial import Array, matrix_from_zxz, zxz_from_matrix
from adapter.tree import BASE
from adapter.tree_data import BodyMotion, TreeData

# Called after every iteration with its number and the mean cost of the batch.
Callback = Callable[[int, float], None]


@dataclass(frozen=True)
class NetworkSettings:
    """How eq. 18 is descended.

    Attributes:
        minibatch: samples an iteration; cycles: passes over all samples (the paper: 10 and 10).
        starts: random starts of each joint, the best of which is kept: a rotation can start
            close to a saddle.
        first_rate, last_rate: ADAM's rate at the start and at the end, rad and m; it falls
            by a constant factor an iteration after `constant` of the iterations.
        betas: ADAM's averaging constants; the second is short because gradients shrink by decades.
        position_span: starting positions are uniform within ± this, m; angles within ±π.
        accelerations: whether accelerations are compared beside the twist. None: only where
            twists can't show every frame (no measured v, or a base at rest).
        snapshots: iterations ("epochs") at which λ is kept, beside the last.
    """

    minibatch: int = 10
    cycles: int = 10
    starts: int = 6
    first_rate: float = 0.03
    constant: float = 0.15
    last_rate: float = 1e-10
    betas: tuple[float, float] = (0.9, 0.95)
    position_span: float = 0.5
    accelerations: bool | None = None
    snapshots: tuple[int, ...] = (0, 50, 100)

    def __post_init__(self) -> None:
        for name in ("minibatch", "cycles", "starts"):
            if getattr(self, name) < 1:
                raise ModelError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0.0 < self.last_rate <= self.first_rate:
            raise ModelError(
                f"rates must be above zero and fall, got {self.first_rate} to {self.last_rate}"
            )


@dataclass
class NetworkResult:
    """What the networks learned.

    Attributes:
        lam: (n, 6) λ at the end, of the best start of each joint; angles are canonical.
        snapshots: λ (n, 6) of those starts by epoch, the last one included.
        loss: (epochs,) mean cost of the batch over joints, of those starts.
        final_loss: (n, starts) mean cost over all samples of every start at the end.
    """

    lam: Array
    snapshots: dict[int, Array]
    loss: Array
    final_loss: Array


@dataclass
class _Signals:
    """What the networks compare, (m, n, 3) each: y of link j turned by Rz(q_j), x of its parent."""

    y: dict[str, Tensor] = field(default_factory=dict)
    x: dict[str, Tensor] = field(default_factory=dict)

    def rows(self, rows: Tensor) -> _Signals:
        return _Signals(
            {k: t[rows] for k, t in self.y.items()}, {k: t[rows] for k, t in self.x.items()}
        )


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
        ModelError: no link motion, fewer samples than a mini-batch.
    """
    settings = settings or NetworkSettings()
    if data.links is None:
        raise ModelError("the body schema is learned from the links' motion, and none is given")
    if len(data) < settings.minibatch:
        raise ModelError(
            f"{len(data)} samples don't fill a mini-batch of {settings.minibatch}; give more"
        )
    signals = _signals(data, settings)
    rng = np.random.default_rng(seed)
    lam = torch.from_numpy(_random_starts(data.tree.n, settings, rng)).requires_grad_()
    total = settings.cycles * (len(data) // settings.minibatch)
    optimiser = torch.optim.Adam([lam], lr=settings.first_rate, betas=settings.betas, eps=1e-300)
    kept, losses = {}, np.empty((total, *lam.shape[:2]))
    for epoch, rows in enumerate(_batches(len(data), settings, rng)):
        if epoch in settings.snapshots:
            kept[epoch] = lam.detach().numpy().copy()
        optimiser.param_groups[0]["lr"] = _rate(settings, epoch / total)
        optimiser.zero_grad()
        cost = _costs(lam, signals.rows(torch.from_numpy(rows)))
        cost.sum().backward()
        optimiser.step()
        losses[epoch] = cost.detach().numpy()
        if callback is not None:
            callback(epoch, float(losses[epoch].min(axis=1).mean()))
    kept[total] = lam.detach().numpy().copy()
    with torch.no_grad():
        final = _costs(lam, signals).numpy()
    joints, best = np.arange(data.tree.n), final.argmin(axis=1)
    chosen = {epoch: _canonical(x[joints, best]) for epoch, x in kept.items()}
    return NetworkResult(chosen[total], chosen, losses[:, joints, best].mean(axis=1), final)


def _signals(data: TreeData, settings: NetworkSettings) -> _Signals:
    """The compared signals of all joints; joint axis and dq taken off as eq. 8b has them."""
    assert data.links is not None
    with_speed = data.links.v is not None and data.base.v is not None
    accelerations = settings.accelerations
    if accelerations is None:
        accelerations = not (with_speed and data.tree.floating)
    q = torch.from_numpy(np.ascontiguousarray(data.q))
    out = _Signals()
    names = ["w", *(["v"] if with_speed else []), *(["a", "dw"] if accelerations else [])]
    for name in names:
        own = torch.from_numpy(np.array(getattr(data.links, name)))
        if name == "w":
            own[:, :, 2] -= torch.from_numpy(data.dq)
        out.x[name] = _of_parents(data.tree.parent, data.base, data.links, name)
        if name != "dw":  # of 8d only the parent's part is used: it carries p in 8c
            out.y[name] = turn_z(q, own)
    return out


def _of_parents(parent: tuple[int, ...], base: BodyMotion, links: BodyMotion, name: str) -> Tensor:
    """A signal (m, n, 3) of the parent of every joint."""
    every = np.concatenate([getattr(base, name)[:, None], getattr(links, name)], axis=1)
    return torch.from_numpy(np.ascontiguousarray(every[:, [i - BASE for i in parent]]))


def _costs(lam: Tensor, s: _Signals) -> Tensor:
    """Half the mean squared error (n, starts) of λ (n, starts, 6) over samples (eq. 18)."""
    r0, p = joint_rotation(lam), lam[..., 3:]

    def gap(name: str, z: Tensor) -> Tensor:
        """|y - R0^T z|² for z (m, n, starts, 3)."""
        turned = torch.einsum("mnsa,nsab->mnsb", z, r0)
        return ((s.y[name][:, :, None] - turned) ** 2).sum(dim=-1)

    x = {name: t[:, :, None] for name, t in s.x.items()}
    w = x["w"].expand(*x["w"].shape[:2], lam.shape[1], 3)
    total = gap("w", w)
    lever = torch.linalg.cross(w, p.expand_as(w))
    if "v" in s.y:
        total = total + gap("v", x["v"] + lever)  # 8a
    if "a" in s.y:
        swing = torch.linalg.cross(x["dw"].expand_as(w), p.expand_as(w))
        total = total + gap("a", x["a"] + swing + torch.linalg.cross(w, lever))  # 8c
    return 0.5 * total.mean(dim=0)


def _random_starts(n: int, settings: NetworkSettings, rng: np.random.Generator) -> Array:
    """λ (n, starts, 6): uniform angles, positions within ± the span."""
    shape = (n, settings.starts, 3)
    angles = rng.uniform(-np.pi, np.pi, shape)
    return np.concatenate(
        [angles, rng.uniform(-settings.position_span, settings.position_span, shape)], axis=-1
    )


def _batches(
    count: int, settings: NetworkSettings, rng: np.random.Generator
) -> Iterator[np.ndarray]:
    """Rows of every mini-batch of every cycle, shuffled anew each cycle; a rest is left out."""
    whole = count // settings.minibatch
    for _ in range(settings.cycles):
        order = rng.permutation(count)[: whole * settings.minibatch]
        yield from order.reshape(whole, settings.minibatch)


def _rate(settings: NetworkSettings, done: float) -> float:
    """ADAM's rate after a share of the iterations."""
    left = max(0.0, done - settings.constant) / (1.0 - settings.constant)
    return settings.first_rate * float((settings.last_rate / settings.first_rate) ** left)


def _canonical(lam: Array) -> Array:
    """The same frames with canonical angles."""
    angles = zxz_from_matrix(matrix_from_zxz(lam[..., :3]))
    return np.concatenate([angles, lam[..., 3:]], axis=-1)
