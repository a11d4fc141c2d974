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

import ctypes
import fcntl
import json
import os
import signal
import stat
import sys
import tempfile
import time
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from types import FrameType

import can

from drivers.damiao import codec
from drivers.damiao.bus import message_for, open_bus, wire_of
from drivers.damiao.codec import Scales, WireError
from drivers.damiao.holding import SINK_S, Braker, Push, PushWatch
from drivers.damiao.settings import BusSettings
from drivers.interface import DriverError
from drivers.process import Block

MOST_JOINTS = 15  # ids of four bits, without the service's
WATCH_S, HOLD_S = 0.002, 0.005
SILENCE_NS = 50_000_000  # a quarter of the motors' time-out
READY = "ready"


class GuardianMode(IntEnum):
    """What the guardian is to do."""

    IDLE = 0  # nothing
    DRIVE = 1  # take over when commands stop coming
    HOLD = 2  # hold the arm now
    RELEASED = 3  # go
    BRAKE = 4  # as DRIVE, while the loop settles or brakes the arm


class GuardianMemory(Block):
    """The shared block.

    The loop writes, the guardian reads, except for `taken` and what it forbids. Numbers of one
    tick may be mixed with the next one's, which is 1 ms later.

    Attributes:
        mode: what the guardian is to do, a `GuardianMode`.
        beat_ns: CLOCK_MONOTONIC instant of the last command.
        taken: how often the guardian has taken a driven arm over.
        held: angles to hold, rad.
        q, dq: where the arm is, rad, and how fast, rad/s.
        carried, tau: what carries it and what was measured, N m.
    """

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("mode", "beat_ns", "taken", "_pushed")),
        *((name, ctypes.c_double) for name in ("_torque", "_limit")),
        *((name, ctypes.c_double * MOST_JOINTS) for name in ("held", "q", "dq", "carried", "tau")),
    )

    @property
    def forbidden(self) -> Push | None:
        """What is pushed, so that the arm may not be driven on; None for nothing."""
        return Push(self._pushed - 1, self._torque, self._limit) if self._pushed else None

    def forbid(self, push: Push) -> None:
        """The arm may not be driven on."""
        self._torque, self._limit = push.torque, push.limit
        self._pushed = push.joint + 1  # last: whoever reads it finds the others

    def put(
        self,
        q: Sequence[float],
        dq: Sequence[float],
        carried: Sequence[float],
        tau: Sequence[float] | None = None,
    ) -> None:
        """Where the arm is, how fast, what carries it and what was measured; (n) each."""
        n = len(q)
        self.q[:n], self.dq[:n], self.carried[:n] = q, dq, carried
        self.tau[:n] = carried if tau is None else tau

    def hold(self, q: Sequence[float]) -> None:
        """Hold these angles from now on, (n) rad."""
        self.held[: len(q)] = q
        self.mode = GuardianMode.HOLD


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
        self._mode: int = GuardianMode.IDLE
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
                self._braker = self._begin(mode, alive)
            if not alive and stat.S_ISFIFO(os.fstat(2).st_mode):
                # whoever reads the ended program's output through a pipe is not to wait for us
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, 2)
                os.close(nowhere)
            if self.ended:
                self._let_down(self._braker)
                return
            self._listen()
            self._send(self._braker.commands(HOLD_S, self._q, self._dq))
            if time.monotonic() - self._heard_s > 10.0:  # s
                self._say("no motor answers any more; nothing is left to hold")
                return
            time.sleep(HOLD_S)

    def close(self) -> None:
        """Close the bus."""
        self._wire.close()
        self._bus.shutdown()

    def _look(self, mode: int) -> None:
        """At each command of a driven arm: forbid to drive on where it is pushed although it
        stands still, and end a loop that drives on all the same."""
        memory = self._memory
        beat_ns, before_ns = memory.beat_ns, self._beat_ns
        if mode != GuardianMode.DRIVE:
            self._pushes.reset()
            self._gone_on = 0
        elif beat_ns != before_ns and memory.forbidden is not None:
            self._gone_on += 1
            # one command may have been under way when driving was forbidden
            if self._gone_on >= 2 and os.getppid() == self._parent:
                self._say(f"process {self._parent} goes on driving; it is ended")
                os.kill(self._parent, signal.SIGKILL)
        elif beat_ns != before_ns:
            dt_s = 1e-9 * min(beat_ns - before_ns, self._longest_ns)
            rows = (row[:] for row in (memory.dq, memory.carried, memory.tau))
            push = self._pushes.step(dt_s, *rows)
            if push is not None:
                memory.forbid(push)
                self._say(f"{push.said(self._names[push.joint])}; the arm is stopped")
        self._beat_ns = beat_ns

    def _begin(self, mode: int, alive: bool) -> Braker:
        self._wire.waiting()  # old replies
        memory, n = self._memory, len(self._limits)
        self._q, self._dq = memory.q[:n], memory.dq[:n]
        self._mode, self._heard_s = mode, time.monotonic()
        hold = memory.held[:n] if mode == GuardianMode.HOLD else None
        if mode in (GuardianMode.DRIVE, GuardianMode.BRAKE):
            memory.taken += 1
            why = "the loop has sent nothing for 50 ms" if alive else "the loop's process is gone"
            self._say(f"{why}; the arm is braked and held. Support it, then: kill {os.getpid()}")
        return Braker(self._limits, memory.carried[:n], hold)

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

    def _let_down(self, braker: Braker) -> None:
        self._say(f"the arm sinks over {SINK_S:g} s, then its motors are switched off")
        steps = round(SINK_S / HOLD_S)
        for k in range(steps):
            if self.relieved:
                return
            self._send(braker.sinking(1.0 - k / steps))
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
        memory = GuardianMemory.of(said["block"])
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
