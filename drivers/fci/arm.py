"""A Franka Panda/FER or FR3 as a driver: states at 1 kHz, and torques where allowed."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence

import numpy as np

from drivers.fci import tables
from drivers.fci.codec import JOINTS, State, Status
from drivers.fci.connect import Connection, open_connection, parse, recover
from drivers.fci.reader_client import QUICK_SWITCHING
from drivers.fci.safeguards import Load, RobotSettings
from drivers.fci.safeguards import parse as parse_safeguards
from drivers.fci.stream import STALE_NS, TICK_NS, Refusal, StateIntake, StateStream
from drivers.fci.tables import told
from drivers.fci.torque_control import TorqueControl
from drivers.interface import Array, DriverError, Intake, JointSample, NotReady, checked_torques

_ROBOTS = {tables.PANDA: "panda", tables.FR3: "fr3"}
_NAMES = {
    version: tuple(f"{robot}_joint{i}" for i in range(1, JOINTS + 1))
    for version, robot in _ROBOTS.items()
}


class FciArm:
    """Driver of a robot with the Franka Control Interface.

    States are received by a process of its own (`drivers.fci.reader`), so that other threads
    here cost none; while connected, the interpreter's switch interval is short for the same
    reason. Stamps are the robot's ticks: `message_id` milliseconds. Every datagram is accounted
    for in `intake`: ids that are missing are lost, whatever arrived and was not used is refused
    by a reason.

    Commands need `allow_motion`. The first one asks the robot for a motion; until the robot
    shows that it runs, commands are kept back. After a motion ended by itself, `read` and
    `command` say why until `stop` is called. If this process dies, the robot stops by itself
    after 20 missing commands.

    With `allow_motion`, `connect` sets collision thresholds and the load at the hand
    (`drivers.fci.safeguards`), and `close` puts back the load that was there and Franka's default
    thresholds; the robot does not tell those it had.

    Args:
        address: `fci://HOST[:PORT][?protocol=5|10|auto&recover=1&collision=1&load=KG,X,Y,Z]`.
        joint_names: 7 names; by default panda_joint1 to 7, or fr3_joint1 to 7 where the address
            or, at `connect`, the robot says protocol 10.
        allow_motion: whether commands may be sent.

    Attributes:
        version: of the protocol, once connected; None before.

    Raises:
        DriverError: the address is not understood, or there are not 7 names.
    """

    paced = True
    adds_gravity = True
    delay_ns = 1_000_000  # a command counts from the next tick on
    period_ns = TICK_NS
    link_names: tuple[str, ...] = ()

    def __init__(
        self, address: str, joint_names: Sequence[str] | None = None, allow_motion: bool = False
    ) -> None:
        self._target = parse(address)
        self._safeguards = parse_safeguards(address, self._target.options)
        self._named = joint_names is not None
        names = _NAMES[self._target.version or tables.PANDA] if joint_names is None else joint_names
        self.joint_names: tuple[str, ...] = tuple(names)
        if len(self.joint_names) != JOINTS:
            raise DriverError(
                f"the robot has {JOINTS} joints, got {len(self.joint_names)} names "
                f"({', '.join(self.joint_names)}); leave out (--joints) what it does not have"
            )
        self.can_move = allow_motion
        self.version: int | None = None
        self.arrived_ns = 0
        self._account = StateIntake()
        self.intake: Intake = self._account.intake
        self._connection: Connection | None = None
        self._stream: StateStream | None = None
        self._control: TorqueControl | None = None
        self._settings: RobotSettings | None = None
        self._first: State | None = None  # read by connect, not handed out yet
        self._state: State | None = None

    @property
    def robot(self) -> str:
        """Name of the robot that this is; empty before it is connected."""
        return "" if self.version is None else _ROBOTS[self.version]

    @property
    def kernel_drops(self) -> int:
        """Datagrams that the operating system dropped; part of `intake.lost`."""
        return self._account.kernel_drops

    def connect(self) -> None:
        """Open the connection and wait for a state; an open one is closed before.

        Raises DriverError, which says what to do; NotReady where motion is allowed and the robot
        is there but cannot move now.
        """
        self.close()
        self._account, self._state = StateIntake(), None
        self.intake = self._account.intake
        connection = self._connection = open_connection(self._target)
        QUICK_SWITCHING.begin()
        try:
            stream = self._stream = StateStream(connection, self._account)
            self._control = TorqueControl(connection.version, connection.channel, stream.send)
            self._first = self._make_ready(stream)
            if self.can_move:
                mass, *rest = stream.load().tolist()
                former = Load(mass, np.array(rest[9:]), np.array(rest[:9]))
                channel, wanted = connection.channel, self._safeguards
                self._settings = RobotSettings(connection.version, channel, wanted)
                self.intake.note("settings", self._settings.apply(former))
                self.intake.commands = self._control.count
        except BaseException:
            self.close()
            raise
        self.arrived_ns = stream.arrived_ns
        self.version = connection.version
        if not self._named:
            self.joint_names = _NAMES[connection.version]

    def read(self) -> JointSample:
        """The next state's sample; waits for it, a second at most. Raises DriverError."""
        stream, motion = self._need_open()
        if motion.fault is not None:
            raise DriverError(motion.fault)
        state, self._first = self._first, None  # that of connect, unless it waited for too long
        if state is not None and time.monotonic_ns() - self.arrived_ns > STALE_NS:
            self.intake.refused[Refusal.STALE] += 1
            state = None
        state = state or _next_of(stream)
        self.intake.used += 1
        self.arrived_ns = stream.arrived_ns
        if motion.active:
            motion.look(state)
        elif self._state is None or state.status is not self._state.status:
            self._note_status(state.status)
        self._state = state
        return JointSample(state.message_id * TICK_NS, state.q, state.dq, state.tau_J)

    def command(self, tau: Array) -> None:
        """Answer the state read last with (7,) N m on top of the arm's weight and friction.

        Torques and their steps are cut at the robot's limits. Raises DriverError.
        """
        stream, motion = self._need_open()
        if not self.can_move:
            raise DriverError("this robot is only listened to; motion needs --allow-motion")
        tau = checked_torques(tau, JOINTS)
        state = self._state
        if state is None:
            raise DriverError("no state was read yet; a command answers one")
        motion.command(tau, state, *stream.answered(state))

    def stop(self) -> None:
        """Brake the arm and end the motion, if there is one. Raises DriverError."""
        if self._control is not None:
            self._control.stop(self._state_while_stopping)

    def close(self) -> None:
        """Stop, then release everything; may be called more than once."""
        connection, motion = self._connection, self._control
        if connection is None:
            return
        try:
            if motion is not None and motion.active:
                self.stop()
            if self._settings is not None:
                self._settings.restore()
        except DriverError as error:
            self.intake.note("close", str(error))
        finally:
            self._connection = self._stream = self._control = self._first = self._settings = None
            connection.close()
            QUICK_SWITCHING.end()

    def _need_open(self) -> tuple[StateStream, TorqueControl]:
        if self._stream is None or self._control is None:
            raise DriverError(f"{self._target.host}: not connected; call connect first")
        return self._stream, self._control

    def _make_ready(self, stream: StateStream) -> State:
        """The first state, after a recovery where that was asked for. Raises DriverError."""
        state = _next_of(stream)
        if state.status.robot_mode == tables.ROBOT_REFLEX and self._target.recover:
            assert self._connection is not None
            recover(self._connection)
            deadline = time.monotonic() + 3.0  # s
            while state.status.robot_mode in (tables.ROBOT_REFLEX, tables.ROBOT_RECOVERY):
                if time.monotonic() > deadline:
                    raise NotReady(
                        f"the robot {tables.ROBOT_MODE_MEANING[state.status.robot_mode]}: it said "
                        "that it recovered, but does not show it"
                    )
                self.intake.refused[Refusal.RECOVERING] += 1
                state = _next_of(stream)
        self._note_status(state.status)
        mode = state.status.robot_mode
        if self.can_move and mode != tables.ROBOT_IDLE:
            raise NotReady(f"no motion: the robot {tables.ROBOT_MODE_MEANING[mode]}")
        return state

    def _state_while_stopping(self, wait_s: float) -> State | None:
        """The newest state there is."""
        stream = self._need_open()[0]
        with contextlib.suppress(DriverError):  # the motion is then ended over TCP
            while (state := stream.next(wait_s)) is not None:
                self.intake.refused[Refusal.STOPPING] += 1
                self._state = state
                if not stream.behind:
                    return state
        return None

    def _note_status(self, status: Status) -> None:
        """While only listening, a robot that cannot move is worth a sentence, not an end."""
        mode = status.robot_mode
        if mode in (tables.ROBOT_REFLEX, tables.ROBOT_USER_STOP):
            why = f" ({told(status.reflex_reason)})" if any(status.reflex_reason) else ""
            sentence = f"the robot {tables.ROBOT_MODE_MEANING[mode]}{why}"
            self.intake.note(f"mode {mode}", sentence)


def _next_of(stream: StateStream) -> State:
    """The next state. Raises DriverError where none comes in time."""
    state = stream.next(1.0)  # s, as Franka's own client
    if state is None:
        raise DriverError(stream.silence())
    return state
