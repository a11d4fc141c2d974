"""Encoder offset: q_measured = q + o."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import Array, Motion, MotionEffect, Parameter, Values
from adapter.effects.by_joint import ByJoint
from adapter.effects.phrases import Phrase
from adapter.effects.splits import LOADS
from adapter.model.urdf_text import Additions


class EncoderOffset(MotionEffect):
    """A joint whose zero is elsewhere than the model's."""

    name = "encoder_offset"
    title = "encoder offset"
    parameters = (Parameter("o", "rad"),)
    prior_std = 0.012
    phrase = Phrase.reads("o", "encoder")
    shows = ((LOADS, "grows with the load"),)

    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """q - o."""
        still = np.zeros(len(motion.t))
        return motion.moved(joint, still - float(values["o"]), still, still)

    def at_instant(self, sums: ByJoint, joint: int | slice, values: Values) -> bool:
        """The offset."""
        sums.offset[joint] += float(values["o"])
        return True

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """The zero of the joint."""
        more.offset[joint] += values["o"]
        return None
