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
from adapter.signals.matching import matching, present
from drivers.files.mcap import Log
from tests.helpers.robot_models import ROBOTS, machine_urdf, read_quietly, relative, urdf_text

FIRST, SECOND = "panda_finger_joint1", "panda_finger_joint2"
RULE = ' multiplier="-0.5" offset="0.3"'
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


def following(text: str, joint: str, leader: str, rule: str = "") -> str:
    """A URDF in which a joint that slides mimics another."""
    tag = f'<joint name="{joint}" type="prismatic">'
    return text.replace(tag, f'{tag}<mimic joint="{leader}"{rule}/>')


@pytest.mark.parametrize(("rule", "factor", "offset"), [("", 1.0, 0.0), (RULE, -0.5, 0.3)])
@pytest.mark.parametrize("lock", [{FIRST: 0.04}, {}])
def test_fingers_are_where_they_are_told_to_be(
    rule: str, factor: float, offset: float, lock: dict[str, float]
) -> None:
    """A sliding finger, and one that follows it: where it is at its leader's zero if that moves."""
    text = following(FINGERS.read_text(), SECOND, FIRST, rule)
    oracle, arm = pin.buildModelFromXML(text), [f"panda_joint{k}" for k in range(1, 8)]
    first = lock.get(FIRST, 0.0)
    second = round(factor * first + offset, 9)
    said = f"mimics {FIRST}.* at {second or 'zero'}"
    with pytest.warns(ModelWarning, match=said):
        model = model_from_urdf(text, joints=None if lock else [*arm, FIRST], lock=lock)
    q, dq, ddq = np.random.default_rng(3).uniform(-1, 1, (3, 7))
    at = np.r_[q, first, second], np.r_[dq, 0.0, 0.0], np.r_[ddq, 0.0, 0.0]
    tau = pin.rnea(oracle, oracle.createData(), *at)[: model.tree.n]
    ours = RigidArm.of(model).torque(*(x[None, : model.tree.n] for x in at))[0]
    assert relative(ours, tau) < 1e-9


def test_a_column_of_a_joint_that_follows_is_not_needed_and_checked() -> None:
    with pytest.warns(ModelWarning):
        model = model_from_urdf(following(FINGERS.read_text(), SECOND, FIRST, RULE))
    model = loads(dumps(model))
    names = (*model.tree.joint_names, FIRST, SECOND)
    q = 0.02 * np.sin(np.linspace(0, 9, 900)[:, None] + np.arange(9))
    q[:, 8] = -0.5 * q[:, 7] + 0.3
    log = Log(Path("a.mcap"), names, 10**7 * np.arange(900), q, 0 * q, 0 * q)
    told = [*matching(log, model).warnings, *present(model, names, "a.mcap")[1]]
    assert not [x for x in told if SECOND in x and "ignored" not in x]
    assert [x for x in told if FIRST in x and "holds still" in x]
    q[:, 8] += 0.01
    (said,) = (x for x in matching(log, model).warnings if "rms" in x)
    assert f"{SECOND} is 0.01 m (rms) off -0.5 times {FIRST} plus 0.3" in said
    without = matching(log.select(names[:8]), model)
    assert without.joint_names == names[:7] and "rms" not in "".join(without.warnings)


def test_what_rides_on_a_joint_that_follows_is_said() -> None:
    text = following(machine_urdf("gantry"), "j2", "j1")
    with pytest.warns(ModelWarning, match="j2.*in its leader, and j3, j4 behind it will not be"):
        model_from_urdf(text)


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
