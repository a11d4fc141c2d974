"""Bad input gets one clear sentence that names the file, the place and the choices."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.cli.exit_codes import ExitCode
from adapter.cli.main import build_parser, main
from adapter.cli.run import run_plan
from adapter.effects.robots import robot_urdf
from adapter.model.model_file import load_model, save_model
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.physics.rigid_arm import RigidArm
from drivers.files.mcap import McapWriter, read_log
from drivers.interface import JointSample

LEARNED = (ExitCode.DONE, ExitCode.NOT_CONVERGED)  # 0.4 s of motion teach little
ROBOT = documented("panda")
MIDDLE = np.array([0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8])
LINK = '<link name="{}"><inertial><mass value="{}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" {}'
INERTIA = 'iyz="0" izz="1"/></inertial></link>'
HOLE = np.where(np.arange(7) == 3, np.nan, 0.0)


def motion(count: int = 400) -> list[JointSample]:
    """A little motion."""
    t = 1e-3 * np.arange(count)[:, None]
    w = 3.0 + 0.5 * np.arange(7)
    q = MIDDLE + 0.2 * np.sin(w * t)
    dq, ddq = 0.2 * w * np.cos(w * t), -0.2 * w * w * np.sin(w * t)
    tau = RigidArm.of(ROBOT).torque(q, dq, ddq)
    return [JointSample(1_000_000 * k, q[k], dq[k], tau[k]) for k in range(count)]


def resting(count: int) -> list[JointSample]:
    still = motion(1)[0]
    return [replace(still, stamp_ns=1_000_000 * k) for k in range(count)]


def record(path: Path, samples: list[JointSample]) -> Path:
    with McapWriter(path, ROBOT.tree.joint_names) as writer:
        for sample in samples:
            writer.write(sample)
    return path


def replayed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], path: Path, *codes: ExitCode
) -> str:
    """Replay a recording that can be used; what was said about it."""
    line = ["replay", str(path), "--quiet", "--no-report", "--out", str(tmp_path / "out")]
    assert main(line) in (codes or LEARNED)
    said = capsys.readouterr()
    return " ".join(f"{said.err} {said.out}".split())


def with_gripper(tmp_path: Path, fingers=("finger",), names: str = "panda_joint") -> Path:
    """The Panda, its joints by other names, with turning fingers behind its last link."""
    text = robot_urdf(ROBOT, alone=True).text.replace("panda_joint", names)
    for finger in fingers:
        body = LINK.format(finger, 0.5, INERTIA)
        joint = (
            f'<joint name="{finger}_joint" type="revolute"><parent link="panda_link8"/>'
            f'<child link="{finger}"/><origin xyz="0 0 0.1"/><axis xyz="1 0 0"/></joint>'
        )
        text = text.replace("</robot>", f"{body}{joint}</robot>")
    path = tmp_path / f"{fingers[0]}.urdf"
    path.write_text(text)
    return path


def test_a_gripper_that_the_log_lacks_is_locked(tmp_path, capsys, refused) -> None:
    log, robot, out = tmp_path / "log.mcap", with_gripper(tmp_path), tmp_path / "out"
    record(log, motion())
    replay = ["replay", str(log), "--robot", str(robot), "--quiet", "--no-report"]
    lengths = []
    for more in ([], ["--lock", "finger_joint=1.5"]):
        assert main([*replay, *more, "--out", str(out)]) in LEARNED
        said = " ".join(capsys.readouterr().err.split())
        assert ("log.mcap: has no joint finger_joint; locked at zero" in said) == (not more)
        model = load_model(out / "model.json")
        assert model.tree.joint_names == ROBOT.tree.joint_names
        lengths.append(next(f.rotation for f in model.frames if f.name == "finger"))
    assert not np.allclose(*lengths)
    chosen = ",".join(ROBOT.tree.joint_names)
    assert main([*replay, "--joints", chosen, "--out", str(out)]) in LEARNED
    assert "has no joint" not in capsys.readouterr().err
    still = record(tmp_path / "still.mcap", motion(20) * 3)
    said = refused("gap", still, "--robot", robot, "--out", out)  # too short, not foreign
    assert "usable samples" in said
    said = refused("replay", log, "--robot", robot, "--lock", "thumb=1")
    assert "'thumb'" in said and "finger_joint" in said
    said = refused("run", "--driver", f"log:{log}", "--joints", "thumb", "--robot", robot)
    assert "'thumb'" in said and "finger_joint" in said


@pytest.mark.parametrize("address", ["fci://localhost", "can://can0?joints=7"])
def test_joints_that_an_arm_without_names_lacks_are_locked(
    tmp_path, capsys, refused, address
) -> None:
    """By the numbers in their names, or where the tree forks; else the choices are said."""

    def plan(robot: Path, *more: str) -> SelfModel:
        line = ["run", "--driver", address, "--robot", str(robot), *more]
        return run_plan(build_parser().parse_args(line)).robot

    two = with_gripper(tmp_path, ("left", "right"), "axis_")
    for robot in (with_gripper(tmp_path), two):
        assert plan(robot).tree.n == 7
        assert "finger_joint; locked at zero" in capsys.readouterr().err.replace(
            "left_joint, right_joint", "finger_joint"
        )
    chain = tmp_path / "chain.urdf"
    chain.write_text(with_gripper(tmp_path).read_text().replace("panda_joint7", "wrist"))
    said = refused("run", "--driver", address, "--robot", chain, "--out", tmp_path)
    assert "has 7 joints and tells no names" in said and "--joints A,B,C" in said
    assert plan(chain, "--lock", "finger_joint=0").tree.n == 7


def test_a_log_that_repeats_one_reading(tmp_path, capsys) -> None:
    path = record(tmp_path / "log.mcap", resting(300))
    said = replayed(tmp_path, capsys, path, ExitCode.NOTHING_LEARNED)
    assert "299 repeated" in said and "learned 0" in said


@pytest.mark.parametrize("count", [3, 3000])
def test_a_load_needs_more_than_one_reading(tmp_path, refused, count: int) -> None:
    said = refused("load", record(tmp_path / "log.mcap", resting(count)))
    assert "log.mcap: only" in said and "record at least 1.5 s" in said


def test_a_folder_cannot_be_written_to(tmp_path, refused) -> None:
    model = save_model(ROBOT, tmp_path / "m.json")
    (tmp_path / "folder.urdf").mkdir()
    said = refused("export", model, "--urdf", tmp_path / "folder.urdf")
    assert "folder.urdf: Is a directory" in said and "Errno" not in said


@pytest.mark.parametrize("name", ["recording.mcap", "recording.part2.mcap", "own.mcap"])
def test_the_recording_of_another_run_is_kept(tmp_path, refused, name: str) -> None:
    """It cannot be made again; the choices are said, and the same command may not lose it."""
    kept = record(tmp_path / name, motion(20)).read_bytes()
    where = ["--record", tmp_path / name] if name == "own.mcap" else []
    said = refused("run", "--duration", 1, "--out", tmp_path, *where)
    assert name in said and all(x in said for x in ("--out", "--record", "--overwrite"))
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_bytes() == kept


def test_no_page_stays_beside_a_model_that_it_does_not_describe(tmp_path, capsys) -> None:
    log, out = record(tmp_path / "log.mcap", motion()), tmp_path / "out"
    assert main(["replay", str(log), "--quiet", "--out", str(out)]) in LEARNED
    assert (out / "report.html").exists()
    replayed(tmp_path, capsys, log)  # without a page, into the same folder
    assert (out / "model.json").exists() and not (out / "report.html").exists()


def test_times_count_from_the_recordings_start(tmp_path, capsys) -> None:
    """Not from the year 1970, from which robots and ROS count."""
    began = 1_700_000_000_000_000_000
    samples = [replace(s, stamp_ns=began + s.stamp_ns) for s in motion(2200)]
    del samples[1000:1300]
    samples[1700].q[3] = np.nan
    path = record(tmp_path / "log.mcap", samples)
    said = replayed(tmp_path, capsys, path)
    assert "at 0.999 s: 0.301 s without a sample" in said
    assert "at 2.000 s: a reading is not a finite number" in said
    main(["info", str(path)])
    said += capsys.readouterr().out
    assert "17000000" not in said and "1.7e+09" not in said


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        (lambda x: [replace(s, q=57.3 * s.q, dq=57.3 * s.dq) for s in x], "degrees"),
        (lambda x: [*x[:100], replace(x[100], q=x[100].q + HOLE), *x[101:]], "1 non finite"),
        (
            lambda x: [*x[:200], replace(x[200], stamp_ns=x[190].stamp_ns), *x[201:]],
            "1 time backwards",
        ),
        (lambda x: x[:200] + x[250:], "0.051 s without a sample"),
    ],
)
def test_a_recording_with_a_fault_says_which(tmp_path, capsys, spoilt, said: str) -> None:
    path = record(tmp_path / "log.mcap", spoilt(motion()))
    assert said in replayed(tmp_path, capsys, path, *LEARNED, ExitCode.NOTHING_LEARNED)


def test_a_cut_file(tmp_path, capsys) -> None:
    path = record(tmp_path / "log.mcap", motion(3000))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    said = replayed(tmp_path, capsys, path)
    assert "warning" in said and "log.mcap" in said
    assert main(["recover", str(path)]) == 0
    assert len(read_log(tmp_path / "log.recovered.mcap")) > 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run", "--driver", "panda"], "pybullet:panda"),
        (["run", "--set", "mass"], "KEY=VALUE"),
        (["run", "--truth", "nowhere.json"], "nowhere.json"),
        (["export", "nowhere.json"], "--mjcf FILE"),
        (["export", "m.json", "--onto", "arm.sdf"], "a .urdf file, an MJCF file"),
        (["export", "m.json", "--onto", "arm.xml", "--urdf", "x"], "is written by --mjcf"),
        (["export", "panda", "--urdf", "x.urdf"], "give a model file (.json)"),
        (["export", "m.json", "--urdf", "x.xml"], "--mjcf FILE.xml"),
        (["export", "m.json", "--mjcf", "x.urdf"], "--urdf FILE.urdf"),
        (["export", "m.json", "--mjcf", "x", "--samples", "0"], "--samples N (1 or more)"),
        (["export", "m.json", "--onto", "x.xml", "--samples", "9"], "--mjcf FOLDER"),
        (["diff", "panda", "nowhere.urdf"], "nowhere.urdf: cannot be read"),
    ],
)
def test_wrong_use(tmp_path, refused, monkeypatch, arguments: list[str], said: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert said in refused(*arguments)


@pytest.mark.parametrize("value", ["panda_joint7", "panda_joint7=nan"])
@pytest.mark.parametrize("words", [["run", "--lock"], ["load", "a.mcap", "--zero"]])
def test_a_joint_without_a_value(refused, words: list[str], value: str) -> None:
    assert f"'{value}' is not JOINT=VALUE" in refused(*words, value)
