"""Effects step by step: nothing counts twice, friction holds still, other loops work as well."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pybullet
import pytest

from adapter.effects.robots import additions, robot_mjcf, robot_urdf
from adapter.errors import MeansError, ModelError, SettingsError
from adapter.model.filled import MJCF_PLACES, joint_attributes
from adapter.model.self_model import SelfModel
from adapter.simulate import FORMATS, SIMULATORS, Effects, MujocoArm, Rollouts
from sim.effects import Effect
from sim.truth import panda
from tests.helpers.arm_data import pin_model
from tests.simulate.test_rollouts import PANDA, model_with

READY = np.array([0.0, -0.8, 0.0, -2.3, 0.0, 1.6, 0.8])
DQ = np.array([0.4, -0.5, 0.6, 0.3, -0.7, 0.8, -0.9])
STILL = np.zeros(7)
RIGID = pin_model(panda())
LOSSES = (
    Effect("viscous_friction", (1, 5), {"Fv": 0.6}),
    Effect("coulomb_friction", (2, 7), {"Fc": 0.5}),
    Effect("stribeck_friction", (4,), {"Fc": 0.4, "Fs": 1.0, "vs": 0.1}),
    Effect("asymmetric_friction", (6,), {"Fc_pos": 0.5, "Fc_neg": 0.2}),
    Effect("motor_inertia", (3, 6), {"B": 0.1}),
    Effect("joint_spring", (5,), {"k": 1.5, "q0": 0.3}),
)
STICKING = (
    Effect("coulomb_friction", (1, 5, 6, 7), {"Fc": 0.5}),
    Effect("stribeck_friction", (2, 3, 4), {"Fc": 0.5, "Fs": 1.2, "vs": 0.05}),
)


def torque_of(q: np.ndarray, dq: np.ndarray = STILL, ddq: np.ndarray = STILL) -> np.ndarray:
    """(n,) N m of the bare arm, by Pinocchio."""
    return pin.rnea(RIGID, RIGID.createData(), q, dq, ddq)


def placed(simulator: str, model: SelfModel, dq: np.ndarray = STILL) -> Any:
    """An arm in its ready pose."""
    arm = SIMULATORS[simulator](model)
    arm.place(READY, dq)
    return arm


def test_friction_goes_with_the_load_of_this_very_step() -> None:
    """The load is the rigid torque at the acceleration that comes out, by Pinocchio."""
    tau = np.array([5.0, -30.0, 8.0, 20.0, 1.0, 2.0, 0.1])
    model = model_with(Effect("load_dependent_friction", (1, 2, 3), {"Fl": 0.1}))
    added = Effects(model, 1e-6, "bodies")(READY, DQ, None, tau, 0.0)
    load = torque_of(READY, DQ, pin.aba(RIGID, RIGID.createData(), READY, DQ, tau + added))
    expected = -0.1 * np.abs(load[:3]) * np.sign(DQ[:3])
    np.testing.assert_allclose(added[:3], expected, atol=0.02 * np.abs(load).max())


@pytest.mark.parametrize("holds", list(FORMATS))
def test_what_the_file_holds_is_not_added_again(holds: str) -> None:
    """Each format loses what it holds by itself; with the rest the arm moves the same."""
    model, h = model_with(*LOSSES), 1e-5
    whole = _acceleration(model, "bodies", h)
    np.testing.assert_allclose(_acceleration(model, holds, h), whole, rtol=1e-3)
    assert np.abs(Effects(model, h, holds)(READY, DQ, None, STILL, 0.0)).max() > 0.1
    if holds == "mjcf":  # holds all of these
        held = model_with(LOSSES[0], LOSSES[1], LOSSES[4], LOSSES[5])
        assert np.abs(Effects(held, h, holds)(READY, DQ, None, STILL, 0.0)).max() < 1e-9
        drag = {"effect": "law: dq³", "joints": [2], "parameters": {"c": 0.3}}
        held = replace(held, effects=(*held.effects, drag))  # by its slope within a step
        assert np.abs(Effects(held, h, holds)(READY, DQ, None, STILL, 0.0)).max() < 1e-7


def _acceleration(model: SelfModel, holds: str, h: float) -> np.ndarray:
    """(n,) rad/s² of one step; losses of the file by hand, as a simulator takes them."""
    M = np.triu(pin.crba(RIGID, RIGID.createData(), READY))
    M = M + np.triu(M, 1).T
    push = Effects(model, h, holds)(READY, DQ, None, torque_of(READY, DQ), 0.0)
    parts = {
        "pybullet": ("damping",),
        "bodies": (),
        "bodies and armature": ("armature",),
        "urdf": ("damping", "frictionloss"),
    }
    more = additions(model, tuple(MJCF_PLACES))
    every = ("damping", "frictionloss", "armature", "stiffness", "springref")
    D, F, A, K, ref = (
        np.array([joint_attributes(more, j).get(key, 0.0) for j in range(7)])
        * (key in parts.get(holds, every))
        for key in every
    )
    push = push - F * np.sign(DQ) - K * (READY - ref) - D * DQ
    return np.linalg.solve(M + np.diag(A + h * D), push)


@pytest.mark.parametrize("simulator", list(SIMULATORS))
def test_friction_holds_still_without_chattering(simulator: str) -> None:
    """At 1 ms, under a torque below friction: the arm creeps less than a hand's unrest."""
    arm, hold = placed(simulator, model_with(*STICKING)), torque_of(READY)
    push = 0.4 * np.array([1, -1, 1, -1, 1, -1, 1])
    speeds = []
    for _ in range(500):
        arm.step(hold + push)
        speeds.append(arm.state()[1])
    arm.close()
    late = np.array(speeds)[100:]
    assert np.abs(late).max() < 0.02  # law: tanh(dq / 0.01) reaches 0.8 at 0.011 rad/s
    assert np.abs(np.diff(late, axis=0)).max() < 1e-3  # no speed that jumps to and fro
    assert (late * np.sign(push) > -1e-6).all()


