"""The model's torque of one instant is that of its table, as far as an instant shows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapter.control.feedforward import ModelFeedforward, Row
from adapter.effects.by_joint import JointSignals
from adapter.effects.catalogue import CATALOGUE, LEARNED
from adapter.effects.torque import ModelTorque
from adapter.model.robots import documented
from tests.helpers.robot_models import relative

N = 7
FC = {"Fc_pos": 0.4, "Fc_neg": 0.2}
SIX = [4e-3, 1e-4, -2e-4, 5e-3, 3e-4, 6e-3]
SHOWN = {
    "viscous_friction": ([1, 4], {"Fv": [0.1, 0.3]}),
    "coulomb_friction": ([2], {"Fc": 0.3}),
    "asymmetric_friction": ([3], FC),
    "stribeck_friction": ([3], {"Fc": 0.1, "Fs": 0.3, "vs": 0.05}),
    "load_dependent_friction": ([2], {"Fl": 0.05}),
    "motor_inertia": ([5], {"B": 0.1}),
    "torque_ripple": ([4], {"a": 0.3, "n": 5, "phase": 0.2}),
    "joint_spring": ([4], {"k": 0.8, "q0": -1.0}),
    "torque_offset": ([6], {"o": 0.4}),
    "torque_gain": ([2], {"g": 0.06}),
    "encoder_offset": ([2], {"o": 0.01}),
    "encoder_ripple": ([6], {"a": 0.004, "phase": 0.3}),
    "payload": ([], {"m": 1.0, "cx": 0.0, "cy": 0.02, "cz": 0.08, "inertia": SIX}),
    "link_inertia": ([4], {"dtheta": [0.2, 0.01, 0, 0, 0.01, 0, 0, 0.01, 0, 0.01]}),
    "base_tilt": ([], {"rx": 0.02, "ry": 0.01}),
    "external_wrench": ([], {"fx": 3, "fy": -4, "fz": 9, "mx": 0.1, "my": 0.2, "mz": 0.3}),
}


def model_with(*names: str):  # type: ignore[no-untyped-def]
    entries = [
        {"effect": name, "joints": SHOWN[name][0], "parameters": SHOWN[name][1]} for name in names
    ]
    return replace(documented("panda"), effects=tuple(entries))


def both(model) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    moved = np.random.default_rng(3).uniform(-1.0, 1.0, (3, 30, N))
    forward = ModelFeedforward.of(model)
    ours = np.array([forward(*row) for row in zip(*moved, strict=True)])
    return ours, ModelTorque(model)(*moved)


@pytest.mark.parametrize("name", SHOWN)
def test_one_effect(name: str) -> None:
    ours, table = both(model_with(name))
    assert relative(ours, table) < 1e-9
    bare = ModelTorque(documented("panda"))
    moved = np.random.default_rng(3).uniform(-1.0, 1.0, (3, 30, N))
    assert relative(ours, bare(*moved)) > 1e-4


def test_effects_beside_each_other() -> None:
    names = [name for name in SHOWN if name != "external_wrench"]
    ours, table = both(model_with(*names))
    assert relative(ours, table) < 2e-3  # encoder ripple and offset in another order
    assert relative(*both(model_with(*(n for n in SHOWN if n != "encoder_ripple")))) < 1e-9


def test_two_of_a_kind_on_one_joint() -> None:
    first = {"effect": "torque_ripple", "joints": [4], "parameters": {"a": 0.3, "n": 5, "phase": 0}}
    second = {**first, "parameters": {"a": 0.2, "n": 1, "phase": 1.0}}
    assert relative(*both(replace(documented("panda"), effects=(first, second)))) < 1e-9


def test_a_gear_that_twists_and_one_with_play() -> None:
    """Position alone; the rates of the twist need more than an instant."""
    gear = {"effect": "joint_elasticity", "joints": [2], "parameters": {"k": 3000.0}}
    play = {"effect": "backlash", "joints": [4], "parameters": {"b": 0.01}}
    model = replace(documented("panda"), effects=(gear, play))
    q, dq, ddq = np.random.default_rng(3).uniform(-1.0, 1.0, (3, N))
    bare = ModelTorque(documented("panda"))
    link = q.copy()
    link[1] -= bare(q[None], dq[None], ddq[None])[0, 1] / 3000.0
    link[3] -= 0.005 * np.tanh(dq[3] / 0.01)
    theirs = bare(link[None], dq[None], ddq[None])[0]
    assert relative(ModelFeedforward.of(model)(q, dq, ddq), theirs) < 1e-9


def test_an_effect_that_is_over_is_not_asked_for() -> None:
    over = {**model_with("torque_offset").effects[0], "interval_s": [1.0, 3.0]}
    ours, _ = both(replace(documented("panda"), effects=(over,)))
    bare, _ = both(documented("panda"))
    np.testing.assert_array_equal(ours, bare)


@pytest.mark.parametrize("name", LEARNED)
def test_what_is_learned_of_an_effect_is_added(name: str) -> None:
    """Compiled or not, it is what the effect's own file says."""
    panda, rng = documented("panda"), np.random.default_rng(4)
    effect, values = CATALOGUE[name], rng.uniform(0.1, 0.3, N)
    shape = np.full(N, effect.shapes[1] if effect.shapes else np.nan)
    bare = ModelFeedforward(panda.tree, panda.gravity)
    bare.set(panda.lam, panda.theta, np.zeros((0, N)))
    forward = ModelFeedforward(panda.tree, panda.gravity, (name,))
    forward.set(panda.lam, panda.theta, values[None], shape[None])
    for q, dq, ddq in rng.uniform(-1.0, 1.0, (20, 3, N)):
        said = forward(q, dq, ddq)
        at = JointSignals(q, dq, ddq, bent=forward.table[Row.BENT : Row.SHARES])
        more = values * effect.torque_per_unit(at, shape)
        np.testing.assert_allclose(said - bare(q, dq, ddq), more, atol=1e-9)
    away = np.full(N, 0.5)
    slides = JointSignals(0 * away, away, 0 * away, bent=np.ones((len(effect.shapes) or 1, N)))
    back = JointSignals(0 * away, -away, 0 * away, bent=-np.ones((len(effect.shapes) or 1, N)))
    half = effect.torque_per_unit(slides, shape) - effect.torque_per_unit(back, shape)
    np.testing.assert_allclose(forward.friction(0.5), 0.5 * values * half, atol=1e-9)
    inertia = values if name == "motor_inertia" else np.zeros(N)
    np.testing.assert_allclose(forward.motor_inertia(), inertia, atol=1e-9)
