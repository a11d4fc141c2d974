"""Joint states and commands that wait in a file while a recording is read, and what they tell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.files.rows import RowsFile
from drivers.interface import Array

AT_ONCE = 2**14  # rows that are worked on together
_IN_MEMORY = 2**22  # bytes of a table that stay in memory
_RAD_MAX = 4 * np.pi  # no arm joint turns further than two turns either way
_DEGREE_SHARE = 0.05  # of the samples a joint must spend beyond it to be suspected
_Stamps = NDArray[np.int64]


class Clock:
    """What stamps tell that come part by part.

    Attributes:
        begin_ns, end_ns: the earliest and the latest.
        back: how often time runs backwards; first_back: (place, ns) of the first time.
        silent: whether all are 0.
    """

    def __init__(self) -> None:
        self.begin_ns, self.end_ns = np.iinfo(np.int64).max, np.iinfo(np.int64).min
        self.back, self.first_back, self.silent = 0, (0, 0), True
        self._count, self._last = 0, 0

    def take(self, stamp_ns: _Stamps) -> None:
        """Take (k,) stamps that follow."""
        if not len(stamp_ns):
            return
        first = self._last if self._count else int(stamp_ns[0])
        steps = np.diff(stamp_ns, prepend=first)
        places = np.flatnonzero(steps < 0)
        if places.size and not self.back:
            self.first_back = self._count + int(places[0]), -int(steps[places[0]])
        self.back += places.size
        self.begin_ns = min(self.begin_ns, int(stamp_ns.min()))
        self.end_ns = max(self.end_ns, int(stamp_ns.max()))
        self.silent = self.silent and not stamp_ns.any()
        self._count, self._last = self._count + len(stamp_ns), int(stamp_ns[-1])


def stamps_told(header: Clock, log: Clock, count: int, where: str) -> tuple[int, list[str]]:
    """Which clock of a topic is used, 0 its headers' and 1 the recorder's, and sentences."""
    said, which = [], 0
    if count > 1 and header.silent:
        which = 1
        said.append(f"{where}: header stamps are 0; the recorder's log times are used")
    clock = (header, log)[which]
    if clock.back:
        place, step_ns = clock.first_back
        said.append(
            f"{where}: time runs backwards {clock.back} times, first by {step_ns / 1e6:.3f} ms at "
            f"sample {place}"
        )
    return which, said


class States(NamedTuple):
    """Joint states: stamps (m,) ns, q, dq, tau (m, n) rad, rad/s, N m."""

    stamp_ns: _Stamps
    q: Array
    dq: Array
    tau: Array


class JointRows:
    """Joint states of one set of joints, in the order of the file.

    Attributes:
        names: of the joints.
        warnings: sentences, once `judge` has looked at them.
        clock: of the stamps in use.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names, n = tuple(names), len(names)
        self.warnings: list[str] = []
        self._rows = RowsFile(2 + 3 * n, _IN_MEMORY)
        self._clocks = Clock(), Clock()
        self._which, self._blind = 0, False
        self._first = np.full(n, np.nan)
        self._varied = self._torque = self._torque_known = self._moving = False
        self._silent, self._furthest = 0, 0.0
        self._beyond = np.zeros(n, dtype=np.int64)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def clock(self) -> Clock:
        """Of the stamps in use."""
        return self._clocks[self._which]

    @property
    def no_torque(self) -> bool:
        """Whether no torque of any sample is a number."""
        return not self._torque_known

    def append(self, states: States, log_ns: _Stamps | None = None) -> None:
        """Take states that follow, and the recorder's times of them (the stamps where None)."""
        stamp_ns, q, dq, tau = states
        log_ns = stamp_ns if log_ns is None else log_ns
        if not len(q):
            return
        if not len(self):
            self._first = q[0].copy()
        for clock, times in zip(self._clocks, (stamp_ns, log_ns), strict=True):
            clock.take(times)
        self._varied = self._varied or bool(np.any(q != self._first))
        self._torque = self._torque or bool(np.any(tau))
        self._torque_known = self._torque_known or not np.isnan(tau).all()
        self._moving = self._moving or bool(np.any(dq))
        self._silent += int(np.isnan(dq).all(axis=1).sum())
        size = np.abs(q)
        self._furthest = float(np.fmax(self._furthest, np.fmax.reduce(size, axis=None)))
        self._beyond += (size > _RAD_MAX).sum(axis=0)
        times_ns = np.stack([stamp_ns, log_ns], axis=1).view(np.float64)
        self._rows.append(np.concatenate([times_ns, q, dq, tau], axis=1))

    def judge(self, where: str, effort: bool) -> JointRows:
        """Choose the clock, derive velocities that are missing, and say what looks wrong.

        Args:
            where: file and topic; effort: see `joints.assemble_joints`.
        """
        count, said = len(self), self.warnings
        self._which, words = stamps_told(*self._clocks, count, where)
        said += words
        if self.no_torque:
            said.append(f"{where} has no efforts: nothing is learned from torques")
        no_speed = self._silent == count or not self._moving
        rows = self
        if not effort and no_speed and self._varied:
            self._blind = True
            said.append(f"{where} has no velocities: they are those of the filtered positions")
        elif self._silent:
            rows = self._with_velocities()
            said.append(
                f"{where}: {self._silent} of {count} messages have no velocity; "
                "derived from the positions"
            )
        if count > 1 and not self._torque:
            said.append(f"{where}: all efforts are 0; does this arm measure torque?")
        if degrees_told(self._beyond, count):
            said.append(
                f"{where}: positions reach {self._furthest:.0f} rad; are these degrees? "
                "Recordings hold radians (`adapter import` converts)"
            )
        return rows

    def tables(self, start: int, stop: int) -> States:
        """Samples `start` to `stop` (not included), as far as there are such."""
        rows, n = self._rows.rows(start, stop), len(self.names)
        stamp_ns = np.ascontiguousarray(rows[:, self._which]).view(np.int64)
        q, dq, tau = (np.ascontiguousarray(rows[:, 2 + k * n : 2 + (k + 1) * n]) for k in range(3))
        return States(stamp_ns, q, np.full_like(q, np.nan) if self._blind else dq, tau)

    def _with_velocities(self) -> JointRows:
        """The same, with the positions' slope where a sample has no velocity."""
        out, begin_ns = JointRows(self.names), int(self.tables(0, 1).stamp_ns[0])
        out.warnings = self.warnings
        for start in range(0, len(self), AT_ONCE):
            before = min(start, AT_ONCE)  # neighbours, of which one that moves forward is needed
            wide = self.tables(start - before, start + 2 * AT_ONCE)
            slope = derive_velocity(wide.stamp_ns, wide.q, begin_ns)
            silent: NDArray[np.bool_] = np.all(np.isnan(wide.dq), axis=1)
            dq = np.where(silent[:, None], slope, wide.dq)
            own = slice(before, before + AT_ONCE)
            out.append(States(wide.stamp_ns[own], wide.q[own], dq[own], wide.tau[own]))
        return out


