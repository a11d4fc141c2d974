"""A process of a driver's own, memory to share with it, signals that end one, waking in time."""

from __future__ import annotations

import ctypes
import mmap
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
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
