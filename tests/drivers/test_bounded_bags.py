"""Bags that make very much of few bytes are refused, before they take memory or disk."""

import gzip
import re
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer

from drivers.files.mcap import read_log
from drivers.interface import DriverError
from tests.helpers.bags import ROS1, ROS2, Motion, write_ros1, write_ros2
from tests.helpers.mcap_tools import weighed_alone

JOINT_STATE = "sensor_msgs/msg/JointState"
STATES = {"/joint_states": (JOINT_STATE, Motion.of())}
ZEROS = 2**27 + 2**24  # bytes of one message, in a few kB of a bag: more than a chunk may make


def ros1(path, compression, messages):
    """A bag of raw messages, a chunk each."""
    writer = Ros1Writer(path)
    writer.chunk_threshold = 1
    writer.set_compression(Ros1Writer.CompressionFormat[compression])
    return filled(writer, path, ROS1, messages)


def filled(writer, path, store, messages):
    with writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=store)
        for i, message in enumerate(messages):
            writer.write(connection, 10**18 + i, message)
    return path


def ros2(path, mode, messages, storage=StoragePlugin.SQLITE3):
    writer = Ros2Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    return filled(writer, path, ROS2, messages)


def base_of(path):
    """An SQLite file of rosbag2, and a connection to it."""
    folder = write_ros2(path.with_suffix(""), STATES)
    next(folder.glob("*.db3")).rename(path)
    return closing(sqlite3.connect(path, isolation_level=None))


def computing(path, value, rows):
    """Its messages are computed."""
    with base_of(path) as base:
        base.execute("DROP TABLE messages")
        base.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            f"data BLOB GENERATED ALWAYS AS ({value}) VIRTUAL)"
        )
        base.executemany("INSERT INTO messages VALUES(?, 1, ?)", [(i, i) for i in range(rows)])
    return path


def endless(path):
    """Its definitions of messages never end."""
    with base_of(path) as base:
        base.execute("DROP TABLE message_definitions")
        base.execute(
            "CREATE VIEW message_definitions AS WITH RECURSIVE n(id) AS "
            "(SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT id, 'a' AS topic_type, "
            "'ros2msg' AS encoding, 'b' AS encoded_message_definition, '' AS "
            "type_description_hash FROM n"
        )
    return path


BOMBS = {
    "lz4.bag": lambda path, n: ros1(path, "LZ4", [bytes(n)]),
    "bz2.bag": lambda path, n: ros1(path, "BZ2", [bytes(n)]),
    "messages": lambda path, n: ros2(path, CompressionMode.MESSAGE, [bytes(n)]),
    "messages in MCAP": lambda path, n: ros2(
        path, CompressionMode.MESSAGE, [bytes(n)], StoragePlugin.MCAP
    ),
    "file": lambda path, n: ros2(path, CompressionMode.FILE, [bytes(2 * n)]),
    "computed.db3": lambda path, n: computing(path, f"zeroblob({n})", 1),
    "computed much.db3": lambda path, n: computing(path, f"zeroblob({n // 4})", 40),
    "endless.db3": lambda path, n: endless(path),
}
SAID = "would grow more than 300 times|makes more than 134217728 bytes|computes '|packed twice"


@pytest.mark.parametrize("name", BOMBS)
def test_a_bag_does_not_grow_in_memory(tmp_path, name):
    path = BOMBS[name](tmp_path / name, ZEROS)
    told, most_kib = weighed_alone("read_log", path)
    assert told.startswith("DriverError") and re.search(SAID, told)
    assert most_kib < 300_000, told


