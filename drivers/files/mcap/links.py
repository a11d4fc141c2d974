"""Motion of links and of frames on them, told by sensors: matched to joint samples or carried.

Link motion with the joint samples' header stamps is matched to them. A sensor with stamps of its
own is carried: a message goes to the joint sample nearest in time, along the straight line through
its neighbours; of several that share a sample their mean does. Samples that no message is nearest
to stay not a number. So nothing is made up in gaps, and the noise of what is there stays that of
the sensor, which values interpolated at every sample would hide.

Of frames tell sensors glued on links, `sensor_msgs/msg/Imu` on whatever topic, and of a floating
base also `Odometry`, `TwistStamped` and `AccelStamped`. An Imu tells angular velocity and what the
accelerometer reads (9.81 m/s² up at rest), in the sensor's own frame. A sensor is what one topic
says of one frame. ROS marks what a sensor does not measure by -1 as the first number of its
covariance.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap.joints import stamps
from drivers.files.mcap.log import FrameMotion
from drivers.files.mcap.series import Series, in_order
from drivers.files.mcap.writer import LINK_ACCELS, LINK_TWISTS
from drivers.files.ros_types import ACCEL_STAMPED, IMU, ODOMETRY, TWIST_STAMPED
from drivers.interface import Array

_MOST_MATCHED = 0.9  # share of a topic's stamps that joint samples have; below, stamps are its own
_W, _W_UNKNOWN = slice(13, 16), 16  # of the run of doubles, and where its covariance begins
_A, _A_UNKNOWN = slice(25, 28), 28
_TWIST = 43  # where an Odometry's twist begins in its run of doubles
_MOST_W = 200.0  # rad/s; gyroscopes end at 70 (4000 °/s)
_MOST_A = 5000.0  # m/s²; accelerometers of robots end at 2000 (200 g)
_AT_REST = (5.0, 15.0)  # m/s², the median of what an accelerometer reads lies around 9.81
_RARE = 0.05  # of a topic's messages; a frame named less often comes from damaged ones


class Carrier:
    """Carries sensors to the stamps of the joint samples and keeps what to say of it."""

    def __init__(self, stamp_ns: NDArray[np.int64], path: Path, warnings: list[str]) -> None:
        """Take (m,) stamps of the joint samples, ns; sentences go to `warnings`."""
        self.stamp_ns, self.path, self.warnings = stamp_ns, path, warnings
        self._carried: dict[str, list[str]] = {}

    @cached_property
    def _samples(self) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
        """Stamps of the joint samples, rising, and whose they are; a long log may need none."""
        stamp_ns, rows = np.unique(self.stamp_ns, return_index=True)
        return stamp_ns, rows

    def carry(self, name: str, own_ns: NDArray[np.int64], values: Array) -> Array | None:
        """(m, 3 h) the values (k, 3 h) of a sensor at the joint samples, each vector by itself.

        None, with a warning, where no message lies within the joint samples' time.

        Args:
            name: of the sensor, for sentences.
            own_ns: (k,) stamps; values: vectors that are not a number are passed over.
        """
        onto, rows = self._samples
        own, first = np.unique(own_ns, return_index=True)
        near, close = _nearest(onto, own)
        if not close.any():
            spans = (1e-9 * (x[[0, -1]] - onto[0]) for x in (own, onto))
            theirs, joints = (f"{first:.3f} to {last:.3f} s" for first, last in spans)
            self.warnings.append(
                f"{self.path}: {name}: its stamps ({theirs}) lie outside those of the joint "
                f"samples ({joints}); do they share a clock? Left out"
            )
            return None
        missed = len(own) - int(close.sum())
        if missed > 0.05 * len(own):
            self.warnings.append(
                f"{self.path}: {name}: {missed} of {len(own)} messages are near no joint sample; "
                "left out"
            )
        out = np.full((len(self.stamp_ns), values.shape[1]), np.nan)
        for k in range(0, values.shape[1], 3):
            x = values[first, k : k + 3]
            use = close & np.isfinite(x).all(axis=1)
            cells, moved = _moved(onto, own[use], near[use], x[use])
            out[rows[cells], k : k + 3] = moved
        rate = "one message"
        if len(own) > 1:
            rate = f"{1e9 / float(np.median(np.diff(own))):.0f} Hz"
        self._carried.setdefault(rate, []).append(name)
        return out

    def tell(self) -> None:
        """One sentence for all sensors of a rate."""
        for rate, names in self._carried.items():
            self.warnings.append(
                f"{self.path}: {', '.join(names)}: {rate}, carried to the joint samples' stamps"
            )


def _nearest(
    onto: NDArray[np.int64], own: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """(k,) the nearest of the stamps `onto`, and whether it is no further than their period."""
    if len(onto) < 2:
        return np.zeros(len(own), dtype=np.int64), np.isin(own, onto)
    right = np.clip(np.searchsorted(onto, own), 1, len(onto) - 1)
    near = right - (own - onto[right - 1] < onto[right] - own)
    return near, np.abs(onto[near] - own) <= np.median(np.diff(onto))


def _moved(
    onto: NDArray[np.int64], own: NDArray[np.int64], near: NDArray[np.int64], x: Array
) -> tuple[NDArray[np.int64], Array]:
    """Places in `onto` (c,) that messages are nearest to, and their values (c, 3) there."""
    start = np.flatnonzero(np.diff(near, prepend=-1))
    if not start.size:
        return near, x
    count = np.diff(start, append=len(near))
    cells = near[start]
    early_s = 1e-9 * (own - onto[near]).astype(np.float64)
    off_s = np.add.reduceat(early_s, start) / count
    mean = np.add.reduceat(x, start, axis=0) / count[:, None]
    t_s = 1e-9 * (onto[cells] - onto[0]).astype(np.float64) + off_s
    return cells, mean - off_s[:, None] * _slopes(t_s, mean)


def _slopes(t_s: Array, x: Array) -> Array:
    """(c, 3) rates of change: the mean of those to either side, but not across a silence."""
    step = np.diff(t_s)
    if not step.size:
        return np.zeros_like(x)
    near = step <= 3.0 * np.median(step)  # no line across a longer silence
    rate = np.where(near[:, None], np.diff(x, axis=0) / step[:, None], 0.0)
    none = np.zeros((1, x.shape[1]))
    sides = np.concatenate([[0], near]) + np.concatenate([near, [0]])
    total = np.concatenate([none, rate]) + np.concatenate([rate, none])
    return np.asarray(total / np.maximum(sides, 1)[:, None])


class Links(NamedTuple):
    """(m, n, 6) twists and accelerations; not a number where a stamp has no message."""

    names: tuple[str, ...]
    twists: Array | None
    accels: Array | None


def assemble_links(
    topics: Mapping[str, Series], order: Sequence[str], carrier: Carrier, sensors: bool
) -> Links:
    """Link motion at the joint samples' stamps.

    Args:
        topics: the file's topics.
        order: link names in their recorded order; links not in it follow in the file's order.
        carrier: to the joint samples' stamps, with what sentences need.
        sensors: carry also topics with stamps of their own, whose frames may then be of other
            names, and behind them all Imu topics. If not, such messages are left out.
    """
    of_links = {k: s for k, s in topics.items() if not (sensors and s.schema == IMU)}
    found = [
        topic.removeprefix(prefix)
        for topic, series in of_links.items()
        for prefix in (LINK_TWISTS, LINK_ACCELS)
        if topic.startswith(prefix) and series.count
    ]
    names = tuple(dict.fromkeys([n for n in order if n in found] + found))
    frames = dict(zip(names, names, strict=True))
    if sensors:
        frames |= _frames_of_their_own(of_links, names, carrier)
    twists = _stack(of_links, TWIST_STAMPED, frames, carrier, sensors)
    accels = _stack(of_links, ACCEL_STAMPED, frames, carrier, sensors)
    links = Links(names if twists is not None or accels is not None else (), twists, accels)
    if sensors:
        links = _with_imus(links, topics, carrier)
        carrier.tell()
    return links


def _stack(
    topics: Mapping[str, Series],
    schema: str,
    frames: Mapping[str, str],
    carrier: Carrier,
    sensors: bool,
) -> Array | None:
    """(m, links, 6) one kind of motion of all links; None where there is none."""
    stack = np.full((len(carrier.stamp_ns), len(frames), 6), np.nan)
    used = False
    for i, (name, frame) in enumerate(frames.items()):
        series = topics.get((LINK_TWISTS if schema == TWIST_STAMPED else LINK_ACCELS) + name)
        if series is None or not series.count:
            continue
        where = f"{carrier.path}: {series.topic}"
        part = _in_frame(series, schema, frame, where, carrier.warnings)
        if part is None:
            continue
        used = True
        link_ns = stamps(part, where, carrier.warnings)
        values = in_order(part.blocks, lambda block: block.values[0])
        matched = _match(carrier.stamp_ns, link_ns, values, stack[:, i])
        sent = len(np.unique(link_ns))
        if sensors and matched < _MOST_MATCHED * sent:
            carried = carrier.carry(part.topic, link_ns, values)
            stack[:, i] = np.nan if carried is None else carried
        elif matched < sent:
            carrier.warnings.append(
                f"{where}: {sent - matched} of {len(link_ns)} messages carry "
                "the stamp of no joint sample; left out"
            )
    return stack if used else None


def _frames_of_their_own(
    topics: Mapping[str, Series], names: tuple[str, ...], carrier: Carrier
) -> dict[str, str]:
    """Frames that can only be the links' own, though they have other names.

    Motion told in a frame of the world, of the base or of another link shares that frame with
    others, or with their names. So all links must have a frame each that no other has, or none.
    """
    frames, path, warnings = {}, carrier.path, carrier.warnings
    for name in names:
        both = (topics.get(prefix + name) for prefix in (LINK_TWISTS, LINK_ACCELS))
        counts = sum((x.frames() for x in both if x is not None), Counter[str]())
        frames[name] = max(counts, key=lambda frame: counts[frame], default="")
    told = set(frames.values())
    if told == {""}:
        warnings.append(f"{path}: no frame of link motion is named; taken to be the links' own")
        return frames
    if len(names) < 2 or len(told) < len(names) or "" in told or told & set(names):
        return {}
    pairs = ", ".join(f"{frame!r} of {name!r}" for name, frame in frames.items())
    warnings.append(f"{path}: frames taken to be fixed to their links: {pairs}")
    return frames


def _in_frame(
    series: Series, schema: str, link: str, where: str, warnings: list[str]
) -> Series | None:
    """Messages whose frame is the link's; anything else would be taken for what it isn't."""
    if series.schema != schema or series.encoding != "cdr":
        warnings.append(
            f"{where}: holds {series.schema or 'no type'} as {series.encoding}, not {schema} as "
            "cdr; left out"
        )
        return None
    part = series.in_frame(link)
    if part.count < series.count - len(series.bad):
        frames = sorted(series.frames().keys() - {link})
        warnings.append(
            f"{where}: {series.count - len(series.bad) - part.count} messages are in the frame "
            f"{', '.join(map(repr, frames))}, not in that of the link, {link!r}; left out"
        )
    if series.bad:
        warnings.append(f"{where}: {len(series.bad)} messages are unreadable; left out")
    return part if part.blocks else None


def _match(
    stamp_ns: NDArray[np.int64], link_ns: NDArray[np.int64], values: Array, into: Array
) -> int:
    """Write the values of equal stamps into `into`; the number of stamps that found a sample."""
    if np.array_equal(stamp_ns, link_ns):
        into[:] = values
        return len(np.unique(link_ns))
    order = np.argsort(link_ns, kind="stable")
    place = np.minimum(np.searchsorted(link_ns[order], stamp_ns), len(order) - 1)
    equal = link_ns[order][place] == stamp_ns
    into[equal] = values[order][place[equal]]
    return len(np.unique(stamp_ns[equal]))


def _with_imus(links: Links, topics: Mapping[str, Series], carrier: Carrier) -> Links:
    """The links' motion, and behind it that of all Imu topics at the joint samples."""
    found: list[FrameMotion] = []  # without those that another topic holds too (raw and processed)
    for imu in frame_motions(topics, (IMU,), carrier.path, carrier.warnings):
        twin = next((other for other in found if _same(other, imu)), None)
        if twin is None:
            found.append(imu)
        else:
            said = f"{imu.topic} holds the sensor of {twin.topic} again; left out"
            carrier.warnings.append(f"{carrier.path}: {said}")
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
        counts = series.frames()
        for frame, count in counts.items():
            if count < _RARE * counts.total():
                warnings.append(f"{where}: {count} messages name the frame {frame!r}; left out")
                continue
            motion = READERS[series.schema](series.in_frame(frame), frame, where, warnings)
            if motion is not None:
                found.append(motion)
    return found


def _imu(series: Series, frame: str, where: str, warnings: list[str]) -> FrameMotion | None:
    """What an Imu says; None where no angular velocity is among it."""
    values = in_order(series.blocks, lambda block: block.values[0])
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
    values = in_order(series.blocks, lambda block: block.values[0])
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


def _same(one: FrameMotion, other: FrameMotion) -> bool:
    pairs = ((one.stamp_ns, other.stamp_ns), (one.w, other.w), (one.a, other.a))
    return bool(np.any(one.w)) and all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def _names(found: Sequence[FrameMotion], taken: Collection[str]) -> list[str]:
    """Frames where each sensor has one of its own, else topics."""
    frames = [imu.frame for imu in found]
    if all(frames) and len(set(frames)) == len(frames) and not set(frames) & set(taken):
        return frames
    topics = Counter(imu.topic for imu in found)
    return [f"{i.topic}:{i.frame}" if topics[i.topic] > 1 else i.topic for i in found]
