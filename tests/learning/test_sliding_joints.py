"""Joints that slide, learned sample by sample, and what cannot be learned of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapter.errors import SettingsError
from adapter.learning.batch.moments import schema_moments
from adapter.learning.imu_schema import ImuSchema
from adapter.learning.learner import OnlineLearner
from adapter.learning.schema_kernels import channel_cost
from adapter.learning.settings import LearnerSettings, SchemaSettings
from adapter.learning.tree_data import TreeData
from adapter.model.self_model import SelfModel
from adapter.model.spatial import exp_rotation, zxz_from_matrix
from adapter.physics.identifiability import frame_observability
from adapter.runs.outcome import frame_errors
from tests.helpers.robot_models import machine_urdf, read_quietly
from tests.helpers.tree_motion import in_motion


@pytest.mark.parametrize("robot", ["scara", "gantry"])
def test_frames_and_bodies_of_a_machine_are_learned(robot: str) -> None:
    """From a random start, link motion being measured by Pinocchio."""
    model, data = in_motion(machine_urdf(robot), False, 4.0, 3)
    schema = SchemaSettings(judge_every=20)
    learner = OnlineLearner(
        model.tree, gravity=model.gravity, settings=LearnerSettings(schema=schema)
    )
    for state in data.states():
        assert learner.step(state)
    seen = frame_observability(model.tree, model.lam, model.gravity)
    turn, shift = frame_errors(learner.schema.lam[None], model.lam, seen.freedom)
    assert turn.max() < 2e-3 and shift.max() < 3e-3
    assert learner.theta_started_ns is not None
    error = learner.predict(data.states()) - data.tau
    assert ((error**2).mean(axis=0) < 0.05**2 * (data.tau**2).mean(axis=0)).all()


def cost(data: TreeData, model: SelfModel, phi: np.ndarray, d: np.ndarray) -> float:
    """Half the squared error of all channels with the frames moved, by the moments."""
    sums, total = schema_moments(data).sums, 0.0
    R = model.joint_rotation() @ exp_rotation(phi)
    for j in range(model.tree.n):
        p, unused = np.ascontiguousarray(model.lam[j, 3:] + d[j]), np.zeros(6)
        total += sum(channel_cost(sums[j], k, R[j], p, unused, np.zeros((0, 6))) for k in range(3))
    return 0.5 * total


def test_the_moments_are_least_where_the_frames_are_and_curve_as_differences_say() -> None:
    model, data = in_motion(machine_urdf("rail"), False, 1.0, 5, rate_hz=100.0)
    rng = np.random.default_rng(0)
    phi, d = 0.1 * rng.normal(size=(2, model.tree.n, 3))
    still = np.zeros_like(phi)
    assert cost(data, model, still, still) < 1e-9 * cost(data, model, phi, d)
    moved = model.joint_rotation() @ exp_rotation(phi)
    lam = np.concatenate([zxz_from_matrix(moved), model.lam[:, 3:] + d], axis=1)
    there = replace(model, lam=lam)
    sums = schema_moments(data).sums
    for j in range(model.tree.n):
        g = np.zeros(6)
        for k in range(3):
            p = np.ascontiguousarray(lam[j, 3:])
            channel_cost(sums[j], k, there.joint_rotation()[j], p, g, np.zeros((0, 6)))
        for a in range(6):
            step = np.zeros((2, model.tree.n, 3))
            step[a // 3, j, a % 3] = 1e-5
            slope = (cost(data, there, *step) - cost(data, there, *-step)) / 2e-5
            assert slope == pytest.approx(g[a], rel=1e-5, abs=1e-5 * np.abs(g).max())


def test_sensors_on_links_behind_a_slide_are_refused() -> None:
    model = read_quietly(machine_urdf("scara"))
    settings = replace(SchemaSettings(), imus=("l3",))
    with pytest.raises(SettingsError, match=r"joint j3 slides; .*lock it, or leave --imu out"):
        ImuSchema(model.tree, None, settings, model.lam)
