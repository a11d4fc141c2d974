"""JointState messages, from whatever recorder, as arrays of one order of joints.

What is decoded waits in files while a recording is read, so that no length needs more memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap.log import Commands
from drivers.files.mcap.series import JOINT_SCHEMAS, Series
from drivers.files.ros import Block
from drivers.files.ros_types import JOINT_STATE
from drivers.files.rows import AT_ONCE, RowsFile, gathered
from drivers.interface import Array, DriverError

_IN_MEMORY = 2**22  # bytes of a column that stay in memory
_RAD_MAX = 4 * np.pi  # no arm joint turns further than two turns either way
_DEGREE_SHARE = 0.05  # of the samples a joint must spend beyond it to be suspected
_NEED = "learning needs positions and measured joint torques (effort)"
_NEED_POSITION = "discovery needs the positions of the joints"
_RUNS = {"q": 0, "dq": 1, "tau": 2}  # of doubles in a message
_CLOCKS = "header_ns", "log_ns"  # of the messages, and of the recorder
STATES, COMMANDS = (*_CLOCKS, "q", "dq", "tau"), (*_CLOCKS, "place", "tau")
_Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Joints:
    """Arrays (m,) and (m, n): stamps ns, positions rad, velocities rad/s, torques N m."""

    names: tuple[str, ...]
    stamp_ns: _Stamps
    q: Array
    dq: Array
    tau: Array


class Clock:
    """What stamps tell that come part by part.

    Attributes:
        back: how often time runs backwards; first_back: (place, ns) of the first time.
        silent: whether all are 0.
    """

    def __init__(self) -> None:
        self.back, self.first_back, self.silent = 0, (0, 0), True
        self._count, self._last = 0, 0

    def take(self, stamp_ns: _Stamps) -> None:
        """Take (k,) stamps that follow."""
        if not len(stamp_ns):
            return
        steps = np.diff(stamp_ns, prepend=self._last if self._count else stamp_ns[0])
        places = np.flatnonzero(steps < 0)
        if places.size and not self.back:
            self.first_back = self._count + int(places[0]), -int(steps[places[0]])
        self.back += places.size
        self.silent = self.silent and not stamp_ns.any()
        self._count, self._last = self._count + len(stamp_ns), int(stamp_ns[-1])


def _stamps_told(header: Clock, log: Clock, count: int, where: str) -> tuple[int, list[str]]:
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


def _stamps_of(header_ns: _Stamps, log_ns: _Stamps, where: str, warnings: list[str]) -> _Stamps:
    clocks = Clock(), Clock()
    for clock, times in zip(clocks, (header_ns, log_ns), strict=True):
        clock.take(times)
    which, said = _stamps_told(*clocks, len(header_ns), where)
    warnings += said
    return (header_ns, log_ns)[which]


def stamps(series: Series, where: str, warnings: list[str]) -> _Stamps:
    """(m,) header stamps; log times where every header stamp is 0."""
    header_ns = series.in_order([block.stamp_ns for block in series.blocks])
    return _stamps_of(header_ns, series.in_order(series.log_ns), where, warnings)


def check_type(series: Series, path: Path) -> None:
    """Raises DriverError where a topic doesn't hold the state of joints in CDR."""
    if not _is_of_joints(series):
        raise DriverError(
            f"{path}: {series.topic} holds {series.schema or 'messages without a type'} encoded "
            f"as {series.encoding or 'unknown'}; need {JOINT_STATE} as cdr "
            f"(or {', '.join(JOINT_SCHEMAS[1:])})"
        )


def _is_of_joints(series: Series) -> bool:
    return series.encoding == "cdr" and series.schema in JOINT_SCHEMAS


def fits(series: Series, effort: bool) -> bool:
    """Whether a topic tells positions (and efforts) of joints."""
    needed = (0, 2) if effort else (0,)
    return _is_of_joints(series) and any(
        b.layout.names and all(_run(b, run) is not None for run in needed) for b in series.blocks
    )


def _run(block: Block, run: int) -> Array | None:
    """A run of doubles with one value for each joint; None where it is absent."""
    values = block.values[run]
    return values if values.shape[1] == len(block.layout.names) else None


