"""A light watch over the residual while an arm is learned: what is new, where, since when.

It runs beside the learner, on the states the learner sees, at 25 rows a second. Once θ has seen
three seconds it takes over what the learner knows and keeps a belief of its own from then on,
which takes in rows only when they are two seconds old: what begins meanwhile is judged against a
model that has not learned it yet. A disagreement that was reported stays in the belief with its
own coefficients, so it is reported once, its size becomes better, and it does not spoil the rest.
An arm at rest shows nothing: the front end passes on states of motion only.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np

from adapter.effects.by_joint import SMOOTHING_DQ, slowness
from adapter.effects.catalogue import CATALOGUE
from adapter.gap.monitor_evidence import ROWS_PER_GROUP, Belief, Level, RowGroup
from adapter.gap.monitor_judge import GROUPS, DisagreementDetector, DisagreementList, sentence
from adapter.gap.monitor_signatures import LearnedFrames
from adapter.judgement.noise import LEAST_NM
from adapter.learning.change import extremes, is_new
from adapter.learning.learner import OnlineLearner
from adapter.model.spatial import Array
from adapter.physics.kernels import jit
from adapter.signals.records import StateLayout, stamp_of

BLOCK_NS = 40_000_000  # states averaged to one row
TRUST = 4.0  # the learner's information counts one in so many
STRIBECK_SPEEDS = (0.03, 0.1)  # rad/s; between them, static friction's shape is a sum of theirs
DRIFT = 0.2  # of friction: no law of it is better from one move to the next


class Mark(IntEnum):
    """Places in the marks of a block that is not over."""

    COUNT = 0  # states in it
    BEGIN_NS = 1
    LAST_NS = 2
    SINCE_NS = 3  # sum of the times since the beginning


@jit
def average(table, first, marks, total, rows):
    """Average states (m, size), from their column `first` on, to rows; how many are full now.

    Args:
        marks: (4,) int64, see `Mark`; total: (w,) sum of the block's states.
        rows: (m, 1 + w) filled: time in the middle, s, and average.
    """
    full = 0
    for m in range(table.shape[0]):
        stamp = table[m, :1].view(np.int64)[0]
        count, since_last = marks[Mark.COUNT], stamp - marks[Mark.LAST_NS]
        if count and not 0 < since_last <= 20_000_000:  # a longer hole ends a block without a row
            marks[Mark.COUNT] = 0
        elif count and stamp - marks[Mark.BEGIN_NS] >= BLOCK_NS:
            rows[full, 0] = 1e-9 * (marks[Mark.BEGIN_NS] + marks[Mark.SINCE_NS] / count)
            rows[full, 1:] = total / count
            marks[Mark.COUNT], full = 0, full + 1
        if not marks[Mark.COUNT]:
            total[:] = 0.0
            marks[Mark.BEGIN_NS], marks[Mark.SINCE_NS] = stamp, 0
        total += table[m, first : first + total.shape[0]]
        marks[Mark.SINCE_NS] += stamp - marks[Mark.BEGIN_NS]
        marks[Mark.COUNT] += 1
        marks[Mark.LAST_NS] = stamp
    return full


class Blocks:
    """Averages states to rows; cheap for each of them.

    Args:
        n: joints.
    """

    def __init__(self, n: int) -> None:
        at = StateLayout(n)
        self._first = at.q.start
        self._total = np.zeros(at.memory.stop - at.q.start)
        self._marks = np.zeros(len(Mark), dtype=np.int64)
        self._one = np.empty((1, 1 + len(self._total)))

    def add(self, table: Array) -> list[tuple[float, Array]]:
        """Take states (m, size); rows (s, states from q to `memory`)."""
        m = len(table)
        rows = self._one if m == 1 else np.empty((m, self._one.shape[1]))
        full = average(table, self._first, self._marks, self._total, rows)
        return [(float(row[0]), row[1:].copy()) for row in rows[:full]]


class Monitor:
    """Watches a learner's states; `learner.watch = Monitor(...)`.

    Args:
        n: joints.
        tool_theta: (10,) of a known tool on the last link, which θ leaves out.
        delay_s: age of a filtered state against the sample that completed it.
        say: takes a sentence when something is reported, and when it is over.
        start_s: stamp that the sentences' times count from; the first state's where nobody knows.
    """

    def __init__(
        self,
        n: int,
        tool_theta: Array | None = None,
        delay_s: float = 0.0,
        say: Callable[[str], None] | None = None,
        start_s: float | None = None,
    ) -> None:
        self._start_s = start_s
        self._n, self._delay_s, self._layout = n, delay_s, StateLayout(n)
        self._tool = np.zeros(10) if tool_theta is None else np.array(tool_theta)
        self._blocks, self._found = Blocks(n), DisagreementList(say)
        self._frames: LearnedFrames | None = None
        self._groups: list[RowGroup] = []
        self._rows: list[tuple[float, Array]] = []

    @property
    def reports(self) -> list[dict[str, Any]]:
        """One dict per disagreement, in the order they were found.

        "what" (a name of the catalogue, or "unexplained"), "joints" (from 1; empty at the
        flange), "since_s", "reported_s" and "over_s" (None while it lasts) in s on the arm's
        clock, "size" (parameters of the catalogue), "score" (standard deviations),
        "ambiguous_with" (what else it may be: "what" and "joints"), "line" (all of it in words,
        times from the first state on).
        """
        found = self._found
        return [{**entry, "line": sentence(entry, found.start_s)} for entry in found.reports]

    def __call__(self, learner: OnlineLearner, table: Array) -> None:
        """Look at states (m, size) that the learner has just learned from."""
        if self._start_s is None and len(table):
            self._start_s = 1e-9 * stamp_of(table[0])
        self._found.start_s = self._start_s or 0.0
        rows = self._blocks.add(table)
        if not rows:
            return
        # or λ or the hand's load was learned anew while nothing else was new
        outdated = self._frames is None
        if self._frames is not None and not self._found.active:
            R0, p = learner.frames
            moved = max(np.abs(R0 - self._frames.R0).max(), np.abs(p - self._frames.p).max())
            outdated = moved > 1e-3 or self._changes < len(learner.changes)  # rad, m
        if learner.theta.count >= 3000 and outdated:  # states behind its least squares
            self._take_over(learner)
        if self._frames is None:
            return
        for row in rows:
            self._rows.append(row)
            if len(self._rows) == ROWS_PER_GROUP:
                # a full group: judge the window with it, and let the oldest into the belief
                t, table = (np.array(column) for column in zip(*self._rows, strict=True))
                self._rows = []
                self._groups.append(self._group(learner, self._frames, t, table))
                if len(self._groups) > GROUPS:
                    self._absorb(self._groups.pop(0))
                if len(self._groups) == GROUPS:
                    self._detector.judge(self._groups, float(t[-1]) + self._delay_s)

    def _take_over(self, learner: OnlineLearner) -> None:
        """Start from what the learner knows."""
        theta, n, self._changes = learner.theta, self._n, len(learner.changes)
        H, rhs = theta.information()
        if theta.spare_in_use:  # it stands behind the last link, whose place it takes
            before = Belief(H, rhs)
            before.drop(slice(10 * n - 10, 10 * n))
            H, rhs = before.H, before.rhs
        else:
            rest = np.r_[: 10 * n, 10 * n + 10 : len(rhs)]
            H, rhs = H[np.ix_(rest, rest)], rhs[rest]
        self._belief, self._size = Belief(H / TRUST, rhs / TRUST), len(rhs)
        self._rates = extremes(learner.rates_seen)
        rubs = [x.band > 0.0 or x is CATALOGUE["viscous_friction"] for x in theta.effects]
        squares = self._squares()
        self._belief.drift[10 * n :] = DRIFT**2 * (np.array(rubs)[:, None] * squares).ravel()
        more = np.sqrt(theta.banded(squares) + LEAST_NM**2)  # static friction above Coulomb's
        self._belief.extend(np.tile(more, len(STRIBECK_SPEEDS)))
        R0, p = learner.frames
        self._frames = LearnedFrames(learner.tree, R0, p, learner.base, theta.smoothing_s)
        self._level = Level(theta.variance(theta.least_squares()), 2.0)  # a first guess
        self._detector = DisagreementDetector(n, self._belief, self._level, self._found)
        self._groups, self._rows = [], []

    def _squares(self) -> Array:
        """(e, n) mean squares of the learned effects' parameters."""
        own = slice(10 * self._n, self._size)
        squares = np.square(self._belief.mean()[own]) + np.square(self._belief.std()[own])
        return np.asarray(squares.reshape(-1, self._n))

    def _group(
        self, learner: OnlineLearner, frames: LearnedFrames, t: Array, table: Array
    ) -> RowGroup:
        states = np.zeros((len(table), self._layout.before_links.stop))
        states[:, self._layout.q.start :] = table
        at = self._layout.signals(states, learner.theta.smoothing_s)
        q, dq, ddq, tau = (np.ascontiguousarray(x) for x in at[:4])
        Y = frames.regressor(q, dq, ddq)
        tool = Y[:, :, -10:] @ self._tool
        columns = list(learner.theta.torque_per_unit(at))
        columns += [at.direction * np.exp(-np.square(dq / speed)) for speed in STRIBECK_SPEEDS]
        links, joints = Y.shape[2], np.arange(self._n)
        Z = np.zeros((len(t), self._n, links + len(columns) * self._n))
        Z[:, :, :links] = Y
        for k, column in enumerate(columns):
            Z[:, joints, links + k * self._n + joints] = column
        model = Z @ self._belief.mean()[: Z.shape[2]] + tool
        signatures = frames.signatures(q, dq, ddq, model, Y)
        # a joint that comes to a rest or leaves one within a row rests in it
        slowest = np.maximum(np.abs(dq) - 1e-9 * BLOCK_NS * np.abs(ddq), 0.0)
        # (N m)²; at a rest static friction is one unknown value however many rows the rest lasts:
        # those of a second tell then as much as one
        held = np.square(slowness(slowest)) * learner.theta.banded(self._squares())
        unsure = np.where(slowest < SMOOTHING_DQ, 1e9 / BLOCK_NS, 1.0) * held
        rates = np.hstack([dq, ddq])
        new = is_new(rates, self._rates).astype(float)
        return RowGroup(t, Z, signatures, tau - tool, unsure, rates, new)

    def _absorb(self, group: RowGroup) -> None:
        """Learn from a group that left the window, and its noise."""
        Z = self._found.columns(group)
        own = self._level.weight(group.unsure)
        weight = self._found.weights(group.t, own)
        residual = group.tau - Z @ self._belief.mean()
        if (weight == own).all():
            self._level.look(residual, group.unsure)
        flat = Z.reshape(-1, Z.shape[2])
        self._belief.absorb(flat, weight.ravel(), group.tau.ravel(), keep=1.0 - 0.2 / 120.0)
        self._found.forget_before(float(group.t[0]), self._belief)
        further = extremes(np.concatenate([self._rates, group.rates]))
        self._rates += 0.2 * (further - self._rates)  # seen, a new rate is known after a second
