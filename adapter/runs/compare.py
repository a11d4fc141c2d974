"""Two models of one arm: each thing that differs, and what it alone does."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from adapter.effects.active import Active, lasting_effects, with_bodies
from adapter.effects.robots import read_robot
from adapter.effects.torque import ModelTorque
from adapter.errors import ModelError
from adapter.gap.hand import hand_frame
from adapter.model import robot_names
from adapter.model.inertia import body_from_theta
from adapter.model.locking import LOCKED
from adapter.model.onto import SAME_PLACE
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array, log_rotation
from adapter.model.urdf import model_from_urdf
from adapter.physics.identifiability import BODY_SIZE, base_parameters, frame_observability
from adapter.physics.kernels import frames_of, place_frames

MOTION_S, STEP_S, EVERY = 8.0, 1e-3, 20  # motion that torques are compared on; rows between poses
SINES, BAND_HZ = 5, (0.1, 0.6)
SHARE = 0.45  # of the range and of the documented speed
SAME = 1e-9  # of a number's size, rad and m: rounding
HIDDEN = 1e-3  # share of a difference that data could show, below which none could
SIGNIFICANT = 4.0  # standard deviations: the largest of a body's ten numbers is rarely above it
NOTHING = 1e-6  # N m and m: a change that does no more does nothing
FRAME, BODY, GRAVITY, TOOL = "frame", "body", "gravity", "tool"


@dataclass(frozen=True)
class Change:
    """One thing that differs, second model less first.

    Attributes:
        what: FRAME of a joint, BODY of a link, GRAVITY, TOOL, or the name of an effect.
        joint, link: names of the joint and of the link that it moves; "" of the whole arm.
        values: by what is told, (before, after); None where one model has it not. Of a frame
            "turn_rad" and "shift_m" in its parent's, from zero; of a body "mass_kg", "com_m" and
            "inertia_kg_m2" (about the centre), in the link's frame; of an effect its parameters.
        units: of the values, by the same keys.
        z: the largest difference in standard deviations, of a body in what torques show of it;
            None where there are none.
        shown: share of the difference that data could show, 0 to 1.
        torque_nm: rms of what it alone does to the torque of the joint that it tells on most, of a
            body with standard deviations what torques show of it; torque_joint: that joint.
        hand_m: rms of how far it alone moves the hand.
    """

    what: str
    joint: str = ""
    link: str = ""
    values: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    z: float | None = None
    shown: float = 1.0
    torque_nm: float = 0.0
    torque_joint: str = ""
    hand_m: float = 0.0

    @property
    def significant(self) -> bool:
        """Whether it is more than noise, as far as that is known."""
        return self.z is None or self.z >= SIGNIFICANT

    @property
    def matters(self) -> bool:
        """Whether it does anything to torques or to the hand's place."""
        return max(self.torque_nm, self.hand_m) > NOTHING


@dataclass(frozen=True)
class ModelDifference:
    """Two models beside each other.

    Attributes:
        names: of the two; joints: names of the joints.
        changes: what does most to torques and to the hand's place first.
        torque_nm: (n,) rms of the difference of torques; torque_size_nm: of the first's torques.
        hand: the frame whose place is compared; hand_rms_m, hand_max_m: how far it is elsewhere.
    """

    names: tuple[str, str]
    joints: tuple[str, ...]
    changes: tuple[Change, ...]
    torque_nm: Array
    torque_size_nm: Array
    hand: str
    hand_rms_m: float
    hand_max_m: float


