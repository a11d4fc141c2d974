"""JointState messages, from whatever recorder, as arrays of one order of joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap.joint_rows import (
    Clock,
    CommandRows,
    JointRows,
    States,
    stamps_told,
    topic_at,
)
from drivers.files.mcap.series import JOINT_SCHEMAS, Series
from drivers.files.ros import Block
from drivers.files.ros_types import JOINT_STATE
from drivers.interface import Array, DriverError

MOST_SETS = 32  # of joints of one topic that are taken part by part
_NEED = "learning needs positions and measured joint torques (effort)"
_NEED_POSITION = "discovery needs the positions of the joints"


class TooManySetsError(ValueError):
    """Messages are of so many sets of joints that they cannot be told apart part by part."""


@dataclass(frozen=True, slots=True)
class Joints:
    """Arrays (m,) and (m, n): stamps ns, positions rad, velocities rad/s, torques N m."""

    names: tuple[str, ...]
    stamp_ns: NDArray[np.int64]
    q: Array
    dq: Array
    tau: Array
    warnings: list[str]


@dataclass(frozen=True, slots=True)
class Commands:
    """Commanded joint torques: stamps (k,) ns, torques (k, n) N m in the log's joint order."""

    stamp_ns: NDArray[np.int64]
    tau: Array


def assemble_joints(
    series: Series, path: Path, want: Sequence[str] | None, *, effort: bool = True
) -> Joints:
    """The joint states of a topic, in the order of the file.

    Messages of other joints than the chosen ones (those of `want`, else the most frequent set)
    are left out with a warning; a permuted order of joints is put straight.

    Args:
        series, path: the topic, its file.
        want: names of joints that must be there.
        effort: whether messages without efforts are of no use. If not, torques are not a number
            where there are none, velocities where no message has any; 0 throughout is none.

    Raises:
        DriverError: no message has the joints asked for, or none has positions (and efforts).
    """
    check_type(series, path)
    told = ToldJoints(effort)
    told.take(series)
    rows = told.chosen(series, path, want)
    stamp_ns, q, dq, tau = rows.tables(0, len(rows))
    return Joints(rows.names, stamp_ns, q, dq, tau, rows.warnings)


def check_type(series: Series, path: Path) -> None:
    """Raises DriverError where a topic doesn't hold the state of joints in CDR."""
    if series.encoding != "cdr" or series.schema not in JOINT_SCHEMAS:
        raise DriverError(
            f"{path}: {series.topic} holds {series.schema or 'messages without a type'} encoded "
            f"as {series.encoding or 'unknown'}; need {JOINT_STATE} as cdr "
            f"(or {', '.join(JOINT_SCHEMAS[1:])})"
        )


def fits(series: Series, effort: bool) -> bool:
    """Whether a topic tells positions (and efforts) of joints."""
    if series.encoding != "cdr" or series.schema not in JOINT_SCHEMAS:
        return False
    needed = (0, 2) if effort else (0,)
    return any(
        b.layout.names and all(_run(b, run) is not None for run in needed) for b in series.blocks
    )


def _unreadable(series: Series, where: str) -> list[str]:
    if not series.bad:
        return []
    place, reason = series.bad[0]
    return [f"{where}: {len(series.bad)} messages are unreadable, first number {place}: {reason}"]


def _natural(names: frozenset[str]) -> list[str]:
    return sorted(names, key=lambda n: (len(n), n))


def _column(series: Series, run: int, names: tuple[str, ...]) -> Array:
    parts = []
    for block in series.blocks:
        values = _run(block, run)
        if values is None:
            values = np.full((len(block.index), len(names)), np.nan)
        elif block.layout.names != names:
            values = values[:, [block.layout.names.index(name) for name in names]]
        parts.append(values)
    return np.ascontiguousarray(series.in_order(parts))


def _run(block: Block, run: int) -> Array | None:
    """A run of doubles with one value for each joint; None where it is absent."""
    values = block.values[run]
    return values if values.shape[1] == len(block.layout.names) else None


def stamps(series: Series, where: str, warnings: list[str]) -> NDArray[np.int64]:
    """(m,) header stamps; log times where every header stamp is 0."""
    clocks = Clock(), Clock()
    times = [series.in_order([block.stamp_ns for block in series.blocks])]
    clocks[0].take(times[0])
    if clocks[0].silent:
        times.append(series.in_order(series.log_ns))
        clocks[1].take(times[1])
    which, said = stamps_told(*clocks, len(times[0]), where)
    warnings += said
    return times[which]


