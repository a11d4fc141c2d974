"""Noticing that the arm's load has changed: the torque error leaves its own running level."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapter.learning.settings import ChangeSettings
from adapter.model.spatial import Array
from adapter.physics.kernels import jit

BURST_BLOCK = 500  # samples
BEYOND = 1.5  # times the fastest that was seen: a velocity is new


@jit
def compare(error, each, settings, samples, recent, level):
    """Update the recent power and its level (n,); root of the largest and of the mean ratio.

    `each` samples are what an error (n,) stands for, `settings` are `fast` and `slow`.

    A level follows its power at most fourfold, so that the start of a change does not hide it.
    """
    rows, n = error.shape
    (fast, slow), m = settings, rows * each
    most, total = 0.0, 0.0
    for j in range(n):
        power = 0.0
        for k in range(rows):
            power += error[k, j] * error[k, j] / rows
        recent[j] += min(1.0, m / fast) * (power - recent[j])
        ratio = recent[j] / max(level[j], 1e-12)
        most = max(most, ratio)
        total += ratio
        if samples > slow:
            power = min(power, 4.0 * level[j])
        level[j] += (power - level[j]) * min(1.0, max(m / slow, m / max(samples, m)))
    return np.sqrt(most), np.sqrt(total / n)


def explained_share(columns: Array, error: Array) -> float:
    """Share of the power of errors (m, n) that one set of parameters explains by (m, n, k)."""
    left = error.ravel()
    found = np.linalg.lstsq(columns.reshape(len(left), -1), left, rcond=None)[0]
    rest = left - columns.reshape(len(left), -1) @ found
    return 1.0 - float(rest @ rest) / max(float(left @ left), 1e-300)


def is_new(rates: Array, seen: Array) -> NDArray[np.bool_]:
    """(m, n) where a joint's velocity or acceleration is beyond those seen.

    Friction of a joint that has turned one way only is told from nothing else; what it does the
    other way, or much faster, is foretold wrong without anything having changed. So are inertias
    of an arm that has hardly sped up.

    Args:
        rates: (m, 2 n) velocities and accelerations, rad/s and rad/s²; seen: (k, 2 n).
    """
    low, high = extremes(seen)
    new = (rates < BEYOND * low) | (rates > BEYOND * high)
    return np.asarray(new.reshape(len(rates), 2, -1).any(axis=1))


def extremes(rates: Array) -> Array:
    """(2, n) least and largest of rates (k, n) and of rest."""
    return np.array([rates.min(axis=0, initial=0.0), rates.max(axis=0, initial=0.0)])


class ChangeDetector:
    """Compares each joint's recent squared torque error with its running level.

    Args:
        n: joints.

    Attributes:
        waiting: an alarm is waiting for its confirmation; nothing should be learned meanwhile.
        each: samples that one whose error is given stands for, where the others are left out.
    """

    def __init__(self, n: int, settings: ChangeSettings | None = None) -> None:
        self.settings = settings or ChangeSettings()
        self.recent, self.level = np.zeros(n), np.zeros(n)
        self.samples, self.each = 0, 1
        self._peaks, self._block, self._block_samples = np.zeros(2), np.zeros(2), 0
        self._armed_at = self.settings.arm_after
        self._wait = 0

    @property
    def waiting(self) -> bool:
        """Whether an alarm waits for its confirmation."""
        return self._wait > 0

    def look(self, error: Array, explained: Callable[[], bool] = lambda: True) -> bool:
        """Take torque errors (m, n); True when they say, for good, that something changed.

        `explained` is asked at the end of a wait: whether a change can explain the errors since.
        """
        s = self.settings
        if self.waiting:
            return self._confirm(error, explained)
        samples = self.samples + self.each * len(error)
        levels = self.recent, self.level
        most, mean = compare(error, self.each, (s.fast, s.slow), samples, *levels)
        self.weigh(self.each * len(error), most, mean)
        return False

    def weigh(self, samples: int, most: float, mean: float) -> None:
        """Take what `compare` says of so many samples more; the detector may wait then."""
        self.samples += samples
        armed = self.settings.enabled and self.samples >= self._armed_at
        if armed and self._alarming(most, mean):
            self._wait = self.settings.wait
        elif self.samples >= self._armed_at - self.settings.slow:
            # largest ratios, block by block: a block counts once it is over, so that what is just
            # rising does not raise its own bar
            block, peaks = self._block, self._peaks
            block[0], block[1] = max(block[0], most), max(block[1], mean)
            self._block_samples += samples
            if self._block_samples >= BURST_BLOCK:
                fade = 1.0 - self._block_samples / self.settings.burst_memory
                peaks[:] = np.maximum(fade * peaks, block)
                block[:], self._block_samples = 0.0, 0

    def weigh_all(self, samples: NDArray[np.int64], ratios: Array) -> None:
        """`weigh` step by step: (m,) samples each, and (m or more, 2) of `compare` where any."""
        ratios, counts = ratios[: len(samples)][samples > 0], samples[samples > 0]
        total, peak = int(counts.sum()), ratios.max(axis=0, initial=0.0)
        most = self.parts(total)[-1]
        calm = self._block_samples + total < BURST_BLOCK and (peak <= most).all()
        if calm and self.samples >= self._armed_at - self.settings.slow:
            self.samples += total
            self._block_samples += total
            np.maximum(self._block, peak, out=self._block)
            return
        for count, (one, mean) in zip(counts.tolist(), ratios.tolist(), strict=True):
            self.weigh(count, one, mean)

    def parts(self, ahead: int) -> tuple[Any, ...]:
        """What `compare` needs, and what ratios say nothing within so many samples; see `steps`."""
        s, most = self.settings, (math.inf, math.inf)
        if s.enabled and self.samples + ahead >= self._armed_at:
            fade = 1.0 - (BURST_BLOCK + ahead) / s.burst_memory  # a block may be over meanwhile
            one, every = (fade * s.burst_factor * self._peaks).tolist()
            most = max(s.one_factor, one), max(s.all_factor, every)
        return (s.fast, s.slow), self.samples, self.recent, self.level, most

    def _alarming(self, most: float, mean: float) -> bool:
        s, (one, every) = self.settings, self.settings.burst_factor * self._peaks
        return bool(most > max(s.one_factor, one) or mean > max(s.all_factor, every))

    def _confirm(self, error: Array, explained: Callable[[], bool]) -> bool:
        """Look on without touching the level; at the end of the wait the alarm must still hold."""
        level, speeds = self.level.copy(), (self.settings.fast, self.settings.slow)
        most, mean = compare(error, self.each, speeds, self.samples, self.recent, level)
        self._wait -= self.each * len(error)
        if self._wait > 0:
            return False
        if not self._alarming(most, mean):
            self._block = np.maximum(self._block, (most, mean))
            return False
        if not explained():
            self._armed_at = self.samples + 500  # no hand carries such
            return False
        self._armed_at = self.samples + self.settings.rearm_after
        self.recent[:] = 0.0
        return True
