"""Bags damaged on purpose: `info` and `gap` answer with one sentence, never a traceback."""

import re
import sqlite3
from contextlib import closing

import pytest
from rosbags.rosbag1 import Writer as Ros1Writer

from adapter.cli import main
from adapter.cli.exit_codes import ExitCode
from drivers.files.mcap import read_log
from drivers.interface import DriverError
from tests.helpers.bags import ROS1, Motion, write_ros1, write_ros2

JOINT_STATE = "sensor_msgs/msg/JointState"
STATES = {"/joint_states": (JOINT_STATE, Motion.of(7, samples=80))}
NAMES = tuple(f"panda_joint{i + 1}" for i in range(7))
ALL_ONES = b"\xff\xff\xff\xff"
MERGED = "a0: &a0 {k: 1}\n" + "".join(
    f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 8)}]\n" for i in range(1, 10)
)
IN_DATABASE = {
    "DROP TABLE messages": "no such table: messages",
    "DROP TABLE topics": "missing tables|no such table",
    "DROP TABLE message_definitions": "no such table: message_definitions",
    "ALTER TABLE messages RENAME COLUMN data TO x": "no such column: data",
    "UPDATE messages SET data = 'text'": "no readable message",
    "UPDATE messages SET data = zeroblob(30)": "no readable message",
    "UPDATE messages SET data = x'0001000000000000000000000100000000ffffffff'": (
        "no readable message"
    ),
    "UPDATE messages SET timestamp = -timestamp": "damaged or unfinished bag",
    "UPDATE messages SET timestamp = 'x'": "damaged or unfinished bag",
    "UPDATE messages SET topic_id = 99": "no message on /joint_states",
    "UPDATE topics SET name = x'ff00'": "name or type of a topic is no text",
    "UPDATE topics SET type = 'a/b/c/d'": "holds a/b/c/d",
    "UPDATE topics SET serialization_format = 'json'": "encoded as json",
    f"UPDATE topics SET offered_qos_profiles = '{MERGED}'": "profiles that no recorder writes",
    "DELETE FROM messages": "no message on /joint_states",
    "DELETE FROM topics": "found: no topic",
}
IN_ROS1 = {  # every field of this name
    "conn_count": (ALL_ONES, "index looks damaged"),
    "index_pos": (2 * ALL_ONES, "damaged or unfinished bag"),
    "chunk_pos": (2 * ALL_ONES, "damaged or unfinished bag"),
    "count": (ALL_ONES, "index looks damaged"),
    "ver": (ALL_ONES, "version 4294967295"),
    "op": (b"\xff", "damaged or unfinished bag"),
    "time": (2 * ALL_ONES, "damaged or unfinished bag"),
}


def answered(path, capsys):
    """What `info` says; `gap` refuses the same bag with one sentence."""
    said = []
    for command in (["info"], ["gap", "--robot", "panda", "--no-report"]):
        code = main([command[0], str(path), *command[1:]])
        told = capsys.readouterr()
        assert "Traceback" not in told.out + told.err
        assert code == ExitCode.WRONG_USE or (code == 0 and command == ["info"])
        if code:
            errors = [line for line in told.err.splitlines() if line.startswith("error: ")]
            assert len(errors) == 1 and path.name in errors[0]
        said.append(told.out + told.err)
    return said[0]


@pytest.mark.parametrize("statement", IN_DATABASE, ids=lambda text: text[:50])
def test_databases(tmp_path, capsys, statement):
    folder = write_ros2(tmp_path / "bag", STATES, NAMES)
    path = next(folder.glob("*.db3"))
    with closing(sqlite3.connect(path, isolation_level=None)) as base:
        base.execute(statement)
    assert re.search(IN_DATABASE[statement], answered(path, capsys))
    assert re.search(IN_DATABASE[statement], answered(folder, capsys))


@pytest.mark.parametrize("name", IN_ROS1)
def test_fields_of_ros1(tmp_path, capsys, name):
    path = write_ros1(tmp_path / "a.bag", STATES, NAMES)
    content, (value, said) = path.read_bytes(), IN_ROS1[name]
    sign = f"{name}=".encode()
    changed = re.sub(b"(?<=[\0-\x20])" + sign + b"(?s:.{%d})" % len(value), sign + value, content)
    assert changed != content
    path.write_bytes(changed)
    assert re.search(said, answered(path, capsys))


def test_a_description_that_lies(tmp_path):
    """What lies in the files counts."""
    whole = read_log(write_ros2(tmp_path / "whole", STATES, NAMES))
    for i, (old, new) in enumerate(
        (
            (r"version: \d+", "version: 99999999"),
            (r"message_count: \d+", "message_count: 99999999999999999999"),
            ("sqlite3", "mcap"),
            ("/joint_states", "/other"),
            (r"compression_mode: .*", "compression_mode: message"),
            (r"- \S+\.db3", "- ../../../../etc/passwd"),
            (r"(\s+- \S+\.db3)", r"\1\1\1"),
        )
    ):
        folder = write_ros2(tmp_path / f"{i}", STATES, NAMES)
        about = folder / "metadata.yaml"
        told = about.read_text()
        assert re.search(old, told)
        about.write_text(re.sub(old, new, told))
        log = read_log(folder)
        assert (log.q == whole.q).all() and len(log) == len(whole)


def test_chunks_of_ros1_that_share_their_index(tmp_path):
    """A few bytes for each of many chunks, and the same 80 messages in each."""
    path = write_ros1(tmp_path / "a.bag", STATES, NAMES)
    content = path.read_bytes()
    last = content[content.rfind(b"\x04\0\0\0op=\x06") - 4 :]  # the record that tells its chunk
    assert b"chunk_pos=" in last
    count = content.find(b"chunk_count=") + len(b"chunk_count=")
    more = bytearray(content + 300 * last)
    more[count : count + 4] = (301).to_bytes(4, "little")
    path.write_bytes(more)
    with pytest.raises(DriverError, match=r"a\.bag: has chunks that share their index"):
        read_log(path)


@pytest.mark.parametrize("limit", [10, 10_000])
def test_an_index_that_goes_to_and_fro(tmp_path, monkeypatch, limit):
    """Each message lies in the chunk that the one before does not: sixty times half a MiB."""
    monkeypatch.setattr("drivers.files.mcap.bags.CHUNK_LIMIT", 2**20)
    monkeypatch.setattr("drivers.files.mcap.bags.GROWTH_LIMIT", limit)
    writer = Ros1Writer(tmp_path / "a.bag")
    writer.set_compression(Ros1Writer.CompressionFormat.LZ4)
    with writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=ROS1)
        for half in range(2):
            for i in range(30):
                writer.chunk_threshold = 2**30 if i < 29 else 1
                writer.write(connection, 10**18 + 2 * i + half, bytes(2**14))
    said = "would grow more than" if limit == 10 else "no readable message"
    with pytest.raises(DriverError, match=said):
        read_log(tmp_path / "a.bag")
