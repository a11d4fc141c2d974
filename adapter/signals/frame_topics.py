"""What topics say of frames in motion, at the joint samples: a floating base, sensors on links.

Of a base angular velocity and what an accelerometer reads have to be there: from one `Imu`, or
from a twist and an acceleration. A velocity (`Odometry`, `TwistStamped`) is welcome and not
needed: no torque depends on it. A frame's place on the base is the model's, and so its readings
are moved to the base's origin. Between two messages a reading goes straight, as it does in the
filter behind; across a silence it is not a number.

Which sensor is glued on which link of an arm is told by a message's frame, which names the link or
a frame fixed to it; else the command line says it. How a sensor sits on its link nobody needs to
know. Readings are carried to the joint samples' stamps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.errors import ModelError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from drivers.errors import choices
from drivers.files.mcap import READERS, Carrier, FrameMotion, Log
from drivers.files.ros_types import IMU
from drivers.interface import DriverError

LONGEST_PERIODS = 3.0  # of a topic; no line is drawn across a longer silence
Place = tuple[Array, Array]  # rotation (3, 3) and position (3,) in the frame of the base


class Vectors(NamedTuple):
    """Stamps (k,) ns, rising, and vectors (k, 3)."""

    stamp_ns: NDArray[np.int64]
    x: Array


def frames_on_base(robot: SelfModel, link: str) -> dict[str, Place]:
    """Frames fixed to the base of a robot, `link` first; where they are on it.

    Raises:
        ModelError: `link` is none of them; names the choices.
    """
    base = robot.tree.base_name
    places: dict[str, Place] = {base: (np.eye(3), np.zeros(3))}
    places |= {f.name: (f.rotation, f.position) for f in robot.frames if f.parent == base}
    if link not in places:
        moves = " moves on it" if link in robot.tree.link_names else " is not there"
        said = "a base that floats is the root link or one fixed to it"
        raise ModelError(f"{robot.name}: {said}; '{link}'{moves}; {choices(link, places)}")
    return {link: places[link], **places}


def with_base_motion(log: Log, robot: SelfModel, link: str) -> Log:
    """The recording with the base's motion at its joint samples (`Log.base`).

    Args:
        log: read with what `frames` tell.
        robot: on a floating base.
        link: the base, or a frame fixed to it, which messages without a frame are taken to mean.

    Raises:
        ModelError: `link` is not on the base.
        DriverError: no angular velocity or no acceleration of a frame on the base.
    """
    places = frames_on_base(robot, link)
    heard = [replace(m, frame=m.frame or link) for m in log.frames]
    heard = [m for m in heard if m.frame in places]
    heard.sort(key=lambda m: list(places).index(m.frame))
    a_of = next((m for m in heard if np.isfinite(m.a).any()), None)
    turning = [m for m in heard if np.isfinite(m.w).any()]
    w_of = next((m for m in turning if m is a_of), next(iter(turning), None))
    if a_of is None or w_of is None:
        no = {"angular velocity": w_of is None, "acceleration": a_of is None}
        what = " and no ".join(name for name, lacks in no.items() if lacks)
        have = [f"{m.topic} ({m.schema} of {m.frame or 'no frame'})" for m in log.frames]
        imu, odometry, twist, accel = READERS
        raise DriverError(
            f"{log.path}: has no {what} of a base that floats; on any topic serve {imu}, or "
            f"{accel} with {twist} or {odometry}, in one of the frames {', '.join(places)}; have: "
            f"{', '.join(have) or 'none of these types'}"
        )
    v_of = next((m for m in heard if np.isfinite(m.v).any()), None)
    w = _turned(w_of, w_of.w, places)
    a = _turned(a_of, a_of.a, places)
    a = _at_origin(a, w, places[a_of.frame][1])
    parts = [np.zeros((len(log), 3)), _at(log.stamp_ns, w), _at(log.stamp_ns, a)]
    if v_of is not None:
        v = _turned(v_of, v_of.v, places)
        moved = v.x - np.cross(_at(v.stamp_ns, w), places[v_of.frame][1])
        parts[0] = np.nan_to_num(_at(log.stamp_ns, Vectors(v.stamp_ns, moved)))
    base = np.concatenate(parts, axis=1)
    used = dict.fromkeys(f"{m.topic} ({m.frame})" for m in (w_of, a_of, v_of) if m is not None)
    silent = int((~np.isfinite(base).all(axis=1)).sum())
    if silent == len(log):
        why = "tell nothing at the joint samples' stamps; do they share a clock?"
        raise DriverError(f"{log.path}: {', '.join(used)} {why}")
    said = [f"{log.path}: motion of the base from {', '.join(used)}"]
    if silent:
        said.append(f"{log.path}: no motion of the base at {silent} of {len(log)} joint samples")
    return replace(log, base=base, warnings=[*log.warnings, *said])


def _turned(motion: FrameMotion, x: Array, places: Mapping[str, Place]) -> Vectors:
    """Vectors of a topic in axes of the base, those that are numbers, in the order of time."""
    stamp_ns, first = np.unique(motion.stamp_ns, return_index=True)
    x = x[first]
    heard = np.isfinite(x).all(axis=1)
    return Vectors(stamp_ns[heard], x[heard] @ places[motion.frame][0].T)


def _at_origin(a: Vectors, w: Vectors, arm: Array) -> Vectors:
    """What an accelerometer at the base's origin reads, from one at `arm` (3,)."""
    if not arm.any() or len(w.stamp_ns) < 2:
        return a
    dw = np.gradient(w.x, 1e-9 * (w.stamp_ns - w.stamp_ns[0]), axis=0)
    turning, spin = _at(a.stamp_ns, w), _at(a.stamp_ns, Vectors(w.stamp_ns, dw))
    moved = a.x - np.cross(spin, arm) - np.cross(turning, np.cross(turning, arm))
    heard = np.isfinite(moved).all(axis=1)
    return Vectors(a.stamp_ns[heard], moved[heard])


def _at(stamp_ns: NDArray[np.int64], of: Vectors) -> Array:
    """(m, 3) vectors at other stamps, along straight lines; not a number across a silence."""
    own, out = of.stamp_ns, np.full((len(stamp_ns), 3), np.nan)
    if len(own) < 2:
        return out
    right = np.clip(np.searchsorted(own, stamp_ns), 1, len(own) - 1)
    step = own[right] - own[right - 1]
    along = (stamp_ns - own[right - 1]) / step
    near = (step <= LONGEST_PERIODS * np.median(np.diff(own))) & (along >= 0.0) & (along <= 1.0)
    near |= (along == 0.0) | (along == 1.0)
    share = along[near, None]
    out[near] = (1.0 - share) * of.x[right[near] - 1] + share * of.x[right[near]]
    return out


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
