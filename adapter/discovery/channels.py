"""Which motion of which links a recording holds.

Turning must be known of every link, as angular velocity or acceleration; the other of the two
follows from it. Where neither was measured of all links, turning is compared by the acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import SettingsError
from adapter.spatial import Array
from drivers.mcap_file import Log

CHANNELS = ("w", "dw", "v", "a")  # of link motion; the angular ones first
STILL = 1e-9  # a channel that never exceeds this was not measured but filled in


@dataclass(frozen=True)
class Channels:
    """Link motion as recorded.

    Attributes:
        values: by channel (k, links, 3), not a number where nothing was heard.
        lacking: by channel (links,) bool, links of which it was never heard; their values are 0.
        measured: channels that can be held against others of all links.
        notes: sentences.
    """

    values: dict[str, Array]
    lacking: dict[str, np.ndarray]
    measured: tuple[str, ...]
    notes: tuple[str, ...]


def check(log: Log, shortest_s: float) -> None:
    """Refuse what holds no link motion, of one link alone, or is too short."""
    links = ", ".join(log.link_names) or "none"
    if not log.link_names or (log.twists is None and log.accels is None):
        raise SettingsError(
            f"{log.path}: has no motion of links (sensor_msgs/msg/Imu on any topic, or "
            f"/link_twists/<link> or /link_accels/<link>), of links: {links}; it needs that of "
            f"every link, measured in the link's own frame; has: {_topics(log)}"
        )
    if len(log.link_names) < 2 and len(log.joint_names) > 1:
        raise SettingsError(
            f"{log.path}: has the motion of one link only ({links}) beside "
            f"{len(log.joint_names)} joints; nothing can be compared"
        )
    span_s = 1e-9 * float(np.ptp(log.stamp_ns)) if len(log) else 0.0
    if span_s < shortest_s:
        raise SettingsError(
            f"{log.path}: lasts {span_s:.2f} s; discovery needs at least {shortest_s} s of motion"
        )


def _topics(log: Log) -> str:
    told = [f"{name} ({t.messages} {t.schema or t.encoding})" for name, t in log.topics.items()]
    return ", ".join(told) or "no topic"


def channels_of(log: Log, rows: np.ndarray) -> Channels:
    """The channels that hold anything.

    Args:
        log: the recording; `rows` of it are used.

    Raises:
        SettingsError: of some link neither angular velocity nor angular acceleration is there.
    """
    heard: dict[str, Array] = {}
    for table, names in ((log.twists, ("v", "w")), (log.accels, ("a", "dw"))):
        if table is None:
            continue
        for k, name in enumerate(names):
            part = table[rows][:, :, 3 * k : 3 * k + 3]
            size = np.nanmax(np.abs(part), initial=0.0, where=np.isfinite(part), axis=(0, 2))
            if (size > STILL).any():
                heard[name] = part
    lacking: dict[str, np.ndarray] = {
        name: np.asarray(~np.isfinite(x).all(axis=2).any(axis=0)) for name, x in heard.items()
    }
    every = np.ones(len(log.link_names), dtype=bool)
    mute = lacking.get("w", every) & lacking.get("dw", every)
    if mute.any():
        whole = ", ".join(k for k in CHANNELS if k in lacking and not lacking[k].any())
        raise SettingsError(
            f"{log.path}: has neither angular velocity nor angular acceleration of every link; of "
            f"all links it has: {whole or 'nothing'}; links with neither: "
            f"{listed(log.link_names, mute)}"
        )
    for name in ("v", "a"):
        if name in heard and lacking[name].any():
            del heard[name]
    values = {k: np.where(lacking[k][None, :, None], 0.0, heard[k]) for k in CHANNELS if k in heard}
    measured = tuple(k for k in values if not lacking[k].any())
    notes = []
    if not {"w", "dw"} & set(measured):
        measured = ("dw", *measured)
        notes.append(
            f"of links {listed(log.link_names, lacking['w'])} no angular velocity is recorded, of "
            f"{listed(log.link_names, lacking['dw'])} no angular acceleration: links are compared "
            "by the latter, differentiated where need be"
        )
    if not {"v", "a"} & set(measured):
        notes.append(
            "neither linear velocity nor acceleration is recorded of every link: the tree follows "
            "from turning alone, and places of joints cannot be learned"
        )
    return Channels(values, {k: lacking[k] for k in values}, measured, tuple(notes))


def listed(names: tuple[str, ...], which: np.ndarray) -> str:
    """Names of some links; where most are meant, of those that are not."""
    rest = [name for name, there in zip(names, which, strict=True) if not there]
    if len(rest) <= 2 < len(names) - len(rest):
        return f"(all {len(names)}{''.join(f', not {name}' for name in rest)})"
    return ", ".join(name for name, there in zip(names, which, strict=True) if there)
