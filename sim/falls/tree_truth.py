"""What is true of a simulated tree with a floating base, such as a humanoid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.truth import Array, facts_of, from_rpy, lam_of, theta_of

BASE = -1


@dataclass(frozen=True, slots=True)
class TreeLimits:
    """Joint limits, (n,) each: rad, rad, rad/s, N m."""

    lower: Array
    upper: Array
    velocity: Array
    effort: Array


@dataclass(frozen=True, eq=False)
class TreeTruth:
    """Everything that decides how a simulated tree of rigid bodies moves; no friction, no drives.

    Attributes:
        name: of the robot.
        joint_names: n names.
        link_names: n names, link j moves with joint j.
        base_name: of the base link.
        parent: for each joint the index of the link it hangs on, -1 the base; parents come first.
        R: (n, 3, 3) orientation of joint frame j in its parent's frame at q_j = 0; axis z.
        p: (n, 3) its position there, m.
        theta: (n + 1, 10) [m mX mY mZ XX XY XZ YY YZ ZZ] about the link-frame origin, SI; the
            base first.
        limits: of the joints.
        gravity: (3,) acceleration of gravity in world axes, m/s².

    Raises:
        ValueError: a parent that does not come earlier, or shapes that do not fit.
    """

    name: str
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    base_name: str
    parent: tuple[int, ...]
    R: Array
    p: Array
    theta: Array
    limits: TreeLimits
    gravity: Array

    def __post_init__(self) -> None:
        n = len(self.parent)
        shapes = (self.R.shape, self.p.shape, self.theta.shape, self.limits.lower.shape)
        if shapes != ((n, 3, 3), (n, 3), (n + 1, 10), (n,)):
            raise ValueError(f"{n} joints don't fit shapes {shapes} of R, p, theta, limits")
        if not len(self.joint_names) == len(self.link_names) == n:
            raise ValueError(f"{n} joints need {n} joint names and {n} link names")
        for k, i in enumerate(self.parent):
            if not BASE <= i < k:
                raise ValueError(f"joint {k} hangs on link {i}; have: -1 (the base) to {k - 1}")

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.parent)

    @property
    def lam(self) -> Array:
        """λ (n, 6), see `lam_of`."""
        return lam_of(self.R, self.p)


def atlas() -> TreeTruth:
    """The humanoid ATLAS: 30 joints on a floating pelvis; facts in `sim/models/atlas.toml`."""
    facts = facts_of("atlas")
    base, joints = facts["base"], facts["joint"]
    links = [j["link"] for j in joints]
    place = {base["link"]: BASE} | {name: k for k, name in enumerate(links)}
    return TreeTruth(
        name=facts["robot"]["name"],
        joint_names=tuple(j["name"] for j in joints),
        link_names=tuple(links),
        base_name=base["link"],
        parent=tuple(place[j["parent"]] for j in joints),
        R=np.array([from_rpy(j["rpy"]) for j in joints]),
        p=np.array([j["xyz"] for j in joints]),
        theta=np.array([theta_of(x["mass"], x["com"], x["inertia"]) for x in (base, *joints)]),
        limits=TreeLimits(*(np.array([j[k] for j in joints]) for k in TreeLimits.__slots__)),
        gravity=np.array(facts["robot"]["gravity"]),
    )
