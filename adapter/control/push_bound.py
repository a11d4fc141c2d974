"""How hard a planned motion may push what is in its way, before a stop and after it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.control.limits import MotionLimits
from adapter.control.path_motion import PathMotion
from adapter.control.settings import SafetySettings
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import frames_of, place_frames

POSES, DIRECTIONS = 40, 200  # that are looked at
# Of the effort limit, and N m: what a stopped arm may still push with on each joint. A CAN arm is
# carried with a tenth of it beyond its weight (`resting`); half of that for what it sags by.
LEFT_SHARE, LEFT_LEAST = 0.15, 1.0


def left_at_most(effort: Array) -> Array:
    """Torque (n,) N m that a stopped arm may still push with, for effort limits (n,) N m."""
    return np.maximum(LEFT_SHARE * effort, LEFT_LEAST)


@dataclass(frozen=True)
class PushBound:
    """Pushes that no limit ends.

    Attributes:
        joints: (n,) N m beyond what the model expects.
        middle, most: N at the origin of the last link, for half of all directions and poses on the
            way, and for the worst of them; infinite where no joint feels it.
        left: (n,) N m after a stop.
    """

    joints: Array
    middle: float
    most: float
    left: Array

    def lines(self) -> list[str]:
        """For the person beside the arm."""
        worst = f"{self.most:.0f} N for the worst"
        if not self.most < 1e4:  # what hardly any joint feels
            worst = "no push does in the worst"
        each, left = (", ".join(f"{x:.3g}" for x in row) for row in (self.joints, self.left))
        return [
            f"A push ends it within 0.05 s from {each} N m on a joint that the model does not "
            f"expect: at the hand from {self.middle:.0f} N for half of all directions and poses on "
            f"the way, {worst}.",
            f"Once stopped the joints push with at most {left} N m.",
        ]


def push_bound(
    model: SelfModel, motion: PathMotion, limits: MotionLimits, safety: SafetySettings
) -> PushBound:
    """The bound of a motion that was drawn."""
    joints = safety.external_share * limits.effort
    frames, n = frames_of(model.tree, model.lam), model.tree.n
    R, o = np.empty((n, 3, 3)), np.empty((n, 3))
    z = 1.0 - (2.0 * np.arange(DIRECTIONS) + 1.0) / DIRECTIONS
    golden = np.pi * (3.0 - np.sqrt(5.0))  # spreads them evenly over a sphere
    angle, radius, forces = golden * np.arange(DIRECTIONS), np.sqrt(1.0 - z**2), []
    ways = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    for s in np.linspace(0.0, 30.0, POSES):  # of path
        place_frames(frames, motion.path(s)[0], R, o)
        felt, j = np.zeros((n, len(ways))), n - 1
        while j >= 0:
            felt[j] = np.abs(np.cross(o[-1] - o[j], ways) @ R[j, :, 2])
            j = model.tree.parent[j]
        with np.errstate(divide="ignore"):
            forces.append((joints[:, None] / felt).min(axis=0))
    force = np.concatenate(forces)
    left = left_at_most(limits.effort)
    return PushBound(joints, float(np.median(force)), float(force.max()), left)
