"""Every file that we write means the same arm to Pinocchio, MuJoCo and PyBullet as to us.

PyBullet reads URDF alone: of an MJCF it drops every inertia that no shape gives.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pybullet
import pytest

from adapter.effects.robots import robot_mjcf, robot_urdf
from adapter.model.inertia import body_from_theta
from adapter.model.self_model import SelfModel, Tool
from adapter.model.spatial import at_joints, z_to_axis
from adapter.model.urdf import parse_urdf
from adapter.physics.rigid_arm import RigidArm
from tests.helpers.robot_models import (
    MACHINES,
    PANDA,
    SHARED,
    machine_urdf,
    places_of,
    random_urdf,
    read_quietly,
    set_angles,
)
from tests.model.test_onto import DRESSED, learned

HAND = SHARED / "models" / "panda_gaz2019_hand.urdf"


def for_pybullet(text: str) -> str:
    """Without what PyBullet gets wrong in an input: long axes, a base's turned inertia."""

    def unit(found: re.Match[str]) -> str:
        axis = np.array(found.group(1).split(), dtype=float)
        return '<axis xyz="{} {} {}"/>'.format(*(axis / np.linalg.norm(axis)))

    text = re.sub(r'(<link name="base">)<inertial>.*?</inertial>', r"\1", text, count=1)
    return re.sub(r'<axis xyz="([^"]*)"/>', unit, text)


ARMS = {
    "panda": PANDA.read_text(),
    "dressed": re.sub("<visual.*?</visual>", "", DRESSED, flags=re.DOTALL),
    "tree6": for_pybullet(random_urdf(6, seed=6)),
    "tree9": for_pybullet(random_urdf(9, seed=4)),
    "mixed9": for_pybullet(random_urdf(9, seed=5, sliding=0.5)),
    **{name: for_pybullet(machine_urdf(name)) for name in MACHINES},
    "hand": HAND.read_text() if HAND.exists() else for_pybullet(random_urdf(7, seed=7)),
}


@dataclass
class Answer:
    """Joint torques (n,) N m, and by link where its centre of mass is (3,), m."""

    tau: np.ndarray
    centres: Points


Names = tuple[str, ...]
Points = dict[str, np.ndarray]  # (3,) by link
Motion = tuple[dict[str, float], dict[str, float], dict[str, float]]  # q dq ddq by joint


def ours(model: SelfModel, motion: Motion, centres: Points) -> Answer:
    """What the model itself says; centres are where they are in their links' frames."""
    q, dq, ddq = (np.array([x[j] for j in model.tree.joint_names]) for x in motion)
    loaded = replace(model, theta=model.theta_with_tool(), tool=None)
    tau = RigidArm.of(loaded).torque(q[None], dq[None], ddq[None])[0]
    frames, places = {-1: (np.zeros(3), np.eye(3))}, {}
    for k, name in enumerate(model.tree.link_names):
        p, r = frames[model.tree.parent[k]]
        zero = model.joint_rotation()[k], model.lam[k, 3:]
        turn, place = at_joints(*zero, q[k], model.tree.slides[k])
        frames[k] = p + r @ place, r @ turn
        places[name] = frames[k][0] + frames[k][1] @ z_to_axis(model.axis[k]).T @ centres[name]
    return Answer(tau, places)


def by_pinocchio(path: Path, motion: Motion, names: Names, centres: Points) -> Answer:
    if path.suffix == ".urdf":
        oracle = pin.buildModelFromUrdf(str(path))
    else:
        oracle = pin.buildModelFromMJCF(str(path))
    q, (dq, ddq), data = pin.neutral(oracle), np.zeros((2, oracle.nv)), oracle.createData()
    at, (angles, *rates) = places_of(oracle, names), [[x[name] for name in names] for x in motion]
    set_angles(oracle, q, names, angles)
    dq[at], ddq[at] = rates
    tau = pin.rnea(oracle, data, q, dq, ddq)
    pin.framesForwardKinematics(oracle, data, q)
    frames = {name: data.oMf[oracle.getFrameId(name)] for name in centres}
    return Answer(tau[at], {name: frames[name].act(centres[name]) for name in centres})


