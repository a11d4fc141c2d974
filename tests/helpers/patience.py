"""Once more where a machine that takes processors away made an arm fall silent."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from drivers.interface import Driver, DriverError, EndOfStream, JointSample

T = TypeVar("T")


def patiently(action: Callable[[], T], again: Callable[[], object]) -> T:
    """What the action gives; where it raises DriverError, `again` and once more, for a while."""
    end = time.monotonic() + 60.0  # a simulated arm beside seven busy processes takes its time
    while True:
        try:
            return action()
        except EndOfStream:
            raise
        except DriverError:
            if time.monotonic() > end:
                raise
        with suppress(DriverError):
            again()


def connect(arm: Driver) -> None:
    """Connect, also where a motor's reply does not come in time at first."""
    patiently(arm.connect, arm.close)


def patient_read(arm: Driver) -> JointSample:
    """The next sample, of a new connection where the old one broke."""
    return patiently(arm.read, lambda: (arm.close(), arm.connect()))


def gone(pid: int) -> bool:
    """Whether a process has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True
