"""Rows without stamps are instants: no row's torque knows its neighbours. Stamps bring memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import adapter
from adapter.effects.active import active_effects
from adapter.effects.base import Motion
from adapter.effects.catalogue import CATALOGUE
from adapter.effects.torque import ModelTorque, sensed_torque
from adapter.errors import SettingsError
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.physics.rigid_arm import RigidArm
from sim.truth import panda
from tests.helpers.arm_data import Motion as Path
from tests.helpers.arm_data import record, rms, trajectory
from tests.helpers.robot_models import relative

N, J = 7, 3  # joints; the one that has an effect, from 0
PANDA = documented("panda")
REMEMBER = {
    "bristle_friction": {"Fc": 2.0, "s0": 3e-3},
    "stribeck_friction": {"Fc": 1.0, "Fs": 2.0, "vs": 0.05, "s0": 3e-3},
    "joint_elasticity": {"k": 2000.0},
    "backlash": {"b": 0.01},
    "torque_filter": {"d": 5e-3, "c": 1.5e-4},
    "signal_delay": {"d": 5e-3},
    "friction_drift": {"dFc": 0.05},
}
Q, DQ, DDQ = trajectory(Path(4.0, seed=3))
T = 1e-3 * np.arange(len(Q))


def entry(name: str, values: dict[str, object]) -> dict[str, object]:
    joints = [] if CATALOGUE[name].scope in ("flange", "base", "all") else [J + 1]
    return {"effect": name, "joints": joints, "parameters": values}


def having(**effects: dict[str, object]) -> SelfModel:
    return replace(PANDA, effects=tuple(entry(*item) for item in effects.items()))


def any_size(name: str) -> dict[str, object]:
    """Parameters of an effect as its own file makes them of coefficients of their usual size."""
    template = CATALOGUE[name].templates()[0]
    found = template.decode(np.array(template.prior_std))
    return {key: abs(x) if isinstance(x, float) else x for key, x in found.items()}


@pytest.mark.parametrize("name", CATALOGUE)
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_shuffled_rows_give_shuffled_torques(name: str, seed: int) -> None:
    """Also as many as a filter would take, in one call or in one each."""
    rng = np.random.default_rng(seed)
    rows = rng.choice(len(Q), 150, replace=False)
    motion, order = (Q[rows], DQ[rows], DDQ[rows]), rng.permutation(len(rows))
    model = having(**{name: REMEMBER.get(name) or any_size(name)})
    tau = adapter.inverse_dynamics(model, *motion)
    shuffled = adapter.inverse_dynamics(model, *(x[order] for x in motion))
    np.testing.assert_allclose(shuffled, tau[order], rtol=1e-12, atol=1e-12)
    alone = [adapter.inverse_dynamics(model, *row) for row in zip(*motion, strict=True)]
    np.testing.assert_allclose(tau, alone, rtol=1e-12, atol=1e-12)


def test_gravity_of_many_poses_is_that_of_each() -> None:
    """Bristles are not bent and gears lean on no flank where nothing moves."""
    poses = np.random.default_rng(2).uniform(-1.5, 1.5, (20, N))
    still = np.zeros_like(poses)
    gravity = RigidArm.of(PANDA).torque(poses, still, still)
    names = [name for name in REMEMBER if name != "joint_elasticity"]
    model = having(**{name: REMEMBER[name] for name in names})
    assert relative(adapter.inverse_dynamics(model, poses, still, still), gravity) < 1e-12
    model = having(**REMEMBER)
    tau = adapter.inverse_dynamics(model, poses, still, still)
    np.testing.assert_allclose(tau[4], adapter.inverse_dynamics(model, poses[4], *np.zeros((2, N))))
    assert 1e-6 < relative(tau, gravity) < 0.01  # a gear gives way under the weight


@pytest.mark.parametrize("name", REMEMBER)
def test_stamps_make_rows_one_motion(name: str) -> None:
    """As the effect's law over a table, whose rates no band limits."""
    model = having(**{name: REMEMBER[name]})
    motion = Motion(T, Q, DQ, DDQ, RigidArm.of(PANDA), smooth_hz=10.0)
    table = sensed_torque(motion, active_effects(model.effects, N))
    timed = adapter.inverse_dynamics(model, Q, DQ, DDQ, time_s=T)
    inner = slice(1300, -300)  # from where the motion has no jerk to where a low-pass ends
    memory = rms((table - ModelTorque(model)(Q, DQ, DDQ))[inner])[J]
    assert memory > 1e-3
    assert rms((timed - table)[inner])[J] < 0.02 * memory


