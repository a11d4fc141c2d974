"""`adapter info`: ten lines on a log, and what it can teach of a robot."""

import json
from dataclasses import replace

import numpy as np
import pytest

from adapter.cli import main
from adapter.cli.exit_codes import ExitCode
from adapter.control.teachable import teachable
from adapter.model.robots import documented
from drivers.files.mcap import McapWriter, read_log
from tests.helpers.bags import Motion, write_ros1, write_ros2

LOG = "recordings/panda_nominal_6s.mcap"
JOINT_STATE = "sensor_msgs/msg/JointState"


def test_ten_lines_and_what_it_teaches(tmp_path, capsys):
    assert main(["info", LOG, "--json", str(tmp_path / "i.json")]) == 0
    plain = capsys.readouterr().out.splitlines()
    assert 8 <= len(plain) <= 14
    assert any(line.startswith("rate: 1000 Hz, 6001 samples") for line in plain)
    assert any("positions rad, velocities rad/s" in line for line in plain)
    assert main(["info", LOG, "--robot", "panda", "--json", str(tmp_path / "i.json")]) == 0
    said = capsys.readouterr().out
    told = json.loads((tmp_path / "i.json").read_text())["teachable"]
    assert 0 < told["rank"] <= told["full_rank"]
    assert "too short: " in said and "panda_joint1: Fv ±" in said


def test_what_is_missing_is_named_with_its_joint():
    model, log = documented("panda"), read_log(LOG)
    rng = np.random.default_rng(5)
    t = np.arange(0, 20, 0.01)
    speed = np.array([1.1, 0.9, 0.0, 0.8, 1.3, 0.7, 1.2])
    q = log.q[0] + 0.4 * np.sin(np.outer(t, speed))
    tau = 5.0 * np.cos(q) + rng.normal(0, 0.05, q.shape)
    own = replace(log, stamp_ns=(t * 1e9).astype(np.int64), q=q, dq=0 * q, tau=tau)
    told = teachable(own, model)
    assert any(s.startswith("rests") and "panda_joint3" in s for s in told.missing)
    assert not any("too short" in s for s in told.missing)
    names = dict(zip(told.expected.names, told.expected.shown, strict=True))
    assert names["panda_joint1 Fc"] and not names["panda_joint3 Fc"]


def test_longer_and_quieter_logs_teach_more():
    """The prediction follows the amount of data and the noise as information does."""
    model, log = documented("panda"), read_log(LOG)
    half = teachable(log.take(np.arange(len(log)) < len(log) // 2), model).expected
    whole = teachable(log, model).expected
    noise = np.random.default_rng(2).normal(0, 3.0, log.tau.shape)
    loud = teachable(replace(log, tau=log.tau + noise), model).expected
    both = half.shown & whole.shown
    assert np.median(half.std[both] / whole.std[both]) > 1.1
    shown = loud.shown & whole.shown
    assert np.median(loud.std[shown] / whole.std[shown]) > 1.5


def test_topic_and_folder(tmp_path, capsys, refused):
    topics = {"/a/state": (JOINT_STATE, Motion.of()), "/b/state": (JOINT_STATE, Motion.of(seed=2))}
    bag = write_ros2(tmp_path / "bag", topics)
    assert main(["info", str(bag)]) == 0
    assert "2 topics tell joint states: /a/state, /b/state" in capsys.readouterr().out
    assert main(["info", str(bag), "--topic", "/b/state"]) == 0
    assert "joint states: /b/state" in capsys.readouterr().out
    assert main(["info", str(bag), "--topic", "/nope"]) == ExitCode.WRONG_USE
    assert "problem: " in capsys.readouterr().out
    (tmp_path / "empty").mkdir()
    for command in (["replay"], ["gap", "--robot", "panda"]):
        assert "no recording in this folder" in refused(*command, tmp_path / "empty")
    logs = tmp_path / "logs"
    logs.mkdir()
    write_ros1(logs / "one.bag", topics)
    assert "one.bag: 2 topics" in refused("replay", logs, "--robot", "panda")


@pytest.mark.parametrize("period_ns", [50_000_000, 1_000_000])
def test_holes_are_counted_in_usual_steps(tmp_path, capsys, period_ns):
    stamps = np.delete(np.arange(400), np.arange(100, 280)) * period_ns
    with McapWriter(tmp_path / "a.mcap", ("a", "b")) as writer:
        for i, stamp in enumerate(stamps):
            writer.write_joint_state(int(stamp), np.full(2, 0.01 * i), np.ones(2), np.ones(2))
    assert main(["info", str(tmp_path / "a.mcap")]) == 0
    assert "holes: 1 " in capsys.readouterr().out
