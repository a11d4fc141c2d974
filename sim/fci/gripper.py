"""A simulated Franka Hand: requests over TCP, states over UDP, as libfranka's Gripper wants them.

Layouts and codes of version 3 of the gripper's protocol: libfranka-common (Apache-2.0).
"""

from __future__ import annotations

import socket
import struct
import time
from contextlib import suppress
from enum import IntEnum

from sim.fci.codec import HOST

PORT = 1338  # clients know no other
VERSION = 3
HEADER = struct.Struct("<HII")  # command, command id, size with this header
STATE = struct.Struct("<IddBH")  # id, width and greatest width (m), grasped, temperature
PAYLOADS = {0: "<HH", 1: "", 2: "<5d", 3: "<2d", 4: ""}  # by command
WIDEST = 0.08  # m between the fingers
HOMING_SPEED, FASTEST = 0.05, 0.1  # m/s; the first chosen, the second of the data sheet
NOTHING = 0.0  # m, the width of what lies between the fingers where nothing does


class Command(IntEnum):
    """Requests."""

    CONNECT = 0
    HOMING = 1
    GRASP = 2
    MOVE = 3
    STOP = 4


class Status(IntEnum):
    """Of a reply; Connect has its own two."""

    SUCCESS = 0
    FAIL = 1
    UNSUCCESSFUL = 2
    ABORTED = 3


class Fingers:
    """The hand itself: moves on when asked what time it is.

    Args:
        thing: width of what lies between the fingers, m; 0 for nothing.

    Attributes:
        width: m.
        grasped: the last grasp holds something.
    """

    def __init__(self, thing: float = NOTHING) -> None:
        self._thing = thing
        self.width, self.grasped = 0.04, False
        self._goals: list[tuple[float, float]] = []  # width and speed, one after the other
        self._accepted: tuple[float, float] | None = None  # of a grasp, least and greatest width
        self._at = 0.0

    @property
    def moving(self) -> bool:
        """A request is still being carried out."""
        return bool(self._goals) or self._accepted is not None

    def begin(self, command: Command, numbers: tuple[float, ...]) -> bool:
        """Start a motion; False for one that is impossible."""
        self.stop()
        if command == Command.HOMING:
            self.grasped = False
            self._goals = [(NOTHING, HOMING_SPEED), (WIDEST, HOMING_SPEED)]
            return True
        width, speed = numbers[0], numbers[-1] if command == Command.MOVE else numbers[3]
        if not (0.0 <= width <= WIDEST and speed > 0.0):
            return False
        self.grasped = False
        if command == Command.GRASP:
            inner, outer, force = numbers[1], numbers[2], numbers[4]
            if not (inner >= 0.0 and outer >= 0.0 and 0.0 < force <= 140.0):  # N, data sheet
                return False
            self._accepted = width - inner, width + outer
            width = NOTHING if self.width >= width else WIDEST
        self._goals = [(width, min(speed, FASTEST))]
        return True

    def stop(self) -> None:
        """Stand still."""
        self._goals, self._accepted = [], None

    def go_on(self, now_s: float) -> Status | None:
        """Move on to this time; how the request ended, if it just did."""
        left_s, self._at = now_s - self._at, now_s
        if not self.moving:
            return None
        while self._goals and left_s > 0.0:
            wanted, speed = self._goals[0]
            goal = max(wanted, self._thing) if wanted < self.width else wanted
            needed_s = abs(goal - self.width) / speed
            if needed_s <= left_s:
                self.width = goal
                self._goals.pop(0)
            else:
                self.width += speed * left_s * (1.0 if goal > self.width else -1.0)
            left_s -= needed_s
        if self._goals:
            return None
        if self._accepted is None:
            return Status.SUCCESS
        (least, most), self._accepted = self._accepted, None
        self.grasped = self._thing > NOTHING and least <= self.width <= most
        return Status.SUCCESS if self.grasped else Status.UNSUCCESSFUL


class GripperServer:
    """The hand on a network, one client at a time; `poll` does all there is to do and never waits.

    Args:
        port: TCP port on 127.0.0.1; 0 takes a free one.
        thing: width of what lies between the fingers, m; 0 for nothing.

    Attributes:
        port: the TCP port.
        fingers: the hand.
        clients: connections so far.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, port: int = PORT, thing: float = NOTHING) -> None:
        self.fingers, self.clients = Fingers(thing), 0
        self._listener = socket.create_server((HOST, port))
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind((HOST, 0))
        self._udp.setblocking(False)
        self._tcp: socket.socket | None = None
        self._states_to: tuple[str, int] | None = None
        self._held = bytearray()
        self._busy: tuple[int, int] | None = None  # command and id of the request under way
        self._message_id, self._due_s = 0, 0.0

    def poll(self) -> None:
        """Take requests, move the fingers, send what is due."""
        now_s = time.monotonic()
        ended = self.fingers.go_on(now_s)
        if ended is not None:
            self._finish(ended)
        if self._tcp is not None:
            self._listen(self._tcp)
        else:
            with suppress(OSError):  # nobody comes
                self._tcp, _ = self._listener.accept()
                self._tcp.setblocking(False)
                self._tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self.clients += 1
        if self._states_to is not None and now_s >= self._due_s:
            self._due_s = now_s + 0.01  # chosen; the hand's own is not published
            self._message_id += 1
            hand = self.fingers
            state = (self._message_id, hand.width, WIDEST, hand.grasped, 30)  # °C
            with suppress(OSError):  # nobody listens there any more
                self._udp.sendto(STATE.pack(*state), self._states_to)

    def close(self) -> None:
        """End the connection."""
        self._drop()
        self._udp.close()
        self._listener.close()

    def _listen(self, tcp: socket.socket) -> None:
        try:
            data = tcp.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop()
            return
        self._held += data
        while self._tcp is not None and len(self._held) >= HEADER.size:
            command, ident, size = HEADER.unpack_from(self._held)
            payload = struct.Struct(PAYLOADS[command]) if command in PAYLOADS else None
            if payload is None or size != HEADER.size + payload.size:
                self._drop()
                return
            if len(self._held) < size:
                return
            numbers = payload.unpack_from(self._held, HEADER.size)
            del self._held[:size]
            self._answer(Command(command), ident, numbers)

    def _answer(self, command: Command, ident: int, numbers: tuple[float, ...]) -> None:
        if command == Command.CONNECT:
            version, port = int(numbers[0]), int(numbers[1])
            agreed = version == VERSION and port > 0
            self._states_to = (HOST, port) if agreed else None
            self._reply(command, ident, not agreed, struct.pack("<H", VERSION))
            return
        self._finish(Status.ABORTED)
        if command == Command.STOP:
            self.fingers.stop()
            self._reply(command, ident, Status.SUCCESS)
        elif self.fingers.begin(command, numbers):
            self._busy = command, ident
        else:
            self._reply(command, ident, Status.FAIL)

    def _finish(self, status: Status) -> None:
        """Reply to the request under way, if there is one."""
        busy, self._busy = self._busy, None
        if busy is not None:
            self._reply(*busy, status)

    def _reply(self, command: int, ident: int, status: int, rest: bytes = b"") -> None:
        if self._tcp is None:
            return
        data = struct.pack("<H", status) + rest
        try:
            self._tcp.send(HEADER.pack(command, ident, HEADER.size + len(data)) + data)
        except OSError:
            self._drop()

    def _drop(self) -> None:
        """The client is gone; so is what it asked for."""
        if self._tcp is not None:
            self._tcp.close()
        self._tcp = self._states_to = self._busy = None
        self._held.clear()
        self.fingers.stop()
