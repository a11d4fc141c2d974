"""How a moving arm is braked by its own motors and then held. Pure, no clock, no bus.

There is no brake in these motors: a motor that is switched off lets go. So the arm is first
damped (speed zero wanted, its weight carried by the torque measured last), and once it is slow
held where it is, with stiffness coming in over `FADE_S`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from drivers.damiao.codec import KD_MAX, KP_MAX, Limits, mit_command

# Own choice. N m/rad per N m of TMAX: full torque at 0.25 rad; DM8009 216, DM4340 112, DM4310 40.
STIFFNESS_PER_TORQUE = 4.0
DAMPING_TIME_S = 0.05  # kd over kp, up to the protocol's 5 N m s/rad
SLOW = 0.1  # rad/s: below this on every joint the arm counts as standing
DAMP_AT_MOST_S = 0.5  # a joint that still drifts then is held nevertheless
FADE_S = 0.2
SINK_S = 3.0  # over which a held arm is let down


def gains(limits: Limits) -> tuple[float, float]:
    """(kp, kd) that hold a joint, N m/rad and N m s/rad."""
    kp = min(STIFFNESS_PER_TORQUE * limits.tau_max, KP_MAX)
    return kp, min(DAMPING_TIME_S * kp, KD_MAX)


class Braker:
    """Commands that bring an arm from any motion to a stand and hold it there.

    Args:
        limits: of each motor.
        tau: (n) torques that carry the arm, N m: measured last.
        hold: (n) angles to hold from the start, rad; None brakes first.

    Attributes:
        hold: angles held, rad; None while braking.
        holding_s: for how long.
    """

    def __init__(
        self, limits: Sequence[Limits], tau: Sequence[float], hold: Sequence[float] | None = None
    ) -> None:
        self._limits = limits
        self._gains = [gains(limit) for limit in limits]
        self._tau = [value if math.isfinite(value) else 0.0 for value in tau]
        self.hold = None if hold is None else list(hold)
        self.holding_s = math.inf if hold is not None else 0.0
        self._braking_s = 0.0

    def commands(self, dt_s: float, q: Sequence[float], dq: Sequence[float]) -> list[bytes]:
        """The next MIT commands.

        Args:
            dt_s: since the last call.
            q, dq: (n) measured last, rad, rad/s; NaN for a joint that does not answer.
        """
        if self.hold is not None:
            self.holding_s += dt_s
        else:
            self._braking_s += dt_s
            slow = all(abs(speed) < SLOW for speed in dq if speed == speed)
            if (slow and self._braking_s > 2 * dt_s) or self._braking_s >= DAMP_AT_MOST_S:
                self.hold, self.holding_s = list(q), 0.0
        share = min(self.holding_s / FADE_S, 1.0) if self.hold is not None else 0.0
        return [self._command(j, share, q[j]) for j in range(len(self._limits))]

    def _command(self, j: int, share: float, q_now: float) -> bytes:
        kp, kd = self._gains[j]
        q = 0.0
        if self.hold is not None:
            if self.hold[j] != self.hold[j]:
                self.hold[j] = q_now  # it answers again
            q = self.hold[j]
        if q != q:  # nothing is known of it: damp only
            q, share = 0.0, 0.0
        return mit_command(self._limits[j], q=q, kp=share * kp, kd=kd, tau=self._tau[j])

    def carry(self, tau: Sequence[float]) -> None:
        """Carry the arm with these torques from now on, (n) N m; NaN leaves a joint's as it is."""
        self._tau = [new if new == new else old for new, old in zip(tau, self._tau, strict=True)]

    def sinking(self, share: float) -> list[bytes]:
        """Commands that let the arm down: its weight is carried to `share`, speed damped."""
        return [
            mit_command(limit, kd=gain[1], tau=share * tau)
            for limit, gain, tau in zip(self._limits, self._gains, self._tau, strict=True)
        ]
