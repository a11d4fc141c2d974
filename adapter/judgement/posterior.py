"""What rows of recordings say of an arm: a Gaussian posterior under held priors.

    tau = model + Y dθ + Y_n load + offset + Fc s(dq) + Fv dq + B ddq + k q + static + noise

The noise is what the model leaves: the sensors' and a misfit that keeps its sign for a while. Its
size and memory come from the data, by joint, so that a model that fits badly says so by its
standard deviations instead of by wrong bodies. Rows enter by products, which add over pieces and
recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.effects.by_joint import smooth_sign
from adapter.effects.torque import ModelTorque
from adapter.judgement.noise import MEMORY_S, memory_s
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.likelihood import SMOOTHING_S, Rows, by_joint, noise_nm, sensor_nm

ROUNDS = 12  # of noise after fit; it settles in five
SEGMENTS = 10  # of a recording, in any of which something may change


@dataclass(frozen=True, eq=False)
class Moments:
    """Rows of a recording, by products of their columns, in segments of its time or in all of it.

    Attributes:
        period_s: between rows; rows: (s,) how many.
        squares, products: (s, n, c, c), (s, n, c) of the columns with one another and with what
            the torque has more than the model; size: (s, n) of that with itself.
        model: (s, n) of the model's torque with itself.
        largest: columns (m, n, c) and torques (m, n) of the largest piece.
    """

    period_s: float
    rows: Array
    squares: Array
    products: Array
    size: Array
    model: Array
    largest: tuple[Array, Array]

    def with_more(self, other: Moments) -> Moments:
        """The same of two pieces."""
        sums = {name: getattr(self, name) + getattr(other, name) for name in _SUMS}
        largest = max(self.largest, other.largest, key=lambda x: len(x[1]))
        return replace(self, **sums, largest=largest)

    def together(self, segments: slice = slice(None)) -> Moments:
        """Some segments as one: without their axis."""
        return replace(self, **{name: getattr(self, name)[segments].sum(axis=0) for name in _SUMS})

    def left(self, x: Array) -> Array:
        """(n,) mean square of what coefficients x (c,) leave, (N m)²; of segments together."""
        left = self.size - 2.0 * self.products @ x + (self.squares @ x) @ x
        return np.asarray(np.maximum(left, 0.0) / self.rows)


_SUMS = ("rows", "squares", "products", "size", "model")


def moments_of(model: SelfModel, rows: Rows, period_s: float, at: Array) -> Moments:
    """Products of rows, period_s apart; at (m,) from 0 to 1: when in their recording they are."""
    torque = ModelTorque(model)(rows.q, rows.dq, rows.ddq)
    regressor = RigidArm.of(model).regressor(rows.q, rows.dq, rows.ddq)
    step = smooth_sign(rows.dq, rows.ddq, SMOOTHING_S)
    joint = (np.ones_like(torque), step, rows.dq, rows.ddq, rows.q, 1.0 - np.abs(step))
    columns = np.concatenate([regressor[:, :, -10:], regressor, by_joint(joint)], axis=2)
    more, segment = rows.tau - torque, np.clip((SEGMENTS * at).astype(int), 0, SEGMENTS - 1)
    x, y = columns.transpose(1, 2, 0), more.T[:, :, None]
    parts = [(x[:, :, on], y[:, on], torque[on]) for on in (segment == s for s in range(SEGMENTS))]
    return Moments(
        period_s,
        np.bincount(segment, minlength=SEGMENTS).astype(float),
        np.stack([a @ a.transpose(0, 2, 1) for a, _, _ in parts]),
        np.stack([(a @ b)[:, :, 0] for a, b, _ in parts]),
        np.stack([np.sum(b**2, axis=(1, 2)) for _, b, _ in parts]),
        np.stack([np.sum(t**2, axis=0) for _, _, t in parts]),
        (columns, more),
    )


class Part(NamedTuple):
    """What one noise is of: all of a recording, or a time of it.

    Attributes:
        moments: its segments together.
        at: (c,) where its coefficients stand among those of all.
        alive: (n,) joints whose torque is measured in it.
        memory_s: (n,) of its noise; found in the largest piece where None.
    """

    moments: Moments
    at: NDArray[np.int64]
    alive: NDArray[np.bool_]
    memory_s: Array | None = None


@dataclass(frozen=True, eq=False)
class Posterior:
    """What is known of coefficients.

    Attributes:
        x: (c,) most probable ones; covariance: (c, c).
        left_nm: (n,) rms of what they leave of the first recording, N m.
    """

    x: Array
    covariance: Array
    left_nm: Array


def judge(
    parts: Sequence[Part],
    std: Array,
    positive: NDArray[np.bool_],
    before: tuple[Array, Array] | None = None,
) -> Posterior:
    """What parts of recordings of one arm say together.

    Args:
        std: (c,) of the prior of all coefficients; what has none is not there.
        positive: (c,) those of which no arm has less than nothing.
        before: information (c, c) and its right side (c,) from before, beside the prior.
    """
    own = std > 0.0
    free = own.copy()
    expected = [sensor_nm(part.moments.model / part.moments.rows) for part in parts]
    noise = [
        np.sqrt(x.moments.left(np.zeros(len(x.at)))) + y
        for x, y in zip(parts, expected, strict=True)
    ]
    memory = [
        np.full(len(part.alive), MEMORY_S[0]) if part.memory_s is None else part.memory_s
        for part in parts
    ]
    for turn in range(ROUNDS):
        information, right = np.diag(np.where(own, std, 1.0) ** -2.0), np.zeros(len(std))
        if before is not None:
            information, right = information + before[0], right + before[1]
        for (sums, at, alive, _), level, long_s in zip(parts, noise, memory, strict=True):
            weight = np.where(alive, sums.period_s / long_s / level**2, 0.0)
            information[np.ix_(at, at)] += np.tensordot(weight, sums.squares, 1)
            right[at] += weight @ sums.products
        covariance = np.zeros_like(information)
        covariance[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
        x = covariance @ right
        for k, (sums, at, _, told_s) in enumerate(parts):
            columns, more = sums.largest
            if told_s is None:
                memory[k] = memory_s(more - columns @ x[at], sums.period_s)
            samples = sums.rows * sums.period_s / memory[k]
            noise[k] = noise_nm(sums.left(x[at]), samples, expected[k])
        if turn >= ROUNDS // 2:
            free &= ~positive | (x >= 0.0)
    held = own & ~free  # at nothing, within what they could be else
    covariance[held, held] = np.diagonal(np.linalg.inv(information[np.ix_(own, own)]))[held[own]]
    return Posterior(x, covariance, np.sqrt(parts[0].moments.left(x[parts[0].at])))
