"""The simulated arm against Pinocchio: rigid dynamics, timing, link motion, payload, brakes.

Its own recursion also on trees of random shape.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from drivers.interface import DriverError
from sim import dynamics
from sim.dynamics import Frames
from sim.effects import payload
from sim.fci.arm import wrench_at
from sim.noise import levels_of
from sim.plant import Plant, SimulatedArm
from sim.scenarios import build
from sim.truth import panda, turn
from tests.helpers.arm_data import pin_model, pin_tree, rms, rnea
from tests.helpers.random_trees import random_tree
from tests.helpers.robot_models import frame_motion


def motion_of(model, q, dq, ddq, joints):
    """(n, 6) each: [v; w] and [a - g; dw] of the links behind joints, in their own axes."""
    data, g = model.createData(), model.gravity.linear
    pin.forwardKinematics(model, data, q, dq, ddq)
    rows = np.array([frame_motion(model, data, j, np.eye(3), g).ravel() for j in joints])
    return rows[:, :6], rows[:, 6:]


@pytest.mark.parametrize("links", [5, 12, 40])
def test_a_tree_that_tumbles_moves_and_pulls_as_pinocchio_says(links):
    truth, rng = random_tree(links, links), np.random.default_rng(links)
    model = pin_tree(truth.parent, truth.R, truth.p, truth.theta, truth.gravity, free=True)
    at = range(1, truth.n + 2)
    frames = Frames(np.array(truth.parent), truth.R, truth.p)
    q, dq, ddq = (np.zeros(k) for k in (model.nq, model.nv, model.nv))
    q[:] = pin.randomConfiguration(model, -np.ones(model.nq), np.ones(model.nq))
    dq[:], ddq[:] = rng.normal(size=(2, model.nv))
    place = [model.joints[j].idx_v - 6 for j in at[1:]]
    own = [x[np.array(place) + skip] for x, skip in ((q, 7), (dq, 6), (ddq, 6))]
    twist, accel = motion_of(model, q, dq, ddq, at)
    base = np.array([twist[0, :3], twist[0, 3:], accel[0, :3], accel[0, 3:]])
    found = dynamics.link_motion(frames, base, *own)
    np.testing.assert_allclose(found[:, :2].reshape(-1, 6), twist[1:], atol=1e-9)
    np.testing.assert_allclose(found[:, 2:].reshape(-1, 6), accel[1:], atol=1e-9)
    tau = dynamics.torques(frames, truth.theta[1:], base, *own)
    wanted = pin.rnea(model, model.createData(), q, dq, ddq)[6:][place]
    np.testing.assert_allclose(tau, wanted, atol=1e-9 * max(1.0, np.abs(wanted).max()))
    # By columns: Pinocchio's own mass matrix wants the joints of a tree depth first.
    still, data = np.zeros(model.nv), model.createData()
    pulls = [pin.rnea(model, data, q, still, unit).copy() for unit in np.eye(model.nv)[6:]]
    weight = pin.rnea(model, data, q, still, still)
    M = (np.array(pulls) - weight)[:, 6:][np.ix_(place, place)]
    found = dynamics.mass_matrix(frames, truth.theta[1:], own[0])
    np.testing.assert_allclose(found, M, atol=1e-9 * np.abs(M).max())


@pytest.mark.parametrize("scenario", ["bent_link", "wall_mounted"])
def test_a_resting_base_carries_gravity_and_the_end_is_where_pinocchio_puts_it(scenario):
    truth, rng = build(scenario, 3).truth, np.random.default_rng(5)
    model = pin_model(truth)
    data = model.createData()
    for _ in range(5):
        q, dq, ddq = truth.ready + rng.normal(size=7), *rng.normal(size=(2, 7))
        tau = dynamics.torques(truth.frames, truth.theta, truth.base, q, dq, ddq)
        np.testing.assert_allclose(tau, pin.rnea(model, data, q, dq, ddq), atol=1e-9)
        tool = pin.SE3.Random()
        pose, J = dynamics.end_effector(truth.frames, q, tool.homogeneous)
        frame = model.addFrame(pin.Frame(f"end{model.nframes}", 7, tool, pin.FrameType.OP_FRAME))
        data = model.createData()
        wanted = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(J, wanted, atol=1e-9)
        np.testing.assert_allclose(
            pose, pin.updateFramePlacement(model, data, frame).homogeneous, atol=1e-9
        )


def test_a_wrench_is_found_from_its_torques_unless_the_posture_is_singular():
    truth, rng = build("nominal").truth, np.random.default_rng(3)
    wrench, tool = rng.normal(size=6), np.eye(4)
    tool[:3, 3] = 0.02, -0.03, 0.1
    pose, J = dynamics.end_effector(truth.frames, truth.ready, np.eye(4))
    lever = pose[:3, :3] @ tool[:3, 3]
    at_origin = np.concatenate([wrench[:3], wrench[3:] + np.cross(lever, wrench[:3])])
    found = wrench_at(pose, J, tool, J.T @ at_origin, 0.01)
    np.testing.assert_allclose(found, wrench, atol=1e-9)
    assert not wrench_at(pose, J, tool, J.T @ at_origin, 1.0).any()


T_S = 1e-3


def reference(t, q0, speed=1.0):
    """A smooth motion from rest: q, dq, ddq (n,) at time t."""
    w = 2 * np.pi * np.array([0.5, 0.4, 0.6, 0.45, 0.8, 0.7, 0.9]) * speed
    a = np.array([0.3, 0.25, 0.3, 0.3, 0.3, 0.3, 0.3])
    return q0 + a * (1 - np.cos(w * t)), a * w * np.sin(w * t), a * w * w * np.cos(w * t)


def drive(plant, seconds=2.0, payload=None):
    """Computed-torque motion; clean samples as arrays t, q, dq, tau and the list of samples."""
    model = pin_model(plant.truth)
    data, samples = model.createData(), []
    for k in range(round(seconds / T_S)):
        plant.read()
        if payload is not None and k * T_S == payload.start_s:
            model = pin_model(plant.truth, payload)
            data = model.createData()
        sample = plant.clean()
        samples.append(sample)
        want, speed, push = reference((k + 1) * T_S, plant.truth.ready)
        push = push + 100.0 * (want - sample.q) + 20.0 * (speed - sample.dq)
        plant.command(pin.rnea(model, data, sample.q, sample.dq, push))
    return [np.array([getattr(s, key) for s in samples]) for key in ("q", "dq", "tau")], samples


def rigid_torque(truth, q, dq, payload=None):
    """RNEA on samples 1 to m - 2 with central differences of dq, and those ddq."""
    ddq = (dq[2:] - dq[:-2]) / (2 * T_S)
    return rnea(pin_model(truth, payload), q[1:-1], dq[1:-1], ddq), ddq


def plant_of(truth, **options):
    return Plant(truth, noise=levels_of("none"), **options)


def test_signals_of_a_sample_are_of_one_instant():
    """The torque is the rigid body's, without a lag, and velocity the rate of the position."""
    plant = plant_of(panda())
    (q, dq, tau), _ = drive(plant)
    assert plant.fault is None and not plant.saturated
    moving = slice(50, None)  # without the start, where the torque has a corner
    left = tau[1:-1] - rigid_torque(panda(), q, dq)[0]
    assert np.all(rms(left[moving]) < 1e-4 * rms(tau - tau.mean(0)))
    slope = np.gradient(tau, T_S, axis=0)[1:-1][moving]
    assert np.all(np.abs(np.sum(slope * left[moving], axis=0)) < 5e-6 * np.sum(slope**2, axis=0))
    # Fourth-order difference: the truncation of the plain one is of the size looked for.
    rate = (8 * (q[3:-1] - q[1:-3]) - (q[4:] - q[:-4])) / (12 * T_S)
    left, ddq = (rate - dq[2:-2])[moving], np.gradient(dq, T_S, axis=0)[2:-2][moving]
    assert np.all(np.abs(np.sum(left * ddq, axis=0)) < 1e-6 * np.sum(ddq**2, axis=0))


