"""Robots for the oracle tests, and Pinocchio's answers brought into the adapter's frames."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch

from adapter.errors import ModelWarning
from adapter.model.robot_file import MOVING
from adapter.model.self_model import SelfModel
from adapter.model.spatial import exp_rotation, rpy_from_matrix, z_to_axis
from adapter.model.urdf import model_from_urdf
from adapter.physics.networks import FrameMotion
from drivers.files.mcap import Log

SHARED = Path(__file__).parents[2].parent / "shared"
PANDA = Path(__file__).parents[2] / "adapter" / "model" / "robots" / "panda.urdf"
# Joints of machines, each on the one before: T turns, S slides along its axis. Fingers come last.
MACHINES = {
    "rail": ("S x", "T z", "T y", "T y", "T x", "T y", "T x"),
    "scara": ("T z", "T z", "S z", "T z"),
    "gantry": ("S x", "S y", "S z", "T z"),
    "gripper": ("T z", "T y", "T y", "T x", "S y", "S y"),
}
ROBOTS = (
    *("panda", "atlas", "talos", "lwr4", "tree5", "tree17", "tree33", "tree60"),
    *("mixed5", "mixed17", "mixed33", "mixed60", *MACHINES),
)
_FILES = {
    "atlas": "models/atlas_v5.urdf",
    "talos": "models/talos_reduced.urdf",
    "lwr4": "data/lwr4/kuka_lwr4.urdf",
}
_SPECIAL_AXES = ("1 0 0", "0 1 0", "0 0 1", "-1 0 0", "0 -1 0", "0 0 -1")


def shared(relative: str) -> Path:
    """A file of the shared folder; skips the test where there is none."""
    path = SHARED / relative
    if not path.exists():
        pytest.skip(f"{path} is not here: the shared folder stays with the project's makers")
    return path


@cache
def real_log() -> Log:
    """A real Panda in motion (Gaz et al. 2019), as it was measured; skips the test likewise."""
    folder = shared("data/panda_gaz2019")
    names = ("time", "positions", "velocity", "torques")
    t, *signals = (np.loadtxt(folder / f"exciting_traj_{name}.txt") for name in names)
    stamps = np.round(1e9 * t).astype(np.int64)
    joints = tuple(f"panda_joint{k}" for k in range(1, 8))
    return Log(Path("real.mcap"), joints, stamps, *(x.reshape(-1, 7) for x in signals))


def file_of(name: str) -> str:
    """Text of a file of `tests/helpers/files`."""
    return (Path(__file__).parent / "files" / name).read_text(encoding="utf-8")


def urdf_text(name: str) -> str:
    """The URDF of a robot of `ROBOTS`."""
    if name in MACHINES:
        return machine_urdf(name)
    for kind, sliding in (("tree", 0.0), ("mixed", 0.5)):
        if name.startswith(kind):
            links = int(name.removeprefix(kind))
            return random_urdf(links, seed=links, sliding=sliding)
    path = PANDA if name == "panda" else shared(_FILES[name])
    return path.read_text()


def machine_urdf(name: str) -> str:
    """One of `MACHINES`, its bodies at random; both fingers of a gripper are on its hand."""
    rng, parts, parent, joints = np.random.default_rng(5), [], "base", MACHINES[name]
    parts.append(_link("base", rng))
    for k, joint in enumerate(joints):
        kind, along = joint.split()
        limit = '<limit lower="-0.8" upper="0.9" velocity="2" effort="300"/>'
        xyz, axis = text_of(rng.uniform(0.05, 0.3, 3)), text_of(np.eye(3)["xyz".index(along)])
        parts += [
            _link(f"l{k + 1}", rng),
            f'<joint name="j{k + 1}" type="{"revolute" if kind == "T" else "prismatic"}">'
            f'<parent link="{parent}"/><child link="l{k + 1}"/><origin xyz="{xyz}" rpy="0 0 0"/>'
            f'<axis xyz="{axis}"/>{limit}</joint>',
        ]
        parent = f"l{k + 1}" if name != "gripper" or kind == "T" else parent
    return f'<robot name="{name}">\n' + "\n".join(parts) + "\n</robot>"


def random_urdf(links: int, seed: int, sliding: float = 0.0) -> str:
    """A tree of `links` moving links with any axes, some fixed links with mass among them.

    Args:
        links, seed: how many, and of what; sliding: share of the joints that slide.
    """
    rng = np.random.default_rng(seed)
    parts = [_link("base", rng)]
    names = ["base"]
    moving = 0
    while moving < links:
        name = f"l{len(names)}"
        parent = names[int(rng.integers(max(0, len(names) - 6), len(names)))]
        fixed = bool(rng.random() < 0.25)
        moving += not fixed
        parts += [_link(name, rng), _joint(name, parent, fixed, rng, sliding)]
        names.append(name)
    return '<robot name="random">\n' + "\n".join(parts) + "\n</robot>"


def text_of(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


def _link(name: str, rng: np.random.Generator) -> str:
    points, mass = rng.normal(size=(8, 3)) * 0.1, float(rng.uniform(0.2, 5.0))
    xyz, rpy = text_of(rng.normal(size=3) * 0.1), text_of(rng.uniform(-3, 3, 3))
    return link_text(name, mass, points, f'xyz="{xyz}" rpy="{rpy}"')


def link_text(name: str, mass: float, points: np.ndarray, origin: str) -> str:
    """A link with the inertia of point masses (k, 3), which is always a possible one."""
    second = mass * np.cov(points.T)
    i = np.trace(second) * np.eye(3) - second
    keys = {"ixx": i[0, 0], "ixy": i[0, 1], "ixz": i[0, 2]}
    keys |= {"iyy": i[1, 1], "iyz": i[1, 2], "izz": i[2, 2]}
    six = " ".join(f'{k}="{float(v)!r}"' for k, v in keys.items())
    return (
        f'<link name="{name}"><inertial><origin {origin}/>'
        f'<mass value="{mass!r}"/><inertia {six}/></inertial></link>'
    )


def _joint(name: str, parent: str, fixed: bool, rng: np.random.Generator, sliding: float) -> str:
    special = bool(rng.random() < 0.5)
    axis = str(rng.choice(_SPECIAL_AXES)) if special else text_of(rng.normal(size=3))
    kind = "fixed" if fixed else str(rng.choice(["revolute", "continuous"]))
    if sliding and not fixed and rng.random() < sliding:
        kind = "prismatic"
    limit = '<limit lower="-2" upper="2" velocity="3" effort="50"/>'
    limit = "" if kind == "continuous" else limit
    xyz = text_of(rng.normal(size=3) * 0.3)
    rpy = text_of(rpy_from_matrix(exp_rotation(rng.normal(size=3))))
    return (
        f'<joint name="j_{name}" type="{kind}"><parent link="{parent}"/><child link="{name}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>'
    )


def read_quietly(text: str, floating: bool = False) -> SelfModel:
    """The model of a URDF's text, warnings aside; all that slides is free where nothing mimics."""
    kinds = re.findall(r'<joint name="([^"]*)" type="([^"]*)"', text)
    joints = [name for name, kind in kinds if kind in MOVING]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return model_from_urdf(text, joints=None if "<mimic" in text else joints, floating=floating)


