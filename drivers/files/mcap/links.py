"""Measured link motion, matched to the joint samples by header stamp, or carried to them.

A sensor with stamps of its own is carried: a message goes to the joint sample nearest in time,
along the straight line through its neighbours; of several that share a sample their mean does.
Samples that no message is nearest to stay not a number. So nothing is made up in gaps, and the
noise of what is there stays that of the sensor, which values interpolated at every sample would
hide.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap.joints import stamps
from drivers.files.mcap.series import Series
from drivers.files.mcap.writer import LINK_ACCELS, LINK_TWISTS
from drivers.files.ros_types import ACCEL_STAMPED, TWIST_STAMPED
from drivers.interface import Array

LONGEST_PERIODS = 3.0  # of the sensor; no line is drawn across a longer silence
MENTIONED = 0.05  # share of messages outside the joint samples' time that is worth a sentence
_MOST_MATCHED = 0.9  # share of a topic's stamps that joint samples have; below, stamps are its own


class Carrier:
    """Carries sensors to the stamps of the joint samples and keeps what to say of it."""

    def __init__(self, stamp_ns: NDArray[np.int64], path: Path, warnings: list[str]) -> None:
        """Take (m,) stamps of the joint samples, ns; sentences go to `warnings`."""
        self._count = len(stamp_ns)
        self._onto, self._rows = np.unique(stamp_ns, return_index=True)
        self._path, self._warnings = path, warnings
        self._carried: dict[str, list[str]] = {}

    def carry(self, name: str, own_ns: NDArray[np.int64], values: Array) -> Array | None:
        """(m, 3 h) the values (k, 3 h) of a sensor at the joint samples, each vector by itself.

        None, with a warning, where no message lies within the joint samples' time.

        Args:
            name: of the sensor, for sentences.
            own_ns: (k,) stamps; values: vectors that are not a number are passed over.
        """
        own, first = np.unique(own_ns, return_index=True)
        near, close = _nearest(self._onto, own)
        if not close.any():
            theirs, joints = (_span(stamps, self._onto[0]) for stamps in (own, self._onto))
            self._warnings.append(
                f"{self._path}: {name}: its stamps ({theirs}) lie outside those of the joint "
                f"samples ({joints}); do they share a clock? Left out"
            )
            return None
        missed = len(own) - int(close.sum())
        if missed > MENTIONED * len(own):
            self._warnings.append(
                f"{self._path}: {name}: {missed} of {len(own)} messages are near no joint sample; "
                "left out"
            )
        out = np.full((self._count, values.shape[1]), np.nan)
        for k in range(0, values.shape[1], 3):
            x = values[first, k : k + 3]
            use = close & np.isfinite(x).all(axis=1)
            cells, moved = _moved(self._onto, own[use], near[use], x[use])
            out[self._rows[cells], k : k + 3] = moved
        self._carried.setdefault(_rate(own), []).append(name)
        return out

    def tell(self) -> None:
        """One sentence for all sensors of a rate."""
        for rate, names in self._carried.items():
            self._warnings.append(
                f"{self._path}: {', '.join(names)}: {rate}, carried to the joint samples' stamps"
            )


def _rate(own_ns: NDArray[np.int64]) -> str:
    if len(own_ns) < 2:
        return "one message"
    return f"{1e9 / float(np.median(np.diff(own_ns))):.0f} Hz"


def _span(stamp_ns: NDArray[np.int64], start_ns: int) -> str:
    first, last = 1e-9 * (stamp_ns[[0, -1]] - start_ns)
    return f"{first:.3f} to {last:.3f} s"


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
    near = step <= LONGEST_PERIODS * np.median(step)
    rate = np.where(near[:, None], np.diff(x, axis=0) / step[:, None], 0.0)
    none = np.zeros((1, x.shape[1]))
    sides = np.concatenate([[0], near]) + np.concatenate([near, [0]])
    total = np.concatenate([none, rate]) + np.concatenate([rate, none])
    return np.asarray(total / np.maximum(sides, 1)[:, None])


@dataclass(frozen=True, slots=True)
class Links:
    """(m, n, 6) twists and accelerations; not a number where a stamp has no message."""

    names: tuple[str, ...]
    twists: Array | None
    accels: Array | None


class Onto(NamedTuple):
    """What link motion is brought onto.

    Attributes:
        stamp_ns: (m,) stamps of the joint samples.
        path, warnings: for sentences on what was left out.
        carrier: for topics with stamps of their own, whose frames may then be of other names;
            without it such messages are left out.
    """

    stamp_ns: NDArray[np.int64]
    path: Path
    warnings: list[str]
    carrier: Carrier | None = None


def assemble_links(topics: Mapping[str, Series], order: Sequence[str], onto: Onto) -> Links:
    """Link motion at the joint samples' stamps.

    Args:
        topics: the file's topics.
        order: link names in their recorded order; links not in it follow in the file's order.
        onto: the joint samples.
    """
    found = [
        topic.removeprefix(prefix)
        for topic, series in topics.items()
        for prefix in (LINK_TWISTS, LINK_ACCELS)
        if topic.startswith(prefix) and series.count
    ]
    names = tuple(dict.fromkeys([n for n in order if n in found] + found))
    frames = dict(zip(names, names, strict=True))
    if onto.carrier is not None:
        frames |= _frames_of_their_own(topics, names, onto.path, onto.warnings)
    twists = _stack(topics, LINK_TWISTS, TWIST_STAMPED, frames, onto)
    accels = _stack(topics, LINK_ACCELS, ACCEL_STAMPED, frames, onto)
    return Links(names if twists is not None or accels is not None else (), twists, accels)


def _stack(
    topics: Mapping[str, Series],
    prefix: str,
    schema: str,
    frames: Mapping[str, str],
    onto: Onto,
) -> Array | None:
    """(m, links, 6) one kind of motion of all links; None where there is none."""
    stack = np.full((len(onto.stamp_ns), len(frames), 6), np.nan)
    used = False
    for i, (name, frame) in enumerate(frames.items()):
        series = topics.get(prefix + name)
        if series is None or not series.count:
            continue
        where = f"{onto.path}: {series.topic}"
        part = _in_frame(series, schema, frame, where, onto.warnings)
        if part is None:
            continue
        used = True
        link_ns = stamps(part, where, onto.warnings)
        values = part.in_order([block.values[0] for block in part.blocks])
        matched = _match(onto.stamp_ns, link_ns, values, stack[:, i])
        sent = len(np.unique(link_ns))
        if onto.carrier is not None and matched < _MOST_MATCHED * sent:
            carried = onto.carrier.carry(part.topic, link_ns, values)
            stack[:, i] = np.nan if carried is None else carried
        elif matched < sent:
            onto.warnings.append(
                f"{where}: {sent - matched} of {len(link_ns)} messages carry "
                "the stamp of no joint sample; left out"
            )
    return stack if used else None


def _frames_of_their_own(
    topics: Mapping[str, Series], names: tuple[str, ...], path: Path, warnings: list[str]
) -> dict[str, str]:
    """Frames that can only be the links' own, though they have other names.

    Motion told in a frame of the world, of the base or of another link shares that frame with
    others, or with their names. So all links must have a frame each that no other has, or none.
    """
    frames = {}
    for name in names:
        counts: Counter[str] = Counter()
        for prefix in (LINK_TWISTS, LINK_ACCELS):
            series = topics.get(prefix + name)
            for block in series.blocks if series is not None else ():
                counts[block.layout.frame_id] += len(block.index)
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
    part = series.only(lambda block: block.layout.frame_id == link)
    if part.count < series.count - len(series.bad):
        frames = sorted({b.layout.frame_id for b in series.blocks} - {link})
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
