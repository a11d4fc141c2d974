"""Plain weighted least squares for a load at the hand: what any user of numpy would try first."""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, sosfiltfilt

from drivers.files.mcap import Log
from sim.truth import Truth
from tests.helpers.gap_effects import regressor, rnea

RATE_HZ, BAND_HZ, KEPT = 500.0, 8.0, 10  # of the even grid; of the low-pass; one row of so many
REST_WIDTH = 0.03  # rad/s: of friction's tanh
PRIOR_KG, PRIOR_KGM = 3.0, 0.3
PRIOR = np.array([PRIOR_KG, *[PRIOR_KGM] * 3, *[0.1] * 6])
ROUNDS = 5  # of the joints' weights


def weighed(recording: Log, nominal: Truth) -> float:
    """Mass kg of a load on the last link, friction and offsets of all joints learned beside it."""
    t = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0])
    grid = np.arange(t[0], t[-1], 1 / RATE_HZ)
    low = butter(2, BAND_HZ, fs=RATE_HZ, output="sos")
    q, tau = (
        sosfiltfilt(low, np.array([np.interp(grid, t, c) for c in x.T]).T, axis=0)
        for x in (recording.q, recording.tau)
    )
    dq = np.gradient(q, 1 / RATE_HZ, axis=0)
    ddq = np.gradient(dq, 1 / RATE_HZ, axis=0)
    inner = slice(int(0.05 * len(q)), int(0.95 * len(q)), KEPT)
    q, dq, ddq, tau = (x[inner] for x in (q, dq, ddq, tau))
    rest = tau - rnea(nominal, q, dq, ddq)
    m, n = rest.shape
    load = regressor(nominal, q, dq, ddq)[:, :, -10:]
    columns = np.zeros((m, n, 10 + 3 * n))
    columns[:, :, :10] = load
    for j in range(n):
        own = 10 + 3 * j
        columns[:, j, own : own + 3] = np.stack(
            [np.tanh(dq[:, j] / REST_WIDTH), dq[:, j], np.ones(m)], axis=1
        )
    information = np.diag(np.concatenate([PRIOR**-2.0, np.tile([1.0, 1.0, 1.0], n)]))
    weight, x = np.ones(n), np.zeros(10 + 3 * n)
    for _ in range(ROUNDS):
        A = information + np.einsum("mji,j,mjk->ik", columns, weight, columns)
        x = np.linalg.solve(A, np.einsum("mji,j,mj->i", columns, weight, rest))
        weight = 1 / np.maximum(np.square(rest - columns @ x).mean(axis=0), 1e-4)
    return float(x[0])
