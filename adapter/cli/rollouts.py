"""Forward simulation along a recording: the learner's model in the simulator's physics.

The only place where the two meet for `adapter gap`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pybullet

from adapter.effects.active import active_effects
from adapter.gap.held_out import DrivenMotion
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from sim.rollout import MotionTable, rollout, truth_from


class Rollouts:
    """Simulates self models by PyBullet; an `adapter.gap.held_out.Simulate`.

    Attributes:
        troubles: why models could not be simulated, a sentence each.
    """

    def __init__(self) -> None:
        self.troubles: list[str] = []

    def __call__(
        self,
        model: SelfModel,
        motion: DrivenMotion,
        segments: Sequence[tuple[int, int]],
        drive: str,
    ) -> tuple[Array, Array]:
        """Simulated q, dq (m, n): NaN outside the segments, all NaN where it cannot be done."""
        try:
            found = rollout(_truth_of(model), MotionTable(*motion), segments, drive)
        except (ValueError, pybullet.error) as error:
            trouble = f"no forward simulation: {error}"
            if trouble not in self.troubles:
                self.troubles.append(trouble)
            return np.full_like(motion.q, np.nan), np.full_like(motion.q, np.nan)
        return found.q, found.dq


def _truth_of(model: SelfModel) -> Any:
    """The simulated arm of a self model: its tool belongs to the last link, effects are its own.

    Raises:
        ValueError: it branches, or holds what cannot be simulated.
    """
    tree, arm = model.tree, RigidArm.of(model)
    if not np.array_equal(arm.frames.parent, np.arange(tree.n) - 1):
        raise ValueError(f"{model.name} branches; only serial arms are simulated")
    return truth_from(
        (tree.joint_names, tree.link_names),
        (arm.frames.R0, arm.frames.p),
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
            **active.effect.simulated(active.values),
        }
        for active in active_effects(model.effects, model.tree.n)
    ]


def _bound(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None
