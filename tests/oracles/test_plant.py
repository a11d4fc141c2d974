"""The simulated arm against Pinocchio: rigid dynamics, timing, link motion, payload, losses."""

import numpy as np
import pinocchio as pin
import pytest

from drivers.interface import DriverError
from drivers.pybullet_arm import PyBulletArm
from sim.engine import COULOMB_WIDTH
from sim.noise import levels_of
from sim.plant import Plant
from sim.scenarios import build
from sim.truth import Payload, panda, turn

T_S = 1e-3
MOTION_S = 2.0


def oracle(truth, payload=None):
    """A Pinocchio model built joint by joint from the truth's numbers alone."""
    model = pin.Model()
    model.gravity.linear = truth.gravity
    parent = 0
    for j, name in enumerate(truth.joint_names):
        place = pin.SE3(truth.R[j], truth.p[j])
        parent = model.addJoint(parent, pin.JointModelRZ(), place, name)
        body = pin.Inertia.FromDynamicParameters(_pin(truth.theta[j]))
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
    if payload is not None:
        body = pin.Inertia(payload.m, payload.com, payload.inertia)
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
    return model, model.createData()


def _pin(theta):
    """Our order of θ in Pinocchio's: XX XY YY XZ YZ ZZ."""
    return theta[[0, 1, 2, 3, 4, 5, 7, 6, 8, 9]]


def reference(t, q0, speed=1.0):
    """A smooth motion from rest: q, dq, ddq (n,) at time t."""
    w = 2 * np.pi * np.array([0.5, 0.4, 0.6, 0.45, 0.8, 0.7, 0.9]) * speed
    a = np.array([0.3, 0.25, 0.3, 0.3, 0.3, 0.3, 0.3])
    return q0 + a * (1 - np.cos(w * t)), a * w * np.sin(w * t), a * w * w * np.cos(w * t)


def drive(plant, seconds=MOTION_S, losses=None, payload=None):
    """Computed-torque motion; clean samples as arrays t, q, dq, tau and the list of samples."""
    model, data = oracle(plant.truth)
    samples = []
    for k in range(round(seconds / T_S)):
        plant.read()
        if payload is not None and k * T_S >= payload.t_s:
            model, data = oracle(plant.truth, payload)
        sample = plant.clean()
        samples.append(sample)
        want, speed, push = reference((k + 1) * T_S, plant.truth.ready)
        push = push + 100.0 * (want - sample.q) + 20.0 * (speed - sample.dq)
        tau = pin.rnea(model, data, sample.q, sample.dq, push)
        plant.command(tau if losses is None else tau + losses(sample.dq, push))
    return [np.array([getattr(s, key) for s in samples]) for key in ("q", "dq", "tau")], samples


def rigid_torque(truth, q, dq, payload=None):
    """RNEA on samples 1 to m - 2 with central differences of dq, and those ddq."""
    model, data = oracle(truth, payload)
    ddq = (dq[2:] - dq[:-2]) / (2 * T_S)
    rows = [pin.rnea(model, data, *row) for row in zip(q[1:-1], dq[1:-1], ddq, strict=True)]
    return np.array(rows), ddq


def rms(x):
    return np.sqrt(np.mean(np.square(x), axis=0))


def plant_of(truth, **options):
    return Plant(truth, noise=levels_of("none"), **options)


@pytest.fixture(scope="module")
def moved():
    plant = plant_of(panda())
    signals, _ = drive(plant)
    assert plant.fault is None and not plant.saturated
    return signals


def moving(x):
    """Without the start, where the torque has a corner."""
    return x[50:]


def test_rigid_dynamics_hold_between_the_signals_of_a_sample(moved):
    q, dq, tau = moved
    model, _ = rigid_torque(panda(), q, dq)
    left = moving(model - tau[1:-1])
    assert np.all(rms(left) < 1e-4 * rms(tau - tau.mean(0)))


