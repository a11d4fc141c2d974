"""The same simulated arm behind each driver, one tick at a time and without a clock.

Franka's goes over the same bytes as the wire: states, commands, requests and replies; only TCP and
UDP are left out. Time is the robot's ticks. A CAN arm's is the simulated line's.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any, cast

import numpy as np

from drivers.damiao import holding
from drivers.damiao.arm import DamiaoArm
from drivers.fci import codec, torque_control
from drivers.fci.codec import ReplyParser, State, StateDecoder
from drivers.fci.connect import Channel
from drivers.fci.torque_control import TorqueControl
from drivers.interface import Driver, DriverError, Intake, JointSample, PassedOn
from sim.damiao.server import Boards
from sim.fci.codec import RequestReader, read_command
from sim.fci.robot import Reporter, Robot
from sim.joint_effects import Obstacles
from sim.plant import SimulatedArm
from sim.scenarios import Scenario
from tests.helpers.can_line import Line

VERSION = 5


class FciLockstep:
    """A driver like `FciArm`, one tick of the robot for each read.

    `torque_control` has to be given it in place of `time`, see `lockstep_drivers`.
    """

    paced, can_move, adds_gravity, arrived_ns = False, True, True, 0
    delay_ns = period_ns = 1_000_000
    link_names: tuple[str, ...] = ()
    closed = False  # of the channel, which never is

    def __init__(self, scenario: Scenario) -> None:
        self.joint_names = scenario.truth.joint_names
        self.intake = Intake()
        self.served = Robot(scenario, VERSION)
        self._reporter, self._decoder = Reporter(self.served), StateDecoder(VERSION)
        self._reporter.refresh()
        self._requests, self._parser = RequestReader(VERSION), ReplyParser()
        self._replies: dict[int, bytes] = {}
        self._id, self._asked = 0, 0
        self._sent: bytes | None = None
        self._state: State | None = None
        self._control = TorqueControl(VERSION, cast(Channel, self), self._keep)

    def monotonic(self) -> float:
        """The robot's time, s: in place of this machine's."""
        return 1e-3 * self._id

    def connect(self) -> None:
        pass

    def read(self) -> JointSample:
        if self._control.fault is not None:
            raise DriverError(self._control.fault)
        state = self._tick()
        if self._control.active:
            self._control.look(state)
        return JointSample(state.message_id * 1_000_000, state.q, state.dq, state.tau_J)

    def command(self, tau: np.ndarray) -> None:
        state = self._state
        assert state is not None
        self._control.command(tau, state, state.message_id, state.tau_J_d)

    def stop(self) -> None:
        self._control.stop(lambda wait_s: self._tick())

    def close(self) -> None:
        self.served.arm.plant.close()

    def _keep(self, datagram: bytearray) -> None:
        self._sent = bytes(datagram)

    def _tick(self) -> State:
        sent, self._sent = self._sent, None
        self.served.tick(None if sent is None else read_command(sent, VERSION))
        self._id += 1
        self._reporter.fill(self._id)
        for said in self.served.take_replies():
            self._take_reply(said)
        data = memoryview(bytes(self._reporter.frame.data))
        self._state = self._decoder.decode(data, 0, len(data))
        return self._state

    def _take_reply(self, said: bytes) -> None:
        for found in self._parser.feed(said):
            self._replies[found.command_id] = found.payload

    # the channel of TorqueControl

    def send(self, command: int, payload: bytes = b"") -> int:
        self._asked += 1
        for asked in self._requests.feed(codec.request(command, self._asked, payload)):
            said = self.served.request(asked)
            if said is not None:
                self._take_reply(said)
        return self._asked

    def poll(self) -> None:
        pass

    def take(self, command_id: int) -> bytes | None:
        return self._replies.pop(command_id, None)

    def wait(self, command_id: int, limit_s: float) -> bytes | None:
        for _ in range(round(1e3 * limit_s)):
            if command_id in self._replies:
                break
            self._tick()
        return self.take(command_id)


SETTLE_TICKS = 300  # the motors take the arm over from its stand


class Lockstep(PassedOn):
    """A driver whose clock is the line's: each `read` lets one period of virtual time pass.

    Args:
        driver: built on `line.host` with the clock `line.now_ns`.
        line: with the boards attached.
    """

    paced = False
    arrived_ns = 0

    def __init__(self, driver: Driver, line: Line) -> None:
        super().__init__(driver)
        self._line, self._next_ns = line, 0

    def connect(self) -> None:
        """Connect and let the arm come to rest in its motors. Raises DriverError."""
        with self._line.eager():
            self.driver.connect()
        self._next_ns = self._line.next_whole_ns(self.period_ns)
        for _ in range(SETTLE_TICKS):
            self.read()

    def read(self) -> JointSample:
        """The next sample. Raises DriverError."""
        self._line.advance_to(self._next_ns)
        self._next_ns += self.period_ns
        return self.driver.read()

    def stop(self) -> None:
        """Bring the arm to a stand. Raises DriverError."""
        with self._line.eager():
            self.driver.stop()
        self._next_ns = self._line.next_whole_ns(self.period_ns)  # it took a while

    def close(self) -> None:
        """Release the driver."""
        with self._line.eager():
            self.driver.close()

    def sleep(self, seconds: float) -> None:
        """Let the line's time pass, in place of this machine's."""
        self._line.advance_to(self._line.now_ns() + int(1e9 * seconds))


def on_line(world: Scenario) -> tuple[Lockstep, Boards]:
    """An arm that may move behind Damiao motors on a line of its own, and the motors' boards."""
    line = Line()
    boards = Boards(line.boards, world, now_ns=line.now_ns)
    line.attach(boards)
    clocks = {"now_ns": line.now_ns, "wall_ns": line.now_ns}
    address, names = "can://line?interface=virtual", world.truth.joint_names
    return Lockstep(DamiaoArm(address, names, True, bus=line.host, **clocks), line), boards


# When a motion can begin, by the plant's time: motors of a CAN arm are switched on and settle
# first, 1.35 to 1.5 s here.
BEGINS_S = {"sim": 0.0, "fci": 0.0, "can": 1.6}
# The same with 4 to 8 kg at the hand: a CAN arm uses up all of the 5 s that it may settle in.
BEGINS_LOADED_S = {**BEGINS_S, "can": 6.4}
LET_GO = 150  # readings after a stop in which it comes to that; ms


@contextmanager
def opened(name: str, world: Scenario) -> Iterator[tuple[Driver, Obstacles]]:
    """The driver, not connected yet, and what is in the way of its arm; closed afterwards."""
    with ExitStack() as after:
        if name == "sim":
            plant = world.plant()
            driver: Driver = SimulatedArm(plant)
            obstacles = plant._engine.obstacles
        elif name == "fci":
            driver = robot = FciLockstep(world)
            obstacles = robot.served.arm.plant._engine.obstacles
            after.enter_context(in_place_of_time(torque_control, robot))
        else:
            driver, boards = on_line(world)
            after.callback(boards.close)
            obstacles = boards.world._engine.obstacles
            after.enter_context(in_place_of_time(holding, driver))
        after.callback(driver.close)
        yield driver, obstacles


@contextmanager
def in_place_of_time(module: ModuleType, clock: Any) -> Iterator[None]:
    """Let one module have this clock where it asks `time`; its own again afterwards."""
    own = vars(module)["time"]
    vars(module)["time"] = clock
    try:
        yield
    finally:
        vars(module)["time"] = own