@pytest.mark.parametrize("simulator", list(SIMULATORS))
@pytest.mark.parametrize(("s0", "falls"), [(1e-5, {}), (4e-3, {}), (4e-3, {"Fs": 0.5, "vs": 0.3})])
def test_bristles_wind_up_and_hold(simulator: str, s0: float, falls: dict[str, float]) -> None:
    """A push that slowly rises to 0.6 Fc winds a joint up by -s0 ln(1 - 0.6), and no further."""
    joints, level = tuple(range(1, 8)), 0.5
    damped = model_with(Effect("viscous_friction", joints, {"Fv": 5.0}))  # or it swings on bristles
    name, more = ("stribeck", falls | {"Fc": 0.3}) if falls else ("bristle", {"Fc": level})
    rubs = {"effect": f"{name}_friction", "joints": list(joints), "parameters": more | {"s0": s0}}
    model = replace(damped, effects=(*damped.effects, rubs))
    arm, way = placed(simulator, model), np.array([1, -1, 1, -1, 1, -1, 1])
    for k in range(1000):
        arm.step(torque_of(arm.state()[0]) + 0.6 * level * min(k / 700, 1.0) * way)
    wound = (arm.state()[0] - READY) * way
    arm.close()
    assert (wound < 2e-4 + 1.2 * s0).all()  # a way below 0.1 mrad is taken as longer
    if s0 > 1e-3:
        np.testing.assert_allclose(wound, -s0 * np.log(0.4), rtol=0.15)


@pytest.mark.parametrize("simulator", list(SIMULATORS))
def test_a_joint_comes_to_rest(simulator: str) -> None:
    arm = placed(simulator, model_with(*STICKING), 0.3 * DQ)
    for _ in range(1000):
        arm.step(torque_of(*arm.state()))
    _, dq = arm.state()
    arm.close()
    assert np.abs(dq).max() < 1e-4


