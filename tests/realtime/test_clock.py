"""Deadlines on a made-up clock, the figures of timing against numpy, requests to the system."""

from __future__ import annotations

import ctypes
import gc
import os
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.realtime import real_time
from adapter.realtime.real_time import Clock
from adapter.realtime.timing import Histogram, Timing
from drivers.process import sleep_until

PERIOD = 1_000_000


class FakeTime:
    """A clock that jumps: to the asked instant when slept, a little with every look."""

    def __init__(self) -> None:
        self.ns = 12_345

    def now(self) -> int:
        self.ns += 50
        return self.ns

    def sleep(self, until: int) -> None:
        self.ns = max(self.ns, until)


@settings(max_examples=100, deadline=None)
@given(work=st.lists(st.integers(0, 6 * PERIOD), min_size=1, max_size=40))
def test_deadlines_stay_on_the_grid_and_are_missed_only_by_more_than_a_period(work):
    fake = FakeTime()
    clock = Clock(PERIOD, now=fake.now, sleep=fake.sleep)
    clock.start()
    t0 = clock._t0
    for waits, busy in enumerate(work, start=1):
        before, asked = clock.k, fake.ns
        late = clock.wait()
        deadline = t0 + clock.k * PERIOD
        assert late >= 0 and fake.ns == deadline + late
        assert clock.k + 1 == waits + clock.missed
        skipped = clock.k - before - 1
        behind = asked - (t0 + (before + 1) * PERIOD)
        if skipped:
            assert behind > PERIOD - 200 and late < 200  # waited for one in the future
        else:
            assert behind <= PERIOD
        fake.ns += busy


def test_where_the_source_keeps_the_rhythm_periods_without_a_tick_are_missed():
    """A loop held up for 30 periods by the machine, then for 5 by its own work."""
    used = iter([0, 0, 0, 100, 100, 100, 6 * PERIOD, 6 * PERIOD])
    clock, at = Clock(PERIOD, used=lambda: next(used)), 12_345
    for step in (0, PERIOD, round(1.3 * PERIOD), 31 * PERIOD, 1000, 6 * PERIOD):
        at += step
        clock.follow(at)
    assert (clock.missed, clock.missed_own) == (35, 5)


def test_sleeps_on_the_real_clock_until_the_absolute_instant():
    at = time.monotonic_ns() + 5_000_000
    sleep_until(at)
    assert time.monotonic_ns() >= at
    sleep_until(at - 1_000_000_000)  # gone by: returns at once


@settings(max_examples=50, deadline=None)
@given(values=st.lists(st.integers(0, 10**12), min_size=1, max_size=300))
def test_percentiles_are_right_to_two_tenths_of_a_percent(values):
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    for share in (50.0, 99.0, 99.9):
        exact = 1e-3 * np.percentile(values, share, method="inverted_cdf")
        assert abs(histogram.percentile_us(share) - exact) <= 2e-3 * exact + 1e-3
    assert histogram.summary_us()["max"] == 1e-3 * max(values)


def test_physics_time_is_told_apart_and_an_empty_report_says_none():
    timing = Timing()
    assert timing.report().tick_us["p50"] is None
    for k in range(10):
        timing.add(k * PERIOD, k * PERIOD + 300_000, k * PERIOD + 400_000, 200_000)
        timing.late(1000)
    report = timing.report(missed=3)
    assert (report.ticks, report.missed_deadlines) == (10, 3)
    assert abs(report.tick_us["p50"] - 100) < 0.2 and abs(report.loop_us["max"] - 200) < 0.2
    assert abs(report.plant_us["p50"] - 200) < 0.4 and report.period_us["mean"] == 1000.0


@pytest.mark.parametrize(("used_ms", "own"), [(0.2, 0), (1.2, 2), (4.0, 3)])
def test_who_is_to_blame_for_a_missed_deadline(used_ms: float, own: int) -> None:
    """A tick that ends 3.5 ms late: our own work as far as the thread ran, else the machine."""
    ms = 1_000_000
    state = {"now": 0, "used": 0}
    clock = Clock(
        ms,
        now=lambda: state["now"],
        sleep=lambda until: state.update(now=until),
        used=lambda: state["used"],
        spin_ns=0,
    )
    clock.wait()
    state["now"] += round(3.5 * ms)
    state["used"] += round(used_ms * ms)
    clock.wait()
    assert (clock.missed, clock.missed_own) == (3, own)


def test_everything_is_given_back():
    before = os.sched_getaffinity(0), os.sched_getscheduler(0), gc.isenabled()
    with real_time.RealTime(core=max(before[0])) as asked:
        assert not gc.isenabled()
        granted = {line.partition(":")[0] for line in asked.grants if "refused" not in line}
        assert "collector" in granted
        if "core" in granted:
            assert os.sched_getaffinity(0) == {max(before[0])}
        if "priority" in granted:
            assert os.sched_getscheduler(0) & os.SCHED_FIFO
    assert (os.sched_getaffinity(0), os.sched_getscheduler(0), gc.isenabled()) == before


def test_a_refusal_says_why(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    line, undo = real_time.request_fifo(70)
    assert "refused" in line and "CAP_SYS_NICE" in line and undo is None
    line, undo = real_time.pin({100_000})
    assert undo is None and "have: " in line

    class NoLock:
        def mlockall(self, flags):
            ctypes.set_errno(12)
            return -1

    monkeypatch.setattr(ctypes, "CDLL", lambda *a, **k: NoLock())
    line, undo = real_time.lock_memory()
    assert undo is None and "Cannot allocate memory" in line and "ulimit -l" in line


def test_the_loop_has_a_core_for_itself_where_there_are_two():
    assert real_time.split_cores([0, 1, 2]) == ({2}, {0, 1})
    assert real_time.split_cores([4]) == ({4}, {4})
