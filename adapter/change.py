"""Noticing that the arm's load has changed: the torque error leaves its own running level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import SettingsError
from adapter.fast import jit
from adapter.records import Array


@dataclass(frozen=True)
class ChangeSettings:
    """When a torque error means that something changed.

    Attributes:
        enabled: whether changes are looked for.
        fast, slow: samples that the error and its level are averaged over.
        all_factor: alarm when the rms over all joints, each in units of its level, exceeds this.
        one_factor: alarm when a single joint's does.
        arm_after: samples of θ learning before the first alarm can be.
        rearm_after: samples after a change before the next can be.
        wait: samples let pass after an alarm, while the filters fill with the new state.
    """

    enabled: bool = True
    fast: int = 50
    slow: int = 2000
    all_factor: float = 2.6
    one_factor: float = 5.0
    arm_after: int = 5000
    rearm_after: int = 3000
    wait: int = 100

    def __post_init__(self) -> None:
        if not 1 <= self.fast < self.slow:
            raise SettingsError("change.fast must be at least 1 and below change.slow")


@jit
def compare(error, samples, fast, slow, recent, level):
    """Update the recent power and its level (n,); their largest and their mean ratio.

    A level follows its power at most fourfold, so that the start of a change does not hide it.
    """
    m, n = error.shape
    most, total = 0.0, 0.0
    for j in range(n):
        power = 0.0
        for k in range(m):
            power += error[k, j] * error[k, j] / m
        recent[j] += min(1.0, m / fast) * (power - recent[j])
        ratio = recent[j] / max(level[j], 1e-12)
        most = max(most, ratio)
        total += ratio
        if samples > slow:
            power = min(power, 4.0 * level[j])
        level[j] += (power - level[j]) * min(1.0, max(m / slow, m / samples))
    return most, total / n


class ChangeDetector:
    """Compares each joint's recent squared torque error with its running level.

    Args:
        n: joints.
    """

    def __init__(self, n: int, settings: ChangeSettings | None = None) -> None:
        self.settings = settings or ChangeSettings()
        self.recent, self.level = np.zeros(n), np.zeros(n)
        self.samples = 0
        self._armed_at = self.settings.arm_after
        self._wait = 0

    def waiting(self, samples: int) -> bool:
        """Whether these samples fall into the wait after an alarm."""
        if self._wait > 0:
            self._wait -= samples
            return True
        return False

    def look(self, error: Array) -> bool:
        """Take torque errors (m, n); True when they say that something changed."""
        s = self.settings
        if not s.enabled:
            return False
        self.samples += len(error)
        most, mean = compare(error, self.samples, s.fast, s.slow, self.recent, self.level)
        if self.samples < self._armed_at or (most < s.one_factor**2 and mean < s.all_factor**2):
            return False
        self._armed_at = self.samples + s.rearm_after
        self._wait = s.wait
        return True
