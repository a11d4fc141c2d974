"""A recording as the search sees it: smooth motion, and torque in the band where models count.

Every torque, measured or modelled, goes through one and the same low-pass before the two are
compared: models are evaluated on the smooth motion at 250 Hz, sharp edges and all, and then
filtered and decimated to 25 Hz like the measured torque. Samples 40 ms apart are about as many
as the band of 10 Hz has independent ones; counting those at 1 kHz would name noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.ndimage import minimum_filter1d
from scipy.optimize import minimize_scalar
from scipy.signal import firwin, oaconvolve, periodogram, upfirdn
from scipy.sparse import diags

from adapter.effects.base import Motion
from adapter.effects.by_joint import SMOOTHING_DQ, slowness
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.screen import pauses, stuck
from adapter.signals.filters import noise_from_samples
from drivers.files.mcap import Log

# The band.
RATE_HZ = 250.0  # of the models
DECIMATION = 10  # from there to the band: 25 Hz
CUT_HZ = 10.0
TAPS = 101  # of the low-pass: 0.9 at 8 Hz, 0.5 at 10, 0.05 at 12.5
RAW_HZ = 1000.0
CLEAR, TOP_HZ = 8.0, 2.0  # times the noise's power, over so much of the band at least
LEAST_S = 1.2  # of a recording, and of a stretch between pauses
EDGE_S = 0.1  # a spline's ends know their neighbours on one side only
MOTION = ("t", "q", "dq", "ddq")
_LOW = firwin(TAPS, CUT_HZ, window=("kaiser", 4.0), fs=RATE_HZ)
_ANTI_ALIAS = firwin(33, 0.4 * RATE_HZ, fs=RAW_HZ)


# Splines through a motion.
SPLINE_DEGREE = 5
KNOT_S = 0.02  # a joint does nothing that we model within 40 ms
Q_NOISE_FLOOR, DQ_NOISE_FLOOR = 2e-6, 2e-5  # rad, rad/s: of signals without noise

# A recording again, or as a forward simulation takes it.
COMMANDS, MEASURED = "commands", "measured"
ROLLOUT_STEP_S = 1e-3
SAME_S, SAME_STEP_S = 0.05, 0.02  # of a repeat: so much longer or shorter; compared so often
SAME_RAD, SAME_RAD_S = 3e-4, 3e-3  # rms differences that are noise, no other motion
UNLIKE = 0.3  # of the measured torque's size: commands further off mean something else
FAR_S = 0.05  # a command older than that does not drive any more
ROLLOUT_EDGE_S = 0.3


def low(x: Array) -> Array:
    """Signals (m, ...) at 250 Hz in the band, (k, ...) at 25 Hz; the ends are left out."""
    flat, shape = x.reshape(len(x), -1), x.shape[1:]
    if flat.shape[1] > 100:  # half of a regressor is zero
        used = flat.any(axis=0)
        if not used.all():
            out = np.zeros((_size_of_low(len(x)), flat.shape[1]))
            out[:, used] = low(flat[:, used])
            return out.reshape(-1, *shape)
    whole = _size_of_low(len(x))
    # output k DECIMATION + TAPS - 1 of the causal filter is the first that knows all its neighbours
    padded = upfirdn(_LOW, flat[(TAPS - 1) % DECIMATION :], down=DECIMATION, axis=0)
    first = (TAPS - 1) // DECIMATION
    return padded[first : first + whole].reshape(-1, *shape)


@dataclass(frozen=True, eq=False)
class Signals:
    """One recording, ready for the search.

    Attributes:
        motion: smooth motion at 250 Hz; its `t` is that of the recording.
        noise: (n,) of its velocities, rad²/s²/Hz.
        tau: (k, n) measured torque in the band, N m.
        t: (k,) s, its instants.
        heard: (k, n) one where the torque was measured, else zero.
        begins: rows of the motion at which its stretches begin; between these time is left out.
        trim: samples of the band that are left out at either end of each stretch, since what
            depends on the motion before (a filter, a rate) is not known there.
    """

    motion: Motion
    noise: Array
    tau: Array
    t: Array
    heard: Array
    begins: tuple[int, ...] = (0,)
    trim: int = 0
    _kept: dict[Hashable, Array] = field(default_factory=dict, init=False, repr=False)

    def once(self, key: Hashable, compute: Callable[[], Array]) -> Array:
        """What depends on this recording alone, computed the first time it is asked for."""
        if key not in self._kept:
            self._kept[key] = compute()
        return self._kept[key]

    def banded(self, links: Motion) -> Motion:
        """The links' motion with the bands in which its own torques stand out of the noise.

        Where a joint jumped and its link did not, it is the link's torques that count.
        """
        bands = []
        for rows in self.stretches:
            part = replace(links, **{key: getattr(links, key)[rows] for key in MOTION})
            bands.append(bands_of(part, self.noise))
        return replace(links, bands_hz=np.max(bands, axis=0))

    @property
    def stretches(self) -> list[slice]:
        """Rows of the motion, stretch by stretch."""
        return [slice(*rows) for rows in pairwise((*self.begins, len(self.motion.t)))]

    @property
    def seams(self) -> tuple[int, ...]:
        """Rows of the band at which stretches begin."""
        if len(self.begins) == 1:
            return (0,)
        sizes = [_size_of_low(x.stop - x.start) - 2 * self.trim for x in self.stretches]
        return tuple(int(x) for x in np.cumsum([0, *sizes[:-1]]))

    def low(self, x: Array) -> Array:
        """A torque (m, ...) at the motion's instants in the band (k, ...)."""
        return self.low_of(lambda rows: x[rows])

    def low_of(self, make: Callable[[slice], Array]) -> Array:
        """The same of what is made stretch by stretch: at the motion's rate it may be large."""
        parts = [low(make(rows)) for rows in self.stretches]
        parts = [x[self.trim : len(x) - self.trim] for x in parts] if self.trim else parts
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def low_on(self, x: Array, joint: int) -> Array:
        """A torque (m, n) that acts on one joint (-1: on all) in the band (k, n)."""
        if joint < 0:
            return self.low(x)
        out = np.zeros_like(self.tau)
        out[:, joint] = self.low(x[:, joint])
        return out

    @cached_property
    def low_regressor(self) -> Array:
        """(10 n, k, n) regressor of the measured motion in the band; whatever the inertias are."""
        whole = self.low_of(lambda rows: regressor_of(self.motion, rows))
        return np.ascontiguousarray(np.moveaxis(whole, 2, 0))

    @cached_property
    def low_dq(self) -> Array:
        """(k, n) rad/s velocities in the band."""
        return self.low(self.motion.dq)

    @property
    def paces(self) -> Array:
        """(k, n) the same, of a joint that slides as if it turned a drum."""
        return self.low_dq / self.motion.drums

    @cached_property
    def rests(self) -> list[tuple[int, slice]]:
        """Joints (from 0) at rest, and the rows of the band in which each is, rest by rest."""
        still = np.abs(self.paces) < SMOOTHING_DQ
        edges = np.diff(still.astype(int), axis=0, prepend=0, append=0)
        cuts = (np.flatnonzero(column).reshape(-1, 2) for column in edges.T)
        return [(j, slice(*cut)) for j, own in enumerate(cuts) for cut in own.tolist()]

    @cached_property
    def slides(self) -> NDArray[np.bool_]:
        """(k, n) where a joint slides and its torque is measured.

        At rest it holds what static friction lets it: that is neither noise nor unexplained.
        """
        return (self.heard > 0.0) & (np.abs(self.paces) > SMOOTHING_DQ)

    @property
    def sliding(self) -> Array:
        """(k, n) one there, else zero; where a joint hardly slides, all that is measured."""
        return np.where(self.slides.sum(axis=0) < 25, self.heard, self.slides)  # rows: a second

    @cached_property
    def slowness(self) -> Array:
        """(k, n) how unsure friction is; of a rest, which holds one unknown value, so is a row."""
        out = slowness(self.paces)
        for j, rows in self.rests:
            out[rows, j] *= math.sqrt(rows.stop - rows.start)
        return out


