"""A process of a driver's own, memory to share with it, signals that end one, waking in time.

What a loop asks of the system is not demanded: each request says whether it was granted.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Self


class Block(ctypes.Structure):
    """Memory that two processes see; what derives from it names its words.

    Each aligned word is written as a whole. Words that are written one after the other may be
    mixed with the next ones' where somebody reads them meanwhile.
    """

    @classmethod
    def create(cls, more: int = 0) -> tuple[int, Self]:
        """Zeros, with `more` bytes behind them, and the descriptor that a child inherits."""
        fileno = os.memfd_create(cls.__name__)
        os.truncate(fileno, ctypes.sizeof(cls) + more)
        return fileno, cls.of(fileno)

    @classmethod
    def of(cls, fileno: int) -> Self:
        """The same from its descriptor; mapped for as long as this object is there."""
        return cls.from_buffer(mmap.mmap(fileno, 0))


def start_module(
    module: str, told: str, filenos: Sequence[int], **how: Any
) -> subprocess.Popen[bytes]:
    """Run a module of this package in a process of its own; the text `told` is its argument.

    Args:
        module: found wherever this package was found.
        told: on its command line.
        filenos: descriptors that it inherits.
        how: more for `subprocess.Popen`; what it says comes through a pipe.

    Raises OSError.
    """
    root = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, told],
        stdout=subprocess.PIPE,
        pass_fds=filenos,
        env={**os.environ, "PYTHONPATH": path},
        **how,
    )


class StopSignals:
    """Counts SIGINT, SIGTERM and SIGHUP in place of their usual effect (main thread only).

    A SIGHUP that is ignored (`nohup`) stays so.
    """

    def __init__(self) -> None:
        self.count = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                if number == signal.SIGHUP and signal.getsignal(number) == signal.SIG_IGN:
                    continue
                self._before[number] = signal.signal(number, self._hear)
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _hear(self, number: int, frame: FrameType | None) -> None:
        self.count += 1


def sleep_until(deadline_ns: int) -> None:
    """Sleep until CLOCK_MONOTONIC shows `deadline_ns`."""
    time.sleep(max(1e-9 * (deadline_ns - time.monotonic_ns()), 0.0))


# One clear sentence on a request, and what takes back what was granted; None where nothing was.
Answer = tuple[str, Callable[[], None] | None]


def request_fifo(priority: int) -> Answer:
    """SCHED_FIFO for the calling thread; its children start ordinary."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except (OSError, ValueError) as error:
        why = "needs root, CAP_SYS_NICE or an rtprio limit (ulimit -r)"
        return f"priority: SCHED_FIFO {priority} refused ({error}); {why}", None
    line = f"priority: SCHED_FIFO {priority} granted"
    return line, lambda: os.sched_setscheduler(0, *before)


def pin(cores: set[int]) -> Answer:
    """Keep the calling thread on these cores."""
    before = os.sched_getaffinity(0)
    names = ", ".join(map(str, sorted(cores)))
    try:
        os.sched_setaffinity(0, cores)
    except (OSError, ValueError) as error:
        have = ", ".join(map(str, sorted(before)))
        return f"core: {names} refused ({error}); have: {have}", None
    shared = " (the only one: the workers share it)" if before <= cores else ""
    line = f"core: the loop runs on core {names}{shared}"
    return line, lambda: os.sched_setaffinity(0, before)


def quiet_collector() -> Answer:
    """Collect once, then leave everything that lives alone and collect no more."""
    enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()

    def undo() -> None:
        gc.unfreeze()
        if enabled:
            gc.enable()

    return "collector: frozen and off", undo
