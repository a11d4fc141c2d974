"""Two models of one arm, joint by joint: what moved, by how much, what of it data could show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adapter.effects.active import lasting_effects, with_bodies
from adapter.effects.robots import read_robot
from adapter.effects.torque import ModelTorque
from adapter.errors import ModelError
from adapter.gap.load import hand_frame
from adapter.model.inertia import PARAMETERS, body_from_theta
from adapter.model.locking import LOCKED
from adapter.model.onto import SAME_PLACE
from adapter.model.robots import names as robot_names
from adapter.model.self_model import SelfModel, link_theta
from adapter.model.spatial import Array, log_rotation
from adapter.model.urdf import model_from_urdf
from adapter.physics.identifiability import base_parameters, frame_observability
from adapter.physics.kernels import frames_of, place_frames

MOTION_S, STEP_S, EVERY = 8.0, 1e-3, 20  # motion that torques are compared on; rows between poses
SINES, BAND_HZ = 5, (0.1, 0.6)
FREE_RAD, FREE_RAD_S = 1.5, 1.0  # of a joint whose limits nobody knows
SHARE = 0.45  # of the range and of the documented speed
SAME = 1e-9  # of a number's size, rad and m: rounding
HIDDEN = 1e-3  # share of a difference that data could show, below which none could


@dataclass(frozen=True)
class JointDifference:
    """What differs at a joint and the link that it moves, second model less first.

    Attributes:
        joint, link: their names.
        turn_rad, shift_m: of the joint's frame in its parent's.
        frame_z: largest difference in standard deviations; None where there are none.
        frame_shown: whether motion of links or torques could show it.
        mass, com, inertia: (before, after): kg, m and kg m² about the centre, in the link's frame.
        body_z: as `frame_z`, of the ten parameters; body_parameter: the one that differs most.
        body_shown: share of the difference that torques could show, 0 to 1.
        effects: by effect and parameter "effect.key": (before, after, z), None where there is none.
        torque_rms_nm: of the difference over the motion; torque_size_nm: of the first's torque.
    """

    joint: str
    link: str
    turn_rad: float
    shift_m: float
    frame_z: float | None
    frame_shown: bool
    mass: tuple[float, float]
    com: tuple[Array, Array]
    inertia: tuple[Array, Array]
    body_z: float | None
    body_parameter: str
    body_shown: float
    effects: Mapping[str, tuple[float | None, float | None, float | None]]
    torque_rms_nm: float
    torque_size_nm: float

    @property
    def frame_moved(self) -> bool:
        """Whether the frame is elsewhere."""
        return max(self.turn_rad, self.shift_m) > SAME_PLACE

    @property
    def body_changed(self) -> bool:
        """Whether the link weighs otherwise."""
        return any(
            not np.allclose(a, b, rtol=SAME, atol=SAME)
            for a, b in (self.mass, self.com, self.inertia)
        )


@dataclass(frozen=True)
class ModelDifference:
    """Two models beside each other.

    Attributes:
        names: of the two; joints: one for each.
        hand: of the frame whose place is compared, hand_rms_m and hand_max_m over the poses.
        others: gravity, tool and effects without a joint, in words.
    """

    names: tuple[str, str]
    joints: tuple[JointDifference, ...]
    hand: str
    hand_rms_m: float
    hand_max_m: float
    others: tuple[str, ...] = field(default=())


def documentation_of(model: SelfModel) -> SelfModel:
    """What the robot's own file says of a model's arm, or a robot known by the model's name.

    Raises:
        ModelError: the model does not know its file.
    """
    source, joints = model.source, model.tree.joint_names
    known = model.name.partition(" ")[0]  # "panda (learned)"
    if source is None and known in robot_names():
        return read_robot(known, joints, gravity=model.gravity)
    if source is None:
        raise ModelError(f"{model.name} does not know the file it came from; give a second model")
    lock = model.provenance.get(LOCKED, {})
    if source.text is None:
        return read_robot(source.file, joints, gravity=model.gravity, lock=lock)
    return model_from_urdf(source.text, source.file, joints, gravity=model.gravity, lock=lock)


def compare(first: SelfModel, second: SelfModel, seed: int = 0) -> ModelDifference:
    """What differs from one model to another of the same tree.

    Args:
        first, second: models of one arm on a fixed base.
        seed: of the motion over which torques and the hand's places are compared.

    Raises:
        ModelError: other trees; names the difference.
    """
    _check_trees(first, second)
    motion = _motion(first, seed)
    torques = [ModelTorque(model)(*motion) for model in (first, second)]
    change, size = (np.sqrt(np.mean(x**2, axis=0)) for x in (torques[1] - torques[0], torques[0]))
    hands = np.stack([_hand(model, motion[0][::EVERY]) for model in (first, second)])
    apart = np.linalg.norm(hands[1] - hands[0], axis=1)
    frames, bodies = _frames(first, second), _bodies(first, second)
    effects = _effects(first, second)
    joints = tuple(
        JointDifference(
            joint=first.tree.joint_names[j],
            link=first.tree.link_names[j],
            effects=effects.get(j, {}),
            torque_rms_nm=float(change[j]),
            torque_size_nm=float(size[j]),
            **frames[j],
            **bodies[j],
        )
        for j in range(first.tree.n)
    )
    rms = float(np.sqrt(np.mean(apart**2)))
    names = first.name, second.name
    return ModelDifference(
        names,
        joints,
        hand_frame(first).name,
        rms,
        float(apart.max()),
        _others(first, second, effects),
    )


def _check_trees(first: SelfModel, second: SelfModel) -> None:
    a, b = first.tree, second.tree
    for what in ("joint_names", "link_names", "parent", "floating"):
        one, other = getattr(a, what), getattr(b, what)
        if one != other:
            told = what.replace("_", " ")
            raise ModelError(
                f"{first.name} and {second.name} are different trees; {told}: {_listed(one)} and "
                f"{_listed(other)}"
            )
    if a.floating:
        raise ModelError(f"{first.name}: its base floats; only fixed-base arms are compared")


def _listed(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _motion(model: SelfModel, seed: int) -> tuple[Array, Array, Array]:
    """q, dq, ddq (m, n) of smooth random motion inside the limits, 1 ms apart."""
    rng = np.random.default_rng(seed)
    limits, n = model.limits, model.tree.n
    bounded = limits.upper > limits.lower  # False where unknown
    middle = np.where(bounded, 0.5 * (limits.upper + limits.lower), 0.0)
    reach = np.where(bounded, SHARE * (limits.upper - limits.lower), FREE_RAD)
    speed = np.where(limits.velocity > 0.0, SHARE * limits.velocity, FREE_RAD_S)
    t = STEP_S * np.arange(round(MOTION_S / STEP_S))
    w = 2.0 * np.pi * rng.uniform(*BAND_HZ, (SINES, 1, n))
    angle = w * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, (SINES, 1, n))
    size = rng.uniform(0.3, 1.0, (SINES, 1, n)) / w
    tables = (size * np.sin(angle), size * w * np.cos(angle), -size * w**2 * np.sin(angle))
    q, dq, ddq = (x.sum(axis=0) for x in tables)
    share = np.minimum(reach / np.abs(q).max(axis=0), speed / np.abs(dq).max(axis=0))
    return middle + share * q, share * dq, share * ddq


def _hand(model: SelfModel, q: Array) -> Array:
    """Places (m, 3) of the hand in the base, m."""
    frames, riding, n = frames_of(model.tree.parent, model.lam), hand_frame(model), model.tree.n
    R, o, places = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((len(q), 3))
    for k, row in enumerate(q):
        place_frames(frames, row, R, o)
        places[k] = o[-1] + R[-1] @ riding.position
    return places


def _z(change: Array, *stds: Array) -> float | None:
    """Largest |change| in standard deviations of two models; None where neither has any."""
    known = [np.nan_to_num(std) for std in stds]
    std = np.sqrt(sum(x**2 for x in known))
    has = std > 0.0
    return float(np.max(np.abs(change[has]) / std[has])) if has.any() else None


def _frames(first: SelfModel, second: SelfModel) -> list[dict[str, Any]]:
    """Of each joint what `JointDifference` says of its frame."""
    R, to_R = first.joint_rotation(), second.joint_rotation()
    p, to_p = first.lam[:, 3:], second.lam[:, 3:]
    turn, shift = log_rotation(to_R @ np.swapaxes(R, 1, 2)), to_p - p
    freedom = frame_observability(first.tree, first.lam, first.gravity).freedom
    near_R, near_p = freedom.nearest(R, p, to_R, to_p)
    left = np.hypot(
        np.linalg.norm(log_rotation(to_R @ np.swapaxes(near_R, 1, 2)), axis=1),
        np.linalg.norm(to_p - near_p, axis=1),
    )
    found = []
    for j in range(first.tree.n):
        change = np.r_[turn[j], shift[j]]
        found.append(
            {
                "turn_rad": float(np.linalg.norm(turn[j])),
                "shift_m": float(np.linalg.norm(shift[j])),
                "frame_z": _z(change, first.lam_std[j], second.lam_std[j]),
                "frame_shown": bool(left[j] > max(HIDDEN * np.linalg.norm(change), SAME)),
            }
        )
    return found


def _bodies(first: SelfModel, second: SelfModel) -> list[dict[str, Any]]:
    """Of each link what `JointDifference` says of its body."""
    wholes = [with_bodies(model) for model in (first, second)]
    a, b = (link_theta(whole) for whole in wholes)
    shown, size = _shown_part(first, a, b - a)
    found = []
    for j in range(first.tree.n):
        (_, *before), (_, *after) = body_from_theta(a[j]), body_from_theta(b[j])
        apart = (b - a)[j] / size[j]
        share = min(float(np.linalg.norm(shown[j])) / max(float(np.linalg.norm(apart)), SAME), 1.0)
        found.append(
            {
                "mass": (float(a[j, 0]), float(b[j, 0])),
                "com": (before[0], after[0]),
                "inertia": (before[1], after[1]),
                "body_z": _z((b - a)[j], first.theta_std[j], second.theta_std[j]),
                "body_parameter": PARAMETERS[int(np.argmax(np.abs(apart)))],
                "body_shown": float(share) if share > HIDDEN else 0.0,
            }
        )
    return found


def _shown_part(model: SelfModel, theta: Array, change: Array) -> tuple[Array, Array]:
    """(n, 10) what torques show of a change of θ, in units of the links' sizes, and these (n, 10).

    Of all changes that torques cannot tell from it the smallest one.
    """
    mass = np.maximum(theta[:, :1], 1e-3 * np.abs(theta[:, 0]).max())
    size = np.hstack([mass, np.repeat(0.1 * mass, 3, 1), np.repeat(0.01 * mass, 6, 1)])
    basis = base_parameters(model.tree, model.lam, model.gravity).basis * size.reshape(-1, 1)
    rows = np.linalg.qr(basis)[0]
    scaled = (change / size).ravel()
    return (rows @ (rows.T @ scaled)).reshape(size.shape), size


def _effects(
    first: SelfModel, second: SelfModel
) -> dict[int, dict[str, tuple[float | None, float | None, float | None]]]:
    """By joint (-1: none) the numbers of effects that differ, before and after, with z."""
    tables: list[dict[tuple[int, str], tuple[float, float]]] = []
    for model in (first, second):
        numbers: dict[tuple[int, str], tuple[float, float]] = {}
        for active in lasting_effects(model.effects, model.tree.n):
            for key, value in active.values.items():
                if np.ndim(value) == 0:
                    at = active.joint, f"{active.effect.name}.{key}"
                    numbers[at] = float(value), float(active.std.get(key) or 0.0)
        tables.append(numbers)
    found: dict[int, dict[str, tuple[float | None, float | None, float | None]]] = {}
    for at in sorted(tables[0].keys() | tables[1].keys()):
        a, b = (table.get(at) for table in tables)
        if a is not None and b is not None and abs(b[0] - a[0]) <= SAME * abs(a[0]):
            continue
        std = np.array([x[1] for x in (a, b) if x is not None])
        change = (b[0] if b else 0.0) - (a[0] if a else 0.0)
        z = _z(np.array([change]), np.array([np.linalg.norm(std)]))
        found.setdefault(at[0], {})[at[1]] = (a and a[0], b and b[0], z)
    return found


def _others(
    first: SelfModel, second: SelfModel, effects: Mapping[int, Mapping[str, Any]]
) -> tuple[str, ...]:
    """Gravity, tool and effects of the whole arm, where they differ, in words."""
    found = []
    if not np.allclose(first.gravity, second.gravity):
        pair = (" ".join(f"{x:.3g}" for x in model.gravity) for model in (first, second))
        found.append("gravity [{}] -> [{}] m/s²".format(*pair))
    masses = [0.0 if model.tool is None else model.tool.mass for model in (first, second)]
    if masses[0] != masses[1]:
        found.append(f"tool {masses[0]:.3f} -> {masses[1]:.3f} kg")
    return (*found, *(f"{key} {a} -> {b}" for key, (a, b, _) in effects.get(-1, {}).items()))
