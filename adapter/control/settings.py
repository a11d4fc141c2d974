"""How the arm is moved. Light to load: wrong settings are told at once."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

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
        self._check_slow_start()

    def _check_slow_start(self) -> None:
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
