"""When a driven arm does not move as it should: limits that end the motion, and a soft effort.

Four things are watched in each tick, each by joint: how far the reading is from the reference,
how long the command has been cut, how much torque the model does not expect (the surroundings
push, or the arm pushes them), and the power that the next command would have at the present
speed. What stays beyond its limit for `hold_s` raises ControlError; the driver then brakes the
arm, damped and without a spring.

What the arm is off by all the time (an unknown load, friction, gravity told wrongly) is no
contact: it is followed over `OFFSET_S`, and stands still while more than half of the limit is
left over.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from adapter.control.limits import MotionLimits
from adapter.control.observer import SIGMAS
from adapter.control.settings import SafetySettings
from adapter.errors import ControlError
from adapter.model.spatial import Array
from adapter.physics.kernels import jit

OFFSET_S = 1.0  # over which a constant difference from the model is learned
CALM = 0.5  # of a limit: below it the arm moves as expected
ENDLESS = 1e9  # N m, of a joint whose limit nobody documented
MOVING = 0.02  # rad/s, of one joint at least; of a slower one friction has no direction


class Cause(IntEnum):
    """What ended a motion; also the rows of the limits."""

    TRACKING = 0
    SATURATED = 1
    EXTERNAL = 2
    POWER = 3


class Now(IntEnum):
    """Rows of what is known of a tick, (n,) each: N m, rad, rad/s."""

    WANTED = 0  # torque that the feedback and its model ask for
    COMMAND = 1  # before a step: the last command; after it: the one to send
    ERROR = 2  # reference less reading
    SPEED = 3  # measured
    MEASURED = 4  # torque, gravity included; NaN where nothing was measured
    EXPECTED = 5  # by the model, gravity included; NaN without a model
    CARRIED = 6  # gravity that the arm carries itself
    EXTERNAL = 7  # filled: torque that nothing explains
    OFFSET = 8  # filled: what the model is off by
    STD = 9  # of a learned model's torque; 0 where none was learned


MOST, LEAST = len(Cause), len(Cause) + 1  # further rows of the limits: what `EXTERNAL` is between


_WHAT = {
    Cause.TRACKING: (
        "is {value:.3f} rad from where it should be (limit {limit:.3f} rad)",
        "something holds the arm or is in its way, or its load is unknown",
    ),
    Cause.SATURATED: (
        "was cut at {value:.1f} N m for more than {limit:.2f} s",
        "something holds the arm, or the motion asks for more than the joint can give",
    ),
    Cause.EXTERNAL: (
        "is pushed with {value:.1f} N m that the model does not expect (limit {limit:.1f} N m)",
        "something touches the arm, or its load changed",
    ),
    Cause.POWER: (
        "would move with {value:.1f} W (limit {limit:.1f} W)",
        "its load changed, or its model is wrong",
    ),
}


@jit
def find_push(now, limit, follow):
    """Fill `EXTERNAL` and follow `OFFSET` by this share; False where there is no model."""
    calm = True
    for j in range(now.shape[1]):
        expected = now[Now.EXPECTED.value, j]
        if not math.isfinite(expected):
            return False
        difference, push = now[Now.MEASURED.value, j] - expected, 0.0
        if math.isfinite(difference):
            if not math.isfinite(now[Now.OFFSET.value, j]):
                now[Now.OFFSET.value, j] = difference
            push = difference - now[Now.OFFSET.value, j]
        now[Now.EXTERNAL.value, j] = push
        calm = calm and abs(push) < CALM * limit[j]
    if calm:
        for j in range(now.shape[1]):
            now[Now.OFFSET.value, j] += follow * now[Now.EXTERNAL.value, j]
    return True


@jit
def command(now, room, most, step, modelled):
    """Bring `WANTED` into the limits as `COMMAND`; whether any was cut, and any was too quick.

    Args:
        now: (10, n); room, most, step: (n,) N m beyond the expected torque, at all, and from the
            last command; modelled: the expected torque is known.
    """
    cut = quick = False
    for j in range(now.shape[1]):
        wanted, low, high = now[Now.WANTED.value, j], -most[j], most[j]
        if modelled:
            middle = now[Now.EXPECTED.value, j] - now[Now.CARRIED.value, j]
            if math.isfinite(now[Now.OFFSET.value, j]):
                middle += now[Now.OFFSET.value, j]
            low = max(low, min(middle - room[j], high))
            high = min(high, max(middle + room[j], low))
        allowed = min(max(wanted, low), high)
        cut = cut or allowed != wanted
        way = allowed - now[Now.COMMAND.value, j]
        quick = quick or abs(way) > step[j]
        now[Now.COMMAND.value, j] += min(max(way, -step[j]), step[j])
        now[Now.WANTED.value, j] = math.nan if allowed != wanted else wanted
    return cut, quick


@jit
def judge(now, limits, times, hold_s, dt_s):
    """(cause, joint, calm) of one tick, cause -1 for none; `times` (4, n) s beyond each limit.

    `limits` (6, n) are rad, s, N m, W, N m, N m.
    """
    calm, moving = True, False
    cause, joint = -1, 0
    for j in range(now.shape[1]):
        speed = now[Now.SPEED.value, j]
        moving = moving or abs(speed) > MOVING
        cut = math.isnan(now[Now.WANTED.value, j])
        power = abs(now[Now.COMMAND.value, j] * speed)
        sizes = (abs(now[Now.ERROR.value, j]), 0.0, abs(now[Now.EXTERNAL.value, j]), power)
        for k in range(4):
            timed = k == Cause.SATURATED.value
            beyond = cut if timed else sizes[k] > limits[k, j]
            times[k, j] = times[k, j] + dt_s if beyond else 0.0
            if cause < 0 and times[k, j] > (limits[k, j] if timed else hold_s):
                cause, joint = k, j
            if beyond or sizes[k] > CALM * limits[k, j]:
                calm = False
    return cause, joint, calm and moving


@jit
def look(now, limits, times, bounds, numbers):
    """One tick of all three; (cause, joint, calm, cut, quick).

    `bounds` (3, n): room, most, step; `numbers`: hold_s, dt_s, share that the offset follows by.
    """
    for j in range(now.shape[1]):  # less push is too much where a learned model knows well
        std, most = now[Now.STD.value, j], limits[MOST, j]
        least = max(limits[LEAST, j], SIGMAS * std)
        limits[Cause.EXTERNAL.value, j] = min(most, least) if std > 0.0 else most
    modelled = find_push(now, limits[Cause.EXTERNAL.value], numbers[2])
    cut, quick = command(now, bounds[0], bounds[1], bounds[2], modelled)
    cause, joint, calm = judge(now, limits, times, numbers[0], numbers[1])
    return cause, joint, calm, cut, quick


class ArmWatch:
    """Watches one motion and limits its commands.

    Args:
        limits: of the arm.
        settings: how far things may go.
        stiffness: (n,) of the feedback, N m/rad.
        most: (n,) N m, torque that a command may have in the end.

    Attributes:
        now: (10, n), see `Now`; whoever calls `step` fills the first seven rows, and the last.
        saturated, rate_limited: commands that were cut at a torque, at the torque rate.
    """

    def __init__(
        self, limits: MotionLimits, settings: SafetySettings, stiffness: Array, most: Array
    ) -> None:
        n = len(limits.effort)
        self._settings, self._names = settings, limits.joint_names
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = settings.tracking_share * limits.effort / stiffness
        reach = np.where(np.isnan(reach), np.inf, reach)
        self._limits = np.array(
            [
                np.minimum(reach, settings.tracking_rad),
                np.full(n, settings.saturated_s),
                settings.external_share * limits.effort,
                settings.power_share * limits.effort * limits.velocity,
                settings.external_share * limits.effort,
                settings.learned_share * limits.effort,
            ]
        )
        self._start = settings.start_share * np.minimum(limits.effort, ENDLESS)
        most = np.minimum(most, ENDLESS)
        self._times, self._agreed_s = np.zeros((4, n)), 0.0
        self._bounds = np.array([np.minimum(self._start, most), most, np.zeros(n)])
        self.now = np.zeros((len(Now), n))
        self.now[Now.EXPECTED] = self.now[Now.OFFSET] = np.nan
        self.saturated = self.rate_limited = 0
        look(  # compiled now, not in the first tick
            self.now.copy(), self._limits, self._times.copy(), self._bounds.copy(), (0.0, 0.0, 0.0)
        )

    def step(self, most: Array, dt_s: float) -> Array:
        """The command (n,) N m of a tick.

        Args:
            most: (n,) N m from the last command.
            dt_s: since the last tick.

        Raises:
            ControlError: a limit; names joint, cause, numbers and what may be the matter.
        """
        self._bounds[2] = most
        numbers = self._settings.hold_s, dt_s, min(dt_s / OFFSET_S, 1.0)
        cause, j, calm, cut, quick = look(
            self.now, self._limits, self._times, self._bounds, numbers
        )
        self.saturated += cut
        self.rate_limited += quick
        if cause >= 0:
            raise ControlError(self._said(Cause(cause), j))
        if calm and self._agreed_s <= self._settings.rise_s:
            self._agreed_s += dt_s  # more effort after so long as expected; in the end, all of it
            share = min(self._agreed_s / max(self._settings.rise_s, dt_s), 1.0)
            self._bounds[0] = (1.0 - share) * self._start + 2.0 * share * self._bounds[1]
        out: Array = self.now[Now.COMMAND].copy()
        return out

    def _said(self, cause: Cause, j: int) -> str:
        now = self.now[:, j]
        values = {
            Cause.TRACKING: now[Now.ERROR],
            Cause.SATURATED: now[Now.COMMAND],
            Cause.EXTERNAL: now[Now.EXTERNAL],
            Cause.POWER: now[Now.COMMAND] * now[Now.SPEED],
        }
        what, why = _WHAT[cause]
        said = what.format(value=values[cause], limit=self._limits[cause, j])
        name = f" ({self._names[j]})" if self._names else ""
        return f"joint {j + 1}{name} {said}: {why}; the arm is stopped"
