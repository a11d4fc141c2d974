"""The simulated robot's rules and faults: tick by tick without a network, and by raw sockets."""

import argparse
import contextlib
import json
import signal
import socket
import struct
import threading
import time

import numpy as np
import pytest

from sim.faults import Fault, read_fault
from sim.fci.clock import PERIOD_NS, Ticks
from sim.fci.codec import ERRORS, Generator, Request, RobotCommand, RobotMode, StateFrame
from sim.fci.faults import JUMP_RAD, KINDS, Spoiler, add_arguments
from sim.fci.robot import RECOVERY_TICKS, DesiredMotion, Robot
from sim.fci.server import FciServer, run
from sim.scenarios import build
from tests.helpers.live_tools import wait_for

DAMPING = np.array([4.0, 4.0, 4.0, 4.0, 0.5, 0.5, 0.1])
REFLEX_CODE = 6
ZERO = np.zeros(7)


def move(controller=2, generator=1):
    return Request("Move", 1, 5, struct.pack("<II", controller, generator) + bytes(48))


def ask(name, payload=b""):
    return Request(name, 0, 6, payload)


@pytest.fixture
def robot():
    made = Robot(build("nominal", 1), 5)
    yield made
    made.arm.plant.close()


def command(robot, tau=None, q=ZERO, dq=ZERO, end=False):
    tau = -DAMPING * robot.arm.dq if tau is None else np.asarray(tau, float)
    return RobotCommand(0, q, dq, tau, end, False)


def flags(robot):
    return [ERRORS[i] for i in np.flatnonzero(robot.errors)]


def second_reply(robot):
    """Status of the one reply that is due."""
    (data,) = robot.take_replies()
    assert data[4] == 5 and len(data) == 13
    return data[12]


def tripped(robot, name):
    assert flags(robot) == [name] and robot.mode == RobotMode.REFLEX and robot.motion is None
    assert second_reply(robot) == REFLEX_CODE
    assert robot.request(move())[12] == 3  # not possible now


def test_a_motion_begins_runs_and_ends_with_gravity_carried_by_the_robot(robot):
    start = robot.arm.q.copy()
    assert robot.request(move())[12] == 1
    assert robot.mode == RobotMode.MOVE
    for _ in range(1000):
        robot.tick(command(robot))
    assert robot.motion.success_rate == 1.0 and not robot.take_replies()
    assert np.abs(robot.arm.q - start).max() < 1e-3
    assert np.abs(robot.arm.tau_external).max() < 1.0
    robot.tick(command(robot, end=True))
    assert robot.mode == RobotMode.IDLE and second_reply(robot) == 0 and not robot.violations


@pytest.mark.parametrize("bad", [1.01, -1.01, np.nan, -np.inf])
def test_torque_step_of_more_than_1_newton_metre_either_way_or_no_number(robot, bad):
    robot.request(move())
    for tau in (1.0, 0.0, -1.0, 0.0):
        robot.tick(command(robot, [0, 0, tau, 0, 0, 0, 0]))
        assert robot.motion is not None and robot.tau_desired[2] == tau
    robot.tick(command(robot, [0, 0, bad, 0, 0, 0, 0]))
    tripped(robot, "controller_torque_discontinuity")
    assert not robot.tau_desired.any()


def test_lost_commands_hold_the_torque_until_there_are_20(robot):
    robot.request(move())
    robot.tick(command(robot, [0.5, 0, 0, 0, 0, 0, 0]))
    for _ in range(19):
        robot.tick(None)
    assert robot.tau_desired[0] == 0.5 and robot.missed == 19
    assert robot.motion.success_rate == pytest.approx(1 / 20)
    robot.tick(command(robot, [0.5, 0, 0, 0, 0, 0, 0]))
    for _ in range(20):
        assert robot.motion is not None
        robot.tick(None)
    tripped(robot, "communication_constraints_violation")


def test_a_client_that_never_commands(robot):
    robot.request(move())
    for _ in range(200):
        assert robot.motion is not None
        robot.tick(None)
    tripped(robot, "communication_constraints_violation")
    assert robot.missed == 0


