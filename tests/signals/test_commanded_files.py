"""Files of position-controlled arms, and tables as spreadsheets and loggers write them."""

import gzip
import json
from dataclasses import replace

import numpy as np
import pytest

from adapter.cli import main
from adapter.cli.exit_codes import ExitCode
from adapter.signals import importer
from drivers.files.mcap import read_log, read_position_log
from tests.helpers.bags import JOINTS, Motion, write_controller_states, write_ros2

TIME = np.arange(500) * 0.02
Q = 0.5 * np.sin(2.0 * TIME[:, None] + [0.0, 1.0])
CMD = np.add(Q, [0.03, -0.05])
TAU = np.cos(3.0 * TIME[:, None] + [0.0, 1.0])


def table(path, *columns, header="", point=".", code="utf-8"):
    rows = [";".join(map(str, row)) for row in np.column_stack(columns).tolist()]
    path.write_bytes("\n".join([header, *rows]).replace(".", point).encode(code))
    return path


def imported(tmp_path, *words):
    """The recording that a command line makes."""
    out = tmp_path / "out.mcap"
    assert main(["import", *map(str, words), "--to", str(out), "--overwrite"]) == 0
    return read_position_log(out) or read_log(out)


def refusal(capsys, *words):
    """The last line of what a command line is refused with."""
    assert main(["import", *map(str, words), "--to", "none.mcap"]) == ExitCode.WRONG_USE
    return capsys.readouterr().err.strip().splitlines()[-1]


def assert_commanded(log, q=Q, commands=CMD, stamps_s=TIME):
    assert np.isnan(log.tau).all() and log.commands is not None
    assert np.allclose(log.q, q) and np.allclose(log.commands.q, commands)
    assert np.allclose(log.commands.stamp_ns, np.round(stamps_s * 1e9), rtol=0, atol=500)


@pytest.mark.parametrize("names", ["q_cmd", "command_", "target", "desired.", "Soll pos "])
def test_commands_have_usual_names(tmp_path, names):
    header = f"t;q_1;q_2;{names}1;{names}2"
    assert_commanded(imported(tmp_path, table(tmp_path / "a.csv", TIME, Q, CMD, header=header)))


def test_torques_beside_commands_are_kept_where_they_are_asked_for(tmp_path, capsys):
    header, signals = "t;q_1;q_2;tau_1;tau_2;", (TIME, np.degrees(Q), TAU, np.degrees(CMD))
    for names, first in (("c1;c2", ("--columns", "cmd=c1,c2")), ("cmd_1;cmd_2", ())):
        path = table(tmp_path / "a.csv", *signals, header=header + names)
        words = [path, "--units", "q=deg"]
        logs = [imported(tmp_path, *words, *first)]
        columns = capsys.readouterr().err.split("--columns ")[1].split(")")[0]
        columns = ",".join([*first[1:], columns])  # as the report says
        logs.append(imported(tmp_path, *words, "--columns", columns))
        with_torques, without = logs if not first else logs[::-1]
        assert_commanded(without)
        assert np.allclose(with_torques.tau, TAU) and np.allclose(with_torques.q, Q)
        assert with_torques.topics["/joint_commands"].messages == len(TIME)
        capsys.readouterr()


def test_commands_keep_their_own_clock(tmp_path, capsys):
    when = 0.003 + TIME[::5]
    states = table(tmp_path / "s.csv", TIME, Q, header="t;q_1;q_2")
    orders = table(tmp_path / "c.csv", when, CMD[::5], header="time;a;b")
    assert_commanded(imported(tmp_path, states, f"cmd={orders}"), Q, CMD[::5], when)
    table(orders, when + 1e9, CMD[::5], header="time;a;b")
    assert "are both on one clock" in refusal(capsys, states, f"cmd={orders}")
    some = [f"{a};{b}" if k % 5 == 0 else ";" for k, (a, b) in enumerate(CMD)]
    blank = table(tmp_path / "blank.csv", TIME, Q, some, header="t;q_1;q_2;cmd_1;cmd_2")
    assert_commanded(imported(tmp_path, blank), Q, CMD[::5], TIME[::5])


