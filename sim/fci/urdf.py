"""The arm as URDF, for clients of protocol 10.

libfranka 0.21 demands of the URDF seven movable joints with `joint1` to `joint7` in their names,
each with its limits and with `position_based_velocity_limits`, and a link that is called exactly
`link8`, the flange.
"""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

import numpy as np

from sim.scenarios import FLANGE_M
from sim.truth import Array, Truth, body_of, to_rpy

NAME = "simulated_arm"


def robot_urdf(truth: Truth) -> str:
    """The arm without payloads and losses."""
    parts = [f"<robot name={quoteattr(NAME)}>", '<link name="link0"/>']
    for j in range(truth.n):
        parts.append(_link(f"link{j + 1}", *body_of(truth.theta[j])))
        parts.append(_joint(truth, j))
    parts.append('<link name="link8"/>')
    parts.append(
        f'<joint name="joint8" type="fixed"><origin xyz="0 0 {FLANGE_M!r}" rpy="0 0 0"/>'
        '<parent link="link7"/><child link="link8"/></joint>'
    )
    return "\n".join([*parts, "</robot>"])


def _joint(truth: Truth, j: int) -> str:
    limits = truth.limits
    numbers = {
        "lower": limits.lower[j],
        "upper": limits.upper[j],
        "velocity": limits.velocity[j],
        "effort": limits.effort[j],
    }
    said = " ".join(f'{key}="{float(value)!r}"' for key, value in numbers.items())
    slowing, offset = limits.acceleration, np.zeros(truth.n)
    if limits.slowing is not None:
        slowing, offset = limits.slowing.deceleration, limits.slowing.offset
    return (
        f'<joint name="joint{j + 1}" type="revolute">'
        f'<origin xyz="{_row(truth.p[j])}" rpy="{_row(to_rpy(truth.R[j]))}"/>'
        f'<parent link="link{j}"/><child link="link{j + 1}"/><axis xyz="0 0 1"/><limit {said}/>'
        f'<position_based_velocity_limits velocity_offset="{float(offset[j])!r}"'
        f' deceleration_limit="{float(slowing[j])!r}"/></joint>'
    )


def _link(name: str, m: float, com: Array, inertia: Array) -> str:
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.tolist()
    return (
        f'<link name="{name}"><inertial><origin xyz="{_row(com)}" rpy="0 0 0"/>'
        f'<mass value="{m!r}"/><inertia ixx="{xx!r}" ixy="{xy!r}" ixz="{xz!r}" iyy="{yy!r}"'
        f' iyz="{yz!r}" izz="{zz!r}"/></inertial></link>'
    )


def _row(values: Array | tuple[float, ...]) -> str:
    return " ".join(repr(float(x)) for x in values)
