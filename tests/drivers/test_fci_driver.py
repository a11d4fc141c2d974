"""The FCI driver against a scripted peer that speaks the real wire formats."""

import mmap
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.fci import FciArm, reader, reader_client
from drivers.fci.codec import id_at
from drivers.fci.torque_control import TORQUE_STEP
from drivers.interface import Driver, DriverError, NotReady
from tests.helpers import fci_peer
from tests.helpers.fci_peer import Peer
from tests.helpers.patience import gone

PROTOCOLS = pytest.mark.parametrize("protocol", [5, 10])
TAU = np.array([3.0, -3.0, 2.0, 1.0, 0.5, -0.5, 0.1])
LIMIT_S = 20.0


@pytest.fixture(params=[5, 10])
def peer(request):
    with Peer(request.param) as it:
        yield it


@pytest.fixture
def peer5():
    with Peer(5) as it:
        yield it


@pytest.fixture
def connected():
    """Builds connected arms and closes them in the end."""
    arms = []

    def build(peer, options="", **arguments):
        arm = FciArm(peer.address + options, **arguments)
        arms.append(arm)
        arm.connect()
        return arm

    yield build
    for arm in arms:
        arm.close()


def quiet(arm, peer):
    """Stop the peer's stream, send one state more and read up to it; its id."""
    peer.message_id = last = peer.pause() + 1
    peer.send(peer.state(last))
    while arm.read().stamp_ns < last * 1_000_000:
        pass
    return last