@dataclass
class Case:
    """A robot in random motion: joint signals, base, and what Pinocchio makes of them."""

    model: SelfModel
    q: torch.Tensor
    dq: torch.Tensor
    ddq: torch.Tensor
    base: torch.Tensor | FrameMotion
    motion: FrameMotion
    tau: np.ndarray


def pinocchio_case(text: str, floating: bool, samples: int = 5, seed: int = 1) -> Case:
    """Random motion of a robot, its link motion and torques by Pinocchio, in our frames."""
    model = read_quietly(text, floating)
    oracle = pin_model(text, floating)
    rng = np.random.default_rng(seed)
    signals, motions, torques, bases = [], [], [], []
    for _ in range(samples):
        q, dq, ddq = rng.uniform(-3, 3, model.tree.n), *rng.normal(size=(2, model.tree.n)) * 2
        # Pinocchio's q, v, a; the base in random motion where it floats
        full_q, full_v, full_a = pin.neutral(oracle), np.zeros(oracle.nv), np.zeros(oracle.nv)
        if model.tree.floating:
            quaternion = rng.normal(size=4)
            full_q[:3], full_q[3:7] = rng.normal(size=3), quaternion / np.linalg.norm(quaternion)
            full_v[:6], full_a[:6] = rng.normal(size=6), rng.normal(size=6) * 3
        names = model.tree.joint_names
        set_angles(oracle, full_q, names, q)
        places = places_of(oracle, names)
        full_v[places], full_a[places] = dq, ddq
        full = full_q, full_v, full_a
        data = oracle.createData()
        pin.forwardKinematics(oracle, data, *full)
        gravity = oracle.gravity.linear
        bodies = [_body(oracle, data, model, name, gravity) for name in model.tree.joint_names]
        if floating:
            root = frame_motion(oracle, data, 1, np.eye(3), gravity)
            bases.append(root)
            bodies.insert(0, root)
        signals.append((q, dq, ddq))
        motions.append(np.stack(bodies))
        torques.append(_torques(oracle, pin.rnea(oracle, data, *full), model))
    motion = FrameMotion(*(torch.from_numpy(np.stack(motions)[:, :, k]) for k in range(4)))
    if floating:
        base: torch.Tensor | FrameMotion = FrameMotion(
            *(torch.from_numpy(np.stack(bases)[:, k]) for k in range(4))
        )
    else:
        base = torch.from_numpy(model.gravity)
    q_t, dq_t, ddq_t = (torch.from_numpy(np.stack(x)) for x in zip(*signals, strict=True))
    return Case(model, q_t, dq_t, ddq_t, base, motion, np.stack(torques))


