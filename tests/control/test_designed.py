"""A designed motion keeps every limit and what it must not touch, and teaches most.

So do slow motions that tell effects apart: what an experiment asks for.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.control.designed import SPEED_ROOM, DesignedMotion, Designer, Gauge, _basis
from adapter.control.excitation import RandomMotion
from adapter.control.information import EFFECTS, Information
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.control.sweeps import HOLD_S, MOVES, RATES, SweepMotion
from adapter.effects.phrases import BOTH_WAYS, SPEEDS, STILL, TURN, TURNS
from adapter.errors import SettingsError
from adapter.model.robots import documented
from adapter.physics.identifiability import BODY_SIZE
from sim.scenarios import build
from tests.helpers.live_tools import check_course, played

PANDA = documented("panda")
LIMITS = MotionLimits.of(PANDA)
READY = build("nominal").truth.ready
TOLD = Information(PANDA)
DT, STEP = 2e-3, 4e-3


def _table(motion, seconds, count=300):
    """q, dq, ddq of a motion long since at full speed."""
    rows = np.array([motion.path(s).copy() for s in np.linspace(0.0, seconds, count)])
    return tuple(rows[:, k].copy() for k in range(3))


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    share=st.lists(st.floats(0.0, 1.0), min_size=7, max_size=7),
    stop_s=st.floats(0.0, 12.0),
    slow=st.sampled_from([0.0, 1.5]),
)
@pytest.mark.parametrize("robot", ["panda", "fr3"])
def test_keeps_every_limit_for_every_seed_start_and_stop(robot, seed, share, stop_s, slow):
    model = documented(robot)
    limits = MotionLimits.of(model)
    start = limits.lower + np.array(share) * (limits.upper - limits.lower)
    start = np.minimum(start, limits.upper)
    how = ExcitationSettings(seed=seed, slow_s=slow, slow_share=0.3)
    motion = Designer(Information(model), steps=8)(limits, start, how)
    lower, upper, speed, acceleration, jerk = motion.bounds()
    q, dq, _ = course = played(motion, stop_s, DT)
    check_course(motion, course, DT)
    assert (q >= limits.lower - 1e-9).all() and (q <= limits.upper + 1e-9).all()
    assert (speed <= 0.95 * limits.speed_between(lower, upper)).all()
    assert (acceleration <= 0.95 * limits.acceleration).all() and (jerk <= limits.jerk).all()
    np.testing.assert_allclose(q[0], q[1], atol=1e-6)
    assert (dq[-1] == 0.0).all()


def test_standard_deviations_are_those_of_least_squares_on_noisy_torques():
    std = 0.01 * LIMITS.effort
    told = Information(PANDA, None, (), std)
    table = _table(RandomMotion(LIMITS, READY, ExcitationSettings(seed=1)), 10.0, 200)
    Y = told.regressor(*table)
    expected = told.expected(200 * told.mean(*table), 0.05)
    weighted = (Y / std[:, None]).reshape(-1, 70)
    rng, errors = np.random.default_rng(0), []
    # the belief before any data is data on its own: x = 0 +- its size
    belief = np.diag(1.0 / (5.0 * told.size))
    rows = np.vstack([weighted, belief])
    for _ in range(400):
        noise = rng.normal(size=len(weighted))
        errors.append(np.linalg.lstsq(rows, np.r_[noise, rng.normal(size=70)], rcond=None)[0])
    size = np.tile(BODY_SIZE, 7)
    basis = np.linalg.qr(told.basis * size[:, None])[0]
    shown = np.array(errors) @ ((basis * size[:, None]) @ (basis / size[:, None]).T).T
    found = shown.std(axis=0)
    assert expected.shown.sum() > 35
    np.testing.assert_allclose(
        expected.std[expected.shown], found[expected.shown], rtol=0.2, atol=1e-9
    )


def test_the_gradient_is_that_of_the_value():
    omega = 2.0 * np.pi * 0.2 * np.arange(1, 4)
    rng = np.random.default_rng(3)
    x = 0.05 * rng.normal(size=(7, 6))
    designer = Designer(TOLD)
    table = _basis(omega, 40)
    _, slope = designer._slope(READY, table, x, rng)
    for _ in range(6):
        way = rng.normal(size=x.shape)
        up, down = (designer._slope(READY, table, x + s * 1e-5 * way, rng)[0] for s in (1, -1))
        assert (slope * way).sum() == pytest.approx(
            (up - down) / 2e-5, abs=1e-2 * np.linalg.norm(slope)
        )


def test_the_gauge_is_one_where_a_limit_is_met():
    omega = 2.0 * np.pi * 0.1 * np.arange(1, 11)
    gauge = Gauge(LIMITS, READY, ExcitationSettings(), omega)
    x = np.random.default_rng(0).normal(size=(7, 20)) / np.tile(omega, 2)
    used, along = gauge(x)
    np.testing.assert_allclose((along * x).sum(axis=1), used)
    motion = DesignedMotion(READY, omega, x / used[:, None], ExcitationSettings())
    lower, upper, speed, acceleration, _ = motion.bounds()
    own = ExcitationSettings()
    parts = np.array(
        [
            speed / (SPEED_ROOM * own.share * LIMITS.velocity),
            acceleration / (own.share * LIMITS.acceleration),
            (upper - READY) / (LIMITS.upper - own.margin - READY),
            (READY - lower) / (READY - LIMITS.lower - own.margin),
            (upper - lower) / (own.range_share * (LIMITS.upper - LIMITS.lower - 2 * own.margin)),
        ]
    )
    np.testing.assert_allclose(parts.max(axis=0), 1.0, atol=0.05)


@pytest.mark.parametrize("seed", [1, 2])
def test_teaches_far_more_than_random_motion(seed):
    how = ExcitationSettings(seed=seed)
    designed = _table(Designer(TOLD, steps=60)(LIMITS, READY, how), 10.0)
    drawn = _table(RandomMotion(LIMITS, READY, how), 10.0)
    mine, others = (TOLD.mean(*table) for table in (designed, drawn))
    assert np.linalg.slogdet(mine)[1] - np.linalg.slogdet(others)[1] > 1.2 * len(mine)
    worst = [TOLD.expected(300 * H, 0.05).worst for H in (mine, others)]
    assert worst[0] < 0.4 * worst[1]
    rigid = Information(PANDA, None, ())
    conditions = [
        np.linalg.cond(rigid.regressor(*table).reshape(-1, 70) @ rigid.basis)
        for table in (designed, drawn)
    ]
    assert conditions[0] < conditions[1] / 2.5


def test_goes_on_from_what_is_known():
    how = ExcitationSettings(seed=4, move=("panda_joint6", "panda_joint7"))
    wrist = _table(RandomMotion(LIMITS, READY, how), 30.0)
    known = 1e4 * TOLD.mean(*wrist)
    alone, further = (
        Designer(TOLD, known=k, steps=60)(LIMITS, READY, ExcitationSettings(seed=5))
        for k in (None, known)
    )
    after = [
        np.linalg.slogdet(known + 300 * TOLD.mean(*_table(m, 10.0)))[1] for m in (alone, further)
    ]
    assert after[1] > after[0]


def test_joints_that_are_not_to_move_stand():
    how = ExcitationSettings(seed=6, move=("panda_joint2", "panda_joint4"))
    motion = Designer(TOLD, steps=10)(LIMITS, READY, how)
    lower, upper = motion.bounds()[:2]
    still = [0, 2, 4, 5, 6]
    np.testing.assert_array_equal(lower[still], READY[still])
    np.testing.assert_array_equal(upper[still], READY[still])
    assert (upper - lower)[[1, 3]].min() > 0.3
    assert set(EFFECTS) >= {"viscous_friction", "coulomb_friction"}


def _played(motion):
    return played(motion, motion.length_s + 1.5, STEP)  # the soft start takes half of its time more


@pytest.mark.parametrize("experiment", [SPEEDS, BOTH_WAYS, STILL, TURN, TURNS])
def test_moves_the_joints_asked_for_and_comes_back(experiment):
    motion = SweepMotion(LIMITS, READY, ExcitationSettings(), [(3, experiment), (5, experiment)])
    q, dq, _ = course = _played(motion)
    check_course(motion, course, STEP)
    lower, upper, speed, acceleration, _ = motion.bounds()
    assert (lower >= LIMITS.lower).all() and (upper <= LIMITS.upper).all()
    assert (speed <= 0.9 * LIMITS.velocity).all() and (acceleration <= LIMITS.acceleration).all()
    np.testing.assert_allclose(q[-1], READY, atol=1e-9)
    moved = np.ptp(q, axis=0) > 1e-6
    assert moved[[3, 5]].all() and moved.sum() == 2
    assert not ((dq[:, 3] != 0.0) & (dq[:, 5] != 0.0)).any()  # one after the other


def test_speeds_are_held_either_way_and_rests_come_after_either_direction():
    speeds = _played(SweepMotion(LIMITS, READY, ExcitationSettings(), [(2, SPEEDS)]))[1][:, 2]
    for rate in RATES:
        for sign in (1.0, -1.0):
            assert STEP * np.count_nonzero(np.abs(speeds - sign * rate) < 1e-9) > 0.05
    dq = _played(SweepMotion(LIMITS, READY, ExcitationSettings(), [(2, STILL)]))[1][:, 2]
    ends = np.flatnonzero((dq[:-1] != 0.0) & (dq[1:] == 0.0))
    before = np.sign(dq[ends])
    assert (before > 0).sum() == 3 and (before < 0).sum() == 3
    for end in ends:
        still = dq[end + 1 : end + 1 + int((HOLD_S - 0.1) / STEP)]
        assert (still == 0.0).all()


def test_a_joint_without_room_is_named():
    at = READY.copy()
    at[3] = LIMITS.upper[3]
    motion = SweepMotion(LIMITS, at, ExcitationSettings(), [(3, TURNS)])
    assert motion.bounds()[1][3] <= LIMITS.upper[3]
    with pytest.raises(SettingsError, match="no joint"):
        SweepMotion(LIMITS, READY, ExcitationSettings(), [])
    assert set(MOVES) == {SPEEDS, BOTH_WAYS, STILL, TURN, TURNS}
