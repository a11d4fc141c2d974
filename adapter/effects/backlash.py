"""Backlash: the gear's play of full width b; the link angle lags the motor's."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import (
    Array,
    Motion,
    MotionEffect,
    Parameter,
    Template,
    Values,
    late_jit,
)
from adapter.effects.by_joint import ByJoint, smooth_sign
from adapter.effects.phrases import Phrase
from adapter.effects.splits import FLANK

MOVES = 0.9  # of the smoothed direction, from which a joint is on its way
SIZES_RAD = (1.5e-3, 3e-3, 6e-3, 12e-3)  # to look for: when a play is crossed hangs on its width
NARROW = -40.0  # ln of the odds that a play narrower than these shows


@late_jit
def play(q, half, start, link):
    """Fill link (m,), the angle behind a motor angle q (m,) with a play of ± half, rad.

    `start` is the link's angle before the first of them. A negative play is the same curve
    mirrored at the motor's, so that a fit may cross zero.
    """
    width, sign = abs(half), 1.0 if half >= 0.0 else -1.0
    last = q[0] + sign * (start - q[0])
    for i in range(q.shape[0]):
        last = min(max(last, q[i] - width), q[i] + width)
        link[i] = q[i] + sign * (last - q[i])


def _pushed(dq: Array) -> float:
    """Which way a joint with velocities dq (m,) moves first, from -1 to 1; 0 where it rests."""
    way = smooth_sign(dq)
    return float(way[np.argmax(np.abs(way) > MOVES)])


class Backlash(MotionEffect):
    """Play in the gear, crossed at each reversal."""

    name = "backlash"
    title = "backlash"
    parameters = (Parameter("b", "rad", lower=0.0),)
    prior_std = 5e-3
    positive = ("b",)
    log_odds = -1.0
    inexact = 0.1
    phrase = Phrase("{who} {has} {b} of backlash")
    shows = ((FLANK, "is gone under that load"),)

    def templates(self) -> tuple[Template, ...]:
        """Plays of several widths."""
        return tuple(
            Template((b,), self.decode, f"b = {1e3 * b:g} mrad", chord=True) for b in SIZES_RAD
        )

    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """The play operator driven by q: the link is pushed by one flank, then by the other.

        Before the first instant the motor pushed the way it moves first, at rows apart the way it
        moves. The motor runs through the play at once and the link does not: what a crossing makes
        of the motor's measured acceleration is no torque. A reversal that was smoothed looks as if
        it came earlier.
        """
        half, dq = 0.5 * float(values["b"]), motion.dq[:, joint]
        angles = motion.q if motion.sharp_q is None else motion.sharp_q
        q = np.ascontiguousarray(angles[:, joint])
        link = q - half * smooth_sign(dq)
        if not motion.apart:
            play(q, half, q[0] - half * _pushed(dq), link)
        behind = motion.as_smooth(link - q)
        rate = motion.rate(behind)
        return motion.moved(joint, behind, rate, motion.rate(rate))

    def log_odds_of(self, values: Values) -> float:
        """What starts and stops leave of the noise in accelerations looks like a narrow play."""
        return NARROW if abs(float(values["b"])) < SIZES_RAD[0] else 0.0

    def at_instant(self, sums: ByJoint, joint: int | slice, values: Values) -> bool:
        """Half the play."""
        sums.half_play[joint] += 0.5 * float(values["b"])
        return True
