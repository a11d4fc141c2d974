"""Forward simulation of a recording: a model with its effects, driven by the recorded torque.

A segment starts from the recorded motion: what the encoders read is taken back to the links,
the arm is put there and then follows the torque alone. What comes out is again what the encoders
would read, so that the recording can be held against it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sim.effects import ENCODER, Effect, effect_from
from sim.engine import Engine
from sim.sensors import Play, decoded, encoded, freed
from sim.truth import Array, Limits, Truth

STEP_S = 1e-3  # longest tick
SUBSTEPS = 2  # of a tick: within 1.5e-4 rad of 4 after 0.5 s with Coulomb friction on joint 7
SEGMENT_S = 0.5
SLOPE_S = 5e-3  # the torque's slope, for the twist's rate, is taken over so much on either side
UNEVEN = 1e-3  # of a period: so far may a table's times be from even ones
DRIVES = ("commands", "measured")


@dataclass(frozen=True, eq=False)
class Rollout:
    """A simulated recording.

    Attributes:
        q: (m, n) rad, as the encoders would read it; NaN outside the segments.
        dq: (m, n) rad/s.
        inside: (m,) whether a row belongs to a segment.
    """

    q: Array
    dq: Array
    inside: Any

    def rmse(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Root mean square differences (n,) rad and (n,) rad/s to a recording q, dq (m, n)."""
        pairs = ((self.q, q), (self.dq, dq))
        gaps = [np.nanmean(np.square(mine - theirs), axis=0) for mine, theirs in pairs]
        return np.sqrt(gaps[0]), np.sqrt(gaps[1])


def segments_of(t: Array, length_s: float = SEGMENT_S) -> list[tuple[int, int]]:
    """Segments [start, stop) of `length_s` along a uniform table t (m,); stop is the next start."""
    t = _table_times(t)
    rows = max(round(length_s / (t[1] - t[0])), 1)
    starts = range(0, len(t) - rows, rows)
    return [(start, start + rows) for start in starts]


class MotionTable(NamedTuple):
    """A recording over time.

    Attributes:
        t: (m,) s, uniform; longer periods than 1 ms are ticked through.
        q: (m, n) measured positions, smoothed, rad.
        dq: (m, n) measured velocities, smoothed, rad/s.
        u: (m, n) driving torque at the times t, linear between them, N m.
    """

    t: Array
    q: Array
    dq: Array
    u: Array


def rollout(
    truth: Truth,
    table: MotionTable,
    segments: Iterable[tuple[int, int]] | None = None,
    drive: str = "commands",
    substeps: int = SUBSTEPS,
) -> Rollout:
    """Simulate an arm along a recording.

    Args:
        truth: arm and effects; effects with intervals act by the times of the table.
        table: the recording.
        segments: (start, stop) rows, stop excluded; every 0.5 s by default.
        drive: `commands` (u is the true driving torque) or `measured` (u is what the torque
            sensors read: it is freed of the truth's gain, offset and delay).
        substeps: of a tick of at most 1 ms.

    Returns:
        Motion as the encoders would read it.

    Raises:
        ValueError: shapes that do not fit, times that are not uniform, values that are not
            finite, an unknown drive, a segment outside the table, a body that cannot be simulated.
    """
    t, q, dq, u = _checked(truth, table)
    if drive not in DRIVES:
        raise ValueError(f"no drive {drive!r}; have: {', '.join(DRIVES)}")
    chosen = segments_of(t) if segments is None else [(int(a), int(b)) for a, b in segments]
    for start, stop in chosen:
        if not 0 <= start < stop <= len(t):
            raise ValueError(f"segment ({start}, {stop}) is not inside a table of {len(t)} rows")
    true_u = freed(truth.effects, t, u) if drive == "measured" else u
    return _Runner(truth, t, true_u, substeps).run(q, dq, chosen)


