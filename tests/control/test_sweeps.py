"""Slow motions that tell effects apart: what an experiment asks for, within every limit."""

from __future__ import annotations

import numpy as np
import pytest

from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.control.sweeps import HOLD_S, MOVES, RATES, SweepMotion
from adapter.effects.phrases import BOTH_WAYS, SPEEDS, STILL, TURN, TURNS
from adapter.errors import SettingsError
from adapter.model.robots import documented
from sim.scenarios import build
from tests.helpers.played import played

LIMITS = MotionLimits.of(documented("panda"))
READY = build("nominal").truth.ready
DT = 4e-3


def _played(motion):
    return played(motion, motion.length_s + 1.5, DT)  # the soft start takes half of its time more


@pytest.mark.parametrize("experiment", [SPEEDS, BOTH_WAYS, STILL, TURN, TURNS])
def test_moves_the_joints_asked_for_and_comes_back(experiment):
    motion = SweepMotion(LIMITS, READY, ExcitationSettings(), [(3, experiment), (5, experiment)])
    q, dq, ddq = _played(motion)
    lower, upper, speed, acceleration, _ = motion.bounds()
    assert (q >= lower - 1e-9).all() and (q <= upper + 1e-9).all()
    assert (lower >= LIMITS.lower).all() and (upper <= LIMITS.upper).all()
    assert (np.abs(dq) <= speed + 1e-9).all() and (speed <= 0.9 * LIMITS.velocity).all()
    assert (np.abs(ddq) <= acceleration + 1e-9).all()
    assert (acceleration <= LIMITS.acceleration).all()
    np.testing.assert_allclose(q[-1], READY, atol=1e-9)
    moved = np.ptp(q, axis=0) > 1e-6
    assert moved[[3, 5]].all() and moved.sum() == 2
    assert not ((dq[:, 3] != 0.0) & (dq[:, 5] != 0.0)).any()  # one after the other
    np.testing.assert_allclose(np.diff(q, axis=0) / DT, 0.5 * (dq[1:] + dq[:-1]), atol=1e-4)
    np.testing.assert_allclose(np.diff(dq, axis=0) / DT, 0.5 * (ddq[1:] + ddq[:-1]), atol=5e-2)


def test_speeds_are_held_either_way_and_rests_come_after_either_direction():
    speeds = _played(SweepMotion(LIMITS, READY, ExcitationSettings(), [(2, SPEEDS)]))[1][:, 2]
    for rate in RATES:
        for sign in (1.0, -1.0):
            assert DT * np.count_nonzero(np.abs(speeds - sign * rate) < 1e-9) > 0.05
    dq = _played(SweepMotion(LIMITS, READY, ExcitationSettings(), [(2, STILL)]))[1][:, 2]
    ends = np.flatnonzero((dq[:-1] != 0.0) & (dq[1:] == 0.0))
    before = np.sign(dq[ends])
    assert (before > 0).sum() == 3 and (before < 0).sum() == 3
    for end in ends:
        still = dq[end + 1 : end + 1 + int((HOLD_S - 0.1) / DT)]
        assert (still == 0.0).all()


def test_a_joint_without_room_is_named():
    at = READY.copy()
    at[3] = LIMITS.upper[3]
    motion = SweepMotion(LIMITS, at, ExcitationSettings(), [(3, TURNS)])
    assert motion.bounds()[1][3] <= LIMITS.upper[3]
    with pytest.raises(SettingsError, match="no joint"):
        SweepMotion(LIMITS, READY, ExcitationSettings(), [])
    assert set(MOVES) == {SPEEDS, BOTH_WAYS, STILL, TURN, TURNS}
