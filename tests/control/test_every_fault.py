"""What the loop does upon each fault of single samples: one test for each row of the table in docs.

Faults that cost samples alone are put into a recording, those that end a run into the simulated
arm under its controller; the last tests have all of the first there, too: the parameters after a
run with faults are those of the run without, within their deviations. Much of θ is not seen by any
torque, and its deviations are wide: therefore the torques that both predict on unseen motion are
compared too, and their errors against the true ones. Faults by the thousand:
`tests/benchmarks/fault_trials.py`.
"""

from __future__ import annotations

import numpy as np
import pytest

from drivers.faults.driver import with_faults
from tests.helpers.fault_runs import FaultRun, clean_run, difference, heard, run_faulty
from tests.helpers.live_tools import simulated_arm

SECONDS = 3.5  # of a recording
MOVING_S = 3.0  # of the simulated arm
USUAL = ("filter_settling", "at_rest")


def unusual(run: FaultRun) -> dict[str, int]:
    """What was refused beside what every start refuses, and the recording without faults."""
    own = heard("", SECONDS).refused
    more = {name: count - own.get(name, 0) for name, count in run.refused.items()}
    return {name: count for name, count in more.items() if name not in USUAL and count}


def went_on(text: str) -> FaultRun:
    """A run that a fault does not end."""
    run = heard(text, SECONDS)
    assert (run.result.ended, run.result.fault) == ("end_of_stream", None)
    run.check_balance()
    assert run.watched.finite and not run.learner.changes
    return run


def ended(text: str, *said: str) -> FaultRun:
    """A run that ends with one sentence which contains all that was said."""
    run = run_faulty(text, MOVING_S)
    assert run.result.ended == "driver_error" and run.result.fault is not None
    assert all(part in run.result.fault for part in said), run.result.fault
    assert "\n" not in run.result.fault
    account = run.driver.account
    assert account.balanced and run.watched.finite
    assert run.result.samples == run.result.passed_on + sum(run.refused.values())
    return run


def test_lost() -> None:
    run = went_on("lost=0.1")
    assert run.driver.account.injected["lost"] > 0 and not unusual(run)
    # each hole costs the samples in it and nothing else
    assert run.result.samples + run.driver.account.injected["lost"] == run.driver.account.taken
    assert run.learner.learned > 0.81 * heard("", SECONDS).learner.learned


@pytest.mark.parametrize("text", ["late=0.1", "reordered=0.01"])
def test_late_and_reordered(text: str) -> None:
    run = went_on(text)
    assert set(unusual(run)) <= {"time_backwards", "implausible_step"}
    assert run.refused.get("implausible_step", 0) <= 3
    assert 0 < run.refused["time_backwards"] <= run.driver.account.injected[text.split("=")[0]]
    assert any("time does not increase" in said for said in run.front_end.messages)


def test_repeated_samples_change_nothing_at_all() -> None:
    run, clean = went_on("repeated=0.1"), heard("", SECONDS)
    assert unusual(run) == {"repeated": run.driver.account.injected["repeated"]}
    assert run.refused["repeated"] > 100
    assert np.array_equal(run.learner.theta.theta, clean.learner.theta.theta)
    assert np.array_equal(run.learner.schema.lam, clean.learner.schema.lam)


@pytest.mark.parametrize(
    ("text", "reasons", "least", "most", "room"),
    [
        ("corrupt=0.1", "non_finite out_of_range implausible_step repeated", 0.0, 1.2, 3),
        ("nan=0.1", "non_finite", 1.0, 1.0, 0),
        ("spike=0.1", "implausible_step out_of_range", 0.8, 1.4, 3),
        ("stamp=0.002", "time_ahead time_backwards", 0.0, np.inf, 0),
    ],
)
def test_wrong_numbers_are_refused_by_what_is_wrong(text, reasons, least, most, room) -> None:
    """What is not refused changed a number by less than noise does."""
    run = went_on(text)
    hit, refused = run.driver.account.injected[text.split("=")[0]], unusual(run)
    assert set(refused) <= set(reasons.split())
    assert least * hit - room / 3 <= sum(refused.values()) <= most * hit + room


def test_a_jump_of_an_encoder_ends_the_run_with_the_last_good_parameters() -> None:
    run = ended("jump:3@2.5+0.03", "joint 3")
    assert run.refused["encoder_jump"] > 0
    assert any("panda_joint3 jumped" in said for said in run.front_end.messages)
    before = clean_run(MOVING_S).watched.history[run.learner.learned - 1]
    assert np.array_equal(run.learner.theta.theta, before)
    assert 2500 - 260 < run.learner.learned < 2500


