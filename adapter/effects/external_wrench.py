"""External wrench: something pushes the flange for a time; tau_measured = tau_rigid - J^T w."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import (
    FLANGE,
    Array,
    Motion,
    Parameter,
    TorqueEffect,
    Values,
)
from adapter.effects.by_joint import ByJoint
from adapter.effects.phrases import Length, Phrase
from adapter.effects.splits import ALONE

KEYS = ("fx", "fy", "fz", "mx", "my", "mz")


class ExternalWrench(TorqueEffect):
    """A constant wrench on the arm at the origin of the last link, base axes."""

    name = "external_wrench"
    title = "external wrench"
    scope = FLANGE
    parameters = (
        *(Parameter(key, "N") for key in KEYS[:3]),
        *(Parameter(key, "N m") for key in KEYS[3:]),
    )
    prior_std = (15.0, 15.0, 15.0, 2.0, 2.0, 2.0)
    inexact = 0.05
    phrase = Phrase(
        "something pushes the flange with {length}",
        lengths=(Length(KEYS[:3], "N"), Length(KEYS[3:], "N m", before="a moment of ")),
    )
    shows = ((ALONE, "is gone"),)
    sudden = True
    passing = True
    watched = True

    def torque(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """-J^T w."""
        wrench = np.array([values[key] for key in KEYS], dtype=float)
        return -motion.arm.wrench_torque(motion.q, wrench)

    def at_instant(self, sums: ByJoint, joint: int | slice, values: Values) -> bool:
        """The wrench."""
        sums.wrench += np.array([values[key] for key in KEYS], dtype=float)
        return True