class _Runner:
    """One engine for all segments of a table."""

    def __init__(self, truth: Truth, t: Array, u: Array, substeps: int) -> None:
        self._t, self._u, self._n = t, u, truth.n
        self._period_s = float(t[-1] - t[0]) / (len(t) - 1)
        self._ticks = max(int(np.ceil(self._period_s / STEP_S - UNEVEN)), 1)
        self._effects = [effect for effect in truth.effects if effect.place == ENCODER]
        self._engine = Engine(truth, self._period_s / self._ticks, substeps)
        self._twisting = _smooth(u, self._period_s)

    def run(self, q: Array, dq: Array, segments: Sequence[tuple[int, int]]) -> Rollout:
        """The motion of the links in all segments, read by the encoders."""
        t, column = self._t, self._t[:, None]
        play_q, play_dq = decoded(self._effects, column, q, dq, self._twisting)
        gap, rate = Play(self._effects, self._n).along(t, play_dq, self._period_s)
        start_q, start_dq = play_q - gap, play_dq - rate
        out_q, out_dq = np.full(q.shape, np.nan), np.full(q.shape, np.nan)
        try:
            for start, stop in segments:
                self._segment(start, stop, start_q, start_dq, out_q, out_dq)
        finally:
            self._engine.close()
        for start, stop in segments:
            part = slice(start, stop)
            play = Play(self._effects, self._n)
            play.gap = gap[start]
            gap_here, rate_here = play.along(t[part], out_dq[part], self._period_s)
            out_q[part] += gap_here
            out_dq[part] += rate_here
        inside = np.isfinite(out_q[:, 0])
        out_q, out_dq = encoded(self._effects, column, out_q, out_dq, self._twisting)
        return Rollout(out_q, out_dq, inside)

    def _segment(
        self, start: int, stop: int, q: Array, dq: Array, out_q: Array, out_dq: Array
    ) -> None:
        """Simulate rows start to stop - 1 into out_q and out_dq."""
        engine, u = self._engine, self._u
        engine.place(q[start], dq[start], float(self._t[start]))
        out_q[start], out_dq[start] = q[start], dq[start]
        for k in range(start + 1, stop):
            before, change = u[k - 1], (u[k] - u[k - 1]) / self._ticks
            for i in range(self._ticks):
                engine.tick(before + i * change, before + (i + 1) * change)
            out_q[k], out_dq[k] = engine.state()


def truth_from(
    names: tuple[Sequence[str], Sequence[str]],
    frames: tuple[Array, Array],
    theta: Array,
    gravity: Array,
    effects: Sequence[Effect | Mapping[str, Any]] = (),
) -> Truth:
    """A truth from plain numbers: a serial arm without limits, joint j turns link j about its z.

    Args:
        names: of the n joints and of the n links.
        frames: R (n, 3, 3) and p (n, 3) m of joint frame j in frame j - 1 (the base for j = 0) at
            q_j = 0.
        theta: (n, 10) about the link-frame origin, SI.
        gravity: (3,) in the base frame, m/s².
        effects: canonical entries or `Effect`s.

    Raises:
        ValueError: shapes that do not fit, matrices that are no rotations, values that are not
            finite, effects that are unknown or on joints that are not there.
    """
    joints, links = names
    n = len(joints)
    if len(links) != n or n == 0:
        raise ValueError(f"{n} joints and {len(links)} links; need as many of both, above 0")
    R = _array("R", frames[0], (n, 3, 3))
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max()
    if off > 1e-6 or np.linalg.det(R).min() < 0:
        raise ValueError(f"R holds what is no rotation (R R^T is off by {off:.2g})")
    most = np.full(n, np.inf)
    return Truth(
        joint_names=tuple(joints),
        link_names=tuple(links),
        R=R,
        p=_array("p", frames[1], (n, 3)),
        theta=_array("theta", theta, (n, 10)),
        gravity=_array("gravity", gravity, (3,)),
        limits=Limits(-most, most, most, most, most),
        ready=np.zeros(n),
        effects=tuple(effect_from(entry) for entry in effects),
    )


def _array(name: str, values: Any, shape: tuple[int, ...]) -> Array:
    """Finite numbers of a shape. Raises ValueError."""
    array = np.array(values, dtype=float)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; needs {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds values that are not finite")
    return array


def _checked(truth: Truth, table: MotionTable) -> MotionTable:
    """The table as arrays. Raises ValueError."""
    t = _table_times(table.t)
    shape = (len(t), truth.n)
    return MotionTable(t, *(_array(key, getattr(table, key), shape) for key in ("q", "dq", "u")))


def _table_times(t: Array) -> Array:
    """Times (m,) of a uniform table. Raises ValueError."""
    t = np.asarray(t, dtype=float)
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all():
        raise ValueError(f"t has shape {t.shape}; needs (m,) finite times, m at least 2")
    even = np.linspace(t[0], t[-1], len(t))
    period = even[1] - even[0]
    if not period > 0 or np.abs(t - even).max() > max(UNEVEN * period, 1e-9):
        raise ValueError("t is not uniform: resample the recording first")
    return t


def _smooth(u: Array, period_s: float) -> tuple[Array, Array]:
    """Driving torque (m, n) as a mean over its neighbourhood, and its slope there, per s."""
    reach = max(round(SLOPE_S / period_s), 1)
    rows = np.arange(len(u))
    first, last = np.maximum(rows - reach, 0), np.minimum(rows + reach, len(u) - 1)
    total = np.vstack([np.zeros(u.shape[1]), np.cumsum(u, axis=0)])
    near = np.minimum(rows - first, last - rows)  # as far on one side as on the other
    mean = (total[rows + near + 1] - total[rows - near]) / (2 * near + 1)[:, None]
    slope = (u[last] - u[first]) / ((last - first) * period_s)[:, None]
    return mean, slope
