"""The ring against a plain queue, and between two processes."""

from __future__ import annotations

import multiprocessing
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.realtime.ring import Ring, affordable_rows
from adapter.realtime.shared import SharedBlock, SharedMemoryError
from adapter.signals.records import stamp_of

moves = st.lists(
    st.one_of(
        st.tuples(st.just("push"), st.integers(1, 9)),
        st.tuples(st.just("take"), st.integers(0, 9)),
    ),
    max_size=60,
)


@settings(max_examples=60, deadline=None)
@given(rows=st.integers(1, 7), size=st.integers(1, 5), moves=moves)
def test_behaves_like_a_queue_that_refuses_when_full(rows, size, moves):
    ring, model, number = Ring.create(size, rows), deque(), 0
    try:
        for what, count in moves:
            if what == "push":
                for _ in range(count):
                    number += 1
                    record = np.arange(size) + 100.0 * number
                    stored = ring.push(record)
                    assert stored == (len(model) < rows)
                    if stored:
                        model.append(record)
                continue
            batch = ring.peek(count)
            assert len(batch) <= min(count, len(model))
            assert len(batch) or not count or not model
            for row in batch:
                np.testing.assert_array_equal(row, model.popleft())
            taken = len(batch)
            ring.release(taken)
            assert ring.unread == len(model)
    finally:
        ring.close()
        ring.unlink()


def test_stamps_keep_all_their_bits():
    ring, record = Ring.create(2, 2), np.zeros(2)
    record[:1].view(np.int64)[0] = (0x7FF4 << 48) | 12345  # as a float, a signalling not-a-number
    ring.push(record)
    row = ring.peek()[0].copy()
    assert stamp_of(row) == (0x7FF4 << 48) | 12345
    ring.close()
    ring.unlink()


def _produce(name: str, count: int) -> None:
    ring = Ring.attach(name)
    sent = 0
    while sent < count:
        sent += ring.push(np.full(ring.size, float(sent)))
    ring.finish()
    ring.close()


def test_between_processes_every_record_arrives_whole_and_in_order():
    ring, count = Ring.create(64, 50), 20_000
    process = multiprocessing.get_context("spawn").Process(target=_produce, args=(ring.name, count))
    process.start()
    expected = 0
    while True:
        finished = ring.finished
        batch = ring.peek()
        taken = len(batch)
        assert (batch == expected + np.arange(taken)[:, None]).all()
        expected += taken
        ring.release(taken)
        if finished and not taken:
            break
    process.join(30)
    assert expected == count and process.exitcode == 0
    ring.close()
    ring.unlink()


def test_memory_that_is_not_there_is_refused_with_a_remedy(monkeypatch):
    monkeypatch.setattr("adapter.realtime.shared.free_bytes", lambda: 1 << 20)
    with pytest.raises(SharedMemoryError, match="shm-size"):
        SharedBlock.create(2 << 20)
    monkeypatch.setattr("adapter.realtime.ring.free_bytes", lambda: 1 << 20)
    assert 100 < affordable_rows((100, 28), 60_000) < 1100


def test_a_successor_begins_where_it_is_told_and_counts_what_is_gone():
    ring = Ring.create(1, 8)
    try:
        for k in range(6):
            assert ring.push(np.array([float(k)]))
        ring.release(4)
        assert (ring.released, ring.taken, ring.kept, ring.unread) == (4, 4, 0, 2)
        assert ring.resume(2) == 2  # 2 and 3 may be written over by now
        assert (ring.skipped, ring.peek()[0, 0]) == (2, 4.0)
        ring.take(2)
        assert (ring.kept, ring.unread) == (2, 0)
        assert ring.resume(5) == 0
        assert (ring.skipped, ring.taken, ring.peek()[0, 0]) == (2, 5, 5.0)
        assert ring.resume(9) == 0 and ring.taken == 6  # not beyond what there is
    finally:
        ring.close()
        ring.unlink()
