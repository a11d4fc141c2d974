"""The last look at a torque command before it goes out: what a motor's scale can hold."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from drivers.damiao.codec import CODES, Scales, mit_command
from drivers.interface import Array, DriverError

# The torque command of each code, with nothing else: q, dq, kp, kd zero. The same for all types.
TORQUE_FRAMES = [
    mit_command(Scales(1.0, 1.0, 1.0))[:6] + code.to_bytes(2, "big") for code in range(CODES + 1)
]


def torque_frames(tau: Array, tau_max: Sequence[float]) -> tuple[list[bytes], bool]:
    """The MIT commands of (n,) torques, N m, and whether one was cut at its motor's TMAX.

    Raises DriverError for anything but n finite numbers.
    """
    wanted = np.asarray(tau, dtype=np.float64).tolist()
    if not isinstance(wanted, list) or len(wanted) != len(tau_max):
        raise DriverError(f"a command is {len(tau_max)} torques, N m")
    frames, cut = [], False
    for value, most in zip(wanted, tau_max, strict=True):
        if not -most <= value <= most:
            if not math.isfinite(value):
                raise DriverError("a torque to be commanded is not a finite number")
            value, cut = math.copysign(most, value), True
        frames.append(TORQUE_FRAMES[int((value + most) / (most + most) * CODES)])
    return frames, cut
