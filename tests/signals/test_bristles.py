"""Bristles in the joints from raw readings: as the equation has it, whatever the sensors' noise."""

import numpy as np

from adapter.effects.bristle_friction import bending
from adapter.effects.by_joint import WAYS_RAD, shares_of_ways, smooth_sign
from adapter.signals.bristles import Bristles, wind

T = 1e-3 * np.arange(6000)
Q_NOISE, DQ_NOISE = 3e-4, 5e-3  # rad, rad/s, of a real Panda


def moved() -> tuple[np.ndarray, np.ndarray]:
    """q, dq (m, 2) of joints that swing for 4 s, with turns of 2 mrad on the way, then rest."""
    t = np.minimum(T, 4.0)[:, None]
    w = 2.0 * np.pi * np.array([0.5, 0.75])
    q = 0.3 * np.cos(w * t) + 1e-3 * np.sin(9.0 * w * t)
    return q, np.gradient(q, T, axis=0)


def bent_along(t: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """(m, K, n) how far bristles are bent along a motion that begins with bristles at rest."""
    m, n = q.shape
    nothing, held = np.zeros((2, n)), np.zeros((len(WAYS_RAD), n))
    bristles, bent = Bristles(np.full(n, np.nan), *nothing, held), np.empty((m, held.size))
    for i, dt_s in enumerate(np.diff(t, prepend=t[0])):
        wind(dt_s, q[i], dq[i], bristles, bent[i])
    return bent.reshape(m, -1, n)


def expected(q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """(m, K, n) by the equation, without noise; the first ones slide at once."""
    z = [[bending(x, s0) for x in q.T] for s0 in WAYS_RAD[1:]]
    return np.array([smooth_sign(dq.T), *z]).transpose(2, 0, 1)


def test_as_the_equation_has_it() -> None:
    q, dq = moved()
    away = np.abs(bent_along(T, q, dq) - expected(q, dq))
    assert away[500:].max() < 0.03  # dq of a motion that starts with a jerk is not its rate


def test_noise_is_no_way() -> None:
    """In motion they follow; over two seconds of rest they hold, but for the noise's own width."""
    q, dq = moved()
    rng = np.random.default_rng(1)
    read = q + Q_NOISE * rng.standard_normal(q.shape), dq + DQ_NOISE * rng.standard_normal(q.shape)
    noisy, true = bent_along(T, *read)[:, 1:], expected(q, dq)[:, 1:]
    assert np.sqrt(np.mean((noisy - true)[1000:4000] ** 2)) < 0.02
    held = np.mean(noisy[-200:], axis=0) / true[-1]
    assert (held[1:] > [[0.6], [0.8], [0.9]]).all(), held
    plain = np.array([bending(x, 1e-3) for x in read[0].T])
    assert (np.abs(np.mean(plain[:, -200:], axis=1)) < 0.3).all()  # what noise makes of it


def test_a_way_between_two() -> None:
    way = np.linspace(0.0, 0.02, 400)
    for s0 in np.geomspace(WAYS_RAD[0], WAYS_RAD[-1], 30):
        alone = np.exp(-way[:, None] / WAYS_RAD)
        assert np.abs(alone @ shares_of_ways(s0) - np.exp(-way / s0)).max() < 0.06