@pytest.mark.parametrize("name", REMEMBER)
def test_stamps_need_not_be_even(name: str) -> None:
    """Jitter and rows that were left out change little of what is remembered, a pause too."""
    model = having(**{name: REMEMBER[name]})
    kept = np.sort(np.random.default_rng(4).choice(len(T), 2800, replace=False))
    kept = kept[(kept < 2500) | (kept > 2700)]
    even = adapter.inverse_dynamics(model, Q, DQ, DDQ, time_s=T)[kept]
    uneven = adapter.inverse_dynamics(model, Q[kept], DQ[kept], DDQ[kept], time_s=T[kept])
    away = (np.abs(T[kept] - 2.6) > 0.3) & (T[kept] > 1.3) & (T[kept] < 3.7)
    memory = rms((even - ModelTorque(model)(Q[kept], DQ[kept], DDQ[kept]))[away])[J]
    assert rms((uneven - even)[away])[J] < 0.1 * memory


def test_the_recipe_leaves_little_with_stamps() -> None:
    """`filtered` and `inverse_dynamics` of a noisy log whose sensors lag and whose joints creep."""
    every = {"joints": list(range(1, N + 1))}
    creep = {"effect": "bristle_friction", "parameters": {"Fc": 0.3, "s0": 3e-3}}
    lag = {"effect": "torque_filter", "parameters": {"d": 0.0, "c": 1.5e-4}}
    model = replace(PANDA, effects=(creep | every, lag | every))
    data = record(panda(), Path(6.0, seed=5))
    more = ModelTorque(model)(*data.true[:3], 1e-9 * data.stamp_ns) - data.true[3]
    log = adapter.make_log(1e-9 * data.stamp_ns, data.q, data.dq, data.tau + more)
    plain = adapter.make_log(1e-9 * data.stamp_ns, data.q, data.dq, data.tau)
    state, noise = adapter.filtered(log), adapter.filtered(plain)
    motion = state.q, state.dq, state.ddq
    timed = rms(state.tau - adapter.inverse_dynamics(model, *motion, time_s=state.time_s))
    instants = rms(state.tau - adapter.inverse_dynamics(model, *motion))
    least = rms(noise.tau - adapter.inverse_dynamics(PANDA, noise.q, noise.dq, noise.ddq))
    assert (timed < 1.5 * least + 0.02).all(), timed / least
    assert (timed < instants).all() and (instants < 1.0).all()


@pytest.mark.parametrize(
    ("stamps", "said"),
    [
        (T[:9], r"got shape \(9,\)"),
        (T[0], r"got shape \(1,\)"),
        (np.zeros(10), r"row 1 \(from 0\) has 0.0 s"),
        (T[:10][::-1], r"row 1 \(from 0\) has 0.008 s"),
        (np.append(T[:9], np.inf), r"row 9 \(from 0\) has inf s"),
        (np.append(np.nan, T[:9]), r"row 0 \(from 0\) has nan s"),
    ],
)
@pytest.mark.parametrize("effects", [True, False])
def test_stamps_that_are_none(stamps: np.ndarray, said: str, effects: bool) -> None:
    with pytest.raises(SettingsError, match=f"rising stamps.* rows are instants.*{said}"):
        adapter.inverse_dynamics(PANDA, Q[:10], DQ[:10], DDQ[:10], time_s=stamps, effects=effects)


def test_one_instant_may_have_a_stamp() -> None:
    model = having(friction_drift=REMEMBER["friction_drift"])
    tau = [adapter.inverse_dynamics(model, Q[9], DQ[9], DDQ[9], time_s=t) for t in (0.0, 20.0)]
    assert tau[0].shape == (N,)
    assert (tau[1] - tau[0])[J] == pytest.approx(np.tanh(DQ[9, J] / 0.01))
