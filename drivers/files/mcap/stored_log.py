"""Recordings of any length: what is decoded waits in an unnamed file and is read by pieces."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.files.mcap.bags import open_scan
from drivers.files.mcap.imus import READERS, FrameMotion
from drivers.files.mcap.joint_rows import (
    AT_ONCE,
    CommandRows,
    JointRows,
    States,
    stamps_told,
    topic_at,
)
from drivers.files.mcap.joints import (
    MOST_SETS,
    Commands,
    ToldCommands,
    ToldJoints,
    TooManySetsError,
    check_type,
    no_commands,
)
from drivers.files.mcap.log import (
    Log,
    Topic,
    choose_topic,
    decoded_metadata,
    is_wanted,
    places_of,
    read_log,
    topics_told,
)
from drivers.files.mcap.records import Scan
from drivers.files.mcap.series import JOINT_SCHEMAS, Series, collect, schema_name
from drivers.files.mcap.writer import JOINT_COMMANDS, JOINT_STATES, LINK_ACCELS, LINK_TWISTS
from drivers.files.ros_types import IMU

IN_MEMORY = 2**17  # samples; a shorter recording is a `Log`


@dataclass(frozen=True)
class StoredCommands:
    """Commanded torques in a file.

    Attributes:
        rows: in the order of time.
        clock: which stamps of theirs are used.
        columns: of `rows` by joint of the log, -1 where it is not commanded.
    """

    rows: CommandRows
    clock: int
    columns: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.rows)

    def between(self, begin_ns: int, end_ns: int) -> Commands:
        """Commands of a time, and one more before and behind it to interpolate between."""
        first = max(self.rows.first_from(begin_ns, self.clock) - 1, 0)
        last = self.rows.first_from(end_ns + 1, self.clock) + 1
        return self._told(first, last)

    def all(self) -> Commands:
        """All of them in memory."""
        return self._told(0, len(self.rows))

    def _told(self, first: int, last: int) -> Commands:
        stamp_ns, told = self.rows.tables(first, last, self.clock)
        tau = np.full((len(told), len(self.columns)), np.nan)
        for i, column in enumerate(self.columns):
            if column >= 0:
                tau[:, i] = told[:, column]
        return Commands(stamp_ns, tau)


@dataclass(frozen=True)
class StoredLog:
    """A recording whose samples wait in an unnamed temporary file (in the folder TMPDIR names).

    Like `Log`, but for the samples: `piece` and `pieces` bring some of them into memory. Nothing
    of it grows with its length but the file. It has no motion of links, frames or a base.

    Attributes:
        path, joint_names, metadata, attachments, topics, topic, truncated, warnings: see `Log`.
        rows: of the file.
        columns: which of the file's joints are this recording's.
        commands: commanded torques.
    """

    path: Path
    joint_names: tuple[str, ...]
    rows: JointRows
    columns: tuple[int, ...]
    commands: StoredCommands | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    topics: dict[str, Topic] = field(default_factory=dict)
    topic: str = JOINT_STATES
    truncated: bool = False
    warnings: list[str] = field(default_factory=list)

    link_names: tuple[str, ...] = ()
    twists: None = None
    accels: None = None
    frames: tuple[FrameMotion, ...] = ()
    base: None = None

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        span_s = 1e-9 * (self.end_ns - self.begin_ns) if len(self) else 0.0
        count = f"{len(self)} samples of {len(self.joint_names)} joints"
        return f"StoredLog({self.path.name}: {count}, {span_s:.1f} s)"

    @property
    def first_ns(self) -> int:
        """Stamp of the first sample."""
        return int(self.rows.tables(0, 1).stamp_ns[0])

    @property
    def begin_ns(self) -> int:
        """The earliest stamp."""
        return self.rows.clock.begin_ns

    @property
    def end_ns(self) -> int:
        """The latest stamp."""
        return self.rows.clock.end_ns

    def piece(self, start: int, stop: int) -> Log:
        """Samples `start` to `stop` (not included) in memory, as far as there are such.

        Commands come with one more before and behind them; warnings stay with the whole.
        """
        states = self.rows.tables(start, stop)
        stamp_ns, q, dq, tau = states
        if self.columns != tuple(range(q.shape[1])):
            q, dq, tau = (np.ascontiguousarray(x[:, self.columns]) for x in states[1:])
        commands = None
        if self.commands is not None and len(stamp_ns):
            commands = self.commands.between(int(stamp_ns.min()), int(stamp_ns.max()))
        return Log(
            self.path,
            self.joint_names,
            stamp_ns,
            q,
            dq,
            tau,
            commands=commands,
            metadata=self.metadata,
            attachments=self.attachments,
            topics=self.topics,
            topic=self.topic,
            truncated=self.truncated,
        )

    def pieces(self, rows: int = AT_ONCE) -> Iterator[Log]:
        """All samples, so many at a time."""
        for start in range(0, len(self), rows):
            yield self.piece(start, start + rows)

    def spread(self, stretches: int, samples: int) -> list[Log]:
        """So many stretches of so many samples each, from the first to the last, evenly spread."""
        starts = np.linspace(0, max(len(self) - samples, 0), stretches).astype(int)
        return [self.piece(start, start + samples) for start in np.unique(starts).tolist()]

    def select(
        self, joint_names: Sequence[str], link_names: Sequence[str] | None = None
    ) -> StoredLog:
        """The same recording with these joints in this order, see `Log.select`."""
        places = places_of(self.joint_names, joint_names, f"{self.path}: has no joint")
        extra = [name for name in self.joint_names if name not in joint_names]
        warnings = list(self.warnings)
        if extra:
            warnings.append(f"{self.path}: joints not asked for are ignored: {', '.join(extra)}")
        commands = self.commands
        if commands is not None:
            commands = replace(commands, columns=tuple(commands.columns[i] for i in places))
        columns = tuple(self.columns[i] for i in places)
        log = replace(self, joint_names=tuple(joint_names), columns=columns, warnings=warnings)
        return replace(log, commands=commands)

    def changed(self, change: Callable[[Log], Log]) -> StoredLog:
        """Every piece as `change` makes it, in a file of its own; the rest is that of this one.

        Args:
            change: of a piece, into one of the same joints with as many samples or fewer.
        """
        return replace(stored(self, map(change, self.pieces())), commands=self.commands)

    def in_memory(self) -> Log:
        """The whole recording in memory."""
        log = self.piece(0, len(self))
        if self.commands is not None:
            log = replace(log, commands=self.commands.all())
        return replace(log, warnings=self.warnings)


AnyLog = Log | StoredLog


def stored(like: AnyLog, pieces: Iterable[Log]) -> StoredLog:
    """A recording in a file, of the samples of some pieces of one set of joints; the rest is as
    `like` has it, without commands.
    """
    rows = JointRows(like.joint_names)
    for log in pieces:
        rows.append(States(log.stamp_ns, log.q, log.dq, log.tau))
    return StoredLog(
        path=like.path,
        joint_names=like.joint_names,
        rows=rows,
        columns=tuple(range(len(like.joint_names))),
        metadata=like.metadata,
        attachments=like.attachments,
        topics=like.topics,
        topic=like.topic,
        truncated=like.truncated,
        warnings=like.warnings,
    )


def open_log(
    path: str | Path,
    joint_names: Sequence[str] | None = None,
    topic: str | None = None,
    *,
    frames: bool = False,
    imus: bool = False,
    in_memory: int = IN_MEMORY,
) -> AnyLog:
    """Read a recording of any length, as `read_log` does.

    A recording of up to `in_memory` samples comes as a `Log`. So does one that tells what only a
    `Log` can hold, whatever its length: motion of links (`/link_twists/...`, `/link_accels/...`),
    with `frames` that of any frame, with `imus` what Imu topics say, states or commands of ever
    other sets of joints in turn, and commands that are not in the order of time.

    Args:
        path, joint_names, topic, frames, imus: see `read_log`.
        in_memory: samples.

    Raises:
        DriverError: see `read_log`.
    """
    file = Path(path)
    kinds = tuple(READERS) if frames else (IMU,) if imus else ()
    scan = open_scan(file)
    known = [(c.topic, schema_name(scan, c)) for c in scan.channels.values()]
    found = None
    if topic != JOINT_COMMANDS and not any(_in_memory_only(*x, kinds) for x in known):
        with suppress(TooManySetsError):
            found = _decoded(scan, joint_names, topic, kinds)
    if found is None:
        return read_log(file, joint_names, topic, frames=frames, imus=imus)
    log = found if len(found) > in_memory else found.in_memory()
    return log if joint_names is None else log.select(joint_names)


def _in_memory_only(topic: str, schema: str, kinds: Sequence[str]) -> bool:
    return topic.startswith((LINK_TWISTS, LINK_ACCELS)) or schema in kinds


def _decoded(
    scan: Scan, want: Sequence[str] | None, topic: str | None, kinds: Sequence[str]
) -> StoredLog | None:
    """A recording; None where it needs the memory. Raises DriverError, TooManySetsError."""
    told = _Told()
    topics = collect(scan, lambda series: is_wanted(series, topic, False, ()), told.take)
    if any(_in_memory_only(name, s.schema, kinds) and s.count for name, s in topics.items()):
        return None
    series = choose_topic(scan, topics, topic, True)
    check_type(series, scan.path)
    told.finish(topics)
    rows = told.joints[series.topic].chosen(series, scan.path, want)
    warnings = scan.warnings + rows.warnings
    commands = None
    if JOINT_COMMANDS in topics and topics[JOINT_COMMANDS].count:
        commands = _commands(topics[JOINT_COMMANDS], told.commands, scan.path, rows, warnings)
        if commands is not None and commands.rows.clocks[commands.clock].back:
            return None
    return StoredLog(
        path=scan.path,
        joint_names=rows.names,
        rows=rows,
        columns=tuple(range(len(rows.names))),
        commands=commands,
        metadata=decoded_metadata(scan),
        attachments={a.name: bytes(a.data) for a in scan.attachments},
        topics=topics_told(topics),
        topic=series.topic,
        truncated=scan.truncated,
        warnings=warnings,
    )


class _Told:
    """What the topics of joints tell, while a file is read."""

    def __init__(self) -> None:
        self.joints: defaultdict[str, ToldJoints] = defaultdict(
            lambda: ToldJoints(most_sets=MOST_SETS)
        )
        self.commands = ToldCommands()

    def take(self, series: Series) -> None:
        """Take what was decoded, once it is worth it."""
        if sum(len(block.index) for block in series.blocks) >= AT_ONCE:
            self._take(series)

    def finish(self, topics: Mapping[str, Series]) -> None:
        """Take the rest."""
        for series in topics.values():
            if series.blocks or series.bad:
                self._take(series)

    def _take(self, series: Series) -> None:
        if series.topic == JOINT_COMMANDS:
            self.commands.take(series)
        elif series.schema in JOINT_SCHEMAS:
            self.joints[series.topic].take(series)
        series.forget()


def _commands(
    series: Series, told: ToldCommands, path: Path, rows: JointRows, warnings: list[str]
) -> StoredCommands | None:
    check_type(series, path)
    where, own = topic_at(path, series.topic), told.rows
    if own is None or not {*own.names} & {*rows.names}:
        warnings.append(no_commands(where))
        return None
    which, said = stamps_told(*own.clocks, len(own), where)
    warnings += said
    places = (own.names.index(name) if name in own.names else -1 for name in rows.names)
    return StoredCommands(own, which, tuple(places))
