"""A process of its own that brakes and holds the arm where the loop's process does not.

These motors have no brakes. A motor that hears nothing keeps its last command until its time-out
(register 9), and then lets go: after a `kill -9` of the loop the arm would first go on as it was
driven and then fall. So this process, with its own handle on the bus, takes over

- when the loop's process is gone: looked at every 2 ms (its parent is then another process);
- when no command has come for `SILENCE_NS` although the arm is being driven;
- when the loop asks for it: before its first command, and after its stop.

It sends the commands of `drivers.damiao.brake` at 200 Hz, until

- the next driver connects with leave to move and sends SIGUSR1 once it holds the arm itself;
- SIGTERM: it lets the arm sink over 3 s against damping, then disables the motors;
- no motor has answered for 10 s (power off).
"""

from __future__ import annotations

import fcntl
import json
import os
import signal
import stat
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

import can

from drivers.damiao import codec
from drivers.damiao.brake import SINK_S, Braker
from drivers.damiao.bus import message_for, open_bus, wire_of
from drivers.damiao.codec import Limits, WireError
from drivers.damiao.post import DRIVE, HOLD, IDLE, RELEASED, Post
from drivers.damiao.settings import BusSettings
from drivers.interface import DriverError

WATCH_S, HOLD_S = 0.002, 0.005
SILENCE_NS = 50_000_000  # a quarter of the motors' time-out
GONE_S = 10.0
READY = "ready"


class Guardian:
    """Watches over one arm.

    Args:
        settings: of the bus, which it opens itself.
        limits: of each motor.
        post: from the loop.
        parent: process id of the loop.
    """

    def __init__(
        self, settings: BusSettings, limits: Sequence[Limits], post: Post, parent: int
    ) -> None:
        self._settings, self._limits, self._post, self._parent = settings, limits, post, parent
        self._bus = open_bus(settings)
        self._wire = wire_of(self._bus)
        self._messages = [message_for(settings, can_id, codec.ENABLE) for can_id in settings.ids]
        self._index = {can_id: j for j, can_id in enumerate(settings.reply_ids)}
        self._braker: Braker | None = None
        self._mode = IDLE
        self._q: list[float] = []
        self._dq: list[float] = []
        self._heard_s = 0.0
        self._lock: int | None = None
        self.relieved = self.ended = False

    def run(self) -> None:
        """Watch, brake, hold; returns when nobody needs it any more."""
        while not self.relieved:
            self._take_lock()
            post, mode = self._post, self._post.mode
            alive = os.getppid() == self._parent
            if mode == RELEASED or (mode == IDLE and not alive):
                return
            driven = alive and mode == DRIVE
            if mode == IDLE or (driven and time.monotonic_ns() - post.beat_ns < SILENCE_NS):
                self._braker = None
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

    def _begin(self, mode: int, alive: bool) -> None:
        self._wire.waiting()  # old replies
        self._q, self._dq, tau = self._post.motion()
        self._mode, self._heard_s = mode, time.monotonic()
        self._braker = Braker(self._limits, tau, self._post.held() if mode == HOLD else None)
        if mode == DRIVE:
            self._post.count_taken()
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
    limits = [Limits(*values) for values in said["limits"]]
    try:
        guardian = Guardian(settings, limits, Post(said["block"], settings.joints), said["parent"])
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
