"""The joint filter: q, dq, tau in; q, dq, ddq, tau of one and the same earlier instant out.

Every signal x is modelled as [x, dx/dt] with white noise on the second derivative (filterpy's
`Q_continuous_white_noise`); filterpy's KalmanFilter is run once to its steady state, and what
is kept are the observer's poles. In steady state the estimated rate is s L(s) x with

    L(s) = k2 / (s² + k1 s + k2),

and the estimated level stepped back by d = k1 / k2 along that rate is exactly L(s) x. So q, dq
and tau leave through L, and ddq as s L(s) dq: one transfer, one instant, d before the sample.

The tick integrates L exactly between stamps (the signal taken as straight between two samples),
so jitter, missing and dropped samples need no grid. All joints go through one call.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.errors import SettingsError
from adapter.model.spatial import Array
from adapter.physics.kernels import jit
from adapter.signals.settings import FilterSettings

# Third differences have 1 + 9 + 9 + 1 times the variance of white noise, and next to no motion.
THIRD_DIFFERENCE_GAIN = 20.0

SETTLING_DELAYS = 4  # after so many delays a start has faded to 1e-2
NEVER = -(2**62)  # a stamp before all others


@cache
def steady_state_poles(settings: FilterSettings) -> tuple[float, float]:
    """(k1, k2) of L from filterpy's Kalman filter in its steady state, 1/s and 1/s²."""
    # Brings scipy.stats, a second of processor time, which the learner's process has no use for.
    from filterpy.common import Q_continuous_white_noise
    from filterpy.kalman import KalmanFilter

    period = settings.step_s
    noise = 5e-3 if settings.dq_noise is None else settings.dq_noise  # rad/s, of a Panda
    noise *= math.sqrt(settings.states_per_sample)  # as if each step brought a sample of its own
    drive = settings.dq_drive
    if drive is None:
        # Kalman-Bucy: corner^4 = drive² / (noise² period)
        drive = (2 * math.pi * settings.bandwidth_hz) ** 2 * noise * math.sqrt(period)
    kalman = KalmanFilter(dim_x=2, dim_z=1)
    kalman.F = np.array([[1.0, period], [0.0, 1.0]])
    kalman.H = np.array([[1.0, 0.0]])
    kalman.R = np.array([[noise**2]])
    kalman.Q = Q_continuous_white_noise(2, dt=period, spectral_density=drive**2)
    kalman.P = np.diag([noise**2, drive**2])
    gain = np.full((2, 1), np.inf)
    while not np.allclose(kalman.K, gain, rtol=1e-12, atol=0.0):
        gain = kalman.K.copy()
        kalman.predict()
        kalman.update(np.zeros(1))
    closed_loop = (np.eye(2) - kalman.K @ kalman.H) @ kalman.F
    poles = np.log(np.linalg.eigvals(closed_loop).astype(complex)) / period
    return float(-(poles[0] + poles[1]).real), float((poles[0] * poles[1]).real)


class Gains(NamedTuple):
    """The transfer L: k1 (1/s), k2 (1/s²), its delay and how long a start takes to fade, ns."""

    k1: float
    k2: float
    delay_ns: int
    settle_ns: int


class FilterState(NamedTuple):
    """What the filter remembers.

    Attributes:
        times: (2,) int64 stamps of the last sample (NEVER: start anew) and of the last start.
        old: (c,) the last sample.
        y, dy: (c,) L of the signals and its rate, at stamp - delay.
    """

    times: NDArray[np.int64]
    old: Array
    y: Array
    dy: Array


@jit
def advance(dt, gains, u1, state):
    """Advance y = L u and its rate over dt seconds while u goes straight from `old` to u1.

    Written for L with complex poles (steady-state Kalman poles of this model always are).
    """
    k1, k2, u0, y, dy = gains.k1, gains.k2, state.old, state.y, state.dy
    decay = 0.5 * k1
    omega = math.sqrt(k2 - decay * decay)
    e = math.exp(-decay * dt)
    c, s = math.cos(omega * dt), math.sin(omega * dt) / omega
    f00, f01 = e * (c + decay * s), e * s
    f10, f11 = -e * k2 * s, e * (c - decay * s)
    lag = k1 / k2
    for i in range(u0.shape[0]):
        slope = (u1[i] - u0[i]) / dt
        e0 = y[i] - (u0[i] - slope * lag)
        e1 = dy[i] - slope
        y[i] = u1[i] - slope * lag + f00 * e0 + f01 * e1
        dy[i] = slope + f10 * e0 + f11 * e1


@jit
def filter_step(stamp_ns, signals, gains, state):
    """Take one sample (c,); whether the filter has settled since its last start."""
    times = state.times
    if times[0] == NEVER:
        state.y[:] = signals
        state.dy[:] = 0.0
        times[1] = stamp_ns
    else:
        advance(1e-9 * (stamp_ns - times[0]), gains, signals, state)
    state.old[:] = signals
    times[0] = stamp_ns
    return stamp_ns - times[1] >= gains.settle_ns


class JointFilter:
    """What the filter of an arm's joints does to their signals; see the module.

    Attributes:
        delay_s: age of the filtered instant against the sample, s, constant.
        gains: what `filter_step` takes.
    """

    def __init__(self, settings: FilterSettings | None = None) -> None:
        self.settings = settings or FilterSettings()
        k1, k2 = steady_state_poles(self.settings)
        self.delay_s = k1 / k2
        delay_ns = round(1e9 * self.delay_s)
        self.gains = Gains(k1, k2, delay_ns, SETTLING_DELAYS * delay_ns)

    @property
    def noise_gain(self) -> float:
        """Filtered states that one independent of white noise is worth (ENBW)."""
        # equivalent noise bandwidth of L, one-sided
        bandwidth_hz = self.gains.k2 / (4.0 * self.gains.k1)
        s = self.settings
        by_band = 1.0 / (2.0 * bandwidth_hz * s.step_s * s.samples_per_state)
        return max(by_band, float(s.states_per_sample))


def noise_from_samples(x: Array) -> Array:
    """White-noise level of each column of x (m, c), from its third differences.

    Works in motion: what an arm does within three samples is far below its sensors' noise.
    Raises SettingsError for fewer than eight samples.
    """
    if len(x) < 8:
        raise SettingsError(f"a noise level needs at least 8 samples, got {len(x)}")
    return np.sqrt(np.mean(np.diff(x, n=3, axis=0) ** 2, axis=0) / THIRD_DIFFERENCE_GAIN)