def test_too_fast_and_out_of_range(robot):
    robot.request(move())
    for k in range(2000):
        robot.tick(command(robot, [0, 0, 0, 0, 0, 0, min(0.01 * k, 0.05)]))
        if robot.motion is None:
            break
    tripped(robot, "joint_velocity_violation")
    recover(robot)
    robot.request(move())
    upper = robot.arm.truth.limits.upper[6]
    tau = 0.0
    for _ in range(20_000):
        tau += np.clip(0.1 * (1.0 - robot.arm.dq[6]) - tau, -0.9, 0.9)
        robot.tick(command(robot, [*(-DAMPING * robot.arm.dq)[:6], tau]))
        if robot.motion is None:
            break
    assert robot.arm.q[6] > upper
    tripped(robot, "joint_position_limits_violation")
    for _ in range(500):
        robot.tick(None)
    assert robot.request(ask("AutomaticErrorRecovery"))[12] == 2  # manual recovery required


def recover(robot):
    assert robot.request(ask("AutomaticErrorRecovery")) is None
    for _ in range(RECOVERY_TICKS + 2000):
        assert robot.mode == RobotMode.RECOVERY and robot.errors.any()
        robot.tick(None)
        if due := robot.take_replies():
            break
    assert due[0][12] == 0 and robot.mode == RobotMode.IDLE and not robot.errors.any()


def test_the_arm_brakes_in_a_reflex_and_moves_after_recovery(robot):
    robot.request(move())
    for _ in range(300):
        robot.tick(command(robot, -DAMPING * robot.arm.dq + 0.2 * DAMPING))
    assert np.abs(robot.arm.dq).max() > 0.1
    robot.trip("cartesian_reflex")
    assert second_reply(robot) == REFLEX_CODE
    for _ in range(300):
        robot.tick(None)
    assert np.abs(robot.arm.dq).max() < 1e-3 and flags(robot) == ["cartesian_reflex"]
    recover(robot)
    assert robot.reflex_reason.any()  # what ended the last motion stays until the next one
    assert robot.request(move())[12] == 1 and not robot.reflex_reason.any()


def test_collision_thresholds(robot):
    lower, upper = [0.2] * 7, [0.4] * 7
    numbers = [*lower, *upper, *lower, *upper, *[50.0] * 6, *[90.0] * 6, *[50.0] * 6, *[90.0] * 6]
    assert robot.request(ask("SetCollisionBehavior", struct.pack("<52d", *numbers)))[12] == 0
    robot.arm.tau_external = np.array([0.0, 0.0, 0.0, 0.6, 0.0, 0.0, 0.0])
    robot.request(move())
    robot.tick(command(robot))
    assert robot.joint_collision.tolist() == [0, 0, 0, 1, 0, 0, 0]
    tripped(robot, "joint_reflex")
    swapped = [*upper, *lower, *upper, *lower, *numbers[28:]]
    assert robot.request(ask("SetCollisionBehavior", struct.pack("<52d", *swapped)))[12] == 2


def test_settings_are_not_possible_in_a_motion(robot):
    stiff = struct.pack("<7d", *[100.0] * 7)
    assert robot.request(ask("SetJointImpedance", stiff))[12] == 0
    assert robot.request(ask("SetJointImpedance", struct.pack("<7d", *[np.nan] * 7)))[12] == 2
    robot.request(move())
    assert robot.request(ask("SetJointImpedance", stiff))[12] == 1
    assert robot.request(move())[12] == 3


@pytest.mark.parametrize(("pair", "code"), [((3, 2), 5), ((2, 4), 5), ((0, 5), 5), ((7, 9), 5)])
def test_motions_that_this_robot_does_not_make(robot, pair, code):
    assert robot.request(move(*pair))[12] == code
    assert robot.mode == RobotMode.IDLE