def test_sensors_read_what_the_effects_say() -> None:
    effects = Effects(
        model_with(
            Effect("encoder_offset", (1,), {"o": 0.02}),
            Effect("encoder_ripple", (2,), {"a": 0.01, "phase": 0.2}),
            Effect("joint_elasticity", (3,), {"k": 3000.0}),
            Effect("backlash", (4,), {"b": 0.008}),
            Effect("torque_gain", (5,), {"g": 0.06}),
            Effect("torque_offset", (6,), {"o": 0.5}),
            Effect("signal_delay", (7,), {"d": 0.002}),
        )
    )
    tau = np.array([1.0, 2.0, 30.0, 4.0, 5.0, 6.0, 0.0])
    for k in range(40):
        t = 1e-3 * k
        tau[6] = 2.0 * t
        q, dq, read = effects.measured(READY, DQ, tau.copy(), t)
    # the encoder's offset is in the zero of the file already
    expected = READY + np.array([0.0, 0.01 * np.sin(READY[1] + 0.2), 0.01, 0.004, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(q, expected, atol=1e-12)
    np.testing.assert_allclose(read, [1.0, 2.0, 30.0, 4.0, 5.3, 6.5, 2.0 * 0.037], atol=1e-9)
    ripple = 0.01 * np.cos(READY[1] + 0.2) * DQ[1]
    np.testing.assert_allclose(dq, DQ + np.array([0, ripple, 0, 0, 0, 0, 0]), atol=1e-12)
    effects.reset()
    assert effects.measured(READY, -DQ, tau, 0.0)[0][3] == pytest.approx(READY[3] - 0.004)


def test_plain_mj_steps_have_the_effects() -> None:
    """A file with losses of its own, stepped by anybody, moves as our loop moves the bare arm."""
    model = model_with(*LOSSES)
    theirs = mujoco.MjModel.from_xml_string(robot_urdf(replace(model, frames=()), alone=True).text)
    theirs.opt.timestep = 1e-3
    data = mujoco.MjData(theirs)
    wrapped, own = MujocoArm(model, (theirs, data)), MujocoArm(model)
    wrapped.put(READY, DQ)
    own.put(READY, DQ)
    tau = np.array([1.0, -20.0, 2.0, 18.0, 0.3, 1.8, 0.1])
    data.qfrc_applied[:] = tau
    with wrapped.acting():
        for _ in range(200):
            mujoco.mj_step(theirs, data)
    for _ in range(200):
        own.advance(tau + own.effects(*own.read(), None, tau, own.data.time))
    np.testing.assert_allclose(wrapped.read()[0], own.read()[0], atol=1e-4)
    assert np.abs(own.read()[0] - READY).max() > 0.02
    assert mujoco.get_mjcb_passive() is None


@pytest.mark.parametrize("simulator", list(SIMULATORS))
def test_a_loop_of_ones_own_around_an_exported_file(simulator: str, tmp_path: Path) -> None:
    """The file with what it holds and the effects with the rest move as our loop does."""
    ripple = Effect("torque_ripple", (1,), {"a": 4.0, "n": 6.0, "phase": 1.0})
    model, tau = model_with(*LOSSES, ripple), np.array([1.0, -20.0, 2.0, 18.0, 0.3, 1.8, 0.1])
    ours = SIMULATORS[simulator](model)
    ours.put(READY, DQ)
    for _ in range(150):
        ours.advance(tau + ours.effects(*ours.read(), None, tau, 0.0))
    q, _ = ours.read()
    ours.close()
    own = {"mujoco": _own_mujoco, "pybullet": _own_pybullet}[simulator]
    with_them, without = (own(model, tau, tmp_path, share) for share in (1.0, 0.0))
    assert np.abs(with_them - q).max() < 5e-3  # MuJoCo's own dry friction is a soft one
    assert np.abs(without - q).max() > 2e-2


def _own_mujoco(model: SelfModel, tau: np.ndarray, folder: Path, share: float) -> np.ndarray:
    file = mujoco.MjModel.from_xml_string(robot_mjcf(model, alone=True).text)
    file.opt.timestep, file.opt.disableflags = 1e-3, mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, effects = mujoco.MjData(file), Effects(model)
    data.qpos[:], data.qvel[:] = READY, DQ
    for _ in range(150):
        added = effects(data.qpos, data.qvel, data.qacc, tau, data.time)
        data.qfrc_applied[:] = tau + share * added
        mujoco.mj_step(file, data)
    return np.array(data.qpos)


def _own_pybullet(model: SelfModel, tau: np.ndarray, folder: Path, share: float) -> np.ndarray:
    path, effects, joints = folder / "arm.urdf", Effects(model, holds="pybullet"), list(range(7))
    path.write_text(robot_urdf(replace(model, frames=()), alone=True).text)
    client = {"physicsClientId": pybullet.connect(pybullet.DIRECT)}
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    arm = pybullet.loadURDF(str(path), useFixedBase=True, flags=flags, **client)
    pybullet.setGravity(*model.gravity, **client)
    pybullet.setTimeStep(1e-3, **client)
    for j in joints:
        pybullet.changeDynamics(arm, j, linearDamping=0.0, angularDamping=0.0, **client)
        pybullet.setJointMotorControl2(arm, j, pybullet.VELOCITY_CONTROL, force=0.0, **client)
        pybullet.resetJointState(arm, j, READY[j], DQ[j], **client)
    torque = pybullet.TORQUE_CONTROL
    for _ in range(150):
        q, dq = np.array([x[:2] for x in pybullet.getJointStates(arm, joints, **client)]).T
        push = tau + share * effects(q, dq, None, tau, 0.0)
        pybullet.setJointMotorControlArray(arm, joints, torque, forces=push.tolist(), **client)
        pybullet.stepSimulation(**client)
    q = np.array([x[0] for x in pybullet.getJointStates(arm, joints, **client)])
    pybullet.disconnect(**client)
    return q


def test_missing_mujoco_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MeansError, match=r"panda-adapter\[mujoco\]"):
        Rollouts("mujoco")


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(SettingsError, match="no format 'sdf'; have: bodies, "):
        Effects(PANDA, holds="sdf")
    with pytest.raises(SettingsError, match=r"step of 0.0 s"):
        Effects(PANDA, 0.0)
    other = replace(PANDA, tree=replace(PANDA.tree, joint_names=tuple("abcdefg")))
    arm = MujocoArm(PANDA)
    with pytest.raises(ModelError, match="no joint 'a'; has: panda_joint1"):
        MujocoArm(other, (arm.model, arm.data))
