"""A truth written as URDF text, without loss.

PyBullet keeps only the diagonal of an inertia tensor, so every inertial frame is turned into
the principal axes of its body. Joints are `continuous`: PyBullet's own joint stops would push
through its constraint solver; the plant watches the ranges itself.
"""

from __future__ import annotations

import numpy as np

from sim.truth import Array, Limits, Truth, body_of, to_rpy


def urdf(truth: Truth, limited: bool = False) -> str:
    """URDF of the rigid arm, without its effects; joints with their limits where `limited`."""
    parts = ['<robot name="arm">', link_text("base", 1.0, np.zeros(3), np.eye(3))]
    parent = "base"
    for j, name in enumerate(truth.link_names):
        parts.append(link_text(name, *body_of(truth.theta[j])))
        place, limits = (truth.p[j], truth.R[j]), limit_text(truth.limits, j) if limited else None
        parts.append(joint_text(truth.joint_names[j], (parent, name), place, limits))
        parent = name
    return "\n".join([*parts, "</robot>"])


def principal(inertia: Array) -> tuple[Array, Array]:
    """Principal moments (3,) and the right-handed axes (3, 3), one per column."""
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    return moments, axes


def _origin(p: Array, R: Array) -> str:
    place, turned = (" ".join(repr(float(x)) for x in part) for part in (p, to_rpy(R)))
    return f'<origin xyz="{place}" rpy="{turned}"/>'


def link_text(name: str, m: float, com: Array, inertia: Array) -> str:
    """A link of mass m (kg), centre (3,) and inertia (3, 3) about the centre, kg m²."""
    (xx, yy, zz), axes = principal(inertia)
    return (
        f'<link name="{name}"><inertial>{_origin(com, axes)}<mass value="{m!r}"/>'
        f'<inertia ixx="{float(xx)!r}" iyy="{float(yy)!r}" izz="{float(zz)!r}"'
        ' ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def joint_text(
    name: str, links: tuple[str, str], place: tuple[Array, Array], more: str | None = None
) -> str:
    """A joint about its own z, between a parent and a child.

    Args:
        name: of the joint; links: of the two.
        place: (3,) m and turn (3, 3) of the joint in its parent.
        more: elements of a joint with limits; it turns without end where None.
    """
    kind = "continuous" if more is None else "revolute"
    return (
        f'<joint name="{name}" type="{kind}">{_origin(*place)}<parent link="{links[0]}"/>'
        f'<child link="{links[1]}"/><axis xyz="0 0 1"/>{more or ""}</joint>'
    )


def limit_text(limits: Limits, j: int) -> str:
    """The limits of joint j, from 0."""
    keys = "lower", "upper", "velocity", "effort"
    said = " ".join(f'{key}="{float(getattr(limits, key)[j])!r}"' for key in keys)
    return f"<limit {said}/>"
