"""Forward simulation along a recording: the learner's model in the simulator's physics.

The only place where the two meet for `adapter gap`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from adapter.effects.active import active_effects
from adapter.model import SelfModel
from adapter.records import Array
from adapter.rigid_arm import RigidArm


class Rollouts:
    """Simulates self models by PyBullet; an `adapter.gap.shrink.Simulate`.

    Attributes:
        troubles: why models could not be simulated, a sentence each.
    """

    def __init__(self) -> None:
        self.troubles: list[str] = []

    def __call__(
        self,
        model: SelfModel,
        t: Array,
        q: Array,
        dq: Array,
        u: Array,
        segments: Sequence[tuple[int, int]],
        drive: str,
    ) -> tuple[Array, Array]:
        """Simulated q, dq (m, n): NaN outside the segments, all NaN where it cannot be done."""
        import pybullet  # few commands need it

        from sim.rollout import rollout

        try:
            found = rollout(_truth_of(model), t, q, dq, u, segments, drive)
        except (ValueError, pybullet.error) as error:
            trouble = f"no forward simulation: {error}"
            if trouble not in self.troubles:
                self.troubles.append(trouble)
            return np.full_like(q, np.nan), np.full_like(q, np.nan)
        return found.q, found.dq


def _truth_of(model: SelfModel) -> Any:
    """The simulated arm of a self model: its tool belongs to the last link, effects are its own.

    Raises:
        ValueError: it branches, or holds what cannot be simulated.
    """
    from sim.rollout import truth_from

    tree, arm = model.tree, RigidArm.of(model)
    if not np.array_equal(arm.parent, np.arange(tree.n) - 1):
        raise ValueError(f"{model.name} branches; only serial arms are simulated")
    return truth_from(
        tree.joint_names,
        tree.link_names,
        arm.R0,
        arm.p,
        arm.theta,
        arm.gravity,
        effects=_entries(model),
    )


def _entries(model: SelfModel) -> list[dict[str, Any]]:
    """Effects joint by joint, as the simulator takes them."""
    return [
        {
            "effect": active.effect.name,
            "joints": [] if active.joint < 0 else [active.joint + 1],
            "interval_s": [_bound(x) for x in active.interval_s],
            "parameters": dict(active.values),
        }
        for active in active_effects(model.effects, model.tree.n)
    ]


def _bound(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None
