"""Recordings as arrays: our own and those of others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import choices
from drivers.files.bounded import parse_json
from drivers.files.estimates import estimate_values, values_of_json
from drivers.files.html_table import NOTHING, html_table
from drivers.files.mcap.bags import open_scan
from drivers.files.mcap.imus import READERS, FrameMotion, frame_motions, with_imus
from drivers.files.mcap.joint_rows import AT_ONCE
from drivers.files.mcap.joints import Commands, Joints, assemble_joints, fits, read_commands
from drivers.files.mcap.links import Carrier, Links, Onto, assemble_links
from drivers.files.mcap.records import McapScan, Scan
from drivers.files.mcap.series import JOINT_SCHEMAS, Series, collect, schema_name
from drivers.files.mcap.writer import (
    ESTIMATES,
    JOINT_COMMANDS,
    JOINT_STATES,
    LINK_ACCELS,
    LINK_TWISTS,
    METADATA,
)
from drivers.files.messages import Message, decode
from drivers.files.ros_types import ESTIMATE, IMU
from drivers.interface import Array, DriverError


@dataclass(frozen=True, slots=True)
class Topic:
    """What a file says of a topic."""

    schema: str
    encoding: str
    messages: int


@dataclass(frozen=True)
class Log:
    """A recording in memory.

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
        span_s = 1e-9 * float(np.ptp(self.stamp_ns)) if len(self) else 0.0
        count = f"{len(self)} samples of {len(self.joint_names)} joints"
        return f"Log({self.path.name}: {count}, {span_s:.1f} s)"

    @property
    def first_ns(self) -> int:
        """Stamp of the first sample."""
        return int(self.stamp_ns[0])

    @property
    def begin_ns(self) -> int:
        """The earliest stamp."""
        return int(self.stamp_ns.min())

    @property
    def end_ns(self) -> int:
        """The latest stamp."""
        return int(self.stamp_ns.max())

    def piece(self, start: int, stop: int) -> Log:
        """Samples `start` to `stop` (not included), as far as there are such.

        The arrays are views; commands stay whole, warnings with the whole recording.
        """
        return replace(self.take(slice(start, stop)), warnings=[])

    def pieces(self, rows: int = AT_ONCE) -> Iterator[Log]:
        """All samples, so many at a time."""
        for start in range(0, len(self), rows):
            yield self.piece(start, start + rows)

    def spread(self, stretches: int, samples: int) -> list[Log]:
        """What tells of the whole: of a recording in memory all of it, see `StoredLog.spread`."""
        return [self]

    def changed(self, change: Callable[[Log], Log]) -> Log:
        """What `change` makes of the recording, see `StoredLog.changed`."""
        return change(self)

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
        columns = places_of(self.joint_names, joint_names, f"{self.path}: has no joint")
        extra = [name for name in self.joint_names if name not in joint_names]
        warnings = list(self.warnings)
        if extra:
            warnings.append(f"{self.path}: joints not asked for are ignored: {', '.join(extra)}")
        log = replace(
            self,
            joint_names=tuple(joint_names),
            q=_columns(self.q, columns),
            dq=_columns(self.dq, columns),
            tau=_columns(self.tau, columns),
            warnings=warnings,
        )
        if self.commands is not None:
            commands = Commands(self.commands.stamp_ns, _columns(self.commands.tau, columns))
            log = replace(log, commands=commands)
        if link_names is None:
            link_names = self._links_moved_by(joint_names)
        return log if link_names is None else log._select_links(link_names)

    def take(self, rows: NDArray[np.bool_] | slice) -> Log:
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

    def _links_moved_by(self, joint_names: Sequence[str]) -> list[str] | None:
        """The links that these joints move, where the recording says so and has them all."""
        if not self.pairs_links:
            return None
        joints, links = self.metadata["joint_names"], self.metadata["link_names"]
        pairs = dict(zip(joints, links, strict=True))
        moved = [pairs.get(name) for name in joint_names]
        return [n for n in moved if n] if all(n in self.link_names for n in moved) else None

    def _select_links(self, link_names: Sequence[str]) -> Log:
        if not self.link_names:
            return self
        rows = places_of(self.link_names, link_names, f"{self.path}: has no motion of link")
        return replace(
            self,
            link_names=tuple(link_names),
            twists=None if self.twists is None else _columns(self.twists, rows),
            accels=None if self.accels is None else _columns(self.accels, rows),
        )


def _columns(values: Array, columns: list[int]) -> Array:
    # In C order whatever was chosen: the order in memory can change the last bit of a product.
    return np.ascontiguousarray(values[:, columns])


