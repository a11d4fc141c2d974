"""Encoder ripple: q_measured = q + a sin(q + phase), an encoder that sits off its centre."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.effects.base import (
    Array,
    Motion,
    MotionEffect,
    Parameter,
    Values,
    polar,
)
from adapter.effects.by_joint import ByJoint
from adapter.effects.phrases import Phrase
from adapter.effects.splits import LOADS, TURN


class EncoderRipple(MotionEffect):
    """A position error of once a turn."""

    name = "encoder_ripple"
    title = "encoder ripple"
    parameters = (Parameter("a", "rad"), Parameter("phase", "rad"))
    prior_std = (5e-3, 5e-3)
    log_odds = -2.0
    inexact = 0.02
    phrase = Phrase("the encoder of {who} errs by {a} once per turn")
    shows = ((LOADS, "grows with the load"), (TURN, "changes sign along the turn"))

    def decode(self, x: Array) -> dict[str, Any]:
        """Of sine and cosine."""
        return dict(zip(("a", "phase"), polar(x), strict=True))

    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """q - a sin(q + phase) with its two derivatives (to first order in a)."""
        a, angle = float(values["a"]), motion.q[:, joint] + float(values["phase"])
        dq, ddq = motion.dq[:, joint], motion.ddq[:, joint]
        sine, cosine = a * np.sin(angle), a * np.cos(angle)
        return motion.moved(joint, -sine, -cosine * dq, sine * dq**2 - cosine * ddq)

    def at_instant(self, sums: ByJoint, joint: int | slice, values: Values) -> bool:
        """The wave."""
        sums.wave[joint] += float(values["a"]) * np.exp(1j * float(values["phase"]))
        return True
