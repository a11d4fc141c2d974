"""Recordings come back as they were written, ours and other people's."""

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from drivers.files.mcap import McapWriter, derive_velocity, read_log, recover
from drivers.files.messages import MotionEncoder
from drivers.files.ros_types import TWIST_STAMPED
from drivers.interface import DriverError
from tests.helpers.mcap_tools import JOINTS, LINKS, foreign, payloads, record, samples
from tests.helpers.ros_messages import assert_read_by_everybody


def stacked(items, name):
    return np.stack([getattr(s, name) for s in items])


def assert_same(log, items):
    assert log.stamp_ns.tolist() == [s.stamp_ns for s in items]
    for name in ("q", "dq", "tau"):
        assert np.array_equal(getattr(log, name), stacked(items, name)), name


def test_what_is_written_is_read(tmp_path):
    items = samples(250, links=True)
    path = record(tmp_path / "a.mcap", items, metadata={"version": "1.2", "config": {"rate": 1e3}})
    log = read_log(path)
    assert_same(log, items)
    assert log.joint_names == JOINTS
    assert log.link_names == LINKS
    assert np.array_equal(log.twists, np.stack([s.links.twist for s in items]))
    assert np.array_equal(log.accels, np.stack([s.links.accel for s in items]))
    assert log.metadata["config"] == {"rate": 1000.0}
    assert not log.truncated
    assert log.warnings == []


def test_other_tools_read_it(tmp_path):
    items = samples(50, links=True)
    path = record(tmp_path / "a.mcap", items)
    topics = {f"/link_{what}/{link}" for what in ("twists", "accels") for link in LINKS}
    found = assert_read_by_everybody(path, topics | {"/joint_states"})
    assert [list(m["position"]) for _, m in found["/joint_states"]] == [s.q.tolist() for s in items]
    _, twist = found["/link_twists/hand"][7]
    assert twist["header"]["frame_id"] == "hand"
    assert twist["twist"]["angular"]["x"] == items[7].links.twist[2, 3]


def test_commands_and_attachments(tmp_path):
    path = tmp_path / "a.mcap"
    with McapWriter(path, JOINTS) as writer:
        writer.attach("model.json", b"{}")
        for s in samples(5):
            writer.write(s)
            writer.write_command(s.stamp_ns, s.tau + 1)
    log = read_log(path)
    assert log.attachments == {"model.json": b"{}"}
    assert np.array_equal(log.commands.tau, log.tau + 1)
    assert log.commands.stamp_ns.tolist() == log.stamp_ns.tolist()


def test_the_older_spelling_of_a_type(tmp_path):
    path = foreign(tmp_path / "a.mcap", payloads(samples(3)), schema="sensor_msgs/JointState")
    assert len(read_log(path)) == 3


def test_joints_in_any_order_and_among_others(tmp_path):
    items = samples(20)
    first = payloads(items[:10], names=("wrist", "finger", "elbow"))
    turned = payloads(items[10:], names=("elbow", "wrist", "finger"))
    fingers = payloads(items[:4], names=("left", "right", "thumb"))
    path = foreign(tmp_path / "a.mcap", first + fingers + turned)
    log = read_log(path, ["elbow", "wrist"])
    assert log.joint_names == ("elbow", "wrist")
    assert np.array_equal(log.q[:10], stacked(items[:10], "q")[:, [2, 0]])
    assert np.array_equal(log.q[10:], stacked(items[10:], "q")[:, [0, 1]])
    assert log.q.flags.c_contiguous
    said = " ".join(log.warnings)
    assert "not asked for are ignored: finger" in said
    assert "4 messages are of other joints (left, right, thumb)" in said
    with pytest.raises(DriverError, match=r"no joint knee; have: .*elbow.*left"):
        read_log(path, ["knee"])


def test_links_follow_their_joints(tmp_path):
    path = record(tmp_path / "a.mcap", samples(20, links=True))
    log = read_log(path, ["wrist", "shoulder"])
    assert log.link_names == ("hand", "upper")
    assert np.array_equal(log.twists, read_log(path).twists[:, [2, 0]])
    with pytest.raises(DriverError, match="no motion of link tail; have: hand, upper"):
        log.select(["wrist"], ["tail"])


def test_link_motion_is_matched_by_stamp(tmp_path):
    items = samples(30, links=True)
    with McapWriter(tmp_path / "a.mcap", JOINTS, LINKS) as writer:
        for i, s in enumerate(items):
            writer.write_joint_state(s.stamp_ns, s.q, s.dq, s.tau)
            if i % 3 == 0:
                writer.write_links(s.stamp_ns, s.links)
        writer.write_links(items[-1].stamp_ns + 1, items[-1].links)
    log = read_log(tmp_path / "a.mcap")
    heard = ~np.isnan(log.twists).any(axis=(1, 2))
    assert np.flatnonzero(heard).tolist() == list(range(0, 30, 3))
    assert np.array_equal(log.accels[3], items[3].links.accel)
    assert "1 of 11 messages carry the stamp of no joint sample" in log.warnings[0]


def test_link_motion_of_another_frame_is_left_out(tmp_path):
    with McapWriter(tmp_path / "a.mcap", JOINTS, LINKS) as writer:
        writer._motions = tuple((name, MotionEncoder("world")) for name in LINKS)
        for s in samples(4, links=True):
            writer.write(s)
    log = read_log(tmp_path / "a.mcap")
    assert log.twists is None
    assert "in the frame 'world', not in that of the link, 'upper'" in log.warnings[0]


