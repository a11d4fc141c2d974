"""Sensors glued on links: `sensor_msgs/msg/Imu` on whatever topic.

Angular velocity and what the accelerometer reads (9.81 m/s² up at rest), in the sensor's own frame.
A sensor is what one topic says of one frame. ROS marks what a sensor does not measure by -1 as the
first number of its covariance.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap.joints import stamps
from drivers.files.mcap.links import Carrier, Links
from drivers.files.mcap.series import Series
from drivers.files.ros import IMU
from drivers.interface import Array

_W, _W_UNKNOWN = slice(13, 16), 16  # of the run of doubles, and where its covariance begins
_A, _A_UNKNOWN = slice(25, 28), 28
_MOST_W = 200.0  # rad/s; gyroscopes end at 70 (4000 °/s)
_MOST_A = 5000.0  # m/s²; accelerometers of robots end at 2000 (200 g)
_AT_REST = (5.0, 15.0)  # m/s², the median of what an accelerometer reads lies around 9.81
_RARE = 0.05  # of a topic's messages; a frame named less often comes from damaged ones


@dataclass(frozen=True, slots=True)
class Imu:
    """One sensor: (k,) stamps ns, (k, 3) rad/s and m/s², not a number where not measured."""

    topic: str
    frame: str
    stamp_ns: NDArray[np.int64]
    w: Array
    a: Array


def with_imus(
    links: Links, topics: Mapping[str, Series], carrier: Carrier, path: Path, warnings: list[str]
) -> Links:
    """The links' motion, and behind it that of all Imu topics at the joint samples.

    Args:
        links: motion of links that is there already, (m, n, 6) each.
        topics: the file's topics.
        carrier: to the joint samples' stamps.
        path, warnings: for sentences on what was left out.
    """
    found = _distinct(_imus(topics, path, warnings), path, warnings)
    names, motion = list(links.names), []
    for imu, name in zip(found, _names(found, links.names), strict=True):
        values = carrier.carry(name, imu.stamp_ns, np.concatenate([imu.w, imu.a], axis=1))
        if values is not None:
            names.append(name)
            motion.append(values)
    if not motion:
        return links
    own = np.stack(motion, axis=1)
    nothing = np.full_like(own[..., :3], np.nan)
    missing = np.full((len(own), len(links.names), 6), np.nan)
    before = [missing if x is None else x for x in (links.twists, links.accels)]
    twists = np.concatenate([nothing, own[..., :3]], axis=2)
    accels = np.concatenate([own[..., 3:], nothing], axis=2)
    return Links(
        tuple(names),
        np.concatenate([before[0], twists], axis=1),
        np.concatenate([before[1], accels], axis=1),
    )


def _imus(topics: Mapping[str, Series], path: Path, warnings: list[str]) -> list[Imu]:
    found = []
    for topic, series in topics.items():
        if series.schema != IMU or not series.count:
            continue
        where = f"{path}: {topic}"
        if series.encoding != "cdr":
            warnings.append(f"{where}: holds {IMU} as {series.encoding}, not as cdr; left out")
        if series.bad:
            place, reason = series.bad[0]
            warnings.append(
                f"{where}: {len(series.bad)} messages are unreadable, first number {place}: "
                f"{reason}; left out"
            )
        counts: Counter[str] = Counter()
        for block in series.blocks:
            counts[block.layout.frame_id] += len(block.index)
        for frame, count in counts.items():
            if count < _RARE * counts.total():
                warnings.append(f"{where}: {count} messages name the frame {frame!r}; left out")
                continue
            imu = _imu(series, frame, where, warnings)
            if imu is not None:
                found.append(imu)
    return found


def _imu(series: Series, frame: str, where: str, warnings: list[str]) -> Imu | None:
    """What a topic says of one frame; None where no angular velocity is among it."""
    part = series.only(lambda block: block.layout.frame_id == frame)
    values = part.in_order([block.values[0] for block in part.blocks])
    w = _measured(values, _W, _W_UNKNOWN, _MOST_W, f"{where}: angular velocities", warnings)
    a = _measured(values, _A, _A_UNKNOWN, _MOST_A, f"{where}: accelerations", warnings)
    if np.isnan(w).all():
        warnings.append(f"{where}: measures no angular velocity; left out")
        return None
    heard = np.isfinite(a).all(axis=1)
    size = float(np.median(np.linalg.norm(a[heard], axis=1))) if heard.any() else np.nan
    if not np.isnan(size) and not _AT_REST[0] < size < _AT_REST[1]:
        warnings.append(
            f"{where}: accelerations are mostly about {size:.2g} m/s², but at rest 9.81 is what "
            "an accelerometer reads; are they in g, or without gravity?"
        )
    return Imu(series.topic, frame, stamps(part, where, warnings), w, a)


def _measured(
    values: Array, part: slice, unknown: int, most: float, what: str, warnings: list[str]
) -> Array:
    """(k, 3) one vector of each message; not a number where not measured, or not possible."""
    x = values[:, part].copy()
    x[values[:, unknown] == -1.0] = np.nan
    wild = (np.isinf(x) | (np.abs(x) > most)).any(axis=1)
    if wild.any():
        warnings.append(f"{what} of {int(wild.sum())} messages are impossible; left out")
    x[wild | np.isnan(x).any(axis=1)] = np.nan
    return x


def _distinct(found: Sequence[Imu], path: Path, warnings: list[str]) -> list[Imu]:
    """Without sensors that another topic holds too (raw and processed, say)."""
    kept: list[Imu] = []
    for imu in found:
        twin = next((k for k in kept if _same(k, imu)), None)
        if twin is None:
            kept.append(imu)
        else:
            warnings.append(f"{path}: {imu.topic} holds the sensor of {twin.topic} again; left out")
    return kept


def _same(one: Imu, other: Imu) -> bool:
    return (
        np.array_equal(one.stamp_ns, other.stamp_ns)
        and np.array_equal(one.w, other.w, equal_nan=True)
        and np.array_equal(one.a, other.a, equal_nan=True)
        and bool(np.any(one.w))
    )


def _names(found: Sequence[Imu], taken: Collection[str]) -> list[str]:
    """Frames where each sensor has one of its own, else topics."""
    frames = [imu.frame for imu in found]
    if all(frames) and len(set(frames)) == len(frames) and not set(frames) & set(taken):
        return frames
    topics = Counter(imu.topic for imu in found)
    return [f"{i.topic}:{i.frame}" if topics[i.topic] > 1 else i.topic for i in found]
