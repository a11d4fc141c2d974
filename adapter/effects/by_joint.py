"""Lasting effects as sums over the joints: for one sample at a time, in real time.

What an effect does over a recording is in its own file, and so is what one instant shows of it
(`Effect.at_instant`): it adds itself to the sums here, entries of all joints go through one
call, and nothing is looked up by name on the way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.model.spatial import Array

JointLaw = Any  # an `effects.base.JointTorque`, which is made of what is here
SMOOTHING_DQ = 0.01  # rad/s; below it the sign of a measured velocity is noise
# m: a joint that slides is taken to have what one that turns a drum of this radius has
DRUM_M = 0.1
STRIBECK_SPEED = 0.05  # rad/s, published ones are 0.02 to 0.1; static friction acts below it
AT_REST = 3.0  # times what static friction is above Coulomb's: a rest holds up to all of it
# Over which bristles wind up that somebody remembers; those of the first one slide at once.
WAYS_RAD = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)


def shares_of_ways(way: Array | float) -> Array:
    """(K, ...) shares of bristles of the `WAYS_RAD` that bend as those of another way, rad.

    Between two ways the mean of their bends, by the logarithm: off by at most 3 % of the range.
    """
    at = np.interp(np.log(way), np.log(WAYS_RAD), np.arange(len(WAYS_RAD)))
    steps = np.arange(len(WAYS_RAD)).reshape(-1, *[1] * np.ndim(way))
    return np.maximum(0.0, 1.0 - np.abs(at - steps))


def smooth_sign(
    dq: Array, ddq: Array | None = None, smoothing_s: float = 0.0, drum: Array | float = 1.0
) -> Array:
    """sign(dq), smoothed around rest as tanh(dq / w): w = 0.01 rad/s, times `drum` (1 or DRUM_M).

    Where the signals have gone through a low-pass, `smoothing_s` says how long it takes a step;
    what jumps in an effect must be as smooth as what jumps in the torque, so w is at least as
    far as dq goes within that time.
    """
    if not smoothing_s or ddq is None:
        return np.tanh(dq / (SMOOTHING_DQ * drum))
    return np.tanh(dq / np.hypot(SMOOTHING_DQ * drum, smoothing_s * ddq))


def slowness(dq: Array) -> Array:
    """How unsure friction is at velocities dq, rad/s, in parts of `Effect.band`."""
    rests = np.abs(dq) < SMOOTHING_DQ
    return np.asarray(np.where(rests, AT_REST, np.exp(-np.square(dq / STRIBECK_SPEED))))


class JointSignals(NamedTuple):
    """What the torque of a joint may depend on: signals of any one shape, (n,), (m,), (m, n).

    Attributes:
        q, dq, ddq: rad, rad/s, rad/s².
        tau: rigid torque, N m; left out where nothing depends on it.
        smoothing_s: how long the low-pass that the signals went through takes a step.
        bent: (K, ...) how far bristles of each of the `WAYS_RAD` are bent, -1 to 1; zeros where
            nobody remembers the way.
        rates: (2, ...) rates of the joint's torque by the model, N m/s and N m/s²; zeros where
            nobody knows what came before.
        drum: of `smooth_sign`.
    """

    q: Array
    dq: Array
    ddq: Array
    tau: Array = np.zeros(())
    smoothing_s: float = 0.0
    bent: Array = np.zeros(len(WAYS_RAD))
    rates: Array = np.zeros(2)
    drum: float = 1.0

    @property
    def direction(self) -> Array:
        """sign(dq), as smooth as the signals are."""
        return smooth_sign(self.dq, self.ddq, self.smoothing_s, self.drum)

    def of(self, joint: int) -> JointSignals:
        """Those of one joint (from 1) for all of (..., n); where 0, of each its own."""
        if not joint:
            return self
        q, dq, ddq, tau = (x[..., joint - 1 : joint] if np.ndim(x) else x for x in self[:4])
        return self._replace(q=q, dq=dq, ddq=ddq, tau=tau)


@dataclass(eq=False)
class ByJoint:
    """Effects of n joints at one instant, to which each adds its own; without any all is zero.

    Attributes:
        wrench: (6,) [f; m] on the last link, base axes.
        offset: (n,) rad, q_measured - q.
        wave: (n,) complex rad, size and phase of what an encoder adds once a turn.
        half_play: (n,) rad, half the width of the gears' play.
        compliance: (n,) rad/(N m), 1/k of the gears.
        log_gain: (n,) ln of the torque sensors' gains.
        delay_s: (n,) of the torque sensors.
        laws: torques at the joints with each parameter (n,); one twice where a joint has two.
        left_out: names of what a single instant cannot show.
    """

    wrench: Array
    offset: Array
    wave: NDArray[np.complex128]
    half_play: Array
    compliance: Array
    log_gain: Array
    delay_s: Array
    laws: list[tuple[JointLaw, dict[str, Array]]] = field(default_factory=list)
    left_out: tuple[str, ...] = ()
    _taken: list[set[int]] = field(default_factory=list)

    @classmethod
    def zero(cls, n: int) -> ByJoint:
        """Of n joints without effects."""
        offset, half_play, compliance, log_gain, delay_s = np.zeros((5, n))
        wave = np.zeros(n, dtype=complex)
        return cls(np.zeros(6), offset, wave, half_play, compliance, log_gain, delay_s)

    def add_law(self, effect: JointLaw, joint: int, values: Mapping[str, Any]) -> None:
        """A law on one joint: beside its like on other joints, in a new table where taken."""
        free = (k for k, (own, _) in enumerate(self.laws) if own is effect)
        at = next((k for k in free if joint not in self._taken[k]), len(self.laws))
        if at == len(self.laws):
            self.laws.append((effect, effect.absent(len(self.offset))))
            self._taken.append(set())
        self._taken[at].add(joint)
        for key, value in values.items():
            self.laws[at][1][key][joint] = value

    @cached_property
    def ripple(self) -> Array:
        """(n,) rad, of what an encoder adds once a turn."""
        return np.abs(self.wave)

    @cached_property
    def phase(self) -> Array:
        """(n,) rad, of the same."""
        return np.angle(self.wave)

    @cached_property
    def gain(self) -> Array:
        """(n,) of the torque sensors."""
        return np.expm1(self.log_gain)

    @cached_property
    def moves(self) -> bool:
        """Whether the links move otherwise than the sensors say."""
        tables = (self.offset, self.ripple, self.half_play, self.compliance)
        return any(bool(np.any(table)) for table in tables)

    @cached_property
    def pushed(self) -> bool:
        """Whether there is a wrench on the last link."""
        return bool(np.any(self.wrench))

    @cached_property
    def by_load(self) -> bool:
        """Whether a law depends on the rigid torque."""
        return any(effect.by_load for effect, _ in self.laws)

    def torque(self, at: JointSignals) -> Array | float:
        """Sum of the laws (..., n) for signals of that shape; the wrench is not in it."""
        return sum((effect.law(at.of(effect.by), values) for effect, values in self.laws), 0.0)
