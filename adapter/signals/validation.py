"""How well a model explains torques it has not seen: one recipe for everybody."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt

from adapter.effects.base import SMOOTH_HZ
from adapter.model.spatial import Array

GRID_S = 1e-3
EDGE_S = 0.3  # left out at either end, where the filter has no neighbours
# Of a recording in pieces: what is filtered together, and how much of it at either end is there
# for the rest only.
WINDOW_S, MARGIN_S = 60.0, 2.0
BLOCKS = 10  # stretches of a table

# (q, dq, ddq), each (m, n), at stamps (m,) in s to torque (m, n)
TorqueModel = Callable[[Array, Array, Array, Array], Array]
Signals = tuple[Array, ...]


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
    t = GRID_S * np.arange(len(q), dtype=np.float64)
    return np.asarray((tau - torque(q, dq, ddq, t))[edge:-edge])


def errors_of_pieces(pieces: Iterable[Signals], torque: TorqueModel) -> Iterator[Array]:
    """The same of a recording of any length that comes in pieces (stamp_s, q, dq, tau), in tables.

    Filtered are windows with `MARGIN_S` to either side that count for nothing, behind which the
    filter has forgotten their ends.

    Raises:
        ValueError: less than a second of data.
    """
    begin = round(EDGE_S / GRID_S)
    for q, dq, ddq, tau in _windows(pieces):
        end = begin + len(q)
        yield tau - torque(q, dq, ddq, GRID_S * np.arange(begin, end, dtype=np.float64))
        begin = end


class Rms(NamedTuple):
    """Root of an error's mean square, (n,), and the standard deviation of that, (n,)."""

    value: Array
    std: Array


def rms_of(errors: Iterable[Array]) -> Rms:
    """Size of an error that comes in tables (k, n).

    Neighbouring rows are alike and do not count one by one: how far stretches of a table differ
    says how sure the size is.
    """
    parts = [part for error in errors for part in np.array_split(error**2, BLOCKS) if len(part)]
    squares = np.array([part.mean(axis=0) for part in parts])
    counts = np.array([len(part) for part in parts])
    value = np.sqrt(np.average(squares, axis=0, weights=counts))
    std = squares.std(axis=0, ddof=1) / np.sqrt(len(parts)) if len(parts) > 1 else np.inf
    return Rms(value, np.asarray(0.5 * std / np.maximum(value, 1e-12)))


def _windows(pieces: Iterable[Signals]) -> Iterator[Signals]:
    """q, dq, ddq, tau of `smooth`, a window at a time, without edges and margins."""
    edge, margin, size = (round(s / GRID_S) for s in (EDGE_S, MARGIN_S, WINDOW_S))
    held: list[Array] = []
    begin_s, k, skip = np.nan, 0, edge
    for piece in pieces:
        begin_s = begin_s if held else float(piece[0][0])
        held = [np.concatenate(x) for x in zip(held, piece, strict=True)] if held else [*piece]
        latest = np.maximum.accumulate(held[0])
        while latest[-1] > begin_s + GRID_S * (k + size):
            grid: Array = begin_s + GRID_S * np.arange(k, k + size, dtype=np.float64)
            last = int(np.searchsorted(latest, grid[-1])) + 1
            stamp_s, q, dq, tau = (x[:last] for x in held)
            smoothed = smooth(stamp_s, q, dq, tau, grid)
            yield tuple(x[skip:-margin] for x in smoothed)
            k, skip = k + size - 2 * margin, margin
            first = max(int(np.searchsorted(latest, begin_s + GRID_S * k, side="right")) - 1, 0)
            held, latest = [x[first:] for x in held], latest[first:]
    stamp_s, q, dq, tau = held
    grid = begin_s + GRID_S * np.arange(k, math.ceil((stamp_s[-1] - begin_s) / GRID_S))
    yield tuple(x[skip:-edge] for x in smooth(stamp_s, q, dq, tau, grid))


def smooth(stamp_s: Array, q: Array, dq: Array, tau: Array, grid: Array | None = None) -> Signals:
    """(q, dq, ddq, tau) of a recording on a 1 ms grid, its own or another one, zero-phase."""
    new = np.ones(len(q), dtype=bool)
    new[1:] = ((np.diff(q, axis=0) != 0) | (np.diff(dq, axis=0) != 0)).any(axis=1)
    new[1:] |= (np.diff(tau, axis=0) != 0).any(axis=1)
    new[1:] &= np.diff(np.maximum.accumulate(stamp_s)) > 0
    stamp_s, table = stamp_s[new], np.concatenate([q, dq, tau], axis=1)[new]
    if grid is None:
        grid = np.arange(stamp_s[0], stamp_s[-1], GRID_S)
    if len(grid) * GRID_S < 1.0:
        raise ValueError(f"validation needs a second of data, got {len(grid) * GRID_S:.2f} s")
    columns = [np.interp(grid, stamp_s, column) for column in table.T]
    sos = butter(4, SMOOTH_HZ, fs=1.0 / GRID_S, output="sos")
    q, dq, tau = np.split(sosfiltfilt(sos, np.column_stack(columns), axis=0), 3, axis=1)
    return q, dq, np.gradient(dq, GRID_S, axis=0), tau
