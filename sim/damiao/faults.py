"""Faults of simulated boards and their bus: how they are written, when they strike, what they do.

A fault is `NAME[=VALUE][@SECONDS]`: from SECONDS after the first frame to a motor on (0 by
default) it strikes a share VALUE of the frames, or the motor with the number VALUE.
"""

from __future__ import annotations

import contextlib
import heapq
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import can
import numpy as np

from sim.damiao import motor
from sim.damiao.codec import BUS_ERROR, error_frame

SHARES = {
    "drop": "a reply never arrives",
    "deaf": "a motor does not get a command",
    "late": "a reply comes 3 ms late",
    "repeat": "a reply comes twice",
    "reorder": "a reply comes after the next one",
    "corrupt": "a reply has one bit flipped or lost its last bytes",
    "spike": "a reply's angle is off by 0.5 rad",
    "error_frames": "the bus carries an error frame besides a reply",
    "enobufs": "the host's controller refuses to send (on a line or a wrapped bus)",
}
MOTORS = {
    "silent": "the motor answers nothing",
    "stuck": "its encoder stands still",
    "jump": "its encoder jumps by 0.1 rad and stays there",
    "overtemp": "its rotor gets too hot",
    "undervoltage": "its supply is too low",
    "overvoltage": "its supply is too high",
    "overcurrent": "its current is too high",
    "overload": "it reports overload",
}
SECONDS = {"bus_off": "the bus is dead for VALUE seconds"}
NAMES = (*SHARES, *MOTORS, *SECONDS)
STATUS = {
    "undervoltage": motor.UNDER_VOLTAGE,
    "overvoltage": motor.OVER_VOLTAGE,
    "overcurrent": motor.OVER_CURRENT,
    "overload": motor.OVERLOAD,
}
DEFAULTS = {**dict.fromkeys(SHARES, 0.01), **dict.fromkeys(MOTORS, 1.0), "bus_off": 1.0}
LATE_NS = 3_000_000
SPIKE_RAD, JUMP_RAD = 0.5, 0.1
HOT_C = 130.0
FAULT_STREAM = 1 << 33  # keeps the draws of faults apart from those of truth and noise

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?"
_ITEM = re.compile(rf"(?P<name>[a-z_]+)(?:=(?P<value>{_NUMBER}))?(?:@(?P<at>{_NUMBER}))?")


@dataclass(frozen=True)
class Fault:
    """One fault: share of frames, number of the motor or seconds, and when it begins."""

    name: str
    value: float
    at_s: float = 0.0

    @classmethod
    def of(cls, text: str) -> Fault:
        """Parse NAME[=VALUE][@SECONDS]. Raises ValueError, naming the choices."""
        found = _ITEM.fullmatch(text.strip())
        name = found["name"] if found else text.partition("=")[0].partition("@")[0].strip()
        if name not in NAMES:
            raise ValueError(f"no fault '{name}'; have: {', '.join(NAMES)}")
        if found is None:
            raise ValueError(f"fault '{text}': write {name}[=VALUE][@SECONDS]")
        value = DEFAULTS[name] if found["value"] is None else float(found["value"])
        if name in SHARES and value > 1.0:
            raise ValueError(f"fault '{text}': VALUE is a share of frames, from 0 to 1")
        if name in MOTORS and value not in range(1, 8):
            raise ValueError(f"fault '{text}': VALUE is the number of a motor, from 1 to 7")
        return cls(name, value, float(found["at"] or 0.0))


class Faults:
    """Faults that are due, drawn by seed; counts what struck.

    Attributes:
        counts: how often each fault struck.
    """

    def __init__(self, texts: Iterable[str] = (), seed: int = 0) -> None:
        """Parse faults. Raises ValueError, naming the choices."""
        self.faults = tuple(Fault.of(text) for text in texts)
        self.counts: Counter[str] = Counter()
        self._rng = np.random.default_rng([seed, FAULT_STREAM])
        self._by_name: dict[str, list[Fault]] = {}
        for fault in self.faults:
            self._by_name.setdefault(fault.name, []).append(fault)

    def __bool__(self) -> bool:
        return bool(self.faults)

    def strikes(self, name: str, now_s: float) -> bool:
        """Whether a fault that hits a share of frames hits this one."""
        for fault in self._by_name.get(name, ()):
            if now_s >= fault.at_s and self._rng.random() < fault.value:
                self.counts[name] += 1
                return True
        return False

    def hits(self, name: str, number: int, now_s: float) -> bool:
        """Whether a motor (from 1) has a fault."""
        for fault in self._by_name.get(name, ()):
            if fault.value == number and now_s >= fault.at_s:
                self.counts[name] += 1
                return True
        return False

    def within(self, name: str, now_s: float) -> bool:
        """Whether a fault that lasts VALUE seconds lasts."""
        return any(
            fault.at_s <= now_s < fault.at_s + fault.value for fault in self._by_name.get(name, ())
        )

    def pick(self, below: int) -> int:
        """A number from 0 to below - 1."""
        return int(self._rng.integers(below))


class Outbox:
    """Sends replies, now or later.

    Attributes:
        sent: frames that went out, error frames not counted.
        failed: frames that the bus would not take.
    """

    def __init__(self, bus: can.BusABC, faults: Faults) -> None:
        self._bus, self._faults = bus, faults
        self._later: list[tuple[int, int, can.Message]] = []
        self._behind: list[can.Message] = []
        self._count = 0
        self.sent = self.failed = 0

    def put(self, message: can.Message, now_ns: int, now_s: float) -> None:
        """Send a reply, as far as the faults allow."""
        if not self._faults:
            self._send(message)
            return
        strikes = self._faults.strikes
        if strikes("error_frames", now_s):
            self.tell(error_frame(BUS_ERROR))
        if strikes("drop", now_s):
            return
        if strikes("corrupt", now_s):
            self._corrupt(message)
        if strikes("late", now_s):
            self._count += 1
            heapq.heappush(self._later, (now_ns + LATE_NS, self._count, message))
        elif strikes("reorder", now_s):
            self._behind.append(message)
        else:
            self._send(message)
            if strikes("repeat", now_s):
                self._send(message)
            waiting, self._behind = self._behind, []
            for held in waiting:
                self._send(held)

    def tell(self, message: can.Message) -> None:
        """Put something on the bus that is no reply."""
        with contextlib.suppress(can.CanError):
            self._bus.send(message)

    def flush(self, now_ns: int) -> None:
        """Send what is due by now."""
        while self._later and self._later[0][0] <= now_ns:
            self._send(heapq.heappop(self._later)[2])

    def next_ns(self) -> int | None:
        """When the next late reply is due."""
        return self._later[0][0] if self._later else None

    def _send(self, message: can.Message) -> None:
        try:
            self._bus.send(message)
            self.sent += 1
        except can.CanError:
            self.failed += 1

    def _corrupt(self, message: can.Message) -> None:
        size, pick = len(message.data), self._faults.pick
        if pick(2):
            message.data[pick(size)] ^= 1 << pick(8)
        else:
            del message.data[pick(size) :]
            message.dlc = len(message.data)


def spiked(q: float, faults: Faults, now_s: float) -> float:
    """An angle, or one that is far off."""
    if faults.strikes("spike", now_s):
        return q + (SPIKE_RAD if faults.pick(2) else -SPIKE_RAD)
    return q