def test_joint_velocities_are_followed_and_lost_ones_bridged(robot):
    start = robot.arm.q.copy()
    robot.request(move(0, 1))
    for k in range(1001):
        dq = np.full(7, 0.1 * (1 - np.cos(2 * np.pi * k / 1000)))
        lost = 100 <= k % 200 < 103
        robot.tick(None if lost else command(robot, ZERO, dq=dq, end=k == 1000))
    assert not robot.violations and second_reply(robot) == 0
    np.testing.assert_allclose(robot.arm.q - start, 0.1, atol=2e-3)


@pytest.mark.parametrize(
    ("positions", "error"),
    [
        (lambda q, k: q + 0.01, "joint_position_motion_generator_start_pose_invalid"),
        (lambda q, k: q * np.nan, "joint_position_motion_generator_start_pose_invalid"),
        (lambda q, k: q + 1e-4 * (k > 5), "joint_motion_generator_velocity_discontinuity"),
        (lambda q, k: q + 5e-6 * max(k - 5, 0) ** 2, "acceleration_discontinuity"),
    ],
)
def test_joint_positions_that_break_a_limit(robot, positions, error):
    q = robot.arm.q.copy()
    robot.request(move(0, 0))
    for k in range(1000):
        robot.tick(command(robot, ZERO, q=positions(q, k)))
        if robot.motion is None:
            break
    assert len(flags(robot)) == 1 and error in flags(robot)[0]


@pytest.mark.parametrize(
    ("speed", "start", "error"),
    [
        (lambda k: 3e-3 * k, 0.0, "joint_motion_generator_velocity_limits_violation"),
        (lambda k: min(1e-3 * k, 0.5), 1.0, "joint_motion_generator_position_limits_violation"),
    ],
)
def test_joint_velocities_that_lead_too_far(speed, start, error):
    truth = build("nominal").truth
    path = DesiredMotion(Generator.JOINT_VELOCITY, truth.ready + start * np.eye(7)[1], truth.limits)
    for k in range(5000):
        found = path.follow(RobotCommand(k, ZERO, speed(k) * np.eye(7)[1], ZERO, False, False))
        if found is not None:
            break
    assert found == error
    assert path.q[1] <= truth.limits.upper[1] and path.dq[1] <= truth.limits.velocity[1] * 1.001


def test_user_stop_and_stop_move(robot):
    robot.request(move())
    robot.tick(command(robot))
    robot.stop_by_user(50)
    assert robot.mode == RobotMode.USER_STOPPED and second_reply(robot) == 7
    assert robot.request(ask("AutomaticErrorRecovery"))[12] == 4
    assert robot.request(ask("StopMove"))[12] == 2
    for _ in range(50):
        robot.tick(None)
    assert robot.mode == RobotMode.IDLE
    robot.request(move())
    robot.tick(command(robot))
    assert robot.request(ask("StopMove"))[12] == 0
    assert robot.mode == RobotMode.IDLE and second_reply(robot) == 2


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("drop", Fault("drop", 0.01)),
        ("drop=0.1@2", Fault("drop", 0.1, "", 2.0)),
        ("stuck=5@1.5", Fault("stuck", 5.0, "", 1.5)),
        ("reflex@5", Fault("reflex", 0.0, "cartesian_reflex", 5.0)),
        ("reflex=joint_reflex@5", Fault("reflex", 0.0, "joint_reflex", 5.0)),
        ("cut@3", Fault("cut", 0.0, "", 3.0)),
        ("clock=-20@1", Fault("clock", -20.0, "", 1.0)),
        ("version", Fault("version", 7.0)),
    ],
)
def test_faults_are_read(text, fault):
    assert read_fault(text, KINDS) == fault


@pytest.mark.parametrize(
    "text",
    [
        "", "dorp", "drop=2", "drop=x", "drop=nan", "drop@", "drop@-1", "stuck=8", "stuck=1.5",
        "cut=1", "reflex=none", "clock=0", "version=7@1", "version=70000", "silence=-1",
    ],
)  # fmt: skip
def test_faults_that_are_none_name_the_choices(text):
    with pytest.raises(ValueError, match="user_stop" if text == "dorp" else "fault"):
        read_fault(text, KINDS)


