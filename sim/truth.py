"""What is true of a simulated arm: the numbers that a learner is to find, and their file."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from sim import dynamics
from sim.dynamics import Frames, resting
from sim.effects import Array, Effect

FLANGE_M = 0.107  # m, from the frame of link 7 to the flange along z (franka_ros)
FLANGE = np.eye(4)  # in the last link's frame
FLANGE[2, 3] = FLANGE_M
BETA_IS_ZERO = 1e-9  # below it (in sin β) only α + γ exists
ATTEMPTS = 1000  # to draw what is possible


class Slowing(NamedTuple):
    """How fast joints may go towards the ends of their ranges, (n,) each: `models/fr3.toml`."""

    deceleration: Array
    offset: Array
    lower: Array
    upper: Array


@dataclass(frozen=True, slots=True)
class Limits:
    """Joint limits, (n,) each: rad, rad, rad/s, N m, rad/s²; `slowing` where speed hangs on it."""

    lower: Array
    upper: Array
    velocity: Array
    effort: Array
    acceleration: Array
    slowing: Slowing | None = None

    def speeds(self, q: Array) -> tuple[Array, Array]:
        """The least and the greatest velocity (n,) rad/s that joints may have at q (n,) rad."""
        if self.slowing is None:
            return -self.velocity, self.velocity
        hard, offset, lower, upper = self.slowing
        room = np.maximum([q - lower, upper - q], 0.0)
        down, up = np.clip(np.sqrt(2.0 * hard * room) - offset, 0.0, self.velocity)
        return -down, up


@dataclass(frozen=True, eq=False)
class Truth:
    """Everything that decides how a simulated serial arm moves.

    The torque of a sample is that of the driving side, everything that acts on it included:
    `tau = tau_rigid(q, dq, ddq) + sum of effects`.

    Attributes:
        joint_names: n names.
        link_names: n names, link j moves with joint j.
        R: (n, 3, 3) orientation of joint frame j in the frame of joint j - 1 at q_j = 0; axis z.
        p: (n, 3) its position there, m.
        theta: (n, 10) [m mX mY mZ XX XY XZ YY YZ ZZ] about the link-frame origin, SI.
        limits: of the joints.
        gravity: (3,) acceleration of gravity in the base frame, m/s².
        ready: (n,) posture at the start, rad.
        effects: friction, loads, offsets and whatever else acts on the arm or its sensors; table
            in `sim.effects`.

    Raises:
        ValueError: an effect on a joint that the arm does not have.
    """

    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    R: Array
    p: Array
    theta: Array
    limits: Limits
    gravity: Array
    ready: Array
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        for effect in self.effects:
            effect.columns(self.n)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @cached_property
    def frames(self) -> Frames:
        """The joint frames, as the dynamics take them."""
        parent = np.arange(self.n) - 1
        return Frames(parent, np.ascontiguousarray(self.R), np.ascontiguousarray(self.p))

    @cached_property
    def base(self) -> Array:
        """(4, 3) motion of the base, at rest under gravity, as the dynamics take it."""
        return resting(self.gravity)

    @property
    def lam(self) -> Array:
        """λ (n, 6), see `lam_of`."""
        return lam_of(self.R, self.p)

    @property
    def motor_inertia(self) -> Array:
        """(n,) kg m² that the motors add to the joints at all times."""
        found = np.zeros(self.n)
        for effect in self.effects:
            if effect.name == "motor_inertia" and effect.interval_s is None:
                found[effect.columns(self.n)] += effect.number("B")
        return found

    def torques(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Inverse dynamics (n,) N m of the rigid arm."""
        return np.asarray(dynamics.torques(self.frames, self.theta, self.base, q, dq, ddq))

    def mass_matrix(self, q: Array) -> Array:
        """(n, n) kg m² of the rigid arm."""
        return np.asarray(dynamics.mass_matrix(self.frames, self.theta, q))

    def with_changes(self, **changes: Any) -> Truth:
        """A copy with some attributes replaced."""
        return replace(self, **changes)

    def as_dict(self) -> dict[str, Any]:
        """The truth as plain numbers, keys as in a truth file."""
        return {
            "joints": list(self.joint_names),
            "links": list(self.link_names),
            "lambda": self.lam.tolist(),
            "theta": self.theta.tolist(),
            "gravity": self.gravity.tolist(),
            "effects": [effect.as_dict() for effect in self.effects],
        }


def panda() -> Truth:
    """The Panda as documented, with the inertias of Gaz et al. 2019 and without friction."""
    return documented("panda")


def documented(robot: str) -> Truth:
    """One of `options.ROBOTS` as documented, without friction."""
    facts = facts_of(robot)
    joints = facts["joint"]
    slowing = {key: np.array(values) for key, values in facts.get("slowing", {}).items()}
    keys = "lower", "upper", "velocity", "effort", "acceleration"
    rows = {key: np.array([j[key] for j in joints]) for key in keys}
    return Truth(
        joint_names=tuple(j["name"] for j in joints),
        link_names=tuple(j["link"] for j in joints),
        R=np.array([from_rpy(j["rpy"]) for j in joints]),
        p=np.array([j["xyz"] for j in joints]),
        theta=np.array([theta_of(j["mass"], j["com"], j["inertia"]) for j in joints]),
        limits=Limits(**rows, slowing=Slowing(**slowing) if slowing else None),
        gravity=np.array(facts["robot"]["gravity"]),
        ready=np.array(facts["robot"]["ready"]),
    )