class CommandRows:
    """Commanded torques of one set of joints, in the order of the file."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.clocks = Clock(), Clock()
        self._rows = RowsFile(2 + len(names), _IN_MEMORY)

    def __len__(self) -> int:
        return len(self._rows)

    def append(self, stamp_ns: _Stamps, log_ns: _Stamps, tau: Array) -> None:
        """Take commands (k, n), N m, that follow."""
        for clock, times in zip(self.clocks, (stamp_ns, log_ns), strict=True):
            clock.take(times)
        times_ns = np.stack([stamp_ns, log_ns], axis=1).view(np.float64)
        self._rows.append(np.concatenate([times_ns, tau], axis=1))

    def tables(self, start: int, stop: int, which: int) -> tuple[_Stamps, Array]:
        """Commands `start` to `stop` (not included): stamps by clock `which`, and torques."""
        rows = self._rows.rows(start, stop)
        return np.ascontiguousarray(rows[:, which]).view(np.int64), rows[:, 2:]

    def first_from(self, stamp_ns: int, which: int) -> int:
        """Place of the first command at or after a stamp, of commands in the order of time."""
        low, high = 0, len(self)
        while low < high:
            middle = (low + high) // 2
            if int(self.tables(middle, middle + 1, which)[0][0]) < stamp_ns:
                low = middle + 1
            else:
                high = middle
        return low


def derive_velocity(stamp_ns: _Stamps, q: Array, begin_ns: int | None = None) -> Array:
    """(m, n) central differences of the positions, over times that move forward.

    Args:
        stamp_ns: (m,); q: (m, n) rad; begin_ns: of the recording that they are a part of.
    """
    latest = np.maximum.accumulate(stamp_ns)
    forward = np.concatenate([[True], latest[1:] > latest[:-1]])
    if forward.sum() < 2:
        return np.zeros_like(q)
    seconds = (stamp_ns[forward] - (stamp_ns[0] if begin_ns is None else begin_ns)) * 1e-9
    derived = np.gradient(q[forward], seconds, axis=0)
    return derived[np.cumsum(forward) - 1]


def looks_like_degrees(q: Array) -> bool:
    """Whether a third of the joints stay long beyond what an arm can turn in radians."""
    return degrees_told((np.abs(q) > _RAD_MAX).sum(axis=0), len(q))


def degrees_told(beyond: NDArray[np.int64], count: int) -> bool:
    """The same by how many of `count` samples each joint (n,) spends beyond."""
    if count == 0:
        return False
    suspects = beyond / count > _DEGREE_SHARE
    return bool(suspects.sum() >= max(1, len(suspects) // 3))


def topic_at(path: Path, topic: str) -> str:
    """How sentences name a topic of a file."""
    return f"{path}: {topic}"
