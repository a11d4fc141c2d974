"""Slow motions that tell effects apart: sweeps at constant speeds, holds, reversals.

One joint moves after the other, by moves at a constant speed with quintic ramps between them, so
that friction is seen at each speed alone, at rest after either direction, or over its first
millimetres. Which experiment wants which moves is said here; what it shows, in `effects.phrases`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from adapter.control.limits import MotionLimits
from adapter.control.path_motion import PathMotion, ramped, usable_range
from adapter.control.settings import ExcitationSettings
from adapter.effects.phrases import BOTH_WAYS, SPEEDS, STILL, TURN, TURNS, DecidingExperiment
from adapter.errors import SettingsError
from adapter.model.spatial import Array

RAMP_S, HOLD_S, FIRST_REST_S = 0.3, 2.0, 1.0
# Largest slope and bend of the quintic step over one second.
STEP_SLOPE, STEP_BEND = 1.875, 5.78
FAR, NARROW = 0.2, 0.02  # rad that a joint is moved to one side
WIDE = 0.2  # rad/s
RATES = (0.01, 0.03, 0.1, 0.3, 0.5)


class Move(NamedTuple):
    """By `way` rad at `speed` rad/s, then still for `hold_s`."""

    way: float
    speed: float
    hold_s: float = 0.0


def _there_and_back(far: float, speeds: Sequence[float], hold_s: float = 0.0) -> list[Move]:
    return [Move(sign * far, v, hold_s) for v in speeds for sign in (1.0, -1.0)]


def _side(up: float, down: float, most: float) -> float:
    """Towards where there is more room."""
    return min(up, most) if up >= down else -min(down, most)


MOVES: dict[DecidingExperiment, Callable[[float, float], list[Move]]] = {
    **dict.fromkeys(
        (SPEEDS, BOTH_WAYS), lambda up, down: _there_and_back(_side(up, down, FAR), RATES)
    ),
    STILL: lambda up, down: _there_and_back(0.5 * _side(up, down, FAR), [0.1] * 3, HOLD_S),
    TURN: lambda up, down: [Move(up, WIDE), Move(-up - down, WIDE), Move(down, WIDE)],
    TURNS: lambda up, down: _there_and_back(_side(up, down, NARROW), [0.01] * 3),
}


class SweepMotion(PathMotion):
    """One joint after the other makes its moves, from q0 and back to it.

    Args:
        limits: to keep.
        q0: (n,) where the arm is, rad.
        settings: shares of the limits; of the start and the stop.
        experiments: by joint (from 0), in this order.
        size: share of the ways.

    Attributes:
        length_s: of the whole, s.

    Raises:
        SettingsError: nothing to do, a joint that stands outside its limits or has no room.
    """

    def __init__(
        self,
        limits: MotionLimits,
        q0: Array,
        settings: ExcitationSettings,
        experiments: Sequence[tuple[int, DecidingExperiment]],
        size: float = 1.0,
    ) -> None:
        q0 = np.array(q0, dtype=np.float64)
        super().__init__(q0, settings)
        lower, upper = usable_range(limits, q0, settings)
        at, rows = FIRST_REST_S, []
        for j, experiment in experiments:
            up, down = size * (upper - q0)[j], size * (q0 - lower)[j]
            if max(up, down) < NARROW * size:
                raise SettingsError(f"joint {j + 1} has no room to move; move it by hand first")
            fastest = settings.share * limits.speed_between(lower, upper)[j]
            for move in MOVES[experiment](up, down):
                wanted = min(move.speed, fastest)
                most = settings.share * limits.acceleration[j]
                ramp = max(RAMP_S, STEP_SLOPE * wanted / most)
                speed = min(wanted, abs(move.way) / ramp)  # it has to reach it between its ramps
                if speed <= 0.0:
                    continue
                lasts = abs(move.way) / speed
                change = np.sign(move.way) * speed
                rows += [(at, j, change, ramp), (at + lasts, j, -change, ramp)]
                at += lasts + ramp + move.hold_s
        if not rows:
            raise SettingsError("no joint is to be swept")
        self.length_s, self._q0 = at, q0
        begin, joint, change, ramp_s = np.array(rows).T
        self._begin, self._joint = begin, joint.astype(int)
        self._change, self._ramp = change, ramp_s
        self._path = np.zeros((3, len(q0)))

    def path(self, s: float) -> Array:
        """See the base class."""
        x = np.clip((s - self._begin) / self._ramp, 0.0, None)
        y = np.minimum(x, 1.0)
        step = y**3 * (10.0 + y * (6.0 * y - 15.0))
        slope = 30.0 * (y * (1.0 - y)) ** 2
        way = y**4 * (2.5 + y * (y - 3.0)) + (x - y)
        self._path[:] = 0.0
        for row, part in enumerate((self._ramp * way, step, slope / self._ramp)):
            np.add.at(self._path[row], self._joint, self._change * part)
        self._path[0] += self._q0
        return self._path

    def bounds(self) -> tuple[Array, Array, Array, Array, Array]:
        """See the base class; a joint is furthest where it rests."""
        rests = np.array([self.path(t)[0].copy() for t in (0.0, *(self._begin + self._ramp))])
        speed, acceleration, jerk = np.zeros((3, len(self._q0)))
        size = np.abs(self._change)
        np.maximum.at(speed, self._joint, size)
        np.maximum.at(acceleration, self._joint, STEP_SLOPE * size / self._ramp)
        np.maximum.at(jerk, self._joint, STEP_BEND * size / self._ramp**2)
        bounds = ramped(speed, acceleration, jerk, self.settings)
        return rests.min(axis=0), rests.max(axis=0), *bounds
