"""Encoder offset: q_measured = q + o."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import Array, Motion, MotionEffect, Parameter, Values


class EncoderOffset(MotionEffect):
    """A joint whose zero is elsewhere than the model's."""

    name = "encoder_offset"
    title = "encoder offset"
    parameters = (Parameter("o", "rad"),)
    typical = 0.012
    split_by = "move the joint over a wider range, and repeat with another load at the flange"

    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """q - o."""
        still = np.zeros(len(motion.t))
        return motion.moved(joint, still - float(values["o"]), still, still)
