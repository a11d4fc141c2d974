"""JointState messages, from whatever recorder, as arrays of one order of joints.

What is decoded waits in files while a recording is read, so that no length needs more memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap.log import Commands
from drivers.files.mcap.series import JOINT_SCHEMAS, Series, in_order
from drivers.files.ros import Block
from drivers.files.ros_types import JOINT_STATE
from drivers.files.rows import AT_ONCE, RowsFile, gathered
from drivers.interface import Array, DriverError

_IN_MEMORY = 2**20  # bytes of a column that stay in memory
_RAD_MAX = 4 * np.pi  # no arm joint turns further than two turns either way
_NEED = (
    "learning needs positions and measured joint torques (effort); of positions with commanded "
    "ones beside them `adapter gap` tells the servos"
)
Q, DQ, TAU, GOAL = range(4)  # runs of doubles in a message; few kinds have the last one
_CALLED = {Q: "position", TAU: "effort", GOAL: "reference"}
_CLOCKS = attrgetter("stamp_ns"), attrgetter("log_ns")  # of a block
_PLACE = attrgetter("index")
_Stamps = NDArray[np.int64]


def stamps_file() -> RowsFile:
    """Where stamps (m, 1) ns wait."""
    return RowsFile(1, _IN_MEMORY, np.int64)


def in_use(header: RowsFile, log: RowsFile, where: str, warnings: list[str]) -> RowsFile:
    """The stamps of the messages' headers; the recorder's where every one of these is 0."""
    clock = header
    if len(header) > 1 and not any(part.any() for part in header.stretches()):
        clock = log
        warnings.append(f"{where}: header stamps are 0; the recorder's log times are used")
    times, place, step_ns = steps_back(clock)
    if times:
        warnings.append(
            f"{where}: time runs backwards {times} times, first by {step_ns / 1e6:.3f} ms at "
            f"sample {place}"
        )
    return clock


def steps_back(clock: RowsFile) -> tuple[int, int, int]:
    """How often time runs backwards, and place and ns of the first time."""
    times, first, last = 0, (0, 0), int(clock.rows(0, 1)[0, 0]) if len(clock) else 0
    for k, part in enumerate(clock.stretches()):
        steps = np.diff(part[:, 0], prepend=last)
        places = np.flatnonzero(steps < 0)
        if places.size and not times:
            first = AT_ONCE * k + int(places[0]), -int(steps[places[0]])
        times, last = times + places.size, int(part[-1, 0])
    return times, *first


def _stamps_of(clocks: Sequence[_Stamps], where: str, warnings: list[str]) -> _Stamps:
    files = stamps_file(), stamps_file()
    for file, stamp_ns in zip(files, clocks, strict=True):
        file.append(stamp_ns[:, None])
    return in_use(*files, where, warnings).table(False)[:, 0]


def stamps(series: Series, where: str, warnings: list[str]) -> _Stamps:
    """(m,) header stamps; log times where every header stamp is 0."""
    clocks = [in_order(series.blocks, clock) for clock in _CLOCKS]
    return _stamps_of(clocks, where, warnings)


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


def fits(series: Series, *needed: int) -> bool:
    """Whether a topic tells these runs of joints."""
    return _is_of_joints(series) and any(
        names and all(lengths[run : run + 1] == (len(names),) for run in needed)
        for names, lengths in series.kinds
    )


def _run(block: Block, run: int) -> Array | None:
    """A run of doubles with one value for each joint; None where it is absent."""
    values = block.values[run] if run < len(block.values) else None
    return values if values is not None and values.shape[1] == len(block.layout.names) else None


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
        self.clocks = stamps_file(), stamps_file()
        self.place = stamps_file()
        self.runs = {run: RowsFile(len(names), _IN_MEMORY) for run in kept}
        self.present: set[int] = set()
        self.lengths: dict[int, set[int]] = {Q: set(), DQ: set(), TAU: set(), GOAL: set()}

    def __len__(self) -> int:
        return len(self.place)

    def take(self, blocks: Sequence[Block], needed: Sequence[int]) -> None:
        """Take messages that follow."""
        kept = []
        for block in blocks:
            self.messages += len(block.index)
            runs = {run for run in self.lengths if _run(block, run) is not None}
            self.present |= runs
            for run, values in enumerate(block.values):
                self.lengths[run].add(values.shape[1])
            if runs >= set(needed):
                kept.append(block)
        if not kept:
            return
        for file, own in zip((*self.clocks, self.place), (*_CLOCKS, _PLACE), strict=True):
            file.append(in_order(kept, own)[:, None])
        for run, table in self.runs.items():
            table.append(in_order(kept, partial(self._doubles, run)))

    def _doubles(self, run: int, block: Block) -> Array:
        values, names = _run(block, run), block.layout.names
        if values is None:
            return np.full((len(block.index), len(names)), np.nan)
        if names == self.names:
            return values
        return values[:, [names.index(name) for name in self.names]]


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
        found: dict[frozenset[str], list[Block]] = {}
        for block in series.blocks:
            names = block.layout.names
            self._messages += len(block.index)
            self._names.update(names)
            if names and len(set(names)) == len(names):
                found.setdefault(frozenset(names), []).append(block)
        for key, blocks in found.items():
            if key not in self.sets:
                self.sets[key] = JointRows(blocks[0].layout.names, self._kept)
            self.sets[key].take(blocks, self._needed)

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
        own = sets[chosen]
        need = _NEED if TAU in self._needed else "discovery needs the positions of the joints"
        for run in self._needed:
            if run not in own.present:
                lengths = ", ".join(map(str, sorted(own.lengths[run])))
                raise DriverError(
                    f"{where} has no {_CALLED[run]} ({lengths} values for "
                    f"{len(own.names)} joints); {need}"
                )
        if not len(own):
            raise DriverError(f"{where} has no message with both position and effort; {_NEED}")
        if len(own) < own.messages:
            warnings.append(
                f"{where}: {own.messages - len(own)} messages lack "
                f"{' or '.join(_CALLED[run] for run in self._needed)}; left out"
            )
        return own


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
    count, velocity, first = len(rows), rows.runs[DQ], rows.runs[Q].rows(0, 1)
    seen = [
        (
            *(np.any(q != first), np.any(dq), ~np.isnan(tau).all(), np.any(tau)),
            np.isnan(dq).all(axis=1).sum(),
            np.fmax.reduce(np.abs(q), axis=None),
            (np.abs(q) > _RAD_MAX).sum(axis=0),
        )
        for q, dq, tau in zip(*(rows.runs[run].stretches() for run in (Q, DQ, TAU)), strict=True)
    ]
    varied, moving, known, torque, silent, furthest, beyond = zip(*seen, strict=True)
    without = sum(silent)
    if effort and not any(known):
        raise DriverError(f"{where} has efforts that are not a number throughout; {_NEED}")
    clock = in_use(*rows.clocks, where, warnings)
    if not any(known):
        warnings.append(f"{where} has no efforts: nothing is learned from torques")
    if not effort and any(varied) and (without == count or not any(moving)):
        nothing = (np.full_like(q, np.nan) for q in rows.runs[Q].stretches())
        velocity = gathered(velocity.width, nothing)
        warnings.append(f"{where} has no velocities: they are those of the filtered positions")
    elif without:
        velocity = gathered(velocity.width, _velocities(rows, clock))
        warnings.append(
            f"{where}: {without} of {count} messages have no velocity; derived from the positions"
        )
    if count > 1 and not any(torque):
        warnings.append(f"{where}: all efforts are 0; does this arm measure torque?")
    if _are_degrees(np.sum(beyond, axis=0), count):
        warnings.append(
            f"{where}: positions reach {np.fmax.reduce(furthest):.0f} rad; are these degrees? "
            "Recordings hold radians (`adapter import` converts)"
        )
    q, dq, tau = (file.table(mapped) for file in (rows.runs[Q], velocity, rows.runs[TAU]))
    return clock.table(mapped)[:, 0], q, dq, tau


def _velocities(rows: JointRows, clock: RowsFile) -> Iterator[Array]:
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
        parts = (_commanded(rows, names, x) for x in rows.runs[TAU].stretches())
        tau = gathered(len(names), parts)
        return Commands(clock.table(mapped)[:, 0], tau.table(mapped))
    place, *clocks = (
        np.concatenate([file.table(False)[:, 0] for file in files])
        for files in zip(*((x.place, *x.clocks) for x in sets), strict=True)
    )
    order = np.argsort(place, kind="stable")
    clocks = [clock[order] for clock in clocks]
    tables = [_commanded(x, names, x.runs[TAU].table(False)) for x in sets]
    return Commands(_stamps_of(clocks, where, warnings), np.concatenate(tables)[order])


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
    suspects = beyond / count > 0.05  # of the samples a joint must spend beyond it to be suspected
    return bool(suspects.sum() >= max(1, len(suspects) // 3))