def test_every_step_is_bounded(tmp_path, monkeypatch):
    """Many chunks, messages or files that are each small enough."""
    monkeypatch.setattr("drivers.files.mcap.bags.CHUNK_LIMIT", 2**20)
    monkeypatch.setattr("drivers.files.mcap.bags.GROWTH_LIMIT", 10)
    zeros = [bytes(2**19)] * 60
    for path in (
        ros1(tmp_path / "lz4.bag", "LZ4", zeros),
        ros1(tmp_path / "bz2.bag", "BZ2", zeros),
        ros2(tmp_path / "messages", CompressionMode.MESSAGE, zeros),
        ros2(tmp_path / "mcap", CompressionMode.MESSAGE, zeros, StoragePlugin.MCAP),
        ros2(tmp_path / "file", CompressionMode.FILE, zeros),
    ):
        with pytest.raises(DriverError, match="would grow more than 10 times; not read"):
            read_log(path)
    grown = tmp_path / "grown.db3.gz"  # eight messages that fit into the file, not into the packed
    inner = next(ros2(tmp_path / "in", CompressionMode.MESSAGE, zeros[:8]).glob("*.db3"))
    grown.write_bytes(gzip.compress(inner.read_bytes() + bytes(2**19)))
    with pytest.raises(DriverError, match=r"grown\.db3\.gz: would grow more than 10 times"):
        read_log(grown)
    twice = tmp_path / "twice.bag.gz"
    twice.write_bytes(gzip.compress(gzip.compress(write_ros1(tmp_path / "a", STATES).read_bytes())))
    with pytest.raises(DriverError, match=r"twice\.bag\.gz: is packed twice"):
        read_log(twice)


@pytest.mark.parametrize("mode", [None, CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize("storage", StoragePlugin)
def test_what_is_honest_is_read_in_order(tmp_path, storage, mode):
    """A bag of three files, as a recorder splits it, whichever its channels' numbers."""
    parts = [Motion.of(seed=seed) for seed in (1, 2, 3)]
    folder, names = tmp_path / "bag", []
    for i, part in enumerate(parts):
        topics = {"/joint_states": (JOINT_STATE, part)}
        if i == 1:
            topics = {"/first": (JOINT_STATE, Motion.of(samples=2)), **topics}
        one = write_ros2(tmp_path / f"{i}", topics, storage=storage, compression=mode)
        text = (one / "metadata.yaml").read_text()
        file = next(p for p in one.iterdir() if p.suffix != ".yaml")
        folder.mkdir(exist_ok=True)
        names.append(f"bag_{2 - i}{''.join(file.suffixes)}")
        file.rename(folder / names[-1])
    listed = "\n".join(f"  - {name}" for name in names)
    text = re.sub(r"relative_file_paths:(\s*- .*)+", f"relative_file_paths:\n{listed}", text)
    (folder / "metadata.yaml").write_text(text)
    log = read_log(folder, topic="/joint_states")
    assert log.path == folder
    assert np.array_equal(log.q, np.concatenate([part.q for part in parts]))
    assert np.array_equal(log.stamp_ns, np.concatenate([part.stamp_ns for part in parts]))
    assert {name: topic.messages for name, topic in log.topics.items()} == {
        "/first": 2,
        "/joint_states": 180,
    }


def test_a_description_that_grows(tmp_path):
    """Mappings merged into each other eight times at each of nine levels."""
    folder = write_ros2(tmp_path / "bag", STATES)
    about = folder / "metadata.yaml"
    text = "a0: &a0 {k: 1}\n"
    for i in range(1, 10):
        text += f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 8)}]\n"
    about.write_text(f"{text}{about.read_text()}")
    assert len(read_log(folder)) == 60
    about.write_text("rosbag2_bagfile_information: *nothing\n" + text)
    assert "the only file there is read" in read_log(folder).warnings[0]
    next(folder.glob("*.db3")).rename(folder / "other")
    for content, said in (
        ("a: [" * 50_000, "cannot be read"),
        ("- a\n" * 2**19, "more than 1 MiB"),
        ("rosbag2_bagfile_information: {relative_file_paths: [..]}", "names the file .*not there"),
        ("rosbag2_bagfile_information: {relative_file_paths: []}", "names no file"),
        ("rosbag2_bagfile_information: {relative_file_paths: [[a]]}", "has no list of files"),
    ):
        about.write_text(content)
        with pytest.raises(DriverError, match=rf"metadata\.yaml: .*{said}"):
            read_log(folder)