class JointRows:
    """Messages of one set of joints that have all that is needed, in the order of the file.

    Attributes:
        names: of the joints.
        columns: a file of each of `STATES` or `COMMANDS`.
        clocks: of the headers and of the recorder.
        messages: how many there were, with those that lack something.
        present: runs (0 q, 1 dq, 2 tau) that any message has; lengths: of each, any of all.
    """

    def __init__(self, names: tuple[str, ...], columns: Sequence[str]) -> None:
        self.names, self.messages = names, 0
        self.columns = {
            key: RowsFile(len(names), _IN_MEMORY)
            if key in _RUNS
            else RowsFile(1, _IN_MEMORY, np.int64)
            for key in columns
        }
        self.clocks = Clock(), Clock()
        self.present: set[int] = set()
        self.lengths: dict[int, set[int]] = {0: set(), 1: set(), 2: set()}

    def __len__(self) -> int:
        return len(self.columns[_CLOCKS[0]])

    def take(self, series: Series, needed: Sequence[int]) -> None:
        """Take messages that follow."""
        kept = []
        for i, block in enumerate(series.blocks):
            self.messages += len(block.index)
            runs = {run for run in range(3) if _run(block, run) is not None}
            self.present |= runs
            for run in range(3):
                self.lengths[run].add(block.values[run].shape[1])
            if runs >= set(needed):
                kept.append(i)
        if not kept:
            return
        part = series.at(kept)
        numbers = {
            "header_ns": [block.stamp_ns for block in part.blocks],
            "log_ns": part.log_ns,
            "place": part.places,
        }
        for key, file in self.columns.items():
            if key in _RUNS:
                file.append(self._doubles(part, _RUNS[key]))
            else:
                table = part.in_order(numbers[key])
                file.append(table[:, None])
                if key in _CLOCKS:
                    self.clocks[_CLOCKS.index(key)].take(table)

    def _doubles(self, series: Series, run: int) -> Array:
        parts = []
        for block in series.blocks:
            values, names = _run(block, run), block.layout.names
            if values is None:
                values = np.full((len(block.index), len(names)), np.nan)
            elif names != self.names:
                values = values[:, [names.index(name) for name in self.names]]
            parts.append(values)
        return series.in_order(parts)

    def clock(self, where: str) -> tuple[str, list[str]]:
        """The column of the stamps in use, and sentences."""
        which, said = _stamps_told(*self.clocks, len(self), where)
        return _CLOCKS[which], said

    def runs_backwards(self) -> bool:
        """Whether the stamps in use do."""
        return self.clocks[_CLOCKS.index(self.clock("")[0])].back > 0

    def stretches(self, *keys: str) -> Iterator[list[NDArray[Any]]]:
        """Columns, so many rows at a time."""
        for start in range(0, len(self), AT_ONCE):
            yield [self.columns[key].rows(start, start + AT_ONCE) for key in keys]


