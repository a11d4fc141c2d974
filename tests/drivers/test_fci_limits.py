"""The last look at a command for an FCI robot: torque and step, up and down alike."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.fci.torque_control import (
    OWN_COMMANDS,
    SETTLE_TICKS,
    STRANGE_TICKS,
    TORQUE_LIMIT,
    TORQUE_STEP,
    TorqueLimiter,
)
from drivers.interface import DriverError, checked_torques


def all_joints(value):
    return [float(value)] * 7


def raised_to(value):
    """A limiter that has reached this torque at every joint, each command accepted."""
    limiter, own = TorqueLimiter(), all_joints(0.0)
    for _ in range(100):
        own = limiter.limit(all_joints(value), own)
        if own == all_joints(value):
            return limiter
    raise AssertionError(f"it does not reach {value}")


def test_the_numbers_are_the_robots():
    assert TORQUE_LIMIT == (87.0,) * 4 + (12.0,) * 3
    assert 0.95 < TORQUE_STEP < 1.0  # N m per ms, documented: 1000 N m/s


@given(
    wanted=st.lists(st.lists(st.floats(-100.0, 100.0), min_size=7, max_size=7), max_size=30),
    late=st.lists(st.integers(0, 1), min_size=30, max_size=30),
)
def test_nothing_is_further_than_a_step_from_the_last_and_the_accepted(wanted, late):
    """Where the robot is one command behind, a step counts from both, and no shorter than that."""
    limiter = TorqueLimiter()
    sent = [all_joints(0.0)]
    for k, tau in enumerate(wanted):
        own, last = sent[-1 - late[k] if len(sent) > 1 else -1], sent[-1]
        out = limiter.limit(tau, own)
        assert out is not None
        for want, x, a, b, most in zip(tau, out, last, own, TORQUE_LIMIT, strict=True):
            away = max(abs(x - a), abs(x - b))
            assert away <= TORQUE_STEP + 1e-12 and abs(x) <= most
            at_limit = math.isclose(away, TORQUE_STEP) or abs(x) == most
            assert x == want or at_limit
        sent.append(out)


def test_a_command_that_got_lost_is_no_step_back():
    limiter = raised_to(3.0)
    assert limiter.limit(all_joints(9.0), all_joints(3.0)) == pytest.approx(all_joints(3.99))
    assert limiter.limit(all_joints(9.0), all_joints(3.0)) == pytest.approx(all_joints(3.99))
    assert limiter.limit(all_joints(-9.0), all_joints(3.0)) == pytest.approx(all_joints(3.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_commands_on_their_way_are_waited_for(sign):
    """More than two steps apart nothing goes out; nearer than that, the next step does."""
    limiter = TorqueLimiter()
    sent, own = [], all_joints(0.0)
    for _ in range(8):
        own = limiter.limit(all_joints(sign * 50.0), own)
        sent.append(own)
    for behind in (7, 6, 5, 4):
        assert limiter.limit(all_joints(sign * 50.0), sent[-behind]) is None
    out = limiter.limit(all_joints(sign * 50.0), sent[-2])
    assert out is not None and abs(abs(out[0]) - 7 * TORQUE_STEP) < 1.01 * TORQUE_STEP


def test_an_accepted_torque_that_stands_still_counts_after_a_while():
    limiter = raised_to(9.0)
    known = all_joints(3 * TORQUE_STEP)  # sent on the way up
    answers = [limiter.limit(all_joints(50.0), known) for _ in range(SETTLE_TICKS + 2)]
    assert answers[:SETTLE_TICKS] == [None] * SETTLE_TICKS
    assert answers[SETTLE_TICKS] == pytest.approx(all_joints(4 * TORQUE_STEP))
    assert limiter.cut >= SETTLE_TICKS


def test_a_torque_that_was_never_sent_is_believed_when_it_comes_again():
    """Bits can flip: one wrong number is no reason to jump."""
    limiter = raised_to(3.0)
    assert limiter.limit(all_joints(3.0), all_joints(-40.0)) is None
    assert limiter.limit(all_joints(3.0), all_joints(3.0)) == all_joints(3.0)
    answers = [limiter.limit(all_joints(9.0), all_joints(2.5)) for _ in range(STRANGE_TICKS)]
    assert answers[: STRANGE_TICKS - 1] == [None] * (STRANGE_TICKS - 1)
    assert answers[-1] == pytest.approx(all_joints(2.5 + TORQUE_STEP))
    assert all(limiter.limit(all_joints(3.0), all_joints(math.nan)) is None for _ in range(9))


def test_only_the_latest_commands_are_known():
    limiter, own = TorqueLimiter(), all_joints(0.0)
    first = limiter.limit(all_joints(0.5), own)
    own = first
    for k in range(OWN_COMMANDS):
        own = limiter.limit(all_joints(0.5 + 0.01 * (k + 1)), own)
    assert limiter.limit(own, all_joints(0.51)) is not None
    assert limiter.limit(own, first) is None


def test_a_new_motion_counts_from_what_the_robot_then_drives_with():
    limiter = raised_to(3.0)
    limiter.reset()
    assert limiter.last == all_joints(0.0)
    assert limiter.limit(all_joints(-20.0), all_joints(-7.0)) == pytest.approx(all_joints(-7.99))
    limiter.reset()
    assert limiter.limit(all_joints(5.0), all_joints(math.nan)) is None


def test_commands_are_seven_finite_numbers():
    assert checked_torques([1, 2, 3, 4, 5, 6, 7], 7).tolist() == [1, 2, 3, 4, 5, 6, 7]
    for bad in (np.full(7, np.nan), np.zeros(6), np.zeros((1, 7)), [math.inf] + [0.0] * 6):
        with pytest.raises(DriverError, match="7 finite torques"):
            checked_torques(bad, 7)