def test_missing_effort_is_refused(tmp_path):
    path = foreign(tmp_path / "a.mcap", payloads(samples(5), fields=("position", "velocity")))
    with pytest.raises(DriverError, match=r"a\.mcap: /joint_states has no effort \(0 values for 3"):
        read_log(path)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"fields": ("position", "effort")}, "100 of 100 messages have no velocity"),
        ({"stamp": lambda sample: 0}, "header stamps are 0"),  # log times stand for them
        ({"scale": 180 / np.pi}, "are these degrees?"),
    ],
)
def test_what_is_odd_about_a_recording_is_said(tmp_path, how, said):
    items = samples(100)
    log = read_log(foreign(tmp_path / "a.mcap", payloads(items, **how)))
    assert log.stamp_ns.tolist() == [s.stamp_ns for s in items]
    assert said in log.warnings[0]
    if "fields" in how:
        assert np.allclose(log.dq, np.gradient(log.q, 1e-3, axis=0))


def test_derived_velocity_passes_over_repeated_and_backward_stamps():
    seconds = np.array([0.0, 1.0, 1.0, 2.0, 1.5, 3.0])
    q = np.array([0.0, 2.0, 2.0, 4.0, 9.0, 6.0])[:, None]
    dq = derive_velocity((seconds * 1e9).astype(np.int64), q)
    assert np.allclose(dq, 2.0)


def test_time_running_backwards_is_reported(tmp_path):
    items = samples(10)
    path = foreign(tmp_path / "a.mcap", payloads(items[:6] + items[3:]))
    log = read_log(path)
    assert len(log) == 13
    assert "time runs backwards 1 times, first by 2.000 ms at sample 6" in log.warnings[0]


def test_unreadable_messages_are_left_out(tmp_path):
    items = payloads(samples(10))
    path = foreign(tmp_path / "a.mcap", [*items[:5], (1, b"\0\1\0\0" + bytes(8)), *items[5:]])
    log = read_log(path)
    assert len(log) == 10
    assert "1 messages are unreadable, first number 5" in log.warnings[0]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "is empty"),
        (b"\x89MC", "is cut after 3 bytes"),
        (b"t,q1,q2\n0,1,2\n", "is not an MCAP recording, .*adapter import"),
        (b"SQLite format 3\0" + bytes(100), "is a damaged or unfinished bag"),
    ],
)
def test_what_is_no_recording(tmp_path, content, sentence):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(DriverError, match=rf"a\.mcap: {sentence}"):
        read_log(path)
    with pytest.raises(DriverError, match="No such file"):
        read_log(tmp_path / "b.mcap")
    (tmp_path / "folder").mkdir()
    with pytest.raises(DriverError, match="is a folder"):
        read_log(tmp_path / "folder")


def test_no_joint_states_names_what_was_found(tmp_path):
    path = foreign(tmp_path / "a.mcap", payloads(samples(3)), topic="/arm/joint_states")
    with pytest.raises(DriverError, match=r"no message on /arm/states; found: /arm/joint_st.*3"):
        read_log(path, topic="/arm/states")
    assert len(read_log(path, topic="/arm/joint_states")) == 3
    other = foreign(
        tmp_path / "b.mcap", [(1, MotionEncoder("a").encode(1, np.zeros(6)))], schema=TWIST_STAMPED
    )
    with pytest.raises(DriverError, match="holds geometry_msgs/msg/TwistStamped encoded as cdr"):
        read_log(other)
    ros1 = foreign(tmp_path / "c.mcap", [(1, b"xxxx")], encoding="ros1")
    with pytest.raises(DriverError, match="encoded as ros1; need"):
        read_log(ros1)


def test_recover_copies_a_whole_file(tmp_path):
    items = samples(30, links=True)
    path = record(tmp_path / "a.mcap", items, metadata={"version": "3"})
    before = path.read_bytes()
    report = recover(path)
    assert report.was_whole
    assert report.out == tmp_path / "a.recovered.mcap"
    assert report.messages["/link_twists/hand"] == 30
    assert path.read_bytes() == before
    assert_same(read_log(report.out), items)
    assert read_log(report.out).metadata["version"] == "3"
    with pytest.raises(DriverError, match="exists"):
        recover(path)


@pytest.mark.parametrize("chunking", [True, False])
def test_recover_keeps_each_message_with_both_of_its_times(tmp_path, chunking):
    """Logged later than published, as by a recorder of another machine."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=chunking)
        writer.start(profile="ros2", library="somebody else")
        channel = writer.register_channel("/a", "json", 0)
        for k in range(20):
            writer.add_message(channel, 1000 + 7 * k, b"{}", 500 + 3 * k, 40 + k)
        writer.finish()
    recover(path)
    with (tmp_path / "a.recovered.mcap").open("rb") as file:
        found = [message for _, _, message in make_reader(file).iter_messages()]
    assert [m.log_time for m in found] == [1000 + 7 * k for k in range(20)]
    assert [m.publish_time for m in found] == [500 + 3 * k for k in range(20)]
    assert [m.sequence for m in found] == [40 + k for k in range(20)]
