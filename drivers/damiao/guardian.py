"""A process of its own that brakes and holds the arm where the loop's process does not.

These motors have no brakes. A motor that hears nothing keeps its last command until its time-out
(register 9), and then lets go: after a `kill -9` of the loop the arm would first go on as it was
driven and then fall. So this process, with its own handle on the bus, takes over

- when the loop's process is gone: looked at every 2 ms (its parent is then another process);
- when no command has come for `SILENCE_NS` although the arm is being driven;
- when the loop asks for it: before its first command, and after its stop.

It also looks whether the loop pushes an arm that stands still (`PushWatch`), and then forbids its
commands: the loop's driver refuses them, naming the joint, and brakes. A loop that goes on driving
all the same is ended (SIGKILL: two that send commands would only take turns), and the arm braked.
Both go by what the loop did, never by how long it took: a loop that a busy machine keeps waiting
has neither pushed nor gone on meanwhile.

It sends the commands of `drivers.damiao.holding` at 200 Hz, until

- the next driver connects with leave to move and sends SIGUSR1 once it holds the arm itself;
- SIGTERM: it lets the arm sink over 3 s against damping, then disables the motors;
- no motor has answered for 10 s (power off).
"""

from __future__ import annotations

import fcntl
import json
import mmap
import os
import signal
import stat
import struct
import sys
import tempfile
import time
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import IO

import can

from drivers.damiao import codec
from drivers.damiao.bus import message_for, open_bus, wire_of
from drivers.damiao.codec import Scales, WireError
from drivers.damiao.holding import SINK_S, Braker, Push, PushWatch
from drivers.damiao.settings import BusSettings
from drivers.interface import DriverError

MOST_JOINTS = 15
HEAD_BYTES = 64
ROWS = 5  # held angle, angle, speed, torque that carries the arm, torque measured
BLOCK_BYTES = HEAD_BYTES + 8 * ROWS * MOST_JOINTS
WATCH_S, HOLD_S = 0.002, 0.005
SILENCE_NS = 50_000_000  # a quarter of the motors' time-out
GO_ON_BEATS = 2  # commands seen after driving was forbidden; one may have been under way
MILLI = 1000  # the block's whole numbers are mN m
GONE_S = 10.0
READY = "ready"


class GuardianMode(IntEnum):
    """What the guardian is to do."""

    IDLE = 0  # nothing
    DRIVE = 1  # take over when commands stop coming
    HOLD = 2  # hold the arm now
    RELEASED = 3  # go
    BRAKE = 4  # as DRIVE, while the loop settles or brakes the arm


class GuardianMemory:
    """The shared block.

    The loop writes, the guardian reads, except for `taken` and `forbidden`. Each number is written
    as a whole; numbers of one tick may be mixed with the next one's, which is 1 ms later.

    Args:
        file: of `BLOCK_BYTES`, open for reading and writing.
        joints: of the arm.
    """

    def __init__(self, file: IO[bytes] | int, joints: int) -> None:
        fileno = file if isinstance(file, int) else file.fileno()
        self._map = mmap.mmap(fileno, BLOCK_BYTES)
        self._head = memoryview(self._map)[:HEAD_BYTES].cast("q")
        self._joints = joints
        self._row = struct.Struct(f"{joints}d")
        self._rows = struct.Struct(f"{4 * joints}d")

    @property
    def mode(self) -> GuardianMode:
        """What the guardian is to do."""
        return GuardianMode(self._head[0])

    @mode.setter
    def mode(self, mode: GuardianMode) -> None:
        self._head[0] = mode

    @property
    def beat_ns(self) -> int:
        """CLOCK_MONOTONIC instant of the last command."""
        return self._head[1]

    @beat_ns.setter
    def beat_ns(self, now_ns: int) -> None:
        self._head[1] = now_ns

    @property
    def taken(self) -> int:
        """How often the guardian has taken a driven arm over."""
        return self._head[2]

    def count_taken(self) -> None:
        """The guardian takes over."""
        self._head[2] += 1

    @property
    def forbidden(self) -> Push | None:
        """What is pushed, so that the arm may not be driven on; None for nothing."""
        if not self._head[3]:
            return None
        return Push(self._head[3] - 1, self._head[4] / MILLI, self._head[5] / MILLI)

    def forbid(self, push: Push) -> None:
        """The arm may not be driven on."""
        self._head[4], self._head[5] = round(MILLI * push.torque), round(MILLI * push.limit)
        self._head[3] = push.joint + 1  # last: whoever reads it finds the others

    def put(
        self,
        q: Sequence[float],
        dq: Sequence[float],
        carried: Sequence[float],
        tau: Sequence[float] | None = None,
    ) -> None:
        """Where the arm is, rad, how fast, rad/s, what carries it and what was measured, N m."""
        values = *q, *dq, *carried, *(carried if tau is None else tau)
        self._rows.pack_into(self._map, HEAD_BYTES + self._row.size, *values)

    def motion(self) -> tuple[list[float], list[float], list[float], list[float]]:
        """(q, dq, carried, tau) as `put` wrote them."""
        values = list(self._rows.unpack_from(self._map, HEAD_BYTES + self._row.size))
        n = self._joints
        return values[:n], values[n : 2 * n], values[2 * n : 3 * n], values[3 * n :]

    def hold(self, q: Sequence[float]) -> None:
        """Hold these angles from now on, rad."""
        self._row.pack_into(self._map, HEAD_BYTES, *q)
        self.mode = GuardianMode.HOLD

    def held(self) -> list[float]:
        """Angles to hold, rad."""
        return list(self._row.unpack_from(self._map, HEAD_BYTES))

    def close(self) -> None:
        """Unmap; may be called more than once."""
        self._head.release()
        self._map.close()


