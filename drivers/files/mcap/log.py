"""What a recording is once it is read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import choices
from drivers.files.html_table import NOTHING, html_table
from drivers.files.mcap.writer import JOINT_STATES, McapWriter
from drivers.files.rows import AT_ONCE, RowsFile, copied, gathered, is_mapped, stretches
from drivers.interface import Array, DriverError, LinkMotion

_SAMPLES = "stamp_ns", "q", "dq", "tau"


@dataclass(frozen=True, slots=True)
class Topic:
    """What a file says of a topic."""

    schema: str
    encoding: str
    messages: int


@dataclass(frozen=True, slots=True)
class FrameMotion:
    """What one topic says of one frame, in its axes; not a number where not measured.

    Attributes:
        topic, schema, frame: their names.
        stamp_ns: (k,) ns.
        w, a, v: (k, 3) angular velocity rad/s, what an accelerometer reads m/s², velocity m/s.
    """

    topic: str
    schema: str
    frame: str
    stamp_ns: NDArray[np.int64]
    w: Array
    a: Array
    v: Array


@dataclass(frozen=True, slots=True)
class Commands:
    """Commanded joint torques: stamps (k,) ns, torques (k, n) N m in the log's joint order.

    Of an arm that takes positions `q` (k, n) rad, and torques that are not a number.
    """

    stamp_ns: NDArray[np.int64]
    tau: Array
    q: Array | None = None

    def between(self, begin_ns: int, end_ns: int) -> Commands:
        """A copy of those of a time, and one more before and behind it to interpolate between.

        They are in the order of time.
        """
        first, last = np.searchsorted(self.stamp_ns, (begin_ns, end_ns + 1)).tolist()
        rows = max(first - 1, 0), last + 1
        q = None if self.q is None else copied(self.q, *rows)
        return Commands(copied(self.stamp_ns, *rows), copied(self.tau, *rows), q)

    def holding(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """(m,) number of the command that holds at each stamp; -1 before the first one."""
        return np.searchsorted(self.stamp_ns, stamp_ns, side="right") - 1


@dataclass(frozen=True)
class Log:
    """A recording.

    Of a long one the arrays of samples and commands are mapped: they lie in an unnamed temporary
    file (in the folder TMPDIR names), and what is used of them is read from there. `piece` and
    `pieces` go through them in little memory.

    Attributes:
        path: where it came from.
        joint_names: order of the columns.
        stamp_ns: (m,) header stamps as recorded, not sorted.
        q, dq, tau: (m, n) rad, rad/s, N m; read for discovery, dq and tau may be all not a number.
        link_names: order of the links; of our own recordings link i is moved by joint i.
        twists, accels: (m, links, 6) measured link motion, not a number where a stamp has none;
            None where the file has none at all.
        frames: what topics say of frames' motion, where it was asked for.
        base: (m, 9) [v, w, a] of a floating base at the joint samples, in its own frame and as
            `JointSample.base` has it, once a reader of `frames` has put it here.
        commands: commanded torques.
        metadata: our own entries (configuration, version, ...) decoded, those of other tools under
            their record's name.
        attachments: files inside the recording.
        topics: all topics of the file.
        topic: that of the joint states.
        truncated: the file has no proper end.
        warnings: what was repaired, left out or looks wrong, one sentence each.
    """

    path: Path
    joint_names: tuple[str, ...]
    stamp_ns: NDArray[np.int64]
    q: Array
    dq: Array
    tau: Array
    link_names: tuple[str, ...] = ()
    twists: Array | None = None
    accels: Array | None = None
    frames: tuple[FrameMotion, ...] = ()
    base: Array | None = None
    commands: Commands | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    topics: dict[str, Topic] = field(default_factory=dict)
    topic: str = JOINT_STATES
    truncated: bool = False
    warnings: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def __repr__(self) -> str:
        span_s = 1e-9 * (self.end_ns - self.begin_ns) if len(self) else 0.0
        count = f"{len(self)} samples of {len(self.joint_names)} joints"
        return f"Log({self.path.name}: {count}, {span_s:.1f} s)"

    @property
    def is_mapped(self) -> bool:
        """Whether the samples lie in a file, for there are many."""
        return is_mapped(self.q)

    @property
    def first_ns(self) -> int:
        """Stamp of the first sample."""
        return int(self.stamp_ns[0])

    @property
    def begin_ns(self) -> int:
        """The earliest stamp."""
        return min(int(x.min()) for x in stretches(self.stamp_ns))

    @property
    def end_ns(self) -> int:
        """The latest stamp."""
        return max(int(x.max()) for x in stretches(self.stamp_ns))

    def piece(self, start: int, stop: int) -> Log:
        """Samples `start` to `stop` (not included), as far as there are such.

        The arrays are views, and commands stay whole; of mapped ones they are copies, and commands
        come with one more before and behind them. Warnings stay with the whole recording.
        """
        if not self.is_mapped:
            return replace(self.take(slice(start, stop)), warnings=[])
        stamp_ns, q, dq, tau = (copied(getattr(self, key), start, stop) for key in _SAMPLES)
        commands = self.commands if len(stamp_ns) else None
        if commands is not None:
            commands = commands.between(int(stamp_ns.min()), int(stamp_ns.max()))
        piece = replace(self, stamp_ns=stamp_ns, q=q, dq=dq, tau=tau)
        return replace(piece, commands=commands, warnings=[])

    def pieces(self, rows: int = AT_ONCE) -> Iterator[Log]:
        """All samples, so many at most at a time, alike many: a rest of a few tells nothing."""
        edges = np.linspace(0, len(self), -(-len(self) // rows) + 1).astype(int)
        for start, stop in pairwise(edges.tolist()):
            yield self.piece(start, stop)

    def spread(self, count: int = 64, samples: int = 2000) -> list[Log]:
        """What tells of the whole: all of it; where it is mapped so many stretches of so many
        samples each, from the first to the last, evenly spread.
        """
        if not self.is_mapped:
            return [self]
        starts = np.linspace(0, max(len(self) - samples, 0), count).astype(int)
        return [self.piece(start, start + samples) for start in np.unique(starts).tolist()]

    def changed(self, change: Callable[[Log], Log]) -> Log:
        """What `change` makes of it; where it is mapped, of every piece, in a file again.

        Args:
            change: of a piece, into one of the same joints with as many samples or fewer.
        """
        if not self.is_mapped:
            return change(self)
        return replace(mapped(self, map(change, self.pieces())), commands=self.commands)

    def _repr_html_(self) -> str:
        """Ranges of each joint, for notebooks."""
        tables = (self.q, self.dq, self.tau)
        rows = [
            (name, *(_range(table[:, j]) for table in tables))
            for j, name in enumerate(self.joint_names)
        ]
        heads = ("joint", "position, rad", "velocity, rad/s", "torque, N m")
        return html_table(repr(self), heads, rows)

    def select(self, joint_names: Sequence[str], link_names: Sequence[str] | None = None) -> Log:
        """The same recording with these joints (and links) in this order.

        Links follow their joints where `link_names` is None and the recording pairs them. Joints
        that are left out are named in a warning. Raises DriverError for a joint or link that the
        recording doesn't have.
        """
        columns = _places_of(self.joint_names, joint_names, f"{self.path}: has no joint")
        extra = [name for name in self.joint_names if name not in joint_names]
        warnings = list(self.warnings)
        if extra:
            warnings.append(f"{self.path}: joints not asked for are ignored: {', '.join(extra)}")
        q, dq, tau = (_columns(x, columns) for x in (self.q, self.dq, self.tau))
        log = replace(self, joint_names=tuple(joint_names), q=q, dq=dq, tau=tau, warnings=warnings)
        if (asked := self.commands) is not None:
            own = None if asked.q is None else _columns(asked.q, columns)
            asked = replace(asked, tau=_columns(asked.tau, columns), q=own)
            log = replace(log, commands=asked)
        if link_names is None and self.pairs_links:
            pairs = dict(
                zip(self.metadata["joint_names"], self.metadata["link_names"], strict=True)
            )
            moved = [pairs.get(name) for name in joint_names]
            if all(name in self.link_names for name in moved):
                link_names = [name for name in moved if name]
        if link_names is None or not self.link_names:
            return log
        rows = _places_of(self.link_names, link_names, f"{self.path}: has no motion of link")
        both = (None if x is None else _columns(x, rows) for x in (self.twists, self.accels))
        twists, accels = both
        return replace(log, link_names=tuple(link_names), twists=twists, accels=accels)

    def take(self, rows: NDArray[np.bool_ | np.int64] | slice) -> Log:
        """The same recording with these samples only."""
        links = (None if x is None else x[rows] for x in (self.twists, self.accels, self.base))
        twists, accels, base = links
        log = replace(self, stamp_ns=self.stamp_ns[rows], q=self.q[rows], dq=self.dq[rows])
        return replace(log, tau=self.tau[rows], twists=twists, accels=accels, base=base)

    @property
    def pairs_links(self) -> bool:
        """Whether the recording says which joint moves which link."""
        joints, links = self.metadata.get("joint_names"), self.metadata.get("link_names")
        return isinstance(joints, list) and isinstance(links, list) and len(joints) == len(links)


def mapped(like: Log, pieces: Iterable[Log]) -> Log:
    """The samples of some pieces, mapped; the rest is as `like` has it, without commands."""
    n = len(like.joint_names)
    files = [RowsFile(1, dtype=np.int64), RowsFile(n), RowsFile(n), RowsFile(n)]
    for piece in pieces:
        for file, key in zip(files, _SAMPLES, strict=True):
            file.append(getattr(piece, key).reshape(len(piece), file.width))
    stamp_ns, q, dq, tau = (file.table(mapped=True) for file in files)
    return replace(like, stamp_ns=stamp_ns[:, 0], q=q, dq=dq, tau=tau, commands=None)


def write_log(log: Log, path: Path, metadata: Mapping[str, Any]) -> None:
    """Write samples, commands and links' motion, of which a sample has both kinds or none.

    Args:
        path: overwritten; metadata: goes with them.
    """
    links = log.link_names if log.twists is not None and log.accels is not None else ()
    if links and not log.pairs_links:  # the copy must not say that link i is moved by joint i
        metadata = {**metadata, "link_names": []}
    with McapWriter(path, log.joint_names, links, metadata, overwrite=True) as writer:
        orders = log.commands
        positions = orders.q if orders is not None else None
        if orders is not None and positions is not None:
            for stamp_ns, q in zip(orders.stamp_ns.tolist(), positions, strict=True):
                writer.write_position_command(stamp_ns, q)
            if np.isnan(log.tau).all():
                for stamp_ns, q in zip(log.stamp_ns.tolist(), log.q, strict=True):
                    writer.write_position(stamp_ns, q)
                return
        for i, stamp_ns in enumerate(log.stamp_ns.tolist()):
            writer.write_joint_state(stamp_ns, log.q[i], log.dq[i], log.tau[i])
            if not links:
                continue
            assert log.twists is not None and log.accels is not None
            if not np.isnan(log.twists[i]).all() or not np.isnan(log.accels[i]).all():
                writer.write_links(stamp_ns, LinkMotion(log.twists[i], log.accels[i]))
        if orders is not None and positions is None:
            for stamp_ns, tau in zip(orders.stamp_ns.tolist(), orders.tau, strict=True):
                writer.write_command(stamp_ns, tau)


def _columns(values: Array, columns: list[int]) -> Array:
    if not is_mapped(values):
        # In C order whatever is chosen: the order in memory can change the last bit of a product.
        return np.ascontiguousarray(values[:, columns])
    if columns == list(range(values.shape[1])):
        return values
    return gathered(len(columns), (x[:, columns] for x in stretches(values))).table(mapped=True)


def _places_of(have: tuple[str, ...], want: Sequence[str], trouble: str) -> list[int]:
    missing = [name for name in want if name not in have]
    if missing:
        raise DriverError(f"{trouble} {', '.join(missing)}; {choices(missing[0], have)}")
    return [have.index(name) for name in want]


def _range(values: Array) -> str:
    """From the smallest to the largest; a dash where nothing was measured."""
    known = values[np.isfinite(values)]
    return f"{known.min():.3g} to {known.max():.3g}" if len(known) else NOTHING
