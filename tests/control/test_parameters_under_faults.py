"""The parameters after a run with faults are those of the run without, within their deviations.

Same motion, same sensor noise. Much of θ is not seen by any torque, and its deviations are wide:
therefore the torques that both predict on unseen motion are compared too, and their errors against
the true ones. The whole grid of faults and shares: `python -m tests.helpers.fault_runs`.
"""

import pytest

from tests.helpers.fault_runs import FaultRun, clean_run, difference, run_faulty

SECONDS = 8.0
THETA_STD, TORQUE_STD, ERROR_RATIO = 2.0, 0.6, 1.6
ROTATION_RAD, POSITION_M = 1e-3, 1e-3
EACH = ("lost=0.1", "reordered=0.1", "corrupt=0.01", "late=0.1", "nan=0.1", "spike=0.01")
ALL_AT_ONCE = "lost=0.01,late=0.01,repeated=0.01,reordered=0.01,corrupt=0.01,nan=0.01,spike=0.01"


def check(run: FaultRun) -> None:
    """The run went to its end, all is accounted for, and the parameters agree."""
    assert (run.result.ended, run.result.fault) == ("duration", None)
    run.check_balance()
    assert run.finite and not run.learner.changes
    apart = difference(clean_run(SECONDS).learner, run.learner)
    assert apart.theta < THETA_STD, apart
    assert apart.torque < TORQUE_STD, apart
    assert apart.error_ratio < ERROR_RATIO, apart
    assert apart.rotation_rad < ROTATION_RAD and apart.position_m < POSITION_M, apart


@pytest.mark.slow
@pytest.mark.parametrize("text", EACH)
def test_parameters_agree(text: str) -> None:
    run = run_faulty(text, SECONDS)
    assert run.driver.account.injected[text.partition("=")[0]] > 50
    check(run)


def test_parameters_agree_with_every_fault_at_once() -> None:
    run = run_faulty(ALL_AT_ONCE, SECONDS)
    assert min(run.driver.account.injected.values()) > 50
    check(run)


def test_the_check_can_fail() -> None:
    """A run of two seconds is not taken for one of eight."""
    clean = clean_run(SECONDS).learner
    other = run_faulty("", 2.0).learner
    assert difference(clean, other).error_ratio > ERROR_RATIO
    assert difference(clean, clean).theta == 0.0
