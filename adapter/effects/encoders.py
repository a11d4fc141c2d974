"""Where links are behind the encoders: q_measured is not the angle of the link."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from adapter.effects import base as base
from adapter.effects.base import Array, Motion, Values
from adapter.effects.by_joint import smooth_sign
from adapter.effects.phrases import FLANK, LOADS, TURN, Phrase
from adapter.model.urdf_text import Additions


class EncoderOffset(base.MotionEffect):
    """A joint whose zero is elsewhere than the model's: q_measured = q + o."""

    name = "encoder_offset"
    title = "encoder offset"
    parameters = (base.Parameter("o", "rad"),)
    prior_std = 0.012
    phrase = Phrase.reads("o", "encoder")
    instant = "offset", lambda values: values["o"]
    shows = ((LOADS, "grows with the load"),)

    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """q - o."""
        still = np.zeros(len(motion.t))
        return motion.moved(joint, still - float(values["o"]), still, still)

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """The zero of the joint."""
        more.offset[joint] += values["o"]
        return None


class EncoderRipple(base.MotionEffect):
    """A position error of once a turn, of an encoder that sits off its centre.

    q_measured = q + a sin(q + phase).
    """

    name = "encoder_ripple"
    title = "encoder ripple"
    parameters = (base.Parameter("a", "rad"), base.Parameter("phase", "rad"))
    prior_std, turns = (5e-3, 5e-3), True
    log_odds = -2.0
    inexact = 0.02
    phrase = Phrase("the encoder of {who} errs by {a} once per turn")
    instant = "wave", lambda values: values["a"] * np.exp(1j * values["phase"])
    shows = ((LOADS, "grows with the load"), (TURN, "changes sign along the turn"))

    def decode(self, x: Array) -> dict[str, Any]:
        """Of sine and cosine."""
        return dict(zip(("a", "phase"), base.polar(x), strict=True))

    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """q - a sin(q + phase) with its two derivatives (to first order in a)."""
        a, angle = float(values["a"]), motion.q[:, joint] + float(values["phase"])
        dq, ddq = motion.dq[:, joint], motion.ddq[:, joint]
        sine, cosine = a * np.sin(angle), a * np.cos(angle)
        return motion.moved(joint, -sine, -cosine * dq, sine * dq**2 - cosine * ddq)


class JointElasticity(base.MotionEffect):
    """A gear that twists under the joint's torque; the encoder sits on the motor side.

    q_measured = q_link + tau / k.
    """

    name = "joint_elasticity"
    title = "joint elasticity"
    parameters = (base.Parameter("k", "N m/rad"),)
    prior_std = 2e-4  # rad/(N m), of 1/k: a typical harmonic drive has 5000 N m/rad
    coefficients = ("rad/(N m)",)
    positive = ("k",)
    inexact = 0.05
    phrase = Phrase("{who} {is} elastic, with a stiffness of {k}")
    instant = "compliance", lambda values: 1.0 / values["k"]
    shows = ((LOADS, "grows with the square of the load"),)

    def decode(self, x: Array) -> dict[str, Any]:
        """Of 1/k, which is zero where the gear is rigid."""
        return {"k": 1.0 / float(x[0]) if x[0] else math.inf}

    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """q - tau/k with two derivatives: fourth ones of q, nothing but noise above a band."""
        twist = -motion.inside_band(tau[:, joint], joint) / float(values["k"])
        speed = motion.rate(twist)
        return motion.moved(joint, twist, speed, motion.rate(speed))


MOVES = 0.9  # of the smoothed direction, from which a joint is on its way
SIZES_RAD = (1.5e-3, 3e-3, 6e-3, 12e-3)  # to look for: when a play is crossed hangs on its width
NARROW = -40.0  # ln of the odds that a play narrower than these shows


@base.late_jit
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


class Backlash(base.MotionEffect):
    """Play in the gear, of full width b, crossed at each reversal: the link lags the motor."""

    name = "backlash"
    title = "backlash"
    parameters = (base.Parameter("b", "rad", lower=0.0),)
    prior_std = 5e-3
    positive = ("b",)
    log_odds = -1.0
    inexact = 0.1
    phrase = Phrase("{who} {has} {b} of backlash")
    instant = "half_play", lambda values: 0.5 * values["b"]
    shows = ((FLANK, "is gone under that load"),)

    def templates(self) -> tuple[base.Template, ...]:
        """Plays of several widths."""
        return tuple(
            base.Template((b,), self.decode, f"b = {1e3 * b:g} mrad", chord=True) for b in SIZES_RAD
        )

    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """The play operator driven by q: the link is pushed by one flank, then by the other.

        Before the first instant the motor pushed the way it moves first, at rows apart the way it
        moves. The motor runs through the play at once and the link does not: what a crossing makes
        of the motor's measured acceleration is no torque. A reversal that was smoothed looks as if
        it came earlier.
        """
        half, way = 0.5 * float(values["b"]), smooth_sign(motion.dq[:, joint])
        angles = motion.q if motion.sharp_q is None else motion.sharp_q
        q = np.ascontiguousarray(angles[:, joint])
        link = q - half * way
        if not motion.apart:
            pushed = float(way[np.argmax(np.abs(way) > MOVES)])  # from -1 to 1; 0 where it rests
            play(q, half, q[0] - half * pushed, link)
        behind = motion.as_smooth(link - q)
        rate = motion.rate(behind)
        return motion.moved(joint, behind, rate, motion.rate(rate))

    def log_odds_of(self, values: Values) -> float:
        """What starts and stops leave of the noise in accelerations looks like a narrow play."""
        return NARROW if abs(float(values["b"])) < SIZES_RAD[0] else 0.0
