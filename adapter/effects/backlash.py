"""Backlash: the gear's play of full width b; the link angle lags the motor's."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import (
    Array,
    Motion,
    MotionEffect,
    Parameter,
    Values,
    late_jit,
)
from adapter.effects.by_joint import EffectSums, smooth_sign
from adapter.effects.phrases import Phrase
from adapter.effects.splits import FLANK


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

    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """The play operator driven by q: the link is pushed by one flank, then by the other.

        Before the first instant the motor pushed the way it moves there.
        """
        half = 0.5 * float(values["b"])
        q = np.ascontiguousarray(motion.q[:, joint])
        link = np.empty_like(q)
        if len(q):
            play(q, half, q[0] - half * smooth_sign(motion.dq[:1, joint])[0], link)
        still = np.zeros_like(q)
        return motion.moved(joint, link - q, still, still)

    def at_instant(self, sums: EffectSums, joint: int | slice, values: Values) -> bool:
        """Half the play."""
        sums.half_play[joint] += 0.5 * float(values["b"])
        return True