def test_torque_and_acceleration_have_no_lag_between_them(moved):
    q, dq, tau = moved
    model, _ = rigid_torque(panda(), q, dq)
    slope = np.gradient(tau, T_S, axis=0)[1:-1]
    model, slope, tau = moving(model), moving(slope), moving(tau[1:-1])
    lag_s = np.sum(slope * (tau - model), axis=0) / np.sum(slope**2, axis=0)
    assert np.all(np.abs(lag_s) < 5e-6)


def test_velocity_is_the_derivative_of_position_at_the_same_instant(moved):
    q, dq, _ = moved
    # Fourth-order difference: the truncation of the plain one is of the size looked for.
    slope = (8 * (q[3:-1] - q[1:-3]) - (q[4:] - q[:-4])) / (12 * T_S)
    ddq = np.gradient(dq, T_S, axis=0)[2:-2]
    left, ddq = moving(slope - dq[2:-2]), moving(ddq)
    skew_s = np.sum(left * ddq, axis=0) / np.sum(ddq**2, axis=0)
    assert np.all(np.abs(skew_s) < 1e-6)


def test_own_acceleration_is_that_of_the_oracle():
    plant = plant_of(panda())
    (q, dq, tau), _ = drive(plant, 0.3)
    model, data = oracle(panda())
    assert plant.ddq() == pytest.approx(pin.aba(model, data, q[-1], dq[-1], tau[-1]), rel=1e-9)


@pytest.mark.parametrize("name", ["bent_link", "wall_mounted"])
def test_rigid_dynamics_hold_in_other_scenarios(name):
    plant = build(name, 3, noise="none").plant()
    (q, dq, tau), _ = drive(plant, 0.8)
    model, _ = rigid_torque(plant.truth, q, dq)
    assert np.all(rms(moving(model - tau[1:-1])) < 1e-4 * rms(tau - tau.mean(0)))


def test_link_motion_is_that_of_the_oracle():
    plant = build("bent_link", 1, noise="none").plant()
    model, data = oracle(plant.truth)
    (q, dq, _), samples = drive(plant, 0.5)
    ddq = (dq[2:] - dq[:-2]) / (2 * T_S)
    for k in range(60, 480, 20):
        pin.forwardKinematics(model, data, q[k], dq[k], ddq[k - 1])
        for j in range(plant.truth.n):
            frame = data.oMi[j + 1]
            v = pin.getVelocity(model, data, j + 1, pin.LOCAL)
            a = pin.getClassicalAcceleration(model, data, j + 1, pin.LOCAL)
            felt = a.linear - frame.rotation.T @ plant.truth.gravity
            assert samples[k].links.twist[j] == pytest.approx(v.vector, abs=1e-6)
            expected = np.concatenate([felt, a.angular])
            assert samples[k].links.accel[j] == pytest.approx(expected, abs=1e-3 * 9.81)


def test_link_motion_at_rest_reads_gravity_upwards():
    plant = build("nominal", links=True, noise="none").plant()
    links = plant.read().links
    assert links.accel[0] == pytest.approx([0, 0, 9.81, 0, 0, 0], abs=1e-9)
    assert np.linalg.norm(links.accel[:, :3], axis=1) == pytest.approx(np.full(7, 9.81))
    assert links.twist == pytest.approx(np.zeros((7, 6)), abs=1e-12)