def test_own_acceleration_is_that_of_the_oracle():
    plant = plant_of(panda())
    (q, dq, tau), _ = drive(plant, 0.3)
    model = pin_model(panda())
    wanted = pin.aba(model, model.createData(), q[-1], dq[-1], tau[-1])
    assert plant.ddq() == pytest.approx(wanted, rel=1e-9)


def test_link_motion_is_that_of_the_samples_own_instant():
    plant = build("bent_link", 1, noise="none").plant()
    model, ((q, dq, _), samples) = pin_model(plant.truth), drive(plant, 0.5)
    ddq = (dq[2:] - dq[:-2]) / (2 * T_S)
    for k in range(60, 480, 40):
        twist, accel = motion_of(model, q[k], dq[k], ddq[k - 1], range(1, 8))
        assert samples[k].links.twist == pytest.approx(twist, abs=1e-9)
        assert samples[k].links.accel == pytest.approx(accel, abs=1e-3 * 9.81)


def test_payload_comes_at_its_time_without_a_jump_in_speed():
    R = turn(0, 0.4) @ turn(2, 0.7)
    load = payload(1.0, [0.02, -0.03, 0.15], R @ np.diag([2e-3, 3e-3, 4e-3]) @ R.T, 0.5)
    plant = plant_of(panda().with_changes(effects=(load,)))
    (q, dq, tau), _ = drive(plant, 1.0, payload=load)
    empty, ddq = rigid_torque(panda(), q, dq)
    full, _ = rigid_torque(panda(), q, dq, load)
    scale = rms(tau - tau.mean(0))
    # Row k belongs to sample k + 1. Left out: the change at 0.5 s and the corner that the
    # controller's answer puts into the torque a sample later.
    before, after = slice(50, 498), slice(502, None)
    assert np.all(rms((empty - tau[1:-1])[before]) < 1e-4 * scale)
    assert np.all(rms((full - tau[1:-1])[after]) < 1e-3 * scale)
    assert rms((empty - tau[1:-1])[after]).max() > 0.5
    assert np.all(np.abs(np.diff(dq, axis=0))[495:505] < 2e-3 * np.abs(ddq).max() + 1e-3)


