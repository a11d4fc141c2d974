"""A URDF carries what effects it can: the arm in it takes the same torque; the rest is named."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from adapter.effects.active import with_bodies
from adapter.effects.robots import robot_mjcf, robot_urdf
from adapter.effects.torque import ModelTorque
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.physics.rigid_arm import RigidArm
from tests.helpers.robot_models import entry, pin_model, read_quietly, relative, urdf_text

SIX = [4e-3, 1e-4, -2e-4, 5e-3, 3e-4, 6e-3]
LOAD = {"m": 1.3, "cx": 0.02, "cy": -0.03, "cz": 0.09}
DTHETA = [0.4, 0.02, -0.01, 0.03, 0.02, 1e-3, 2e-3, 0.022, -1e-3, 0.018]
BODIES = (
    {"effect": "payload", "parameters": {**LOAD, "inertia": SIX}},
    {"effect": "link_inertia", "joints": [3], "parameters": {"dtheta": DTHETA}},
    {"effect": "base_tilt", "joints": [], "parameters": {"rx": 0.03, "ry": -0.02}},
    {"effect": "encoder_offset", "joints": [2, 4], "parameters": {"o": [0.012, -0.02]}},
)
LOSSES = (
    {"effect": "viscous_friction", "joints": [1, 2], "parameters": {"Fv": [0.1, 0.2]}},
    {"effect": "coulomb_friction", "joints": [1], "parameters": {"Fc": 0.3}},
    {"effect": "stribeck_friction", "joints": [2], "parameters": {"Fc": 0.4, "Fs": 0.7, "vs": 0.1}},
    {"effect": "asymmetric_friction", "joints": [3], "parameters": {"Fc_pos": 0.6, "Fc_neg": 0.2}},
)


def signals(n: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1.5, 1.5, (3, 20, n))


def carrying(*effects: dict[str, object]) -> SelfModel:
    return replace(read_quietly(urdf_text("panda"), False), effects=effects)


def apart(one: SelfModel, other: SelfModel) -> float:
    """By how much their torques differ, relatively."""
    moved = signals(one.tree.n)
    return relative(ModelTorque(one)(*moved), ModelTorque(other)(*moved))


def test_pinocchio_reads_the_same_arm() -> None:
    model = carrying(*BODIES)
    text = robot_urdf(model, alone=True).text
    oracle, back = pin_model(text), read_quietly(text, False)
    assert {frame.name for frame in model.frames} < {frame.name for frame in back.frames}
    data = oracle.createData()
    for q, dq, ddq in zip(*signals(7), strict=True):
        theirs = pin.rnea(oracle, data, q, dq, ddq)
        ours = ModelTorque(model)(q[None], dq[None], ddq[None])[0]
        assert relative(ours, theirs) < 1e-9


def test_a_tilted_base_stands_on_an_upright_link() -> None:
    text = robot_urdf(carrying(BODIES[2]), alone=True).text
    joint = ET.fromstring(text).find("joint[@name='panda_link0_upright_joint']")
    assert joint is not None and joint.get("type") == "fixed"
    parent, child, origin = (joint.find(tag) for tag in ("parent", "child", "origin"))
    assert parent is not None and parent.get("link") == "panda_link0_upright"
    assert child is not None and child.get("link") == "panda_link0"
    assert origin is not None
    rpy = [float(x) for x in origin.get("rpy", "").split()]
    assert rpy == pytest.approx([0.03, -0.02, 0.0], abs=5e-4)


def test_a_base_that_was_tilted_twice_stands_as_it_stands_in_the_model() -> None:
    """One tilt follows the other, about axes that the first has turned."""
    tilts = [entry("base_tilt", rx=x, ry=y) for x, y in ((0.3, 0.0), (0.0, 0.4))]
    model = carrying(*tilts)
    assert apart(read_quietly(robot_urdf(model, alone=True).text, False), model) < 1e-9
    assert apart(carrying(*tilts[::-1]), model) > 1e-3


def test_friction_is_in_dynamics_and_nowhere_else_mentioned() -> None:
    twice = {"effect": "viscous_friction", "joints": [2], "parameters": {"Fv": 0.05}}
    robot = ET.fromstring(robot_urdf(carrying(*LOSSES, twice), alone=True).text)
    found = {
        joint.get("name"): {key: float(x) for key, x in dynamics.attrib.items()}
        for joint in robot.iter("joint")
        if (dynamics := joint.find("dynamics")) is not None
    }
    assert found == {
        "panda_joint1": {"damping": 0.1, "friction": 0.3},
        "panda_joint2": {"damping": 0.25, "friction": 0.4},
        "panda_joint3": {"friction": 0.4},
    }


IN_MJCF = (
    *LOSSES[:2],
    {"effect": "coulomb_friction", "joints": [4], "parameters": {"Fc": 0.6}},
    {"effect": "motor_inertia", "joints": [1, 5], "parameters": {"B": [0.15, 0.2]}},
    {"effect": "joint_spring", "joints": [6], "parameters": {"k": 1.5, "q0": -0.4}},
    {"effect": "joint_spring", "joints": [6], "parameters": {"k": 0.5, "q0": 0.8}},
    {"effect": "law: dq |dq|", "joints": [2, 6], "parameters": {"c": [0.3, 0.4]}},
    {"effect": "law: dq³", "joints": [2], "parameters": {"c": 0.2}},
)


def test_mujoco_takes_the_arm_and_its_effects_as_the_equations_have_them() -> None:
    model = carrying(*IN_MJCF, *BODIES)
    q, dq, ddq = signals(7)
    dq += np.sign(dq)  # where dry friction slides, which MuJoCo has as a soft constraint
    oracle = mujoco.MjModel.from_xml_string(robot_mjcf(model).text)
    oracle.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data, theirs = mujoco.MjData(oracle), []
    for row in zip(q, dq, ddq, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = row
        mujoco.mj_inverse(oracle, data)
        theirs.append(data.qfrc_inverse.copy())
    ours = ModelTorque(model)(q, dq, ddq)
    assert np.abs(ours - RigidArm.of(model).torque(q, dq, ddq)).max(axis=0).min() > 0.1
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


def comments(text: str) -> list[str]:
    builder = ET.TreeBuilder(insert_comments=True)
    root = ET.fromstring(text, parser=ET.XMLParser(target=builder))
    return [element.text or "" for element in root.iter(ET.Comment)]  # type: ignore[arg-type]


def test_what_has_no_place_is_in_one_comment() -> None:
    left = (
        {"effect": "motor_inertia", "joints": [5], "parameters": {"B": 0.15}},
        {"effect": "viscous_friction", "joints": [6], "parameters": {"Fv": -0.01}},
        {"effect": "signal_delay", "parameters": {"d": 0.002}},
        {"effect": "bristle_friction", "joints": [3], "parameters": {"Fc": 0.4, "s0": 1e-3}},
        {"effect": "torque_filter", "joints": [3], "parameters": {"d": 0.004, "c": 1e-5}},
        {**entry("torque_offset", [1], o=1.0), "interval_s": [5.0, 6.0]},
    )
    (said,) = comments(robot_urdf(carrying(*LOSSES, *left), alone=True).text)
    for part in (
        "reflected motor inertia: no\n      panda_joint5: B = 0.15 kg m2",
        "signal delay: no\n      d = 0.002 s",
        "Fc is there as the joint's friction\n      panda_joint3: Fc = 0.4 N m, s0 = 0.001 rad",
        "panda_joint3: d = 0.004 s, c = 1e-05 s2",
        "viscous friction: whole\n    Coulomb friction: whole\n    Stribeck friction: Fc",
        "Fs = 0.7 N m",
        "Fc_pos = 0.6 N m",
        "damping of panda_joint6, which is negative: -0.01",
        "panda_joint1: o = 1 N m (it ended)",
    ):
        assert part in said
    names = ["asymmetric_friction", "bristle_friction", "motor_inertia"]
    names += ["signal_delay", "stribeck_friction", "torque_filter"]
    assert robot_urdf(carrying(*LOSSES, *left)).left_out == tuple(sorted([*names, "torque_offset"]))
    assert comments(robot_urdf(carrying(*BODIES, *LOSSES[:2]), alone=True).text) == []
    assert comments(robot_urdf(documented("panda"), alone=True).text) == []


def test_a_load_without_inertia_is_part_of_the_link() -> None:
    model = carrying({"effect": "payload", "parameters": LOAD})
    text = robot_urdf(model, alone=True).text
    (said,) = comments(text)
    assert "the last link has it\n      m = 1.3 kg" in said
    assert apart(read_quietly(text, False), model) < 1e-9


def test_gravity_that_is_not_upright_is_said() -> None:
    (said,) = comments(robot_urdf(documented("panda", gravity=[9.81, 0.0, 0.0]), alone=True).text)
    assert "gravity [9.81, 0.0, 0.0] m/s2" in said


def test_bodies_folded_into_the_model_take_the_same_torque() -> None:
    model = carrying(*BODIES, *LOSSES)
    folded = with_bodies(model)
    assert [e["effect"] for e in folded.effects] == ["encoder_offset"] + [
        e["effect"] for e in LOSSES
    ]
    assert apart(folded, model) < 1e-12
    assert with_bodies(folded) is folded
    floating = with_bodies(model.with_base(floating=True))
    np.testing.assert_array_equal(floating.theta[1:], folded.theta)
    over = replace(model, effects=({**BODIES[0], "interval_s": [1.0, 2.0]},))
    assert with_bodies(over) is over
