"""Long recordings: mapped ones are those in memory, to the last bit and word.

Rows that wait in a file come back bit by bit, and messages whose sizes come again in turn are
found at once, and none else than one by one.
"""

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode

from drivers.files import rows
from drivers.files.mcap import Log, McapWriter, read, read_log, records
from drivers.files.mcap.records import walk
from drivers.files.rows import RowsFile
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


@pytest.mark.parametrize("in_memory", [64, 2**20])
def test_rows_come_back_bit_by_bit(monkeypatch, in_memory: int) -> None:
    monkeypatch.setattr(rows, "IN_MEMORY", in_memory)
    rng = np.random.default_rng(3)
    table = rng.standard_normal((500, 5))
    table[7, 2], table[8, 3], table[9, 0] = np.nan, -0.0, np.int64(2**62 + 1).view(np.float64)
    kept = RowsFile(5)
    for start in range(0, 500, 33):
        kept.append(table[start : start + 33, :])
        assert kept.rows(start, start + 5).tobytes() == table[start : start + 5].tobytes()
    assert len(kept) == 500
    for start, stop in ((0, 500), (5, 10), (490, 600), (700, 800), (9, 3)):
        found = kept.rows(start, stop)
        assert found.tobytes() == table[start:stop].tobytes()
        assert found.shape == table[start:stop].shape
        assert found.flags.writeable


def test_rows_of_another_width_are_refused() -> None:
    with pytest.raises(ValueError, match="rows of 5 numbers"):
        RowsFile(5).append(np.zeros((2, 4)))


MESSAGE, CHANNEL, INVALID = int(Opcode.MESSAGE), int(Opcode.CHANNEL), 0
HEAD = struct.calcsize("<BQ")


def one(opcode: int, length: int, rng: np.random.Generator) -> bytes:
    return struct.pack("<BQ", opcode, length) + rng.bytes(length)


def one_by_one(data: bytes, most: int | None) -> tuple[list[int], list[int], int]:
    start, stop, at = [], [], 0
    while at + HEAD <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == INVALID or at + HEAD + length > len(data):
            break
        if opcode == MESSAGE:
            if len(start) == most:
                break
            start.append(at + HEAD + 22)
            stop.append(at + HEAD + length)
        at += HEAD + length
    return start, stop, at


@pytest.mark.parametrize("most", [None, 50, 333])
@pytest.mark.parametrize("seed", range(12))
def test_a_walk_finds_what_is_there(seed, most):
    rng = np.random.default_rng(seed)
    parts: list[bytes] = []
    for _ in range(rng.integers(1, 6)):
        sizes = rng.integers(22, 90, rng.integers(1, 13))  # some turns are longer than looked for
        for _ in range(rng.integers(1, 60)):
            parts += [one(MESSAGE, int(x), rng) for x in sizes]
        if rng.random() < 0.7:
            parts.append(one(CHANNEL, int(rng.integers(0, 40)), rng))
    data = b"".join(parts)
    data = data[: len(data) - int(rng.integers(0, 60))] + bytes(int(rng.integers(0, 40)))
    found = walk(memoryview(data), 0, frozenset({INVALID}), most)
    start, stop, end = one_by_one(data, most)
    assert (list(found.start), list(found.stop), found.end) == (start, stop, end)
    assert found.full == (most is not None and len(start) == most and end < len(data))