def delivered(text, ticks=4000):
    """Ids of what leaves, in order, and the datagrams."""
    spoiler, out = Spoiler([text], 5), []
    for tick in range(ticks):
        out += [bytes(x) for x in spoiler.deliver(bytearray(struct.pack("<QQ", tick, 7)), tick)]
    whole = [struct.unpack_from("<Q", x)[0] for x in out if len(x) == 16 and x[8] == 7]
    return whole, out, spoiler.counts


def test_network_faults():
    ids, _, counts = delivered("drop=0.05")
    assert 100 < 4000 - len(ids) < 300 and counts["drop"] == 4000 - len(ids)
    assert np.all(np.diff(ids) > 0)
    ids, _, _ = delivered("repeat=0.05")
    assert 100 < len(ids) - len(set(ids)) < 300
    ids, _, _ = delivered("reorder=0.05")
    assert 100 < np.sum(np.diff(ids) < 0) < 300 and len(set(ids)) >= 3999
    ids, _, _ = delivered("late=0.05")
    assert 50 < np.sum(np.diff(ids) < 0) < 300 and len(set(ids)) >= 3990
    _, out, counts = delivered("corrupt=0.05")
    wrong = [x for k, x in enumerate(out) if x != struct.pack("<QQ", k, 7)]
    assert len(wrong) == counts["corrupt"] and any(len(x) < 16 for x in wrong)
    ids, _, _ = delivered("drop=1@1")
    assert ids == list(range(1000))
    assert delivered("corrupt=0.05")[1] == out  # by seed


def test_sensor_faults():
    for text, name in (("nan=0.2", "nan"), ("spike=0.2", "spike")):
        spoiler, frame, hits = Spoiler([text], 1), StateFrame(5), 0
        for tick in range(500):
            for key in ("q", "dq", "tau_J"):
                frame.fields[key][:] = 0.0
            spoiler.spoil_values(frame, tick / 1000)
            seen = np.concatenate([frame.fields[key] for key in ("q", "dq", "tau_J")])
            hits += np.isnan(seen).any() if name == "nan" else bool((np.abs(seen) > 0.1).any())
        assert hits == spoiler.counts[name] and 50 < hits < 150
    for text in ("stuck=3@1", "jump=3@1"):
        spoiler, frame = Spoiler([text], 1), StateFrame(10)
        for tick, expected in ((999, 0.999), (1000, 1.0), (1500, 1.5)):
            frame.fields["q"][:] = tick / 1000
            spoiler.spoil_values(frame, tick / 1000)
            if text[0] == "s":
                expected = min(expected, 1.0)
            else:
                expected += JUMP_RAD * (tick >= 1000)
            assert frame.fields["q"][2] == pytest.approx(expected, abs=1e-6)
            assert frame.fields["q"][1] == pytest.approx(tick / 1000, abs=1e-6)


def test_a_stalled_machine_slips_the_world():
    now = [0]

    def sleep(deadline):
        now[0] = max(now[0], deadline)

    def look():
        now[0] += 1000
        return now[0]

    ticks = Ticks(look, sleep)
    ticks.restart()
    for _ in range(10):
        ticks.wait()
    assert ticks.stalled == 0 and abs(now[0] - 10 * PERIOD_NS) < 100_000
    now[0] += 7 * PERIOD_NS
    ticks.wait()
    assert ticks.stalled == 6  # the seventh tick is the one that waited
    for _ in range(10):
        ticks.wait()
    assert ticks.stalled == 6


@contextlib.contextmanager
def serving(*faults, protocol=5):
    server, over = FciServer(build("nominal", 2), 0, protocol, faults), threading.Event()
    thread = threading.Thread(target=server.serve, args=(over.is_set,))
    thread.start()
    try:
        yield server
    finally:
        over.set()
        thread.join(60)
        server.close()