@pytest.mark.parametrize("point_mass", [True, False])
def test_payload_acts_from_its_time_on_without_a_jump_in_speed(point_mass):
    shape = np.zeros((3, 3)) if point_mass else _tilted(np.diag([2e-3, 3e-3, 4e-3]))
    load = Payload(0.5, 1.0, np.array([0.02, -0.03, 0.15]), shape)
    plant = plant_of(panda().with_changes(events=(load,)))
    (q, dq, tau), _ = drive(plant, 1.0, payload=load)
    empty, ddq = rigid_torque(panda(), q, dq)
    full, _ = rigid_torque(panda(), q, dq, load)
    scale = rms(tau - tau.mean(0))
    # Row k belongs to sample k + 1. Left out: the change at 0.5 s and the corner that the
    # controller's answer puts into the torque a sample later.
    before, after = slice(50, 498), slice(502, None)
    assert np.all(rms((empty - tau[1:-1])[before]) < 1e-4 * scale)
    assert np.all(rms((full - tau[1:-1])[after]) < 1e-3 * scale)
    assert np.all(rms((empty - tau[1:-1])[after]).max() > 0.5)
    assert np.all(np.abs(np.diff(dq, axis=0))[495:505] < 2e-3 * np.abs(ddq).max() + 1e-3)


def _tilted(inertia):
    R = turn(0, 0.4) @ turn(2, 0.7)
    return R @ inertia @ R.T


def test_brakes_carry_a_payload_too():
    load = Payload(0.2, 1.0, np.array([0.0, 0.0, 0.15]))
    plant = plant_of(panda().with_changes(events=(load,)))
    for _ in range(800):
        sample = plant.read()
    model, data = oracle(panda(), load)
    assert sample.q == pytest.approx(panda().ready, abs=1e-6)
    hold = pin.computeGeneralizedGravity(model, data, sample.q)
    assert sample.tau == pytest.approx(hold, abs=1e-4)


def test_friction_and_motor_inertia_are_in_the_torque():
    base = build("friction", noise="none").truth
    truth = base.with_changes(motor_inertia=np.full(7, 0.05), torque_offset=np.full(7, 0.2))

    def losses(dq, ddq):
        friction = truth.Fv * dq + truth.Fc * np.tanh(dq / COULOMB_WIDTH)
        return friction + truth.motor_inertia * ddq

    (q, dq, tau), _ = drive(plant_of(truth), losses=losses)
    model, ddq = rigid_torque(truth, q, dq)
    model += losses(dq[1:-1], ddq) + truth.torque_offset
    # Around a reversal tanh bends inside the three samples of the difference.
    steady = np.abs(dq[1:-1]) > 3 * COULOMB_WIDTH
    left = np.where(steady, model - tau[1:-1], 0.0)
    assert np.all(rms(moving(left)) < 2e-3 * rms(tau - tau.mean(0)))


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
    arm = PyBulletArm(plant_of(panda()))
    arm.connect()
    hold = arm.read().tau
    with pytest.raises(DriverError, match=r"panda_joint\d (left its range|exceeded its speed)"):
        for _ in range(2000):
            arm.command(hold + np.array([0, 0, 0, 20.0, 0, 0, 0]))
            arm.read()
    for _ in range(1000):
        sample = arm.read()
    assert np.abs(sample.dq).max() < 1e-6


def test_driver_says_what_it_cannot_do():
    arm = PyBulletArm(plant_of(panda()))
    with pytest.raises(DriverError, match="connect"):
        arm.read()
    arm.connect()
    assert arm.joint_names[0] == "panda_joint1" and arm.link_names[6] == "panda_link7"
    assert [arm.read().stamp_ns for _ in range(3)] == [0, 1_000_000, 2_000_000]
    assert arm.plant_time_ns > 0
    for bad in (np.zeros(6), np.full(7, np.nan)):
        with pytest.raises(DriverError, match="7 finite torques"):
            arm.command(bad)
    arm.close()
    arm.close()
    with pytest.raises(DriverError, match="closed"):
        arm.read()
    with pytest.raises(DriverError, match="closed"):
        arm.connect()


def test_plants_do_not_disturb_each_other():
    alone = drive(plant_of(panda()), 0.1)[0]
    first, other = plant_of(panda()), build("wall_mounted", noise="none").plant()
    other.read()
    both = drive(first, 0.1)[0]
    other.close()
    assert all(np.array_equal(a, b) for a, b in zip(alone, both, strict=True))