class Told:
    """What a topic tells of joints, part by part, by the set of joints that messages are of.

    Args:
        needed: runs without which a message is of no use; columns: that are kept.
    """

    def __init__(self, needed: Sequence[int], columns: Sequence[str] = STATES) -> None:
        self.sets: dict[frozenset[str], JointRows] = {}
        self._needed, self._columns = needed, columns
        self._messages, self._names = 0, set[str]()

    def take(self, series: Series) -> None:
        """Take messages that follow in the file."""
        found: dict[frozenset[str], list[int]] = {}
        for i, block in enumerate(series.blocks):
            names = block.layout.names
            self._messages += len(block.index)
            self._names.update(names)
            if names and len(set(names)) == len(names):
                found.setdefault(frozenset(names), []).append(i)
        for key, places in found.items():
            part = series.at(places)
            if key not in self.sets:
                self.sets[key] = JointRows(part.blocks[0].layout.names, self._columns)
            self.sets[key].take(part, self._needed)

    def chosen(
        self, series: Series, where: str, want: Sequence[str] | None, warnings: list[str]
    ) -> JointRows:
        """The messages of the joints of `want`, else of the most frequent set.

        Raises:
            DriverError: no message has these joints, or none has positions (and efforts).
        """
        if series.bad:
            place, reason = series.bad[0]
            warnings.append(
                f"{where}: {len(series.bad)} messages are unreadable, first number {place}: "
                f"{reason}"
            )
        sets = self.sets
        if not sets:
            raise DriverError(f"{where} has no readable message that names joints")
        fitting = [s for s in sets if want is None or s.issuperset(want)]
        if not fitting:
            have = "; ".join(", ".join(sorted(s, key=lambda n: (len(n), n))) for s in sets)
            missing = [n for n in want or () if not any(n in s for s in sets)]
            lack = f"has no joint {', '.join(missing)}" if missing else "never has these together"
            raise DriverError(f"{where} {lack}; have: {have}")
        chosen = max(fitting, key=lambda s: sets[s].messages)
        left_out = self._messages - sets[chosen].messages
        if left_out:
            others = ", ".join(sorted(self._names - chosen))
            warnings.append(
                f"{where}: {left_out} messages are of other joints "
                f"({others or 'a part of these, or twice'}); left out"
            )
        self._check_complete(sets[chosen], where, warnings)
        return sets[chosen]

    def _check_complete(self, own: JointRows, where: str, warnings: list[str]) -> None:
        """Say which messages lack positions (or efforts). Raises DriverError where all do."""
        need = _NEED if 2 in self._needed else _NEED_POSITION
        what_of = {0: "position", 2: "effort"}
        for run in self._needed:
            if run not in own.present:
                lengths = ", ".join(map(str, sorted(own.lengths[run])))
                raise DriverError(
                    f"{where} has no {what_of[run]} ({lengths} values for "
                    f"{len(own.names)} joints); {need}"
                )
        if not len(own):
            raise DriverError(f"{where} has no message with both position and effort; {_NEED}")
        if len(own) < own.messages:
            warnings.append(
                f"{where}: {own.messages - len(own)} messages lack "
                f"{' or '.join(what_of[run] for run in self._needed)}; left out"
            )

    def of(self, names: Sequence[str]) -> list[JointRows]:
        """The messages that tell something of these joints."""
        return [x for x in self.sets.values() if len(x) and {*x.names} & {*names}]


class _Seen(NamedTuple):
    """What all samples tell: whether positions and velocities vary and torques are known or not
    0, samples without velocities, the largest position, samples beyond any arm's angle by joint.
    """

    varied: bool
    moving: bool
    torque_known: bool
    torque: bool
    silent: int
    furthest: float
    beyond: NDArray[np.int64]

    @classmethod
    def of(cls, rows: JointRows) -> _Seen:
        varied = moving = known = torque = False
        silent, furthest, beyond = 0, 0.0, np.zeros(len(rows.names), dtype=np.int64)
        first = rows.columns["q"].rows(0, 1)
        for q, dq, tau in rows.stretches("q", "dq", "tau"):
            varied = varied or bool(np.any(q != first))
            moving = moving or bool(np.any(dq))
            known = known or not np.isnan(tau).all()
            torque = torque or bool(np.any(tau))
            silent += int(np.isnan(dq).all(axis=1).sum())
            size = np.abs(q)
            furthest = float(np.fmax(furthest, np.fmax.reduce(size, axis=None)))
            beyond += (size > _RAD_MAX).sum(axis=0)
        return cls(varied, moving, known, torque, silent, furthest, beyond)


