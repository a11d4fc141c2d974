"""Joints that slide, learned sample by sample, and what cannot be learned of them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from adapter.errors import SettingsError
from adapter.learning.imu_schema import ImuSchema
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings, SchemaSettings
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


def test_sensors_on_links_behind_a_slide_are_refused() -> None:
    model = read_quietly(machine_urdf("scara"))
    settings = replace(SchemaSettings(), imus=("l3",))
    with pytest.raises(SettingsError, match=r"joint j3 slides; .*lock it, or leave --imu out"):
        ImuSchema(model.tree, None, settings, model.lam)
