"""A recording as the search sees it: smooth motion, and torque in the band where models count.

Every torque, measured or modelled, goes through one and the same low-pass before the two are
compared: models are evaluated on the smooth motion at 250 Hz, sharp edges and all, and then
filtered and decimated to 25 Hz like the measured torque. Samples 40 ms apart are about as many
as the band of 10 Hz has independent ones; counting those at 1 kHz would name noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import firwin, oaconvolve, periodogram, upfirdn

from adapter.effects.base import Motion
from adapter.gap.recorded import Recorded
from adapter.records import Array
from adapter.rigid_arm import RigidArm

RATE_HZ = 250.0  # of the models
STEP = 10  # from there to the band: 25 Hz
CUT_HZ = 10.0
TAPS = 101  # of the low-pass: 0.9 at 8 Hz, 0.5 at 10, 0.05 at 12.5
RAW_HZ = 1000.0
BAND_REST, BAND_MARGIN = 1e-3, 1.3
EDGE_S = 0.1  # a spline's ends know their neighbours on one side only
_LOW = firwin(TAPS, CUT_HZ, window=("kaiser", 4.0), fs=RATE_HZ)
_ANTI_ALIAS = firwin(33, 0.4 * RATE_HZ, fs=RAW_HZ)


def low(x: Array) -> Array:
    """Signals (m, ...) at 250 Hz in the band, (k, ...) at 25 Hz; the ends are left out."""
    flat = x.reshape(len(x), -1)
    whole = (len(x) - TAPS) // STEP + 1
    # output k STEP + TAPS - 1 of the causal filter is the first that knows all its neighbours
    padded = upfirdn(_LOW, flat[(TAPS - 1) % STEP :], down=STEP, axis=0)
    first = (TAPS - 1) // STEP
    return padded[first : first + whole].reshape(-1, *x.shape[1:])


@dataclass(frozen=True, eq=False)
class Signals:
    """One recording, ready for the search.

    Attributes:
        motion: smooth motion at 250 Hz; its `t` is that of the recording.
        tau: (k, n) measured torque in the band, N m.
        t: (k,) s, its instants.
    """

    motion: Motion
    tau: Array
    t: Array

    def low(self, x: Array) -> Array:
        """A torque (m, ...) at the motion's instants in the band (k, ...)."""
        return low(x)

    def low_all(self, x: Array) -> Array:
        """Torques (c, m, n) in the band (c, k, n)."""
        return np.moveaxis(low(np.moveaxis(x, 0, -1)), -1, 0)


def prepare(recording: Recorded, arm: RigidArm, repeat: Recorded | None = None) -> Signals:
    """Smooth a recording.

    Args:
        recording: to be searched; arm: that moves.
        repeat: of the same motion, whose positions and velocities are taken instead: their noise
            has nothing to do with that of this recording's torques and positions.

    Raises:
        ValueError: less than two seconds of data.
    """
    t = recording.t
    if t[-1] - t[0] < 2.0:
        raise ValueError(f"the search needs 2 s of data, got {t[-1] - t[0]:.2f} s")
    grid = np.arange(t[0] + EDGE_S, t[-1] - EDGE_S, 1.0 / RATE_HZ)
    smoothed = (repeat or recording).smoothed().at(grid)
    motion = Motion(grid, *smoothed, arm, _band(smoothed[1]))
    band_t = grid[TAPS // 2 : -(TAPS // 2)][::STEP]
    return Signals(motion, low(_at(grid, t, recording.tau)), band_t)


def _band(dq: Array) -> float:
    """Frequency below which all but a thousandth of every joint's speed lies, with a margin, Hz."""
    f, power = periodogram(dq, fs=RATE_HZ, window="hann", axis=0)
    share = np.cumsum(power, axis=0) / power.sum(axis=0)
    return BAND_MARGIN * float(f[np.argmax(share > 1.0 - BAND_REST, axis=0)].max())


def _at(grid: Array, t: Array, tau: Array) -> Array:
    """Torque (m, n) at the grid's instants, without what lies above 100 Hz."""
    pad = (len(_ANTI_ALIAS) // 2) / RAW_HZ
    factor = round(RAW_HZ / RATE_HZ)
    fine = np.arange(len(grid) * factor + 2 * (len(_ANTI_ALIAS) // 2)) / RAW_HZ + grid[0] - pad
    raw = np.column_stack([np.interp(fine, t, column) for column in tau.T])
    return oaconvolve(raw, _ANTI_ALIAS[:, None], mode="valid", axes=0)[::factor][: len(grid)]
