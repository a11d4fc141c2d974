"""How a moving arm is braked and then held by torques alone.

A controller of ros2_control that takes efforts goes on with the last one it was given, for ever,
and knows no brake. So whoever commands it has to bring the arm to a stand: from the speeds that it
has its joints follow a path that slows down evenly to zero, and then stay where it ends. The torque
measured last carries the arm's weight; what the weight has become on the way is found by a spring
and its integral. Once the arm stands, the torque that carries is measured anew, and the spring is
soft: an arm that is kept away is not pushed for good.

Gains go by each joint's largest torque and by how often the arm is heard: a joint that its drive
could accelerate by `MOST_ACCELERATION` has that much less inertia, and damping that takes away
`DAMPED_SHARE` of the speed in one period is stable with a delay of a few periods.
"""

from __future__ import annotations

import numpy as np

from drivers.interface import Array

MOST_ACCELERATION = 2500.0  # rad/s² that the largest torque gives to the lightest joint
DAMPED_SHARE = 0.3  # of the speed, in one period
BRAKE_S = 0.25  # from the speed it has to a stand
SLOW, SLOW_S = 0.05, 0.1  # rad/s, s: then it stands


class Braker:
    """Torques that bring an arm from any motion to a stand and hold it there.

    Args:
        effort: (n,) largest torques, N m.
        period_s: between two states.
        gravity: the arm carries its own weight.

    Attributes:
        effort: (n,) as given.
        standing: it holds its place.
    """

    def __init__(self, effort: Array, period_s: float, gravity: bool) -> None:
        self.effort, self._period_s, self._gravity = effort, period_s, gravity
        self._kd = DAMPED_SHARE * effort / MOST_ACCELERATION / max(period_s, 1e-3)
        self._kp = 10.0 * self._kd  # 1/s
        self._mean: Array | None = None  # [dq, tau] (2, n)
        self.release()

    def release(self) -> None:
        """Somebody else drives the arm from here on."""
        self._goal: Array | None = None  # (n,) where the joints should be, rad
        self._integral = self._speed = self._carry = np.zeros(len(self.effort))
        self.standing = False
        self._braked_s = self._slow_s = 0.0

    def listen(self, dq: Array, tau: Array) -> None:
        """Speeds and torques (n,) measured; while somebody else drives, too."""
        now, share = np.stack([dq, tau]), min(self._period_s / 0.02, 1.0)  # a mean over 20 ms
        self._mean = now if self._mean is None else self._mean + share * (now - self._mean)

    def blind(self) -> Array:
        """Torques (n,) for an arm that is not heard any more: what carried it."""
        if self._gravity or self._mean is None:
            return np.zeros(len(self.effort))
        return np.clip(self._mean[1], -self.effort, self.effort)

    def torques(self, q: Array, dq: Array, tau: Array) -> Array:
        """The next torques (n,) N m; one call for each state (n,) rad, rad/s, N m."""
        if self._goal is None:
            self._goal = q
            self._speed, carry = (dq, tau) if self._mean is None else self._mean
            self._carry = np.zeros_like(q) if self._gravity else carry
        self.listen(dq, tau)
        self._braked_s += self._period_s
        speed = max(1.0 - self._braked_s / BRAKE_S, 0.0) * self._speed
        self._goal = self._goal + speed * self._period_s
        self._look_whether_it_stands(q, dq)
        # at rest the spring has a share of the largest torque
        away, most = self._goal - q, (0.15 if self.standing else 1.0) * self.effort
        self._integral = np.clip(
            self._integral + 1.5 * self._kp * away * self._period_s, -most, most
        )
        spring = np.clip(self._kp * away + self._integral, -most, most)
        wanted = self._carry + spring + self._kd * (speed - dq)
        return np.clip(wanted, -self.effort, self.effort)

    def _look_whether_it_stands(self, q: Array, dq: Array) -> None:
        slow = bool((np.abs(dq) < SLOW).all())
        self._slow_s = self._slow_s + self._period_s if slow else 0.0
        if self.standing or self._braked_s < BRAKE_S:
            return
        if self._slow_s >= SLOW_S or self._braked_s >= 2.0:  # s
            self.standing = True
            if slow and self._mean is not None:
                self._goal, self._integral = q, np.zeros(len(q))
                self._carry = np.zeros_like(q) if self._gravity else self._mean[1]
