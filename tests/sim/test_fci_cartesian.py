"""Cartesian motions and impedance of the simulated robot, tick by tick; its gripper by sockets."""

import contextlib
import dataclasses
import socket
import struct
import time

import numpy as np
import pytest

from sim.effects import Effect
from sim.fci import gripper
from sim.fci.cartesian import difference, moved
from sim.fci.codec import ERRORS, Request, RobotCommand
from sim.fci.gripper import Fingers, GripperServer
from sim.fci.robot import Robot
from sim.scenarios import build
from tests.sim.test_fci_server_faults import move

ZERO = np.zeros(7)
PREFIX = "cartesian_motion_generator_"
TICKS = 600  # of an eased motion


both = pytest.mark.parametrize("robot", ["nominal", "real_drives"], indirect=True)


@pytest.fixture
def robot(request):
    made = Robot(build(getattr(request, "param", "nominal"), 1), 5)
    yield made
    made.arm.plant.close()


def answer(pose=None, twist=None, elbow=None, end=False):
    column = np.eye(4) if pose is None else pose
    twist = np.zeros(6) if twist is None else twist
    return RobotCommand(0, ZERO, ZERO, ZERO, end, False, column.ravel("F"), twist, elbow)


def eased(k):
    """From 0 to 1, with its rate at rest at both ends."""
    s = min(k / TICKS, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def shifted(start, s):
    """A pose 6 cm and 0.2 rad away, in part."""
    pose = moved(start, 1e3 * s * np.array([0.0, 0.0, 0.0, 0.1, -0.1, 0.2]))
    pose[:3, 3] += s * np.array([0.02, 0.04, -0.04])
    return pose


@both
@pytest.mark.parametrize("controller", [0, 1])
def test_poses_are_followed(robot, controller):
    start = robot.arm.pose.copy()
    assert robot.request(move(controller, 2))[12] == 1
    for k in range(TICKS + 300):
        robot.tick(None if 300 <= k % 500 < 303 else answer(shifted(start, eased(k))))
        assert robot.motion is not None, [ERRORS[i] for i in np.flatnonzero(robot.errors)]
    wanted = shifted(start, 1.0)
    assert np.abs(difference(robot.arm.pose, wanted)).max() < (4e-3 if controller else 2e-3)
    robot.tick(answer(wanted, end=True))
    assert robot.motion is None
    assert not robot.violations


@both
def test_twists_are_followed_and_the_elbow_goes_where_it_is_told(robot):
    start, elbow = robot.arm.pose.copy(), robot.arm.q[2]
    robot.request(move(0, 3))
    for k in range(TICKS + 300):
        rate = 1e3 * (eased(k + 1) - eased(k)) * np.array([0.05, 0.0, -0.05, 0.0, 0.1, 0.0])
        side = np.array([elbow + 0.1 * eased(k + 1), -1.0])
        robot.tick(answer(twist=rate, elbow=side) if k % 50 else None)
        assert robot.motion is not None, [ERRORS[i] for i in np.flatnonzero(robot.errors)]
    step = difference(start, robot.arm.pose)
    np.testing.assert_allclose(step, [0.05, 0, -0.05, 0, 0.1, 0], atol=2e-3)
    assert robot.arm.q[2] - elbow == pytest.approx(0.1, abs=5e-3)
    robot.tick(answer(end=True))
    assert not robot.violations


@pytest.mark.parametrize(
    ("what", "error"),
    [
        (lambda late: 0.01, "cartesian_position_motion_generator_start_pose_invalid"),
        (lambda late: np.nan, "cartesian_position_motion_generator_invalid_frame_flag"),
        (lambda late: 1e-3 * late, PREFIX + "velocity_discontinuity"),
        (lambda late: 7.5e-6 * late**2, PREFIX + "acceleration_discontinuity"),
        (lambda late: 5e-4 * (late - 100 * np.tanh(late / 100)), "joint_"),  # too far
    ],
)
def test_poses_that_break_a_limit(robot, what, error):
    start = robot.arm.pose.copy()
    robot.request(move(0, 2))
    for k in range(3000):
        pose = start.copy()  # with something wrong from the 50th tick on
        pose[0, 3] += what(max(k - 50, 0))
        robot.tick(answer(pose))
        if robot.motion is None:
            break
    assert len(robot.violations) == 1 and error in robot.violations[0]


@pytest.mark.parametrize(
    ("acceleration", "ticks", "error"),
    [
        (10.0, 10, PREFIX + "joint_velocity_discontinuity"),
        (3.0, 1, PREFIX + "joint_acceleration_discontinuity"),
        (1.0, 1, None),
    ],
)
def test_joints_that_a_hand_within_its_limits_would_jerk(robot, acceleration, ticks, error):
    robot.request(move(0, 3))
    rate = 0.0
    for k in range(40):
        rate += 1e-3 * acceleration * min((k + 1) / ticks, 1.0)
        robot.tick(answer(twist=np.array([0.0, 0.0, rate, 0.0, 0.0, 0.0])))
    assert robot.violations == ([] if error is None else [error])


def test_an_fr3_slows_down_towards_the_end_of_a_joint():
    robot = Robot(build("nominal", 1, robot="fr3"), 10)
    motion = Request("Move", 1, 10, struct.pack("<II", 0, 1) + bytes(105))
    assert robot.request(motion)[12] == 1
    rate = np.zeros(7)
    for _ in range(2500):  # joint 7 at 1 rad/s from 0.785 rad towards 3.016
        rate[6] = min(rate[6] + 0.005, 1.0)
        robot.tick(RobotCommand(0, ZERO, rate.copy(), ZERO, False, False))
        if robot.motion is None:
            break
    reached = robot.arm.q[6]
    robot.arm.plant.close()
    assert robot.violations == ["joint_motion_generator_velocity_limits_violation"]
    assert reached == pytest.approx(3.0196 - 1.35**2 / 34.0, abs=1e-2)


@pytest.mark.parametrize(
    ("elbow", "error"),
    [
        ((0.5, -1.0), PREFIX + "start_elbow_invalid"),
        ((0.0, 1.0), "start_elbow_sign_inconsistent"),
        ((np.nan, -1.0), PREFIX + "start_elbow_invalid"),
    ],
)
def test_elbows_that_are_none(robot, elbow, error):
    robot.request(move(0, 2))
    robot.tick(answer(robot.arm.pose, elbow=np.array(elbow)))
    assert robot.violations == [error]


@pytest.mark.parametrize("stiffness", [300.0, 1500.0])
def test_a_push_moves_the_hand_as_far_as_the_stiffness_says(stiffness):
    push = Effect("external_wrench", (), {"fx": 0.0, "fy": 10.0, "fz": 0.0}, (0.2, None))
    nominal = build("nominal", 1, noise="none")
    truth = nominal.truth.with_changes(effects=(push,))
    robot = Robot(dataclasses.replace(nominal, truth=truth), 5)
    numbers = struct.pack("<6d", *[stiffness] * 3, *[100.0] * 3)
    assert robot.request(Request("SetCartesianImpedance", 6, 1, numbers))[12] == 0
    start = robot.arm.pose.copy()
    robot.request(move(1, 2))
    for _ in range(1500):
        robot.tick(answer(start))
    assert robot.motion is not None
    step = difference(start, robot.arm.pose)
    turn = np.cross(step[3:], [0, 0, 0.107])
    robot.arm.plant.close()
    # the push acts 0.107 m behind the hand, which turns it a little as well
    assert step[1] == pytest.approx(10.0 / stiffness, rel=0.1, abs=np.abs(turn).max())


def test_a_threshold_below_a_push_ends_the_motion():
    push = Effect("external_wrench", (), {"fx": 0.0, "fy": 30.0, "fz": 0.0}, (0.2, None))
    nominal = build("nominal", 1)
    for most, ended in ((50.0, []), (20.0, ["cartesian_reflex"])):
        truth = nominal.truth.with_changes(effects=(push,))
        robot = Robot(dataclasses.replace(nominal, truth=truth), 5)
        numbers = struct.pack("<52d", *[50.0] * 28, *[most] * 24)
        assert robot.request(Request("SetCollisionBehavior", 4, 1, numbers))[12] == 0
        robot.request(move(0, 2))
        start = robot.arm.pose.copy()
        for _ in range(400):
            robot.tick(answer(start))
        assert robot.violations == ended
        robot.arm.plant.close()


# Gripper


class Hand:
    """A gripper and a client of it, both here."""

    def __init__(self, thing=0.0):
        self.server, self.held = GripperServer(0, thing), b""
        self.tcp = socket.create_connection(("127.0.0.1", self.server.port))
        self.tcp.settimeout(0.0)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind(("127.0.0.1", 0))
        self.udp.settimeout(0.0)

    def ask(self, command, ident, payload=b""):
        self.tcp.sendall(struct.pack("<HII", command, ident, 10 + len(payload)) + payload)

    def wait(self, limit_s=20.0):
        """(command, id, status, rest) of the next reply."""
        end = time.monotonic() + limit_s
        while time.monotonic() < end:
            self.server.poll()
            with contextlib.suppress(BlockingIOError):
                self.held += self.tcp.recv(100)
            if self.held:
                command, ident, size = struct.unpack_from("<HII", self.held)
                data, self.held = self.held[:size], self.held[size:]
                return command, ident, struct.unpack_from("<H", data, 10)[0], data[12:]
            time.sleep(1e-3)
        raise AssertionError("no reply")

    def state(self):
        """Of a datagram to come: width, greatest width, grasped."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self.udp.recv(100)
        end, data = time.monotonic() + 20.0, b""
        while not data and time.monotonic() < end:
            time.sleep(1e-3)
            self.server.poll()
            with contextlib.suppress(BlockingIOError):
                data = self.udp.recv(100)
        assert len(data) == 23
        return struct.unpack_from("<dd?", data, 4)

    def close(self):
        for end in (self.server, self.tcp, self.udp):
            end.close()


@pytest.fixture
def hand():
    made = Hand(thing=0.03)
    made.ask(0, 1, struct.pack("<HH", 3, made.udp.getsockname()[1]))
    assert made.wait() == (0, 1, 0, struct.pack("<H", 3))
    yield made
    made.close()


def test_the_gripper_moves_grasps_and_is_stopped(hand):
    hand.ask(3, 2, struct.pack("<2d", 0.05, 0.1))
    assert hand.wait() == (3, 2, 0, b"")
    assert hand.state() == (0.05, 0.08, False)
    hand.ask(2, 3, struct.pack("<5d", 0.03, 0.005, 0.005, 0.1, 20.0))
    assert hand.wait()[2] == 0
    assert hand.state() == (0.03, 0.08, True)
    hand.ask(2, 4, struct.pack("<5d", 0.01, 0.005, 0.005, 0.1, 20.0))  # thicker than expected
    assert hand.wait()[2] == 2
    assert not hand.state()[2]
    hand.ask(3, 5, struct.pack("<2d", 0.08, 0.01))
    for _ in range(5):
        hand.server.poll()
    hand.ask(4, 6)
    assert sorted((hand.wait()[1:3], hand.wait()[1:3])) == [(5, 3), (6, 0)]
    assert 0.03 <= hand.state()[0] < 0.08
    for bad in (struct.pack("<2d", 0.2, 0.1), struct.pack("<2d", np.nan, 0.1)):
        hand.ask(3, 7, bad)
        assert hand.wait()[2] == 1


def test_another_version_of_the_gripper_is_said(hand):
    hand.ask(0, 9, struct.pack("<HH", 2, 5))
    assert hand.wait() == (0, 9, 1, struct.pack("<H", 3))


def test_nonsense_to_the_gripper_ends_the_connection_and_the_next_client_comes(hand):
    hand.tcp.sendall(b"GET / HTTP/1.1\r\n\r\n")
    time.sleep(0.01)
    for _ in range(3):
        hand.server.poll()
    with socket.create_connection(("127.0.0.1", hand.server.port)) as tcp:
        hand.tcp.close()
        hand.tcp = tcp
        hand.tcp.settimeout(0.0)
        hand.ask(0, 1, struct.pack("<HH", 3, 5))
        assert hand.wait()[2] == 0
    assert hand.server.clients == 2


def test_homing_goes_to_both_ends_in_its_time():
    fingers = Fingers()
    assert fingers.begin(gripper.Command.HOMING, ())
    fingers.go_on(0.5)
    assert fingers.width == pytest.approx(0.04 - 0.05 * 0.5)
    assert fingers.go_on(2.39) is None
    assert fingers.go_on(2.41) == gripper.Status.SUCCESS
    assert fingers.width == 0.08
