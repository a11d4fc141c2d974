"""Simulated hardware for the contract, each behind its real wire: FCI server, CAN boards, DDS."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import numpy as np

from drivers.damiao.arm import DamiaoArm
from drivers.fci.arm import FciArm
from drivers.interface import Driver, JointSample
from drivers.ros2.arm import Ros2Arm
from sim.scenarios import build
from tests.helpers.board_tools import free_port
from tests.helpers.contract_suite import Start
from tests.helpers.lockstep_drivers import Lockstep, on_line

SERVE = "-m", "adapter", "sim"
PANDA_JOINTS = tuple(f"panda_joint{j}" for j in range(1, 8))

# Of a simulated robot with a process that this machine holds up; less than the second after which
# a driver gives up that waits for a state, as one does that lost the state it owes an answer to.
PATIENCE_S = "0.5"


class OnTime:
    """A driver that does not pace itself, read once a period as the loop does."""

    def __init__(self, driver) -> None:
        self._driver, self._due_s = driver, 0.0

    def __getattr__(self, name: str):
        return getattr(self._driver, name)

    def read(self) -> JointSample:
        """Wait for the tick, then read."""
        now_s = time.monotonic()
        time.sleep(max(0.0, self._due_s - now_s))
        self._due_s = max(self._due_s, now_s) + 1e-9 * self._driver.period_ns
        return self._driver.read()


@contextmanager
def process(*command: str) -> Iterator[str]:
    """A server in a process of its own; gives the line it says when it is ready."""
    with subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            yield server.stdout.readline()
        finally:
            server.terminate()
            try:
                server.communicate(timeout=10.0)
            except subprocess.TimeoutExpired:
                server.kill()


@contextmanager
def one_at_a_time(new: Callable[[], Driver]) -> Iterator[Start]:
    """Makes drivers of an arm that serves one client at a time, closed whatever happens."""
    arms: list[Driver] = []

    def make() -> Driver:
        for arm in arms:
            arm.close()
        arms.append(new())
        return arms[-1]

    try:
        yield make
    finally:
        for arm in arms:
            arm.stop()
            arm.close()


def fci_address(line: str) -> str:
    """Of the simulated robot that says in this line that it is ready."""
    return next(word for word in line.split() if word.startswith("fci:"))


@contextmanager
def fci(protocol: int, allow_motion: bool) -> Iterator[Start]:
    """The FCI server of one protocol, and drivers that may move it or not."""
    options = ["--port", "0", "--protocol", str(protocol), "--patience", PATIENCE_S]
    with process(*SERVE, "fci", *options) as line:
        address = f"{fci_address(line)}?recover=1"
        with one_at_a_time(lambda: FciArm(address, allow_motion=allow_motion)) as make:
            yield make


@contextmanager
def can_multicast() -> Iterator[Start]:
    """Boards in a process of their own, on UDP multicast."""
    options = ["--interface", "udp_multicast", "--port", str(free_port())]
    with process(*SERVE, "can", *options) as line:
        address = line.split()[-1]
        with one_at_a_time(lambda: OnTime(DamiaoArm(address, allow_motion=True))) as make:
            yield make


@contextmanager
def can_line() -> Iterator[Start]:
    """Boards in this process on a line in virtual time, where every bit takes what it takes."""
    scenario = build("nominal")
    with ExitStack() as stack:

        def make() -> Lockstep:
            arm, boards = on_line(scenario)
            stack.callback(boards.close)
            return arm

        yield make


@contextmanager
def ros2(allow_motion: bool) -> Iterator[Start]:
    """An arm behind ros2_control in a process of its own, on DDS over loopback."""
    with (
        ros2_arm() as address,
        one_at_a_time(lambda: Ros2Arm(address, PANDA_JOINTS, allow_motion)) as make,
    ):
        yield make


@contextmanager
def ros2_arm(*options: str) -> Iterator[str]:
    """`adapter sim ros2` with these options in a domain of its own; gives its address."""
    with process(*SERVE, "ros2", "--domain", str(free_domain()), *options) as line:
        yield line.split()[-1]


def free_domain() -> int:
    """A DDS domain that nobody on this machine uses: its first participant's port is free."""
    for domain in np.random.default_rng().permutation(np.arange(60, 200)).tolist():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", 7410 + 250 * domain))
            except OSError:
                continue
            return int(domain)
    raise RuntimeError("no DDS domain is free")