Variant = tuple[Change, SelfModel]  # a change, and the first model with this change alone


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

    What effects do to bodies and to gravity (a payload, a tilt) is told as these.

    Args:
        first, second: models of one arm on a fixed base.
        seed: of the motion over which torques and the hand's places are compared.

    Raises:
        ModelError: other trees; names the difference.
    """
    _check_trees(first, second)
    first, second = with_bodies(first), with_bodies(second)
    motion = _motion(first, seed)
    torque, hand = ModelTorque(first)(*motion), _hand(first, motion[0][::EVERY])
    joints = first.tree.joint_names

    def done(model: SelfModel) -> tuple[Array, Array]:
        """Rms (n,) of what another model does to torques; distances (poses,) of the hand."""
        apart = _hand(model, motion[0][::EVERY]) - hand
        error = ModelTorque(model)(*motion) - torque
        return np.sqrt(np.mean(error**2, axis=0)), np.linalg.norm(apart, axis=1)

    changes = []
    for change, alone in _variants(first, second):
        rms, apart = done(alone)
        most, way = int(np.argmax(rms)), float(np.sqrt(np.mean(apart**2)))
        change = replace(change, torque_nm=float(rms[most]), torque_joint=joints[most], hand_m=way)
        changes.append(change)
    rms, apart = done(second)
    size = np.sqrt(np.mean(torque**2, axis=0))
    # what does most first, against the arm's largest torque and its reach
    most_nm = max(float(size.max()), NOTHING)
    reach_m = max(float(np.linalg.norm(hand, axis=1).max()), NOTHING)
    changes.sort(key=lambda c: -(c.torque_nm / most_nm + c.hand_m / reach_m))
    away = hand_frame(first).name, float(np.sqrt(np.mean(apart**2))), float(apart.max())
    names = first.name, second.name
    return ModelDifference(names, joints, tuple(changes), rms, size, *away)


def _variants(first: SelfModel, second: SelfModel) -> Iterator[Variant]:
    """All that differs."""
    yield from _frames(first, second)
    yield from _bodies(first, second)
    yield from _effects(first, second)
    if not np.allclose(first.gravity, second.gravity):
        pair = {GRAVITY: (first.gravity, second.gravity)}
        turned = replace(first, gravity=second.gravity)
        yield Change(GRAVITY, values=pair, units={GRAVITY: "m/s²"}), turned
    tools = tuple(model.theta_with_tool() - model.theta for model in (first, second))
    if not np.allclose(tools[0], tools[1], rtol=SAME, atol=SAME):
        masses = tuple(float(theta[:, 0].sum()) for theta in tools)
        values = {"mass_kg": (masses[0], masses[1])}
        yield Change(TOOL, values=values, units={"mass_kg": "kg"}), replace(first, tool=second.tool)


def _check_trees(first: SelfModel, second: SelfModel) -> None:
    a, b = first.tree, second.tree
    for what in ("joint_names", "link_names", "parent", "floating"):
        one, other = getattr(a, what), getattr(b, what)
        if one != other:
            told, way = what.replace("_", " "), ""
            if {*a.joint_names} < {*b.joint_names} or {*b.joint_names} < {*a.joint_names}:
                way = "; --joints A,B,C compares these, --lock JOINT=VALUE takes one away"
            listed = (x if isinstance(x, tuple) else (x,) for x in (one, other))
            both = " and ".join(", ".join(map(str, x)) for x in listed)
            names = f"{first.name} and {second.name}"
            raise ModelError(f"{names} are different trees; {told}: {both}{way}")
    if a.floating:
        raise ModelError(f"{first.name}: its base floats; only fixed-base arms are compared")


def _motion(model: SelfModel, seed: int) -> tuple[Array, Array, Array, Array]:
    """q, dq, ddq (m, n) and t (m,) of smooth random motion inside the limits."""
    rng = np.random.default_rng(seed)
    limits, n = model.limits, model.tree.n
    bounded = limits.upper > limits.lower  # False where unknown
    middle = np.where(bounded, 0.5 * (limits.upper + limits.lower), 0.0)
    reach = np.where(bounded, SHARE * (limits.upper - limits.lower), 1.5)  # rad
    speed = np.where(limits.velocity > 0.0, SHARE * limits.velocity, 1.0)  # rad/s
    t: Array = STEP_S * np.arange(round(MOTION_S / STEP_S), dtype=np.float64)
    w = 2.0 * np.pi * rng.uniform(*BAND_HZ, (SINES, 1, n))
    angle = w * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, (SINES, 1, n))
    size = rng.uniform(0.3, 1.0, (SINES, 1, n)) / w
    tables = (size * np.sin(angle), size * w * np.cos(angle), -size * w**2 * np.sin(angle))
    q, dq, ddq = (x.sum(axis=0) for x in tables)
    share = np.minimum(reach / np.abs(q).max(axis=0), speed / np.abs(dq).max(axis=0))
    return middle + share * q, share * dq, share * ddq, t


def _hand(model: SelfModel, q: Array) -> Array:
    """Places (m, 3) of the hand in the base, m."""
    frames, riding, n = frames_of(model.tree, model.lam), hand_frame(model), model.tree.n
    R, o, places = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((len(q), 3))
    for k, row in enumerate(q):
        place_frames(frames, row, R, o)
        places[k] = o[-1] + R[-1] @ riding.position
    return places


def _z(change: Array, *stds: Array) -> float | None:
    """Largest |change| in standard deviations of two models; None where neither has any."""
    std = np.sqrt(sum(np.nan_to_num(std) ** 2 for std in stds))
    has = std > 0.0
    return float(np.max(np.abs(change[has]) / std[has])) if has.any() else None


def _frames(first: SelfModel, second: SelfModel) -> Iterator[Variant]:
    """Joints whose frames are elsewhere."""
    R, to_R = first.joint_rotation(), second.joint_rotation()
    p, to_p = first.lam[:, 3:], second.lam[:, 3:]
    turn, shift = log_rotation(to_R @ np.swapaxes(R, 1, 2)), to_p - p
    freedom = frame_observability(first.tree, first.lam, first.gravity).freedom
    near_R, near_p = freedom.nearest(R, p, to_R, to_p)
    left_turn = np.linalg.norm(log_rotation(to_R @ np.swapaxes(near_R, 1, 2)), axis=1)
    left = np.hypot(left_turn, np.linalg.norm(to_p - near_p, axis=1))
    for j, (joint, link) in enumerate(_names(first)):
        ways = float(np.linalg.norm(turn[j])), float(np.linalg.norm(shift[j]))
        if max(ways) <= SAME_PLACE:
            continue
        z = _z(np.r_[turn[j], shift[j]], first.lam_std[j], second.lam_std[j])
        shown = float(left[j] > max(HIDDEN * np.hypot(*ways), SAME))
        values = {"turn_rad": (0.0, ways[0]), "shift_m": (0.0, ways[1])}
        lam = first.lam.copy()
        lam[j] = second.lam[j]
        units = {"turn_rad": "rad", "shift_m": "m"}
        yield Change(FRAME, joint, link, values, units, z, shown), replace(first, lam=lam)


def _bodies(first: SelfModel, second: SelfModel) -> Iterator[Variant]:
    """Links that weigh otherwise."""
    change = second.theta - first.theta
    shown_map = base_parameters(second.tree, second.lam, second.gravity).shown_map()
    shown = (shown_map @ change.ravel()).reshape(change.shape)
    units = {"mass_kg": "kg", "com_m": "m", "inertia_kg_m2": "kg m²"}
    for j, (joint, link) in enumerate(_names(first)):
        before, after = body_from_theta(first.theta[j]), body_from_theta(second.theta[j])
        pairs = list(zip(before, after, strict=True))
        if all(np.allclose(a, b, rtol=SAME, atol=SAME) for a, b in pairs):
            continue
        part, whole = (float(np.linalg.norm(x[j] / BODY_SIZE)) for x in (shown, change))
        share = min(part / whole, 1.0)
        share = share if share > HIDDEN else 0.0
        z = _z(shown[j], first.theta_std[j], second.theta_std[j]) if share else None
        theta = first.theta.copy()
        theta[j] += change[j] if z is None else shown[j]  # what is noise cancels in torques
        values = dict(zip(units, pairs, strict=True))
        yield Change(BODY, joint, link, values, units, z, share), replace(first, theta=theta)


def _names(model: SelfModel) -> Iterator[tuple[str, str]]:
    """Names of each joint and of the link that it moves."""
    return zip(model.tree.joint_names, model.tree.link_names, strict=True)


def _effects(first: SelfModel, second: SelfModel) -> Iterator[Variant]:
    """Effects whose numbers differ, by joint."""
    tables, n = [], first.tree.n
    for model in (first, second):
        table: dict[tuple[int, str], list[Active]] = {}
        for active in lasting_effects(model.effects, n):
            table.setdefault((active.joint, active.effect.name), []).append(active)
        tables.append(table)
    names = [*_names(first), ("", "")]  # the last of what has no joint
    for at in sorted(tables[0].keys() | tables[1].keys()):
        was, now = (table.get(at, []) for table in tables)
        before, after = ({k: v for a in found for k, v in a.values.items()} for found in (was, now))
        pairs = {key: (before.get(key), after.get(key)) for key in before | after}
        values = {key: pair for key, pair in pairs.items() if not _same(*pair)}
        if not values:
            continue
        std = [{k: s for a in found for k, s in a.std.items()} for found in (was, now)]
        units = (was or now)[0].effect.units()
        others = [a for key, found in tables[0].items() if key != at for a in found]
        changed = replace(first, effects=tuple(a.entry for a in (*others, *now)))
        z = []  # a number that is not there is zero
        for key, (a, b) in values.items():
            stds = (np.atleast_1d(np.asarray(s.get(key) or 0.0, dtype=float)) for s in std)
            apart = np.subtract(0.0 if b is None else b, 0.0 if a is None else a)
            z.append(_z(np.atleast_1d(apart), *stds))
        largest = max((x for x in z if x is not None), default=None)
        yield Change(at[1], *names[at[0]], values, units, largest), changed


def _same(a: Any, b: Any) -> bool:
    return a is not None and b is not None and np.allclose(a, b, rtol=SAME, atol=0.0)
