"""Recordings of position-controlled arms: commanded and measured positions, no torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap.bags import open_scan
from drivers.files.mcap.joints import Q, Told, fits, in_use
from drivers.files.mcap.log import Commands, Log
from drivers.files.mcap.series import Series, collect
from drivers.files.mcap.writer import JOINT_COMMANDS, JOINT_STATES
from drivers.interface import Array

GLANCE_S = 5.0  # that tell of most recordings that they are of another kind


def read_position_log(path: str | Path, topic: str | None = None) -> Log | None:
    """The positions of a recording whose `/joint_commands` hold positions, without any efforts.

    Args:
        path: as `read_log` takes it; topic: of the joint states, `/joint_states` where None.

    Returns:
        Finite positions, stamps of the encoders and of the commands strictly increasing; None for
        every other recording: those whose joint states have efforts, or whose commands are not
        positions.

    Raises:
        DriverError: the file is unreadable, or positions and commands are of other joints.
    """
    states = topic or JOINT_STATES
    if _is_of_another_kind(Path(path), states):
        return None  # a long recording was not held in memory for that
    scan = open_scan(Path(path))
    topics = collect(scan, lambda series: series.topic in (states, JOINT_COMMANDS))
    read, commanded = topics.get(states), topics.get(JOINT_COMMANDS)
    if read is None or commanded is None or not fits(commanded, effort=False):
        return None
    if not fits(read, effort=False) or _has_effort(read):
        return None
    names, at, rows, said = _positions(read, scan.path, None)
    asked, when, commands, _ = _positions(commanded, scan.path, names)
    at, rows = _increasing(at, rows)
    when, commands = _increasing(when, commands[:, [asked.index(name) for name in names]])
    nothing, warnings = np.full_like(rows, np.nan), scan.warnings + said
    orders = Commands(when, np.full_like(commands, np.nan), commands)
    log = Log(scan.path, names, at, rows, nothing, nothing, topic=states, warnings=warnings)
    return replace(log, commands=orders)


def _positions(
    series: Series, path: Path, want: Sequence[str] | None
) -> tuple[tuple[str, ...], NDArray[np.int64], Array, list[str]]:
    """Joints, stamps (k,), positions (k, n) of a topic, and sentences on its clock."""
    told, where, said = Told((Q,), (Q,)), f"{path}: {series.topic}", list[str]()
    told.take(series)
    rows = told.chosen(series, where, want, [])
    stamp_ns = in_use(*rows.clocks, where, said).table(False)[:, 0]
    return rows.names, stamp_ns, rows.runs[Q].table(False), said


def _is_of_another_kind(path: Path, states: str) -> bool:
    """Whether the first seconds tell that it is of another kind: efforts, or nothing commanded."""
    scan = open_scan(path)
    scan.within_s = (0.0, GLANCE_S)
    topics = collect(scan, lambda series: series.topic == states)
    if states not in topics or JOINT_COMMANDS not in topics or not topics[JOINT_COMMANDS].count:
        return True
    return fits(topics[states], effort=True) and _has_effort(topics[states])


def _has_effort(series: Series) -> bool:
    """Whether any message tells an effort that is a number and not zero."""
    return any(np.any(np.nan_to_num(block.values[2])) for block in series.blocks)


def _increasing(stamp_ns: NDArray[np.int64], q: Array) -> tuple[NDArray[np.int64], Array]:
    """Finite rows in the order of time, the first of those with one stamp."""
    finite = np.isfinite(q).all(axis=1)
    found, first = np.unique(stamp_ns[finite], return_index=True)
    return found, np.ascontiguousarray(q[finite][first])
