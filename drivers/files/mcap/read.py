"""Reads recordings: our own and those of others."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import choices
from drivers.files.bounded import parse_json
from drivers.files.estimates import estimate_values, values_of_json
from drivers.files.mcap.bags import open_scan
from drivers.files.mcap.imus import READERS, frame_motions, with_imus
from drivers.files.mcap.joints import (
    TAU,
    Q,
    Told,
    check_type,
    commands_told,
    fits,
    in_use,
    joints_told,
)
from drivers.files.mcap.links import Carrier, Links, Onto, assemble_links
from drivers.files.mcap.log import Log, Topic
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
from drivers.files.rows import AT_ONCE
from drivers.interface import DriverError

IN_MEMORY = 2**17  # samples; the arrays of a longer recording are mapped


def read_log(
    path: str | Path,
    joint_names: Sequence[str] | None = None,
    topic: str | None = None,
    *,
    sensors: bool = False,
    frames: bool = False,
    imus: bool = False,
) -> Log:
    """Read a recording of any length, cut or whole, by whatever recorder.

    The arrays of more than `IN_MEMORY` samples are mapped (see `Log`). In memory is, whatever the
    length, a recording that tells motion of links or what `frames` or `imus` ask for, or whose
    commands are of several sets of joints or not in the order of time.

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
    kinds = (*tell, IMU) if sensors else tell
    told = _Told((Q,) if sensors else (Q, TAU))
    topics = collect(scan, lambda series: _is_wanted(series, topic, kinds), told.take)
    series = _choose_topic(scan, topics, topic, not sensors)
    check_type(series, scan.path)
    for other in topics.values():
        told.take(other, least=0)
    where, warnings = f"{scan.path}: {series.topic}", list(scan.warnings)
    rows = told.joints[series.topic].chosen(series, where, joint_names, warnings)
    orders = told.commands.of(rows.names)
    mapped = (
        len(rows) > IN_MEMORY
        and not any(s.count for s in topics.values() if _is_of_links(s) or s.schema in kinds)
        and not (len(orders) > 1 or any(in_use(*x.clocks, where, []).back for x in orders))
    )
    metadata = _decoded_metadata(scan)
    with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers are found by their size
        samples = joints_told(rows, where, not sensors, mapped, warnings)
        onto = Onto(samples[0], scan.path, warnings)
        links = _links(topics, metadata.get("link_names"), onto, sensors)
        found = frame_motions(topics, tell, scan.path, warnings)
    commands = None
    if JOINT_COMMANDS in topics and topics[JOINT_COMMANDS].count:
        check_type(topics[JOINT_COMMANDS], scan.path)
        where = f"{scan.path}: {JOINT_COMMANDS}"
        commands = commands_told(orders, where, rows.names, mapped, warnings)
    log = Log(
        scan.path,
        rows.names,
        *samples,
        link_names=links.names,
        twists=links.twists,
        accels=links.accels,
        frames=tuple(found),
        commands=commands,
        metadata=metadata,
        attachments={a.name: bytes(a.data) for a in scan.attachments},
        topics=_topics_told(topics),
        topic=series.topic,
        truncated=scan.truncated,
        warnings=warnings,
    )
    return log if joint_names is None else log.select(joint_names)


class _Told:
    """What the topics of joints tell, while a file is read.

    Args:
        needed: runs of doubles without which a state is of no use, see `Told`.
    """

    def __init__(self, needed: Sequence[int]) -> None:
        self.joints = defaultdict[str, Told](lambda: Told(needed))
        self.commands = Told((TAU,), (TAU,))

    def take(self, series: Series, least: int = AT_ONCE) -> None:
        """Take what was decoded of joints, once it is so much that it is worth it."""
        if series.schema not in JOINT_SCHEMAS or not (series.blocks or series.bad):
            return
        if sum(len(block.index) for block in series.blocks) >= least:
            self.joints[series.topic].take(series)
            if series.topic == JOINT_COMMANDS:
                self.commands.take(series)
            series.forget()


def survey(path: str | Path) -> tuple[dict[str, Topic], list[str], bool]:
    """Topics, warnings and whether the file is cut, of any recording. Raises DriverError."""
    scan = open_scan(Path(path))
    return _topics_told(collect(scan, lambda series: False)), scan.warnings, scan.truncated


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


def _choose_topic(
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


def _is_wanted(series: Series, topic: str | None, kinds: Sequence[str]) -> bool:
    """Whether the messages of a topic are decoded."""
    if series.topic in (topic, JOINT_COMMANDS) or series.schema in kinds:
        return True
    return topic is None if series.schema in JOINT_SCHEMAS else _is_of_links(series)


def _is_of_links(series: Series) -> bool:
    return series.topic.startswith((LINK_TWISTS, LINK_ACCELS))


def _links(topics: Mapping[str, Series], order: Any, onto: Onto, sensors: bool) -> Links:
    names = order if isinstance(order, list) else []
    if not sensors:
        return assemble_links(topics, names, onto)
    carrier = Carrier(*onto[:3])
    others = {name: series for name, series in topics.items() if series.schema != IMU}
    links = assemble_links(others, names, onto._replace(carrier=carrier))
    links = with_imus(links, topics, carrier, onto.path, onto.warnings)
    carrier.tell()
    return links


def _topics_told(topics: Mapping[str, Series]) -> dict[str, Topic]:
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


def _decoded_metadata(scan: Scan) -> dict[str, Any]:
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
