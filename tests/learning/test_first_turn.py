"""A joint's first turn shows what friction does the other way: nothing changed at the hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.effects.robots import read_robot
from adapter.learning.change import is_new
from adapter.learning.settings import LearnerSettings
from adapter.runs.config import PipelineSettings
from adapter.runs.library import make_log
from adapter.runs.replay import Replay, replay
from adapter.signals.matching import matching
from tests.helpers.arm_data import rnea

LEARNER = LearnerSettings(effects=REAL_ARM_EFFECTS)
SLOW_S, END_S = 9.0, 16.0  # one way only until then
FRICTION = np.array([0.0, 0.4])  # N m
NOISE_DQ, NOISE_TAU = 1e-4, 0.02  # rad/s, N m
LINK = """ <link name="{name}"><inertial><origin xyz="0 0 {z}"/><mass value="{mass}"/>
  <inertia ixx="{turn}" iyy="{turn}" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
"""
JOINT = """ <joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="0 0 {z}"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="3" effort="50"/>
 </joint>
"""


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """URDF of two links that hang in one plane."""
    bodies = ("base", 0.0, 1.0, 0.01), ("l1", -0.3, 2.0, 0.05), ("l2", -0.2, 1.0, 0.02)
    text = "".join(LINK.format(name=n, z=z, mass=m, turn=i) for n, z, m, i in bodies)
    joints = ("a", "base", "l1", 1.0), ("b", "l1", "l2", -0.5)
    text += "".join(JOINT.format(name=n, parent=p, child=c, z=z) for n, p, c, z in joints)
    path = tmp_path_factory.mktemp("pendulum") / "pendulum.urdf"
    path.write_text(f'<robot name="pendulum">\n{text}</robot>\n')
    return path


def path_of(t: np.ndarray) -> np.ndarray:
    """(m, 2) rad: first slowly one way, then fast both ways, from rest."""
    slow = 0.02 * np.minimum(t, SLOW_S) * np.minimum(t, 1.0)
    fast = np.maximum(t - SLOW_S, 0.0)
    swing = np.minimum(fast, 1.0) ** 2
    return np.column_stack(
        [slow + 0.5 * swing * np.sin(2.1 * fast), slow - 0.8 * swing * np.sin(fast)]
    )


def learned(urdf: Path, seed: int) -> Replay:
    t = 1e-3 * np.arange(round(1e3 * END_S))
    q = path_of(t)
    dq = np.gradient(q, 1e-3, axis=0)
    ddq = np.gradient(dq, 1e-3, axis=0)
    tau = rnea(pin.buildModelFromUrdf(str(urdf)), q, dq, ddq) + FRICTION * np.tanh(dq / 0.01)
    rng = np.random.default_rng(seed)
    dq = dq + NOISE_DQ * rng.standard_normal(q.shape)
    tau += NOISE_TAU * rng.standard_normal(q.shape)
    arm = read_robot(str(urdf))
    log = make_log(t, q, dq, tau, arm.tree.joint_names)
    return replay(matching(log, arm), arm, PipelineSettings(learner=LEARNER))


@pytest.mark.parametrize("seed", [1, 2])
def test_a_first_turn_is_no_load(pendulum: Path, seed: int) -> None:
    found = learned(pendulum, seed)
    assert not found.pipeline.learner.changes
    assert found.pipeline.learner.watch is not None
    assert not found.pipeline.learner.watch.reports


def test_new_rates_are_those_beyond_what_was_seen() -> None:
    seen = np.array([[0.1, -0.2], [0.3, -0.1]])
    dq = np.array([[0.44, -0.29], [0.46, -0.31], [-0.01, 0.01]])
    new = [[False, False], [True, True], [True, True]]
    for still, table in ((np.zeros_like(seen), np.zeros_like(dq)), (seen, seen[[0, 0, 0]])):
        assert is_new(np.hstack([dq, table]), np.hstack([seen, still])).tolist() == new
        assert is_new(np.hstack([table, dq]), np.hstack([still, seen])).tolist() == new
