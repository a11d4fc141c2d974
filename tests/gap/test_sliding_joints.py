"""A rail, a SCARA and a gripper whose logs Pinocchio wrote: found, weighed, exported as others."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import adapter
from adapter.cli import main
from adapter.gap import servo_words
from adapter.gap.load import find_load
from adapter.gap.servo import explain, going_on
from adapter.gap.servo_kernels import Ground, over_ground
from adapter.gap.servo_model import ServoModel, read_servos
from adapter.gap.words import console_summary, headline
from adapter.model.self_model import SelfModel
from adapter.model.urdf import model_from_urdf
from adapter.physics.kernels import frames_of
from adapter.signals.matching import present
from drivers.files.mcap import Commands, Log, write_log
from tests.helpers.robot_models import machine_urdf, pin_model, read_quietly

COULOMB_N, VISCOUS_N_S, LOAD_KG = 12.0, 25.0, 0.8
SECONDS, STEP_S, NOISE = 20.0, 4e-3, 0.02


@cache
def recorded(robot: str, loaded: bool = True) -> tuple[SelfModel, Log]:
    """The documented machine, and a log of it with friction in its first slide, and a load."""
    model, oracle = read_quietly(machine_urdf(robot)), pin_model(machine_urdf(robot))
    rng, t, n = np.random.default_rng(1), np.arange(0.0, SECONDS, STEP_S), model.tree.n
    hz = np.array([0.1, 0.2, 0.3, 0.5, 0.7, 1.0]) * rng.uniform(0.8, 1.2, (n, 6))
    swing = np.where(model.tree.slides, 0.1, 0.3)[:, None]
    size, angle = swing * rng.uniform(0.5, 1.0, (n, 6)) / (1.0 + hz), 2.0 * np.pi * hz
    at = angle * t[:, None, None] + rng.uniform(0.0, 6.0, (n, 6))
    q, dq = (size * np.sin(at)).sum(axis=2), (size * angle * np.cos(at)).sum(axis=2)
    ddq = -(size * angle**2 * np.sin(at)).sum(axis=2)
    if loaded:
        body = pin.Inertia(LOAD_KG, np.array([0.0, 0.02, 0.08]), 1e-3 * np.eye(3))
        oracle.appendBodyToJoint(oracle.getJointId(f"j{n}"), body, pin.SE3.Identity())
    data = oracle.createData()
    tau = np.array([pin.rnea(oracle, data, *row) for row in zip(q, dq, ddq, strict=True)])
    k = model.tree.slides.index(True)
    tau[:, k] += COULOMB_N * np.tanh(dq[:, k] / 1e-3) + VISCOUS_N_S * dq[:, k]
    tau += NOISE * rng.normal(size=tau.shape)
    dq = dq + 1e-4 * rng.normal(size=dq.shape)
    return model, adapter.make_log(t, q, dq, tau, joint_names=model.tree.joint_names)


def test_friction_of_a_slide_is_found_in_newtons_and_exported(tmp_path: Path) -> None:
    model, log = recorded("scara")
    result = adapter.find_gap(log, model, model_out=tmp_path / "model.json")
    found = {f.effect: f for f in result.findings}
    assert {*found} == {"coulomb_friction", "viscous_friction", "payload"}
    dry, wet = found["coulomb_friction"], found["viscous_friction"]
    assert dry.joints == wet.joints == (3,)
    assert dry.parameters["Fc"] == pytest.approx(COULOMB_N, rel=0.03)
    assert wet.parameters["Fv"] == pytest.approx(VISCOUS_N_S, rel=0.05)
    assert (dry.units["Fc"], wet.units["Fv"]) == ("N", "N s/m")
    load = found["payload"]
    assert load.parameters["m"] == pytest.approx(LOAD_KG, abs=2.0 * load.std["m"])
    assert load.std["m"] < 0.2  # links are known to a share of their masses
    assert re.match(r"joint 3 lacks 1[12].* N of Coulomb friction; .* N s/m", headline(result))
    assert any("N, mm of joint 3" in line for line in console_summary(result))
    assert result.after.torque_rmse_nm[2] < 0.2 * result.before.torque_rmse_nm[2]
    learned = adapter.load_model(tmp_path / "model.json")
    assert learned.tree.slides == (False, False, True, False)
    samples, rows = learned.sample(300), slice(None, None, 200)
    at = [x["effect"] for x in learned.effects].index(dry.effect)
    drawn = [x.effects[at]["parameters"]["Fc"] for x in samples]
    assert np.std(drawn) == pytest.approx(dry.std["Fc"], rel=0.2)
    q, dq = log.q[rows], log.dq[rows]
    torques = [adapter.inverse_dynamics(x, q, dq, 0.0 * q) for x in samples[:40]]
    # what trades against one another in the data does so in the draws
    assert (np.std(torques, axis=0).mean(axis=0) < [0.01, 0.01, 1.0, 0.01]).all()
    urdf = ET.parse(adapter.export(learned, tmp_path / "arm.urdf")).getroot()
    joint = next(x for x in urdf.iter("joint") if x.get("name") == "j3")
    losses = joint.find("dynamics")
    assert joint.get("type") == "prismatic" and losses is not None
    assert float(losses.get("friction", 0)) == pytest.approx(COULOMB_N, rel=0.03)
    assert float(losses.get("damping", 0)) == pytest.approx(VISCOUS_N_S, rel=0.05)
    mujoco = pytest.importorskip("mujoco")
    compiled = mujoco.MjModel.from_xml_path(str(adapter.export(learned, tmp_path / "arm.xml")))
    slide = compiled.joint("j3")
    assert compiled.jnt_type[slide.id] == mujoco.mjtJoint.mjJNT_SLIDE
    assert float(compiled.dof_frictionloss[slide.dofadr[0]]) == pytest.approx(COULOMB_N, rel=0.03)


def test_the_hand_behind_a_rail_is_weighed() -> None:
    model, log = recorded("rail")
    load = find_load(log, model)
    assert load.mass == pytest.approx(LOAD_KG, abs=2.0 * load.mass_std)
    bare, same = (adapter.learn(recorded("rail", x)[1], model, every=10) for x in (False, True))
    gained = same.model.theta[-1, 0] - bare.model.theta[-1, 0]
    assert gained == pytest.approx(LOAD_KG, abs=0.15)
    np.testing.assert_allclose(same.model.lam[:, 3:], model.lam[:, 3:], atol=1e-9)
    np.testing.assert_allclose(same.model.joint_rotation(), model.joint_rotation(), atol=1e-9)
    entry = next(e for e in same.model.effects if e["effect"] == "coulomb_friction")
    assert entry["joints"] == [1] and entry["units"]["Fc"] == "N"
    assert entry["parameters"]["Fc"] == pytest.approx(COULOMB_N, rel=0.1)


def test_what_info_and_replay_say_of_a_rail(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, file, robot = recorded("rail")[1], tmp_path / "rail.mcap", tmp_path / "rail.urdf"
    robot.write_text(machine_urdf("rail"))
    nothing, arm = np.full_like(log.q, np.nan), ["--robot", str(robot)]
    orders = Commands(log.stamp_ns, nothing, log.q + 0.01)
    write_log(replace(log, dq=nothing, tau=nothing, commands=orders), file, {})
    assert main(["info", str(file), *arm]) == 0
    said = capsys.readouterr().out
    assert "mrad (mm of j1)" in said and "positions rad (m of j1), no efforts" in said
    write_log(log.piece(0, 2000), file, {})
    assert main(["info", str(file), *arm]) == 0
    said = capsys.readouterr().out
    assert "(N of j1)" in said and "explain, N m (N of joint 1): " in said
    main(["replay", str(file), *arm, "--validate-from", "6", "--out", str(tmp_path / "out")])
    said = capsys.readouterr().out.replace("\u202f", " ")
    assert re.search(r"joint 1 [\d.]+ N → [\d.]+ N\.", said)
    assert re.search(r"N m\s+\(N of joint 1\)", said)
    page = (tmp_path / "out" / "report.html").read_text().replace("\u202f", " ")
    assert "N m (N of joint 1) rms" in page


def test_fingers_in_a_recording_are_spoken_of_and_free_where_asked_for() -> None:
    _, log = recorded("gripper", False)
    closed = model_from_urdf(machine_urdf("gripper"))
    arm, said = present(closed, log.joint_names, "log")
    assert arm.tree.n == 4 and "j5, j6" in said[0] and "--joints" in said[0]
    free = read_quietly(machine_urdf("gripper"))
    found = adapter.inverse_dynamics(free, log.q, log.dq, np.gradient(log.dq, STEP_S, axis=0))
    left = (log.tau - found)[5:-5, 4]
    friction = COULOMB_N * np.sign(log.dq[5:-5, 4]) + VISCOUS_N_S * log.dq[5:-5, 4]
    assert np.corrcoef(left, friction)[0, 1] > 0.98


def test_a_servo_that_slides_is_told_in_newtons_and_metres(tmp_path: Path) -> None:
    model, driven = recorded("scara", False)
    names, t = model.tree.joint_names, 1e-9 * (driven.stamp_ns - driven.stamp_ns[0])
    kp, kd = np.array([300.0, 200.0, 4e3, 20.0]), np.array([12.0, 8.0, 160.0, 0.8])
    others = 2e-3 * kp, 0.0 * kp, 2e-3 * kp, kp < 0.0, 4e-3
    ServoModel(names, kp, kd, *others).save(file := tmp_path / "servo.toml")
    q = read_servos(file, names).motion(model, t, driven.q)
    read = q + 2e-5 * np.random.default_rng(4).normal(size=q.shape)
    orders = Commands(driven.stamp_ns, np.full_like(q, np.nan), driven.q)
    found = explain([replace(driven, q=read, commands=orders)], model)
    gains = {f.unit: f for f in found.findings if f.effect == "servo_position_gain"}
    assert gains["N/m"].joints == (3,) and gains["N m/rad"].joints == (1, 2, 4)
    assert gains["N/m"].values[0] == pytest.approx(kp[2], rel=0.05)
    said = " ".join(servo_words.lines(found))
    own = r"position gain of joint 3: [\d.]+ N/m.*worst joint [\d.]+ mrad and [\d.]+ mm -> "
    assert re.search(own + r".*tracking error before, mrad \(mm of joint 3\)", said)


@pytest.mark.parametrize("robot", ["rail", "scara", "gantry"])
def test_a_hand_goes_over_the_ground_as_differences_say(robot: str) -> None:
    model, rng = read_quietly(machine_urdf(robot)), np.random.default_rng(3)
    frames, n = frames_of(model.tree, model.lam), model.tree.n
    up = np.array([0.1, 0.2, 0.97]) / np.linalg.norm([0.1, 0.2, 0.97])
    ground, q = Ground(n - 1, rng.normal(size=3), up, 0.3, 2.0), rng.normal(size=n)
    way, unused, ends = np.empty((3, n)), np.empty((3, n)), np.empty((2, 3))
    over_ground(frames, ground, q, way, ends[0])
    for j, step in enumerate(1e-6 * np.eye(n)):
        for end, sign in zip(ends, (1.0, -1.0), strict=True):
            over_ground(frames, ground, q + sign * step, unused, end)
        assert way[:, j] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-7)


def test_positions_and_commands_told_within_one_turn_go_on_in_the_servos_door() -> None:
    model = read_quietly(machine_urdf("scara"))
    t = np.arange(0.0, 5.0, 0.01)
    q = np.column_stack([3.0 + 0.6 * np.sin(t + k) for k in range(4)])
    orders = Commands(np.arange(500) * 10_000_000, np.full_like(q, np.nan), q + 0.01)
    log = Log(Path("wrapped"), model.tree.joint_names, orders.stamp_ns, q, q, q, commands=orders)
    turns = np.where(model.tree.slides, q, (q + np.pi) % (2.0 * np.pi) - np.pi)
    assert np.abs(np.diff(turns, axis=0)).max() > 6.0
    found = going_on(replace(log, q=turns, commands=replace(orders, q=turns + 0.01)), model)
    assert found.commands is not None
    np.testing.assert_allclose(np.diff(found.q, axis=0), np.diff(q, axis=0), atol=1e-9)
    np.testing.assert_allclose(found.commands.q - found.q, 0.01, atol=1e-9)
