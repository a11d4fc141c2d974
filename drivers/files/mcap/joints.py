"""JointState messages, from whatever recorder, as arrays of one order of joints.

What is decoded waits in files while a recording is read, so that no length needs more memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap.log import Commands
from drivers.files.mcap.series import JOINT_SCHEMAS, Series
from drivers.files.ros import Block
from drivers.files.ros_types import JOINT_STATE
from drivers.files.rows import AT_ONCE, RowsFile, gathered
from drivers.interface import Array, DriverError

_IN_MEMORY = 2**20  # bytes of a column that stay in memory
_RAD_MAX = 4 * np.pi  # no arm joint turns further than two turns either way
_DEGREE_SHARE = 0.05  # of the samples a joint must spend beyond it to be suspected
_NEED = "learning needs positions and measured joint torques (effort)"
_NEED_POSITION = "discovery needs the positions of the joints"
Q, DQ, TAU = range(3)  # runs of doubles in a message
_Stamps = NDArray[np.int64]


class StampsFile(RowsFile):
    """Stamps (m, 1) ns, and what they tell while they come.

    Attributes:
        back: how often time runs backwards; first_back: (place, ns) of the first time.
        silent: whether all are 0.
    """

    def __init__(self) -> None:
        super().__init__(1, _IN_MEMORY, np.int64)
        self.back, self.first_back, self.silent, self._last = 0, (0, 0), True, 0

    def append(self, table: _Stamps) -> None:
        """Take (k, 1) stamps that follow."""
        if not len(table):
            return
        steps = np.diff(table[:, 0], prepend=self._last if len(self) else table[0, 0])
        places = np.flatnonzero(steps < 0)
        if places.size and not self.back:
            self.first_back = len(self) + int(places[0]), -int(steps[places[0]])
        self.back += places.size
        self.silent = self.silent and not table.any()
        self._last = int(table[-1, 0])
        super().append(table)


def in_use(header: StampsFile, log: StampsFile, where: str, warnings: list[str]) -> StampsFile:
    """The stamps of the messages' headers; the recorder's where every one of these is 0."""
    clock = header
    if len(header) > 1 and header.silent:
        clock = log
        warnings.append(f"{where}: header stamps are 0; the recorder's log times are used")
    if clock.back:
        place, step_ns = clock.first_back
        warnings.append(
            f"{where}: time runs backwards {clock.back} times, first by {step_ns / 1e6:.3f} ms at "
            f"sample {place}"
        )
    return clock


def _stamps_of(clocks: Sequence[_Stamps], where: str, warnings: list[str]) -> _Stamps:
    files = StampsFile(), StampsFile()
    for file, stamp_ns in zip(files, clocks, strict=True):
        file.append(stamp_ns[:, None])
    return in_use(*files, where, warnings).table(False)[:, 0]


def stamps(series: Series, where: str, warnings: list[str]) -> _Stamps:
    """(m,) header stamps; log times where every header stamp is 0."""
    clocks = [block.stamp_ns for block in series.blocks], series.log_ns
    return _stamps_of([series.in_order(parts) for parts in clocks], where, warnings)


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
    needed = (Q, TAU) if effort else (Q,)
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
        clocks: stamps of the headers and of the recorder; place: in the topic's order.
        runs: (m, n) files of the runs of doubles that are kept.
        messages: how many there were, with those that lack something.
        present: runs that any message has; lengths: of each, any of all.
    """

    def __init__(self, names: tuple[str, ...], kept: Sequence[int]) -> None:
        self.names, self.messages = names, 0
        self.clocks = StampsFile(), StampsFile()
        self.place = StampsFile()
        self.runs = {run: RowsFile(len(names), _IN_MEMORY) for run in kept}
        self.present: set[int] = set()
        self.lengths: dict[int, set[int]] = {Q: set(), DQ: set(), TAU: set()}

    def __len__(self) -> int:
        return len(self.place)

    def take(self, series: Series, needed: Sequence[int]) -> None:
        """Take messages that follow."""
        kept = []
        for i, block in enumerate(series.blocks):
            self.messages += len(block.index)
            runs = {run for run in self.lengths if _run(block, run) is not None}
            self.present |= runs
            for run, lengths in self.lengths.items():
                lengths.add(block.values[run].shape[1])
            if runs >= set(needed):
                kept.append(i)
        if not kept:
            return
        part = series.at(kept)
        header_ns = [block.stamp_ns for block in part.blocks]
        for file, own in zip(
            (*self.clocks, self.place), (header_ns, part.log_ns, part.places), strict=True
        ):
            file.append(part.in_order(own)[:, None])
        for run, table in self.runs.items():
            table.append(part.in_order([self._doubles(block, run) for block in part.blocks]))

    def _doubles(self, block: Block, run: int) -> Array:
        values, names = _run(block, run), block.layout.names
        if values is None:
            return np.full((len(block.index), len(names)), np.nan)
        if names == self.names:
            return values
        return values[:, [names.index(name) for name in self.names]]

    def stretches(self, *runs: int) -> Iterator[list[Array]]:
        """Runs of doubles, so many rows at a time."""
        for start in range(0, len(self), AT_ONCE):
            yield [self.runs[run].rows(start, start + AT_ONCE) for run in runs]


