"""Forward simulation along a recording: the true model repeats it, a lesser one does not."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects import Effect
from sim.rollout import MotionTable, rollout, segments_of, truth_from
from sim.truth import panda
from tests.sim.test_plant import T_S
from tests.sim.test_sim_effects import Record, arm_with

CLOSE = 1e-3  # rad after 0.5 s

SEGMENTS = [(100, 600), (600, 1100)]  # the torque of the first samples has a corner

BALL = {"m": 1.0, "cx": 0.02, "cy": -0.03, "cz": 0.15}
# Effect, and whether its absence shows in the motion under the true driving torque.
CASES = [
    (Effect("coulomb_friction", (4,), {"Fc": 1.0}), True),
    (Effect("asymmetric_friction", (6,), {"Fc_pos": 0.6, "Fc_neg": 0.3}), True),
    (Effect("stribeck_friction", (2,), {"Fc": 0.5, "Fs": 1.2, "vs": 0.1}), True),
    (Effect("load_dependent_friction", (2,), {"Fl": 0.05}), True),
    (Effect("motor_inertia", (5,), {"B": 0.1}), True),
    (Effect("joint_spring", (3,), {"k": 1.5, "q0": 0.5}), True),
    (Effect("torque_ripple", (1,), {"a": 0.5, "n": 6.0}), True),
    (Effect("payload", (), BALL, (0.7, None)), True),
    (Effect("base_tilt", (), {"rx": 0.03, "ry": 0.03}), True),
    (Effect("external_wrench", (), {"fx": 8.0, "fy": 0.0, "fz": 5.0}, (0.3, 0.9)), True),
    (Effect("joint_elasticity", (2,), {"k": 3000.0}), True),
    (Effect("encoder_offset", (4,), {"o": 0.02}), True),
    (Effect("encoder_ripple", (4,), {"a": 0.01, "phase": 0.2}), True),
    (Effect("backlash", (6,), {"b": 0.008}), True),
    (Effect("x_hysteresis", (1,), {"F": 0.5, "sigma": 80.0}), False),
]


def record_of(*effects, seconds=1.1):
    return Record(arm_with(*effects), seconds)


def table_of(record):
    return MotionTable(record.t, record.read_q, record.read_dq, record.u)


def worst(truth, record, u, **options):
    """Largest error in q over the segments of a record."""
    table = MotionTable(record.t, record.read_q, record.read_dq, u)
    made = rollout(truth, table, segments=SEGMENTS, **options)
    return np.nanmax(np.abs(made.q - record.read_q))


@pytest.mark.parametrize(("effect", "shows"), CASES)
def test_true_model_repeats_the_recording_and_a_lesser_one_does_not(effect, shows):
    record = record_of(effect)
    with_it = worst(arm_with(effect), record, record.u)
    if not shows:  # what the bristles hold at a restart is not in the recording
        assert with_it < 0.1
        return
    without = worst(panda(), record, record.u)
    assert with_it < CLOSE
    assert without > 3 * with_it and without > 1e-3


SENSED = [
    Effect("torque_gain", (2,), {"g": 0.06}),
    Effect("torque_offset", (4,), {"o": 0.5}, (0.5, None)),
    Effect("signal_delay", (), {"d": 0.0045}),
]


@pytest.mark.parametrize("effect", SENSED)
def test_measured_torque_is_freed_of_the_sensors_effects(effect):
    record = record_of(effect)
    with_it = worst(arm_with(effect), record, record.read_tau, drive="measured")
    without = worst(panda(), record, record.read_tau, drive="measured")
    assert with_it < CLOSE < without


def test_a_coarser_table_and_chosen_segments():
    effect = Effect("coulomb_friction", (2,), {"Fc": 1.0})
    record = record_of(effect, seconds=2.0)
    coarse = slice(None, None, 4)
    table = MotionTable(*(x[coarse] for x in table_of(record)))
    made = rollout(arm_with(effect), table, segments=[(100, 225), (300, 420)])
    assert np.flatnonzero(made.inside).tolist() == [*range(100, 225), *range(300, 420)]
    assert np.isnan(made.q[:100]).all()
    assert np.nanmax(np.abs(made.q - table.q)) < CLOSE
    q_rmse, dq_rmse = made.rmse(table.q, table.dq)
    assert q_rmse.shape == dq_rmse.shape == (7,)
    assert q_rmse.max() < CLOSE and dq_rmse.max() < 1e-2


def test_two_steps_per_tick_are_fine_enough():
    effects = (
        Effect("coulomb_friction", (1, 2, 3, 4), {"Fc": 0.5}),
        Effect("coulomb_friction", (5, 6, 7), {"Fc": 0.25}),
    )
    record = record_of(*effects, seconds=1.1)
    table = table_of(record)
    coarse, fine = (rollout(arm_with(*effects), table, substeps=k) for k in (2, 8))
    assert np.nanmax(np.abs(coarse.q - fine.q)) < 3e-4


def test_segments_cover_the_table_in_half_seconds():
    assert segments_of(np.arange(1200) * T_S) == [(0, 500), (500, 1000)]


def parts(**changes):
    arm = panda()
    return {
        "names": (arm.joint_names, arm.link_names),
        "frames": (arm.R.tolist(), arm.p.tolist()),
        "theta": arm.theta.tolist(),
        "gravity": arm.gravity.tolist(),
        **changes,
    }


def test_a_truth_from_plain_numbers_moves_like_the_arm():
    entry = {"effect": "viscous_friction", "joints": [3], "parameters": {"Fv": 0.8}, "std": {}}
    record = record_of(Effect("viscous_friction", (3,), {"Fv": 0.8}))
    assert worst(truth_from(**parts(effects=[entry])), record, record.u) < CLOSE


def test_a_body_that_no_rigid_body_is_still_moves():
    """Moments that break the triangle inequality, as learned ones may, are not set to zero."""
    theta = panda().theta.copy()
    theta[6, 4:] = [5e-3, 0.0, 0.0, 5e-3, 0.0, 3e-2]
    truth = truth_from(**parts(theta=theta))
    record = Record(panda(), 0.6)
    made, again = (rollout(x, table_of(record), [(0, 500)]) for x in (truth, panda()))
    assert np.isfinite(made.q[:500]).all()
    assert np.abs((made.q - again.q)[:500, 6]).max() > 0.01


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": (panda().R, np.zeros((6, 3)))}, r"p has shape \(6, 3\); needs \(7, 3\)"),
        ({"theta": np.full((7, 10), np.nan)}, "theta holds values that are not finite"),
        ({"frames": (np.ones((7, 3, 3)), panda().p)}, "no rotation"),
        ({"frames": (-panda().R, panda().p)}, "no rotation"),
        ({"names": (panda().joint_names, ["one"])}, "7 joints and 1 links"),
        ({"effects": [{"effect": "coulomb_friction"}]}, "needs: effect, parameters"),
    ],
)
def test_parts_that_do_not_fit_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        truth_from(**parts(**change))


def test_a_body_without_mass_is_refused():
    theta = panda().theta.copy()
    theta[2, 0] = 0.0
    zero = np.zeros((10, 7))
    with pytest.raises(ValueError, match=r"panda_link3 has a mass of 0.0 kg"):
        rollout(truth_from(**parts(theta=theta)), MotionTable(np.arange(10) * T_S, *3 * [zero]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t": np.arange(9) * T_S}, r"q has shape \(10, 7\); needs \(9, 7\)"),
        ({"t": np.arange(10) ** 2 * T_S}, "not uniform"),
        ({"u": np.zeros((10, 6))}, r"u has shape \(10, 6\)"),
        ({"dq": np.full((10, 7), np.inf)}, "dq holds values"),
        ({"drive": "torque"}, "no drive 'torque'; have: commands, measured"),
        ({"segments": [(5, 11)]}, r"segment \(5, 11\) is not inside"),
    ],
)
def test_tables_that_do_not_fit_are_refused(change, message):
    zero = np.zeros((10, 7))
    given = {"t": np.arange(10) * T_S, "q": zero, "dq": zero, "u": zero, **change}
    table = MotionTable(*(given.pop(key) for key in MotionTable._fields))
    with pytest.raises(ValueError, match=message):
        rollout(panda(), table, **given)
