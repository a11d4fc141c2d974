"""Bags of ROS 1 and rosbag2, written by `rosbags`, read like our own recordings."""

import gzip

import numpy as np
import pytest
import zstandard

from drivers.files.mcap import read_log
from drivers.interface import DriverError
from tests.helpers.bags import Motion, write_ros1, write_ros1_mcap, write_ros2
from tests.helpers.robot_models import shared

JOINT_STATE = "sensor_msgs/msg/JointState"
KINDS = (
    JOINT_STATE,
    "control_msgs/msg/DynamicJointState",
    "franka_msgs/msg/FrankaRobotState",
    "franka_msgs/msg/FrankaState",
)
SEVEN = tuple(f"arm_joint{i + 1}" for i in range(7))


def equal(log, motion):
    for name in ("stamp_ns", "q", "dq", "tau"):
        assert np.array_equal(getattr(log, name), getattr(motion, name)), name


@pytest.mark.parametrize("kind", KINDS)
def test_every_message_of_joints(tmp_path, kind):
    motion = Motion.of(7)
    path = write_ros2(tmp_path / "bag", {"/state": (kind, motion)}, SEVEN)
    log = read_log(path)
    equal(log, motion)
    named = tuple(f"joint{i + 1}" for i in range(7)) if kind.endswith("FrankaState") else SEVEN
    assert log.joint_names == named
    assert log.topic == "/state"


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
@pytest.mark.parametrize("kind", [JOINT_STATE, "franka_msgs/msg/FrankaState"])
def test_ros1(tmp_path, kind, compression):
    motion = Motion.of(7)
    path = write_ros1(tmp_path / "a.bag", {"/states": (kind, motion)}, SEVEN, compression)
    equal(read_log(path), motion)


def test_a_single_file_under_a_hostile_name_and_packed(tmp_path):
    motion = Motion.of()
    folder = write_ros2(tmp_path / "bag", {"/joint_states": (JOINT_STATE, motion)})
    content = next(folder.glob("*.db3")).read_bytes()
    for name, data in (
        ("50%20 of?it#1'.sqlite", content),
        ("a.db3.gz", gzip.compress(content)),
        ("a.db3.zstd", zstandard.compress(content)),
    ):
        (tmp_path / name).write_bytes(data)
        log = read_log(tmp_path / name)
        equal(log, motion)
        assert log.path == tmp_path / name


def test_the_usual_topic_comes_first_where_it_tells_efforts_and_the_others_are_named(tmp_path):
    both = {"/joint_states": (JOINT_STATE, Motion.of()), "/other": (JOINT_STATE, Motion.of(seed=4))}
    path = write_ros2(tmp_path / "a", both)
    log = read_log(path)
    equal(log, both["/joint_states"][1])
    assert [x for x in log.warnings if "also told by /other (--topic NAME)" in x]
    assert not read_log(path, topic="/joint_states").warnings
    one = {"/joint_states": both["/joint_states"]}
    assert not read_log(write_ros2(tmp_path / "b", one)).warnings


@pytest.mark.parametrize("kind", [JOINT_STATE, "franka_msgs/msg/FrankaState"])
def test_ros1_messages_in_mcap(tmp_path, kind):
    motion, other = Motion.of(7), Motion.of(7, seed=5)
    topics = {"/states": (kind, motion), "/more": (JOINT_STATE, other)}
    path = write_ros1_mcap(tmp_path / "a.mcap", topics, SEVEN)
    log = read_log(path, topic="/states")
    equal(log, motion)
    assert log.joint_names[0] == ("arm_joint1" if kind == JOINT_STATE else "joint1")
    equal(read_log(path, topic="/more"), other)


def test_a_cut_mcap_of_ros1_gives_what_it_has(tmp_path):
    motion = Motion.of()
    path = write_ros1_mcap(tmp_path / "a.mcap", {"/joint_states": (JOINT_STATE, motion)})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    log = read_log(path)
    assert log.truncated
    assert 0 < len(log) < 60
    assert np.array_equal(log.tau, motion.tau[: len(log)])


RULE = "=" * 80
# Any number of messages of no bytes would fit into one, and be walked over.
NO_BYTES = [
    f"{array} many\n{RULE}\nMSG: franka_msgs/Nothing\nfloat64[0] none\n"
    for array in ("Nothing[100000000]", "Nothing[]", "Nothing[2]")
]


@pytest.mark.parametrize(
    "definition", ["no!at64[] effort", "other_msgs/Unknown x", "\x00", *NO_BYTES]
)
def test_ros1_messages_whose_definition_is_none_are_refused(tmp_path, definition):
    topics = {"/arm": ("franka_msgs/msg/FrankaState", Motion.of(7))}
    path = write_ros1_mcap(tmp_path / "a.mcap", topics, SEVEN, definition)
    with pytest.raises(DriverError, match=r"a\.mcap: .*/arm"):
        read_log(path)


def whole_of(folder, kind, message=JOINT_STATE):
    """The bytes of a bag in one file."""
    topics = {"/joint_states": (message, Motion.of())}
    if kind == "bag":
        return write_ros1(folder / "whole.bag", topics).read_bytes()
    return next(write_ros2(folder / "bag", topics).glob("*.db3")).read_bytes()


@pytest.mark.parametrize("keep", [20, 100, 2000, 9000])
@pytest.mark.parametrize("kind", ["bag", "db3"])
def test_cut_bags_are_named(tmp_path, kind, keep):
    path = tmp_path / f"cut.{kind}"
    path.write_bytes(whole_of(tmp_path, kind)[:keep])
    with pytest.raises(DriverError, match=rf"cut\.{kind}: "):
        read_log(path)


@pytest.mark.parametrize("kind", ["bag", "db3"])
def test_any_damage_ends_in_samples_or_a_sentence(tmp_path, kind):
    whole = whole_of(tmp_path, kind, KINDS[1] if kind == "db3" else JOINT_STATE)
    rng, path, read = np.random.default_rng(7), tmp_path / f"x.{kind}", 0
    for _ in range(40):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), rng.integers(1, 12)):
            data[place] = rng.integers(256)
        path.write_bytes(data)
        try:
            read += len(read_log(path)) > 0
        except DriverError as error:
            assert f"x.{kind}: " in str(error)
    assert read > 0


def test_what_sqlite_has_not_written_in_is_said(tmp_path):
    folder = write_ros2(tmp_path / "bag", {"/joint_states": (JOINT_STATE, Motion.of())})
    path = next(folder.glob("*.db3"))
    path.with_name(f"{path.name}-wal").write_bytes(b"")
    assert "-wal is not read" in read_log(path).warnings[0]


@pytest.mark.parametrize(("name", "joints", "samples"), [("panda", 7, 727), ("ur10", 6, 3441)])
def test_bags_of_real_arms(name, joints, samples):
    log = read_log(shared(f"data/unisa_bags/{name}_exciting_trajectory.db3"))
    assert (len(log), len(log.joint_names)) == (samples, joints)
    assert np.isfinite(log.tau).all()
