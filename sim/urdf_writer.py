"""A truth written as URDF text, in the form that PyBullet reads without loss.

PyBullet keeps only the diagonal of an inertia tensor, so every inertial frame is turned into
the principal axes of its body. Joints are `continuous`: PyBullet's own joint stops would push
through its constraint solver; the plant watches the ranges itself.
"""

from __future__ import annotations

import numpy as np

from sim.truth import Array, Truth, body_of, to_rpy


def urdf(truth: Truth) -> str:
    """URDF of the rigid arm, without its effects."""
    parts = ['<robot name="arm">', link_text("base", 1.0, np.zeros(3), np.eye(3))]
    parent = "base"
    for j, name in enumerate(truth.link_names):
        parts.append(link_text(name, *body_of(truth.theta[j])))
        parts.append(joint_text(truth.joint_names[j], parent, name, truth.p[j], truth.R[j]))
        parent = name
    return "\n".join([*parts, "</robot>"])


def principal(inertia: Array) -> tuple[Array, Array]:
    """Principal moments (3,) and the right-handed axes (3, 3), one per column."""
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    return moments, axes


def _numbers(values: Array | tuple[float, ...]) -> str:
    return " ".join(repr(float(v)) for v in values)


def _origin(p: Array, R: Array) -> str:
    return f'<origin xyz="{_numbers(p)}" rpy="{_numbers(to_rpy(R))}"/>'


def link_text(name: str, m: float, com: Array, inertia: Array) -> str:
    """A link of mass m (kg), centre (3,) and inertia (3, 3) about the centre, kg m²."""
    (xx, yy, zz), axes = principal(inertia)
    return (
        f'<link name="{name}"><inertial>{_origin(com, axes)}<mass value="{m!r}"/>'
        f'<inertia ixx="{float(xx)!r}" iyy="{float(yy)!r}" izz="{float(zz)!r}"'
        ' ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def joint_text(name: str, parent: str, child: str, p: Array, R: Array) -> str:
    """A joint at p (3,) m, turned by R (3, 3), about its own z."""
    return (
        f'<joint name="{name}" type="continuous">{_origin(p, R)}<parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 0 1"/></joint>'
    )
