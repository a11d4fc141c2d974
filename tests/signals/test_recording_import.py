"""Bags of others, turned by `adapter import` into recordings of our own."""

import gzip
import re

import numpy as np
import pytest

from adapter.cli import main
from adapter.cli.exit_codes import ExitCode
from adapter.signals.importer import velocity_doubts
from drivers.files.mcap import McapWriter, read_log
from drivers.files.mcap.records import McapScan
from tests.helpers.bags import JOINTS, Motion, write_ros1, write_ros2
from tests.helpers.mcap_tools import record, samples

JOINT_STATE = "sensor_msgs/msg/JointState"
MOTION = Motion.of()
STATES = {"/joint_states": (JOINT_STATE, MOTION)}
NAMED = Motion.of(7, samples=30)


def packed(path):
    whole = next(write_ros2(path.with_suffix(""), STATES).glob("*.db3"))
    path.write_bytes(gzip.compress(whole.read_bytes()))
    return path


MAKERS = {
    "folder": lambda path: write_ros2(path, STATES),
    "ros1 without a suffix": lambda path: write_ros1(path, STATES, compression="BZ2"),
    "packed.db3.gz": packed,
}


def imported(source, *options):
    """What `import` made of it."""
    out = source.parent / "out.mcap"
    assert main(["import", str(source), "--to", str(out), *map(str, options)]) == 0
    assert not list(source.parent.glob("*.part"))
    return out


def refused(capsys, source, *options):
    """The one sentence of a refusal; nothing is written."""
    out = source.parent / "none.mcap"
    capsys.readouterr()
    assert main(["import", str(source), "--to", str(out), *options]) == ExitCode.WRONG_USE
    assert not list(source.parent.glob("none*"))
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 2 and said[0].startswith("reading ")
    return said[1]


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.filterwarnings("error")
def test_every_bag_becomes_the_same_recording(tmp_path, name):
    out = imported(MAKERS[name](tmp_path / name))
    log, scan = read_log(out), McapScan(out)
    list(scan.regions())
    assert scan.header.profile == "ros2"
    assert log.topic == "/joint_states"
    assert log.joint_names == JOINTS
    assert not log.warnings
    for told, written in (
        (log.stamp_ns, MOTION.stamp_ns),
        *((log.q, MOTION.q), (log.dq, MOTION.dq), (log.tau, MOTION.tau)),
    ):
        assert np.array_equal(told, written)
    assert log.metadata["imported"]["topic"] == "/joint_states"


def test_of_several_topics_the_named_one_is_taken(tmp_path, capsys):
    left, right = Motion.of(seed=2), Motion.of(seed=3)
    topics = {"/left": (JOINT_STATE, left), "/right": (JOINT_STATE, right)}
    bag = write_ros2(tmp_path / "bag", topics)
    assert "2 topics tell joint states: /left, /right; choose" in refused(capsys, bag)
    assert "no message on /up" in refused(capsys, bag, "--topic", "/up")
    log = read_log(imported(bag, "--topic", "/right"))
    assert np.array_equal(log.q, right.q)
    assert log.metadata["imported"]["topic"] == "/right"


def test_units(tmp_path, capsys):
    """Degrees and millinewton metres become SI; likely degrees are refused until they are named."""
    turn = 180 / np.pi
    told = Motion(MOTION.stamp_ns, 5 * MOTION.q * turn, 5 * MOTION.dq * turn, 1e3 * MOTION.tau)
    bag = write_ros1(tmp_path / "a.bag", {"/joint_states": (JOINT_STATE, told)})
    assert "are they degrees? Say --units q=deg" in refused(capsys, bag)
    log = read_log(imported(bag, "--units", "q=deg,tau=mNm"))
    assert np.allclose(log.q, 5 * MOTION.q, rtol=1e-14)
    assert np.allclose(log.dq, 5 * MOTION.dq, rtol=1e-14)
    assert np.allclose(log.tau, MOTION.tau, rtol=1e-14)
    as_it_is = imported(bag, "--units", "q=rad,dq=deg", "--overwrite")
    assert np.array_equal(read_log(as_it_is).q, told.q)
    assert np.allclose(read_log(as_it_is).dq, 5 * MOTION.dq, rtol=1e-14)
    said = "no unit 'grad' for q; have: rad, deg, m, mm; did you mean rad?"
    assert said in refused(capsys, bag, "--units", "q=grad")
    assert main(["info", str(bag), "--units", "q=deg"]) == 0
    assert "positions rad" in capsys.readouterr().out


def test_velocities_in_another_unit_are_doubted(tmp_path, capsys):
    told = Motion(MOTION.stamp_ns, MOTION.q, MOTION.dq * 57.3, MOTION.tau)
    imported(write_ros1(tmp_path / "a.bag", {"/joint_states": (JOINT_STATE, told)}))
    assert "velocities are 57" in capsys.readouterr().err
    unknown = np.full_like(MOTION.dq, np.nan)
    assert velocity_doubts("a", MOTION.stamp_ns, MOTION.q, unknown) == []


