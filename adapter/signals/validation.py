"""How well a model explains torques it has not seen: one recipe for everybody."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.signal import butter, sosfiltfilt

from adapter.effects.base import SMOOTH_HZ
from adapter.model.spatial import Array

GRID_S = 1e-3
EDGE_S = 0.3  # left out at either end, where the filter has no neighbours

# (q, dq, ddq), each (m, n), to torque (m, n)
TorqueModel = Callable[[Array, Array, Array], Array]


def validation_torque_rmse(
    stamp_s: Array, q: Array, dq: Array, tau: Array, torque: TorqueModel
) -> Array:
    """Torque RMSE (n,) of a model on a recording, N m; see `validation_error`."""
    return np.sqrt(np.mean(validation_error(stamp_s, q, dq, tau, torque) ** 2, axis=0))


def validation_error(stamp_s: Array, q: Array, dq: Array, tau: Array, torque: TorqueModel) -> Array:
    """Torque error (k, n) of a model on a recording, N m, by the project's recipe.

    Drop samples identical to the one before in all of q, dq, tau; interpolate linearly on a 1 ms
    grid of the stamps; zero-phase fourth-order Butterworth at 10 Hz; ddq = numpy.gradient of the
    filtered dq; leave out 0.3 s at either end.

    Args:
        stamp_s: (m,) s; q, dq, tau: (m, n) rad, rad/s, N m.
        torque: the model.

    Raises:
        ValueError: less than a second of data.
    """
    q, dq, ddq, tau = smooth(stamp_s, q, dq, tau)
    edge = round(EDGE_S / GRID_S)
    return np.asarray((tau - torque(q, dq, ddq))[edge:-edge])


def smooth(stamp_s: Array, q: Array, dq: Array, tau: Array) -> tuple[Array, Array, Array, Array]:
    """(q, dq, ddq, tau) of a recording on a 1 ms grid, zero-phase; see above."""
    new = np.ones(len(q), dtype=bool)
    new[1:] = ((np.diff(q, axis=0) != 0) | (np.diff(dq, axis=0) != 0)).any(axis=1)
    new[1:] |= (np.diff(tau, axis=0) != 0).any(axis=1)
    new[1:] &= np.diff(np.maximum.accumulate(stamp_s)) > 0
    stamp_s, table = stamp_s[new], np.concatenate([q, dq, tau], axis=1)[new]
    grid = np.arange(stamp_s[0], stamp_s[-1], GRID_S)
    if len(grid) * GRID_S < 1.0:
        raise ValueError(f"validation needs a second of data, got {len(grid) * GRID_S:.2f} s")
    columns = [np.interp(grid, stamp_s, column) for column in table.T]
    sos = butter(4, SMOOTH_HZ, fs=1.0 / GRID_S, output="sos")
    q, dq, tau = np.split(sosfiltfilt(sos, np.column_stack(columns), axis=0), 3, axis=1)
    return q, dq, np.gradient(dq, GRID_S, axis=0), tau
