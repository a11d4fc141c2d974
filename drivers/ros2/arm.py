"""An arm that ros2_control drives, over DDS: joint states in, efforts out.

Such an arm has no watch over its commands: `effort_controllers/JointGroupEffortController` goes on
with the last torque for ever. The bridge, a process of the driver's, brakes and holds the arm when
commands stay away for 50 ms or the loop's process is gone. When the network between the bridge and
the arm is cut, nobody brakes: an arm whose own drives have no time-out needs somebody at its
emergency stop.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import subprocess
import tempfile
import time
from collections.abc import Sequence
from typing import IO, Any

import numpy as np

from drivers.interface import Array, CommandCount, DriverError, Intake, JointSample, checked_torques
from drivers.process import start_module
from drivers.ros2.bridge import BRAKES, Start
from drivers.ros2.memory import SLOTS, Asked, Doing, Memory, Refusal
from drivers.ros2.settings import EXAMPLE, parse

READY_S, STOP_S, END_S = 60.0, 3.0, 2.0
NOTES = {
    Refusal.UNREADABLE: "joint states come that cannot be read; is it another type that is sent?",
    Refusal.OTHER_JOINTS: "joint states of other joints come on the same topic; they are left out",
    Refusal.INCOMPLETE: "joint states come without velocities or efforts; they are left out",
    Refusal.NOT_FINITE: "joint states come with numbers that are none (NaN); they are left out",
    Refusal.JUMP: "joint states come that are further on than a joint moves; they are left out",
    Refusal.OLD: "joint states come with stamps that do not go on; are there two publishers?",
    Refusal.OVERTAKEN: "joint states came faster than they were read; the oldest are left out",
}


class Ros2Arm:
    """Driver of an arm behind ros2_control, by DDS alone.

    Args:
        address: `ros2:///joint_states[?command=/effort_controller/commands&domain=0&local=1
            &hz=1000&joints=A,B&effort=87,87&gravity=1&timeout_ms=200]`; see `settings`.
        joint_names: the joints, in the order of every array; those of the address where None.
        allow_motion: whether commands may be sent.

    Raises:
        DriverError: the address is not understood, or its joints are others.
    """

    paced = True
    link_names: tuple[str, ...] = ()

    def __init__(
        self, address: str, joint_names: Sequence[str] | None = None, allow_motion: bool = False
    ) -> None:
        self._address, self._settings = address, parse(address)
        where = self._settings
        names = tuple(joint_names or where.joints)
        if not names:
            raise DriverError(f"'{address}': which joints? name a robot, or joints=A,B,... here")
        if where.joints and {*where.joints} != {*names}:
            raise DriverError(
                f"'{address}': joints={','.join(where.joints)} are not those of the robot: "
                f"{', '.join(names)}"
            )
        if allow_motion and not where.command:
            raise DriverError(f"'{address}': motion needs command=TOPIC, as in {EXAMPLE}")
        self.joint_names: tuple[str, ...] = names
        self.can_move = allow_motion
        self.adds_gravity = where.gravity
        self.period_ns = round(1e9 / where.hz)
        self.delay_ns = self.period_ns + 1_000_000  # of a command, from here to the controller
        self.intake, self.arrived_ns = Intake(), 0
        self._bridge: _Process | None = None
        self._driving, self._fault = False, ""

    def connect(self) -> None:
        """Start the bridge and wait until it hears the arm. Raises DriverError."""
        self.close()
        self.intake, self.arrived_ns = Intake(), 0
        if self.can_move:
            self.intake.commands = CommandCount()
        self._driving, self._fault = False, ""
        self._bridge = self._started()
        self._stamp_ns = 0

    def _started(self, rescue: bool = False) -> _Process:
        """A new bridge; samples and counts begin with what it hears from now on."""
        bridge = _Process(self._address, self.joint_names, (self.can_move, rescue))
        try:
            told = bridge.first_word(READY_S)
            if "ready" not in told:
                raise DriverError(str(told.get("fault") or bridge.last_words()))
            self._effort = np.array(told["effort"])
        except BaseException:
            bridge.end(0.0)
            raise
        self._next = bridge.memory.words.head
        self._ignored = bridge.memory.words.refused[:]
        return bridge

    def read(self) -> JointSample:
        """The next joint state; waits for it. Raises DriverError."""
        bridge = self._open()
        deadline = time.monotonic() + self._settings.timeout_s
        while bridge.memory.words.head <= self._next:
            self._listen(bridge)
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                raise DriverError(
                    f"{self._settings.states} has been silent for {self._settings.timeout_s} s; is "
                    "joint_state_broadcaster active, is the network up? connect again"
                )
            bridge.wait(left_s)
        self._listen(bridge)
        behind = bridge.memory.words.head - self._next - (SLOTS - 8)
        if behind > 0:
            self._next += behind
            self.intake.refused[Refusal.OVERTAKEN.name.lower()] += behind
            if self._driving:  # before that it only says that somebody took a while to begin
                self.intake.note(Refusal.OVERTAKEN.name, NOTES[Refusal.OVERTAKEN])
        stamp_ns, self.arrived_ns, values = bridge.memory.state(self._next)
        self._next += 1
        self._count(bridge, stamp_ns)
        q, dq, tau = (row.copy() for row in values)
        return JointSample(stamp_ns, q, dq, tau)

    def command(self, tau: Array) -> None:
        """Ask for (n,) N m, cut at the joints' limits. Raises DriverError."""
        bridge = self._open()
        if not self.can_move:
            raise DriverError("this arm is only listened to; motion needs --allow-motion")
        wanted = checked_torques(tau, len(self.joint_names))
        self._listen(bridge)
        cut = np.clip(wanted, -self._effort, self._effort)
        count = self.intake.commands
        assert count is not None
        count.cut += int(not np.array_equal(cut, wanted))
        count.sent += 1
        if not self._driving:
            self._driving = True
            bridge.memory.words.asked = Asked.DRIVE
        bridge.memory.put_command(cut, time.monotonic_ns())
        bridge.nudge()

    def stop(self) -> None:
        """Have the arm braked, and wait until it holds its place, 3 s at most."""
        bridge = self._bridge
        if bridge is None or not self._driving:
            return
        if not bridge.alive:  # a new one in its place
            bridge.end(0.0)
            with contextlib.suppress(DriverError):
                bridge = self._bridge = self._started(rescue=True)
        bridge.memory.words.asked = Asked.BRAKE
        end = time.monotonic() + STOP_S
        while (
            bridge.alive and bridge.memory.words.doing != Doing.HOLDING and time.monotonic() < end
        ):
            if bridge.memory.words.doing not in (*BRAKES, Doing.DRIVING):
                break  # no command of ours was sent yet
            time.sleep(0.002)  # s
        self._driving, self._fault = False, ""

    def close(self) -> None:
        """Stop, then end the bridge. The controller goes on with the torques that hold the arm."""
        bridge = self._bridge
        if bridge is None:
            return
        try:
            self.stop()
        finally:
            bridge, self._bridge = self._bridge, None
            assert bridge is not None
            bridge.memory.words.asked = Asked.LISTEN
            bridge.end(END_S)

    def _open(self) -> _Process:
        if self._bridge is None:
            raise DriverError(f"{self._settings.states}: not connected; call connect first")
        if not self._bridge.alive:
            self._fault = f"the bridge to DDS ended: {self._bridge.last_words()}; connect again"
        if self._fault:
            raise DriverError(self._fault)
        return self._bridge

    def _listen(self, bridge: _Process) -> None:
        """What the bridge has to say. Raises DriverError for a fault."""
        for told in bridge.said():
            self._fault = str(told.get("fault", self._fault))
        self._open()

    def _count(self, bridge: _Process, stamp_ns: int) -> None:
        intake = self.intake
        intake.used += 1
        for why in Refusal:
            refused = bridge.memory.words.refused[why] - self._ignored[why]
            if why != Refusal.OVERTAKEN and refused:
                intake.note(why.name, NOTES[why])
                intake.refused[why.name.lower()] = refused
        intake.received = intake.used + sum(intake.refused.values())
        if self._stamp_ns:
            periods = (stamp_ns - self._stamp_ns) / self.period_ns
            intake.lost += max(math.floor(periods + 0.5) - 1, 0)
        self._stamp_ns = stamp_ns