def test_in_passive_mode_nothing_is_learned_behind_a_jump() -> None:
    run = heard("jump:3@1.5+0.05", SECONDS)
    assert run.watched.stamps_ms[-1] < 1500 and run.refused["encoder_jump"] > 1900
    assert run.front_end.fault is not None and "panda_joint3" in run.front_end.fault


def test_in_passive_mode_a_stuck_joint_is_left_out_until_it_moves() -> None:
    run = heard("stuck:1@1.5+0.5", SECONDS)
    learned = run.watched.stamps_ms
    assert 300 < run.refused["stuck_joint"] <= 500
    assert not [t for t in learned if 1600 < t < 1950] and learned[-1] > 3400


def test_in_passive_mode_a_silence_restarts_the_filter() -> None:
    run = heard("silence@1.5+0.05", SECONDS)
    assert run.front_end.gaps == [(1_499_000_000, pytest.approx(0.051))]
    assert "without a sample" in run.front_end.messages[0]
    assert run.watched.stamps_ms[-1] > 3400


def test_a_joint_stuck_for_a_moment_is_left_out() -> None:
    run = went_on("stuck:2@2+0.015")
    assert set(unusual(run)) <= {"stuck_joint", "implausible_step"}


def test_a_stuck_joint_ends_the_run_with_the_last_good_parameters() -> None:
    run = ended("stuck:2@2.5+1", "joint")
    assert run.refused["stuck_joint"] > 0
    before = clean_run(MOVING_S).watched.history[run.learner.learned - 1]
    std = np.sqrt(run.learner.theta.covariance().diagonal()[:70]).reshape(7, 10)
    assert (np.abs(run.learner.theta.theta - before) < std).all()


@pytest.mark.parametrize("offset", ["+3600", "-0.05"])
def test_a_clock_jump(offset: str) -> None:
    """Stamps that go on from elsewhere cost a restart of the filter, not the run."""
    run = went_on(f"clock@2{offset}")
    assert set(unusual(run)) <= {"time_ahead", "time_backwards", "implausible_step"}
    assert sum(unusual(run).values()) <= 110
    assert run.refused["filter_settling"] > heard("", SECONDS).refused["filter_settling"]


def test_a_short_silence_is_bridged() -> None:
    run = went_on("silence@2+0.015")
    assert run.driver.account.injected["silence"] == 15 and not run.front_end.gaps


@pytest.mark.parametrize(
    ("text", "said"),
    [("silence@2+5", "nothing heard"), ("died@2", "connection to the arm is gone")],
)
def test_a_silent_or_dead_connection_ends_the_run(text: str, said: str) -> None:
    run = ended(text, said)
    before = clean_run(MOVING_S).watched.history[run.learner.learned - 1]
    assert np.array_equal(run.learner.theta.theta, before)


def test_a_slow_read_in_lockstep_changes_nothing() -> None:
    run = went_on("slow=0.01+0.002")
    assert run.driver.account.injected["slow"] > 10
    assert np.array_equal(run.learner.theta.theta, heard("", SECONDS).learner.theta.theta)
    assert with_faults(simulated_arm(), "slow=0.5").faults.items[0].amount == 0.005


LONG_S = 8.0
ROTATION_RAD, POSITION_M = 1e-3, 1e-3
ALL_AT_ONCE = "lost=0.01,late=0.01,repeated=0.01,reordered=0.01,corrupt=0.01,nan=0.01,spike=0.01"


def test_parameters_agree_with_every_fault_at_once() -> None:
    """The run goes to its end, all is accounted for, and the parameters agree."""
    run = run_faulty(ALL_AT_ONCE, LONG_S)
    assert min(run.driver.account.injected.values()) > 50
    assert (run.result.ended, run.result.fault) == ("duration", None)
    run.check_balance()
    assert run.watched.finite and not run.learner.changes
    apart = difference(clean_run(LONG_S).learner, run.learner)
    assert apart.theta < 2.0, apart
    assert apart.torque < 0.6, apart
    assert apart.error_ratio < 1.6, apart
    assert apart.rotation_rad < ROTATION_RAD and apart.position_m < POSITION_M, apart