def regressor_of(motion: Motion, rows: slice) -> Array:
    """(k, n, 10 n) regressor at some instants of a motion."""
    return motion.arm.regressor(motion.q[rows], motion.dq[rows], motion.ddq[rows])


def _size_of_low(rows: int) -> int:
    """Samples of the band in so many rows at 250 Hz."""
    return (rows - TAPS) // DECIMATION + 1


def prepare(recording: Recorded, arm: RigidArm, repeat: Recorded | None = None) -> Signals:
    """Smooth a recording.

    Args:
        recording: to be searched; arm: that moves.
        repeat: of the same motion, whose positions and velocities are taken instead: their noise
            has nothing to do with that of this recording's torques and positions.

    Raises:
        ValueError: less data than the filters need.
    """
    if len(recording.begins) > 1:
        return together([prepare(x, arm, repeat) for x in recording.stretches()])
    t = recording.t
    if t[-1] - t[0] < LEAST_S:
        told = f"{recording.name}: at most {t[-1] - t[0]:.2f} s without a pause"
        raise ValueError(f"{told}; the filters need {LEAST_S:g} s")
    grid = np.arange(t[0] + EDGE_S, t[-1] - EDGE_S, 1.0 / RATE_HZ)
    source = repeat or recording
    smoothed = source.smoothed()
    q, dq, ddq = smoothed.at(grid)
    noise = 2.0 * float(np.median(np.diff(source.t))) * smoothed.dq_noise**2
    tau, known = (on_grid(grid, t, x) for x in (recording.tau, recording.heard.astype(float)))
    return in_band(Motion(grid, q, dq, ddq, arm), noise, tau, known)