def places_of(have: tuple[str, ...], want: Sequence[str], trouble: str) -> list[int]:
    missing = [name for name in want if name not in have]
    if missing:
        raise DriverError(f"{trouble} {', '.join(missing)}; {choices(missing[0], have)}")
    return [have.index(name) for name in want]


def read_log(
    path: str | Path,
    joint_names: Sequence[str] | None = None,
    topic: str | None = None,
    *,
    sensors: bool = False,
    frames: bool = False,
    imus: bool = False,
) -> Log:
    """Read a recording, cut or whole, by whatever recorder.

    Args:
        path: an MCAP file, chunked or not, uncompressed, zstd or lz4; a rosbag2, folder or SQLite
            file; a bag of ROS 1; any of these compressed (zstd, gzip).
        joint_names: joints that must be there, in the order wanted; all joints where None.
        topic: of the joint states; where None `/joint_states`, else the only one that fits.
        sensors: read what sensors on links recorded beside the joints, for discovery: also
            Imu topics and link motion with stamps of its own, carried to the joint samples'
            stamps; efforts and velocities may be absent.
        frames: read into `Log.frames` what topics say of frames' motion, whatever frames; `imus`
            the same for Imu topics alone.

    Raises:
        DriverError: the file is unreadable or empty, or has no joint states with positions and
            efforts; the sentence says what the file does have.
    """
    return assembled(
        open_scan(Path(path)), joint_names, topic, sensors=sensors, frames=frames, imus=imus
    )


def read_sensors(
    path: str | Path, topic: str | None = None, within_s: tuple[float, float] | None = None
) -> Log:
    """As `read_log` with `sensors`, of a part of the recording.

    Args:
        within_s: log times since the first message, s; None: all.

    Raises:
        DriverError: as `read_log`; the recording ends before that time.
    """
    scan = open_scan(Path(path))
    scan.within_s = within_s
    return assembled(scan, None, topic, sensors=True)


def assembled(
    scan: Scan,
    joint_names: Sequence[str] | None = None,
    topic: str | None = None,
    *,
    sensors: bool = False,
    frames: bool = False,
    imus: bool = False,
) -> Log:
    """What a scan tells, see `read_log`."""
    tell = tuple(READERS) if frames else (IMU,) if imus else ()
    topics = collect(scan, lambda series: is_wanted(series, topic, sensors, tell))
    series = choose_topic(scan, topics, topic, not sensors)
    with np.errstate(invalid="ignore"):  # not-a-number is counted, not computed with
        joints = assemble_joints(series, scan.path, joint_names, effort=not sensors)
    warnings = scan.warnings + joints.warnings
    metadata = decoded_metadata(scan)
    links = _links(topics, joints, metadata.get("link_names"), scan.path, warnings, sensors)
    found: list[FrameMotion] = []
    if tell:
        with np.errstate(invalid="ignore", over="ignore"):
            found = frame_motions(topics, tell, scan.path, warnings)
    commands = None
    if JOINT_COMMANDS in topics and topics[JOINT_COMMANDS].count:
        commands = read_commands(topics[JOINT_COMMANDS], scan.path, joints.names, warnings)
    log = Log(
        path=scan.path,
        joint_names=joints.names,
        stamp_ns=joints.stamp_ns,
        q=joints.q,
        dq=joints.dq,
        tau=joints.tau,
        link_names=links.names,
        twists=links.twists,
        accels=links.accels,
        frames=tuple(found),
        commands=commands,
        metadata=metadata,
        attachments={a.name: bytes(a.data) for a in scan.attachments},
        topics=topics_told(topics),
        topic=series.topic,
        truncated=scan.truncated,
        warnings=warnings,
    )
    return log if joint_names is None else log.select(joint_names)


def survey(path: str | Path) -> tuple[dict[str, Topic], list[str], bool]:
    """Topics, warnings and whether the file is cut, of any recording. Raises DriverError."""
    scan = open_scan(Path(path))
    return topics_told(collect(scan, lambda series: False)), scan.warnings, scan.truncated


def read_estimates(path: str | Path, topic: str = ESTIMATES) -> Iterator[dict[str, Any]]:
    """The estimates in a recording, in the order of the file, as `estimate_values` tells them.

    Those of recordings before version 0.2 are JSON and tell less: no names, no standard
    deviations. Raises DriverError.
    """
    for message in read_messages(path, topic):
        if message.schema == ESTIMATE:
            yield estimate_values(message.fields)
        else:
            yield values_of_json(message.fields)