def test_a_data_set_there_and_back(tmp_path, capsys):
    pq = pytest.importorskip("pyarrow.parquet")
    states = table(tmp_path / "s.csv", 7.0 + TIME, Q, CMD, header="t;q_1;q_2;cmd_1;cmd_2")
    imported(tmp_path, states, "--joints", "shoulder,elbow")
    for name in ("one", "two"):
        out = ["--lerobot", str(tmp_path / name)]
        assert main(["export", str(tmp_path / "out.mcap"), *out]) == 0
        log = imported(tmp_path, tmp_path / name)
        assert_commanded(log)
        assert log.joint_names == ("shoulder", "elbow")
    first, second = (pq.read_table(tmp_path / x / "data") for x in ("one", "two"))
    assert first.equals(second)
    assert "warning" not in capsys.readouterr().err
    turned = imported(tmp_path, tmp_path / "one", "--joints", "elbow,shoulder")
    assert_commanded(turned, Q[:, ::-1], CMD[:, ::-1])
    info = json.loads((tmp_path / "one" / "meta" / "info.json").read_text())
    assert (info["fps"], info["total_frames"]) == (50, len(TIME))
    assert set(info["features"]) == set(first.column_names)
    told = json.loads((tmp_path / "one" / "meta" / "stats.json").read_text())
    episode = pq.read_table(tmp_path / "one" / "meta" / "episodes").to_pylist()[0]
    for name, numbers in told.items():
        values = np.array(first[name].to_pylist()).reshape(len(TIME), -1)
        for percent in (1, 10, 50, 90, 99):
            found = numbers[f"q{percent:02}"]
            assert np.allclose(found, np.quantile(values, percent / 100, axis=0), atol=1e-6)
        assert numbers == {key: episode[f"stats/{name}/{key}"] for key in numbers}
    assert main(["export", str(tmp_path / "out.mcap"), *out]) == ExitCode.WRONG_USE


def test_what_lerobot_itself_reads_and_appends_to(tmp_path):
    reason = "the package lerobot is not installed"
    loader = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason=reason).LeRobotDataset
    states = table(tmp_path / "s.csv", TIME, Q, CMD, header="t;q_1;q_2;cmd_1;cmd_2")
    imported(tmp_path, states)
    folder = tmp_path / "set"
    assert main(["export", str(tmp_path / "out.mcap"), "--lerobot", str(folder)]) == 0
    read = loader("nobody/set", root=folder)
    rows = [read[i] for i in range(len(read))]
    for name, values in (("observation.state", Q), ("action", CMD), ("timestamp", TIME)):
        assert np.allclose([row[name].numpy() for row in rows], values, atol=1e-6)
    assert (read.fps, rows[-1]["task"]) == (50, "motion")
    for q, goal in np.stack([Q, CMD], axis=1)[:30].astype(np.float32):
        read.add_frame({"observation.state": q, "action": goal, "task": "more"})
    read.save_episode()
    read.finalize()
    again = loader("nobody/set", root=folder)
    assert (again.num_episodes, len(again), again[len(TIME)]["task"]) == (2, len(TIME) + 30, "more")
    assert_commanded(imported(tmp_path, folder, "--episode", "1"), Q[:30], CMD[:30], TIME[:30])


def sage(folder, joints):
    folder.mkdir()
    (folder / "joint_list.txt").write_text(f"{joints}\n")
    heads = {"control.csv": "positions", "state_motor.csv.gz": "positions,velocities,torques"}
    for (name, head), signals in zip(heads.items(), ([CMD], [Q, 0 * Q, TAU]), strict=True):
        rows = [",".join(f'"{x[i].tolist()}"' for x in signals) for i in range(len(TIME))]
        rows = [f"KIND,{1e6 * t},{row}" for t, row in zip(TIME.tolist(), rows, strict=True)]
        content = "\n".join([f"type,timestamp,{head}", *rows]).encode()
        (folder / name).write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    return folder


def test_a_folder_of_sage_and_what_is_said_of_it(tmp_path, capsys):
    folder = sage(tmp_path / "m", "Pitch\nJaw")
    log = imported(tmp_path, folder, "--joints", "a,b")
    assert_commanded(log)
    said = capsys.readouterr().err
    assert log.joint_names == ("a", "b") and "by their order: Pitch = a, Jaw = b" in said
    assert "with torques: --columns tau=torques)" in said
    assert np.allclose(imported(tmp_path, folder, "--columns", "tau=torques").tau, TAU)
    imported(tmp_path, folder)
    for told in (folder, tmp_path / "out.mcap"):
        assert main(["info", str(told), "--robot", "panda"]) == 0
        said = capsys.readouterr().out
        for words in ("500 commanded positions", "rms: 30  50 mrad", "no efforts", "the servos"):
            assert words in said
        assert "problem" not in said and "adapter gap LOG --robot" in said


