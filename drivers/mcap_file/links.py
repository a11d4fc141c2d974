"""Measured link motion, matched to the joint samples by header stamp, or carried to them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.interface import Array
from drivers.mcap_file.carried import Carrier
from drivers.mcap_file.joints import stamps
from drivers.mcap_file.series import Series
from drivers.mcap_file.writer import LINK_ACCELS, LINK_TWISTS
from drivers.ros_schemas import ACCEL_STAMPED, TWIST_STAMPED

_MOST_MATCHED = 0.9  # share of a topic's stamps that joint samples have; below, stamps are its own


@dataclass(frozen=True, slots=True)
class Links:
    """(m, n, 6) twists and accelerations; not a number where a stamp has no message."""

    names: tuple[str, ...]
    twists: Array | None
    accels: Array | None


def assemble_links(
    topics: Mapping[str, Series],
    stamp_ns: NDArray[np.int64],
    order: Sequence[str],
    path: Path,
    warnings: list[str],
    carrier: Carrier | None = None,
) -> Links:
    """Link motion at the joint samples' stamps.

    Args:
        topics: the file's topics.
        stamp_ns: (m,) stamps of the joint samples.
        order: link names in their recorded order; links not in it follow in the file's order.
        path, warnings: for sentences on what was left out.
        carrier: for topics with stamps of their own, whose frames may then be of other names;
            without it such messages are left out.
    """
    found = [
        topic.removeprefix(prefix)
        for topic, series in topics.items()
        for prefix in (LINK_TWISTS, LINK_ACCELS)
        if topic.startswith(prefix) and series.count
    ]
    names = tuple(dict.fromkeys([n for n in order if n in found] + found))
    frames = dict(zip(names, names, strict=True))
    if carrier is not None:
        frames |= _frames_of_their_own(topics, names, path, warnings)
    rest = (stamp_ns, path, warnings, carrier)
    twists = _stack(topics, LINK_TWISTS, TWIST_STAMPED, frames, *rest)
    accels = _stack(topics, LINK_ACCELS, ACCEL_STAMPED, frames, *rest)
    return Links(names if twists is not None or accels is not None else (), twists, accels)


def _stack(
    topics: Mapping[str, Series],
    prefix: str,
    schema: str,
    frames: Mapping[str, str],
    stamp_ns: NDArray[np.int64],
    path: Path,
    warnings: list[str],
    carrier: Carrier | None,
) -> Array | None:
    stack = np.full((len(stamp_ns), len(frames), 6), np.nan)
    used = False
    for i, (name, frame) in enumerate(frames.items()):
        series = topics.get(prefix + name)
        if series is None or not series.count:
            continue
        part = _in_frame(series, schema, frame, f"{path}: {series.topic}", warnings)
        if part is None:
            continue
        used = True
        where = f"{path}: {part.topic}"
        link_ns = stamps(part, where, warnings)
        values = part.in_order([block.values[0] for block in part.blocks])
        matched, sent = _match(stamp_ns, link_ns, values, stack[:, i]), len(np.unique(link_ns))
        if carrier is not None and matched < _MOST_MATCHED * sent:
            carried = carrier.carry(part.topic, link_ns, values)
            stack[:, i] = np.nan if carried is None else carried
        elif matched < sent:
            warnings.append(
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
