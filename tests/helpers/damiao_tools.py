"""Small Damiao motors for tests: on a bus in made-up time, and behind any python-can bus."""

from __future__ import annotations

import heapq
import os
import struct
import threading
import time
from contextlib import suppress

import can
import numpy as np

from sim.damiao.codec import FullScale, data_frame, decode_command, encode_feedback

LIMITS = [(12.5, 45.0, 54.0)] * 2 + [(12.5, 10.0, 28.0)] * 2 + [(12.5, 30.0, 10.0)] * 3
FRAME_NS, SLOT_NS = 50_000, 100_000  # a frame on the wire; replies of neighbours lie so far apart
STEP_NS = 200_000


def reply_bytes(can_id, status, limits, q, dq, tau, mosfet=30, rotor=35):
    return encode_feedback(can_id, status, (q, dq, tau), (mosfet, rotor), FullScale(*limits))


class Bank:
    """Motors 1..n. `motion(t_s)` prescribes (q, dq, tau); without, they obey their commands."""

    def __init__(self, n=7, limits=None, motion=None, encode=None):
        self.n, self.limits = n, limits or LIMITS[:n]
        self.encode = encode or self.limits  # scales that the motors really use
        self.motion = motion
        self.status = [0] * n
        self.temperatures = [(30, 35)] * n
        self.registers = [{9: 0, 10: 2, 21: a, 22: b, 23: c} for a, b, c in self.limits]
        self.silent = set()
        self.q, self.dq = np.linspace(-0.6, 0.6, n), np.zeros(n)
        self.load = np.full(n, 2.0)
        self.inertia = np.array([0.6, 0.6, 0.2, 0.2, 0.05, 0.05, 0.05])[:n]
        self.command = np.zeros((n, 5))  # q, dq, kp, kd, tau
        self.heard_ns, self.now_ns = [0] * n, 0
        self.commanded, self.limp, self.writes = [False] * n, False, []
        self.held = [False] * n  # something rigid keeps these joints where they are

    def advance(self, now_ns):
        if not self.now_ns:
            self.now_ns = now_ns
        while self.now_ns + STEP_NS <= now_ns:
            self.now_ns += STEP_NS
            h = 1e-9 * STEP_NS
            for j, registers in enumerate(self.registers):
                limit_ns = registers[9] * 50_000
                if limit_ns and self.status[j] == 1 and self.now_ns - self.heard_ns[j] > limit_ns:
                    self.status[j] = 0xD
            on = np.array(self.status) == 1
            standing = not all(self.commanded)  # in a stand until each motor had a command
            self.limp = self.limp or not (standing or on.all())
            c = self.command
            tau = c[:, 2] * (c[:, 0] - self.q) + c[:, 3] * (c[:, 1] - self.dq) + c[:, 4]
            force = 0.0 if standing else np.where(on, tau, 0.0) - self.load
            self.dq = np.where(self.held, 0.0, self.dq + h * force / self.inertia)
            self.q = self.q + h * self.dq

    def state(self, j, now_ns):
        if self.motion is not None:
            q, dq, tau = (np.broadcast_to(x, self.n)[j] for x in self.motion(1e-9 * now_ns))
        else:
            c = self.command[j]
            q, dq = self.q[j], self.dq[j]
            tau = (c[2] * (c[0] - q) + c[3] * (c[1] - dq) + c[4]) if self.status[j] == 1 else 0.0
        return reply_bytes(j + 1, self.status[j], self.encode[j], q, dq, tau, *self.temperatures[j])

    def handle(self, can_id, data, now_ns):
        """(joint, bytes) of the reply to a frame that the motors took in at `now_ns`, or None."""
        self.advance(now_ns)
        j = (struct.unpack_from("<H", data)[0] if can_id == 0x7FF else can_id) - 1
        if not 0 <= j < self.n or j in self.silent:
            return None
        if can_id == 0x7FF:
            return self._service(j, bytes(data), now_ns)
        if bytes(data[:7]) == b"\xff" * 7:
            self.status[j] = {0xFB: 0, 0xFC: 1, 0xFD: 0}.get(data[7], self.status[j])
        else:
            self._take(j, data)
        self.heard_ns[j] = now_ns
        return j, self.state(j, now_ns)

    def _take(self, j, data):
        self.commanded[j] = self.commanded[j] or self.status[j] == 1
        self.command[j] = decode_command(data, FullScale(*self.encode[j]))

    def _service(self, j, data, now_ns):
        if data[2] == 0xCC:
            return j, self.state(j, now_ns)
        kind = "<I" if data[3] in (9, 10) else "<f"
        if data[2] == 0x55:
            self.registers[j][data[3]] = struct.unpack(kind, data[4:])[0]
            self.writes.append((j, data[3]))
            self.heard_ns[j] = now_ns
        return j, data[:4] + struct.pack(kind, self.registers[j][data[3]])


