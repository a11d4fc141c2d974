"""A scripted robot for the tests of the FCI driver: sockets, no physics.

Frames are made with `struct` from the offsets of the reference tables, without the driver's code.
`python tests/fci_peer.py PROTOCOL RATE` streams states from a process of its own: it prints its
port and waits for Connect.
"""

from __future__ import annotations

import itertools
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterable

HEADER = struct.Struct("<III")
STATE_SIZE = {5: 2373, 10: 1377}
COMMAND_SIZE = {5: 370, 10: 371}
# version: (number format, its size, tau_J, tau_J_d, q, dq, generator mode, success rate)
PLACES = {5: ("d", 1016, 1072, 1184, 1296, 2280, 2365), 10: ("f", 512, 540, 596, 652, 1288, 1373)}
SET_COLLISION, SET_LOAD = {5: 4, 10: 3}, {5: 10, 10: 9}
MOVE, STOP_MOVE, RECOVER = 1, 2, {5: 12, 10: 10}
RUNNING = {5: 2, 10: 5}  # generator mode of a torque motion
STARTED, NOT_POSSIBLE = 1, {5: 3, 10: 5}
REFLEX, USER_STOP = {5: 6, 10: 8}, {5: 7, 10: 9}
ZERO, PERIOD_S = (0.0,) * 7, 1e-3


def state(
    protocol: int,
    message_id: int,
    q: Iterable[float] = ZERO,
    dq: Iterable[float] = ZERO,
    tau: Iterable[float] = ZERO,
    tau_d: Iterable[float] = ZERO,
    modes: tuple[int, int, int] = (0, 3, 1),
    errors: Iterable[int] = (),
    reflex: Iterable[int] = (),
    rate: float = 0.0,
    load: Iterable[float] = (0.0,) * 13,
) -> bytes:
    """A state; modes are (generator, controller, robot), errors and reflex indices of flags."""
    number, at_tau, at_tau_d, at_q, at_dq, at_modes, at_rate = PLACES[protocol]
    data = bytearray(STATE_SIZE[protocol])
    struct.pack_into("<Q", data, 0, message_id)
    for at, values in ((at_tau, tau), (at_tau_d, tau_d), (at_q, q), (at_dq, dq)):
        struct.pack_into(f"<7{number}", data, at, *values)
    struct.pack_into(f"<13{number}", data, {5: 880, 10: 444}[protocol], *load)
    data[at_modes], data[at_modes + 1], data[at_modes + 84] = modes
    for index in errors:
        data[at_modes + 2 + index] = 1
    for index in reflex:
        data[at_modes + 43 + index] = 1
    struct.pack_into(f"<{number}", data, at_rate, rate)
    return bytes(data)


def reply(command: int, command_id: int, payload: bytes) -> bytes:
    """A reply with its header."""
    return HEADER.pack(command, command_id, HEADER.size + len(payload)) + payload


def exactly(connection: socket.socket, count: int) -> bytes:
    """So many bytes. Raises EOFError where the other end hung up."""
    data = b""
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            raise EOFError
        data += part
    return data


