"""Times of states that a slower source gave to a regular publisher."""

from __future__ import annotations

import numpy as np
import pytest

from adapter.screening.timing import source_stamps

JOINTS = 5
MS = 1_000_000


def motion(t_s: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """q, dq (m, JOINTS) of sines at times (m,) s."""
    rng = np.random.default_rng(seed)
    size, speed, phase = (rng.uniform(*x, JOINTS) for x in ((0.2, 0.8), (0.8, 3.0), (0.0, 6.0)))
    angle = speed * t_s[:, None] + phase
    return size * np.sin(angle), size * speed * np.cos(angle)


def shown(period_s: float, source_s: float, span_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Stamps ns of a publisher without its repeats, and the times s of the states it shows."""
    stamps = np.arange(0.0, span_s, period_s)
    ticks = np.floor(stamps / source_s + 1e-9)
    new = np.concatenate([[True], np.diff(ticks) > 0])
    return np.round(1e9 * stamps[new]).astype(np.int64), ticks[new] * source_s


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("rate_hz", "source_hz"), [(30.0, 29.4), (1000.0, 960.0), (100.0, 93.0)])
def test_a_slower_source_is_found_out(seed: int, rate_hz: float, source_hz: float) -> None:
    """The states' times come back, but for what all of them are late by."""
    stamps, true_s = shown(1.0 / rate_hz, 1.0 / source_hz, 20.0)
    q, dq = motion(true_s, seed)
    noise = np.random.default_rng(seed + 100).normal(size=q.shape)
    found = 1e-9 * source_stamps(stamps, q + 1e-6 * noise, dq + 1e-4 * noise).astype(float)
    assert np.ptp(1e-9 * stamps - true_s) > 0.9 / rate_hz
    assert np.ptp(found - true_s) < 0.15 / rate_hz


@pytest.mark.parametrize("seed", range(5))
def test_lost_packets_leave_the_stamps(seed: int) -> None:
    """Where the arm went on during a repeat the stamps are right."""
    rng = np.random.default_rng(seed)
    stamps = np.flatnonzero(rng.random(20_000) > 0.05).astype(np.int64) * MS
    q, dq = motion(1e-9 * stamps, seed)
    assert source_stamps(stamps, q, dq) is stamps


def test_an_arm_that_rests_leaves_the_stamps() -> None:
    """Nothing is told by an arm that does not move."""
    stamps = np.arange(500, dtype=np.int64) * MS
    q = np.zeros((500, JOINTS))
    assert source_stamps(stamps, q, q) is stamps
