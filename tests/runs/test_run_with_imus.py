"""The simulated arm with sensors glued on its links: run, recorded, replayed to the same bits."""

from __future__ import annotations

import json

import numpy as np
import pytest

from adapter.cli import main
from adapter.cli.main import build_parser
from adapter.cli.run import run_plan
from adapter.control.controller import ExcitationController
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.errors import UsageError
from adapter.model.model_file import load_model
from adapter.realtime.session import run_lockstep
from adapter.runs.pipeline import make_front_end, make_learner
from adapter.runs.replay import replay
from adapter.signals.frame_topics import with_link_imus
from adapter.signals.matching import matching
from drivers.files.mcap import McapWriter, read_log
from drivers.files.ros_types import IMU
from sim.scenarios import build
from sim.sensors import Imus
from tests.helpers.imu_data import Parts, record

LINKS = ("panda_link3", "panda_link5", "panda_link7")


def test_run_and_replay_agree(tmp_path) -> None:
    given = ["run", "--scenario", "bent_link", "--seed", "3", "--effects", "none"]
    args = build_parser().parse_args([*given, "--set", f"imus={json.dumps(LINKS)}"])
    plan = run_plan(args)
    settings = plan.config.pipeline
    assert settings.learner.schema.imus == LINKS
    arm, learner = plan.open(args.driver, False), make_learner(plan.robot, settings)
    controller = ExcitationController(MotionLimits.of(plan.robot), ExcitationSettings(seed=3))
    path = tmp_path / "run.mcap"
    with McapWriter(path, arm.joint_names, arm.link_names) as writer:
        run_lockstep(
            arm,
            make_front_end(plan.robot, settings),
            learner,
            controller,
            1.4,
            each=lambda sample, command: writer.write(sample),
        )
    arm.close()
    log = read_log(path, beside="imus")
    assert {k for k, t in log.topics.items() if t.schema == IMU} == {
        f"/link_imus/{x}" for x in LINKS
    }
    log, links = with_link_imus(matching(log, plan.robot), plan.robot)
    assert links == LINKS
    again = replay(log, plan.robot, settings).pipeline.learner
    assert again.learned == learner.learned > 1000
    assert np.array_equal(again.schema.lam, learner.schema.lam)
    documented = plan.robot.lam
    assert np.abs(learner.schema.lam - documented).max() > 5e-3  # bent by up to 5° and 20 mm


def test_imus_are_where_they_are_told_to_be() -> None:
    arm = build("bent_link", 1, imus=["panda_link2"]).plant()
    read = [arm.read().links for _ in range(40)]
    w = np.array([links.twist[:, 3:] for links in read])
    heard = np.isfinite(w).all(axis=2)
    assert heard[:, 1].any() and not heard[:, np.arange(7) != 1].any()
    a = np.array([links.accel[1, :3] for links in read])[heard[:, 1]]
    assert np.linalg.norm(a, axis=1) == pytest.approx(9.81, abs=0.6)
    assert all(np.isnan(links.twist[:, :3]).all() for links in read)
    arm.close()


def test_wrong_sensors_are_refused() -> None:
    with pytest.raises(ValueError, match="no link 'elbow' for a sensor; have: panda_link1"):
        build("nominal", 0, imus=["elbow"])
    with pytest.raises(ValueError, match="imus is 3"):
        build("nominal", 0, imus=3)
    address = "can://x?interface=virtual"
    args = build_parser().parse_args(["run", "--driver", address, "--set", 'imus=["panda_link2"]'])
    with pytest.raises((ValueError, UsageError), match="no sensor on a link is heard"):
        run_plan(args)
    assert not Imus(("a", "b"), (), 0, 1e-3).sensors


def test_a_recording_of_another_tool_is_replayed(tmp_path) -> None:
    glued = record(0, (1, 3), 2.5, Parts(rate_hz=250.0, joints_hz=500.0))
    path = glued.write(tmp_path / "log.mcap", {1: "front", 3: "panda_link4"})
    given = ["replay", str(path), "--robot", "panda", "--every", "20", "--no-report", "--quiet"]
    given += ["--out", str(tmp_path / "out"), "--json", str(tmp_path / "out.json")]
    assert main([*given, "--imu", "/imu2=panda_link2", "--imu", "/imu4"]) in (0, 9)
    figures = json.loads((tmp_path / "out.json").read_text())
    assert figures["lambda"]["source"] == "measured"
    told = " ".join(figures["warnings"])
    assert "/imu2 on panda_link2, /imu4 on panda_link4" in told
    assert load_model(tmp_path / "out" / "model.json").lambda_source == "measured"
