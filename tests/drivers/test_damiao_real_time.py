"""The CAN arm's driver and its guardian in real time, on real python-can buses."""

import itertools
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager, suppress

import can
import numpy as np
import pytest

from drivers.damiao.arm import DamiaoArm
from tests.helpers.damiao_tools import Bank, Served
from tests.helpers.live_tools import wait_for
from tests.helpers.patience import connect, gone

pytestmark = pytest.mark.alone

N = 7


def socketcan_reason():
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        socket.if_nametoindex("vcan0")
    except (OSError, AttributeError) as error:
        return f"no vcan0 on this kernel: {error}"
    return None


@pytest.mark.skipif(socketcan_reason() is not None, reason=str(socketcan_reason()))
def test_on_vcan():
    with Served(Bank(), can.Bus("vcan0", interface="socketcan", fd=True)):
        arm = DamiaoArm("can://vcan0?guardian=0&rate=200", allow_motion=True)
        connect(arm)
        for _ in range(50):
            arm.read()
            arm.command(np.full(N, 2.0))
            time.sleep(0.005)
        arm.close()
    assert arm.intake.used > 20 * N


GROUP = "239.74.163.2"
PORTS = itertools.count(46000 + os.getpid() % 2000 * 5)


def multicast_reason():
    try:
        with can.Bus(GROUP, interface="udp_multicast", port=45999, hop_limit=0) as bus:
            bus.send(can.Message(arbitration_id=1, is_extended_id=False))
            return None if bus.recv(2.0) else "multicast frames do not come back on this machine"
    except (OSError, can.CanError) as error:
        return f"no multicast on this machine: {error}"


needs_multicast = pytest.mark.skipif(multicast_reason() is not None, reason=str(multicast_reason()))


@pytest.fixture
def served():
    """(address, motors) between processes."""
    port = next(PORTS)
    bank = Bank()
    with Served(bank, can.Bus(GROUP, interface="udp_multicast", port=port, hop_limit=0)):
        yield f"can://{GROUP}:{port}?interface=udp_multicast&rate=200", bank


BEGIN = """
import sys, time
import numpy as np
from drivers.damiao.arm import DamiaoArm
from tests.helpers.patience import connect
arm = DamiaoArm(sys.argv[1], allow_motion=True)
connect(arm)
print(arm._guardian.pid, flush=True)
"""
LOOP = f"""{BEGIN}
while True:
    sample = arm.read()
    arm.command(np.where(sample.dq < 0.4, 2.4, 1.95))
    if sys.argv[2] == "hang" and sample.dq.min() > 0.3:
        time.sleep(1e6)
    time.sleep(0.005)
"""


def ended(pid):
    """Wait for the end of a process; make sure of it."""
    try:
        assert wait_for(lambda: gone(pid)), "the guardian ends"
    finally:
        if not gone(pid):
            os.kill(pid, signal.SIGKILL)


DISOBEYS = f"""{BEGIN}
arm._need_leave = lambda: None
while True:
    sample = arm.read()
    arm.carry(np.full(7, 2.0))
    arm.command(np.where(np.arange(7) == 1, 50.0, 2.0 - 0.5 * sample.dq))
    time.sleep(0.005)
"""


