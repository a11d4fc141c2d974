"""Whether numbers of other tools can be what they are said to be: angles, velocities, torques."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap import derive_velocity, looks_like_degrees
from drivers.interface import Array, DriverError

_MOST = {"time": 9e9, "q": 1e4, "dq": 1e6, "tau": 1e6}  # SI; beyond, it is another quantity
_WHAT = {"time": "time", "q": "angle", "dq": "velocity", "tau": "torque"}
_MOVING = 1e-2  # rad/s, a median slope below it says nothing
_PLAUSIBLE = 0.2  # degrees for radians are a factor of 57, milliseconds for seconds of 1000


def refuse_wild(where: str, place: Callable[[int], str], signal: str, values: Array) -> None:
    """Refuse numbers that no arm has.

    Args:
        where: the file; place: what stands at a row of it, in words.
        signal: time, q, dq or tau; values: (m, k), SI.

    Raises:
        DriverError: one is larger than any of its kind; names the first.
    """
    wild = np.argwhere(np.abs(values) > _MOST[signal])
    if len(wild):
        row, column = wild[0].tolist()
        raise DriverError(
            f"{where}: {place(row)}: {values[row, column]:.4g} is no {_WHAT[signal]} (at most "
            f"{_MOST[signal]:g} in SI units); are column and unit of {signal} right?"
        )


def value_doubts(where: str, signals: Mapping[str, Array], units: Mapping[str, str]) -> list[str]:
    """Sentences on samples that are no number, and on positions that look like degrees.

    Args:
        where: the file; signals: (m, n) by name, SI; units: those that the user named.

    Raises:
        DriverError: positions look like degrees, and their unit was not named.
    """
    found = []
    for name, values in signals.items():
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if bad.size:
            found.append(
                f"{where}: {name} is not a number in {bad.size} samples, first in sample {bad[0]}"
            )
    if looks_like_degrees(signals["q"]):
        said = (
            f"{where}: positions reach {np.nanmax(np.abs(signals['q'])):.0f} rad; are they degrees?"
        )
        if "q" not in units:
            raise DriverError(f"{said} Say --units q=deg (q=rad takes them as they are)")
        found.append(f"{said} Say q=deg")
    return found


def velocity_doubts(where: str, stamp_ns: NDArray[np.int64], q: Array, dq: Array) -> list[str]:
    """Whether the velocities are the positions' slope in the same unit."""
    with np.errstate(invalid="ignore"):
        slopes = np.abs(derive_velocity(stamp_ns, q))
    if np.isnan(slopes).all() or np.isnan(dq).all():
        return []
    slope, said = np.nanmedian(slopes), np.nanmedian(np.abs(dq))
    ratio = said / slope if slope > _MOVING and said > 0 else 1.0
    if _PLAUSIBLE < ratio < 1 / _PLAUSIBLE:
        return []
    return [
        f"{where}: velocities are {ratio:.3g} times the slope of the positions; are the units "
        "of q, dq and time right?"
    ]
