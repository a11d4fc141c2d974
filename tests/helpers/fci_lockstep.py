"""The FCI driver's torque control and the simulated robot in one thread, without sockets or clock.

What goes over the wire is the same bytes: states, commands, requests and replies; only TCP and UDP
are left out. Time is the robot's ticks.
"""

from __future__ import annotations

from typing import cast

import numpy as np

from drivers.fci import codec
from drivers.fci.codec import ReplyParser, State, StateDecoder
from drivers.fci.connect import Channel
from drivers.fci.torque_control import TorqueControl
from drivers.interface import DriverError, Intake, JointSample
from sim.fci.codec import RequestReader, read_command
from sim.fci.robot import Reporter, Robot
from sim.scenarios import Scenario

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
        self.served.arm.close()

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