class Told:
    """What a topic tells of joints, part by part, by the set of joints that messages are of.

    Args:
        needed: runs without which a message is of no use; kept: runs that are.
    """

    def __init__(self, needed: Sequence[int], kept: Sequence[int] = (Q, DQ, TAU)) -> None:
        self.sets: dict[frozenset[str], JointRows] = {}
        self._needed, self._kept = needed, kept
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
                self.sets[key] = JointRows(part.blocks[0].layout.names, self._kept)
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
        need = _NEED if TAU in self._needed else _NEED_POSITION
        what_of = {Q: "position", TAU: "effort"}
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
        first = rows.runs[Q].rows(0, 1)
        for q, dq, tau in rows.stretches(Q, DQ, TAU):
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
) -> tuple[_Stamps, Array, Array, Array]:
    """Stamps (m,), positions, velocities and efforts (m, n); sentences on what looks wrong.

    Args:
        rows, where: the states, file and topic.
        effort: whether states without efforts are of no use. If not, velocities are not a number
            where no message has any; 0 throughout is none. Else the positions' slope is taken.
        mapped: whether arrays lie in files.

    Raises:
        DriverError: efforts that are needed are not a number throughout.
    """
    seen, count, velocity = _Seen.of(rows), len(rows), rows.runs[DQ]
    if effort and not seen.torque_known:
        raise DriverError(f"{where} has efforts that are not a number throughout; {_NEED}")
    clock = in_use(*rows.clocks, where, warnings)
    if not seen.torque_known:
        warnings.append(f"{where} has no efforts: nothing is learned from torques")
    if not effort and seen.varied and (seen.silent == count or not seen.moving):
        velocity = gathered(velocity.width, (np.full_like(q, np.nan) for (q,) in rows.stretches(Q)))
        warnings.append(f"{where} has no velocities: they are those of the filtered positions")
    elif seen.silent:
        velocity = gathered(velocity.width, _velocities(rows, clock))
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
    q, dq, tau = (file.table(mapped) for file in (rows.runs[Q], velocity, rows.runs[TAU]))
    return clock.table(mapped)[:, 0], q, dq, tau


def _velocities(rows: JointRows, clock: StampsFile) -> Iterator[Array]:
    """Velocities, the positions' slope where a sample has none."""
    begin_ns = int(clock.rows(0, 1)[0, 0])
    for start in range(0, len(rows), AT_ONCE):
        before = min(start, AT_ONCE)  # neighbours, of which one that moves forward is needed
        wide = start - before, start + 2 * AT_ONCE
        slope = derive_velocity(clock.rows(*wide)[:, 0], rows.runs[Q].rows(*wide), begin_ns)
        dq = rows.runs[DQ].rows(start, start + AT_ONCE)
        silent = np.all(np.isnan(dq), axis=1)
        yield np.where(silent[:, None], slope[before : before + AT_ONCE], dq)


def commands_told(
    sets: Sequence[JointRows], where: str, names: Sequence[str], mapped: bool, warnings: list[str]
) -> Commands | None:
    """Commanded torques in the order of `names`; joints without a command are not a number.

    Args:
        sets: that command any of them; where: file and topic; mapped: one set, in files.
    """
    if not sets:
        warnings.append(f"{where}: no message commands a torque of these joints; left out")
        return None
    if len(sets) == 1:
        (rows,) = sets
        clock = in_use(*rows.clocks, where, warnings)
        tau = gathered(len(names), (_commanded(rows, names, x) for (x,) in rows.stretches(TAU)))
        return Commands(clock.table(mapped)[:, 0], tau.table(mapped))
    order = np.argsort(_joined([x.place for x in sets]), kind="stable")
    clocks = [_joined(files)[order] for files in zip(*(x.clocks for x in sets), strict=True)]
    tables = [_commanded(x, names, x.runs[TAU].table(False)) for x in sets]
    return Commands(_stamps_of(clocks, where, warnings), np.concatenate(tables)[order])


def _joined(files: Sequence[StampsFile]) -> _Stamps:
    return np.concatenate([file.table(False)[:, 0] for file in files])


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
