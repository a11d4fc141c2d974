"""A recording that is too long to be held at once: read in pieces, searched in a few stretches.

It is gone through twice. The first time each piece is cleaned, and windows are told by what moves
in them, so that stretches can be chosen that are spread over the whole time and move most
differently. The second time splines go through it, piece by piece, and the smooth motion waits in
a file at the rate of the models. What a search needs rows for takes the stretches; what adds up
takes all.

Pieces overlap by so much that a spline's inner rows are those of one spline through everything.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

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
    in_band,
    on_grid,
    smoothness_of,
    together,
)
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.screening.screen import RecordingFault, RecordingRefused, at_source, of_this_robot
from adapter.screening.timing import RecordingClock, check_timing, joined, lateness, uniform
from drivers.files.mcap import Log, mapped
from drivers.files.rows import RowsFile, stretches

LONG_S = 60.0  # what is longer is searched in stretches
PIECE_S = 30.0  # of a recording that is worked on at once
FEWEST, FIRST = 1000, 4096  # samples of a piece; by which the usual step is told
OVERLAP_S = 2.0  # by which splines reach over a piece; their memory is some 0.1 s
HOLE_S = 0.5  # without samples: nobody knows how the arm moved, the motion is cut there
STRETCH_S, STRETCHES = 5.0, 6  # of a search: length, and how many
SCREENED_S = 40.0  # in one piece, where most moves: units, signs and order are judged there
TRIM = 20  # samples of the band (0.8 s) at either end, in which filters settle
APART = 2 * TRIM + TAPS // DECIMATION + 1  # samples between stretches that share no motion

Span = tuple[float, float]  # s since the first sample


def is_long(log: Log) -> bool:
    """Whether a recording is searched in stretches: by its samples, for one stamp may be wrong."""
    if len(log) < FEWEST or 1e-9 * (log.end_ns - log.begin_ns) <= LONG_S:
        return False
    return len(log) * _step_s(log) > LONG_S


def _step_s(log: Log) -> float:
    """The usual step between stamps."""
    steps = np.diff(log.piece(0, FIRST).stamp_ns)
    return 1e-9 * float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _usable(log: Log, clocks: list[tuple[int, RecordingClock]]) -> Iterator[Log]:
    """Usable samples in order, piece by piece; `clocks` gets each one's first stamp and clock."""
    size, last = max(round(PIECE_S / _step_s(log)), FEWEST), -np.inf
    for start in range(0, len(log), size):
        seen = log.piece(start, start + size + 200)  # is the last stamp one far ahead?
        rows, raw = uniform(seen.stamp_ns, seen.q, seen.dq, seen.tau), seen.piece(0, size)
        own = raw.take(rows[rows < size])
        if len(own):
            clock = check_timing(raw.stamp_ns, raw.q, raw.dq, raw.tau)
            own, clock, _ = at_source(own, clock)
            own = own.take(own.stamp_ns > last)
        if len(own):
            clocks.append((own.first_ns, clock))
            last = own.end_ns
            yield own