def read_messages(path: str | Path, topic: str) -> Iterator[Message]:
    """The messages of a topic of an MCAP file, of whatever type the file defines.

    Raises:
        DriverError: the file cannot be read, or a message of the topic is damaged.
    """
    scan = McapScan(Path(path))
    for region in scan.regions():
        for i, number in enumerate(region.channel.tolist()):
            channel = scan.channels.get(number)
            if channel is None or channel.topic != topic:
                continue
            data = region.data[region.start[i] : region.stop[i]].tobytes()
            schema = scan.schemas.get(channel.schema_id)
            name = schema_name(scan, channel)
            try:
                if channel.message_encoding == "json":
                    fields = parse_json(data)
                else:
                    fields = decode(name, data, schema.data.decode() if schema else None)
            except ValueError as error:
                raise DriverError(f"{path}: a message on {topic} is damaged: {error}") from error
            yield Message(topic, name, int(region.times[i, 0]), fields)


def choose_topic(
    scan: Scan, topics: Mapping[str, Series], topic: str | None, effort: bool
) -> Series:
    """The topic that was named, or `/joint_states`, or the only one of use."""
    series = topics.get(topic or JOINT_STATES)
    if topic is not None:
        if series is None or not series.count:
            raise DriverError(_nothing_found(scan, topics, topic))
        return series
    fitting = sorted(k for k, s in topics.items() if k != JOINT_COMMANDS and fits(s, effort))
    if series is not None and fits(series, effort):
        others = [name for name in fitting if name != JOINT_STATES]
        if others:
            scan.warnings.append(
                f"{scan.path}: joint states are those of {JOINT_STATES}; also told by "
                f"{', '.join(others)} (--topic NAME)"
            )
        return series
    if len(fitting) > 1:
        raise DriverError(
            f"{scan.path}: {len(fitting)} topics tell joint states: {', '.join(fitting)}; choose "
            "one (--topic NAME)"
        )
    if fitting:
        scan.warnings.append(f"{scan.path}: joint states are those of {fitting[0]}")
        return topics[fitting[0]]
    if series is None or not series.count:
        raise DriverError(_nothing_found(scan, topics, JOINT_STATES))
    return series


def is_wanted(series: Series, topic: str | None, sensors: bool, tell: Sequence[str]) -> bool:
    """Whether the messages of a topic are decoded."""
    if series.topic in (topic, JOINT_COMMANDS) or series.schema in tell:
        return True
    if series.schema in JOINT_SCHEMAS:
        return topic is None
    if series.schema == IMU:
        return sensors
    return series.topic.startswith((LINK_TWISTS, LINK_ACCELS))


def _links(
    topics: Mapping[str, Series],
    joints: Joints,
    order: Any,
    path: Path,
    warnings: list[str],
    sensors: bool,
) -> Links:
    names = order if isinstance(order, list) else []
    if not sensors:
        return assemble_links(topics, names, Onto(joints.stamp_ns, path, warnings))
    carrier = Carrier(joints.stamp_ns, path, warnings)
    others = {name: series for name, series in topics.items() if series.schema != IMU}
    with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers are found by their size
        links = assemble_links(others, names, Onto(joints.stamp_ns, path, warnings, carrier))
        links = with_imus(links, topics, carrier, path, warnings)
    carrier.tell()
    return links


def topics_told(topics: Mapping[str, Series]) -> dict[str, Topic]:
    return {k: Topic(s.schema, s.encoding, s.count) for k, s in sorted(topics.items())}


def _nothing_found(scan: Scan, topics: Mapping[str, Series], topic: str) -> str:
    others = [name for name, s in topics.items() if s.schema in JOINT_SCHEMAS and name != topic]
    found = [f"{name} ({s.count} {s.schema or s.encoding})" for name, s in sorted(topics.items())]
    hint = f"; of joint states {choices(topic, others)}" if others else ""
    cut = " up to the cut" if scan.truncated else ""
    return (
        f"{scan.path}: has no message on {topic}{cut}; found: {', '.join(found) or 'no topic'}"
        f"{hint}"
    )


def decoded_metadata(scan: Scan) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for record in scan.metadata:
        if record.name == METADATA:
            entries.update({key: _decoded(value) for key, value in record.metadata.items()})
        else:
            entries[record.name] = dict(record.metadata)
    return entries


def _decoded(text: str) -> Any:
    try:
        return parse_json(text)
    except ValueError:
        return text


def _range(values: Array) -> str:
    """From the smallest to the largest; a dash where nothing was measured."""
    known = values[np.isfinite(values)]
    return f"{known.min():.3g} to {known.max():.3g}" if len(known) else NOTHING
