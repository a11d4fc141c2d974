"""Whether a recording's samples belong to the instants that they are stamped with."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.signal import butter, sosfiltfilt

from adapter.model.spatial import Array

HOLE_PERIODS = 3.0  # a step longer than so many median periods is a hole
# A reading further from it than so many usual ones, and than this share of its range, is no arm's.
SPIKE_TIMES, SPIKE_SHARE = 15.0, 0.2
PUT_BACK_S = 1.0  # of a pause where a clock was put back, which says nothing of how long it took
CUT_HZ = 8.0  # band in which velocity and position are compared: arms move below it
FEWEST_COMPARED = 100  # points of 10 ms; fewer say nothing about lateness
TIMING_SHARE = 0.25  # of a sample period: a hold of half a sample, two of these, is no effect
BLOCKS = 16  # of the recording, left out in turn: how sure the lateness is

FEWEST_SLIPS = 3  # of a source that is slower all along
SLIP_PERIODS = 0.5  # less motion than the stamps say, in median periods, is a state shown twice
BETTER = 0.5  # times the disagreement of dq and the steps of q that the stamps leave
FASTEST = 0.05  # share of the fastest step's speed below which a step's time is not told by motion

Index = NDArray[np.int64]


@dataclass(frozen=True)
class RecordingClock:
    """What a recording's clock is like.

    Attributes:
        samples: rows of the recording; kept: those that `uniform` keeps.
        span_s: from the first kept stamp to the last.
        rate_hz: one over the median step of the stamps.
        jitter_s: standard deviation of the steps, holes left out.
        holes: (start, length) s of steps of more than 3 median periods, from the first stamp.
        frozen: (start, length) s of runs in which no signal changes though the arm moves.
        repeated: share of rows identical to the one before.
        held: share of the other rows in which this signal ("q", "dq", "tau") stays as it was.
        out_of_order: rows whose stamps don't increase; not_finite: rows with no number in them;
            impossible: rows with a single reading that no arm makes, see `possible`.
        lateness_s, lateness_std_s: of dq against q, dq(t) = d/dt q(t - lateness); NaN where the
            motion does not tell.
        velocity_gain: (n,) size of dq against d/dt q; NaN where a joint does not move.
    """

    samples: int
    kept: int
    span_s: float
    rate_hz: float
    jitter_s: float
    holes: tuple[tuple[float, float], ...]
    frozen: tuple[tuple[float, float], ...]
    repeated: float
    held: dict[str, float]
    out_of_order: int
    not_finite: int
    impossible: int
    lateness_s: float
    lateness_std_s: float
    velocity_gain: Array

    @property
    def period_s(self) -> float:
        """Median step of the stamps."""
        return 1.0 / self.rate_hz if self.rate_hz else float("nan")

    def hold_lag_s(self, signal: str) -> float:
        """Mean age of a signal that arrives more often than it is updated; 0 where it is new."""
        share = self.held[signal]
        if share < 0.3 or share > 0.999:  # more is a slower source
            return 0.0
        return 0.5 * self.period_s * share / (1.0 - share)

    def words(self) -> list[str]:
        """What is worth knowing, a sentence each; a recording without fault has none."""
        said = []
        if self.out_of_order:
            said.append(f"{self.out_of_order} stamps do not increase; those samples are left out.")
        if self.holes:
            start, length = max(self.holes, key=lambda hole: hole[1])
            many = "a hole" if len(self.holes) == 1 else f"{len(self.holes)} holes"
            said.append(
                f"The stamps have {many}, {sum(x for _, x in self.holes):.3g} s in all; the "
                f"longest is {1e3 * length:.3g} ms at {start:.2f} s."
            )
        if self.jitter_s > 0.1 * self.period_s:
            around = f"{1e3 * self.jitter_s:.2g} ms around {1e3 * self.period_s:.3g} ms"
            said.append(f"The steps between stamps scatter by {around}.")
        if self.not_finite:
            said.append(f"{self.not_finite} samples hold no number; they are left out.")
        if self.impossible:
            said.append(
                f"{self.impossible} samples hold what no arm makes (torques that are all exactly "
                "zero, single readings far from those before and after); they are left out."
            )
        if self.repeated > 0.001:
            share = f"{100 * self.repeated:.1f} %"
            said.append(f"{share} of the samples repeat the one before; they are left out.")
        if self.frozen:
            start, length = max(self.frozen, key=lambda run: run[1])
            said.append(
                f"The signals stand still while the arm moves, {len(self.frozen)} times, longest "
                f"for {1e3 * length:.3g} ms at {start:.2f} s."
            )
        for signal, held in self.held.items():
            if self.hold_lag_s(signal):
                said.append(
                    f"{signal} is updated at {(1 - held) * self.rate_hz:.4g} Hz only and held in "
                    f"between: on average it is {1e3 * self.hold_lag_s(signal):.2g} ms old."
                )
        late, std = self.lateness_s, self.lateness_std_s
        if not abs(late) > max(3.0 * std, 1e-4):
            return said
        side = "behind" if late > 0 else "ahead of"
        sentence = f"dq is {1e3 * abs(late):.2f} ± {1e3 * std:.2g} ms {side} q"
        if abs(abs(late) / self.period_s - 0.5) < 0.1 and std < 0.1 * self.period_s:
            sentence += ", half a sample: the mark of a simulator that holds torque over its step"
        return [*said, sentence + "."]


def joined(clocks: Sequence[RecordingClock], begins_s: Sequence[float]) -> RecordingClock:
    """The clock of a recording by those of its pieces.

    Args:
        begins_s: when each piece begins, since the recording began.
    """
    samples = np.array([c.samples for c in clocks], dtype=float)
    own = ("lateness_s", "lateness_std_s")
    late, std = (np.array([getattr(c, key) for c in clocks]) for key in own)
    told = np.isfinite(late) & np.isfinite(std)
    weight = np.maximum(std[told], 1e-6) ** -2.0  # of a lateness; no clock is better
    gains = np.array([c.velocity_gain for c in clocks])
    seen = np.isfinite(gains).any(axis=0)

    def moved(key: str) -> tuple[tuple[float, float], ...]:
        own = zip(clocks, begins_s, strict=True)
        return tuple((begin + t, length) for c, begin in own for t, length in getattr(c, key))

    def mean(values: Sequence[float]) -> float:
        return float(np.average(values, weights=samples))

    gain = np.full(gains.shape[1], np.nan)
    gain[seen] = np.nanmedian(gains[:, seen], axis=0)
    return RecordingClock(
        samples=int(samples.sum()),
        kept=sum(c.kept for c in clocks),
        span_s=begins_s[-1] + clocks[-1].span_s - begins_s[0],
        rate_hz=float(np.median([c.rate_hz for c in clocks])),
        jitter_s=float(np.sqrt(mean([c.jitter_s**2 for c in clocks]))),
        holes=moved("holes"),
        frozen=moved("frozen"),
        repeated=mean([c.repeated for c in clocks]),
        held={key: mean([c.held[key] for c in clocks]) for key in clocks[0].held},
        out_of_order=sum(c.out_of_order for c in clocks),
        not_finite=sum(c.not_finite for c in clocks),
        impossible=sum(c.impossible for c in clocks),
        lateness_s=float(np.average(late[told], weights=weight)) if told.any() else float("nan"),
        lateness_std_s=float(weight.sum() ** -0.5) if told.any() else float("nan"),
        velocity_gain=gain,
    )


def lateness(clock: RecordingClock) -> float:
    """How much later dq is than q, where that is known, s."""
    late, std = clock.lateness_s, clock.lateness_std_s
    return late if np.isfinite(late) and abs(late) > 3.0 * std else 0.0  # standard deviations


def check_timing(stamp_ns: Index, q: Array, dq: Array, tau: Array) -> RecordingClock:
    """Examine a recording's clock.

    Args:
        stamp_ns: (m,) ns as recorded; q, dq, tau: (m, n) rad, rad/s, N m.
    """
    m = len(stamp_ns)
    increasing = _increasing(stamp_ns)
    finite = increasing[_finite(q, dq, tau)[increasing]]
    sound = finite[possible(q[finite], dq[finite], tau[finite])]
    keep = _new(sound, q, dq, tau)
    steps_s = 1e-9 * np.diff(stamp_ns[increasing])
    period_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    since_s = 1e-9 * (stamp_ns - stamp_ns[increasing[0]]) if m else np.zeros(0)
    gaps = np.flatnonzero(steps_s > HOLE_PERIODS * period_s)
    regular = np.delete(steps_s, gaps)
    same = {name: _same(x) for name, x in (("q", q), ("dq", dq), ("tau", tau))}
    moving = np.any(np.nan_to_num(dq[1:]) != 0.0, axis=1)  # a simulated arm at rest repeats itself
    again = same["q"] & same["dq"] & same["tau"] & moving
    fresh = ~again & moving
    late_s, std_s, gain = _lateness(since_s[keep], q[keep], dq[keep], period_s)
    return RecordingClock(
        samples=m,
        kept=len(keep),
        span_s=float(since_s[keep[-1]] - since_s[keep[0]]) if len(keep) else 0.0,
        rate_hz=1.0 / period_s if period_s else 0.0,
        jitter_s=float(np.std(regular)) if len(regular) else 0.0,
        holes=tuple((float(since_s[increasing[k]]), float(steps_s[k])) for k in gaps),
        frozen=_runs(again & (np.abs(dq[1:]).max(axis=1) > 0.05), since_s),  # rad/s: it moves
        repeated=float(again.sum()) / max(m, 1),
        held={name: float((x & fresh).sum() / max(fresh.sum(), 1)) for name, x in same.items()},
        out_of_order=m - len(increasing),
        not_finite=int((~_finite(q, dq, tau)).sum()),
        impossible=len(finite) - len(sound),
        lateness_s=late_s,
        lateness_std_s=std_s,
        velocity_gain=gain,
    )


def uniform(stamp_ns: Index, q: Array, dq: Array, tau: Array) -> Index:
    """(k,) rows worth keeping: strictly increasing stamps, finite, none that repeats the last.

    The most rows whose stamps increase are kept, so a single stamp far ahead costs itself and
    not everything after it. Arguments as of `check_timing`.
    """
    rows = _increasing(stamp_ns)
    rows = rows[_finite(q, dq, tau)[rows]]
    return _new(rows[possible(q[rows], dq[rows], tau[rows])], q, dq, tau)


def _new(rows: Index, q: Array, dq: Array, tau: Array) -> Index:
    """Those rows that do not repeat the one before."""
    again = _same(q[rows]) & _same(dq[rows]) & _same(tau[rows])
    return rows[np.concatenate([[True], ~again])[: len(rows)]]


def unwrapped(q: Array, lower: Array, upper: Array) -> tuple[Array, NDArray[np.int64]]:
    """Positions (m, n) of joints that were told within one turn, going on; and which joints.

    Args:
        lower, upper: (n,) rad, limits; of all turns that one is taken which lies nearest to them.
    """
    step = np.nan_to_num(np.diff(q, axis=0))
    turns = np.where(np.abs(np.abs(step) - 2.0 * np.pi) < 0.5, np.sign(step), 0.0)  # so near a turn
    joints = np.flatnonzero(turns.any(axis=0))
    if not joints.size:
        return q, joints
    q = q.copy()
    q[1:] -= 2.0 * np.pi * np.cumsum(turns, axis=0)
    middle = np.nan_to_num(0.5 * (lower + upper))[joints]
    away = np.round((np.nanmedian(q[:, joints], axis=0) - middle) / (2.0 * np.pi))
    q[:, joints] -= 2.0 * np.pi * away
    return q, joints


def put_forward(stamp_ns: Index) -> tuple[Index, list[str]]:
    """Stamps (m,) of a clock that was put back on the way, with a pause there instead; a note.

    What comes back soon is out of order, see `uniform`: a clock that was put back stays so.
    """
    back = np.flatnonzero(np.diff(stamp_ns) < 0) + 1
    lengths = np.diff(np.concatenate([[0], back, [len(stamp_ns)]]))
    put = back[(lengths[:-1] >= FEWEST_COMPARED) & (lengths[1:] >= FEWEST_COMPARED)]
    if not len(put):
        return stamp_ns, []
    later = np.zeros_like(stamp_ns)
    later[put] = stamp_ns[put - 1] - stamp_ns[put] + round(1e9 * PUT_BACK_S)
    longest_s = 1e-9 * float(np.max(stamp_ns[put - 1] - stamp_ns[put]))
    said = f"The clock is put back {len(put)} times, by up to {longest_s:.3g} s: taken as pauses."
    return stamp_ns + np.cumsum(later), [said]


def _finite(*signals: Array) -> NDArray[np.bool_]:
    return np.all([np.isfinite(x).all(axis=1) for x in signals], axis=0)


def possible(q: Array, dq: Array, tau: Array) -> NDArray[np.bool_]:
    """(m,) whether an arm makes these readings (m, n), told before any filter smears them.

    See `unsaid`; and no reading stands alone far from those around it.
    """
    if len(tau) < FEWEST_COMPARED:
        return np.ones(len(tau), dtype=bool)
    good = ~unsaid(tau)
    for x in (q, dq, tau) if good.any() else ():
        apart = np.abs(x - median_filter(x, size=(5, 1), mode="nearest"))  # samples
        low, high = np.percentile(x[good], (1, 99), axis=0)
        usual = np.median(apart[good], axis=0)
        good &= (apart <= np.maximum(SPIKE_TIMES * usual, SPIKE_SHARE * (high - low))).all(axis=1)
    return good


def unsaid(tau: Array) -> NDArray[np.bool_]:
    """(m,) where torques (m, n) are all exactly zero while the arm holds its weight throughout.

    A second publisher shows them, and bursts of a driver that had nothing to say.
    """
    dead = (tau == 0.0).all(axis=1)
    if not dead.any() or dead.all():
        return np.zeros(len(tau), dtype=bool)
    holds = np.percentile(np.abs(tau[~dead]).max(axis=1), 10)
    return np.asarray(dead & (holds > 0.3))  # so zeros are none


def _same(x: Array) -> NDArray[np.bool_]:
    """(m - 1,) whether a row of x (m, n) equals the one before."""
    return np.asarray((x[1:] == x[:-1]).all(axis=1))


def _increasing(stamp_ns: Index) -> Index:
    """Rows of a longest strictly increasing part of the stamps."""
    if np.all(np.diff(stamp_ns) > 0):
        return np.arange(len(stamp_ns))
    ends: list[int] = []  # smallest last stamp of a part of each length
    rows: list[int] = []  # where it stands
    before = np.full(len(stamp_ns), -1)
    for row, stamp in enumerate(stamp_ns.tolist()):
        length = bisect_left(ends, stamp)
        before[row] = rows[length - 1] if length else -1
        if length == len(ends):
            ends.append(stamp)
            rows.append(row)
        else:
            ends[length], rows[length] = stamp, row
    chain = [rows[-1]]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def _runs(again: NDArray[np.bool_], since_s: Array) -> tuple[tuple[float, float], ...]:
    """(start, length) s of long runs of repeats."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], again, [False]]).astype(int)))
    runs = [(a, b) for a, b in edges.reshape(-1, 2).tolist() if b - a >= 10]  # a stuck source
    return tuple((float(since_s[a]), float(since_s[b] - since_s[a])) for a, b in runs)