def test_names_of_joints(tmp_path, capsys):
    arm, folder = ("--joints", "lower_arm,upper_arm"), sage(tmp_path / "m", "Lower\nUpper")
    assert imported(tmp_path, folder, *arm).joint_names == ("lower_arm", "upper_arm")
    turned = sage(tmp_path / "n", "Upper\nLower")
    assert "--names A=B" in refusal(capsys, turned, *arm)
    log = imported(tmp_path, turned, *arm, "--names", "Upper=upper_arm,Lower=lower_arm")
    assert_commanded(log, Q[:, ::-1], CMD[:, ::-1])
    assert "no joint Uper" in refusal(capsys, turned, "--names", "Uper=a")
    assert "calls two" in refusal(capsys, turned, "--names", "Upper=Lower")
    assert "is not SOURCE=NAME" in refusal(capsys, turned, "--names", "Upper")


def test_one_of_two_arms(tmp_path, capsys):
    joints, arm = ("l_arm2", "l_arm1", "r_arm2", "r_arm1"), ("--joints", "arm1,arm2")
    motion = Motion.of(4, samples=40)
    topics = {"/joint_states": ("sensor_msgs/msg/JointState", motion)}
    bag = write_ros2(tmp_path / "bag", topics, joints)
    assert "has 2 such arms, l_ and r_; take one:" in refusal(capsys, bag, *arm)
    log = imported(tmp_path, bag, *arm, "--names", "r_*=*")
    assert np.array_equal(log.q, motion.q[:, [3, 2]])
    one = write_ros2(tmp_path / "one", topics, (*joints[:2], "l_finger", "l_hand"))
    assert np.array_equal(imported(tmp_path, one, *arm).q, motion.q[:, [1, 0]])
    assert "taken without the l_ before them" in capsys.readouterr().err


@pytest.mark.parametrize("code", ["utf-16", "utf-8", "latin-1"])
@pytest.mark.parametrize("point", [",", "."])
def test_headers_that_say_their_units(tmp_path, code, point):
    state, nothing = np.where(TIME > 1.0, "fährt", "steht"), np.full(len(TIME), "")
    time, *signals = 1e3 * TIME, np.degrees(Q), 1e3 * TAU
    german = "Zeit [ms];A1 pos [°];A2 pos [°];A1 torque [mNm];A2 torque [mNm];Zustand"
    english = "angle 2;angle 1;x speed;Drehmoment 2;Drehmoment 1;time\ndeg;deg;;mNm;mNm;ms"
    for header, columns in (
        (german, (time, *signals, state)),
        (english, (signals[0][:, ::-1], nothing, signals[1][:, ::-1], time)),
    ):
        path = table(tmp_path / "a.csv", *columns, header=header, point=point, code=code)
        log = imported(tmp_path, path)
        assert np.allclose(log.q, Q) and np.allclose(log.tau, TAU)
        assert np.array_equal(log.stamp_ns, np.round(TIME * 1e9))
        assert np.allclose(importer.read_log(path).q, Q)


def test_a_rail_beside_joints_that_turn(tmp_path, capsys):
    header = "t;E1 pos [mm];A1 pos [deg];E1 vel [mm/s];A1 vel [deg/s];E1 torque [N];A1 torque [Nm]"
    rail, turn = Q.T
    columns = (TIME, 1e3 * rail, np.degrees(turn), 1e3 * TAU[:, 0], np.degrees(TAU[:, 1]))
    log = imported(tmp_path, table(tmp_path / "a.csv", *columns, TAU, header=header))
    for told, said in ((log.q, Q), (log.dq, TAU), (log.tau, TAU)):
        assert np.allclose(told, said)
    bare = header.replace(" [mm/s]", "").replace(" [deg/s]", "")
    table(tmp_path / "a.csv", *columns[:3], *columns[1:3], TAU, header=bare)
    assert np.allclose(imported(tmp_path, tmp_path / "a.csv").dq, Q)


