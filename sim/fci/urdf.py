"""The arm as URDF, for clients of protocol 10.

libfranka 0.21 demands of the URDF seven movable joints with `joint1` to `joint7` in their names,
each with its limits and with `position_based_velocity_limits`, and a link that is called exactly
`link8`, the flange.
"""

from __future__ import annotations

import numpy as np

from sim.scenarios import FLANGE_M
from sim.truth import Truth, body_of
from sim.urdf_writer import joint_text, limit_text, link_text


def robot_urdf(truth: Truth) -> str:
    """The arm without payloads and losses."""
    parts = ['<robot name="simulated_arm">', '<link name="link0"/>']
    slowing, offset = truth.limits.acceleration, np.zeros(truth.n)
    if truth.limits.slowing is not None:
        slowing, offset = truth.limits.slowing.deceleration, truth.limits.slowing.offset
    for j in range(truth.n):
        limits = (
            f"{limit_text(truth.limits, j)}<position_based_velocity_limits "
            f'velocity_offset="{float(offset[j])!r}" deceleration_limit="{float(slowing[j])!r}"/>'
        )
        links, place = (f"link{j}", f"link{j + 1}"), (truth.p[j], truth.R[j])
        parts.append(link_text(links[1], *body_of(truth.theta[j])))
        parts.append(joint_text(f"joint{j + 1}", links, place, limits))
    parts.append('<link name="link8"/>')
    parts.append(
        f'<joint name="joint8" type="fixed"><origin xyz="0 0 {FLANGE_M!r}" rpy="0 0 0"/>'
        '<parent link="link7"/><child link="link8"/></joint>'
    )
    return "\n".join([*parts, "</robot>"])