class ToldJoints:
    """What a topic tells of joints, part by part, by the set of joints that messages are of.

    Args:
        effort: whether messages without efforts are of no use, see `assemble_joints`.
        most_sets: more of them are refused; None for any number.
    """

    def __init__(self, effort: bool = True, most_sets: int | None = None) -> None:
        self._sets: dict[frozenset[str], _Set] = {}
        self._most_sets = most_sets
        self._effort, self._messages, self._names = effort, 0, set[str]()
        self._needed = (0, 2) if effort else (0,)

    def take(self, series: Series) -> None:
        """Take messages that follow in the file. Raises TooManySets."""
        found: dict[frozenset[str], list[int]] = {}
        for i, block in enumerate(series.blocks):
            names = block.layout.names
            self._messages += len(block.index)
            self._names.update(names)
            if names and len(set(names)) == len(names):
                found.setdefault(frozenset(names), []).append(i)
        for key, places in found.items():
            own = self._sets.get(key)
            if own is None:
                if len(self._sets) == self._most_sets:
                    raise TooManySetsError(f"{series.topic}: messages of ever other joints")
                own = self._sets[key] = _Set(series.blocks[places[0]].layout.names)
            own.take(series, places, self._needed)

    def chosen(self, series: Series, path: Path, want: Sequence[str] | None) -> JointRows:
        """The states of the chosen joints, with sentences on what was left out or looks wrong.

        Raises:
            DriverError: see `assemble_joints`.
        """
        where = topic_at(path, series.topic)
        warnings = _unreadable(series, where)
        own = self._one_set(where, want, warnings)
        self._check_complete(own, where, warnings)
        rows = own.rows
        if rows.no_torque and self._effort:
            raise DriverError(f"{where} has efforts that are not a number throughout; {_NEED}")
        rows.warnings = warnings
        return rows.judge(where, self._effort)

    def _one_set(self, where: str, want: Sequence[str] | None, warnings: list[str]) -> _Set:
        sets = self._sets
        if not sets:
            raise DriverError(f"{where} has no readable message that names joints")
        fitting = [s for s in sets if want is None or s.issuperset(want)]
        if not fitting:
            have = "; ".join(", ".join(_natural(s)) for s in sets)
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
        return sets[chosen]

    def _check_complete(self, own: _Set, where: str, warnings: list[str]) -> None:
        """Say which messages lack positions (or efforts). Raises DriverError where all do."""
        need = _NEED if self._effort else _NEED_POSITION
        what_of = {0: "position", 2: "effort"}
        for run in self._needed:
            if run not in own.present:
                lengths = ", ".join(map(str, sorted(own.lengths[run])))
                raise DriverError(
                    f"{where} has no {what_of[run]} ({lengths} values for "
                    f"{len(own.rows.names)} joints); {need}"
                )
        if not len(own.rows):
            raise DriverError(f"{where} has no message with both position and effort; {_NEED}")
        if len(own.rows) < own.messages:
            warnings.append(
                f"{where}: {own.messages - len(own.rows)} messages lack "
                f"{' or '.join(what_of[run] for run in self._needed)}; left out"
            )


class _Set:
    """Messages of one set of joints.

    Attributes:
        rows: those with all that is needed.
        messages: how many there were.
        present: runs (0 q, 1 dq, 2 tau) that any message has; lengths: of each, any of all.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self.rows, self.messages = JointRows(names), 0
        self.present: set[int] = set()
        self.lengths: dict[int, set[int]] = {0: set(), 1: set(), 2: set()}

    def take(self, series: Series, places: list[int], needed: tuple[int, ...]) -> None:
        """Take the blocks at these places."""
        kept = []
        for i in places:
            block = series.blocks[i]
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
        stamp_ns = part.in_order([block.stamp_ns for block in part.blocks])
        q, dq, tau = (_column(part, run, self.rows.names) for run in range(3))
        self.rows.append(States(stamp_ns, q, dq, tau), part.in_order(part.log_ns))


class ToldCommands:
    """Commanded torques that a topic tells, part by part.

    Raises:
        TooManySetsError: from `take`, where messages command several sets of joints in turn.
    """

    def __init__(self) -> None:
        self.rows: CommandRows | None = None

    def take(self, series: Series) -> None:
        """Take messages that follow in the file."""
        places = [
            i
            for i, block in enumerate(series.blocks)
            if block.layout.names and _run(block, 2) is not None
        ]
        if not places:
            return
        names = series.blocks[places[0]].layout.names
        rows = self.rows = self.rows or CommandRows(names)
        if any({*series.blocks[i].layout.names} != {*rows.names} for i in places):
            raise TooManySetsError(f"{series.topic}: commands of several sets of joints")
        part = series.at(places)
        stamp_ns = part.in_order([block.stamp_ns for block in part.blocks])
        rows.append(stamp_ns, part.in_order(part.log_ns), _column(part, 2, rows.names))


def read_commands(
    series: Series, path: Path, names: tuple[str, ...], warnings: list[str]
) -> Commands | None:
    """Commanded torques in the order of `names`; joints without a command are not a number."""
    where = f"{path}: {series.topic}"
    check_type(series, path)
    part = series.only(lambda b: _run(b, 2) is not None and bool(set(names) & set(b.layout.names)))
    if not part.blocks:
        warnings.append(no_commands(where))
        return None
    parts = []
    for block in part.blocks:
        tau = np.full((len(block.index), len(names)), np.nan)
        for i, name in enumerate(names):
            if name in block.layout.names:
                tau[:, i] = block.values[2][:, block.layout.names.index(name)]
        parts.append(tau)
    return Commands(stamps(part, where, warnings), part.in_order(parts))


def no_commands(where: str) -> str:
    """A sentence on a topic of commands that are of no use."""
    return f"{where}: no message commands a torque of these joints; left out"