def test_numbers_that_no_arm_has_are_refused(tmp_path, capsys):
    for signal, word in (("q", "angle"), ("tau", "torque")):
        told = {name: getattr(MOTION, name).copy() for name in ("stamp_ns", "q", "dq", "tau")}
        told[signal][17, 1] = -1e300
        bag = write_ros1(tmp_path / f"{signal}.bag", {"/s": (JOINT_STATE, Motion(**told))})
        assert re.search(rf"/s: sample 17: -1e\+300 is no {word}", refused(capsys, bag))


def test_joints_by_robot_and_by_name(tmp_path, capsys):
    """The robot's names, in its order; names that differ before their number are the same."""
    fer = tuple(f"fer_joint{i}" for i in (3, 1, 2, 7, 6, 5, 4))
    bag = write_ros2(tmp_path / "bag", {"/joint_states": (JOINT_STATE, NAMED)}, fer)
    log = read_log(imported(bag, "--robot", "panda"))
    assert log.joint_names == tuple(f"panda_joint{i + 1}" for i in range(7))
    assert np.array_equal(log.tau, NAMED.tau[:, [1, 2, 0, 6, 5, 4, 3]])
    some = read_log(imported(bag, "--joints", "fer_joint6,fer_joint1", "--overwrite"))
    assert np.array_equal(some.q, NAMED.q[:, [4, 1]])
    assert "has no joint elbow; have: fer_joint3" in refused(capsys, bag, "--joints", "elbow")


def test_what_goes_with_tables_only_is_refused(tmp_path, capsys):
    bag = write_ros1(tmp_path / "a.bag", STATES)
    for options, said in (
        (("--columns", "q=1:3"), "--columns goes with tables"),
        (("--period", "0.01"), "--period goes with tables"),
        (("--units", "time=ms"), "--units time goes with tables"),
        (("--flat",), "--flat goes with tables"),
        (("--episode", "0"), "--episode goes with tables"),
    ):
        assert said in refused(capsys, bag, *options)
    out = str(tmp_path / "none.mcap")
    assert main(["import", f"q={bag}", "--to", out]) == ExitCode.WRONG_USE
    assert "is a recording with all signals; write it without SIGNAL=" in capsys.readouterr().err
    assert main(["import", str(bag), str(bag), "--to", out]) == ExitCode.WRONG_USE
    assert "are both for all signals" in capsys.readouterr().err
    table = tmp_path / "a.csv"
    table.write_text("t,q,tau\n0,0,1\n0.01,0,1\n")
    assert "a.csv: is no recording" in refused(capsys, table, "--topic", "/joint_states")


def test_what_cannot_be_a_recording_is_refused(tmp_path, capsys):
    cut = write_ros1(tmp_path / "cut.bag", STATES)
    cut.write_bytes(cut.read_bytes()[:3000])
    assert "cut.bag: is a damaged or unfinished bag" in refused(capsys, cut)
    for name in ("empty.bag", "empty.db3", "empty.mcap"):
        (tmp_path / name).write_bytes(b"")
        assert f"{name}: is empty" in refused(capsys, tmp_path / name)
    (tmp_path / "folder").mkdir()
    assert "folder: " in refused(capsys, tmp_path / "folder")
    write_ros1(tmp_path / "folder" / "a.bag", STATES)
    write_ros1(tmp_path / "folder" / "b.bag", STATES)
    assert "name the file in it (has: a.bag, b.bag)" in refused(capsys, tmp_path / "folder")


def test_an_existing_recording_stays(tmp_path, capsys):
    bag, out = write_ros1(tmp_path / "a.bag", STATES), tmp_path / "out.mcap"
    out.write_bytes(b"mine")
    assert main(["import", str(bag), "--to", str(out)]) == ExitCode.WRONG_USE
    assert "exists" in capsys.readouterr().err
    assert out.read_bytes() == b"mine"
    assert len(read_log(imported(bag, "--overwrite"))) == len(MOTION.q)
    assert len(read_log(imported(out, "--overwrite"))) == len(MOTION.q)


def test_commands_and_links_come_along(tmp_path):
    source = record(tmp_path / "own.mcap", samples(200, links=True))
    before, after = read_log(source), read_log(imported(source))
    for name in ("stamp_ns", "q", "dq", "tau", "twists", "accels"):
        assert np.array_equal(getattr(before, name), getattr(after, name), equal_nan=True)
    assert before.twists is not None
    assert after.link_names == before.link_names
    backwards = tuple(reversed(before.joint_names))
    assert after.select(backwards).link_names == before.select(backwards).link_names
    asked = tmp_path / "asked.mcap"
    with McapWriter(asked, ("a", "b")) as writer:
        for i in range(20):
            writer.write_joint_state(10**9 + i * 10**7, *np.full((3, 2), 0.1 * i))
            writer.write_command(10**9 + i * 10**7 + 5, np.array([500.0, 2.0 * i]))
    commands = read_log(imported(asked, "--overwrite", "--units", "tau=mNm")).commands
    assert np.array_equal(commands.stamp_ns, 10**9 + np.arange(20) * 10**7 + 5)
    assert np.allclose(commands.tau, np.column_stack([np.full(20, 0.5), 2e-3 * np.arange(20)]))
