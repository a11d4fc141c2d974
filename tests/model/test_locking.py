"""Locked joints: what is left moves and weighs as the whole robot with these joints held."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pybullet_data
import pytest

from adapter.effects.robots import robot_urdf
from adapter.errors import ModelError, ModelWarning
from adapter.model.locking import locked, restricted
from adapter.model.model_file import dumps, loads
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel, Tool
from adapter.model.urdf import model_from_urdf
from adapter.physics.rigid_arm import RigidArm
from tests.helpers.robot_models import ROBOTS, read_quietly, relative, urdf_text

FINGERS = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"


def held(model: SelfModel, values: dict[str, float], seed: int = 0) -> tuple[np.ndarray, ...]:
    """Random motion with joints held: q, dq, ddq of the others, and the whole model's torques."""
    rng = np.random.default_rng(seed)
    at = [model.tree.joint_index(name) for name in values]
    q, dq, ddq = rng.uniform(-3, 3, (3, 5, model.tree.n))
    q[:, at], dq[:, at], ddq[:, at] = list(values.values()), 0.0, 0.0
    kept = [k for k in range(model.tree.n) if k not in at]
    tau = RigidArm.of(model).torque(q, dq, ddq)
    return q[:, kept], dq[:, kept], ddq[:, kept], tau[:, kept]


@pytest.mark.parametrize("robot", ROBOTS)
def test_torques_are_those_of_the_whole_robot(robot: str) -> None:
    model = read_quietly(urdf_text(robot))
    names = model.tree.joint_names
    model = replace(model, tool=Tool(1.5, np.array([0.1, -0.2, 0.05]), 0.01 * np.eye(3)))
    for part in (names[:1], names[-1:], names[1::2]):
        values = dict(zip(part, np.linspace(-1.2, 0.8, len(part)), strict=True))
        left = locked(model, values)
        *motion, tau = held(model, values)
        assert left.tree.joint_names == tuple(n for n in names if n not in part)
        assert relative(RigidArm.of(left).torque(*motion), tau) < 1e-9
        assert left.theta[:, 0].sum() + left.base_theta[0] == pytest.approx(
            model.theta[:, 0].sum() + model.base_theta[0]
        )


def test_floating_trees_keep_their_base() -> None:
    whole = read_quietly(urdf_text(ROBOTS[0]), floating=True)
    value = {whole.tree.joint_names[1]: 0.4}
    one = locked(whole, value).with_base(False)
    other = locked(whole.with_base(False), value)
    np.testing.assert_allclose(one.theta, other.theta, atol=1e-12)
    np.testing.assert_allclose(one.base_theta, other.base_theta, atol=1e-12)


def test_the_reader_locks_as_the_model_does() -> None:
    values = {"panda_joint3": 0.5, "panda_joint7": -1.0}
    read, done = documented("panda", lock=values), locked(documented("panda"), values)
    for key in ("lam", "theta", "base_theta", "axis"):
        np.testing.assert_allclose(getattr(read, key), getattr(done, key), atol=1e-12)
    frames = [{f.name: f for f in m.frames} for m in (read, done)]
    assert frames[0].keys() == frames[1].keys() == {"panda_link3", "panda_link7", "panda_link8"}
    for name, frame in frames[0].items():
        other = frames[1][name]
        assert (frame.parent, frame.joint) == (other.parent, other.joint)
        np.testing.assert_allclose(frame.rotation, other.rotation, atol=1e-12)
        np.testing.assert_allclose(frame.position, other.position, atol=1e-12)
    assert read.source is not None and done.source is not None
    np.testing.assert_allclose(read.source.lam, done.source.lam, atol=1e-12)
    assert loads(dumps(done)).provenance["locked"] == values == read.provenance["locked"]


@pytest.mark.parametrize("value", [0.0, 0.7])
def test_a_locked_model_is_written_onto_its_whole_file(value: float) -> None:
    whole = documented("panda")
    again = model_from_urdf(robot_urdf(locked(whole, {"panda_joint5": value})).text)
    np.testing.assert_array_equal(again.lam, whole.lam)
    np.testing.assert_allclose(again.theta, whole.theta, atol=1e-12)


def test_fingers_are_where_they_are_told_to_be() -> None:
    """A sliding finger, and one that follows it."""
    text = FINGERS.read_text().replace(
        '<joint name="panda_finger_joint2" type="prismatic">',
        '<joint name="panda_finger_joint2" type="prismatic"><mimic joint="panda_finger_joint1"/>',
    )
    oracle = pin.buildModelFromXML(text)
    with pytest.warns(ModelWarning, match="finger_joint2. is prismatic and mimics.* at 0.04"):
        model = model_from_urdf(text, lock={"panda_finger_joint1": 0.04})
    rng = np.random.default_rng(3)
    q, dq, ddq = rng.uniform(-1, 1, (3, 7))
    rest = np.zeros(oracle.nv - 7)
    tau = pin.rnea(
        oracle, oracle.createData(), np.r_[q, rest + 0.04], np.r_[dq, rest], np.r_[ddq, rest]
    )
    ours = RigidArm.of(model).torque(q[None], dq[None], ddq[None])[0]
    assert relative(ours, tau[:7]) < 1e-9


def test_effects_keep_their_joints() -> None:
    entries = (
        {"effect": "viscous_friction", "joints": [1, 3, 4], "parameters": {"d": [0.1, 0.3, 0.4]}},
        {"effect": "coulomb_friction", "joints": [3], "parameters": {"Fc": 0.2}},
        {"effect": "signal_delay", "parameters": {"d": 1e-3}},
    )
    model = locked(replace(documented("panda"), effects=entries), {"panda_joint3": 0.0})
    friction, delay = model.effects
    assert friction["joints"] == [1, 3] and friction["parameters"] == {"d": [0.1, 0.4]}
    assert delay["effect"] == "signal_delay"


def test_what_cannot_be_locked_is_refused() -> None:
    panda = documented("panda")
    with pytest.raises(ModelError, match=r"no joint 'finger'; have: panda_joint1, .*panda_joint7"):
        locked(panda, {"finger": 0.0})
    with pytest.raises(ModelError, match="no joint is left to move"):
        restricted(panda, [], {})
    with pytest.raises(ModelError, match="'panda_joint2' cannot be learned and locked"):
        restricted(panda, ["panda_joint2"], {"panda_joint2": 0.1})
    load = {"effect": "payload", "parameters": {"m": 1.0, "cx": 0.0, "cy": 0.0, "cz": 0.0}}
    with pytest.raises(ModelError, match="payload may act on panda_link7, the last link"):
        locked(replace(panda, effects=(load,)), {"panda_joint7": 0.0})
    with pytest.raises(
        ModelError, match=r"'finger', .*is not there; have: .*joints that can be lock"
    ):
        documented("panda", lock={"finger": 0.0})
