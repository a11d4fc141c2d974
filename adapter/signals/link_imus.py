"""Sensors glued on an arm's links: which topic of a recording is on which link.

A message's frame names the link, or a frame fixed to it; else the command line says it. How a
sensor sits on its link nobody needs to know. Readings are carried to the joint samples' stamps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adapter.model.self_model import SelfModel
from drivers.errors import choices
from drivers.files.mcap import Carrier, FrameMotion, Log
from drivers.files.ros_types import IMU
from drivers.interface import DriverError

NO_IMUS = "none"  # what `--imu` takes where none shall be used


def with_link_imus(
    log: Log, robot: SelfModel, asked: Sequence[str] = ()
) -> tuple[Log, tuple[str, ...]]:
    """The recording with what sensors on the links read, w and a alone, and the links with one.

    Args:
        log: read with what `imus` tell, its joints those of the robot.
        robot: on a fixed base.
        asked: TOPIC=LINK, or TOPIC whose frame names the link; where empty all topics whose
            frames do, unless the motion of the links was measured whole; `NO_IMUS` for none.

    Raises:
        DriverError: no such topic or link, or nothing was heard; names the choices.
    """
    told = [motion for motion in log.frames if motion.schema == IMU]
    whole = log.twists is not None and log.accels is not None
    if NO_IMUS in asked or (not asked and (whole or not told)):
        return log, ()
    warnings = list(log.warnings)
    chosen = _asked(log, told, robot, asked) if asked else _named(log, told, robot, warnings)
    names, carrier = robot.tree.link_names, Carrier(log.stamp_ns, log.path, warnings)
    twists = np.full((len(log), len(names), 6), np.nan)
    accels, used = twists.copy(), {}
    for motion, link in chosen:
        if link in used:
            text = f"{log.path}: {motion.topic}: a second sensor on {link}; left out"
            warnings.append(text)
            continue
        values = np.concatenate([motion.w, motion.a], axis=1)
        carried = carrier.carry(motion.topic, motion.stamp_ns, values)
        if carried is not None:
            i = names.index(link)
            twists[:, i, 3:], accels[:, i, :3] = carried[:, :3], carried[:, 3:]
            used[link] = motion.topic
    carrier.tell()
    if not used and asked:
        raise DriverError("; ".join(warnings))
    if not used:
        return replace(log, warnings=warnings), ()
    listed = ", ".join(f"{topic} on {link}" for link, topic in used.items())
    warnings.append(f"{log.path}: λ from sensors mounted anyhow: {listed}")
    found = tuple(name for name in names if name in used)
    log = replace(log, link_names=names, twists=twists, accels=accels, warnings=warnings)
    return log, found


def _link_of(frame: str, robot: SelfModel) -> str | None:
    """The moving link that a frame is, or is fixed to."""
    riding = {f.name: f.parent for f in robot.frames}
    link = riding.get(frame, frame)
    return link if link in robot.tree.link_names else None


def _named(
    log: Log, told: Sequence[FrameMotion], robot: SelfModel, warnings: list[str]
) -> list[tuple[FrameMotion, str]]:
    """Topics whose frames name moving links; of the others a warning."""
    pairs = [(motion, _link_of(motion.frame, robot)) for motion in told]
    others = [f"{m.topic} ({m.frame or 'no frame'})" for m, link in pairs if link is None]
    if others:
        warnings.append(
            f"{log.path}: Imu topics whose frame names no moving link of {robot.name}, left out: "
            f"{', '.join(others)}; --imu TOPIC=LINK says which it is on: {_links(robot)}"
        )
    return [(motion, link) for motion, link in pairs if link is not None]


def _asked(
    log: Log, told: Sequence[FrameMotion], robot: SelfModel, asked: Sequence[str]
) -> list[tuple[FrameMotion, str]]:
    """What the command line asks for. Raises DriverError."""
    found = []
    for text in asked:
        topic, _, name = text.partition("=")
        motion = next((m for m in told if m.topic == topic), None)
        if motion is None:
            have = choices(topic, [m.topic for m in told] or ["none"])
            raise DriverError(f"{log.path}: no Imu topic {topic} that can be used; {have}")
        link = _link_of(name or motion.frame, robot)
        if link is None:
            raise DriverError(
                f"{log.path}: {topic}: '{name or motion.frame}' is no moving link of {robot.name}; "
                f"--imu {topic}=LINK takes: {_links(robot)}"
            )
        found.append((motion, link))
    return found


def _links(robot: SelfModel) -> str:
    return ", ".join(robot.tree.link_names)
