"""Measured link motion, matched to the joint samples by header stamp."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.interface import Array
from drivers.mcap_file.joints import stamps
from drivers.mcap_file.series import Series
from drivers.mcap_file.writer import LINK_ACCELS, LINK_TWISTS
from drivers.ros_schemas import ACCEL_STAMPED, TWIST_STAMPED


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
) -> Links:
    """Link motion at the joint samples' stamps.

    Args:
        topics: the file's topics.
        stamp_ns: (m,) stamps of the joint samples.
        order: link names in their recorded order; links not in it follow in the file's order.
        path, warnings: for sentences on what was left out.
    """
    found = [
        topic.removeprefix(prefix)
        for topic, series in topics.items()
        for prefix in (LINK_TWISTS, LINK_ACCELS)
        if topic.startswith(prefix) and series.count
    ]
    names = tuple(dict.fromkeys([n for n in order if n in found] + found))
    twists = _stack(topics, LINK_TWISTS, TWIST_STAMPED, names, stamp_ns, path, warnings)
    accels = _stack(topics, LINK_ACCELS, ACCEL_STAMPED, names, stamp_ns, path, warnings)
    return Links(names if twists is not None or accels is not None else (), twists, accels)


def _stack(
    topics: Mapping[str, Series],
    prefix: str,
    schema: str,
    names: tuple[str, ...],
    stamp_ns: NDArray[np.int64],
    path: Path,
    warnings: list[str],
) -> Array | None:
    stack = np.full((len(stamp_ns), len(names), 6), np.nan)
    used = False
    for i, name in enumerate(names):
        series = topics.get(prefix + name)
        if series is None or not series.count:
            continue
        part = _in_own_frame(series, schema, name, f"{path}: {series.topic}", warnings)
        if part is None:
            continue
        used = True
        where = f"{path}: {part.topic}"
        link_ns = stamps(part, where, warnings)
        values = part.in_order([block.values[0] for block in part.blocks])
        matched = _match(stamp_ns, link_ns, values, stack[:, i])
        if matched < len(np.unique(link_ns)):
            warnings.append(
                f"{where}: {len(np.unique(link_ns)) - matched} of {len(link_ns)} messages carry "
                "the stamp of no joint sample; left out"
            )
    return stack if used else None


def _in_own_frame(
    series: Series, schema: str, link: str, where: str, warnings: list[str]
) -> Series | None:
    """Messages whose frame is the link itself; anything else would be taken for what it isn't."""
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