def _lateness(t: Array, q: Array, dq: Array, period_s: float) -> tuple[float, float, Array]:
    """(lateness, its std, gain (n,)) of dq(t) = gain d/dt q(t - lateness).

    Both are brought to one even grid and through one low-pass, so that what the grid and the
    filter do, they do to both. Then dq = g dq' - g l ddq' + o per joint, with dq' and ddq' from q
    taken at t - (lateness so far); l corrects the lateness. Joints count by what their residual
    allows, blocks of time left out in turn give the standard deviation.
    """
    n = q.shape[1]
    nothing = (float("nan"), float("nan"), np.full(n, np.nan))
    if len(t) < FEWEST_COMPARED or not period_s:
        return nothing
    step_s = min(period_s, 0.01)
    grid = np.arange(t[0], t[-1], step_s)
    sos = butter(3, min(CUT_HZ, 0.1 / period_s), fs=1.0 / step_s, output="sos")
    if len(grid) * step_s < 1.0:
        return nothing
    # points of the grid, 10 ms apart, away from either end and from holes
    pick = np.arange(0, len(grid), max(1, round(0.01 / (grid[1] - grid[0]))))
    at = grid[pick]
    clear = (at > t[0] + 0.3) & (at < t[-1] - 0.3)
    for k in np.flatnonzero(np.diff(t) > max(HOLE_PERIODS * period_s, 0.02)):
        clear &= (at < t[k] - 0.2) | (at > t[k + 1] + 0.2)
    pick = pick[clear]
    if pick.size < FEWEST_COMPARED:
        return nothing
    table = np.column_stack([np.interp(grid, t, x) for x in np.concatenate([q, dq], axis=1).T])
    smooth = sosfiltfilt(sos, table, axis=0)
    rate = np.gradient(smooth[:, :n], step_s, axis=0)
    late_s, found = 0.0, nothing
    for _ in range(3):  # each repeats the linearised fit about the last one
        moved = np.column_stack([np.interp(grid - late_s, grid, x) for x in rate.T])
        change, std_s, gain = _fit(moved, smooth[:, n:], step_s, pick)
        if not np.isfinite(change):
            return (*nothing[:2], gain)
        late_s += float(np.clip(change, -0.05, 0.05))
        found = (late_s, std_s, gain)
    return found