def in_band(motion: Motion, noise: Array, tau: Array, known: Array, trim: int = 0) -> Signals:
    """A motion without a pause; its bands are found where it has none.

    Args:
        noise: (n,) of its velocities; tau: (m, n) N m at its instants.
        known: (m, n) one where that was measured; trim: see `Signals`.
    """
    if motion.bands_hz is None:
        motion = replace(motion, bands_hz=bands_of(motion, noise))
    at = slice(TAPS // 2, -(TAPS // 2), DECIMATION)
    heard = (minimum_filter1d(known, TAPS, axis=0)[at] > 0.999).astype(float)  # all of it
    own, t, heard = (x[trim : len(x) - trim] for x in (low(tau), motion.t[at], heard))
    return Signals(motion, noise, own, t, heard, trim=trim)


def together(parts: Sequence[Signals]) -> Signals:
    """Stretches of one recording, of one trim, as one."""
    motions = [x.motion for x in parts]
    t, q, dq, ddq = (np.concatenate([getattr(m, k) for m in motions]) for k in MOTION)
    bands = np.max([x.motion.bands_hz for x in parts if x.motion.bands_hz is not None], axis=0)
    begins = tuple(int(x) for x in np.cumsum([0, *(len(m.t) for m in motions[:-1])]))
    own = ("tau", "t", "heard")
    tau, band_t, heard = (np.concatenate([getattr(x, k) for x in parts]) for k in own)
    motion = Motion(t, q, dq, ddq, motions[0].arm, bands_hz=bands)
    noise = np.mean([x.noise for x in parts], axis=0)
    return Signals(motion, noise, tau, band_t, heard, begins, parts[0].trim)


def bands_of(motion: Motion, noise: Array) -> Array:
    """(n,) Hz above which a joint's torque does not stand out of the noise of the motion.

    Infinite where it does as far as torques are compared. `noise` is (n,) rad²/s²/Hz, of dq.
    """
    arm = motion.arm
    some = motion.q[:: max(len(motion.q) // 20, 1)]  # instants for the mass matrix
    rest = np.zeros_like(some)
    held = arm.torque(some, rest, rest)
    mass = [arm.torque(some, rest, rest + unit) - held for unit in np.eye(arm.n)]
    made = np.mean(np.square(mass), axis=1).T @ noise  # times the square of the circular frequency
    tau = arm.torque(motion.q, motion.dq, motion.ddq)
    f, power = periodogram(tau, fs=RATE_HZ, window="hann", axis=0)
    inside = f < 0.5 * RATE_HZ / DECIMATION
    f, power = f[inside], power[inside]
    theirs = np.cumsum((2.0 * np.pi * f[::-1]) ** 2)[::-1, None] * made
    clear = np.cumsum(power[::-1], axis=0)[::-1] > CLEAR * theirs
    clear &= (f <= f[-1] - TOP_HZ)[:, None]
    last = len(f) - 1 - np.argmax(clear[::-1], axis=0)
    band = np.where(f[last] + 2.0 * f[1] > f[-1] - TOP_HZ, math.inf, 1.3 * f[last])  # a margin
    return np.where(clear.any(axis=0), band, 0.0)


def on_grid(grid: Array, t: Array, tau: Array) -> Array:
    """Torque (m, n) at the grid's instants, without what lies above 100 Hz."""
    pad = (len(_ANTI_ALIAS) // 2) / RAW_HZ
    factor = round(RAW_HZ / RATE_HZ)
    fine = np.arange(len(grid) * factor + 2 * (len(_ANTI_ALIAS) // 2)) / RAW_HZ + grid[0] - pad
    raw = np.column_stack([np.interp(fine, t, column) for column in tau.T])
    return oaconvolve(raw, _ANTI_ALIAS[:, None], mode="valid", axes=0)[::factor][: len(grid)]


@dataclass(frozen=True, eq=False)
class Recorded:
    """One recording.

    Attributes:
        name: of the file.
        t: (m,) s since its first sample, increasing; q, dq, tau: (m, n).
        command_t, commands: (k,) s and (k, n) N m; None where none were recorded.
        dq_late_s: how much later dq is than q.
        begins: rows at which its stretches begin; between these time is left out.
        loads_s: about when what the hand holds changed, where that is known already.
    """

    name: str
    t: Array
    q: Array
    dq: Array
    tau: Array
    command_t: Array | None = None
    commands: Array | None = None
    dq_late_s: float = 0.0
    begins: tuple[int, ...] = (0,)
    loads_s: tuple[float, ...] = ()

    @classmethod
    def of(cls, log: Log, dq_late_s: float = 0.0, begin_ns: int | None = None) -> Recorded:
        """From a screened log; times count from `begin_ns`, its first sample where None."""
        start = log.stamp_ns[0] if begin_ns is None else begin_ns
        command_t = commands = None
        if log.commands is not None and len(log.commands.stamp_ns) > 1:
            stamps, first = np.unique(log.commands.stamp_ns, return_index=True)
            known = np.isfinite(log.commands.tau[first]).all(axis=1)
            command_t = 1e-9 * (stamps[known] - start).astype(float)
            commands = log.commands.tau[first][known]
        t = 1e-9 * (log.stamp_ns - start).astype(float)
        signals = log.path.name, t, log.q, log.dq, log.tau, command_t, commands, dq_late_s
        return cls(*signals)

    def cut(self) -> Recorded:
        """The stretches between its pauses, those that are long enough for the filters.

        Nobody knows how the arm moved in a pause: no spline, filter or memory reaches over one.
        Where none is, the longest is taken, for `prepare` to refuse.
        """
        cuts = pauses(self.t) + 1
        if not len(cuts):
            return replace(self, begins=(0,))
        every = [np.arange(a, b) for a, b in pairwise((0, *cuts.tolist(), len(self.t)))]
        lengths_s = np.array([self.t[x[-1]] - self.t[x[0]] for x in every])
        rows = [x for x, s in zip(every, lengths_s, strict=True) if s >= LEAST_S]
        rows = rows or [every[int(np.argmax(lengths_s))]]
        begins = np.cumsum([0, *(len(x) for x in rows[:-1])])
        return replace(self.part(np.concatenate(rows)), begins=tuple(map(int, begins)))

    def part(self, rows: slice | NDArray[np.int64]) -> Recorded:
        """Some of its rows; times stay those of the whole."""
        kept = {key: getattr(self, key)[rows] for key in ("t", "q", "dq", "tau")}
        return replace(self, **kept)

    def between(self, begin_s: float, end_s: float) -> Recorded:
        """Its samples from a time to another one (not included), cut at its pauses."""
        return self.part(np.flatnonzero((self.t >= begin_s) & (self.t < end_s))).cut()

    @property
    def heard(self) -> NDArray[np.bool_]:
        """(m, n) where the torque was measured."""
        return ~stuck(self.t, self.dq, self.tau)

    def heard_at(self, t: Array) -> NDArray[np.bool_]:
        """(k, n) the same at times t (k,), s."""
        return self.heard[np.clip(np.searchsorted(self.t, t), 0, len(self.t) - 1)]

    @property
    def end_s(self) -> float:
        """When the recording ends."""
        return float(self.t[-1])

    @property
    def seconds(self) -> float:
        """How much of it there is in memory."""
        return sum(float(x.t[-1] - x.t[0]) for x in self.stretches())

    def stretches(self) -> list[Recorded]:
        """Each stretch for itself."""
        if len(self.begins) == 1:
            return [self]
        cuts = pairwise((*self.begins, len(self.t)))
        return [replace(self.part(slice(a, b)), begins=(0,)) for a, b in cuts]

    def repeated_in(self, others: Sequence[Recorded]) -> Recorded | None:
        """Another recording of the same motion, if one of these is."""
        return next((x for x in others if x is not self and self._repeats(x)), None)

    def _repeats(self, other: Recorded) -> bool:
        if abs(self.t[-1] - other.t[-1]) > SAME_S or abs(self.t[0] - other.t[0]) > SAME_S:
            return False
        span = max(self.t[0], other.t[0]), min(self.t[-1], other.t[-1])
        t = np.arange(span[0], span[1], SAME_STEP_S)
        mine, theirs = self.smoothed().at(t), other.smoothed().at(t)
        off = [np.sqrt(np.mean((a - b) ** 2)) for a, b in zip(mine, theirs, strict=True)]
        return bool(off[0] < SAME_RAD and off[1] < SAME_RAD_S)

    def smoothed(self) -> Smoothed:
        """Splines through its motion."""
        return smooth_motion(self.t, self.q, self.dq, self.dq_late_s)

    def grid(self) -> Array:
        """(m,) s, even times 1 ms apart within the recording, its edges left out."""
        begin, span = self.t[0] + ROLLOUT_EDGE_S, self.t[-1] - self.t[0] - 2 * ROLLOUT_EDGE_S
        return begin + ROLLOUT_STEP_S * np.arange(max(int(span / ROLLOUT_STEP_S), 0))

    def is_whole(self, begin_s: float, end_s: float) -> bool:
        """Whether there are samples all the way between two of its times."""
        first, last = np.searchsorted(self.t, (begin_s, end_s))
        around = self.t[max(first - 1, 0) : last + 1]
        return bool(len(around) > 1 and np.diff(around).max() < 0.05)  # no hole in between

    def drive(self, t: Array) -> tuple[Array, str]:
        """Torque (m, n) that moved the arm at times t, and which of `COMMANDS`, `MEASURED` it is.

        Commands that are far from the measured torques (without gravity, of motors, positions)
        or that leave out parts of the time are no drive.
        """
        measured = np.column_stack([np.interp(t, self.t, column) for column in self.tau.T])
        given = self._commanded(t)
        if given is None:
            return measured, MEASURED
        size = float(np.sqrt(np.mean(measured**2)))
        off = float(np.sqrt(np.mean((given - measured) ** 2)))
        return (given, COMMANDS) if off < UNLIKE * size else (measured, MEASURED)

    def _commanded(self, t: Array) -> Array | None:
        """Commands (m, n) at times t; None where there are none for part of the time."""
        if self.command_t is None or self.commands is None or len(self.command_t) < 2:
            return None
        at = self.command_t + 1e-3  # it is reached at the end of the next period
        inside = at[(at > t[0] - FAR_S) & (at < t[-1] + FAR_S)] if len(t) else at[:0]
        if len(inside) < 2 or inside[0] > t[0] + FAR_S or inside[-1] < t[-1] - FAR_S:
            return None
        if np.diff(inside).max() > FAR_S:
            return None
        return np.column_stack([np.interp(t, at, column) for column in self.commands.T])


@dataclass(frozen=True)
class Smoothed:
    """Splines of all joints.

    Attributes:
        spline: q(t), (n,) at a time; its derivatives are dq and ddq.
        q_noise, dq_noise: (n,) noise levels that were assumed.
    """

    spline: BSpline
    q_noise: Array
    dq_noise: Array

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """q, dq, ddq (m, n) at times t (m,), s."""
        return tuple(np.asarray(self.spline(t, nu)) for nu in range(3))  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class Smoothness:
    """What splines through a motion assume.

    Attributes:
        q_noise, dq_noise: (n,) noise levels, rad and rad/s.
        log_penalty: (n,) ln of what the squared third derivative costs.
    """

    q_noise: Array
    dq_noise: Array
    log_penalty: Array


def smooth_motion(t: Array, q: Array, dq: Array, dq_late_s: float = 0.0) -> Smoothed:
    """Splines through q and dq.

    Args:
        t: (m,) s, increasing; q, dq: (m, n) rad, rad/s.
        dq_late_s: how much later dq is than q.
    """
    splines = Splines.through(t, q, dq, dq_late_s)
    return splines.smoothed(smoothness_of([splines]))


def smoothness_of(parts: Sequence[Splines]) -> Smoothness:
    """Noise of some parts of a motion, and the penalties under which they are most probable."""
    sizes = [len(part.t) for part in parts]

    def noise(key: str, floor: float) -> Array:
        own = [noise_from_samples(getattr(part, key)) for part in parts]
        pooled = np.sqrt(np.average(np.square(own), axis=0, weights=sizes))
        return np.maximum(own[0] if len(own) == 1 else pooled, floor)

    q_noise, dq_noise = noise("q", Q_NOISE_FLOOR), noise("dq", DQ_NOISE_FLOOR)
    penalties = []
    for j in range(len(q_noise)):
        costs = [_cost_of(*part.known(j, q_noise[j], dq_noise[j]), part.rough) for part in parts]
        best = minimize_scalar(
            lambda x, costs=costs: sum(cost(x) for cost in costs),
            bounds=(-16.0, 6.0),  # range of ln of the penalty on the squared third derivative
            method="bounded",
            options={"xatol": 0.2},
        )
        penalties.append(float(best.x))
    return Smoothness(q_noise, dq_noise, np.array(penalties))


def _cost_of(data: Array, right: Array, rough: Array) -> Callable[[float], float]:
    """-2 ln of the marginal likelihood of splines, but for a constant, by ln of the penalty."""
    rank = data.shape[1] - 3

    def cost(log_penalty: float) -> float:
        factor = cholesky_banded(data + np.exp(log_penalty) * rough, lower=True)
        solution = cho_solve_banded((factor, True), right)
        return float(2.0 * np.log(factor[0]).sum() - rank * log_penalty - right @ solution)

    return cost


@dataclass(frozen=True, eq=False)
class Splines:
    """A motion and the splines that may go through it.

    Attributes:
        t: (m,) s; q, dq: (m, n) rad, rad/s; knots: (k,) s.
        level, slope: sparse, from coefficients to q and to dq at the samples.
        bands_q, bands_dq, rough: lower bands of their products, and of the roughness.
    """

    t: Array
    q: Array
    dq: Array
    knots: Array
    level: Any
    slope: Any
    bands_q: Array
    bands_dq: Array
    rough: Array

    @classmethod
    def through(
        cls, t: Array, q: Array, dq: Array, dq_late_s: float = 0.0, inner: Array | None = None
    ) -> Splines:
        """Of samples at t (m,) s, q and dq (m, n).

        Args:
            dq_late_s: how much later dq is than q.
            inner: knots from before the first sample to behind the last, even ones where None.
        """
        if inner is None:
            count = max(2, int(np.ceil((t[-1] - t[0]) / KNOT_S)))
            inner = np.linspace(t[0], t[-1], count + 1)
        begin, end = inner[0], inner[-1]
        knots = np.concatenate([np.full(SPLINE_DEGREE, begin), inner, np.full(SPLINE_DEGREE, end)])
        level = BSpline.design_matrix(t, knots, SPLINE_DEGREE)
        when = np.clip(t - dq_late_s, begin, end)
        first, inner_knots = _differentiated(knots, 1)
        slope = BSpline.design_matrix(when, inner_knots, SPLINE_DEGREE - 1) @ first
        rough = _roughness(knots)
        bands = (_bands(x) for x in (level.T @ level, slope.T @ slope, rough))
        return cls(t, q, dq, knots, level, slope, *bands)

    def known(self, j: int, q_noise: float, dq_noise: float) -> tuple[Array, Array]:
        """Information (bands) and right side of a joint's coefficients, by its samples."""
        wq, wdq = q_noise**-2, dq_noise**-2
        data = wq * self.bands_q + wdq * self.bands_dq
        right = wq * (self.level.T @ self.q[:, j]) + wdq * (self.slope.T @ self.dq[:, j])
        return data, right

    def smoothed(self, by: Smoothness) -> Smoothed:
        """The most probable ones."""
        coefficients = np.empty((self.level.shape[1], self.q.shape[1]))
        for j, log_penalty in enumerate(by.log_penalty):
            data, right = self.known(j, by.q_noise[j], by.dq_noise[j])
            factor = cholesky_banded(data + np.exp(log_penalty) * self.rough, lower=True)
            coefficients[:, j] = cho_solve_banded((factor, True), right)
        spline = BSpline(self.knots, coefficients, SPLINE_DEGREE)
        return Smoothed(spline, by.q_noise, by.dq_noise)


def _differentiated(knots: Array, order: int) -> tuple[Any, Array]:
    """A derivative of splines on knots: sparse matrix on their coefficients, and its knots."""
    degree, size, product = SPLINE_DEGREE, len(knots) - SPLINE_DEGREE - 1, None
    for _ in range(order):
        gain = degree / (knots[degree + 1 : degree + size] - knots[1:size])
        bands: Any = [-gain, gain]
        step = diags(bands, offsets=[0, 1], shape=(size - 1, size))
        product = step if product is None else step @ product
        knots, degree, size = knots[1:-1], degree - 1, size - 1
    return product, knots


def _roughness(knots: Array) -> Any:
    """Integral of products of third derivatives of the basis functions, sparse."""
    third, inner = _differentiated(knots, 3)
    # degree-2 splines: exact with three Gauss points per knot interval
    edges = np.unique(inner)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    half = 0.5 * np.diff(edges)
    points = (edges[:-1, None] + half[:, None] * (1.0 + nodes)).ravel()
    basis = BSpline.design_matrix(points, inner, SPLINE_DEGREE - 3)
    mass = basis.T @ diags((half[:, None] * weights).ravel()) @ basis
    return third.T @ mass @ third


def _bands(matrix: Any) -> Array:
    """Lower bands (SPLINE_DEGREE + 1, size) of a sparse symmetric matrix."""
    size = matrix.shape[0]
    out = np.zeros((SPLINE_DEGREE + 1, size))
    for k in range(SPLINE_DEGREE + 1):
        out[k, : size - k] = matrix.diagonal(-k)
    return out