@dataclass(frozen=True, eq=False)
class Survey:
    """What a first look at a long recording tells.

    Attributes:
        log: its usable samples.
        clock: of the recording as it was.
        begins: (w,) s since the first sample, of windows of `STRETCH_S`.
        moments: (w, f, f) mean products of one, positions and velocities in them; nan in those
            that lack samples.
    """

    log: Log
    clock: RecordingClock
    begins: Array
    moments: Array

    @classmethod
    def of(cls, log: Log) -> Survey:
        """Of a recording with the joints of its model.

        Raises:
            RecordingRefused: no sample of it is usable.
        """
        clocks: list[tuple[int, RecordingClock]] = []
        own = replace(mapped(log, _usable(log, clocks)), commands=log.commands)
        if not clocks:
            said = f"{log.path}: none of its {len(log)} samples is usable"
            raise RecordingRefused(RecordingFault.DATA, said)
        begins_s = [1e-9 * (stamp - own.first_ns) for stamp, _ in clocks]
        clock = joined([clock for _, clock in clocks], begins_s)
        bare = cls(own, clock, np.zeros(0), np.zeros(0))
        every = max(STRETCH_S, bare.end_s / 1500)  # among so many stretches are chosen
        step = max(round(0.02 * clock.rate_hz), 1)  # samples by which a window is told
        told = []
        for begin in every * np.arange(max(int(bare.end_s / every), 1)):
            some = own.piece(*bare.rows(begin, begin + STRETCH_S - 1e-9))
            signals = np.column_stack([np.ones(len(some)), some.q, some.dq])[::step]
            if len(signals):
                told.append((begin, len(signals), signals.T @ signals / len(signals)))
        begins, counts, moments = (np.array(x) for x in zip(*told, strict=True))
        moments[counts < 0.8 * counts.max()] = np.nan  # of the samples that a window should have
        return replace(bare, begins=begins, moments=moments)

    @property
    def end_s(self) -> float:
        """When the last sample is."""
        return 1e-9 * (int(self.log.stamp_ns[-1]) - self.log.first_ns)

    def rows(self, begin_s: float, end_s: float) -> tuple[int, int]:
        """Rows of the samples from one time to another, which counts as well."""
        begin, end = (self.log.first_ns + round(1e9 * t) for t in (begin_s, end_s))
        first, last = np.searchsorted(self.log.stamp_ns, (begin, end + 1)).tolist()
        return first, last

    def recorded(self, first: int, last: int) -> Recorded:
        """Some rows of the samples."""
        return Recorded.of(self.log.piece(first, last), lateness(self.clock), self.log.first_ns)

    def spread(self, span: Span) -> list[Span]:
        """Windows of a time that move most and most differently, one in each part of it."""
        inside = (self.begins >= span[0]) & (self.begins + STRETCH_S <= span[1])
        usable = np.flatnonzero(inside & np.isfinite(self.moments[:, 0, 0]))
        if not len(usable):
            return [span]
        scale = np.sqrt(np.diagonal(self.moments[usable].mean(axis=0)))
        M = self.moments[usable] / np.maximum(np.outer(scale, scale), 1e-12)
        known, chosen = 1e-3 * np.eye(len(scale)), []
        parts = np.array_split(np.arange(len(usable)), STRETCHES)
        for part in (parts[0], parts[-1], *parts[1:-1]):  # what changes shows at both ends best
            if len(part):
                best = part[int(np.argmax(np.linalg.slogdet(known + M[part])[1]))]
                known = known + M[best]
                chosen.append(float(self.begins[usable[best]]))
        return [(begin, begin + STRETCH_S) for begin in sorted(chosen)]

    def busiest(self, log: Log, end_s: float | None = None) -> Log:
        """The part in one piece in which joints move most.

        Args:
            log: the recording as it was read; end_s: the part lies before it.
        """
        n = len(self.log.joint_names)
        speed = np.nan_to_num(np.diagonal(self.moments, axis1=1, axis2=2)[:, 1 + n :])
        moved = np.sqrt(speed / np.maximum(speed.max(axis=0), 1e-12)).sum(axis=1)
        step = float(np.median(np.diff(self.begins))) if len(moved) > 1 else STRETCH_S
        moved = moved[self.begins + STRETCH_S <= (self.end_s if end_s is None else end_s)]
        count = min(max(int(SCREENED_S / step), 1), len(moved))
        begin_s = self.begins[int(np.argmax(np.convolve(moved, np.ones(count), "valid")))]
        stamp = self.log.stamp_ns[self.rows(begin_s, begin_s)[0]]
        off = np.concatenate([np.abs(x - stamp) for x in stretches(log.stamp_ns)])
        begin = int(np.argmin(off))
        return log.piece(begin, begin + round(SCREENED_S / self.clock.period_s))


def part_of(log: Log, model: SelfModel, end_s: float | None = None) -> Log:
    """Of a long recording the part in one piece in which most moves; a short one whole.

    Args:
        model: of the arm; end_s: the part lies before it, s.

    Raises:
        RecordingRefused: of another robot.
    """
    if is_long(log):
        return Survey.of(of_this_robot(log, model)).busiest(log, end_s)
    if end_s is None:
        return log
    return log.take(log.stamp_ns < log.first_ns + round(1e9 * end_s))


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


