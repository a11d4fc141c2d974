"""A recording that is too long to be held at once: read in pieces, searched in a few stretches.

It is gone through twice. The first time each piece is cleaned and told by what moves in it, so
that stretches can be chosen that are spread over the whole time and move most differently. The
second time splines go through it, piece by piece, and the smooth motion waits in a file at the
rate of the models. What a search needs rows for takes the stretches; what adds up takes all.

Pieces overlap by so much that a spline's inner rows are those of one spline through everything.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from adapter.effects.base import ArmDynamics, Motion
from adapter.gap.signals import (
    DECIMATION,
    EDGE_S,
    KNOT_S,
    LEAST_S,
    RATE_HZ,
    TAPS,
    Recorded,
    Signals,
    Smoothness,
    Splines,
    bands_of,
    heard_in,
    low,
    on_grid,
    smoothness_of,
    together,
)
from adapter.model.spatial import Array
from adapter.screening.rows import stuck
from adapter.screening.screen import RecordingFault, RecordingRefused, at_source
from adapter.screening.timing import RecordingClock, check_timing, joined, lateness, uniform
from adapter.signals.source_clock import source_stamps
from drivers.files.mcap import Log
from drivers.files.rows import RowsFile

LONG_S = 60.0  # what is longer is searched in stretches
PIECE_S = 30.0  # of a recording that is worked on at once
FEWEST, FIRST = 1000, 4096  # samples of a piece; by which the usual step is told
AHEAD = 200  # samples behind a piece that are looked at: is the last stamp one far ahead?
OVERLAP_S = 2.0  # by which splines reach over a piece; their memory is some 0.1 s
HOLE_S = 0.5  # without samples: nobody knows how the arm moved, the motion is cut there
STRETCH_S, STRETCHES = 5.0, 6  # of a search: length, and how many
MOST_WINDOWS = 1500  # that stretches are chosen among
EVERY_S = 0.02  # samples by which a window is told
WHOLE_SHARE = 0.8  # of the samples that a window should have
SCREENED_S = 40.0  # in one piece, where most moves: units, signs and order are judged there
SCORED_EDGE_S = 0.3  # around a stretch, see `signals.validation`
TRIM = 20  # samples of the band (0.8 s) at either end, in which filters settle
APART = 2 * TRIM + TAPS // DECIMATION + 1  # samples between stretches that share no motion

Span = tuple[float, float]  # s since the first sample


@dataclass(frozen=True, eq=False)
class Survey:
    """What a first look at a recording tells.

    Attributes:
        begin_ns: stamp of its first sample; end_s: of the last, since then.
        clock: of all pieces.
        pieces: (p, 2) s, first and last sample of each.
        windows: (w, 2) s; rows: (w, 2) of the recording, where they begin and end.
        moments: (w, f, f) mean products of one, positions and velocities in them; nan in those
            that lack samples.
    """

    begin_ns: int
    end_s: float
    clock: RecordingClock
    pieces: Array
    windows: Array
    rows: np.ndarray
    moments: Array

    def spread(self, span: Span, count: int = STRETCHES) -> list[Span]:
        """Windows of a time that move most and most differently, one in each part of it."""
        inside = (self.windows[:, 0] >= span[0]) & (self.windows[:, 1] <= span[1])
        usable = np.flatnonzero(inside & np.isfinite(self.moments[:, 0, 0]))
        if not len(usable):
            return []
        scale = np.sqrt(np.diagonal(self.moments[usable].mean(axis=0)))
        M = self.moments[usable] / np.maximum(np.outer(scale, scale), 1e-12)
        known, chosen = 1e-3 * np.eye(len(scale)), []
        parts = np.array_split(np.arange(len(usable)), count)
        for part in (parts[0], parts[-1], *parts[1:-1]):  # what changes shows at both ends best
            if len(part):
                best = part[int(np.argmax(np.linalg.slogdet(known + M[part])[1]))]
                known = known + M[best]
                chosen.append(int(usable[best]))
        return [(float(a), float(b)) for a, b in self.windows[sorted(set(chosen))]]

    def busiest(self, seconds: float, end_s: float | None = None) -> tuple[int, int]:
        """Rows of so many seconds, in one and before an end, in which joints move most."""
        n = (self.moments.shape[1] - 1) // 2
        speed = np.nan_to_num(np.diagonal(self.moments, axis1=1, axis2=2)[:, 1 + n :])
        moved = np.sqrt(speed / np.maximum(speed.max(axis=0), 1e-12)).sum(axis=1)
        step = float(np.median(np.diff(self.windows[:, 0]))) if len(moved) > 1 else STRETCH_S
        moved = moved[self.windows[:, 1] <= (self.end_s if end_s is None else end_s)]
        count = min(max(int(seconds / step), 1), len(moved))
        sums = np.convolve(moved, np.ones(count), "valid")
        begin = int(self.rows[int(np.argmax(sums)), 0])
        return begin, begin + round(seconds / self.clock.period_s)


class Run(NamedTuple):
    """Smooth motion without a hole.

    Attributes:
        begin_s: of its first row; first: row in the file; length: rows.
    """

    begin_s: float
    first: int
    length: int

    @property
    def samples(self) -> int:
        """Samples of the band in it, trimmed at its ends."""
        return (self.length - TAPS) // DECIMATION + 1 - 2 * TRIM

    def t(self, sample: int) -> float:
        """When a sample of the band is, s."""
        return self.begin_s + (TAPS // 2 + DECIMATION * (TRIM + sample)) / RATE_HZ

    def sample(self, t: float) -> int:
        """The first sample from an instant on."""
        return int(np.ceil((t - self.t(0)) * RATE_HZ / DECIMATION - 1e-6))

    def rows(self, begin: int, end: int) -> tuple[int, int]:
        """Rows in the file that samples from one to before another need."""
        stop = DECIMATION * (end - 1 + 2 * TRIM) + TAPS
        return self.first + DECIMATION * begin, self.first + stop


@dataclass(frozen=True, eq=False)
class LongRecording:
    """A recording of any length, clean and smooth.

    Attributes:
        log: with the joints of the model.
        survey: of it; span: the time that is used, s.
        smoothness: of the splines; dq_late_s: how much later dq is than q.
        table: [q, dq, ddq, tau, where tau was measured] at 250 Hz; runs: without holes in it.
    """

    log: Log
    survey: Survey
    span: Span
    smoothness: Smoothness
    dq_late_s: float
    table: RowsFile
    runs: tuple[Run, ...]

    @property
    def seconds(self) -> float:
        """How much of it there is."""
        return sum(max(run.samples, 0) for run in self.runs) * DECIMATION / RATE_HZ

    def signals(self, spans: Sequence[Span], arm: ArmDynamics) -> Signals:
        """Some stretches of it, as the search sees a recording."""
        noise = 2.0 * self.survey.clock.period_s * self.smoothness.dq_noise**2
        parts = []
        for run, begin, end in self._samples(spans):
            motion, tau, known = self._motion(run.rows(begin, end), run, arm)
            motion = replace(motion, bands_hz=bands_of(motion, noise))
            parts.append(_banded(motion, tau, known, noise))
        return together(parts)

    def pieces(self, like: Signals, before: int) -> Iterator[Signals]:
        """All of it, piece by piece; each begins so many samples before what is its own.

        Args:
            like: whose arm and bands these have.
        """
        size = round(PIECE_S * RATE_HZ / DECIMATION)
        for run in self.runs:
            last = min(run.samples, run.sample(self.span[1]))
            for begin in range(max(before, run.sample(self.span[0])), last, size):
                end = min(begin + size, last)
                rows = run.rows(begin - before, end)
                motion, tau, known = self._motion(rows, run, like.motion.arm)
                motion = replace(motion, bands_hz=like.motion.bands_hz)
                yield _banded(motion, tau, known, like.noise)

    def recorded(self, spans: Sequence[Span], name: str) -> Recorded:
        """Samples of some stretches, as they were recorded."""
        spans = self.near(spans)
        parts = [self.samples(begin - SCORED_EDGE_S, end + SCORED_EDGE_S) for begin, end in spans]
        begins = np.cumsum([0, *(len(x.t) for x in parts[:-1])])
        t, q, dq, tau = (np.concatenate([getattr(x, k) for x in parts]) for k in _RAW)
        own = replace(parts[0], name=name, t=t, q=q, dq=dq, tau=tau, whole=self)
        own = replace(own, begins=tuple(map(int, begins)), spans=tuple(spans))
        if any(x.commands is None for x in parts):
            return own
        at, commands = (np.concatenate([getattr(x, k) for x in parts]) for k in _COMMANDS)
        _, first = np.unique(at, return_index=True)
        return replace(own, command_t=at[first], commands=commands[first])

    def near(self, spans: Sequence[Span]) -> list[Span]:
        """Stretches as they are in the motion: cut at its holes, those that touch in one."""
        return [(run.t(a), run.t(b - 1)) for run, a, b in self._samples(spans)]

    def _samples(self, spans: Sequence[Span]) -> list[tuple[Run, int, int]]:
        """Run and samples of stretches; those too near one another to be two are one."""
        out: list[tuple[Run, int, int]] = []
        for begin, end in sorted(spans):
            run = max(self.runs, key=lambda r: min(r.t(r.samples), end) - max(r.t(0), begin))
            a = max(run.sample(max(begin, self.span[0])), 0)
            b = min(run.sample(min(end, self.span[1])), run.samples)
            if b - a < LEAST_SAMPLES:
                continue
            if out and out[-1][0] is run and a - out[-1][2] < APART:
                out[-1] = run, out[-1][1], max(b, out[-1][2])
            else:
                out.append((run, a, b))
        return out

    def _motion(
        self, rows: tuple[int, int], run: Run, arm: ArmDynamics
    ) -> tuple[Motion, Array, Array]:
        """Of rows in the file, with their torque and where it was measured."""
        parts = np.split(self.table.rows(*rows), 5, axis=1)
        q, dq, ddq, tau, known = map(np.ascontiguousarray, parts)
        t = run.begin_s + np.arange(rows[0] - run.first, rows[1] - run.first) / RATE_HZ
        return Motion(t, q, dq, ddq, arm), tau, known

    def samples(self, begin_s: float, end_s: float) -> Recorded:
        """Samples of a time, as they were recorded."""
        parts = []
        for k, (first, last) in enumerate(self.survey.pieces):
            if last >= begin_s and first <= end_s:
                parts.append(_piece(self.log, k))
        whole = [Recorded.of(x, self.dq_late_s, self.survey.begin_ns) for x in parts]
        t = np.concatenate([x.t for x in whole])
        rows = np.flatnonzero((t >= begin_s) & (t <= end_s) & np.append(True, np.diff(t) > 0))
        t, q, dq, tau = (np.concatenate([getattr(x, k) for x in whole])[rows] for k in _RAW)
        own = replace(whole[0], t=t, q=q, dq=dq, tau=tau)
        if any(x.commands is None for x in whole):
            return replace(own, command_t=None, commands=None)
        at, commands = (np.concatenate([getattr(x, k) for x in whole]) for k in _COMMANDS)
        inside = (at >= begin_s - HOLE_S) & (at <= end_s + HOLE_S)
        return replace(own, command_t=at[inside], commands=commands[inside])


LEAST_SAMPLES = round(LEAST_S * RATE_HZ / DECIMATION)
_RAW = ("t", "q", "dq", "tau")
_COMMANDS = "command_t", "commands"


def _banded(motion: Motion, tau: Array, known: Array, noise: Array) -> Signals:
    """A stretch in the band, trimmed; its torque and where that was measured (m, n) at 250 Hz."""
    t = motion.t[TAPS // 2 : -(TAPS // 2) : DECIMATION][TRIM:-TRIM]
    own, heard = (x[TRIM:-TRIM] for x in (low(tau), heard_in(known)))
    return Signals(motion, noise, own, t, heard, trim=TRIM)


def is_long(log: Log) -> bool:
    """Whether a recording is searched in stretches: by its samples, for one stamp may be wrong."""
    if len(log) < FEWEST or 1e-9 * (log.end_ns - log.begin_ns) <= LONG_S:
        return False
    return len(log) * _step_s(log) > LONG_S


def surveyed(log: Log) -> Survey:
    """A first look at a recording with the joints of its model.

    Raises:
        RecordingRefused: no sample of it is usable.
    """
    clocks: list[RecordingClock] = []
    pieces: list[Span] = []
    begin_ns, end_ns = _ends(log)
    windows = _Windows(1e-9 * (end_ns - begin_ns), len(log.joint_names))
    for k in range(_count(log)):
        raw, rows = _read(log, k)
        clock = check_timing(raw.stamp_ns, raw.q, raw.dq, raw.tau)
        if not len(rows):
            continue
        own = raw.take(rows)
        own, clock, _ = at_source(own, clock)
        t = 1e-9 * (own.stamp_ns - begin_ns).astype(np.float64)
        clocks.append(clock)
        pieces.append((float(t[0]), float(t[-1])))
        windows.take(t, own, rows + k * _size(log), clock.period_s)
    begins = [first for first, _ in pieces]
    table, rows, moments = windows.told()
    return Survey(
        begin_ns, pieces[-1][1], joined(clocks, begins), np.array(pieces), table, rows, moments
    )


class _Windows:
    """Windows of a recording and what moves in them."""

    def __init__(self, seconds: float, n: int) -> None:
        self.every = max(STRETCH_S, seconds / MOST_WINDOWS)
        count = max(int(seconds / self.every), 1)
        self.moments = np.zeros((count, 2 * n + 1, 2 * n + 1))
        self.seen = np.zeros(count)
        self.rows = np.full((count, 2), -1)
        self.first = np.full(count, np.inf)
        self.last = np.full(count, -np.inf)

    def take(self, t: Array, log: Log, rows: np.ndarray, period_s: float) -> None:
        """Take a piece: t (m,) s, and which rows of the whole its samples are."""
        place = (t // self.every).astype(int)
        inside = (place >= 0) & (place < len(self.seen)) & (t - place * self.every < STRETCH_S)
        step = max(round(EVERY_S / period_s), 1)
        for w in np.unique(place[inside]):
            own = np.flatnonzero(inside & (place == w))
            some = own[::step]
            signals = np.column_stack([np.ones(len(some)), log.q[some], log.dq[some]])
            self.moments[w] += signals.T @ signals
            self.seen[w] += len(some) * step * period_s
            self.first[w] = min(self.first[w], t[own[0]])
            self.last[w] = max(self.last[w], t[own[-1]])
            self.rows[w] = (
                rows[own[0]] if self.rows[w, 0] < 0 else self.rows[w, 0],
                rows[own[-1]] + 1,
            )

    def told(self) -> tuple[Array, np.ndarray, Array]:
        """Windows (w, 2) s, their rows (w, 2) and moments (w, f, f), of those that have any."""
        there = self.rows[:, 0] >= 0
        counts = np.maximum(self.moments[:, :1, :1], 1.0)
        moments = self.moments / counts
        moments[self.seen < WHOLE_SHARE * self.seen.max()] = np.nan
        begin = self.every * np.arange(len(self.seen))
        windows = np.column_stack([begin, begin + STRETCH_S])
        return windows[there], self.rows[there], moments[there]


def _step_s(log: Log) -> float:
    """The usual step between stamps."""
    steps = np.diff(log.piece(0, FIRST).stamp_ns)
    return 1e-9 * float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _size(log: Log) -> int:
    """Samples of a piece."""
    return max(round(PIECE_S / _step_s(log)), FEWEST)


def _count(log: Log) -> int:
    return int(np.ceil(len(log) / _size(log)))


def _ends(log: Log) -> tuple[int, int]:
    """The first usable stamp and the last, ns. Raises RecordingRefused."""
    kept = (raw.stamp_ns[rows] for raw, rows in (_read(log, k) for k in range(_count(log))))
    first = next((x for x in kept if len(x)), None)
    back = (_read(log, k) for k in reversed(range(_count(log))))
    last = next((raw.stamp_ns[rows] for raw, rows in back if len(rows)), None)
    if first is None or last is None:
        raise RecordingRefused(
            RecordingFault.DATA, f"{log.path}: none of its {len(log)} samples is usable"
        )
    return int(first[0]), int(last[-1])


def _read(log: Log, k: int) -> tuple[Log, np.ndarray]:
    """The k-th piece as it is, and its rows worth keeping."""
    start, size = k * _size(log), _size(log)
    seen = log.piece(start, start + size + AHEAD)
    rows = uniform(seen.stamp_ns, seen.q, seen.dq, seen.tau)
    return seen.piece(0, size), rows[rows < size]


def _piece(log: Log, k: int) -> Log:
    """The usable samples of the k-th piece."""
    raw, rows = _read(log, k)
    own = raw.take(rows)
    return replace(own, stamp_ns=source_stamps(own.stamp_ns, own.q, own.dq))


def _pieces(log: Log, survey: Survey) -> Iterator[tuple[Array, Array, Array, Array]]:
    """t, q, dq, tau of usable samples, in order."""
    last = -np.inf
    for k in range(_count(log)):
        own = _piece(log, k)
        if not len(own):
            continue
        t = 1e-9 * (own.stamp_ns - survey.begin_ns).astype(np.float64)
        kept = t > last
        if kept.any():
            last = float(t[-1])
            yield t[kept], own.q[kept], own.dq[kept], own.tau[kept]


class _Smoother:
    """Splines through pieces that overlap, into a table.

    Args:
        smoothness: of all; dq_late_s: how much later dq is than q; n: joints.
    """

    def __init__(self, smoothness: Smoothness, dq_late_s: float, n: int) -> None:
        self.smoothness, self.late = smoothness, dq_late_s
        self.table = RowsFile(5 * n)
        self.runs: list[Run] = []
        self._kept: list[tuple[Array, ...]] = []
        self._begin, self._done, self._first = 0.0, 0, 0

    def take(self, rows: tuple[Array, ...]) -> None:
        """Take samples that follow."""
        t = rows[0]
        before = self._kept[-1][0][-1] if self._kept else t[0]
        holes = np.flatnonzero(np.diff(t, prepend=before) > HOLE_S).tolist()
        for a, b in pairwise(sorted({0, *holes, len(t)})):
            if a in holes:
                self.finish()
            self._add(tuple(x[a:b] for x in rows))

    def _add(self, rows: tuple[Array, ...]) -> None:
        if not self._kept:
            self._begin, self._done, self._first = float(rows[0][0]), 0, len(self.table)
        self._kept.append(rows)
        while self._kept[-1][0][-1] > self._next() + PIECE_S + OVERLAP_S:
            self._smooth(self._next() + PIECE_S)

    def _next(self) -> float:
        """The next instant that is to be told, s."""
        return self._begin + EDGE_S + self._done / RATE_HZ

    def finish(self) -> None:
        """Tell what is left of a run."""
        if self._kept:
            end = self._kept[-1][0][-1]
            if end - self._begin > LEAST_S:
                self._smooth(end - EDGE_S)
            count = len(self.table) - self._first
            run = Run(self._begin + EDGE_S, self._first, count)
            if run.samples > 0:
                self.runs.append(run)
            self._kept = []

    def _smooth(self, end_s: float) -> None:
        """Tell all instants before one."""
        t, q, dq, tau = (np.concatenate(x) for x in zip(*self._kept, strict=True))
        reach = self._next() - OVERLAP_S
        used = slice(int(np.searchsorted(t, reach)), int(np.searchsorted(t, end_s + OVERLAP_S)))
        part = t[used]
        knots = np.arange(
            int(np.floor((part[0] - self._begin) / KNOT_S)),
            int(np.ceil((part[-1] - self._begin) / KNOT_S)) + 1,
        )
        inner = self._begin + KNOT_S * knots.astype(np.float64)
        splines = Splines.through(part, q[used], dq[used], self.late, inner)
        count = int(np.ceil((end_s - self._next()) * RATE_HZ - 1e-9))
        grid = self._begin + EDGE_S + (self._done + np.arange(count)) / RATE_HZ
        told = splines.smoothed(self.smoothness).at(grid)
        known = ~stuck(part, dq[used], tau[used])
        torque = (on_grid(grid, part, x) for x in (tau[used], known.astype(float)))
        self.table.append(np.column_stack([*told, *torque]))
        self._done += count
        keep = int(np.searchsorted(t, self._next() - OVERLAP_S))
        self._kept = [tuple(x[keep:] for x in (t, q, dq, tau))]


def long_recording(log: Log, survey: Survey) -> LongRecording:
    """Smooth a recording.

    Args:
        log: with the joints of the model; survey: of it.
    """
    late, span = lateness(survey.clock), (0.0, survey.end_s)
    nothing = Smoothness(np.zeros(0), np.zeros(0), np.zeros(0))
    raw = LongRecording(log, survey, span, nothing, late, RowsFile(1), ())
    probes = [raw.samples(*x) for x in survey.spread(span)]
    smoothness = smoothness_of([Splines.through(x.t, x.q, x.dq, late) for x in probes])
    smoother = _Smoother(smoothness, late, len(log.joint_names))
    for rows in _pieces(log, survey):
        smoother.take(rows)
    smoother.finish()
    return replace(raw, smoothness=smoothness, table=smoother.table, runs=tuple(smoother.runs))