def test_brakes_carry_a_payload_too():
    load = payload(1.0, [0.0, 0.0, 0.15], t_s=0.2)
    plant = plant_of(panda().with_changes(effects=(load,)))
    for _ in range(800):
        sample = plant.read()
    assert sample.q == pytest.approx(panda().ready, abs=1e-6)
    still = np.zeros((1, 7))
    hold = rnea(pin_model(panda(), load), sample.q[None], still, still)[0]
    assert sample.tau == pytest.approx(hold, abs=1e-4)


def test_stiff_friction_brings_a_joint_to_rest_without_ringing():
    truth = build("friction", noise="none").truth.with_changes(gravity=np.zeros(3))
    plant = plant_of(truth)
    plant.read()
    for k in range(400):
        plant.command(np.array([0, 0, 0, 0, 0, 0, 0.6 if k < 20 else 0.0]))
        plant.read()
    tail = []
    for _ in range(50):
        plant.command(np.zeros(7))
        tail.append(plant.read().dq)
    assert np.abs(tail).max() < 1e-3
    assert np.all(np.abs(np.diff(tail, axis=0)) < 1e-4)


def test_arm_holds_until_commanded_and_brakes_when_commands_end():
    plant = plant_of(panda())
    for _ in range(300):
        first = plant.read()
    assert first.stamp_ns == 299_000_000
    assert first.q == pytest.approx(panda().ready, abs=1e-9)
    (q, dq, _), _ = drive(plant, 0.5)
    assert np.abs(dq[-1]).max() > 0.3
    for k in range(600):
        last = plant.read()
        assert plant.braked == (k >= 20)
    assert np.abs(last.dq).max() < 1e-6
    assert np.abs(last.q - q[-1]).max() < 0.3
    plant.command(last.tau)
    assert not plant.braked
    plant.stop()
    assert plant.braked


def test_torque_is_cut_at_the_effort_limit_and_says_so():
    plant = plant_of(panda())
    hold = plant.read().tau
    plant.command(hold + np.array([0, 0, 0, 0, 0, 0, 50.0]))
    assert plant.saturated
    assert plant.read().tau[6] == 12.0
    plant.command(hold)
    assert not plant.saturated


def test_leaving_the_range_of_a_joint_brakes_for_good():
    arm = SimulatedArm(plant_of(panda()))
    arm.connect()
    hold = arm.read().tau
    with pytest.raises(DriverError, match=r"panda_joint\d (left its range|exceeded its speed)"):
        for _ in range(2000):
            arm.command(hold + np.array([0, 0, 0, 20.0, 0, 0, 0]))
            arm.read()
    for _ in range(1000):
        sample = arm.read()
    assert np.abs(sample.dq).max() < 1e-6


def test_driver_says_what_it_is_and_does_not_open_again():
    arm = SimulatedArm(plant_of(panda()))
    arm.connect()
    assert arm.joint_names[0] == "panda_joint1" and arm.link_names[6] == "panda_link7"
    assert [arm.read().stamp_ns for _ in range(3)] == [0, 1_000_000, 2_000_000]
    assert arm.plant_time_ns > 0
    arm.close()
    with pytest.raises(DriverError, match="closed"):
        arm.connect()


def test_plants_do_not_disturb_each_other():
    alone = drive(plant_of(panda()), 0.1)[0]
    first, other = plant_of(panda()), build("wall_mounted", noise="none").plant()
    other.read()
    both = drive(first, 0.1)[0]
    other.close()
    assert all(np.array_equal(a, b) for a, b in zip(alone, both, strict=True))