def _fit(rate: Array, dq: Array, step_s: float, pick: Index) -> tuple[float, float, Array]:
    """(lateness, its std, gain (n,)) of dq against the rate of q, both (m, n), at rows `pick`."""
    accel = np.gradient(rate, step_s, axis=0)
    x = np.stack([rate, accel, np.ones_like(rate)], axis=2)[pick]
    y = dq[pick]
    blocks = np.array_split(np.arange(len(pick)), BLOCKS)
    xx = np.array([np.einsum("tji,tjk->jik", x[b], x[b]) for b in blocks])
    xy = np.array([np.einsum("tji,tj->ji", x[b], y[b]) for b in blocks])
    moves = np.std(rate[pick], axis=0) > 0.02  # rad/s; slower is noise
    gain = np.where(moves, 0.0, np.nan)
    moves &= np.std(y, axis=0) > 0.0
    if not moves.any():
        return float("nan"), float("nan"), gain
    xx, xy = xx[:, moves], xy[:, moves]
    best = _solve(xx.sum(axis=0), xy.sum(axis=0))
    gain[moves] = best[:, 0]
    spread = np.std(y[:, moves] - np.einsum("tji,ji->tj", x[:, moves], best), axis=0)
    # information on the lateness: accelerations against the residual
    size = np.abs(best[:, 0]) * np.std(accel[pick][:, moves], axis=0)
    weight = (size / np.maximum(spread, 1e-6)) ** 2

    def common(coefficients: Array) -> float:
        return float(np.average(-coefficients[:, 1] / coefficients[:, 0], weights=weight))

    total = xx.sum(axis=0), xy.sum(axis=0)
    without = [common(_solve(total[0] - a, total[1] - b)) for a, b in zip(xx, xy, strict=True)]
    std = float(np.sqrt((BLOCKS - 1) * np.var(without)))
    return common(best), std, gain


