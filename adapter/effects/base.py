"""What a physical effect beside the rigid body looks like to the learner."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class JointEffect(Protocol):
    """A torque on each joint, linear in one parameter per joint.

    Attributes:
        name: canonical name.
        key: name of the parameter.
        unit: unit of the parameter.
        prior_std: how large the parameter may well be, in its unit; the prior's mean is zero.
    """

    name: str
    key: str
    unit: str
    prior_std: float

    def column(self, q: Array, dq: Array, ddq: Array, smoothing_s: float = 0.0) -> Array:
        """Torque per unit of the parameter, same shape as dq; rad, rad/s, rad/s² in.

        Where the signals have gone through a low-pass, `smoothing_s` says how long it takes a
        step; what jumps in the effect must be as smooth as what jumps in the torque.
        """