def by_mujoco(path: Path, motion: Motion, names: Names, centres: Points) -> Answer:
    oracle = mujoco.MjModel.from_xml_path(str(path))
    oracle.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    oracle.dof_damping[:] = 0.0  # the file of the dressed robot has some, which stays in it
    data = mujoco.MjData(oracle)
    at, dofs = (
        [getattr(oracle.joint(name), key)[0] for name in names] for key in ("qposadr", "dofadr")
    )
    data.qpos[at], data.qvel[dofs], data.qacc[dofs] = ([x[name] for name in names] for x in motion)
    mujoco.mj_inverse(oracle, data)
    tau = data.qfrc_inverse[dofs]
    bodies = {name: data.body(name) for name in centres}
    places = {x: b.xpos + b.xmat.reshape(3, 3) @ centres[x] for x, b in bodies.items()}
    return Answer(tau, places)


def by_pybullet(path: Path, motion: Motion, names: Names, centres: Points) -> Answer:
    client = pybullet.connect(pybullet.DIRECT)
    at = {"physicsClientId": client}
    try:
        pybullet.setGravity(0, 0, -9.81, **at)
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        body = pybullet.loadURDF(str(path), useFixedBase=True, flags=flags, **at)
        infos = [
            pybullet.getJointInfo(body, k, **at) for k in range(pybullet.getNumJoints(body, **at))
        ]
        moving = [i[1].decode() for i in infos if i[2] != pybullet.JOINT_FIXED]
        rows = [[values.get(name, 0.0) for name in moving] for values in motion]
        tau = pybullet.calculateInverseDynamics(body, *rows, **at)
        for info in infos:
            pybullet.resetJointState(body, info[0], motion[0].get(info[1].decode(), 0.0), **at)
        places = {  # its links' frames come back in single precision
            info[12].decode(): np.array(
                pybullet.getLinkState(body, info[0], computeForwardKinematics=True, **at)[0]
            )
            for info in infos
        }
    finally:
        pybullet.disconnect(client)
    return Answer(np.array([tau[moving.index(name)] for name in names]), places)


READERS: dict[str, tuple[Callable[..., Answer], ...]] = {
    ".urdf": (by_pinocchio, by_mujoco, by_pybullet),
    ".xml": (by_pinocchio, by_mujoco),
}


@pytest.mark.parametrize("form", ["onto its URDF", "URDF alone", "MJCF alone"])
@pytest.mark.parametrize("arm", ARMS)
def test_three_engines_read_the_same_arm(arm: str, form: str, tmp_path: Path) -> None:
    """Of a learned arm with a tool, as a run leaves it."""
    tool = Tool(0.6, np.array([0.01, 0.02, 0.05]), np.diag([1e-3, 2e-3, 2.5e-3]))
    model = replace(learned(read_quietly(ARMS[arm]), seed=5), tool=tool)
    path = tmp_path / ("arm.xml" if "MJCF" in form else "arm.urdf")
    alone = "alone" in form
    written = robot_mjcf(model, alone=True) if "MJCF" in form else robot_urdf(model, alone=alone)
    path.write_text(written.text)
    names, rng = model.tree.joint_names, np.random.default_rng(2)
    text = written.text if path.suffix == ".urdf" else robot_urdf(model, alone=True).text
    links = parse_urdf(text, "arm").links
    for _ in range(3):
        values = rng.uniform(-1, 1, (3, len(names)))
        motion = tuple(dict(zip(names, x, strict=True)) for x in values)
        centres = {name: body_from_theta(links[name])[1] for name in model.tree.link_names}
        expected = ours(model, motion, centres)
        scale = max(1.0, float(np.abs(expected.tau).max()))
        for read in READERS[path.suffix]:
            found = read(path, motion, names, centres)
            assert np.abs(found.tau - expected.tau).max() < 1e-6 * scale, read.__name__
            for name, place in expected.centres.items():
                np.testing.assert_allclose(found.centres[name], place, atol=1e-9)
