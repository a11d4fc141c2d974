"""What topics say of frames' motion: sensors glued on links, `sensor_msgs/msg/Imu` on whatever
topic, and of a floating base also `Odometry`, `TwistStamped` and `AccelStamped`.

An Imu tells angular velocity and what the accelerometer reads (9.81 m/s² up at rest), in the
sensor's own frame. A sensor is what one topic says of one frame. ROS marks what a sensor does not
measure by -1 as the first number of its covariance.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from drivers.files.mcap.joints import stamps
from drivers.files.mcap.links import Carrier, Links
from drivers.files.mcap.log import FrameMotion
from drivers.files.mcap.series import Series
from drivers.files.ros_types import ACCEL_STAMPED, IMU, ODOMETRY, TWIST_STAMPED
from drivers.interface import Array

_W, _W_UNKNOWN = slice(13, 16), 16  # of the run of doubles, and where its covariance begins
_A, _A_UNKNOWN = slice(25, 28), 28
_TWIST = 43  # where an Odometry's twist begins in its run of doubles
_MOST_W = 200.0  # rad/s; gyroscopes end at 70 (4000 °/s)
_MOST_A = 5000.0  # m/s²; accelerometers of robots end at 2000 (200 g)
_AT_REST = (5.0, 15.0)  # m/s², the median of what an accelerometer reads lies around 9.81
_RARE = 0.05  # of a topic's messages; a frame named less often comes from damaged ones


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
    found = _distinct(frame_motions(topics, (IMU,), path, warnings), path, warnings)
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


def frame_motions(
    topics: Mapping[str, Series], schemas: Collection[str], path: Path, warnings: list[str]
) -> list[FrameMotion]:
    """What the topics of these types (of `READERS`) say, one entry for each topic and frame."""
    found = []
    for topic, series in topics.items():
        if series.schema not in schemas or not series.count:
            continue
        where = f"{path}: {topic}"
        if series.encoding != "cdr":
            held = f"{series.schema} as {series.encoding}"
            warnings.append(f"{where}: holds {held}, not as cdr; left out")
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
            motion = READERS[series.schema](_of(series, frame), frame, where, warnings)
            if motion is not None:
                found.append(motion)
    return found


def _of(series: Series, frame: str) -> Series:
    return series.only(lambda block: block.layout.frame_id == frame)


def _imu(series: Series, frame: str, where: str, warnings: list[str]) -> FrameMotion | None:
    """What an Imu says; None where no angular velocity is among it."""
    values = series.in_order([block.values[0] for block in series.blocks])
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
    stamp_ns = stamps(series, where, warnings)
    return FrameMotion(series.topic, series.schema, frame, stamp_ns, w, a, np.full_like(w, np.nan))


def _other(series: Series, frame: str, where: str, warnings: list[str]) -> FrameMotion | None:
    """What a TwistStamped, an AccelStamped or an Odometry says."""
    values = series.in_order([block.values[0] for block in series.blocks])
    first = _TWIST if series.schema == ODOMETRY else 0
    linear, angular = values[:, first : first + 3], values[:, first + 3 : first + 6]
    nothing, stamp_ns = np.full_like(linear, np.nan), stamps(series, where, warnings)
    about = series.topic, series.schema, frame, stamp_ns
    if series.schema == ACCEL_STAMPED:  # its angular part is the rate of a velocity that is there
        return FrameMotion(*about, nothing, linear, nothing)
    return FrameMotion(*about, angular, nothing, linear)


READERS: dict[str, Callable[[Series, str, str, list[str]], FrameMotion | None]] = {
    IMU: _imu,
    ODOMETRY: _other,
    TWIST_STAMPED: _other,
    ACCEL_STAMPED: _other,
}


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


def _distinct(found: Sequence[FrameMotion], path: Path, warnings: list[str]) -> list[FrameMotion]:
    """Without sensors that another topic holds too (raw and processed, say)."""
    kept: list[FrameMotion] = []
    for imu in found:
        twin = next((k for k in kept if _same(k, imu)), None)
        if twin is None:
            kept.append(imu)
        else:
            warnings.append(f"{path}: {imu.topic} holds the sensor of {twin.topic} again; left out")
    return kept


def _same(one: FrameMotion, other: FrameMotion) -> bool:
    return (
        np.array_equal(one.stamp_ns, other.stamp_ns)
        and np.array_equal(one.w, other.w, equal_nan=True)
        and np.array_equal(one.a, other.a, equal_nan=True)
        and bool(np.any(one.w))
    )


def _names(found: Sequence[FrameMotion], taken: Collection[str]) -> list[str]:
    """Frames where each sensor has one of its own, else topics."""
    frames = [imu.frame for imu in found]
    if all(frames) and len(set(frames)) == len(frames) and not set(frames) & set(taken):
        return frames
    topics = Counter(imu.topic for imu in found)
    return [f"{i.topic}:{i.frame}" if topics[i.topic] > 1 else i.topic for i in found]
