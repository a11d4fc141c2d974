"""All messages of the wanted topics of a file, decoded in bulk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from drivers.files import ros, ros_types
from drivers.files.mcap.records import Region, Scan
from drivers.interface import DriverError

_JOINT_PARSERS: dict[str, Callable[[ros.Bytes], ros.Layout]] = {
    ros_types.JOINT_STATE: ros.parse_joint_state,
    ros_types.DYNAMIC_JOINT_STATE: ros.parse_dynamic_joint_state,
    ros_types.JOINT_TRAJECTORY_CONTROLLER_STATE: ros.parse_controller_state,
    ros_types.FRANKA_ROBOT_STATE: ros.parse_franka_robot_state,
    ros_types.FRANKA_STATE: ros.parse_franka_state,
}
JOINT_SCHEMAS = tuple(_JOINT_PARSERS)  # messages with positions, velocities and efforts of joints
PARSERS: dict[str, Callable[[ros.Bytes], ros.Layout]] = {
    **_JOINT_PARSERS,
    ros_types.TWIST_STAMPED: partial(ros.parse_doubles, number=6),
    ros_types.ACCEL_STAMPED: partial(ros.parse_doubles, number=6),
    ros_types.IMU: partial(ros.parse_doubles, number=ros.IMU_DOUBLES),
    ros_types.ODOMETRY: partial(ros.parse_doubles, number=ros.ODOMETRY_DOUBLES, of_child=True),
}


@dataclass
class Series:
    """The messages of one topic.

    Attributes:
        topic, schema: their names; a schema's name without the older spelling's missing `/msg/`.
        encoding: of the messages; only `cdr` is decoded.
        count: messages in the file.
        blocks: the decoded messages, by layout.
        kinds: joints and lengths of the runs of doubles of all that there were.
        bad: (place, reason) of messages that could not be read.
    """

    topic: str
    schema: str
    encoding: str
    count: int = 0
    blocks: list[ros.Block] = field(default_factory=list)
    kinds: set[tuple[tuple[str, ...], tuple[int, ...]]] = field(default_factory=set)
    bad: list[tuple[int, str]] = field(default_factory=list)

    def add(self, region: Region, which: NDArray[np.int64], times: NDArray[np.int64]) -> None:
        """Decode the messages `which` of a region and append them."""
        parse = PARSERS[self.schema]
        sizes = (region.stop - region.start)[which]
        for size in np.unique(sizes):
            here = np.flatnonzero(sizes == size)
            rows = region.rows(region.start[which[here]], int(size))
            blocks, bad = ros.decode_many(rows, parse)
            for block in blocks:
                places = here[block.index]
                index, log_ns = self.count + places, times[which[places]]
                self.blocks.append(replace(block, index=index, log_ns=log_ns))
                self.kinds.add((block.layout.names, tuple(x.shape[1] for x in block.values)))
            self.bad += [(self.count + int(here[i]), reason) for i, reason in bad]
        self.count += len(which)

    def frames(self) -> Counter[str]:
        """How many of the decoded messages name each frame."""
        counts: Counter[str] = Counter()
        for block in self.blocks:
            counts[block.layout.frame_id] += len(block.index)
        return counts

    def in_frame(self, frame: str) -> Series:
        """The messages that name a frame."""
        blocks = [block for block in self.blocks if block.layout.frame_id == frame]
        return replace(self, blocks=blocks, count=sum(len(b.index) for b in blocks), bad=[])


def in_order(blocks: Sequence[ros.Block], of: Callable[[ros.Block], NDArray]) -> NDArray:
    """What each block has of its messages, in one array in the order of the file."""
    joined = np.concatenate([of(block) for block in blocks])
    if all(a.index[-1] < b.index[0] for a, b in pairwise(blocks)):
        return joined
    return joined[np.argsort(np.concatenate([block.index for block in blocks]), kind="stable")]


def schema_name(scan: Scan, channel: Channel) -> str:
    """A channel's type, `pkg/msg/Name`; some recorders write `pkg/Name`."""
    schema = scan.schemas.get(channel.schema_id)
    if schema is None:
        return ""
    parts = schema.name.split("/")
    return "/".join((parts[0], "msg", parts[1])) if len(parts) == 2 else schema.name


def collect(
    scan: Scan, wanted: Callable[[Series], bool], take: Callable[[Series], None] | None = None
) -> dict[str, Series]:
    """Every topic of the file by name; those `wanted` are decoded, the others counted.

    Args:
        take: is given a topic of `wanted` each time that it has decoded some messages more.

    Raises:
        DriverError: the recording ends before `scan.within_s`.
    """
    topics: dict[str, Series] = {}
    within_s, unknown, outside, begin, end = scan.within_s, 0, 0, 0, 0
    for region in scan.regions():
        channels = region.channel
        times = region.times[:, 0].astype(np.int64)
        if len(times):
            begin, end = begin or int(times.min()), max(end, int(times.max()))
        by_topic: dict[str, list[int]] = {}  # a topic with several publishers has several channels
        for number in np.unique(channels).tolist():
            known = scan.channels.get(number)
            by_topic.setdefault(known.topic if known else "", []).append(number)
        for topic, numbers in by_topic.items():
            which = np.flatnonzero(np.isin(channels, numbers))
            if not topic:
                unknown += len(which)
                continue
            series = _series(topics, scan, scan.channels[numbers[0]])
            if wanted(series) and series.encoding == "cdr" and series.schema in PARSERS:
                if within_s is not None:
                    since = 1e-9 * (times[which] - begin)
                    inside = (since >= within_s[0]) & (since < within_s[1])
                    series.count += int((~inside).sum())
                    outside, which = outside + int((~inside).sum()), which[inside]
                series.add(region, which, times)
                if take is not None:
                    take(series)
            else:
                series.count += len(which)
    if unknown:
        scan.warnings.append(f"{scan.path}: {unknown} messages belong to no channel; left out")
    if within_s is not None and outside:
        (first, last), seconds = within_s, 1e-9 * (end - begin)
        if first > seconds:
            raise DriverError(f"{scan.path} ends at {seconds:.1f} s, before {first:g} s")
        last = min(last, seconds)
        scan.warnings.append(f"{scan.path}: read from {first:g} to {last:g} s of {seconds:.0f} s")
    for channel in scan.channels.values():
        _series(topics, scan, channel)
    for topic, count in scan.passed.items():
        topics[topic].count += count
    for series in topics.values():
        if series.schema == ros_types.JOINT_JOG and series.count:
            scan.warnings.append(
                f"{scan.path}: {series.topic} jogs: steps and speeds from wherever a joint is tell "
                "which joints were asked to move, and not where to; record the positions that are "
                "made of them, too (/joint_commands, or the controller's state)"
            )
    return topics


def _series(topics: dict[str, Series], scan: Scan, channel: Channel) -> Series:
    if channel.topic not in topics:
        name = schema_name(scan, channel)
        topics[channel.topic] = Series(channel.topic, name, channel.message_encoding)
    return topics[channel.topic]