class Peer:
    """Serves one connection after the other on a port of 127.0.0.1.

    Connect is answered by `connect_reply`, a function of the version asked for; then one state
    a millisecond goes out while `streaming` is set. Move, StopMove and recovery are answered as
    the first attributes say; the robot's modes follow.

    Attributes:
        first_status: of Move; started by default, any other number refuses.
        stop_status, recover_status, set_status: of StopMove, AutomaticErrorRecovery and settings;
            None never answers.
        load: mass, inertia and centre in every state.
        obeys_finish: whether the finish flag ends the motion.
        modes, errors, reflex: put into every state.
        commands: (message id, torques, finish flag) received.
        requests: (command, payload) received.
    """

    def __init__(self, protocol: int) -> None:
        self.protocol = protocol
        self.first_status = STARTED
        self.stop_status: int | None = 0
        self.recover_status: int | None = 0
        self.set_status: int | None = 0
        self.load: tuple[float, ...] = (0.0,) * 13
        self.obeys_finish = True
        self.modes, self.errors, self.reflex = (0, 3, 1), (), ()
        self.dq: tuple[float, ...] = ZERO
        self.commands: list[tuple[int, tuple[float, ...], bool]] = []
        self.requests: list[tuple[int, bytes]] = []
        self.streaming = threading.Event()
        self.streaming.set()
        self.connect_reply: Callable[[int, int], bytes | None] = self._agree
        self.slowly = False  # replies byte by byte
        self.message_id = 1000
        self._move_id: int | None = None
        self._accepted: tuple[float, ...] = ZERO
        self._tcp: socket.socket | None = None
        self._where: tuple[str, int] | None = None
        self._lock = threading.RLock()
        self._over = threading.Event()
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind(("127.0.0.1", 0))
        self._udp.settimeout(0.05)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._threads = [
            threading.Thread(target=work, daemon=True)
            for work in (self._serve, self._stream, self._listen)
        ]

    def __enter__(self) -> Peer:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.hang_up()
        for thread in self._threads:
            thread.join(5.0)
        self._udp.close()

    @property
    def address(self) -> str:
        """Of the driver."""
        return f"fci://127.0.0.1:{self.port}"

    def hang_up(self) -> None:
        """End the TCP connection."""
        with self._lock:
            if self._tcp is not None:
                self._tcp.close() if self._over.is_set() else self._tcp.shutdown(socket.SHUT_RDWR)

    def send(self, data: bytes) -> None:
        """A datagram to where the client wants its states."""
        assert self._where is not None
        self._udp.sendto(data, self._where)

    def pause(self) -> int:
        """Stream no more; the id sent last."""
        with self._lock:
            self.streaming.clear()
            return self.message_id

    def send_ids(self, *ids: int) -> None:
        """States of these ids; each tells its own id as q1."""
        for message_id in ids:
            self.send(self.state(message_id, q=(float(message_id), *ZERO[1:])))

    def state(self, message_id: int, **fields: object) -> bytes:
        """A state with the modes and errors of now."""
        with self._lock:
            known = {
                "modes": self.modes,
                "errors": self.errors,
                "reflex": self.reflex,
                "dq": self.dq,
                "tau_d": self._accepted,
                "rate": 1.0,
                "load": self.load,
            }
        return state(self.protocol, message_id, **{**known, **fields})

    def end_motion(self, robot_mode: int, status: int, reflex: tuple[int, ...] = ()) -> None:
        """Leave the motion as a robot does by itself."""
        with self._lock:
            self.modes, self.reflex = (0, 3, robot_mode), reflex
            self._say(MOVE, self._move_id, bytes([status]))
            self._move_id = None

    def _agree(self, version: int, command_id: int) -> bytes:
        status = 0 if version == self.protocol else 1
        return reply(0, command_id, struct.pack("<BH", status, self.protocol))

    def _serve(self) -> None:
        while not self._over.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with self._lock:
                self._tcp, self._where = connection, None
            try:
                while True:
                    self._answer(connection)
            except (EOFError, OSError):
                connection.close()

    def _answer(self, connection: socket.socket) -> None:
        command, command_id, size = HEADER.unpack(exactly(connection, HEADER.size))
        payload = exactly(connection, size - HEADER.size)
        self.requests.append((command, payload))
        if command == 0:
            version, port = struct.unpack_from("<HH", payload)
            answer = self.connect_reply(version, command_id)
            if answer is None:
                return
            self._put(answer)
            if answer[12:13] == b"\0":
                self._where = ("127.0.0.1", port)
        elif command == MOVE:
            self._move(command_id)
        elif command == STOP_MOVE and self.stop_status is not None:
            with self._lock:
                if self.stop_status == 0:
                    self.modes = (0, 3, 1)
                self._say(STOP_MOVE, command_id, bytes([self.stop_status]))
                if self._move_id is not None and self.stop_status == 0:
                    self._say(MOVE, self._move_id, bytes([2]))
                    self._move_id = None
        elif command in (SET_COLLISION[self.protocol], SET_LOAD[self.protocol]):
            if self.set_status is not None:
                with self._lock:
                    self._say(command, command_id, bytes([self.set_status]))
        elif command == RECOVER[self.protocol] and self.recover_status is not None:
            with self._lock:
                if self.recover_status == 0:
                    self.modes, self.errors, self.reflex = (0, 3, 1), (), ()
                self._say(command, command_id, bytes([self.recover_status]))

    def _move(self, command_id: int) -> None:
        with self._lock:
            self._say(MOVE, command_id, bytes([self.first_status]))
            if self.first_status == STARTED:
                self.modes, self._move_id = (RUNNING[self.protocol], 2, 2), command_id

    def _say(self, command: int, command_id: int, payload: bytes) -> None:
        self._put(reply(command, command_id, payload))

    def _put(self, data: bytes) -> None:
        assert self._tcp is not None
        step = 1 if self.slowly else len(data)
        for k in range(0, len(data), step):
            self._tcp.sendall(data[k : k + step])
            time.sleep(2e-3 if self.slowly else 0.0)

    def _stream(self) -> None:
        due = time.monotonic()
        while not self._over.is_set():
            due = max(due + PERIOD_S, time.monotonic() - 0.05)
            time.sleep(max(0.0, due - time.monotonic()))
            with self._lock:
                if self.streaming.is_set() and self._where is not None:
                    self.message_id += 1
                    self.send(self.state(self.message_id))

    def _listen(self) -> None:
        while not self._over.is_set():
            try:
                data, _ = self._udp.recvfrom(1000)
            except (TimeoutError, OSError):
                continue
            assert len(data) == COMMAND_SIZE[self.protocol]
            (message_id,) = struct.unpack_from("<Q", data)
            tau = struct.unpack_from("<7d", data, 314)
            finish = bool(data[313] if self.protocol == 5 else data[370])
            with self._lock:
                self.commands.append((message_id, tau, finish))
                self._accepted = tau
                if finish and self.obeys_finish and self._move_id is not None:
                    self.end_motion(1, 0)


def stream(protocol: int, rate: float) -> None:
    """Serve one client: states from id 1 on, `rate` of them in a second, until it hangs up."""
    listener = socket.create_server(("127.0.0.1", 0))
    print(listener.getsockname()[1], flush=True)
    connection, _ = listener.accept()
    _, command_id, size = HEADER.unpack(exactly(connection, HEADER.size))
    _, port = struct.unpack("<HH", exactly(connection, size - HEADER.size))
    connection.sendall(reply(0, command_id, struct.pack("<BH", 0, protocol)))
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    frame = bytearray(state(protocol, 0))
    begin = time.monotonic()
    for k in itertools.count(1):
        struct.pack_into("<Q", frame, 0, k)
        time.sleep(max(0.0, begin + k / rate - time.monotonic()))
        udp.sendto(frame, ("127.0.0.1", port))


if __name__ == "__main__":
    stream(int(sys.argv[1]), float(sys.argv[2]))