class Guardian:
    """Watches over one arm.

    Args:
        settings: of the bus, which it opens itself.
        limits: of each motor.
        memory: from the loop.
        parent: process id of the loop.
        names: of the joints.
    """

    def __init__(
        self,
        settings: BusSettings,
        limits: Sequence[Scales],
        memory: GuardianMemory,
        parent: int,
        names: Sequence[str],
    ) -> None:
        self._names = names
        self._settings, self._limits, self._memory, self._parent = settings, limits, memory, parent
        self._bus = open_bus(settings)
        self._wire = wire_of(self._bus)
        self._messages = [message_for(settings, can_id, codec.ENABLE) for can_id in settings.ids]
        self._index = {can_id: j for j, can_id in enumerate(settings.reply_ids)}
        self._braker: Braker | None = None
        self._pushes = PushWatch(limits)
        self._longest_ns = max(round(1e9 * HOLD_S), 1_000_000_000 // settings.rate_hz)
        self._beat_ns = self._gone_on = 0
        self._mode = GuardianMode.IDLE
        self._q: list[float] = []
        self._dq: list[float] = []
        self._heard_s = 0.0
        self._lock: int | None = None
        self.relieved = self.ended = False

    def run(self) -> None:
        """Watch, brake, hold; returns when nobody needs it any more."""
        while not self.relieved:
            self._take_lock()
            memory, mode = self._memory, self._memory.mode
            alive = os.getppid() == self._parent
            if mode == GuardianMode.RELEASED or (mode == GuardianMode.IDLE and not alive):
                return
            driven = alive and mode in (GuardianMode.DRIVE, GuardianMode.BRAKE)
            if mode == GuardianMode.IDLE or (
                driven and time.monotonic_ns() - memory.beat_ns < SILENCE_NS
            ):
                self._braker = None
                self._look(mode)
                time.sleep(WATCH_S)
                continue
            if self._braker is None or mode != self._mode:
                self._begin(mode, alive)
            if not alive:
                leave_pipe()
            if self.ended:
                self._let_down()
                return
            self._step()
            if time.monotonic() - self._heard_s > GONE_S:
                self._say("no motor answers any more; nothing is left to hold")
                return
            time.sleep(HOLD_S)

    def close(self) -> None:
        """Close the bus."""
        self._wire.close()
        self._bus.shutdown()

    def _look(self, mode: GuardianMode) -> None:
        """At each command of a driven arm: forbid to drive on where it is pushed although it
        stands still, and end a loop that drives on all the same."""
        memory = self._memory
        beat_ns, before_ns = memory.beat_ns, self._beat_ns
        if mode != GuardianMode.DRIVE:
            self._pushes.reset()
            self._gone_on = 0
        elif beat_ns != before_ns and memory.forbidden is not None:
            self._gone_on += 1
            if self._gone_on >= GO_ON_BEATS and os.getppid() == self._parent:
                self._say(f"process {self._parent} goes on driving; it is ended")
                os.kill(self._parent, signal.SIGKILL)
        elif beat_ns != before_ns:
            _, dq, carried, tau = memory.motion()
            dt_s = 1e-9 * min(beat_ns - before_ns, self._longest_ns)
            push = self._pushes.step(dt_s, dq, carried, tau)
            if push is not None:
                memory.forbid(push)
                self._say(f"{push.said(self._names[push.joint])}; the arm is stopped")
        self._beat_ns = beat_ns

    def _begin(self, mode: GuardianMode, alive: bool) -> None:
        self._wire.waiting()  # old replies
        self._q, self._dq, tau, _ = self._memory.motion()
        self._mode, self._heard_s = mode, time.monotonic()
        self._braker = Braker(
            self._limits, tau, self._memory.held() if mode == GuardianMode.HOLD else None
        )
        if mode in (GuardianMode.DRIVE, GuardianMode.BRAKE):
            self._memory.count_taken()
            why = "the loop has sent nothing for 50 ms" if alive else "the loop's process is gone"
            self._say(f"{why}; the arm is braked and held. Support it, then: kill {os.getpid()}")

    def _step(self) -> None:
        assert self._braker is not None
        self._listen()
        self._send(self._braker.commands(HOLD_S, self._q, self._dq))

    def _listen(self) -> None:
        try:
            frames = self._wire.waiting()
        except (can.CanError, OSError):
            return  # the bus is down; it may come back
        for can_id, data, _, kind in frames:
            j = self._index.get(can_id)
            if kind or j is None:
                continue
            try:
                said = codec.state(self._limits[j], data)
            except WireError:
                continue
            if said.motor == self._settings.ids[j] & 0xF:
                self._q[j], self._dq[j] = said.q, said.dq
                self._heard_s = time.monotonic()

    def _send(self, commands: Sequence[bytes]) -> None:
        for message, data in zip(self._messages, commands, strict=True):
            message.data = bytearray(data)
            try:
                self._bus.send(message, timeout=0.0)
            except (can.CanError, OSError):
                continue  # buffer full or bus down: the next one follows in 5 ms

    def _let_down(self) -> None:
        assert self._braker is not None
        self._say(f"the arm sinks over {SINK_S:g} s, then its motors are switched off")
        steps = round(SINK_S / HOLD_S)
        for k in range(steps):
            if self.relieved:
                return
            self._send(self._braker.sinking(1.0 - k / steps))
            time.sleep(HOLD_S)
        for _ in range(3):  # a lost frame must not leave a motor on
            self._send([codec.DISABLE] * len(self._messages))
            time.sleep(HOLD_S)

    def _take_lock(self) -> None:
        """Become this bus's guardian as soon as no other is."""
        if self._lock is not None:
            return
        handle = open_lock(self._settings)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(handle)
            return
        os.ftruncate(handle, 0)
        os.write(handle, str(os.getpid()).encode())
        self._lock = handle

    def _say(self, sentence: str) -> None:
        try:
            print(f"guardian {os.getpid()}: {sentence}", file=sys.stderr, flush=True)
        except OSError:
            return  # the terminal is gone


def leave_pipe() -> None:
    """Whoever reads the ended program's output through a pipe is not to wait for us."""
    if stat.S_ISFIFO(os.fstat(2).st_mode):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        os.close(nowhere)


def open_lock(settings: BusSettings) -> int:
    """File that the guardian of this bus locks; its process id stands in it."""
    name = f"{settings.interface}-{settings.channel}-{settings.port}-{settings.first_id}"
    safe = "".join(c if c.isalnum() or c in "-." else "_" for c in name)
    path = Path(tempfile.gettempdir()) / f"damiao-guardian-{os.getuid()}-{safe}"
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)


def main() -> None:
    """Entry of the process: settings, limits, block and parent come as JSON."""
    said = json.loads(sys.argv[1])
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    settings = BusSettings(**said["settings"])
    limits = [Scales(*values) for values in said["limits"]]
    try:
        memory = GuardianMemory(said["block"], settings.joints)
        guardian = Guardian(settings, limits, memory, said["parent"], said["names"])
    except DriverError as error:
        print(error, flush=True)
        return

    def end(number: int, frame: FrameType | None) -> None:
        guardian.ended = True

    def relieve(number: int, frame: FrameType | None) -> None:
        guardian.relieved = True

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGUSR1, relieve)
    print(READY, flush=True)
    try:
        guardian.run()
    finally:
        guardian.close()


if __name__ == "__main__":
    main()
