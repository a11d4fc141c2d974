"""Whether a motor's speed is the rate of change of its angle; a wrong VMAX shows as a factor.

Over windows of 50 ms, the integral of dq is fitted against the change of q by a line with an
offset (codes are truncated, so that dq has a constant error of half a step). The slope is VMAX as
decoded over VMAX as encoded: 0.8 where a DM4340 is read with another source's table.
"""

from __future__ import annotations

import numpy as np

from drivers.interface import Array, DriverError

WINDOW_NS = 50_000_000
LEAST_WINDOWS, MOST_WINDOWS = 10, 60  # 0.5 s to 3 s of windows
FIT = 0.995  # correlation of a slope that counts: a stuck encoder is something else
# rad: changes of q are known to a step's 1/sqrt(6), a step being at most 25 rad / 65535
Q_NOISE = 25.0 / 65535 / 6.0**0.5


class SpeedCheck:
    """Looks at every sample of an arm.

    Args:
        joint_names: for the sentence.
        dq_max: (n,) VMAX as read from the motors, rad/s.
    """

    def __init__(self, joint_names: tuple[str, ...], dq_max: Array) -> None:
        self._names, self._dq_max = joint_names, dq_max
        n = len(joint_names)
        self._sum, self._count = np.zeros(n), 0
        self._start_ns, self._start_q, self._start_dq = 0, np.zeros(n), np.zeros(n)
        self._windows = np.zeros((2, MOST_WINDOWS, n))  # change of q, integral of dq
        self._filled = 0

    def add(self, stamp_ns: int, q: Array, dq: Array) -> None:
        """One sample without gaps. Raises DriverError where a speed is clearly off."""
        if self._count:
            self._sum += dq
            self._count += 1
            span_ns = stamp_ns - self._start_ns
            if span_ns < WINDOW_NS:
                return
            mean = (self._sum - 0.5 * (self._start_dq + dq)) / (self._count - 1)
            self._windows[:, self._filled] = q - self._start_q, mean * (1e-9 * span_ns)
            self._filled += 1
            if self._filled % LEAST_WINDOWS == 0:
                self._judge(self._filled)
            if self._filled == MOST_WINDOWS:
                self._filled = 0
        self._start_ns, self._start_q, self._start_dq = stamp_ns, q, dq
        self._sum[:] = dq
        self._count = 1

    def skip(self) -> None:
        """A sample with a gap came; the window that it lies in is left out."""
        self._count = 0

    def _judge(self, m: int) -> None:
        change, integral = self._windows[:, :m]
        change = change - change.mean(axis=0)
        integral = integral - integral.mean(axis=0)
        square = np.maximum((change**2).sum(axis=0), 1e-300)
        slope = (change * integral).sum(axis=0) / square
        rest = ((integral - slope * change) ** 2).sum(axis=0)
        deviation = np.sqrt((rest / (m - 2) + Q_NOISE**2) / square)
        fit = 1.0 - rest / np.maximum((integral**2).sum(axis=0), 1e-300)
        off = np.abs(slope - 1.0)
        wrong = (
            (off > 0.1)  # of the slope
            & (off > 6.0 * deviation)  # standard deviations that a wrong slope must lie off
            & (deviation < 0.02)  # standard deviation of a slope that counts
            & (fit > FIT**2)
        )
        for j in np.flatnonzero(wrong)[:1]:
            raise DriverError(
                f"{self._names[j]}: its speed is {slope[j]:.2f} times the rate of change of its "
                f"angle; VMAX {self._dq_max[j]:g} rad/s is not what the motor scales with (that "
                f"would be about {self._dq_max[j] / slope[j]:.3g}): check register 22 (VMAX)"
            )
