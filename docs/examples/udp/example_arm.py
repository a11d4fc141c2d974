"""A worked example of a driver: an arm that sends one UDP datagram per tick.

The wire, all little-endian:

    arm -> us   uint64 counter, uint64 stamp in ns, n float64 q, n dq, n tau
    us -> arm   uint64 counter of the state answered, n float64 torque   (a command)
    us -> arm   uint64 anything                                          (hello, or: brake)

Counters go up by one per tick. The arm sends to whom it heard from last; it brakes by itself
when it hears no command for 20 ms. Torques are link-side and include the arm's own weight.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Sequence

import numpy as np

from drivers.address import Address
from drivers.interface import Array, DriverError, Intake, JointSample, checked_torques

DEFAULT_PORT = 5800
OPTIONS = ("joints", "hz", "timeout_ms")
HEADER = struct.Struct("<QQ")
COUNTER = struct.Struct("<Q")
LARGEST = 65536  # bytes of a datagram
HELLO_TRIES = 20  # the first datagram may get lost, or the arm may be a little late
BRAKE_SENDS = 3  # UDP loses one now and then; this one must not be lost


class ExampleArm:
    """Driver of an arm that speaks the wire above.

    Args:
        address: `udp://HOST:PORT?joints=6&hz=1000&timeout_ms=100`.
        joint_names: in the arm's order; joint1, joint2, ... where None.
        allow_motion: whether commands go out. Without it the driver only listens.

    Raises:
        DriverError: the address cannot be read, or has another number of joints than names.
    """

    paced = True
    adds_gravity = False
    delay_ns = 1_000_000
    link_names: tuple[str, ...] = ()  # no sensors on the links

    def __init__(
        self, address: str, joint_names: Sequence[str] | None = None, allow_motion: bool = False
    ) -> None:
        place = Address.of(address, OPTIONS)
        self._where = (place.host, place.port or DEFAULT_PORT)
        n = int(place.number("joints", 6, 1, 100))
        names = joint_names or [f"joint{j}" for j in range(1, n + 1)]
        if len(names) != n:
            raise DriverError(f"{address}: {n} joints, but {len(names)} names; add joints={n}")
        self.joint_names = tuple(names)
        self.period_ns = round(1e9 / place.number("hz", 1000.0, 1e-3, 1e6))
        self._timeout_s = 1e-3 * place.number("timeout_ms", 100.0, 1e-3, 1e6)
        self.can_move = allow_motion
        self.intake, self.arrived_ns = Intake(), 0
        self._socket: socket.socket | None = None
        self._counter: int | None = None
        self._ready: JointSample | None = None

    def connect(self) -> None:
        """Say hello until the arm answers. Raises DriverError."""
        self.close()
        self.intake, self.arrived_ns, self._counter = Intake(), 0, None
        try:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.connect(self._where)  # from here on only this sender is heard
            self._ready = self._first()
        except OSError as error:
            self.close()
            raise DriverError(f"{self._name}: {error}; check address and cable") from error
        except DriverError:
            self.close()
            raise

    def _first(self) -> JointSample:
        """The first sample; the arm sends nothing before it has heard of us."""
        for _ in range(HELLO_TRIES):
            self._send(COUNTER.pack(0))
            try:
                return self._next()
            except DriverError:
                time.sleep(self._timeout_s)
        raise DriverError(f"{self._name}: no answer; is the arm switched on, is the port right?")

    def read(self) -> JointSample:
        """The next sample, as soon as it is there. Raises DriverError when the arm is silent."""
        sample, self._ready = self._ready or self._next(), None
        return sample

    def _next(self) -> JointSample:
        sock = self._open()
        end = time.monotonic() + self._timeout_s
        while True:
            left_s = end - time.monotonic()
            if left_s <= 0.0:
                break
            sock.settimeout(left_s)
            try:
                data = sock.recv(LARGEST)
            except TimeoutError:
                break
            except OSError as error:
                raise DriverError(f"{self._name}: {error}; is the arm's program running?") from None
            arrived_ns = time.monotonic_ns()
            sample = self._sample(data)
            if sample is not None:
                self.arrived_ns = arrived_ns
                return sample
        raise DriverError(
            f"{self._name}: silent for {self._timeout_s} s; check power and cable, connect again"
        )

    def _sample(self, data: bytes) -> JointSample | None:
        """What a datagram says; None where it is refused, and why is counted."""
        intake, n = self.intake, len(self.joint_names)
        intake.received += 1
        right = HEADER.size + 24 * n
        if len(data) != right:
            why = f"a datagram has {len(data)} bytes, not {right}; is joints={n} right?"
            return self._refused("wrong_length", why)
        counter, stamp_ns = HEADER.unpack_from(data)
        if self._counter is not None and counter <= self._counter:
            return self._refused("old", "a datagram came twice or late; only newer ones are used")
        if stamp_ns >= 2**63:
            return self._refused("bad_stamp", f"a stamp of {stamp_ns} ns cannot be; refused")
        if self._counter is not None and counter > self._counter + 1:
            intake.lost += counter - self._counter - 1
            advice = "give the arm a network port of its own"
            intake.note("lost", f"{self._name}: datagrams got lost; {advice}")
        self._counter = counter
        intake.used += 1
        # a copy: the sample belongs to the caller, and recv's bytes are read-only
        q, dq, tau = np.frombuffer(data, "<f8", offset=HEADER.size).reshape(3, n).astype(float)
        return JointSample(stamp_ns, q, dq, tau)

    def _refused(self, reason: str, why: str) -> JointSample | None:
        """Count a datagram that is not used; there is no sample."""
        self.intake.note(reason, f"{self._name}: {why}")
        self.intake.refused[reason] += 1
        return None

    def command(self, tau: Array) -> None:
        """Send (n,) N m, gravity included.

        Raises DriverError without `allow_motion`, before the first sample, or for anything but n
        finite numbers.
        """
        self._open()
        if not self.can_move:
            raise DriverError(f"{self._name}: listens only; motion needs --allow-motion")
        wanted = checked_torques(tau, len(self.joint_names))
        self._send(COUNTER.pack(self._counter or 0) + wanted.astype("<f8").tobytes())

    def stop(self) -> None:
        """Ask the arm to brake; without a connection its own watch on commands has done so."""
        if self._socket is not None and self.can_move:
            for _ in range(BRAKE_SENDS):
                self._send(COUNTER.pack(self._counter or 0))

    def close(self) -> None:
        """Leave the arm; it brakes when commands stay away."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._ready = None, None

    def _send(self, data: bytes) -> None:
        try:
            self._open().send(data)
        except OSError as error:
            raise DriverError(f"{self._name}: {error}; is the arm's program running?") from None

    def _open(self) -> socket.socket:
        if self._socket is None:
            raise DriverError(f"{self._name}: not connected; call connect()")
        return self._socket

    @property
    def _name(self) -> str:
        return f"udp://{self._where[0]}:{self._where[1]}"