class _Process:
    """The bridge from the driver's side.

    Attributes:
        pid: of the process.
        alive: it runs; costs no system call while it has not closed its output.
    """

    def __init__(self, address: str, joints: tuple[str, ...], leave: tuple[bool, bool]) -> None:
        self.memory = Memory(len(joints))
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._nudge = os.eventfd(0, os.EFD_CLOEXEC)
        filenos = self.memory.fileno, self._wake, self._nudge
        self._complaints: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = start_module(
            "drivers.ros2.bridge",
            json.dumps(Start(address, joints, *leave, *filenos)),
            filenos,
            stdin=subprocess.PIPE,
            stderr=self._complaints,
        )
        os.close(self.memory.fileno)
        assert self._process.stdout is not None
        self._out = self._process.stdout.fileno()
        os.set_blocking(self._out, False)
        self._rest = b""
        self.pid, self.alive = self._process.pid, True

    def first_word(self, timeout_s: float) -> dict[str, Any]:
        """What it says first; empty where it ends, or says nothing in time."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end and self.alive:
            select.select([self._out], [], [], max(end - time.monotonic(), 0.0))
            for told in self.said():
                return told
        return {}

    def said(self) -> list[dict[str, Any]]:
        """What it said since the last look."""
        try:
            data = os.read(self._out, 65536)
        except BlockingIOError:
            return []
        self.alive = self.alive and bool(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines]

    def wait(self, timeout_s: float) -> None:
        """Until there is a state, or it has something to say."""
        ready, _, _ = select.select([self._wake, self._out], [], [], timeout_s)
        if self._wake in ready:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._wake)

    def nudge(self) -> None:
        """There is a command."""
        os.eventfd_write(self._nudge, 1)

    def last_words(self) -> str:
        """Why it ended, as far as it says; one line."""
        self._complaints.seek(0)
        lines = self._complaints.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"

    def end(self, timeout_s: float) -> None:
        """Let it go, and end it where it does not."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._complaints.close()
        for fileno in (self._wake, self._nudge):
            os.close(fileno)
