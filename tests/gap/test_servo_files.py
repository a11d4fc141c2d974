"""Servos in a robot's file: MuJoCo alone moves as our own simulation, and a user's file is kept."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from adapter import optional
from adapter.cli import main
from adapter.effects.robots import read_robot
from adapter.errors import ModelError
from adapter.gap.servo_files import servo_mjcf
from adapter.gap.servo_kernels import Ground
from adapter.gap.servo_model import ServoModel
from adapter.gap.servo_signals import Track
from adapter.model.mjcf_drives import SPEED
from adapter.model.self_model import Limits
from adapter.physics.rigid_arm import RigidArm
from tests.helpers.position_arm import Drawn, as_log, position_arm
from tests.helpers.position_mujoco import error_in_mujoco
from tests.helpers.robot_models import file_of

PANDA = read_robot("panda")
FREE = replace(PANDA, limits=Limits.unknown(7))  # the simulated motors have no ends
TABLE = 0.55, 2000.0  # m, N/m


@pytest.mark.parametrize(
    ("drawn", "rubs", "static"),
    [
        (Drawn(noise_rad=5e-5), None, 0.0),
        (Drawn(noise_rad=1e-5), None, 0.5),
        (Drawn(feeds_speed=False, period_s=4e-3, noise_rad=5e-5), None, 0.0),
        (Drawn(noise_rad=1e-4, feeds_speed=False), 0.0, 0.0),
        (Drawn(noise_rad=1e-4, feeds_speed=False), 0.3, 0.0),
    ],
)
def test_mujoco_alone_moves_as_our_simulation(
    drawn: Drawn, rubs: float | None, static: float
) -> None:
    """Also on a table of a coefficient of friction; with static friction, a share of Coulomb's."""
    arm = position_arm(14, drawn)
    stiction = static * arm.servos.coulomb
    arm = replace(arm, servos=replace(arm.servos, stiction=stiction))
    servos = arm.documentation
    if rubs is not None:
        arm = replace(arm, servos=replace(arm.servos, table=(0.0, 0.0, 0.12, *TABLE, rubs)))
        point, up = np.array([0.0, 0.0, 0.12]), np.array([0.0, 0.0, 1.0])
        servos = replace(servos, ground=Ground(6, point, up, TABLE[0], TABLE[1] ** 0.5, rubs))
    log = as_log(arm.moved("points", 64))
    track = Track.of(log)
    own = servos.tracking_error(track, RigidArm.of(PANDA))
    there = error_in_mujoco(servo_mjcf(FREE, servos).text, log, track.start)
    # a hand that drags jolts a light wrist by less than the encoders' noise
    assert np.all(there < 1.2 * own + (drawn.noise_rad if rubs else 0.0)), there / own
    if rubs is not None:  # which the arm truly touched
        air = replace(servos, ground=servos.ground._replace(root=0.0))
        assert air.tracking_error(track, RigidArm.of(PANDA)).max() > 5.0 * own.max()


DRESSED = file_of("servo_arm.xml")
SERVO = file_of("servo.toml")


@pytest.fixture
def dressed(tmp_path: Path) -> Path:
    (tmp_path / "arm.xml").write_text(DRESSED)
    (tmp_path / "servo.toml").write_text(SERVO)
    return tmp_path


