"""How a moving arm is braked and then held by torques alone.

A controller of ros2_control that takes efforts goes on with the last one it was given, for ever,
and knows no brake. So whoever commands it has to bring the arm to a stand: its weight is carried
by the torque measured last, speed is damped, and once it is slow its place is held by a soft
spring. What the spring then holds up becomes part of the torque that carries.

Gains go by each joint's largest torque and by how often the arm is heard: a joint that its drive
can accelerate by some 2500 rad/s² and more has no more than a 2500th of it as inertia, and damping
that takes away a fifth of the speed in one period is stable with a period or two of delay.
"""

from __future__ import annotations

import numpy as np

from drivers.interface import Array

MOST_ACCELERATION = 2500.0  # rad/s² that the largest torque gives to the lightest joint
DAMPED_SHARE = 0.2  # of the speed, in one period
SPRING_RATE = 5.0  # 1/s: stiffness over damping
SPRING_SHARE = 0.15  # of the largest torque: an arm that is kept away is not pushed for good
SLOW, SLOW_S = 0.05, 0.1  # rad/s, s: then it stands
DAMP_AT_MOST_S = 1.0  # an arm that still drifts then is held nevertheless
CARRY_S = 0.02  # torques measured are averaged over so long


class Braker:
    """Torques that bring an arm from any motion to a stand and hold it there.

    Args:
        effort: (n,) largest torques, N m.
        period_s: between two states.
        gravity: the arm carries its own weight.

    Attributes:
        effort: (n,) as given.
    """

    def __init__(self, effort: Array, period_s: float, gravity: bool) -> None:
        self.effort, self._period_s, self._gravity = effort, period_s, gravity
        self._kd = DAMPED_SHARE * effort / MOST_ACCELERATION / max(period_s, 1e-3)
        self._kp = SPRING_RATE * self._kd
        self._mean: Array | None = None
        self._begin()

    def _begin(self) -> None:
        self._hold: Array | None = None
        self._carry: Array | None = None
        self._braked_s = self._slow_s = 0.0

    @property
    def standing(self) -> bool:
        """Whether it holds its place."""
        return self._hold is not None

    def release(self) -> None:
        """Somebody else drives the arm from here on."""
        self._begin()

    def listen(self, tau: Array) -> None:
        """Torques (n,) measured while somebody else drives."""
        share = min(self._period_s / CARRY_S, 1.0)
        before = tau if self._mean is None else self._mean
        self._mean = before + share * (tau - before)

    def blind(self) -> Array:
        """Torques (n,) for an arm that is not heard any more: what carried it."""
        carried = self._mean if self._carry is None else self._carry
        if self._gravity or carried is None:
            return np.zeros(len(self.effort))
        return np.clip(carried, -self.effort, self.effort)

    def torques(self, q: Array, dq: Array, tau: Array) -> Array:
        """The next torques (n,) N m; one call for each state (n,) rad, rad/s, N m."""
        if self._carry is None:
            measured = tau if self._mean is None else self._mean
            self._carry = np.zeros_like(q) if self._gravity else measured
        self.listen(tau)
        self._braked_s += self._period_s
        slow = bool((np.abs(dq) < SLOW).all())
        self._slow_s = self._slow_s + self._period_s if slow else 0.0
        if self._hold is None and (self._slow_s >= SLOW_S or self._braked_s >= DAMP_AT_MOST_S):
            self._hold = q
            if slow and not self._gravity and self._mean is not None:
                self._carry = self._mean  # what stands is carried by what is measured
        wanted = self._carry - self._kd * dq
        if self._hold is not None:
            most = SPRING_SHARE * self.effort
            wanted = wanted + np.clip(self._kp * (self._hold - q), -most, most)
        return np.clip(wanted, -self.effort, self.effort)