def test_texts_and_blanks_that_nobody_asked_for(tmp_path, capsys):
    words, where = np.full(len(TIME), "ok"), ("--columns", "q=1:3,tau=3:5")
    path = table(tmp_path / "a.csv", words, Q, TAU, np.full(len(TIME), ""))
    log = imported(tmp_path, path, *where, "--rate", "50")
    assert np.array_equal(log.stamp_ns, np.round(TIME * 1e9))
    assert "'ok' is not a number" in refusal(capsys, path, "--columns", "time=0,q=1:3")
    with pytest.raises(SystemExit):
        refusal(capsys, path, "--rate", "0")
    assert "no rate in Hz" in capsys.readouterr().err


def silent(ahead):
    """A motion without efforts, and what is commanded so far ahead of it."""
    motion = Motion.of(samples=200)
    return replace(motion, tau=np.full_like(motion.tau, np.nan), goal=motion.q + ahead)


NEW = ("reference", "feedback", "error", "output")
OLD = ("desired", "actual", "error")


@pytest.mark.parametrize("points", [NEW, OLD, (*NEW, "desired", "actual")])
@pytest.mark.parametrize("name", ["sqlite", "a.mcap", "a.bag"])
def test_the_state_of_a_controller_is_commands_and_positions(tmp_path, capsys, points, name):
    motion = silent(np.array([0.03, -0.05, 0.01]))
    bag = write_controller_states(tmp_path / name, points, motion)
    log = read_position_log(bag)
    assert log.joint_names == JOINTS and np.array_equal(log.stamp_ns, motion.stamp_ns)
    for read in (log, imported(tmp_path, bag)):
        assert_commanded(read, motion.q, motion.goal, 1e-9 * motion.stamp_ns)
    said, some = capsys.readouterr().err, [2, 0]
    other = imported(tmp_path, bag, "--units", "q=deg", "--joints", "arm_joint3,arm_joint1")
    seconds, (q, goal) = 1e-9 * motion.stamp_ns, np.radians([motion.q, motion.goal])
    assert_commanded(other, q[:, some], goal[:, some], seconds)
    assert "positions and commands are feedback and reference of /arm/state" in said
    assert main(["info", str(bag)]) == 0
    said = capsys.readouterr().out
    assert "200 commanded positions" in said and "rms: 30  50  10 mrad" in said


def test_which_topics_tell_commands(tmp_path, capsys):
    motion = silent(0.1)
    orders, seconds = replace(motion, q=motion.goal), 1e-9 * motion.stamp_ns
    dynamic, jog = "control_msgs/msg/DynamicJointState", "control_msgs/msg/JointJog"
    states = "sensor_msgs/msg/JointState", replace(motion, tau=np.zeros_like(motion.q))
    usual = {"/joint_states": states, "/joint_commands": (states[0], orders)}
    assert main(["info", str(write_ros2(tmp_path / "zero", usual))]) == 0
    assert "rms: 100  100  100 mrad" in capsys.readouterr().out
    topics = {"/dynamic_joint_states": (dynamic, motion), "/servo/delta": (jog, motion)}
    told = write_ros2(tmp_path / "a", {**topics, "/joint_commands": (dynamic, orders)})
    assert_commanded(imported(tmp_path, told), motion.q, motion.goal, seconds)
    said = capsys.readouterr().err
    assert "those of /dynamic_joint_states" in said and "/servo/delta jogs: steps and" in said
    alone = write_ros2(tmp_path / "b", topics)
    assert "/dynamic_joint_states has efforts that are not a number" in refusal(capsys, alone)
    assert main(["info", str(alone)]) == 0 and "/servo/delta jogs" in capsys.readouterr().out
    two = write_controller_states(tmp_path / "c", NEW, motion, ("/left", "/right"))
    assert "2 topics tell positions and commands: /left, /right; choose" in refusal(capsys, two)
    assert main(["info", str(two)]) == 0 and "/left, /right; choose" in capsys.readouterr().out
    assert_commanded(read_position_log(two, "/right"), motion.q, motion.goal, seconds)
    strong = write_controller_states(tmp_path / "d", OLD, replace(motion, tau=motion.q))
    assert read_position_log(strong) is None and np.array_equal(read_log(strong).tau, motion.q)
