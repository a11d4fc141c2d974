"""JointState messages, from whatever recorder, as arrays of one order of joints."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap.series import JOINT_SCHEMAS, Series
from drivers.files.ros import Block
from drivers.files.ros_types import JOINT_STATE
from drivers.interface import Array, DriverError

_RAD_MAX = 4 * np.pi  # no arm joint turns further than two turns either way
_DEGREE_SHARE = 0.05  # of the samples a joint must spend beyond it to be suspected
_NEED = "learning needs positions and measured joint torques (effort)"
_NEED_POSITION = "discovery needs the positions of the joints"


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
    where = f"{path}: {series.topic}"
    check_type(series, path)
    warnings = _unreadable(series, where)
    series = _one_set_of_joints(series, where, want, warnings)
    names = series.blocks[0].layout.names
    series = _complete(series, where, warnings, effort)
    stamp_ns = stamps(series, where, warnings)
    q, dq, tau = (_column(series, run, names) for run in range(3))
    if np.isnan(tau).all():
        if effort:
            raise DriverError(f"{where} has efforts that are not a number throughout; {_NEED}")
        warnings.append(f"{where} has no efforts: nothing is learned from torques")
    absent: NDArray[np.bool_] = np.all(np.isnan(dq), axis=1)
    if not effort and (absent.all() or not np.any(dq)) and np.any(q != q[:1]):
        dq = np.full_like(q, np.nan)
        warnings.append(f"{where} has no velocities: they are those of the filtered positions")
    elif absent.any():
        dq = np.where(absent[:, None], derive_velocity(stamp_ns, q), dq)
        warnings.append(
            f"{where}: {int(absent.sum())} of {len(q)} messages have no velocity; "
            "derived from the positions"
        )
    if len(tau) > 1 and not np.any(tau):
        warnings.append(f"{where}: all efforts are 0; does this arm measure torque?")
    if looks_like_degrees(q):
        warnings.append(
            f"{where}: positions reach {np.nanmax(np.abs(q)):.0f} rad; are these degrees? "
            "Recordings hold radians (`adapter import` converts)"
        )
    return Joints(names, stamp_ns, q, dq, tau, warnings)


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


def _one_set_of_joints(
    series: Series, where: str, want: Sequence[str] | None, warnings: list[str]
) -> Series:
    sets: Counter[frozenset[str]] = Counter()
    for block in series.blocks:
        names = block.layout.names
        if names and len(set(names)) == len(names):
            sets[frozenset(names)] += len(block.index)
    if not sets:
        raise DriverError(f"{where} has no readable message that names joints")
    fitting = [s for s in sets if want is None or s.issuperset(want)]
    if not fitting:
        have = "; ".join(", ".join(_natural(s)) for s in sets)
        missing = [n for n in want or () if not any(n in s for s in sets)]
        lack = f"has no joint {', '.join(missing)}" if missing else "never has these together"
        raise DriverError(f"{where} {lack}; have: {have}")
    chosen = max(fitting, key=lambda s: sets[s])
    part = series.only(
        lambda b: frozenset(b.layout.names) == chosen and len(b.layout.names) == len(chosen)
    )
    left_out = sum(len(b.index) for b in series.blocks) - part.count
    if left_out:
        others = sorted({n for b in series.blocks for n in b.layout.names} - chosen)
        warnings.append(
            f"{where}: {left_out} messages are of other joints "
            f"({', '.join(others) or 'a part of these, or twice'}); left out"
        )
    return part


def _natural(names: frozenset[str]) -> list[str]:
    return sorted(names, key=lambda n: (len(n), n))


def _run(block: Block, run: int) -> Array | None:
    """A run of doubles with one value for each joint; None where it is absent."""
    values = block.values[run]
    return values if values.shape[1] == len(block.layout.names) else None


def _complete(series: Series, where: str, warnings: list[str], effort: bool) -> Series:
    """Messages with positions (and efforts); what else has another length counts as absent."""
    needed, need = ((0, 2), _NEED) if effort else ((0,), _NEED_POSITION)
    what_of = {0: "position", 2: "effort"}
    for run in needed:
        if all(_run(block, run) is None for block in series.blocks):
            lengths = sorted({block.values[run].shape[1] for block in series.blocks})
            count = len(series.blocks[0].layout.names)
            raise DriverError(
                f"{where} has no {what_of[run]} ({', '.join(map(str, lengths))} values for "
                f"{count} joints); {need}"
            )
    part = series.only(lambda b: all(_run(b, run) is not None for run in needed))
    if not part.blocks:
        raise DriverError(f"{where} has no message with both position and effort; {_NEED}")
    if part.count < series.count:
        warnings.append(
            f"{where}: {series.count - part.count} messages lack "
            f"{' or '.join(what_of[run] for run in needed)}; left out"
        )
    return part


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


def stamps(series: Series, where: str, warnings: list[str]) -> NDArray[np.int64]:
    """(m,) header stamps; log times where every header stamp is 0."""
    stamp_ns = series.in_order([block.stamp_ns for block in series.blocks])
    if len(stamp_ns) > 1 and not np.any(stamp_ns):
        stamp_ns = series.in_order(series.log_ns)
        warnings.append(f"{where}: header stamps are 0; the recorder's log times are used")
    back = np.flatnonzero(np.diff(stamp_ns) < 0)
    if back.size:
        step_ms = (stamp_ns[back[0]] - stamp_ns[back[0] + 1]) / 1e6
        warnings.append(
            f"{where}: time runs backwards {back.size} times, first by {step_ms:.3f} ms at "
            f"sample {back[0] + 1}"
        )
    return stamp_ns


def derive_velocity(stamp_ns: NDArray[np.int64], q: Array) -> Array:
    """(m, n) central differences of the positions, over times that move forward."""
    latest = np.maximum.accumulate(stamp_ns)
    forward = np.concatenate([[True], latest[1:] > latest[:-1]])
    if forward.sum() < 2:
        return np.zeros_like(q)
    seconds = (stamp_ns[forward] - stamp_ns[0]) * 1e-9
    derived = np.gradient(q[forward], seconds, axis=0)
    return derived[np.cumsum(forward) - 1]


def looks_like_degrees(q: Array) -> bool:
    """Whether a third of the joints stay long beyond what an arm can turn in radians."""
    if len(q) == 0:
        return False
    beyond = (np.abs(q) > _RAD_MAX).mean(axis=0) > _DEGREE_SHARE
    return bool(beyond.sum() >= max(1, len(beyond) // 3))


def read_commands(
    series: Series, path: Path, names: tuple[str, ...], warnings: list[str]
) -> Commands | None:
    """Commanded torques in the order of `names`; joints without a command are not a number."""
    where = f"{path}: {series.topic}"
    check_type(series, path)
    part = series.only(lambda b: _run(b, 2) is not None and bool(set(names) & set(b.layout.names)))
    if not part.blocks:
        warnings.append(f"{where}: no message commands a torque of these joints; left out")
        return None
    parts = []
    for block in part.blocks:
        tau = np.full((len(block.index), len(names)), np.nan)
        for i, name in enumerate(names):
            if name in block.layout.names:
                tau[:, i] = block.values[2][:, block.layout.names.index(name)]
        parts.append(tau)
    return Commands(stamps(part, where, warnings), part.in_order(parts))