class Time:
    """Made-up clocks; each look at them takes a microsecond."""

    def __init__(self):
        self.ns, self.wall_offset_ns = 1_000_000_000, 1_700_000_000_000_000_000

    def now_ns(self):
        self.ns += 1_000
        return self.ns

    def wall_ns(self):
        return self.ns + self.wall_offset_ns


class MotorBus(can.BusABC):
    """A python-can bus in made-up time with motors at its other end.

    Replies to one tick's requests arrive one after the other, `SLOT_NS` apart; the motor has
    measured one frame before its reply's arrival.
    """

    def __init__(self, bank):
        self.bank, self.clock, self.spread_ns = bank, Time(), SLOT_NS
        self._queue, self._count = [], 0
        self.sent, self.refusing, self.keep = [], 0, lambda can_id, data: True
        self.channel_info = "motors"
        super().__init__(channel=0)

    def send(self, msg, timeout=None):
        if self.refusing:
            self.refusing -= 1
            raise can.CanOperationError("Transmit buffer full")
        data = bytes(msg.data)
        self.sent.append((msg.arbitration_id, data))
        j = (data[0] if msg.arbitration_id == 0x7FF else msg.arbitration_id) - 1
        arrival_ns = self.clock.ns + FRAME_NS + (j + 1) * self.spread_ns
        said = self.bank.handle(msg.arbitration_id, data, arrival_ns - FRAME_NS)
        if said is not None and self.keep(0x11 + said[0], said[1]):
            self.put(0x11 + said[0], said[1], arrival_ns)

    def put(self, can_id, data, arrival_ns=None, **flags):
        at = self.clock.ns if arrival_ns is None else arrival_ns
        self._count += 1
        stamp = 1e-9 * (at + self.clock.wall_offset_ns)
        message = can.Message(
            timestamp=stamp, arbitration_id=can_id, data=data, is_extended_id=False
        )
        for name, flag in flags.items():
            setattr(message, name, flag)
        heapq.heappush(self._queue, (at, self._count, message))

    def recv(self, timeout=None):
        if self._queue and self._queue[0][0] <= self.clock.ns:
            return heapq.heappop(self._queue)[2]
        self.clock.ns += 20_000
        return None


def tick(arm, bus, tau=None, period_ns=1_000_000):
    """One tick in made-up time: read, command, wait for the next."""
    begin = bus.clock.ns
    sample = arm.read()
    if tau is not None:
        arm.command(tau)
    bus.clock.ns = begin + period_ns
    return sample


def ticks(count, arm, bus, tau=None):
    """So many of them; the last sample."""
    for _ in range(count):
        sample = tick(arm, bus, tau)
    return sample


class Served:
    """Motors in a thread behind a python-can bus, in real time. Use as a context manager."""

    def __init__(self, bank, bus):
        self.bank, self.bus = bank, bus
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._stop.set()
        self._thread.join()
        self.bus.shutdown()

    def _run(self):
        with suppress(OSError):  # real motors answer whatever this machine does
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(40))
        while not self._stop.is_set():
            try:
                message = self.bus.recv(0.002)
            except can.CanOperationError:
                continue  # bytes that are no frame
            now_ns = time.monotonic_ns()
            if message is None:
                self.bank.advance(now_ns)
                continue
            if message.arbitration_id > 0x10 and message.arbitration_id != 0x7FF:
                continue  # its own, on a bus that hands them back
            said = self.bank.handle(message.arbitration_id, message.data, now_ns)
            if said is not None:
                self.bus.send(data_frame(0x11 + said[0], said[1], message.is_fd))