@contextmanager
def driving(*words):
    """A loop in a process of its own, and the number of its guardian's; both end here."""
    command = [sys.executable, "-c", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as loop:
        guardian = int(loop.stdout.readline())
        try:
            yield loop, guardian
        finally:
            loop.kill()
            loop.wait()
            with suppress(ProcessLookupError):
                os.kill(guardian, signal.SIGTERM)
            ended(guardian)


@needs_multicast
def test_the_guardian_ends_a_loop_that_pushes_a_held_arm_and_does_not_stop(served, capfd):
    """The push is the whole of what joint 2 can: some 50 ms of it in a loop of 200 Hz."""
    address, bank = served
    bank.held[1] = True
    pushed_s, take = [], bank._take

    def note(j, word):
        take(j, word)
        if j == 1 and bank.command[1][4] > 45.0:
            pushed_s.append(time.monotonic())

    bank._take = note
    with driving(DISOBEYS, address) as (loop, _):
        assert wait_for(lambda: pushed_s), "the loop pushes"
        assert wait_for(lambda: abs(bank.command[1][4]) < 5.0), "the guardian brakes the arm"
        assert loop.wait(10.0) == -signal.SIGKILL
        time.sleep(0.6)
        assert abs(bank.command[1][4]) < 5.0 and bank.status == [1] * N and not bank.limp
        assert np.abs(bank.dq).max() < 0.02
    said = capfd.readouterr().err
    assert "joint 2 (joint2) is pushed with +48.0 N m (limit 40.5 N m)" in said
    assert "goes on driving; it is ended" in said and "braked and held" in said
    print(f"pushed for {pushed_s[-1] - pushed_s[0]:.3f} s")
    assert pushed_s[-1] - pushed_s[0] < 0.3  # on a busy machine, too


@needs_multicast
@pytest.mark.parametrize("how", ["kill", "hang"])
def test_the_guardian_brakes_and_holds_when_the_loop_dies(served, how, capfd):
    address, bank = served
    with driving(LOOP, address, how) as (loop, guardian):
        assert wait_for(lambda: bank.dq.min() > 0.3), "the loop drives the arm"
        q0 = bank.q.copy()
        if how == "kill":
            loop.send_signal(signal.SIGKILL)
            loop.wait()
        assert wait_for(lambda: np.abs(bank.dq).max() < 0.02), "the guardian brakes the arm"
        time.sleep(0.5)
        assert (np.abs(bank.q - q0) < 0.5).all()
        q1 = bank.q.copy()
        time.sleep(0.6)
        assert np.abs(bank.q - q1).max() < 0.02
        assert not bank.limp
        assert bank.status == [1] * N
        os.kill(guardian, signal.SIGTERM)  # the operator has put something under the arm
        assert wait_for(lambda: bank.status == [0] * N), "the motors are switched off"
    assert "braked and held" in capfd.readouterr().err


@needs_multicast
def test_a_new_driver_takes_the_arm_over_from_the_guardian(served):
    address, bank = served
    arm = DamiaoArm(address, allow_motion=True)
    connect(arm)
    first = arm._guardian.pid
    assert any(f"kill {first}" in note for note in arm.intake.notes)
    for _ in range(100):
        arm.read()
        arm.command(np.full(N, 2.0))
        time.sleep(0.005)
    arm.close()
    assert not gone(first)
    q0 = bank.q.copy()
    time.sleep(1.1)  # two of the motors' time-outs
    assert bank.status == [1] * N
    listener = DamiaoArm(address)
    connect(listener)
    assert any(f"process {first} holds" in note for note in listener.intake.notes)
    assert np.isfinite(listener.read().q).all()
    listener.close()
    connect(arm)
    second = arm._guardian.pid
    assert second != first
    assert wait_for(lambda: gone(first)), "the first guardian goes"
    time.sleep(0.5)
    assert np.abs(bank.q - q0).max() < 0.05
    assert not bank.limp
    arm.close()
    os.kill(second, signal.SIGTERM)
    assert wait_for(lambda: gone(second)), "the second guardian ends"


@needs_multicast
def test_garbage_between_processes_is_counted(served):
    address, _ = served
    port = int(address.split(":")[2].split("?")[0])
    arm = DamiaoArm(address + "&guardian=0", allow_motion=True)
    connect(arm)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for k in range(100):
            sender.sendto(bytes(range(k)), (GROUP, port))
            if k % 10 == 0:
                arm.read()
                arm.command(np.full(N, 2.0))
    assert wait_for(lambda: (arm.read(), arm.intake.refused["unreadable"] == 100)[1]), (
        "all were seen"
    )
    arm.close()
    intake = arm.intake
    assert intake.received == intake.used + sum(intake.refused.values())
