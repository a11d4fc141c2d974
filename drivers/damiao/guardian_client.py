"""The loop's side of its guardian: start it, tell it how the arm is, relieve the former one."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress

from drivers.damiao.codec import Scales
from drivers.damiao.guardian import READY, GuardianMemory, GuardianMode, open_lock
from drivers.damiao.settings import BusSettings
from drivers.interface import DriverError
from drivers.process import start_module

START_TIMEOUT_S, RELIEF_TIMEOUT_S = 30.0, 2.0


class GuardianClient:
    """A guardian process; it outlives this one.

    Args:
        settings: of the bus.
        limits: of each motor.
        names: of the joints.

    Attributes:
        memory: what it is told.
        pid: its process id.

    Raises:
        DriverError: it cannot be started, or cannot open the bus.
    """

    def __init__(
        self, settings: BusSettings, limits: Sequence[Scales], names: Sequence[str]
    ) -> None:
        self._settings = settings
        block, self.memory = GuardianMemory.create()
        said = {
            "settings": dataclasses.asdict(settings),
            "limits": [dataclasses.astuple(limit) for limit in limits],
            "block": block,
            "parent": os.getpid(),
            "names": list(names),
        }
        try:
            self._process = start_module(
                "drivers.damiao.guardian",
                json.dumps(said),
                (block,),
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C and a closing terminal are not for it
            )
        finally:
            os.close(block)
        self.pid = self._process.pid
        assert self._process.stdout is not None
        with self._process.stdout as said_there:
            ready, _, _ = select.select([said_there], [], [], START_TIMEOUT_S)
            answer = said_there.readline().decode(errors="replace").strip() if ready else ""
        if answer != READY:
            self._process.kill()
            self._process.wait()
            raise DriverError(
                "the process that holds the arm when the loop dies did not start: "
                f"{answer or 'no answer'}; without it (?guardian=0) a crash drops the arm"
            )

    @property
    def alive(self) -> bool:
        """It runs."""
        return self._process.poll() is None

    def relieve_former(self) -> int | None:
        """Send the guardian of a former run away; its process id, or None.

        Called while the arm is held by this run already.
        """
        former = former_guardian(self._settings, self.pid)
        if former is None:
            return None
        end = time.monotonic() + RELIEF_TIMEOUT_S
        while former_guardian(self._settings, self.pid) == former:
            with suppress(ProcessLookupError):
                os.kill(former, signal.SIGUSR1)
            if time.monotonic() > end:
                raise DriverError(
                    f"process {former} still holds this arm and does not give it up; end it: "
                    f"kill -9 {former} once the arm is supported"
                )
            time.sleep(0.005)
        return former

    def leave(self) -> None:
        """Let it go on alone with what it was told last; away with it where that was nothing."""
        if self.memory.mode == GuardianMode.IDLE:
            self.memory.mode = GuardianMode.RELEASED
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(RELIEF_TIMEOUT_S)
        if self.alive:
            self._process.returncode = 0  # it is meant to outlive us: nobody waits for it


def former_guardian(settings: BusSettings, not_this: int = 0) -> int | None:
    """Process id of the guardian that holds this arm now, or None."""
    handle = open_lock(settings)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        text = os.read(handle, 32).decode(errors="replace")
        return int(text) if text.isdecimal() and int(text) != not_this else None
    finally:
        os.close(handle)
    return None
