"""A motion that somebody else designed, through the same limits, plan and stops as any other.

Its positions are joined by a quintic spline that rests at both ends. Before it the arm goes to
where the motion begins, and where it is quicker than the limits allow all of it is slowed down.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from adapter.control.limits import MotionLimits
from adapter.control.path_motion import (
    PathMotion,
    largest,
    moving,
    ramp_pairs,
    ramped,
    smooth_step,
    usable_range,
)
from adapter.control.settings import ExcitationSettings
from adapter.errors import SettingsError
from adapter.model.spatial import Array

APPROACH_S = 4.0
# Largest slope, bend and jerk of the quintic step over one second.
STEP = 1.875, 5.78, 60.0


class PlayedMotion(PathMotion):
    """A way to where a spline begins, and that spline at a pace.

    Args:
        q0: (n,) rad; spline: rests at both ends; pace: times its own speed.
        path_bounds: lowest, highest q, highest |q'|, |q''|, |q'''| of the path, (n,) each.
    """

    def __init__(
        self,
        q0: Array,
        spline: BSpline,
        pace: float,
        path_bounds: tuple[Array, ...],
        settings: ExcitationSettings,
    ) -> None:
        super().__init__(q0, settings)
        self._q0, self._pace, self._path_bounds = q0, pace, path_bounds
        self._ways = spline, spline.derivative(1), spline.derivative(2)
        self._end = float(spline.t[-1])
        self._way = spline(0.0) - q0

    def path(self, s: float) -> Array:
        """See the base class; it stands where the file ends."""
        if s < APPROACH_S:
            x = s / APPROACH_S
            step, slope = smooth_step(x)
            bend = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x)
            rows = (step, slope / APPROACH_S, bend / APPROACH_S**2)
            return np.outer(rows, self._way) + np.array([self._q0, 0.0 * self._q0, 0.0 * self._q0])
        at = min(self._pace * (s - APPROACH_S), self._end)
        return np.array([self._pace**k * way(at) for k, way in enumerate(self._ways)])

    def bounds(self) -> tuple[Array, Array, Array, Array, Array]:
        """See the base class."""
        return _with_ramps(self._path_bounds, self.settings)


@dataclass(frozen=True)
class Player:
    """What draws the motion of a file, from wherever the arm stands.

    Attributes:
        name: of the file; t: (m,) s from zero on; q: (m, n) rad.
    """

    name: str
    t: Array
    q: Array

    def __call__(
        self,
        limits: MotionLimits,
        q0: Array,
        settings: ExcitationSettings,
        attempt: int = 0,
        size: float = 1.0,
    ) -> PlayedMotion:
        """The motion; attempt and size have no say.

        Raises SettingsError: it leaves a joint's range, is far too quick, or the arm stands too
        far from where it begins.
        """
        q0, on = np.array(q0, dtype=np.float64), moving(limits, settings).astype(bool)
        lower, upper = usable_range(limits, q0, settings)
        low, high = (np.where(on, edge, q0) for edge in self._reach[:2])
        beyond = (low < np.minimum(lower, q0)) | (high > np.maximum(upper, q0))
        if beyond.any():
            j = int(np.argmax(beyond))
            raise SettingsError(
                f"{self.name}: takes joint {j + 1} to {low[j]:.3f} .. {high[j]:.3f}, which may go "
                f"from {lower[j]:.3f} to {upper[j]:.3f} (excitation.margin {settings.margin:g} "
                "from its limits)"
            )
        pace = self.pace(limits, settings)
        spline = BSpline(self._spline.t, np.where(on, self._spline.c, q0), self._spline.k)
        ends = np.minimum(low, q0), np.maximum(high, q0)
        way = np.abs(spline(0.0) - q0)
        rates = [
            np.maximum(on * most * pace**k, way * STEP[k - 1] / APPROACH_S**k)
            for k, most in enumerate(self._reach[2:], 1)
        ]
        motion = PlayedMotion(q0, spline, pace, (*ends, *rates), settings)
        if not _kept(limits, settings, motion.bounds()).all():
            j = int(np.argmax(way))
            raise SettingsError(
                f"{self.name}: the arm stands {way[j]:.2f} from where joint {j + 1} begins, too "
                f"far for {APPROACH_S:g} s; move it nearer first"
            )
        return motion

    def pace(self, limits: MotionLimits, settings: ExcitationSettings) -> float:
        """Times its own speed at which it keeps all limits, at most one.

        Raises SettingsError where that is hardly the same motion any more.
        """

        def kept(factor: Array) -> Array:
            rates = (most * factor**k for k, most in enumerate(self._reach[2:], 1))
            return _kept(limits, settings, _with_ramps((*self._reach[:2], *rates), settings))

        pace = float(largest(np.ones(self.q.shape[1]), kept).min())
        if pace < 0.25 * settings.share:  # slower, it is another motion
            raise SettingsError(
                f"{self.name}: keeps the limits at {pace:.1%} of its speed alone; does it rest "
                "where it begins and ends, are its times in s and its positions in rad?"
            )
        return pace

    def seconds(self, limits: MotionLimits, settings: ExcitationSettings) -> float:
        """Of motion time from the start on, after which it is over: whole tenths."""
        lasts = APPROACH_S + float(self.t[-1]) / self.pace(limits, settings) + settings.start_s
        return float(np.ceil(10.0 * lasts) / 10.0)

    @cached_property
    def _spline(self) -> BSpline:
        rest: Any = [(k, np.zeros(self.q.shape[1])) for k in (1, 2)]
        return make_interp_spline(self.t, self.q, k=5, bc_type=(rest, rest))

    @cached_property
    def _reach(self) -> tuple[Array, ...]:
        """Lowest, highest q, highest |q'|, |q''|, |q'''| at the points and between, (n,) each."""
        between = np.arange(4) / 4  # looks between two points
        looks = np.append(self.t[:-1, None] + np.diff(self.t)[:, None] * between, self.t[-1])
        q, *rates = (self._spline(looks, k) for k in range(4))
        return q.min(axis=0), q.max(axis=0), *(np.abs(x).max(axis=0) for x in rates)


def _with_ramps(
    path_bounds: tuple[Array, ...], settings: ExcitationSettings
) -> tuple[Array, Array, Array, Array, Array]:
    """Bounds of the motion on a path with these, while its rate changes, too."""
    lower, upper, speed, acceleration, jerk = path_bounds
    ramps = ramp_pairs(settings) @ np.array([acceleration, speed])
    return lower, upper, speed, ramps.max(axis=0), ramped(speed, acceleration, jerk, settings)[2]


def _kept(limits: MotionLimits, settings: ExcitationSettings, bounds: tuple[Array, ...]) -> Array:
    """(n,) whether a motion with these bounds keeps its share of the limits."""
    lower, upper, speed, acceleration, jerk = bounds
    share = settings.share * (1.0 + 1e-9)
    return np.asarray(
        (speed <= share * limits.speed_between(lower, upper))
        & (acceleration <= share * limits.acceleration)
        & (jerk <= share * limits.jerk)
    )
