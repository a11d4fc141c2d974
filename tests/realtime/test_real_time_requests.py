"""Requests to the operating system are answered in one line and taken back."""

from __future__ import annotations

import ctypes
import gc
import os

from adapter.realtime import real_time


def test_everything_is_given_back():
    before = os.sched_getaffinity(0), os.sched_getscheduler(0), gc.isenabled()
    with real_time.RealTime(core=max(before[0])) as asked:
        assert not gc.isenabled()
        granted = {grant.what: grant for grant in asked.grants}
        assert granted["collector"].granted
        if granted["core"].granted:
            assert os.sched_getaffinity(0) == {max(before[0])}
        if granted["priority"].granted:
            assert os.sched_getscheduler(0) & os.SCHED_FIFO
    assert (os.sched_getaffinity(0), os.sched_getscheduler(0), gc.isenabled()) == before


def test_a_refusal_says_why(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    grant, undo = real_time.request_fifo(70)
    assert not grant.granted and undo is None
    assert "refused" in grant.line and "CAP_SYS_NICE" in grant.line
    grant, undo = real_time.pin({100_000})
    assert not grant.granted and "have: " in grant.line

    class NoLock:
        def mlockall(self, flags):
            ctypes.set_errno(12)
            return -1

    monkeypatch.setattr(ctypes, "CDLL", lambda *a, **k: NoLock())
    grant, undo = real_time.lock_memory()
    assert (
        not grant.granted and "Cannot allocate memory" in grant.line and "ulimit -l" in grant.line
    )


def test_the_loop_has_a_core_for_itself_where_there_are_two():
    assert real_time.split_cores([0, 1, 2]) == ({2}, {0, 1})
    assert real_time.split_cores([4]) == ({4}, {4})