def joints_told(
    rows: JointRows, where: str, effort: bool, mapped: bool, warnings: list[str]
) -> Joints:
    """Joint states as arrays, with sentences on what looks wrong.

    Args:
        rows, where: the states, file and topic.
        effort: whether states without efforts are of no use. If not, velocities are not a number
            where no message has any; 0 throughout is none. Else the positions' slope is taken.
        mapped: whether arrays lie in files.

    Raises:
        DriverError: efforts that are needed are not a number throughout.
    """
    seen, count, velocity = _Seen.of(rows), len(rows), rows.columns["dq"]
    if effort and not seen.torque_known:
        raise DriverError(f"{where} has efforts that are not a number throughout; {_NEED}")
    clock, said = rows.clock(where)
    warnings += said
    if not seen.torque_known:
        warnings.append(f"{where} has no efforts: nothing is learned from torques")
    if not effort and seen.varied and (seen.silent == count or not seen.moving):
        nothing = (np.full_like(q, np.nan) for (q,) in rows.stretches("q"))
        velocity = gathered(len(rows.names), nothing)
        warnings.append(f"{where} has no velocities: they are those of the filtered positions")
    elif seen.silent:
        velocity = gathered(len(rows.names), _velocities(rows, clock))
        warnings.append(
            f"{where}: {seen.silent} of {count} messages have no velocity; "
            "derived from the positions"
        )
    if count > 1 and not seen.torque:
        warnings.append(f"{where}: all efforts are 0; does this arm measure torque?")
    if _are_degrees(seen.beyond, count):
        warnings.append(
            f"{where}: positions reach {seen.furthest:.0f} rad; are these degrees? "
            "Recordings hold radians (`adapter import` converts)"
        )
    files = rows.columns[clock], rows.columns["q"], velocity, rows.columns["tau"]
    stamp_ns, q, dq, tau = (file.table(mapped) for file in files)
    return Joints(rows.names, stamp_ns[:, 0], q, dq, tau)


def _velocities(rows: JointRows, clock: str) -> Iterator[Array]:
    """Velocities, the positions' slope where a sample has none."""
    stamps, positions, velocities = (rows.columns[key] for key in (clock, "q", "dq"))
    begin_ns = int(stamps.rows(0, 1)[0, 0])
    for start in range(0, len(rows), AT_ONCE):
        before = min(start, AT_ONCE)  # neighbours, of which one that moves forward is needed
        wide = start - before, start + 2 * AT_ONCE
        slope = derive_velocity(stamps.rows(*wide)[:, 0], positions.rows(*wide), begin_ns)
        dq = velocities.rows(start, start + AT_ONCE)
        silent = np.all(np.isnan(dq), axis=1)
        yield np.where(silent[:, None], slope[before : before + AT_ONCE], dq)


def commands_told(
    told: Told, where: str, names: Sequence[str], mapped: bool, warnings: list[str]
) -> Commands | None:
    """Commanded torques in the order of `names`; joints without a command are not a number.

    Args:
        told: by the topic; where: file and topic; mapped: of one set of joints, in files.
    """
    sets = told.of(names)
    if not sets:
        warnings.append(f"{where}: no message commands a torque of these joints; left out")
        return None
    if mapped:
        (rows,) = sets
        clock, said = rows.clock(where)
        warnings += said
        tau = (_commanded(rows, names, table) for (table,) in rows.stretches("tau"))
        stamp_ns = rows.columns[clock].table(mapped)[:, 0]
        return Commands(stamp_ns, gathered(len(names), tau).table(mapped))
    place, header_ns, log_ns = (
        np.concatenate([x.columns[key].table(False)[:, 0] for x in sets])
        for key in ("place", *_CLOCKS)
    )
    tables = [_commanded(x, names, x.columns["tau"].table(False)) for x in sets]
    order = np.argsort(place, kind="stable")
    stamp_ns = _stamps_of(header_ns[order], log_ns[order], where, warnings)
    return Commands(stamp_ns, np.concatenate(tables)[order])


def _commanded(rows: JointRows, names: Sequence[str], tau: Array) -> Array:
    out = np.full((len(tau), len(names)), np.nan)
    for i, name in enumerate(names):
        if name in rows.names:
            out[:, i] = tau[:, rows.names.index(name)]
    return out


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
    return _are_degrees((np.abs(q) > _RAD_MAX).sum(axis=0), len(q))


def _are_degrees(beyond: NDArray[np.int64], count: int) -> bool:
    """The same by how many of `count` samples each joint (n,) spends beyond."""
    if count == 0:
        return False
    suspects = beyond / count > _DEGREE_SHARE
    return bool(suspects.sum() >= max(1, len(suspects) // 3))
