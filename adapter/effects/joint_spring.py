"""Joint spring: k (q - q0), a cable or hose that pulls."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.effects.base import (
    Array,
    JointTorque,
    Parameter,
    Template,
    Values,
)


class JointSpring(JointTorque):
    """A spring between a joint's two sides."""

    name = "joint_spring"
    title = "joint spring"
    parameters = (Parameter("k", "N m/rad"), Parameter("q0", "rad"))
    split_by = "move the joint over a wider range, and repeat with the base rotated"

    def templates(self) -> tuple[Template, ...]:
        """Coefficients of the springs that rest at 0 and at 1 rad."""
        return (Template((1.0, 1.0), _decode),)

    def law(
        self,
        q: Array,
        dq: Array,
        ddq: Array,
        tau: Array,
        values: Values,
        smoothing_s: float = 0.0,
    ) -> Array:
        """k (q - q0)."""
        return np.asarray(values["k"] * (q - values["q0"]))


def _decode(x: Array) -> dict[str, Any]:
    k = float(x[0] + x[1])
    return {"k": k, "q0": float(x[1]) / k if k else 0.0}
