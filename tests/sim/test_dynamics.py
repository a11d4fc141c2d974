"""The simulator's own recursion against Pinocchio, on the Panda and on trees of random shape."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from sim import dynamics
from sim.dynamics import Frames
from sim.fci.arm import wrench_at
from sim.scenarios import build
from tests.helpers.arm_data import pin_model
from tests.helpers.random_trees import random_tree

PIN_ORDER = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]  # of our θ: Pinocchio has XX XY YY XZ YZ ZZ


def oracle_motion(truth, q, dq, ddq):
    """(n, 6) each: [v; w] and [a - g; dw] of the links of a serial arm, in their own axes."""
    model = pin_model(truth)
    return motion_of(model, q, dq, ddq, range(1, truth.n + 1))


def motion_of(model, q, dq, ddq, joints):
    data = model.createData()
    pin.forwardKinematics(model, data, q, dq, ddq)
    twist, accel = [], []
    for j in joints:
        v = pin.getVelocity(model, data, j, pin.LOCAL)
        a = pin.getClassicalAcceleration(model, data, j, pin.LOCAL)
        felt = a.linear - data.oMi[j].rotation.T @ model.gravity.linear
        twist.append(v.vector)
        accel.append(np.concatenate([felt, a.angular]))
    return np.array(twist), np.array(accel)


def tree_model(truth):
    """A Pinocchio model of a tree with a free base."""
    model = pin.Model()
    model.gravity.linear = truth.gravity
    at = [model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")]
    model.appendBodyToJoint(at[0], _body(truth.theta[0]), pin.SE3.Identity())
    for j, parent in enumerate(truth.parent):
        place = pin.SE3(truth.R[j], truth.p[j])
        name = truth.joint_names[j]
        at.append(model.addJoint(at[parent + 1], pin.JointModelRZ(), place, name))
        model.appendBodyToJoint(at[-1], _body(truth.theta[j + 1]), pin.SE3.Identity())
    return model, at


def _body(theta):
    return pin.Inertia.FromDynamicParameters(theta[PIN_ORDER])


@pytest.mark.parametrize("links", [5, 12, 40])
def test_a_tree_that_tumbles_moves_and_pulls_as_pinocchio_says(links):
    truth, rng = random_tree(links, links), np.random.default_rng(links)
    model, at = tree_model(truth)
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
