"""What a motion of a documented arm has to keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array

# Franka Emika Panda, vendor documentation (limits for planning motion): rad/s², rad/s³, N m/s.
PANDA_ACCELERATION = (15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0)
PANDA_JERK = (7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0)
PANDA_TORQUE_RATE = 1000.0
# Of an arm whose documentation is silent; modest.
UNKNOWN_VELOCITY, UNKNOWN_ACCELERATION, UNKNOWN_JERK = 1.0, 5.0, 1000.0


@dataclass(frozen=True)
class MotionLimits:
    """What a motion has to keep, (n,) each: rad, rad/s, rad/s², rad/s³, N m, N m/s.

    Attributes:
        is_panda: whether the arm is known as one.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    effort: Array
    torque_rate: Array
    is_panda: bool = False

    @classmethod
    def of(cls, model: SelfModel) -> MotionLimits:
        """Limits of a documented arm; modest ones where its documentation is silent."""
        n, known = model.tree.n, model.limits
        panda = n == len(PANDA_JERK) and model.name.startswith(("panda", "fer"))
        velocity = np.where(np.isfinite(known.velocity), known.velocity, UNKNOWN_VELOCITY)
        return cls(
            known.lower,
            known.upper,
            velocity,
            np.array(PANDA_ACCELERATION) if panda else np.full(n, UNKNOWN_ACCELERATION),
            np.array(PANDA_JERK) if panda else np.full(n, UNKNOWN_JERK),
            np.where(np.isfinite(known.effort), known.effort, np.inf),
            np.full(n, PANDA_TORQUE_RATE),
            panda,
        )
