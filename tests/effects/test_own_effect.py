"""An effect of one's own, in thirty lines, is learned, named, rolled out and exported."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from adapter.effects.base import Array, JointSignals, LinearEffect, Parameter, Values
from adapter.effects.catalogue import CATALOGUE, registered
from adapter.effects.export import robot_urdf, to_urdf
from adapter.effects.phrases import SPEEDS, Phrase, experiments
from adapter.gap.words import headline
from adapter.gap.workflow import find_gap
from adapter.model.self_model import SelfModel
from adapter.model.urdf_text import DAMPING, Additions
from adapter.simulate import SIMULATORS, DrivenMotion, Rollouts
from sim.effects import Effect
from tests.helpers.arm_data import ArmData, Motion, arm, learner_for, panda_model, record, states_of
from tests.sim.test_sim_effects import Record, arm_with

J, C = 1, 1.2  # the joint, from 0, and what it has, N m s²/rad²


class Drag(LinearEffect):
    """Torque that grows with the square of the speed: a joint that stirs oil."""

    name = "drag"
    title = "drag"
    parameters = (Parameter("c", "N m s2/rad2"),)
    prior_std = 1.0
    positive = ("c",)
    phrase = Phrase("{who} {lacks} {x} of drag", "c")
    shows = ((SPEEDS, "grows with the square of the speed"),)

    def column(self, at: JointSignals) -> Array:
        """dq |dq|."""
        return np.asarray(at.dq * np.abs(at.dq))

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """Its slope at 0.5 rad/s, as damping."""
        return more.at_joint(DAMPING, joint, values["c"], "its slope at 0.5 rad/s is damping")


@pytest.fixture(autouse=True)
def drag() -> Iterator[Drag]:
    own = Drag()
    with registered(own):
        yield own
    assert own.name not in CATALOGUE


def stirring(seconds: float) -> ArmData:
    """A recording of an arm with drag on one joint."""
    data = record(arm(), Motion(seconds, seed=4))
    dq, tau = data.true[1], data.tau.copy()
    tau[:, J] += C * dq[:, J] * np.abs(dq[:, J])
    return replace(data, tau=tau)


def with_drag() -> SelfModel:
    entry = {"effect": "drag", "joints": [J + 1], "parameters": {"c": C}}
    return replace(panda_model(), effects=(entry,))


def test_it_is_learned() -> None:
    learner = learner_for(effects=("drag",))
    for state in states_of(stirring(12.0)):
        learner.step(state)
    values = learner.theta.effect_values[0]
    assert values[J] == pytest.approx(C, abs=0.1)
    assert np.abs(np.delete(values, J)).max() < 0.2


def test_it_is_named() -> None:
    result = find_gap([stirring(15.0).log()], panda_model())
    (found,) = [f for f in result.findings if f.effect == "drag"]
    assert found.joints == (J + 1,)
    assert abs(found.parameters["c"] - C) < min(5.0 * found.std["c"], 0.1)
    assert found.std["c"] < 0.06
    assert "joint 2 lacks" in headline(result) and "of drag" in headline(result)
    assert len(result.findings) == 1


def test_it_is_told_from_all_others(drag: Drag) -> None:
    for other in set(CATALOGUE.values()) - {drag}:
        (said,) = experiments(drag, [other])
        assert "drag" in said and other.title in said


@pytest.mark.parametrize("simulator", list(SIMULATORS))
def test_it_is_simulated(simulator: str) -> None:
    """As the simulated arm moves that has the same equation of its own."""
    made = Record(arm_with(Effect("x_quadratic_drag", (J + 1,), {"c": C})), 0.6)
    motion = DrivenMotion(made.t, made.read_q, made.read_dq, made.u)
    rollouts = Rollouts(simulator)
    off = [
        np.nanmax(np.abs(rollouts(model, motion, [(100, 600)], "commands")[0] - made.read_q))
        for model in (with_drag(), panda_model())
    ]
    assert rollouts.troubles == []
    assert off[0] < 1e-4 < 1e-3 < off[1]


def test_it_is_exported() -> None:
    text = to_urdf(with_drag())
    assert f'<dynamics damping="{C}" />' in text and text.count("<dynamics") == 1
    assert "drag of panda_joint2" in text and "its slope at 0.5 rad/s is damping" in text
    assert robot_urdf(with_drag()).left_out == ("drag",)