def _solve(xx: Array, xy: Array) -> Array:
    """Coefficients (n, 3) of normal equations (n, 3, 3), (n, 3); a trace of ridge for rest."""
    ridge = 1e-9 * np.trace(xx, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-15 * np.eye(3)
    return np.asarray(np.linalg.solve(xx + ridge, xy[..., None])[..., 0])


def source_stamps(stamp_ns: Index, q: Array, dq: Array) -> Index:
    """Stamps (m,) ns of the states of a slower source that a faster, regular publisher shows.

    A publisher at 30 Hz that shows the newest state of a source at 29.4 Hz stamps states that are
    up to a period old, and every so often shows one twice. Its stamps are even, and the motion
    between them is not: after a repeat the arm went as far in two periods as in one. The states
    themselves are even, so they are numbered and spread over the time of the stamps. A repeat that
    stands for a lost packet looks the same until the motion is asked: there the arm went on. Where
    the motion agrees with the given stamps, these are returned.

    Args:
        stamp_ns: (m,) ns, strictly increasing, of samples of which none repeats the last.
        q, dq: (m, n) rad, rad/s.
    """
    steps_s = 1e-9 * np.diff(stamp_ns)
    if len(steps_s) < FEWEST_SLIPS:
        return stamp_ns
    period_s = float(np.median(steps_s))
    went, speed = np.diff(q, axis=0), 0.5 * (dq[1:] + dq[:-1])
    size = np.sum(speed**2, axis=1)
    told = size > FASTEST**2 * size.max()
    took_s = np.sum(went * speed, axis=1)[told] / size[told]
    slips = np.flatnonzero(told)[took_s < steps_s[told] - SLIP_PERIODS * period_s]
    # what moves too little to be told from slips between is as the stamps say
    slips = slips[steps_s[slips] > (1.0 + SLIP_PERIODS) * period_s]
    if len(slips) < FEWEST_SLIPS:
        return stamp_ns
    ticks = np.maximum(np.round(steps_s / period_s), 1.0)
    ticks[slips] = np.maximum(ticks[slips] - 1.0, 1.0)
    numbers = np.concatenate([[0.0], np.cumsum(ticks)])
    span_ns = float(stamp_ns[-1] - stamp_ns[0])
    even = stamp_ns[0] + np.round(numbers * (span_ns / numbers[-1])).astype(np.int64)
    apart = (went - 1e-9 * np.diff(x)[:, None] * speed for x in (stamp_ns, even))
    before, after = (float(np.sum(x**2)) for x in apart)
    return even if after < BETTER * before else stamp_ns