@dataclass(frozen=True, eq=False, kw_only=True)
class LongRecording(Recorded):
    """A recording of any length, smooth; in memory are some stretches of it.

    Attributes:
        survey: of it.
        smoothness: of the splines.
        table: [q, dq, ddq, tau, where tau was measured] at 250 Hz; runs: without holes in it.
        span: the time that is used, s; spans: the stretches, cut at holes.
    """

    survey: Survey
    smoothness: Smoothness
    table: RowsFile
    runs: tuple[Run, ...]
    span: Span
    spans: tuple[Span, ...] = ()

    @classmethod
    def through(cls, survey: Survey, name: str) -> LongRecording:
        """Smooth a recording, and take stretches that are spread over it."""
        span = 0.0, survey.end_s
        probes = [survey.recorded(*survey.rows(*x)) for x in survey.spread(span)]
        smoothness = smoothness_of([Splines.through(x.t, x.q, x.dq, x.dq_late_s) for x in probes])
        table, runs = _smooth(survey, smoothness)
        none = survey.recorded(0, 0)
        signals = name, none.t, none.q, none.dq, none.tau, None, None, none.dq_late_s
        return cls(
            *signals, survey=survey, smoothness=smoothness, table=table, runs=runs, span=span
        ).between(*span)

    @property
    def end_s(self) -> float:
        """When what is used of it ends."""
        return self.span[1]

    @property
    def seconds(self) -> float:
        """How much of it is in memory."""
        return sum(b - a for a, b in self.spans)

    def between(self, begin_s: float, end_s: float) -> LongRecording:
        """The same in a part of its time alone."""
        own = replace(self, span=(max(begin_s, self.span[0]), min(end_s, self.span[1])))
        return own.taking(self.survey.spread(own.span))

    def taking(self, spans: Sequence[Span]) -> LongRecording:
        """With these stretches; those that touch are one."""
        spans = [(run.t(a), run.t(b - 1)) for run, a, b in self._samples(spans)]
        edge, survey = 0.3, self.survey  # around a stretch, see `signals.validation`
        parts = [survey.recorded(*survey.rows(a - edge, b + edge)) for a, b in spans]
        begins = np.cumsum([0, *(len(x.t) for x in parts[:-1])])
        t, q, dq, tau = (
            np.concatenate([getattr(x, k) for x in parts]) for k in ("t", "q", "dq", "tau")
        )
        own = replace(self, t=t, q=q, dq=dq, tau=tau, spans=tuple(spans))
        own = replace(own, begins=tuple(begins.tolist()))
        if any(x.commands is None for x in parts):
            return replace(own, command_t=None, commands=None)
        at = np.concatenate([x.command_t for x in parts])
        commands = np.concatenate([x.commands for x in parts])
        _, first = np.unique(at, return_index=True)
        return replace(own, command_t=at[first], commands=commands[first])

    def signals(self, arm: ArmDynamics) -> Signals:
        """The stretches as the search sees a recording."""
        return together([self._part(*x, arm) for x in self._samples(self.spans)])

    def pieces(self, like: Signals) -> Iterator[Signals]:
        """All of it, piece by piece, with the arm and bands of others."""
        size = round(PIECE_S * RATE_HZ / DECIMATION)
        for run in self.runs:
            last = min(run.samples, run.sample(self.span[1]))
            for begin in range(max(run.sample(self.span[0]), 0), last, size):
                end = min(begin + size, last)
                yield self._part(run, begin, end, like.motion.arm, like.motion.bands_hz)

    def _samples(self, spans: Sequence[Span]) -> list[tuple[Run, int, int]]:
        """Run and samples of stretches; those too near one another to be two are one."""
        out: list[tuple[Run, int, int]] = []
        for begin, end in sorted(spans):
            run = max(self.runs, key=lambda r: min(r.t(r.samples), end) - max(r.t(0), begin))
            a = max(run.sample(max(begin, self.span[0])), 0)
            b = min(run.sample(min(end, self.span[1])), run.samples)
            if b - a < round(LEAST_S * RATE_HZ / DECIMATION):
                continue
            if out and out[-1][0] is run and a - out[-1][2] < APART:
                out[-1] = run, out[-1][1], max(b, out[-1][2])
            else:
                out.append((run, a, b))
        return out

    def _part(
        self, run: Run, begin: int, end: int, arm: ArmDynamics, bands_hz: Array | None = None
    ) -> Signals:
        """Samples of the band from one to before another; its bands are its own where None."""
        first, last = DECIMATION * begin, DECIMATION * (end - 1 + 2 * TRIM) + TAPS
        parts = np.split(self.table.rows(run.first + first, run.first + last), 5, axis=1)
        q, dq, ddq, tau, known = map(np.ascontiguousarray, parts)
        t = run.begin_s + np.arange(first, last) / RATE_HZ
        noise = 2.0 * self.survey.clock.period_s * self.smoothness.dq_noise**2
        return in_band(Motion(t, q, dq, ddq, arm, bands_hz=bands_hz), noise, tau, known, TRIM)


