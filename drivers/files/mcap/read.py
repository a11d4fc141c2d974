"""Reads recordings: our own and those of others."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.errors import choices
from drivers.files.bounded import parse_json
from drivers.files.estimates import estimate_values
from drivers.files.mcap.bags import open_scan
from drivers.files.mcap.joints import (
    GOAL,
    TAU,
    Q,
    Told,
    check_type,
    commands_told,
    fits,
    in_use,
    joints_told,
    steps_back,
)
from drivers.files.mcap.links import READERS, Carrier, assemble_links, frame_motions
from drivers.files.mcap.log import Commands, Log, Topic
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
from drivers.interface import Array, DriverError

Beside = Literal["", "sensors", "frames", "imus"]
IN_MEMORY = 2**17  # samples; the arrays of a longer recording are mapped


def read_log(
    path: str | Path,
    joint_names: Sequence[str] | None = None,
    topic: str | None = None,
    *,
    beside: Beside = "",
    within_s: tuple[float, float] | None = None,
) -> Log:
    """Read a recording of any length, cut or whole, by whatever recorder.

    The arrays of more than `IN_MEMORY` samples are mapped (see `Log`). In memory is, whatever the
    length, a recording that tells motion of links or what `beside` asks for, or whose commands are
    of several sets of joints or not in the order of time.

    Args:
        path: an MCAP file, chunked or not, uncompressed, zstd or lz4; a rosbag2, folder or SQLite
            file; a bag of ROS 1; any of these compressed (zstd, gzip).
        joint_names: joints that must be there, in the order wanted; all joints where None.
        topic: of the joint states; where None `/joint_states`, else the only one that fits.
        beside: what else is read. `sensors`, for discovery: what sensors on links recorded beside
            the joints, also Imu topics and link motion with stamps of its own, carried to the joint
            samples' stamps; efforts and velocities may be absent. `frames`: into `Log.frames` what
            topics say of frames' motion, whatever frames; `imus` the same for Imu topics alone.
        within_s: the part that is read, log times since the first message, s; all where None.

    Raises:
        DriverError: the file is unreadable or empty, ends before `within_s`, or has no joint
            states with positions and efforts; the sentence says what the file does have.
    """
    scan = open_scan(Path(path))
    scan.within_s = within_s
    return assembled(scan, joint_names, topic, beside)


def assembled(
    scan: Scan,
    joint_names: Sequence[str] | None = None,
    topic: str | None = None,
    beside: Beside = "",
) -> Log:
    """What a scan tells, see `read_log`."""
    sensors, tell = beside == "sensors", {"frames": (*READERS,), "imus": (IMU,)}.get(beside, ())
    kinds, needed = ((IMU,), (Q,)) if sensors else (tell, (Q, TAU))
    states, commanding = defaultdict[str, Told](lambda: Told(needed)), Told((TAU,), (TAU,))

    def take(series: Series, least: int = AT_ONCE) -> None:
        """Take what was decoded of joints, once it is so much that it is worth it."""
        if series.schema not in JOINT_SCHEMAS or not (series.blocks or series.bad):
            return
        if sum(len(block.index) for block in series.blocks) >= least:
            states[series.topic].take(series)
            if series.topic == JOINT_COMMANDS:
                commanding.take(series)
            series.blocks.clear()

    def is_wanted(series: Series) -> bool:
        """Whether the messages of a topic are decoded."""
        if series.topic in (topic, JOINT_COMMANDS) or series.schema in kinds:
            return True
        return topic is None if series.schema in JOINT_SCHEMAS else _is_of_links(series)

    topics = collect(scan, is_wanted, take)
    series = _choose_topic(scan, topics, topic, not sensors)
    check_type(series, scan.path)
    for other in topics.values():
        take(other, least=0)
    where, warnings = f"{scan.path}: {series.topic}", list(scan.warnings)
    rows = states[series.topic].chosen(series, where, joint_names, warnings)
    asked = [x for x in commanding.sets.values() if len(x) and {*x.names} & {*rows.names}]
    mapped = (
        len(rows) > IN_MEMORY
        and not any(s.count for s in topics.values() if _is_of_links(s) or s.schema in kinds)
        and len(asked) <= 1
        and not any(steps_back(in_use(*x.clocks, where, []))[0] for x in asked)
    )
    metadata = _decoded_metadata(scan)
    with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers are found by their size
        samples = joints_told(rows, where, not sensors, mapped, warnings)
        carrier, order = Carrier(samples[0], scan.path, warnings), metadata.get("link_names")
        names = order if isinstance(order, list) else []
        links = assemble_links(topics, names, carrier, sensors)
        found = frame_motions(topics, tell, scan.path, warnings)
    commands = None
    if JOINT_COMMANDS in topics and topics[JOINT_COMMANDS].count:
        check_type(topics[JOINT_COMMANDS], scan.path)
        where = f"{scan.path}: {JOINT_COMMANDS}"
        commands = commands_told(asked, where, rows.names, mapped, warnings)
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


def read_position_log(path: str | Path, topic: str | None = None) -> Log | None:
    """The positions of a recording that tells commanded ones beside them, without any efforts.

    Commands are those on `/joint_commands`, or the references in the state of a controller of
    trajectories, which has the positions with them.

    Args:
        path: as `read_log` takes it; topic: of the joint states. Where None `/joint_states`, else
            the only one that tells positions (and references, if there are no other commands).

    Returns:
        Finite positions, stamps of the encoders and of the commands strictly increasing; None for
        every other recording: those whose joint states have efforts, or whose commands are not
        positions.

    Raises:
        DriverError: the file is unreadable, positions and commands are of other joints, or several
            controllers tell both.
    """
    glance = open_scan(Path(path))
    glance.within_s = (0.0, 5.0)  # a long recording is not held in memory for that
    pair = _commanded(glance, topic)
    if pair is None:
        return None
    (states, ordering), scan = pair, open_scan(Path(path))
    topics = collect(scan, lambda series: series.topic in pair)
    read, commanded = topics[states], topics[ordering]
    asked = GOAL if read is commanded else Q
    if not fits(read, Q) or _has_effort(read) or not fits(commanded, asked):
        return None
    names, at, rows, said = _positions(read, scan.path, None)
    _, when, commands, _ = _positions(commanded, scan.path, names, asked)
    if topic is None and states != JOINT_STATES:
        both = "s are those" if asked == Q else "s and commands are feedback and reference"
        said.append(f"{scan.path}: position{both} of {states}")
    nothing, warnings = np.full_like(rows, np.nan), scan.warnings + said
    orders = Commands(when, np.full_like(commands, np.nan), commands)
    return Log(
        scan.path,
        names,
        at,
        rows,
        nothing,
        nothing,
        commands=orders,
        metadata=_decoded_metadata(scan),
        topics=_topics_told(topics),
        topic=states,
        truncated=scan.truncated,
        warnings=warnings,
    )


def _commanded(scan: Scan, topic: str | None) -> tuple[str, str] | None:
    """The topics of positions and of commanded ones, see `read_position_log`."""
    topics = collect(scan, lambda series: series.schema in JOINT_SCHEMAS)
    orders = topics.pop(JOINT_COMMANDS, None)
    usual = topics.get(topic or JOINT_STATES)
    told = [*topics.values()] if topic is None else [usual] if usual is not None else []
    if usual is not None and fits(usual, Q, TAU) and _has_effort(usual):
        return None
    alone = [x for x in told if x is usual or (usual is None and fits(x, Q))]
    if orders is not None and orders.count and len(alone) == 1:
        return alone[0].topic, JOINT_COMMANDS
    both = sorted(x.topic for x in told if fits(x, Q, GOAL))
    if not both or any(map(_has_effort, told)):
        return None
    if len(both) > 1:
        raise DriverError(
            f"{scan.path}: {len(both)} topics tell positions and commands: {', '.join(both)}; "
            "choose one (--topic NAME)"
        )
    return both[0], both[0]


def _positions(
    series: Series, path: Path, want: Sequence[str] | None, run: int = Q
) -> tuple[tuple[str, ...], NDArray[np.int64], Array, list[str]]:
    """Joints of a topic, finite positions (k, n) in the order of time, and sentences on its clock.

    With stamps (k,), of each of which it is the first; of `want` in that order where it is given.
    """
    told, where, said = Told((run,), (run,)), f"{path}: {series.topic}", list[str]()
    told.take(series)
    rows = told.chosen(series, where, want, [])
    stamp_ns = in_use(*rows.clocks, where, said).table(False)[:, 0]
    q = rows.runs[run].table(False)[:, [rows.names.index(name) for name in want or rows.names]]
    finite = np.isfinite(q).all(axis=1)
    found, first = np.unique(stamp_ns[finite], return_index=True)
    return rows.names, found, np.ascontiguousarray(q[finite][first]), said


def _has_effort(series: Series) -> bool:
    """Whether any message tells an effort that is a number and not zero."""
    return any(np.any(np.nan_to_num(block.values[2])) for block in series.blocks)


def survey(path: str | Path) -> tuple[dict[str, Topic], list[str], bool]:
    """Topics, warnings and whether the file is cut, of any recording. Raises DriverError."""
    scan = open_scan(Path(path))
    return _topics_told(collect(scan, lambda series: False)), scan.warnings, scan.truncated


def read_estimates(path: str | Path) -> Iterator[dict[str, Any]]:
    """The estimates in a recording, in the order of the file, as `estimate_values` tells them.

    Raises DriverError.
    """
    for message in read_messages(path, ESTIMATES):
        if message.schema == ESTIMATE:
            yield estimate_values(message.fields)


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
    fitting = []
    if topic is None:
        needed = (Q, TAU) if effort else (Q,)
        fitting = sorted(k for k, s in topics.items() if k != JOINT_COMMANDS and fits(s, *needed))
    if series is not None and JOINT_STATES in fitting:
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
    silent = [s for k, s in topics.items() if k != JOINT_COMMANDS and fits(s, Q)]
    if series is None and topic is None and len(silent) == 1:
        return silent[0]  # which lacks efforts, and that is what is said
    if series is None or not series.count:
        raise DriverError(_nothing_found(scan, topics, topic or JOINT_STATES))
    return series


def _is_of_links(series: Series) -> bool:
    return series.topic.startswith((LINK_TWISTS, LINK_ACCELS))


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
        if record.name != METADATA:
            entries[record.name] = dict(record.metadata)
            continue
        for key, value in record.metadata.items():
            try:
                entries[key] = parse_json(value)
            except ValueError:
                entries[key] = value
    return entries
