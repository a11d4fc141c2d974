"""Filtered states come every millisecond, whatever the rate of the samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapter.runs.library import learn
from adapter.runs.replay import fitted_to
from adapter.signals.front_end import FrontEnd
from adapter.signals.records import StateLayout, stamps_of
from adapter.signals.settings import FilterSettings
from drivers.files.mcap import Log
from tests.helpers.arm_data import Motion, arm, panda_model, record

LAYOUT = StateLayout(7)


def at_period(log: Log, period_ms: float) -> Log:
    """The same motion, sampled so."""
    stamps = np.arange(log.stamp_ns[0], log.stamp_ns[-1], round(1e6 * period_ms))
    q, dq, tau = (
        np.column_stack([np.interp(stamps, log.stamp_ns, x) for x in table.T])
        for table in (log.q, log.dq, log.tau)
    )
    return replace(log, stamp_ns=stamps, q=q, dq=dq, tau=tau)


def states_of(log: Log) -> np.ndarray:
    """What the front end makes of it."""
    settings, _ = fitted_to(log, FilterSettings())
    front_end = FrontEnd(panda_model(), settings)
    return front_end.step_table(log.stamp_ns, log.q, log.dq, log.tau)


@pytest.mark.parametrize("period_ms", [0.2, 0.4, 2.0, 8.0, 100.0 / 3.0, 50.0])
def test_states_are_those_of_a_kilohertz(period_ms: float) -> None:
    """One a millisecond; what is lost is what straight lines between the samples cut off."""
    log = record(arm(), Motion(6.0, seed=1, high_hz=0.5), noisy=False).log()
    usual, states = states_of(log), states_of(at_period(log, period_ms))
    stamps, known = stamps_of(states), stamps_of(usual)
    inside = (stamps > known[0]) & (stamps < known[-1])
    assert 0.75 < 1e-6 * np.median(np.diff(stamps)) < 1.25
    assert inside.sum() > 4500
    share = 0.01 + 0.1 * (period_ms / 50.0) ** 2
    for name in ("q", "dq", "ddq", "tau"):
        at = getattr(LAYOUT, name)
        for ours, theirs in zip(states[inside].T[at], usual.T[at], strict=True):
            wanted = np.interp(stamps[inside], known, theirs)
            assert np.abs(ours - wanted).max() < share * np.ptp(theirs), name


@pytest.mark.parametrize("rate", [30, 125])
def test_a_slow_log_is_learned_as_well_as_its_samples_allow(rate: int) -> None:
    """Held out, beside the documented arm, which is the truth here; and it has converged."""
    log = record(arm(), Motion(20.0, seed=2, high_hz=0.5)).log()
    slow = at_period(log, 1000.0 / rate)
    found = learn(slow, panda_model(), effects=(), every=20)
    assert found.theta_learned
    assert (found.held_out_rmse_nm < 0.3).all()
