"""Recordings that are mapped are those in memory, to the last bit and word."""

from pathlib import Path

import numpy as np
import pytest

from drivers.files.mcap import Log, McapWriter, read, read_log, records
from tests.helpers.mcap_tools import foreign, payloads, samples

NAMES = ("a", "b", "c")


def write(path: Path, samples: int, seed: int = 3) -> Path:
    """States with commands, some of them late, silent or of a second set of joints."""
    rng = np.random.default_rng(seed)
    with McapWriter(path, NAMES, metadata={"arm": "left"}) as writer:
        for i in range(samples):
            q, dq, tau = rng.standard_normal((3, 3))
            stamp_ns = 10**9 + 10**6 * (i - 5 * (i == 700))
            writer.write_joint_state(stamp_ns, q, dq if i % 5 else np.full(3, np.nan), tau)
            if i % 2:
                writer.write_command(stamp_ns + 300, tau + 1.0)
    return path


def mapped_log(path: Path, monkeypatch: pytest.MonkeyPatch) -> Log:
    """Read as a long one; so is what is read next."""
    monkeypatch.setattr(read, "IN_MEMORY", 0)
    return read_log(path)


def assert_same(whole: Log, log: Log) -> None:
    """All that a recording tells."""
    for name in ("stamp_ns", "q", "dq", "tau"):
        assert np.array_equal(getattr(whole, name), getattr(log, name), equal_nan=True), name
    assert np.array_equal(whole.commands.stamp_ns, log.commands.stamp_ns)
    assert np.array_equal(whole.commands.tau, log.commands.tau, equal_nan=True)
    for name in ("joint_names", "metadata", "topics", "topic", "truncated", "warnings"):
        assert getattr(whole, name) == getattr(log, name), name


def test_a_mapped_recording_is_the_one_in_memory(tmp_path: Path, monkeypatch) -> None:
    path = write(tmp_path / "log.mcap", 40_000)
    log, long = read_log(path), mapped_log(path, monkeypatch)
    assert long.is_mapped and not log.is_mapped
    assert any("backwards 1 times, first by 4.000 ms at sample 700" in w for w in log.warnings)
    assert any("8000 of 40000 messages have no velocity" in w for w in log.warnings)
    assert_same(long, log)
    assert (long.begin_ns, long.end_ns) == (log.begin_ns, log.end_ns)
    assert_same(long.select(("c", "a")), log.select(("c", "a")))
    for whole in (long, log):
        assert np.array_equal(np.concatenate([p.q for p in whole.pieces(7_000)]), log.q)
        assert min(len(piece) for piece in whole.pieces(len(log) - 1)) == len(log) // 2
    late = long.changed(lambda piece: piece.take(piece.stamp_ns > 2 * 10**10))
    assert np.array_equal(late.piece(0, 10).q, log.take(log.stamp_ns > 2 * 10**10).q[:10])


def test_a_piece_has_the_commands_of_its_time_and_more(tmp_path: Path, monkeypatch) -> None:
    long = mapped_log(write(tmp_path / "log.mcap", 600), monkeypatch)
    piece, every = long.piece(100, 200), long.commands.stamp_ns
    first, last = np.searchsorted(every, (piece.begin_ns, piece.end_ns + 1))
    assert np.array_equal(piece.commands.stamp_ns, every[first - 1 : last + 1])
    assert len(long.piece(0, 3).commands.stamp_ns) == 2


@pytest.mark.parametrize("cut", [0, 5_000])
def test_others_joints_and_a_cut_are_told_alike(tmp_path: Path, monkeypatch, cut: int) -> None:
    path = tmp_path / "log.mcap"
    rng = np.random.default_rng(1)
    with McapWriter(path, NAMES) as writer, McapWriter(tmp_path / "x.mcap", ("g",)) as other:
        for i in range(3_000):
            writer.write_joint_state(i * 10**6, *rng.standard_normal((3, 3)))
            if i % 3 == 0:
                writer._states, own = other._states, writer._states
                writer.write_joint_state(i * 10**6, *np.zeros((3, 1)))
                writer._states = own
        writer.write_command(0, np.zeros(3))
    path.write_bytes(path.read_bytes()[: -cut or None])
    log, long = read_log(path), mapped_log(path, monkeypatch)
    assert long.is_mapped and log.truncated == bool(cut)
    assert any("messages are of other joints (g)" in w for w in log.warnings)
    assert np.array_equal(long.q, log.q) and long.warnings == log.warnings


def test_commands_that_run_backwards_come_in_memory(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "log.mcap"
    with McapWriter(path, NAMES) as writer:
        for i in (1, 2, 3):
            writer.write_joint_state(i, *np.zeros((3, 3)))
            writer.write_command(-i + 10, np.ones(3))
    assert not mapped_log(path, monkeypatch).is_mapped


def test_messages_outside_of_chunks_come_in_several_regions(tmp_path: Path, monkeypatch) -> None:
    items = samples(3_000)
    flat = foreign(tmp_path / "flat.mcap", payloads(items), chunking=False)
    monkeypatch.setattr(records, "_TOGETHER", 700)
    assert len(list(records.McapScan(flat).regions())) == 5
    assert np.array_equal(read_log(flat).q, [s.q for s in items])