def pin_model(text: str, floating: bool = False) -> pin.Model:
    """Pinocchio's model of a URDF."""
    if floating:
        return pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
    return pin.buildModelFromXML(text)


def set_angles(oracle, full, names, angles) -> None:  # type: ignore[no-untyped-def]
    """Put the angles of joints into a configuration of Pinocchio's."""
    for name, angle in zip(names, angles, strict=True):
        joint = oracle.joints[oracle.getJointId(name)]
        turn = [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
        full[joint.idx_q : joint.idx_q + joint.nq] = turn


def places_of(oracle, names) -> list[int]:  # type: ignore[no-untyped-def]
    """Where joints stand in Pinocchio's velocities and torques."""
    return [oracle.joints[oracle.getJointId(name)].idx_v for name in names]


def _body(oracle, data, model, joint, gravity):  # type: ignore[no-untyped-def]
    turn = z_to_axis(model.axis[model.tree.joint_names.index(joint)])
    return frame_motion(oracle, data, oracle.getJointId(joint), turn, gravity)


def frame_motion(oracle, data, number, turn, gravity):  # type: ignore[no-untyped-def]
    """[v w a dw] (4, 3) of a joint's frame, turned; `a` as an accelerometer reads it."""
    twist = data.v[number]
    accel = pin.getClassicalAcceleration(oracle, data, number, pin.LOCAL)
    lifted = accel.linear - data.oMi[number].rotation.T @ gravity
    return np.stack([twist.linear, twist.angular, lifted, accel.angular]) @ turn


def _torques(oracle, tau, model):  # type: ignore[no-untyped-def]
    own = tau[places_of(oracle, model.tree.joint_names)]
    return np.concatenate([tau[:6] if model.tree.floating else [], own])


def relative(found: object, expected: object) -> float:
    """Largest error over the largest expected magnitude."""
    a, b = np.asarray(found), np.asarray(expected)
    assert a.shape == b.shape
    return float(np.max(np.abs(a - b)) / np.max(np.abs(b)))


def entry(name: str, joints: Iterable[int] = (), **parameters: object) -> dict[str, object]:
    """Of a model's effects."""
    return {"effect": name, "joints": list(joints), "parameters": parameters}
