"""A recording that was cut, killed or damaged gives what it holds and says what it lost."""

import os
import signal
import subprocess
import sys
import time
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType

from adapter.signals.recording import describe
from drivers.files.mcap import read_log, recover
from drivers.files.mcap.records import MAGIC
from drivers.interface import DriverError
from tests.helpers.mcap_tools import foreign, payloads, record, samples

COUNT = 600
EVERY = 150
ITEMS = samples(COUNT, links=True)
TORQUES = np.stack([s.tau for s in ITEMS])

RECORDER = """
import sys, time
import numpy as np
from drivers.interface import JointSample
from drivers.files.mcap import McapWriter
writer = McapWriter(sys.argv[1], ["a", "b"])
start = time.monotonic()
for i in range(100_000):
    while time.monotonic() < start + i * 1e-3:
        time.sleep(2e-4)
    x = np.full(2, float(i))
    writer.write(JointSample(time.time_ns(), x, x, x))
    if i == 0:
        print("recording", flush=True)
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    return record(path, ITEMS, EVERY, metadata={"version": "1"}).read_bytes()


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cut") / "cut.mcap"


def test_kill_9_costs_at_most_a_second(tmp_path):
    path = tmp_path / "killed.mcap"
    root = Path(__file__).parents[2]
    child = subprocess.Popen(
        [sys.executable, "-c", RECORDER, str(path)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    assert child.stdout is not None
    with child.stdout:
        assert child.stdout.readline() == b"recording\n"
        time.sleep(1.8)
        child.send_signal(signal.SIGKILL)
        killed_ns = time.time_ns()
        child.wait()
    log = read_log(path)
    assert log.truncated
    assert "the file is cut" in log.warnings[0]
    assert killed_ns - log.stamp_ns[-1] < 1_000_000_000
    assert np.array_equal(log.q[:, 0], np.arange(len(log)))
    report = recover(path)
    assert report.messages == {"/joint_states": len(log)}
    assert not read_log(report.out).truncated


def complete_chunks(content: bytes) -> list[int]:
    """Where the chunks of a file end."""
    summary = make_reader(BytesIO(content)).get_summary()
    assert summary is not None
    return [c.chunk_start_offset + c.chunk_length for c in summary.chunk_indexes]


@pytest.fixture(scope="module")
def ends(whole) -> list[int]:
    return complete_chunks(whole)


@settings(max_examples=60, deadline=None)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_cut_at_any_byte(whole, ends, place, share):
    cut = int(share * len(whole))
    place.write_bytes(whole[:cut])
    held = sum(end <= cut for end in ends) * EVERY
    try:
        log = read_log(place)
    except DriverError as error:
        assert held == 0
        assert str(place) in str(error)
        return
    assert log.truncated
    assert log.warnings
    assert held <= len(log) <= COUNT
    assert np.array_equal(log.tau, TORQUES[: len(log)])


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize("chunking", [True, False])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 1.0])
def test_files_of_others_whole_and_cut(tmp_path, compression, chunking, share):
    path = foreign(tmp_path / "a.mcap", payloads(ITEMS), "/joint_states", compression, chunking)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    log = read_log(path)
    assert log.truncated == (share < 1.0) and bool(log.warnings) == log.truncated
    assert len(log) > 0.5 * share * COUNT and (log.truncated or len(log) == COUNT)
    for name in ("stamp_ns", "q", "dq", "tau"):
        expected = [getattr(s, name) for s in ITEMS[: len(log)]]
        assert np.array_equal(getattr(log, name), expected), name


def test_the_readable_part_of_a_cut_chunk_is_read(tmp_path):
    path = record(tmp_path / "a.mcap", ITEMS, every=COUNT + 1)
    (end,) = complete_chunks(path.read_bytes())
    path.write_bytes(path.read_bytes()[: end - 20_000])
    log = read_log(path)
    assert len(log) > 0
    assert "messages of them could be read" in log.warnings[0]
    report = recover(path)
    assert report.messages["/joint_states"] == len(log)
    assert report.lost_bytes > 0
    assert np.array_equal(read_log(report.out).tau, log.tau)


def test_recover_in_place_keeps_everything(tmp_path, whole):
    path = tmp_path / "a.mcap"
    path.write_bytes(whole[: int(0.7 * len(whole))])
    before = read_log(path)
    report = recover(path, path)
    after = read_log(path)
    assert not report.was_whole
    assert not after.truncated
    assert after.warnings == [w for w in before.warnings if "is cut" not in w]
    assert np.array_equal(after.tau, before.tau)
    assert np.array_equal(after.twists, before.twists, equal_nan=True)
    assert after.metadata == before.metadata
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_a_failed_recovery_leaves_the_file(tmp_path, whole, monkeypatch):
    path = tmp_path / "a.mcap"
    path.write_bytes(whole[:-100])
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "no space")))
    with pytest.raises(DriverError, match="cannot be written: no space"):
        recover(path, path)
    assert path.read_bytes() == whole[:-100]
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize(("cut", "zeros"), [("index", 0), ("second chunk", 100_000)])
def test_a_cut_behind_chunks_loses_none_of_them(tmp_path, whole, ends, cut, zeros):
    path = tmp_path / "a.mcap"
    path.write_bytes(whole[: -len(MAGIC) - 3 if cut == "index" else ends[1]] + bytes(zeros))
    log = read_log(path)
    assert log.truncated and len(log) == (COUNT if cut == "index" else 2 * EVERY)
    said = "cut in its index; no message is lost" if cut == "index" else "is cut"
    assert said in log.warnings[0]


@pytest.mark.parametrize(
    ("chunk", "place", "bits", "said"),
    [
        (1, -500, 0xFF, "is damaged and was passed over"),
        (0, -500, 0xFF, "is damaged"),  # it alone defines the channels; the index repeats them
        (1, "length", 0x01, "damaged and were passed over"),
    ],
)
def test_a_damaged_chunk_costs_only_itself(tmp_path, whole, ends, chunk, place, bits, said):
    starts = [c.chunk_start_offset for c in make_reader(BytesIO(whole)).get_summary().chunk_indexes]
    path, data = tmp_path / "a.mcap", bytearray(whole)
    data[starts[chunk] + 4 if place == "length" else ends[chunk] + place] ^= bits
    path.write_bytes(data)
    log = read_log(path)
    left = np.delete(TORQUES, slice(chunk * EVERY, (chunk + 1) * EVERY), axis=0)
    assert np.array_equal(log.tau, left)
    assert said in log.warnings[0] and not log.truncated
    if place != "length":
        assert describe(path)["gaps"]["count"] == chunk  # none where the beginning is missing
        assert recover(path).messages["/joint_states"] == COUNT - EVERY


@settings(max_examples=60, deadline=None)
@given(share=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255), length=st.integers(1, 9))
def test_any_damage_ends_in_samples_or_a_sentence(whole, place, share, flip, length):
    data = bytearray(whole)
    at = int(share * len(data))
    for i in range(at, min(at + length, len(data))):
        data[i] ^= flip
    place.write_bytes(data)
    try:
        log = read_log(place)
    except DriverError as error:
        assert str(place) in str(error)
        return
    known = {s.stamp_ns: s.tau for s in ITEMS}
    for stamp, tau in zip(log.stamp_ns.tolist(), log.tau, strict=True):
        assert np.array_equal(known[stamp], tau)


def test_describe_of_a_file_without_joint_states(tmp_path):
    path = foreign(tmp_path / "a.mcap", payloads(ITEMS[:3]), topic="/other", schema="a/msg/B")
    facts = describe(path)
    assert "no message on /joint_states" in facts["problem"]
    assert facts["topics"]["/other"]["messages"] == 3
    (tmp_path / "b.mcap").write_bytes(b"")
    with pytest.raises(DriverError, match="is empty"):
        describe(tmp_path / "b.mcap")