def test_a_users_file_gets_its_servos_and_keeps_the_rest(dressed: Path, capsys) -> None:
    words = ["export", str(dressed / "arm.xml"), "--servo", str(dressed / "servo.toml")]
    out, figures = dressed / "out.xml", dressed / "said.json"
    assert main([*words, "--mjcf", str(out), "--json", str(figures)]) == 0
    assert "rad/s, to the actuators JOINT_speed" in capsys.readouterr().err
    assert json.loads(figures.read_text())["onto"] == str(dressed / "arm.xml")
    m = mujoco.MjModel.from_xml_path(str(out))
    names = [m.actuator(k).name for k in range(m.nu)]
    assert names == ["lifts", "a", "a" + SPEED]
    lifts, a, speed = (m.actuator(name) for name in names)
    assert np.array_equal(lifts.biasprm[:3], [0.0, -30.0, -0.9]) and lifts.gainprm[0] == 30.0
    assert lifts.ctrlrange.tolist() == [-1.0, 1.0] and lifts.forcerange.tolist() == [-4.0, 4.0]
    assert np.array_equal(a.biasprm[:3], [0.0, -20.0, 0.0]) and speed.gainprm[0] == 0.7
    assert m.actuator_delay.tolist() == [0.005] * 3  # half a step of 2 ms more
    joints = [m.joint(name) for name in "ab"]
    assert [float(x.damping[0]) for x in joints] == [0.2, 0.0]
    assert [float(x.frictionloss[0]) for x in joints] == [0.0, 0.1]
    assert [float(x.armature[0]) for x in joints] == [0.0, 0.02]
    assert m.opt.timestep == 0.002 and m.geom("ground").contype[0] == 1
    assert m.key("home").qpos.tolist() == [0.0, 0.0, 0.0, 0.0, 0.0]
    assert "<!-- a table -->" in out.read_text()


def test_a_limit_that_was_found_goes_before_the_files(dressed: Path, capsys) -> None:
    limited = SERVO.replace("armature = 0.02", "torque_limit = 3.0\ndead_band = 0.002")
    (dressed / "servo.toml").write_text(limited)
    out = dressed / "out.xml"
    words = ["export", str(dressed / "arm.xml"), "--servo", str(dressed / "servo.toml")]
    assert main([*words, "--mjcf", str(out)]) == 0
    assert "the dead band of joint 2 is not in it" in capsys.readouterr().err
    lifts = mujoco.MjModel.from_xml_path(str(out)).actuator("lifts")
    assert lifts.forcerange.tolist() == [-3.0, 3.0]


def test_the_ground_pushes_as_a_spring(dressed: Path) -> None:
    """At rest on it, depth times stiffness carries what the servos do not."""
    servo = SERVO.replace("delay_s = 0.004", "").replace("height = -0.5", "height = 0.9")
    (dressed / "servo.toml").write_text(servo)
    words = ["export", str(dressed / "arm.xml"), "--servo", str(dressed / "servo.toml")]
    assert main([*words, "--mjcf", str(dressed / "out.xml")]) == 0
    m = mujoco.MjModel.from_xml_path(str(dressed / "out.xml"))
    d = mujoco.MjData(m)
    d.qpos[0] = d.ctrl[1] = 1.6
    for _ in range(5000):
        mujoco.mj_step(m, d)
    assert d.ncon == 1 and np.abs(d.qvel).max() < 1e-6
    depth = 0.9 - d.geom_xpos[m.geom("touches_found_ground").id][2]
    push = float(d.efc_force[d.contact[0].efc_address])
    assert push > 1.0 and abs(push / (300.0 * depth) - 1.0) < 1e-3


def test_what_cannot_be_written_is_said(dressed: Path, monkeypatch, capsys) -> None:
    with pytest.raises(ModelError, match="where their commands are"):
        servo_mjcf(FREE, ServoModel.ideal(FREE.tree.joint_names))
    old = SimpleNamespace(MjModel=SimpleNamespace())
    monkeypatch.setattr(optional, "load", lambda name: old)
    late = replace(position_arm(1).documentation, delay_s=0.003)
    written = servo_mjcf(FREE, late)
    assert "delay=" not in written.text
    assert "give commands 3.00 ms late" in " ".join(written.notes)
    assert 'timestep="0.0005" integrator="RK4"' in written.text
    quick = replace(late, viscous=1e4 * late.viscous)  # too quick for Runge and Kutta
    assert 'timestep="0.0001" integrator="implicitfast"' in servo_mjcf(FREE, quick).text
    monkeypatch.undo()
    (dressed / "scene.xml").write_text('<mujoco><include file="arm.xml"/></mujoco>')
    words = ["export", str(dressed / "scene.xml"), "--servo", str(dressed / "servo.toml")]
    assert main([*words, "--mjcf", str(dressed / "x.xml")]) == 2
    assert "does not stand in this file" in capsys.readouterr().err
