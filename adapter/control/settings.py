"""How the arm is moved, and in which cell. Light to load: wrong settings are told at once.

The cell is what it must not touch. In base axes, m and rad.

[cell]
margin = 0.05
[[cell.box]]
name = "shelf"
size = [0.4, 1.0, 0.05]
xyz = [0.6, 0.0, 0.4]
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from adapter.errors import SettingsError

# Of the documented speed, so that 20 ms of a torque that is held, the longest a Franka robot puts
# up with, do not bring a joint to its limit.
REAL_SHARE = 0.75
SLOW_S, SLOW_SHARE = 10.0, 0.1  # an arm that may be real starts so slowly for so long
RANDOM, DESIGNED = KINDS = ("random", "designed")


@dataclass(frozen=True)
class ExcitationSettings:
    """How the arm moves.

    Attributes:
        kind: `random`, or `designed` to teach most (`adapter.control.designed`).
        seed: of the motion.
        sines: in each joint's random motion; a designed one has every multiple of `low_hz`.
        low_hz, high_hz: between these frequencies.
        share: of the velocity, acceleration and jerk limits that is never exceeded.
        range_share: of a joint's range that is used at most.
        move: names of the joints that move, the others stand; all of them where empty.
        margin: kept from the position limits, rad.
        start_s, stop_s: length of the soft start and of the safe stop.
        rests: (from, to) seconds of motion time in which the arm rests; the stop before and the
            start after each lie behind its first and its second instant.
        slow_s: seconds of motion time at `slow_share` of the speed, before a smooth step to all
            of it within `start_s`; 0 for none.
        slow_share: share of the speed meanwhile.
    """

    kind: str = RANDOM
    seed: int = 0
    sines: int = 5
    low_hz: float = 0.1
    high_hz: float = 1.0
    share: float = 0.9
    range_share: float = 0.8
    move: tuple[str, ...] = ()
    margin: float = 0.15
    start_s: float = 1.0
    stop_s: float = 1.0
    rests: tuple[tuple[float, float], ...] = ()
    slow_s: float = 0.0
    slow_share: float = 0.1

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise SettingsError(f"no excitation '{self.kind}'; have: {', '.join(KINDS)}")
        if self.sines < 1:
            raise SettingsError(f"excitation.sines must be at least 1, got {self.sines}")
        if not 0.0 < self.low_hz < self.high_hz:
            raise SettingsError(
                f"excitation: frequencies must be 0 < low_hz < high_hz, got {self.low_hz}, "
                f"{self.high_hz}"
            )
        for name in ("share", "range_share"):
            if not 0.0 < getattr(self, name) <= 0.95:
                raise SettingsError(f"excitation.{name} must be above 0 and at most 0.95")
        for name in ("margin", "start_s", "stop_s"):
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"excitation.{name} must be above zero")
        if any(len(rest) != 2 for rest in self.rests):
            raise SettingsError("excitation.rests needs pairs of (from, to) seconds")
        for begin, end in self.rests:
            if end - begin < self.stop_s:
                raise SettingsError(f"excitation.rests: {begin} to {end} s is shorter than a stop")
        if not 0.0 < self.slow_share <= 1.0:
            raise SettingsError("excitation.slow_share must be above 0 and at most 1")
        if not (self.slow_s == 0.0 or self.start_s <= self.slow_s < math.inf):
            raise SettingsError(
                f"excitation.slow_s must be 0 or at least start_s ({self.start_s} s), "
                f"got {self.slow_s}"
            )
        quicker = self.slow_s, self.slow_s + self.start_s
        for begin, end in self.rests if self.slow_s else ():
            for at, length in ((begin, self.stop_s), (end, self.start_s)):
                if at < quicker[1] and at + length > quicker[0]:
                    raise SettingsError(
                        f"excitation.rests: {begin} to {end} s begins or ends while the motion "
                        f"becomes quicker, {quicker[0]} to {quicker[1]} s"
                    )


def gentle(settings: ExcitationSettings) -> ExcitationSettings:
    """The same for an arm that may be real: no settings are quicker or start less slowly.

    Raises SettingsError where rests fall into the end of the slow start.
    """
    return replace(
        settings,
        share=min(settings.share, REAL_SHARE),
        slow_s=max(settings.slow_s, SLOW_S, settings.start_s),
        slow_share=min(settings.slow_share, SLOW_SHARE),
    )


@dataclass(frozen=True)
class SafetySettings:
    """When the arm is stopped because it does not move as it should; shares are of each joint's
    effort limit (torques), and of effort times speed limit (power).

    Attributes:
        tracking_share: torque that the feedback's spring alone may hold.
        tracking_rad: distance from the reference that stops a joint however soft its spring is.
        external_share: torque beyond what the model expects and what it was off by before.
        learned_share: the same where the contact observer watches with what was learned; 8 of its
            standard deviations, where these are more.
        power_share: of torque times velocity, along the motion and against it.
        hold_s: for which one of these must be exceeded.
        saturated_s: for which a command may be cut at the effort limit, or at its present share.
        start_share: of the effort limit, beyond the expected torque, that a command has at the
            start of a motion.
        rise_s: of motion as expected until it has all of `ControlSettings.effort_share`.
        watch_contacts: whether the contact observer runs beside the loop, some 10 µs a tick.
        stop_at_contact: whether what the contact observer sees ends the motion, too, once θ has
            converged. A load that is picked up in motion is a contact.
    """

    tracking_share: float = 0.8
    tracking_rad: float = 0.5
    external_share: float = 0.7
    learned_share: float = 0.5
    power_share: float = 0.7
    hold_s: float = 0.01
    saturated_s: float = 0.1
    start_share: float = 0.5
    rise_s: float = 5.0
    watch_contacts: bool = True
    stop_at_contact: bool = False

    def __post_init__(self) -> None:
        shares = "tracking_share", "external_share", "learned_share", "power_share", "start_share"
        for name in shares:
            if not 0.0 < getattr(self, name) <= 1.0:
                raise SettingsError(f"safety.{name} must be above 0 and at most 1")
        if not 0.0 < self.tracking_rad <= math.pi:
            raise SettingsError("safety.tracking_rad must be above 0 and at most pi")
        for name, most in (("hold_s", 0.05), ("saturated_s", 1.0), ("rise_s", 600.0)):
            if not 0.0 <= getattr(self, name) <= most:
                raise SettingsError(f"safety.{name} must be from 0 to {most:g}")


LEAST_MARGIN_M = 0.01


def _need(condition: bool, name: str, what: str) -> None:
    if not condition:
        raise SettingsError(f"cell, '{name}': {what}")


def _finite(values: tuple[float, ...], count: int) -> bool:
    return len(values) == count and all(map(math.isfinite, values))


@dataclass(frozen=True)
class Box:
    """A box: side lengths along its own axes, place of its centre, turn about x, y, z."""

    name: str
    size: tuple[float, ...]
    xyz: tuple[float, ...]
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        sides = _finite(self.size, 3) and min(self.size) > 0.0
        _need(sides, self.name, "size needs 3 lengths above zero")
        _need(_finite((*self.xyz, *self.rpy), 6), self.name, "xyz and rpy need 3 numbers each")


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along its own z, placed by its centre."""

    name: str
    radius: float
    length: float
    xyz: tuple[float, ...]
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        sizes = 0.0 < self.radius < math.inf and 0.0 < self.length < math.inf
        _need(sizes, self.name, "radius and length must be above zero")
        _need(_finite((*self.xyz, *self.rpy), 6), self.name, "xyz and rpy need 3 numbers each")