def _smooth(survey: Survey, smoothness: Smoothness) -> tuple[RowsFile, tuple[Run, ...]]:
    """Splines through a recording in pieces that overlap, and the runs between its holes."""
    log, size = survey.log, round(PIECE_S * RATE_HZ)
    table, runs, holes, row, before = RowsFile(5 * len(log.joint_names)), [], [], 0, log.first_ns
    for stamps in stretches(log.stamp_ns):
        steps = np.diff(stamps, prepend=before)
        holes += (row + np.flatnonzero(steps > 1e9 * HOLE_S)).tolist()
        row, before = row + len(stamps), stamps[-1]
    for first, last in pairwise((0, *holes, len(log))):
        begin, end = (survey.recorded(k, k + 1).t[0] for k in (first, last - 1))
        if end - begin <= LEAST_S:
            continue
        # the last piece of a run reaches to its end, so that none is shorter than an overlap
        count = int(np.ceil((end - begin - 2.0 * EDGE_S) * RATE_HZ - 1e-9))
        short = round((OVERLAP_S - EDGE_S) * RATE_HZ)
        run = Run(float(begin + EDGE_S), len(table), count)
        for a, b in pairwise((0, *range(size, count - short, size), count)):
            grid = run.begin_s + np.arange(a, b) / RATE_HZ
            rows = survey.rows(grid[0] - OVERLAP_S, grid[-1] + 1.0 / RATE_HZ + OVERLAP_S)
            part = survey.recorded(max(rows[0], first), min(rows[1], last))
            knots = np.arange(
                np.floor((part.t[0] - begin) / KNOT_S), np.ceil((part.t[-1] - begin) / KNOT_S) + 1
            )
            inner = begin + KNOT_S * knots
            splines = Splines.through(part.t, part.q, part.dq, part.dq_late_s, inner)
            told = splines.smoothed(smoothness).at(grid)
            torque = (on_grid(grid, part.t, x) for x in (part.tau, part.heard.astype(float)))
            table.append(np.column_stack([*told, *torque]))
        if run.samples > 0:
            runs.append(run)
    return table, tuple(runs)


def sampling(recordings: Sequence[Recorded]) -> tuple[dict[str, Any], ...]:
    """What was taken of long recordings, for the JSON file."""
    return tuple(
        {
            "recording": own.name,
            "seconds": sum(max(run.samples, 0) for run in own.runs) * DECIMATION / RATE_HZ,
            "searched_s": own.seconds,
            "stretches_s": [[float(a), float(b)] for a, b in own.spans],
            "weighed_on_all": len(recordings) == 1,
        }
        for own in recordings
        if isinstance(own, LongRecording)
    )


def sampling_words(recordings: Sequence[Recorded]) -> list[str]:
    """What was taken of long recordings, a sentence each."""
    alone, said = len(recordings) == 1, []
    for x in sampling(recordings):
        who, spans = "" if alone else f"{x['recording']}: ", x["stretches_s"]
        said.append(
            f"{who}searched and scored in {x['searched_s']:.0f} s of {x['seconds']:.0f} s, in "
            f"{len(spans)} stretches from {spans[0][0]:.0f} s to {spans[-1][1]:.0f} s"
            + (", weighed on all" if alone else "")
        )
    return said
