"""Commanded and measured positions as the servos' fit takes them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from adapter.gap.servo_kernels import LEAST_LOAD, Ground, Load, between, touches
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from drivers.files.mcap import Log

LONGEST_STEP_S = 1e-3  # of the simulation
CUT_HZ, CUT_SHARE = 20.0, 0.2  # of the smoothing; of the sample rate at most
EDGE_S = 0.5  # at the start, where what winds the joints up is unknown: not judged
BEYOND_S = 10.0  # before and after the commands, in which the first and last one hold


@dataclass(frozen=True, eq=False)
class Track:
    """One recording on the simulation's steps.

    Attributes:
        t: (m,) s, the end of each step; step_s: their length.
        stamp_s: (k,) of the readings; q: (k, n) rad.
        at_s: (c,) s of the commands; held: (c, n) integral of the held command up to there,
            rad s; gained: (c, n) integral of its rate, rad.
        smooth: (3, m + 1, n) q, dq, ddq at the ends of all steps, zero-phase, rad.
    """

    name: str
    t: Array
    step_s: float
    stamp_s: Array
    q: Array
    at_s: Array
    held: Array
    gained: Array
    smooth: Array
    _alone: dict[int, Track] = field(default_factory=dict, init=False, repr=False)
    _goals: dict[float, list[Array]] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, log: Log, longest_step_s: float = LONGEST_STEP_S) -> Track:
        """Prepare a recording whose commands are positions."""
        first, orders = log.stamp_ns[0], log.commands
        assert orders is not None and orders.q is not None
        stamp_s = 1e-9 * (log.stamp_ns - first).astype(float)
        period = float(np.median(np.diff(stamp_s)))
        step = period / np.ceil(period / longest_step_s - 1e-6)
        count = round(stamp_s[-1] / step)
        grid = step * np.arange(count + 1)
        at = 1e-9 * (orders.stamp_ns - first)
        at = np.concatenate([[at[0] - BEYOND_S], at, [at[-1] + BEYOND_S]])
        q, usual = np.concatenate([orders.q[:1], orders.q]), float(np.median(np.diff(at)))
        rate, width = np.zeros_like(q), np.diff(at)[:, None]
        rate[2:] = np.diff(q[1:], axis=0) / np.maximum(width[1:-1], 0.5 * usual)
        nothing = np.zeros((1, q.shape[1]))
        held, gained = (np.concatenate([nothing, np.cumsum(x * width, axis=0)]) for x in (q, rate))
        smooth = smoothed(columns(grid, stamp_s, log.q), step, period)
        return cls(log.path.name, grid[1:], step, stamp_s, log.q, at, held, gained, smooth)

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])

    def only(self, joint: int) -> Track:
        """The same of one joint (from 0)."""
        if joint not in self._alone:
            at = slice(joint, joint + 1)
            tables = {key: getattr(self, key)[..., at] for key in ("q", "held", "gained", "smooth")}
            self._alone[joint] = replace(self, **tables)
        return self._alone[joint]

    @property
    def start(self) -> Array:
        """(2, n) q, dq before the first step."""
        return np.ascontiguousarray(self.smooth[:2, 0])

    @cached_property
    def judged(self) -> NDArray[np.bool_]:
        """(k,) readings that are judged."""
        return self.stamp_s >= EDGE_S

    @cached_property
    def _places(self) -> tuple[NDArray[np.intp], Array]:
        """(k,) steps in which the readings are, and (k, 1) how far, of one."""
        at = np.clip((self.stamp_s / self.step_s).astype(int), 0, len(self.t) - 1)
        return at, np.clip(self.stamp_s / self.step_s - at, 0.0, 1.0)[:, None]

    def goal(self, lead: Array, delay_s: float) -> Array:
        """(2, m, n) rad: command, and lead (n,) s times its rate, over each step."""
        if delay_s not in self._goals:
            if len(self._goals) > 2:  # a fit needs its delay, and two nearby for slopes
                self._goals.clear()
            ends = np.concatenate([[0.0], self.t]) - delay_s
            both = (np.diff(columns(ends, self.at_s, x), axis=0) for x in (self.held, self.gained))
            self._goals[delay_s] = [x / self.step_s for x in both]
        held, gained = self._goals[delay_s]
        return np.array([held, lead * gained])

    def commanded(self, delay_s: float) -> Array:
        """(m, n) rad: commands at the ends of the steps, between two of them by a line."""
        each = np.diff(self.held, axis=0) / np.diff(self.at_s)[:, None]
        return columns(self.t - delay_s, self.at_s, np.concatenate([each, each[-1:]]))

    def left(self, q: Array) -> Array:
        """(k, n) rad: readings less simulated positions (m, n) at the ends of the steps."""
        whole, (at, share) = np.concatenate([self.start[:1], q]), self._places
        return np.asarray(self.q - whole[at] - share * (whole[at + 1] - whole[at]))

    def simulated(self, q: Array) -> Array:
        """(3, m + 1, n) as `smooth`, of simulated positions (m, n)."""
        whole = np.concatenate([self.start[:1], q])
        dq = np.gradient(whole, self.step_s, axis=0)
        return np.array([whole, dq, np.gradient(dq, self.step_s, axis=0)])


def columns(at: Array, t: Array, table: Array) -> Array:
    """(m, n) of a table (k, n) over t (k,), between its rows by a line; both ascend."""
    out = np.empty((len(at), table.shape[1]))
    between(at, t, table, out)
    return out


def smoothed(q: Array, step_s: float, period_s: float) -> Array:
    """(3, m, n) q, dq, ddq through a zero-phase low-pass."""
    cut = min(CUT_HZ, CUT_SHARE / period_s)
    sections, pad = butter(4, cut, fs=1.0 / step_s, output="sos"), min(15, len(q) - 1)
    clean = sosfiltfilt(sections, q, axis=0, padlen=pad)
    dq = np.gradient(clean, step_s, axis=0)
    return np.array([clean, dq, np.gradient(dq, step_s, axis=0)])


def loads(arm: RigidArm, motion: Array, ground: Ground) -> list[Load]:
    """What the arm, and what it comes down on, make of each joint's motion, at the steps' middles.

    Args:
        motion: (3, m + 1, n) q, dq, ddq at the ends of the steps.
    """
    q, dq, ddq = 0.5 * (motion[:, 1:] + motion[:, :-1])
    tau = arm.torque(q, dq, ddq)
    weightless, still, found = arm.changed(gravity=np.zeros(3)), np.zeros_like(q), []
    lift, above, push = over_ground(arm, ground, q)
    for j in range(arm.n):
        unit = still.copy()
        unit[:, j] = 1.0
        mass = weightless.torque(q, still, unit)[:, j]
        side = tau[:, j] / np.hypot(tau[:, j], LEAST_LOAD)
        other, gap = tau[:, j] - mass * ddq[:, j], above - lift[:, j] * q[:, j]
        columns = mass, other, lift[:, j], gap, push[:, j], side
        found.append(Load(*map(np.ascontiguousarray, columns)))
    return found


def over_ground(arm: RigidArm, ground: Ground, q: Array) -> tuple[Array, Array, Array]:
    """Lift (m, n), above (m,) and push (m, n) along a motion q (m, n) rad, see `touches`."""
    q = np.ascontiguousarray(q)
    lift, above, push = np.zeros_like(q), np.ones(len(q)), np.zeros_like(q)
    if ground.root > 0.0:
        touches(arm.frames, ground, q, lift, above, push)
    return lift, above, push