def lam_of(turns: Array, p: Array) -> Array:
    """λ (n, 6): [α β γ p] of frames R (n, 3, 3), p (n, 3); R = Rz(α) Rx(β) Rz(γ), rad and m."""
    return np.array([[*zxz_angles(R), *at] for R, at in zip(turns, p, strict=True)])


def facts_of(robot: str) -> dict[str, Any]:
    """The data file of a robot in `sim/models`, with what it shares with another one."""
    text = (resources.files(__package__) / "models" / f"{robot}.toml").read_text("utf-8")
    facts = tomllib.loads(text)
    like = facts.pop("like", None)
    return facts if like is None else facts_of(like) | facts


def body_of(theta: Array) -> tuple[float, Array, Array]:
    """Mass, centre (3,) and inertia (3, 3) about the centre, from (10,) about the origin."""
    m, *first, xx, xy, xz, yy, yz, zz = theta.tolist()
    c = np.array(first) / m
    about_origin = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return m, c, about_origin - m * (c @ c * np.eye(3) - np.outer(c, c))


def theta_of(m: float, com: list[float], inertia: list[float]) -> Array:
    """(10,) about the frame's origin, from mass, centre and inertia about the centre."""
    c = np.array(com)
    shift = m * (c @ c * np.eye(3) - np.outer(c, c))
    return np.array([m, *(m * c), *(np.array(inertia) + shift[np.triu_indices(3)])])


def wrong_bodies(theta: Array, error: float, rng: np.random.Generator) -> Array:
    """θ (n, 10) with each number changed by `error` rms, every body still possible."""
    wrong = [wrong_body(body, error, rng) for body in theta]
    for j, body in enumerate(wrong):
        assert body is not None, f"no possible body near that of link {j + 1}"
    return np.array(wrong)


def wrong_body(body: Array, error: float, rng: np.random.Generator) -> Array | None:
    """(10,) with each number changed by `error` rms; None where none of those drawn is possible."""
    for _ in range(ATTEMPTS):
        wrong = np.asarray(body * (1 + error * rng.standard_normal(10)))
        if possible(wrong):
            return wrong
    return None


def possible(theta: Array) -> bool:
    """Whether moments about the centre are those of some distribution of mass."""
    moments = np.linalg.eigvalsh(body_of(theta)[2])
    return bool(moments[0] > 0 and moments[0] + moments[1] > moments[2])


def turn(axis: int, angle: float) -> Array:
    """Rotation by `angle` (rad) about coordinate axis 0, 1 or 2."""
    R = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i] = R[j, j] = np.cos(angle)
    R[j, i] = np.sin(angle)
    R[i, j] = -R[j, i]
    return R


def turn_about(axis: Array, angle: float) -> Array:
    """Rotation matrix by `angle` (rad) about a unit vector (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def direction(rng: np.random.Generator) -> Array:
    """A unit vector, all directions alike."""
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def from_rpy(rpy: list[float]) -> Array:
    """Rotation matrix of URDF's roll, pitch, yaw (rad): turns about fixed x, then y, then z."""
    return turn(2, rpy[2]) @ turn(1, rpy[1]) @ turn(0, rpy[0])


def to_rpy(R: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw (rad) of a rotation matrix; yaw is 0 where pitch is ±90°."""
    flat = np.hypot(R[0, 0], R[1, 0])
    pitch = float(np.arctan2(-R[2, 0], flat))
    if flat < BETA_IS_ZERO:
        return float(np.arctan2(-R[1, 2], R[1, 1])), pitch, 0.0
    roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    return float(roll), pitch, float(yaw)


def zxz_angles(R: Array) -> tuple[float, float, float]:
    """Angles α, β, γ (rad) of R = Rz(α) Rx(β) Rz(γ).

    Of the two triples that exist the one with the smaller |α| + |γ| is taken; at β = 0 or π,
    where only α + γ or α - γ exists, γ = 0.
    """
    sin_beta = float(np.hypot(R[0, 2], R[1, 2]))
    beta = float(np.arctan2(sin_beta, R[2, 2]))
    if sin_beta < BETA_IS_ZERO:
        return float(np.arctan2(R[1, 0], R[0, 0])), beta, 0.0
    first = np.array([np.arctan2(R[0, 2], -R[1, 2]), np.arctan2(R[2, 0], R[2, 1])])
    second = first - np.pi * np.where(first > 0, 1.0, -1.0)
    if np.abs(second).sum() < np.abs(first).sum():
        return float(second[0]), -beta, float(second[1])
    return float(first[0]), beta, float(first[1])


def urdf(truth: Truth, limited: bool = False) -> str:
    """URDF of the rigid arm without loss, without its effects; with limits where `limited`.

    PyBullet keeps only the diagonal of an inertia tensor, so every inertial frame is turned into
    the principal axes of its body. Joints are `continuous`: PyBullet's own joint stops would push
    through its constraint solver; the plant watches the ranges itself.
    """
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