@dataclass(frozen=True)
class Plane:
    """A wall or floor: all is free where normal . x > offset, for a normal of length 1."""

    name: str
    normal: tuple[float, ...]
    offset: float

    def __post_init__(self) -> None:
        _need(_finite((*self.normal, self.offset), 4), self.name, "normal needs 3 numbers")
        _need(math.hypot(*self.normal) > 0.0, self.name, "normal must not be zero")


@dataclass(frozen=True)
class Mesh:
    """The triangles of an STL or OBJ file, a surface: what is closed is not filled.

    `scale` is metres per unit of the file; xyz and rpy place the file's origin.
    """

    name: str
    file: str
    xyz: tuple[float, ...] = (0.0, 0.0, 0.0)
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        _need(0.0 < self.scale < math.inf, self.name, "scale must be above zero")
        _need(_finite((*self.xyz, *self.rpy), 6), self.name, "xyz and rpy need 3 numbers each")


@dataclass(frozen=True)
class Hand:
    """What is on the hand, from the last link's frame along its z."""

    length: float
    radius: float

    def __post_init__(self) -> None:
        sizes = 0.0 < self.radius < math.inf and 0.0 < self.length < math.inf
        _need(sizes, "hand", "length and radius must be above zero")


@dataclass(frozen=True)
class Cell:
    """Everything around an arm.

    Attributes:
        margin: kept from everything and between links.
        table: whether the arm stands on a plane: z = 0 of its base (on a wall, that wall).
        reach: furthest from the base's origin that any part may get; no limit where None.
        box, cylinder, plane, mesh: what stands there.
        hand: what the robot's file does not say of its hand.
        allowed: pairs of links, or of a link and a thing, that may touch.
    """

    margin: float = 0.05
    table: bool = True
    reach: float | None = None
    box: tuple[Box, ...] = ()
    cylinder: tuple[Cylinder, ...] = ()
    plane: tuple[Plane, ...] = ()
    mesh: tuple[Mesh, ...] = ()
    hand: Hand | None = None
    allowed: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        if not LEAST_MARGIN_M <= self.margin < math.inf:
            raise SettingsError(f"cell.margin must be at least {LEAST_MARGIN_M} m")
        if self.reach is not None and not self.reach > 0.0:
            raise SettingsError("cell.reach must be above zero")
        if any(len(pair) != 2 for pair in self.allowed):
            raise SettingsError("cell.allowed needs pairs of names")
        names = [each.name for each in self.box] + [each.name for each in self.cylinder]
        names += [each.name for each in self.plane] + [each.name for each in self.mesh]
        if len({*names, "table"}) <= len(names):
            raise SettingsError("cell: every box, cylinder, plane and mesh needs a name of its own")

    def beside(self, folder: Path) -> Cell:
        """The same cell, with files of meshes that are named from this folder."""
        return replace(
            self, mesh=tuple(replace(each, file=str(folder / each.file)) for each in self.mesh)
        )