class RawClient:
    """A client of sockets alone."""

    def __init__(self, server, version=5):
        self.tcp = socket.create_connection(("127.0.0.1", server.port), timeout=30)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind(("127.0.0.1", 0))
        self.udp.settimeout(30)
        self.tcp.sendall(struct.pack("<IIIHH", 0, 0, 16, version, self.udp.getsockname()[1]))

    def reply(self, size):
        data = b""
        while len(data) < size:
            more = self.tcp.recv(size - len(data))
            if not more:
                break
            data += more
        return data

    def ids(self, count):
        return [struct.unpack_from("<Q", self.udp.recv(4096))[0] for _ in range(count)]

    def close(self):
        self.tcp.close()
        self.udp.close()


@contextlib.contextmanager
def connected(server):
    """A client whose version was accepted."""
    with contextlib.closing(RawClient(server)) as client:
        assert client.reply(15)[12] == 0
        yield client


def test_ids_are_contiguous_and_the_world_stands_between_clients():
    with serving() as server:

        def stands():
            before = server.summary()["ticks"]
            time.sleep(0.3)
            return server.summary()["ticks"] == before

        ids = []
        for _ in range(2):
            with connected(server) as client:
                ids += client.ids(30)
            assert wait_for(stands)  # once the robot has noticed that nobody is there
        assert np.all(np.diff(ids) > 0)


def test_a_second_client_is_turned_away():
    with serving() as server:
        with connected(server) as first:
            second = RawClient(server)
            with contextlib.suppress(ConnectionResetError):
                assert second.reply(15) == b""
            second.close()
            assert first.ids(5)
        assert server.summary()["refused_clients"] == 1


@pytest.mark.parametrize(
    "nonsense",
    [b"GET / HTTP/1.1\r\n\r\n", bytes(12), struct.pack("<IIIII", 1, 0, 20, 0, 0), b"\xff" * 400],
)
def test_nonsense_closes_the_connection_and_nothing_else(nonsense):
    with serving() as server:
        bad = socket.create_connection(("127.0.0.1", server.port), timeout=30)
        bad.sendall(nonsense)
        with contextlib.suppress(ConnectionResetError):
            assert bad.recv(100) == b""
        bad.close()
        with connected(server) as good:
            assert good.ids(5)
            good.udp.sendto(b"x" * 17, good.udp.getsockname())


def test_cut_and_silence_and_a_jump_of_the_clock():
    with serving("cut@0.1") as server:
        with connected(server) as client:
            assert client.tcp.recv(1) == b""
        with connected(server) as again:
            assert len(again.ids(10)) == 10
    with serving("silence@0.05") as server, connected(server) as client:
        client.udp.settimeout(1.0)
        with pytest.raises(TimeoutError):
            client.ids(10_000)
    with serving("clock=5000@0.05") as server, connected(server) as client:
        steps = np.diff(client.ids(200))
        assert np.sum(steps > 4000) == 1 and np.sum(steps < 1) == 0


def shell(*words):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return run(parser.parse_args(["--port", "0", *words]))


def test_command_serves_and_sums_up(tmp_path, capsys):
    path = tmp_path / "summary.json"
    before = signal.getsignal(signal.SIGTERM)
    code = shell(
        "--duration", "0.2", "--json", str(path), "--protocol", "10", "--set", "noise=none"
    )
    assert signal.getsignal(signal.SIGTERM) == before
    said = capsys.readouterr().out.splitlines()
    assert code == 0 and said[0].startswith("ready: a simulated arm on fci://127.0.0.1")
    assert said[0].endswith("(protocol 10)") and "stalled_ms: 0" in said
    assert json.loads(path.read_text("utf-8"))["clients"] == 0


def test_bad_options_name_the_choices():
    for options in ({"protocol": 7}, {"faults": ["x"]}):
        with pytest.raises(ValueError, match="have:"):
            FciServer(build("nominal"), 0, **options)
    with serving() as server, pytest.raises(OSError, match="in use"):
        FciServer(build("nominal"), server.port)