def ids_until(arm, last):
    """Ids of the samples up to one of them."""
    got = []
    while not got or got[-1] != last:
        got.append(arm.read().stamp_ns // 1_000_000)
    return got


def patiently(condition, between=lambda: time.sleep(0.005)):
    """Do something until a condition is true; it must come true in time."""
    deadline = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline
        between()


def answer(arm, tau=TAU):
    """Read and command."""
    arm.read()
    arm.command(tau)


def drive(arm, until, tau=TAU):
    """Read and command until something is true."""
    patiently(until, lambda: answer(arm, tau))


def moving(arm, peer, tau=TAU):
    """A motion that has taken some commands."""
    drive(arm, lambda: len(peer.commands) >= 20 and peer.commands[-1][1] == tuple(tau), tau)


@pytest.fixture
def in_motion(peer, connected):
    """(arm, peer) of a motion that has begun."""
    arm = connected(peer, allow_motion=True)
    moving(arm, peer)
    return arm, peer


@pytest.fixture
def in_motion5(peer5, connected):
    """The same of protocol 5 alone."""
    arm = connected(peer5, allow_motion=True)
    moving(arm, peer5)
    return arm, peer5


def exact(intake):
    return intake.received == intake.used + sum(intake.refused.values())


# Connecting


def test_it_is_a_driver_and_finds_the_version(peer, connected):
    before = sys.getswitchinterval()
    arm: Driver = connected(peer)
    assert arm.version == peer.protocol
    name = "panda" if peer.protocol == 5 else "fr3"
    assert arm.joint_names == tuple(f"{name}_joint{k}" for k in range(1, 8))
    assert (arm.link_names, arm.period_ns) == ((), 1_000_000)
    assert (arm.paced, arm.adds_gravity, arm.can_move) == (True, True, False)
    asked = [struct.unpack_from("<H", payload)[0] for _, payload in peer.requests]
    assert asked == ([5] if peer.protocol == 5 else [5, 10])
    assert sys.getswitchinterval() < before
    arm.close()
    arm.close()
    assert sys.getswitchinterval() == before
    with pytest.raises(DriverError, match="not connected"):
        arm.read()
    arm.connect()
    assert arm.read().stamp_ns > 0
    assert arm.intake.used == 1


def test_samples_carry_what_was_sent(peer, connected):
    arm = connected(peer, f"?protocol={peer.protocol}")
    last = quiet(arm, peer)
    q, dq, tau = (np.arange(7.0) + k for k in (0.5, 10.25, 20.125))
    before = time.monotonic_ns()
    peer.send(peer.state(last + 1, q=q, dq=dq, tau=tau))
    sample = arm.read()
    after = time.monotonic_ns()
    assert sample.stamp_ns == (last + 1) * 1_000_000
    assert np.array_equal(sample.q, q)
    assert np.array_equal(sample.dq, dq)
    assert np.array_equal(sample.tau, tau)
    assert before <= arm.arrived_ns <= after
    peer.send(peer.state(last + 2, q=[np.nan, *q[1:]]))
    assert np.isnan(arm.read().q[0])
    assert np.array_equal(sample.q, q)  # a sample keeps its numbers


def test_names_and_addresses_are_checked():
    assert FciArm("fci://robot", "abcdefg").joint_names == tuple("abcdefg")
    assert FciArm("fci://robot?protocol=10").joint_names[0] == "fr3_joint1"
    with pytest.raises(DriverError, match="7 joints, got 2"):
        FciArm("fci://robot", ["a", "b"])
    for address, why in (
        ("fci://robot?protocol=7", "have: auto, 5, 10"),
        ("fci://robot?recover=yes", "write recover=1"),
        ("fci://robot?speed=1", "have: protocol, recover, collision, load"),
        ("fci://", "names nobody"),
    ):
        with pytest.raises(DriverError, match=why):
            FciArm(address)


@pytest.mark.parametrize(
    ("host", "advice"), [("127.0.0.1", "adapter sim fci"), ("127.0.0.2", "activate FCI in Desk")]
)
def test_nobody_there(host, advice):
    with socket.create_server((host, 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(DriverError, match=rf"no FCI at .*{advice}"):
        FciArm(f"fci://{host}:{port}").connect()


@pytest.mark.parametrize("server", [6, 9, 77])
def test_versions_that_nobody_supports(peer5, server):
    peer5.protocol = server
    with pytest.raises(DriverError, match=f"protocol {server} .*supported are 5 .* and 10 "):
        FciArm(peer5.address).connect()


@PROTOCOLS
def test_the_wrong_version_asked_for(protocol):
    with Peer(protocol) as peer:
        arm = FciArm(f"{peer.address}?protocol={15 - protocol}")
        with pytest.raises(DriverError, match=rf"use \?protocol={protocol}"):
            arm.connect()


def test_a_handshake_byte_by_byte_with_surplus(peer5, connected):
    peer5.slowly = True
    peer5.connect_reply = lambda version, command_id: fci_peer.reply(
        0, command_id, struct.pack("<BH", 0, 5) + bytes(50)
    )
    assert connected(peer5).read().stamp_ns > 0


@pytest.mark.parametrize(
    ("answered", "why"),
    [
        (lambda _, k: fci_peer.reply(0, k, b""), "answer to Connect of 12 bytes; it has 15"),
        (lambda _, k: fci_peer.reply(0, k, b"\0\0"), "answer to Connect of 14 bytes; it has 15"),
        (lambda _, k: fci_peer.reply(0, k, b"\7\5\0"), "status 7, which is not defined"),
        (lambda peer, _: b"HTTP/1.1 400 Bad Request\r\n", "is this an FCI port"),
        (lambda peer, _: None, "does not answer Connect"),
        (lambda peer, _: peer.hang_up(), "hung up during the handshake"),
    ],
)
def test_a_handshake_that_is_none_another_kind_of_server_and_a_hang_up(
    peer5, monkeypatch, answered, why
):
    monkeypatch.setattr("drivers.fci.connect.REPLY_LIMIT_S", 1.0)
    peer5.connect_reply = lambda version, command_id: answered(peer5, command_id)
    with pytest.raises(DriverError, match=why):
        FciArm(peer5.address).connect()


def test_no_state_after_the_handshake(peer5):
    peer5.streaming.clear()
    before = sys.getswitchinterval()
    with pytest.raises(DriverError, match="no state for 1 s while the connection stands"):
        FciArm(peer5.address).connect()
    assert sys.getswitchinterval() == before


@pytest.mark.parametrize("said", [5, 10])
def test_a_server_that_agrees_to_5_and_is_10_is_taken_for_10(peer5, connected, said):
    peer5.connect_reply = lambda version, command_id: fci_peer.reply(
        0, command_id, struct.pack("<BH", 0, said)
    )
    peer5.protocol = 10  # its answer, or its states alone, tell
    with pytest.raises(DriverError, match=r"nothing of use.*1377 bytes.*2373.*\?protocol"):
        FciArm(f"{peer5.address}?protocol=5").connect()
    arm = connected(peer5, allow_motion=True)
    assert arm.version == 10
    assert arm.joint_names[0] == "fr3_joint1"
    moving(arm, peer5)
    assert exact(arm.intake)


# The account


def test_every_datagram_is_accounted_for(peer, connected):
    arm = connected(peer)
    last = quiet(arm, peer)
    received, used = arm.intake.received, arm.intake.used
    peer.send_ids(last + 1, last + 2, last + 2, last + 4, last + 3)  # repeated; lost, then late
    peer.send(peer.state(last + 5)[:-1])  # cut short: arrived, so not lost
    peer.send(peer.state(last + 6) + b"\0" * 100)
    peer.send(peer.state(last + 7, modes=(0, 77, 1)))
    peer.send_ids(last + 8, 1 << 41, last + 3_600_001, last + 50_000, last + 12)
    assert ids_until(arm, last + 12) == [last + k for k in (1, 2, 4, 8, 12)]
    assert arm.intake.received - received == 13
    assert arm.intake.used - used == 5
    assert arm.intake.refused == {"repeated": 1, "out_of_order": 1, "malformed": 6}
    assert arm.intake.lost == 1  # of 9 to 11, three datagrams arrived and could not be read
    assert exact(arm.intake)
    notes = " ".join(arm.intake.notes)
    for said in ("repeated a state", "after a later one", "no state of this", "got lost"):
        assert notes.count(said) == 1


@pytest.mark.parametrize(("jump", "refused"), [(-900, 99), (10_000, 9), (4_000_000, 9)])
def test_another_count_is_followed_after_a_while(peer5, connected, jump, refused):
    arm = connected(peer5)
    first = quiet(arm, peer5) + jump
    for message_id in range(first, first + 120):
        peer5.send_ids(message_id)
    assert ids_until(arm, first + 119) == list(range(first + refused, first + 120))
    assert sum(arm.intake.refused.values()) == refused
    assert arm.intake.lost == 0
    assert any("another count" in note for note in arm.intake.notes)
    assert exact(arm.intake)


def test_states_of_strangers_are_refused(peer5, connected):
    arm = connected(peer5)
    last = quiet(arm, peer5)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.2", 0))
        stranger.sendto(peer5.state(last + 1, q=[9.0] * 7), peer5._where)
    peer5.send(peer5.state(last + 1))
    assert arm.read().q[0] == 0.0
    assert arm.intake.refused == {"stranger": 1}


@pytest.mark.alone  # a peer that stands still for a second is a dead robot
def test_a_loop_that_was_away_gets_fresh_states_and_an_exact_account(peer5, connected):
    arm = connected(peer5)
    first = quiet(arm, peer5)
    before = arm.intake.received
    peer5.streaming.set()
    patiently(lambda: peer5.message_id >= first + 1500)  # more than are kept
    sample = arm.read()
    assert time.monotonic_ns() - arm.arrived_ns < 600_000_000
    assert sample.stamp_ns > (first + 400) * 1_000_000
    last = quiet(arm, peer5)
    assert arm.intake.refused["loop_too_slow"] > 0
    assert exact(arm.intake)
    assert arm.intake.received - before + arm.intake.lost == last - first


def test_silence_and_a_cut_connection(peer5, connected):
    arm = connected(peer5)
    quiet(arm, peer5)
    begin = time.monotonic()
    with pytest.raises(DriverError, match="while the connection stands: check the cable"):
        arm.read()
    assert time.monotonic() - begin < LIMIT_S
    peer5.hang_up()
    with pytest.raises(DriverError, match="has cut the connection"):
        arm.read()


# The reader's process

FILLS = """
import mmap, sys
from drivers.fci.reader import TAIL, StateRing, ring_size
ring = StateRing(mmap.mmap(int(sys.argv[1]), ring_size(8)), 8)
while True:
    ring.put(ring.space(), (1, bytes(4)), 3, 0, 1)
    ring._words[TAIL] = ring._head
"""


def test_the_head_of_the_ring_never_goes_back():
    """Two processes, one word: whoever reads it while it is written must not see a zero."""
    fd = os.memfd_create("ring")
    os.ftruncate(fd, reader.ring_size(8))
    words = memoryview(mmap.mmap(fd, 0))[: reader.FIRST_SLOT].cast("Q")
    with subprocess.Popen([sys.executable, "-c", FILLS, str(fd)], pass_fds=[fd]) as writer:
        seen = 0
        while 0 <= seen < 1_000_000 and writer.poll() is None:
            head = words[reader.HEAD]
            seen = head if head >= seen else -1
        writer.kill()
    os.close(fd)
    assert seen >= 1_000_000


def test_a_killed_reader_is_replaced(peer5, connected):
    arm = connected(peer5)
    first = arm.read().stamp_ns // 1_000_000
    used = arm.intake.used
    for _ in range(3):
        pid = arm._connection.reader.pid
        os.kill(pid, signal.SIGKILL)
        patiently(lambda old=pid: arm._connection.reader.pid != old, arm.read)
        for _ in range(50):
            arm.read()
    last = quiet(arm, peer5)
    assert exact(arm.intake)
    assert arm.intake.refused.keys() <= {"stale", "loop_too_slow"}
    there = arm.intake.used - used + sum(arm.intake.refused.values())
    assert there + arm.intake.lost == last - first
    assert len(peer5.requests) == 1  # the session went on
    assert sum("was replaced" in note for note in arm.intake.notes) == 1


@pytest.mark.alone  # a spare that the machine has no time for is none
@pytest.mark.parametrize("ready", [True, False])
def test_a_spare_reader_takes_over_in_motion(in_motion, ready):
    """The motion goes on where the spare had started; where it dies as well, a new one is made."""
    arm, peer = in_motion
    pid, spare = arm._connection.reader.pid, arm._connection.reader.spare_pid
    if not ready:
        os.kill(spare, signal.SIGKILL)
    os.kill(pid, signal.SIGKILL)
    drive(arm, lambda: arm._connection.reader.pid != pid)
    assert (arm._connection.reader.pid == spare) == ready
    drive(arm, lambda: arm._connection.reader.spare_pid not in (pid, spare, None))
    sent = arm.intake.commands.sent
    drive(arm, lambda: arm.intake.commands.sent > sent + 50)
    assert peer.modes[2] == 2
    assert exact(arm.intake)
    arm.stop()


def test_a_reader_that_stands_still_is_replaced(peer5, connected):
    arm = connected(peer5)
    pid = arm._connection.reader.pid
    os.kill(pid, signal.SIGSTOP)
    for _ in range(100):
        arm.read()
    patiently(lambda: arm._connection.reader.pid != pid, arm.read)
    assert exact(arm.intake)


def test_a_reader_that_keeps_dying_is_an_error(peer5, connected, monkeypatch):
    monkeypatch.setattr(reader_client, "RESTARTS_WITHIN_S", 1000.0)  # a slow computer kills slowly
    arm = connected(peer5)

    def kill_again_and_again():
        for _ in range(reader_client.RESTARTS + 1):
            pid = arm._connection.reader.pid
            os.kill(pid, signal.SIGKILL)
            while arm._connection.reader.pid == pid:
                arm.read()

    with pytest.raises(DriverError, match="died 5 times within 1000 s"):
        kill_again_and_again()
    with pytest.raises(DriverError, match="died 5 times"):
        arm.read()
    arm.close()
    arm.connect()
    assert arm.read().stamp_ns > 0


def test_the_reader_goes_when_its_driver_is_killed(peer5):
    lines = (
        "import time",
        "from drivers.fci import FciArm",
        f"arm = FciArm('{peer5.address}')",
        "arm.connect()",
        "print(arm._connection.reader.pid, arm._connection.reader.spare_pid, flush=True)",
        "time.sleep(100)",
    )
    driver = subprocess.Popen(
        [sys.executable, "-c", "\n".join(lines)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    )
    pids = [int(word) for word in driver.stdout.readline().split()]
    os.kill(driver.pid, signal.SIGKILL)
    driver.wait()
    driver.stdout.close()
    patiently(lambda: all(map(gone, pids)))


@PROTOCOLS
def test_a_busy_thread_beside_the_loop_costs_no_samples(protocol):
    """Every state is accounted for; of those unused, none is lost to the busy thread.

    Where this machine itself stood still, the states of that time are refused as stale: the
    stalls that the reading thread saw are counted apart.
    """
    count = 2000
    peer = subprocess.Popen(
        [sys.executable, fci_peer.__file__, str(protocol), "1000"],
        stdout=subprocess.PIPE,
        text=True,
    )
    over = threading.Event()

    def spin():
        while not over.is_set():
            sum(range(100))

    busy = threading.Thread(target=spin)
    arm = FciArm(f"fci://127.0.0.1:{int(peer.stdout.readline())}?protocol={protocol}")
    try:
        busy.start()
        begin = time.monotonic()
        arm.connect()
        ids, stalled_s = [0], 0.0
        while ids[-1] < count:
            ids.append(arm.read().stamp_ns // 1_000_000)
            now = time.monotonic()
            begin, gap_s = now, now - begin
            stalled_s += gap_s if gap_s > 0.1 else 0.0
    finally:
        over.set()
        busy.join()
        arm.close()
        peer.kill()
        peer.wait()
        peer.stdout.close()
    assert np.diff(ids).min() > 0
    assert exact(arm.intake) and arm.intake.used == len(ids) - 1
    assert arm.intake.received + arm.intake.lost == ids[-1]
    assert arm.intake.lost == arm.kernel_drops
    assert arm.intake.refused.keys() <= {"stale", "loop_too_slow"}
    assert ids[-1] - arm.intake.used <= 1000.0 * stalled_s


# Motion


def test_without_permission_nothing_moves(peer, connected):
    arm = connected(peer)
    arm.read()
    with pytest.raises(DriverError, match="needs --allow-motion"):
        arm.command(TAU)
    arm.stop()
    assert [command for command, _ in peer.requests if command != 0] == []


def test_a_motion_is_started_fed_and_finished(peer, connected):
    arm = connected(peer, allow_motion=True)
    assert arm.can_move
    with pytest.raises(DriverError, match="no state was read"):
        arm.command(TAU)
    moving(arm, peer)
    arm.stop()
    arm.stop()
    moves = [payload for command, payload in peer.requests if command == fci_peer.MOVE]
    assert len(moves) == 1
    assert struct.unpack_from("<II", moves[0]) == (2, 1 if peer.protocol == 5 else 4)
    assert len(moves[0]) == (56 if peer.protocol == 5 else 113)
    assert fci_peer.STOP_MOVE not in [command for command, _ in peer.requests]
    torques = np.array([tau for _, tau, _ in peer.commands])
    ids = [message_id for message_id, _, _ in peer.commands]
    assert all(np.diff(ids) >= 0)
    assert np.abs(np.diff(torques, axis=0, prepend=0.0)).max() <= 1.0
    assert np.abs(torques - TAU).max(axis=1).min() < 1e-9
    finished = [flag for _, _, flag in peer.commands]
    assert finished.index(True) > 20
    assert all(finished[finished.index(True) :])
    assert np.abs(torques[-1]).max() < 1.0
    assert peer.modes == (0, 3, 1)
    assert exact(arm.intake)
    moving_again = len(peer.commands) + 10
    drive(arm, lambda: len(peer.commands) >= moving_again)  # a stop is no end
    assert peer.modes[2] == 2


def test_commands_are_accounted_for(in_motion):
    """A hole is a gap in the robot's ticks that we answered; shares are what the robot says."""
    arm, peer = in_motion
    last = quiet(arm, peer)
    arm.command(TAU)
    count = arm.intake.commands
    sent, holes = count.sent, count.holes
    for step, rate in (*[(1, 1.0)] * 100, (1, 0.9), (7, 0.5), (1, 0.9), (1, np.nan), (1, 1.0)):
        last += step
        peer.send(peer.state(last, rate=rate))
        answer(arm)
    assert count.sent - sent == 105
    assert count.holes - holes == 1
    assert count.longest_hole_ms >= 7
    assert count.success_min == pytest.approx(0.5)
    assert 0.9 < count.success_mean < 1.0
    assert arm.intake.as_dict()["commands"]["holes"] == count.holes
    assert "arrived in time" in count.line()
    assert "at worst 50 %" in count.line()


def test_commands_wait_until_the_modes_show_the_motion(peer5, connected):
    arm = connected(peer5, allow_motion=True)
    quiet(arm, peer5)
    arm.command(TAU)
    patiently(lambda: peer5.modes[2] == 2)
    base = peer5.message_id
    for k in range(1, 6):  # the robot has answered, its states still show no motion
        peer5.send(peer5.state(base + k, modes=(0, 3, 1)))
        answer(arm)
    time.sleep(0.1)
    assert peer5.commands == []
    peer5.send(peer5.state(base + 6))
    answer(arm)
    patiently(lambda: peer5.commands)
    assert [message_id for message_id, _, _ in peer5.commands] == [base + 6]


@pytest.mark.parametrize(("first", "sign"), [(True, 1.0), (False, 1.0), (True, -1.0)])
def test_a_command_answers_the_newest_state_with_what_was_accepted_there(
    peer5, connected, first, sign
):
    """The robot is past a state behind which another waits: its id and its torque count."""
    arm = connected(peer5, allow_motion=True)
    moving(arm, peer5, np.full(7, sign * 3.0))  # in steps of 0.99 N m
    base, sent = quiet(arm, peer5), arm.intake.commands.sent
    older, newer = sign * 2 * TORQUE_STEP, sign * 3.0
    peer5.send(peer5.state(base + 1, tau_d=(older,) * 7))
    if first:
        peer5.send(peer5.state(base + 2, tau_d=(newer,) * 7))
        patiently(lambda: waits(arm, base + 2))
    answer(arm, np.full(7, sign * 9.0))
    patiently(lambda: len(peer5.commands) > sent)
    message_id, tau, _ = peer5.commands[sent]
    # A step counts from the command sent last, 3 N m, and from what was accepted.
    accepted = newer if first else older
    assert message_id == base + (2 if first else 1)
    assert tau[0] == pytest.approx(accepted + sign * TORQUE_STEP)


def waits(arm, message_id):
    """Whether the state of this id is the newest that waits."""
    start = arm._connection.reader.newest()
    return start is not None and id_at(arm._connection.reader.data, start) == message_id


def test_stopping_brakes_a_moving_arm(in_motion5):
    arm, peer = in_motion5
    before = len(peer.commands)
    peer.dq = (0.5, -0.5, 0.5, -0.5, 1.0, -1.0, 1.0)
    begin = time.monotonic()
    arm.stop()
    assert time.monotonic() - begin < LIMIT_S
    torques = np.array([tau for _, tau, _ in peer.commands[before:]])
    braking = torques[np.argmax(np.abs(torques).sum(axis=1))]
    assert (np.sign(braking) == -np.sign(peer.dq)).all()
    assert np.abs(np.diff(torques, axis=0)).max() <= 1.0
    assert np.abs(torques[-1]).max() < 1.0
    assert peer.commands[-1][2]


@pytest.mark.parametrize(
    ("statuses", "why"),
    [
        (fci_peer.NOT_POSSIBLE, "refused the motion: it is not possible now: unlock the brakes"),
        (fci_peer.REFLEX, "refused the motion: a reflex stopped the arm"),
        (fci_peer.USER_STOP, "refused the motion: the user stop is pressed"),
        ({5: 4, 10: 6}, "refused the motion: the arm starts in a singular posture"),
        ({5: 0, 10: 0}, "refused the motion: it says that all is done"),
        ({5: 99, 10: 99}, "answers status 99, which is not defined"),
    ],
)
def test_a_refused_motion_says_why(peer, connected, statuses, why):
    arm = connected(peer, allow_motion=True)
    peer.first_status = statuses[peer.protocol]
    with pytest.raises(DriverError, match=why):
        drive(arm, lambda: False)
    with pytest.raises(DriverError, match=why):
        arm.read()
    with pytest.raises(DriverError, match=why):
        arm.command(TAU)
    arm.stop()
    assert peer.commands == []
    arm.read()


def test_a_motion_that_never_starts(peer5, connected, monkeypatch):
    monkeypatch.setattr("drivers.fci.torque_control.START_LIMIT_S", 0.2)
    arm = connected(peer5, allow_motion=True)
    peer5._move = lambda command_id: None
    with pytest.raises(DriverError, match="did not begin to move"):
        drive(arm, lambda: False)


def test_a_reflex_names_its_reason(in_motion):
    arm, peer = in_motion
    peer.end_motion(4, fci_peer.REFLEX[peer.protocol], reflex=(25, 32))
    with pytest.raises(DriverError, match="reflex stopped") as error:
        drive(arm, lambda: False)
    for said in ("communication_constraints_violation", "missed 20 commands", "recover=1"):
        assert said in str(error.value)
    assert "controller_torque_discontinuity" in str(error.value)
    arm.stop()
    assert arm.read().stamp_ns > 0  # it can still be listened to
    with pytest.raises(DriverError, match="no motion: the robot is in reflex"):
        arm.command(TAU)


def test_one_state_with_a_damaged_mode_ends_no_motion(in_motion):
    arm, peer = in_motion
    last = quiet(arm, peer)
    for modes in ((0, 3, 4), peer.modes, (0, 2, 2), peer.modes):  # every other one is damaged
        last += 1
        peer.send(peer.state(last, modes=modes))
        answer(arm)
    for _ in range(2):
        last += 1
        peer.send(peer.state(last, modes=(0, 3, 4)))
        arm.read()
    with pytest.raises(DriverError, match="a reflex stopped the arm"):
        arm.command(TAU)


@pytest.mark.parametrize(
    ("mode", "statuses", "why"),
    [
        (5, fci_peer.USER_STOP, "user stop is pressed: release it"),
        (1, {5: 2, 10: 2}, "was preempted: end the other program"),
        (1, {5: 9, 10: 11}, "it aborted: look at Desk"),
    ],
)
def test_other_ends_of_a_motion(in_motion, mode, statuses, why):
    arm, peer = in_motion
    peer.end_motion(mode, statuses[peer.protocol])
    with pytest.raises(DriverError, match=why):
        drive(arm, lambda: False)


def test_a_reflex_and_a_user_stop_are_notes_while_only_reading(peer5, connected):
    arm = connected(peer5)
    peer5.modes, peer5.reflex = (0, 3, 4), (6,)
    base = quiet(arm, peer5)
    peer5.send(peer5.state(base + 1, modes=(0, 3, 5)))
    arm.read()
    notes = " ".join(arm.intake.notes)
    assert "in reflex" in notes
    assert "joint_reflex (a joint felt a collision" in notes
    assert "user stop pressed" in notes


@pytest.mark.parametrize("silent", [False, True])
def test_a_stop_that_the_finish_flag_does_not_make_goes_over_tcp(in_motion, silent):
    arm, peer = in_motion
    peer.obeys_finish = False
    if silent:
        peer.pause()
    arm.stop()
    assert peer.requests[-1][0] == fci_peer.STOP_MOVE
    assert peer.modes == (0, 3, 1)


def test_a_stop_that_nobody_confirms_ends_and_says_so(in_motion):
    arm, peer = in_motion
    peer.obeys_finish, peer.stop_status = False, None
    begin = time.monotonic()
    with pytest.raises(DriverError, match="press its user stop"):
        arm.stop()
    assert time.monotonic() - begin < LIMIT_S
    arm.stop()


def test_the_connection_cut_in_a_motion(in_motion5):
    arm, peer = in_motion5
    peer.hang_up()
    with pytest.raises(DriverError, match="cut the connection"):
        drive(arm, lambda: False)
    arm.stop()


def test_closing_stops_the_arm(in_motion5):
    arm, peer = in_motion5
    arm.close()
    assert peer.commands[-1][2]
    assert peer.modes == (0, 3, 1)


# Thresholds and load


def settings_of(peer):
    """(name, numbers) of the settings that arrived, in order."""
    names = {fci_peer.SET_COLLISION[peer.protocol]: "collision"}
    names[fci_peer.SET_LOAD[peer.protocol]] = "load"
    return [
        (names[command], struct.unpack(f"<{len(payload) // 8}d", payload))
        for command, payload in peer.requests
        if command in names
    ]


def test_thresholds_and_load_are_set_before_motion_and_put_back(peer, connected):
    peer.load = (1.5, *np.eye(3).ravel(), 0.25, 0.0, 0.125)
    connected(peer).close()
    assert settings_of(peer) == []  # who only listens changes nothing
    arm = connected(peer, "?collision=2&load=0.5,0,0,0.1", allow_motion=True)
    (_, thresholds), (_, load) = settings_of(peer)
    torques, forces = np.reshape(thresholds[:28], (4, 7)), np.reshape(thresholds[28:], (4, 6))
    assert np.array_equal(torques, [[40, 40, 36, 36, 32, 28, 24]] * 4)
    assert np.array_equal(forces, [[40, 40, 40, 50, 50, 50]] * 4)
    assert load[:4] == (0.5, 0.0, 0.0, 0.1)
    assert len(load) == 13
    said = " ".join(arm.intake.notes)
    for part in ("40 40 36 36 32 28 24 N m", "load at its hand is 0.5 kg", "1.5 kg before"):
        assert part in said
    moving(arm, peer)
    arm.close()
    (_, load), (_, thresholds) = settings_of(peer)[2:]
    assert load == (1.5, 0.25, 0.0, 0.125, *np.eye(3).ravel())
    torques, forces = np.reshape(thresholds[:28], (4, 7)), np.reshape(thresholds[28:], (4, 6))
    assert np.array_equal(torques[:, 0], [20, 20, 10, 10])
    assert np.array_equal(forces[:, 5], [20, 20, 10, 10])


def test_settings_can_be_left_alone_and_refused(peer5, connected):
    arm = connected(peer5, "?collision=keep&load=keep", allow_motion=True)
    arm.close()
    assert settings_of(peer5) == []
    assert "as the last client left them" in " ".join(arm.intake.notes)
    peer5.set_status = 1
    with pytest.raises(NotReady, match=r"does not take SetCollisionBehavior.*collision=keep"):
        connected(peer5, allow_motion=True)
    for option, why in (
        ("collision=0", "factor from 0.1 to 5, or keep"),
        ("collision=nan", "factor from 0.1 to 5"),
        ("load=-1", "KG,X,Y,Z"),
        ("load=1,2", "KG,X,Y,Z"),
        ("load=nan,0,0,0", "KG,X,Y,Z"),
    ):
        with pytest.raises(DriverError, match=why):
            FciArm(f"fci://robot?{option}")


# Recovery


def test_motion_from_a_reflex_needs_a_recovery(peer, connected):
    peer.modes, peer.reflex = (0, 3, 4), (6,)
    with pytest.raises(NotReady, match=r"is in reflex: .*\?recover=1"):
        connected(peer, allow_motion=True)
    arm = connected(peer, f"?recover=1&protocol={peer.protocol}", allow_motion=True)
    asked = [command for command, _ in peer.requests]
    assert fci_peer.RECOVER[peer.protocol] in asked
    moving(arm, peer)
    assert exact(arm.intake)


@pytest.mark.parametrize(
    ("statuses", "why"),
    [
        ({5: 2, 10: 3}, "does not recover: the error needs hands"),
        ({5: 4, 10: 5}, "does not recover: the user stop is pressed"),
        ({5: None, 10: None}, "no answer to the error recovery"),
    ],
)
def test_a_recovery_that_fails_says_why(peer, statuses, why, monkeypatch):
    monkeypatch.setattr("drivers.fci.connect.RECOVERY_LIMIT_S", 0.3)
    peer.modes, peer.recover_status = (0, 3, 4), statuses[peer.protocol]
    with pytest.raises(DriverError, match=why):
        FciArm(f"{peer.address}?recover=1").connect()


@pytest.mark.parametrize(
    ("mode", "why"), [(0, "unlock the brakes"), (2, "another program"), (5, "user stop")]
)
def test_motion_needs_an_idle_robot(peer5, connected, mode, why):
    peer5.modes = (0, 3, mode)
    listening = connected(peer5)
    assert listening.read().stamp_ns > 0
    listening.close()
    with pytest.raises(NotReady, match=f"no motion: the robot .*{why}"):
        connected(peer5, allow_motion=True)
