"""What rows of recordings say of an arm: a Gaussian posterior under held priors.

    tau = model + Y dθ + Y_n load + offset + Fc s(dq) + Fv dq + B ddq + static + noise

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
from adapter.judgement.priors import Place
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.likelihood import (
    SENSOR_NM,
    SENSOR_SHARE,
    SENSOR_WEIGHT,
    SMOOTHING_S,
    Rows,
)

ROUNDS = 12  # of noise after fit; it settles in five
MEMORY_S = (0.1, 0.5)  # of the noise, least and most: the band's 10 Hz, and an arm's misfit
FADED = 0.1  # of the noise's correlation, which ends its memory
SEGMENTS = 10  # of a recording, in any of which something may change


@dataclass(frozen=True, eq=False)
class Moments:
    """Rows of a recording, by products of their columns.

    Attributes:
        period_s: between rows; rows: (s,) how many, by segments of time.
        squares, products: (s, n, c, c), (s, n, c) of the columns with one another and with what
            the torque has more than the model; size: (s, n) of that with itself.
        model: (s, n) of the model's torque with itself.
        last: columns (m, n, c) and torques (m, n) of the last piece.
    """

    period_s: float
    rows: Array
    squares: Array
    products: Array
    size: Array
    model: Array
    last: tuple[Array, Array]

    def with_more(self, other: Moments) -> Moments:
        """The same of two pieces."""
        names = ("rows", "squares", "products", "size", "model")
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return replace(other, **sums)

    @property
    def rms(self) -> Array:
        """(n,) of what the torque has more than the model, N m."""
        return np.sqrt(self.size.sum(axis=0) / self.rows.sum())


def moments_of(model: SelfModel, rows: Rows, period_s: float, at: Array) -> Moments:
    """Products of rows, period_s apart; at (m,) from 0 to 1: when in their recording they are."""
    arm = RigidArm.of(model)
    torque = ModelTorque(model)(rows.q, rows.dq, rows.ddq)
    (m, n), place = torque.shape, Place(arm.n)
    columns = np.zeros((m, n, place.size))
    regressor = arm.regressor(rows.q, rows.dq, rows.ddq)
    columns[:, :, place.theta], columns[:, :, place.load] = regressor, regressor[:, :, -10:]
    step = smooth_sign(rows.dq, rows.ddq, SMOOTHING_S)
    joint = (np.ones_like(torque), step, rows.dq, rows.ddq, 1.0 - np.abs(step))
    for k, column in enumerate(joint):
        columns[:, range(n), np.arange(n) + place.joint(k).start] = column
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
    """Some segments of a recording, and where its coefficients (c,) stand among those of all."""

    moments: Moments
    segments: slice
    at: NDArray[np.int64]


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


def judge(parts: Sequence[Part], std: Array, alive: NDArray[np.bool_]) -> Posterior:
    """What parts of recordings of one arm say together.

    Args:
        std: (c,) of the prior of all coefficients, the first of them in the order of `Place`;
            what has none is not there. alive: (n,) joints whose torque is measured.
    """
    place, free = Place(len(alive)), std > 0.0
    sums = [_sums(part) for part in parts]
    noise = [np.sqrt(size / rows) + SENSOR_NM for rows, _, _, size, _ in sums]
    memory = [np.full(len(alive), MEMORY_S[0]) for _ in parts]
    for turn in range(ROUNDS):
        information, right = np.diag(np.where(std > 0.0, std, 1.0) ** -2.0), np.zeros(len(std))
        for part, (_, squares, products, _, _), level, long_s in zip(
            parts, sums, noise, memory, strict=True
        ):
            weight = np.where(alive, part.moments.period_s / long_s / level**2, 0.0)
            information[np.ix_(part.at, part.at)] += np.tensordot(weight, squares, 1)
            right[part.at] += weight @ products
        covariance = np.zeros_like(information)
        covariance[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
        x = covariance @ right
        left = [_left(one, x[part.at]) for part, one in zip(parts, sums, strict=True)]
        for k, (part, (rows, _, _, _, model)) in enumerate(zip(parts, sums, strict=True)):
            columns, more = part.moments.last
            memory[k] = _memory_s(more - columns @ x[part.at], part.moments.period_s)
            samples = rows * part.moments.period_s / memory[k]
            floor = SENSOR_NM + SENSOR_SHARE * np.sqrt(model / rows)
            total = samples * left[k] + SENSOR_WEIGHT * floor**2
            noise[k] = np.sqrt(total / (samples + SENSOR_WEIGHT))
        if turn >= ROUNDS // 2:
            free[place.positive] &= x[place.positive] >= 0.0
    return Posterior(x, covariance, np.sqrt(left[0]))


def _sums(part: Part) -> tuple[float, Array, Array, Array, Array]:
    """Rows, squares, products, size and model's size of its segments."""
    own, on = part.moments, part.segments
    squares, products, size, model = (
        x[on].sum(axis=0) for x in (own.squares, own.products, own.size, own.model)
    )
    return float(own.rows[on].sum()), squares, products, size, model


def _left(sums: tuple[float, Array, Array, Array, Array], x: Array) -> Array:
    """(n,) mean square of what coefficients x (c,) leave, (N m)²."""
    rows, squares, products, size, _ = sums
    return np.asarray(np.maximum(size - 2.0 * products @ x + (squares @ x) @ x, 0.0) / rows)


def _memory_s(left: Array, period_s: float) -> Array:
    """(n,) s of noise (m, n) that one independent sample stands for."""
    centred = left - left.mean(axis=0)
    power = np.abs(np.fft.rfft(centred, 2 * len(left), axis=0)) ** 2
    alike = np.fft.irfft(power, axis=0)[: max(round(MEMORY_S[1] / period_s), 1)]
    alike /= np.maximum(alike[0], 1e-12)
    until = np.cumprod(alike > FADED, axis=0)
    return np.clip(period_s * (2.0 * np.sum(alike * until, axis=0) - 1.0), *MEMORY_S)
