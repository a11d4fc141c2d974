"""The ring against a plain queue, and between two processes; and the published estimate.

That is never torn, clear when absent, and leaves nothing behind.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections import deque
from dataclasses import replace
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.model.self_model import LAMBDA_MEASURED
from adapter.realtime import SnapshotError, SnapshotReader, SnapshotWriter, snapshot
from adapter.realtime.ring import Ring, affordable_rows
from adapter.realtime.shared import SharedBlock, SharedMemoryError
from adapter.realtime.snapshot import PID
from adapter.signals.records import stamp_of
from tests.helpers.live_learners import nothing_known

moves = st.lists(
    st.one_of(
        st.tuples(st.just("push"), st.integers(1, 9)), st.tuples(st.just("take"), st.integers(0, 9))
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


JOINTS = ("a", "b", "c")


@pytest.fixture
def board():
    writer = SnapshotWriter.create(
        JOINTS, ("viscous_friction",), name=f"adapter-test-{os.getpid()}"
    )
    yield writer
    writer.close()
    writer.unlink()


def _of(number: float):
    parts = nothing_known(3, 3, 1)
    filled = {
        key: np.full(getattr(parts, key).shape, number)
        for key in ("lam", "lam_std", "theta", "theta_std", "effects", "effects_std")
    }
    return replace(parts, **filled, stamp_ns=int(number), learned=int(number))


def test_what_is_published_is_read(board):
    with SnapshotReader(board.name) as reader:
        before = reader.read()
        assert before.version == 0 and np.isnan(before.lam).all() and not before.lam_converged
        wanted = replace(_of(7.0), lam_converged=True, lambda_source=LAMBDA_MEASURED)
        board.publish(wanted)
        found = reader.read()
    assert reader.joint_names == JOINTS and reader.effect_names == ("viscous_friction",)
    assert found.version == 1 and found.stamp_ns == found.learned == 7
    assert found.lam_converged and not found.theta_converged
    assert found.lambda_source == LAMBDA_MEASURED and found.age_s >= 0.0
    for key in ("lam", "lam_std", "theta", "theta_std", "effects", "effects_std"):
        np.testing.assert_array_equal(getattr(found, key), getattr(wanted, key))


def test_nobody_watches_what_pushes_the_arm(board):
    """The estimate alone is published: what pushes is not known, and that is said."""
    board.publish(_of(1.0))
    with SnapshotReader(board.name) as reader:
        push = reader.read_external()
    assert push.version == 0 and push.contact_joint is None and not push.learned
    assert np.isnan(push.torque).all() and np.isnan(push.wrench_std).all()


def test_what_does_not_fit_is_refused(board):
    with pytest.raises(ValueError, match="lam must have shape"):
        board.publish(replace(_of(1.0), lam=np.zeros((2, 6))))
    with pytest.raises(ValueError, match="have: documentation"):
        board.publish(replace(_of(1.0), lambda_source="guess"))


def test_absent_and_closed_are_said_clearly(board):
    with pytest.raises(SnapshotError, match="no estimate is published as 'nobody'"):
        SnapshotReader("nobody")
    reader = SnapshotReader(board.name)
    reader.close()
    with pytest.raises(SnapshotError, match="was closed"):
        reader.read()


def test_a_name_in_use_is_refused_and_a_leftover_replaced(board):
    with pytest.raises(SnapshotError, match=f"in use by process {os.getpid()}"):
        SnapshotWriter.create(JOINTS, name=board.name)
    board._header[PID] = 2**22 + 1  # of no process
    fresh = SnapshotWriter.create(JOINTS, name=board.name)
    assert fresh.effect_names == ()
    fresh.close()


def header(**words: int) -> bytes:
    """The head of a block that says it is ours, and room behind it."""
    head = np.zeros(snapshot.HEADER_WORDS, np.int64)
    head[snapshot.KIND] = snapshot.MAGIC
    for word, value in words.items():
        head[getattr(snapshot, word)] = value
    return head.tobytes() + bytes(2**16)


FOREIGN = {
    "small": b"somebody's",
    "page": b"\0" * 4096,
    "large counts": header(N=2**40, BODIES=2**40, TEXT=2),
    "negative counts": header(N=-1, BODIES=-1),
    "long text": header(TEXT=2**62),
    "no names": header(N=3, BODIES=3, TEXT=9),
    "owner of no process": header(PID=2**62),
}


@pytest.mark.parametrize("content", FOREIGN.values(), ids=FOREIGN)
def test_what_somebody_else_has_under_this_name_survives(content: bytes) -> None:
    """It is neither read as an estimate nor written over; a run publishes under another name."""
    name = f"adapter-test-foreign-{os.getpid()}"
    theirs = SharedMemory(name, create=True, size=len(content))
    try:
        theirs.buf[: len(content)] = content
        with pytest.raises(SnapshotError, match=r"another program|no whole estimate"):
            SnapshotReader(name).read(timeout_s=0.01)
        if len(content) < 2**16:  # else it is taken for what a dead process left
            with pytest.raises(SnapshotError, match="in use by another program"):
                SnapshotWriter.create(JOINTS, name=name)
            assert bytes(theirs.buf[: len(content)]) == content
    finally:
        theirs.close()
        theirs.unlink()


def _hammer(name: str, stop) -> None:
    writer = SnapshotWriter.attach(name)
    number = 0
    while not stop.is_set():
        for _ in range(200):
            number += 1
            writer.publish(_of(float(number)))
    writer.close()


def test_a_hammering_writer_is_never_read_torn(board):
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    process = context.Process(target=_hammer, args=(board.name, stop))
    process.start()
    versions = []
    with SnapshotReader(board.name) as reader:
        while reader.read().version == 0:
            pass
        for _ in range(5_000):
            found = reader.read()
            values = np.concatenate(
                [v.ravel() for v in (found.lam, found.theta_std, found.effects, found.effects_std)]
            )
            assert (values == found.version).all() and found.stamp_ns == found.version
            versions.append(found.version)
    stop.set()
    process.join(30)
    assert process.exitcode == 0
    assert (np.diff(versions) >= 0).all() and versions[-1] > versions[0]


def test_a_foreign_reader_leaves_the_memory_and_stderr_alone(board):
    code = (
        "from adapter.realtime import SnapshotReader; import sys;"
        "print(SnapshotReader(sys.argv[1]).read().version)"
    )
    board.publish(_of(1.0))
    done = subprocess.run(
        [sys.executable, "-c", code, board.name], capture_output=True, text=True, timeout=120
    )
    assert (done.stdout, done.stderr) == ("1\n", "")
    if Path("/dev/shm").is_dir():
        assert Path("/dev/shm", board.name).exists()
