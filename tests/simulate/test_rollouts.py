"""Forward simulation along a recording: the true model repeats it, a lesser one does not.

The recordings come from `sim`, which shares no code with what simulates here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapter.errors import SettingsError
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.simulate import SIMULATORS, DrivenMotion, Rollouts
from sim.effects import Effect
from tests.sim.test_sim_effects import Record, arm_with

CLOSE = 1e-3  # rad after 0.35 s
SECONDS, SEGMENTS = 0.8, [(100, 450), (450, 800)]  # the torque of the first samples has a corner
PANDA = documented("panda")

BALL = {"m": 1.0, "cx": 0.02, "cy": -0.03, "cz": 0.15}
PUSH = {"fx": 8.0, "fy": 0.0, "fz": 5.0, "mx": 0.0, "my": 0.5, "mz": 0.0}
CASES = [
    Effect("viscous_friction", (4,), {"Fv": 0.8}),
    Effect("coulomb_friction", (4,), {"Fc": 1.0}),
    Effect("asymmetric_friction", (6,), {"Fc_pos": 0.6, "Fc_neg": 0.3}),
    Effect("stribeck_friction", (2,), {"Fc": 0.5, "Fs": 1.2, "vs": 0.1}),
    Effect("load_dependent_friction", (2,), {"Fl": 0.05}),
    Effect("bristle_friction", (4,), {"Fc": 1.0, "s0": 2e-3}),
    Effect("bristle_friction", (7,), {"Fc": 0.3, "s0": 5e-3}),
    Effect("friction_drift", (1,), {"dFc": 0.8}),
    Effect("motor_inertia", (5,), {"B": 0.1}),
    Effect("joint_spring", (3,), {"k": 1.5, "q0": 0.5}),
    Effect("torque_ripple", (1,), {"a": 0.5, "n": 6.0, "phase": 0.3}),
    Effect("payload", (), BALL, (0.5, None)),
    Effect("base_tilt", (), {"rx": 0.03, "ry": 0.03}),
    Effect("external_wrench", (), PUSH, (0.3, 0.7)),
    Effect("joint_elasticity", (2,), {"k": 3000.0}),
    Effect("encoder_offset", (4,), {"o": 0.02}),
    Effect("encoder_ripple", (4,), {"a": 0.01, "phase": 0.2}),
    Effect("backlash", (6,), {"b": 0.008}),
]
SENSED = [
    Effect("torque_gain", (2,), {"g": 0.06}),
    Effect("torque_offset", (4,), {"o": 0.5}, (0.5, None)),
    Effect("signal_delay", (), {"d": 0.0045}),
    Effect("torque_filter", (4,), {"d": 0.02, "c": 0.0003}),
]


def model_with(*effects: Effect) -> SelfModel:
    return replace(PANDA, effects=tuple(effect.as_dict() for effect in effects))


def simulated(model: SelfModel, record: Record, u: np.ndarray, how: tuple[str, str]) -> np.ndarray:
    """q (m, n) by (simulator, drive) along a record."""
    rollouts = Rollouts(how[0])
    motion = DrivenMotion(record.t, record.read_q, record.read_dq, u)
    q, _ = rollouts(model, motion, SEGMENTS, how[1])
    assert not rollouts.troubles
    assert np.isfinite(q[100:]).all() and np.isnan(q[:100]).all()
    return q


@pytest.mark.parametrize("effect", [*CASES, *SENSED], ids=lambda effect: effect.name)
def test_true_model_repeats_the_recording_and_a_lesser_one_does_not(effect: Effect) -> None:
    record = Record(arm_with(effect), SECONDS)
    sensed = effect in SENSED
    drive, u = ("measured", record.read_tau) if sensed else ("commands", record.u)
    paths = [simulated(model_with(effect), record, u, (name, drive)) for name in SIMULATORS]
    for q in paths:
        assert np.nanmax(np.abs(q - record.read_q)) < CLOSE
    assert np.nanmax(np.abs(paths[0] - paths[1])) < 0.1 * CLOSE  # the same in both simulators
    without = simulated(PANDA, record, u, ("mujoco", drive))
    assert np.nanmax(np.abs(without - record.read_q)) > 3 * CLOSE


def test_a_coarser_table() -> None:
    effect = Effect("coulomb_friction", (2,), {"Fc": 1.0})
    record = Record(arm_with(effect), SECONDS)
    coarse = slice(None, None, 4)
    motion = DrivenMotion(*(x[coarse] for x in (record.t, record.read_q, record.read_dq, record.u)))
    q, dq = Rollouts()(model_with(effect), motion, [(25, 125)], "commands")
    assert np.flatnonzero(np.isfinite(q[:, 0])).tolist() == list(range(25, 125))
    assert np.nanmax(np.abs(q - motion.q)) < CLOSE
    assert np.nanmax(np.abs(dq - motion.dq)) < 10 * CLOSE


def test_what_does_not_exist_is_refused_with_the_choices() -> None:
    with pytest.raises(SettingsError, match="no simulator 'gazebo'; have: pybullet, mujoco"):
        Rollouts("gazebo")
