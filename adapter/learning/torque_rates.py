"""Rates of the model's own torque around each state, for effects that need them.

A rate of a torque is far noisier than the torque, so differences are taken over a span in which
the filter lets next to nothing happen; the second one needs what comes that much later. States
therefore wait for as long before θ learns from them. What the torque sensors' low-pass is of does
not matter much: friction is left out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.kernels import (
    Frames,
    JointMotion,
    borrowed,
    inverse_dynamics,
    jit,
    link_motion,
)
from adapter.signals.records import StateLayout, columns

LONGEST_STEP_NS = 20_000_000  # between two states that a torque is interpolated between
ROOM = 512  # states that can wait


class Waiting(NamedTuple):
    """States that wait, in a ring.

    Attributes:
        rows: (ROOM, w); tau: (ROOM, n) N m by the model; stamps: (ROOM,) int64 ns.
        marks: (2,) int64 running numbers of the first state that waits, and of the next to come.
        bends: (n + 1,) sums of squares of the torque's second differences over their steps,
            (N m)²/s, and how many there are.
    """

    rows: Array
    tau: Array
    stamps: NDArray[np.int64]
    marks: NDArray[np.int64]
    bends: Array


@jit
def torque_at(stamp, near, ring, out):
    """Fill out (n,) with the torque at a stamp, searched for from the state `near` on."""
    first = max(ring.marks[1] - ROOM, 0)
    k = near
    while k > first and ring.stamps[k % ROOM] > stamp:
        k -= 1
    while k + 1 < ring.marks[1] and ring.stamps[(k + 1) % ROOM] <= stamp:
        k += 1
    a, b = k % ROOM, (k + 1) % ROOM
    step = ring.stamps[b] - ring.stamps[a]
    if ring.stamps[a] > stamp or k + 1 >= ring.marks[1]:
        exact = ring.stamps[a] == stamp
        out[:] = ring.tau[a]
        return exact
    if step <= 0 or step > LONGEST_STEP_NS:
        return False
    share = (stamp - ring.stamps[a]) / step
    for j in range(out.shape[0]):
        out[j] = ring.tau[a, j] + share * (ring.tau[b, j] - ring.tau[a, j])
    return True


@jit
def let_go(span_ns, ring, at, out):
    """Give the oldest state into out (w,), with its rates where its neighbours tell them."""
    n, number = ring.tau.shape[1], ring.marks[0]
    here = number % ROOM
    out[:] = ring.rows[here]
    before, behind = np.empty(n), np.empty(n)
    stamp, span_s = ring.stamps[here], 1e-9 * span_ns
    rates = out[at.rates : at.rates + 2 * n]
    rates[:] = 0.0
    known = torque_at(stamp - span_ns, number, ring, before)
    if known and torque_at(stamp + span_ns, number, ring, behind):
        for j in range(n):
            rates[j] = (behind[j] - before[j]) / (2.0 * span_s)
            rates[n + j] = (behind[j] - 2.0 * ring.tau[here, j] + before[j]) / span_s**2
    ring.marks[0] += 1


@jit
def bend(tau, one, two, step_s, bends):
    """Add squares of the second differences of torques (n,) over their step to bends (n + 1,)."""
    for j in range(tau.shape[0]):
        d = tau[j] - 2.0 * one[j] + two[j]
        bends[j] += d * d / step_s
    bends[tau.shape[0]] += 1.0


@jit
def model_torque(frames, theta, row, at, rest, tau):
    """Fill tau (rows,) with what the bodies make of a state; `rest` as of `follow`'s arm."""
    base = rest if rest.shape[0] else row[at.base : at.bent]
    q, dq, ddq = row[at.q : at.dq], row[at.dq : at.ddq], row[at.ddq : at.tau]
    motion = np.empty((frames.parent.shape[0], 12))
    link_motion(frames, JointMotion(q, dq, ddq), base, motion)
    inverse_dynamics(frames, theta, q, motion, base, tau)


@jit
def bend_all(arm, triples, bends):
    """Add those of states (t, 3, w) that follow each other; `arm` as of `follow`."""
    placed, theta, rest = arm
    frames, n, six = Frames(*placed), placed[0].shape[0], 0 if rest.shape[0] else 6
    at, tau = columns(n, six > 0), np.empty((3, n + six))
    for m in range(triples.shape[0]):
        for k in range(3):
            model_torque(frames, theta, triples[m, k], at, rest, tau[k])
        first, last = triples[m, 0, :1].view(np.int64)[0], triples[m, 2, :1].view(np.int64)[0]
        if 0 < last - first <= LONGEST_STEP_NS:
            bend(tau[2, six:], tau[1, six:], tau[0, six:], 0.5e-9 * (last - first), bends)


@jit
def follow(arm, table, span_ns, waiting, out):
    """Take states (m, w); fill out with those that need not wait any more, and count them.

    Args:
        arm: `Frames`, θ (bodies, 10), and the motion (12,) of a base that rests, or nothing.
        waiting: `Waiting`, as a plain tuple.
    """
    arm, table, waiting, out = borrowed((arm, table, waiting, out))
    placed, theta, rest = arm
    frames, ring = Frames(*placed), Waiting(*waiting)
    n, six, count = frames.parent.shape[0], 0 if rest.shape[0] else 6, 0
    at = columns(n, six > 0)
    tau = np.empty(n + six)
    for m in range(table.shape[0]):
        row = table[m]
        stamp = row[:1].view(np.int64)[0]
        last = ring.stamps[(ring.marks[1] - 1) % ROOM]
        if ring.marks[1] and not 0 < stamp - last <= LONGEST_STEP_NS:
            while ring.marks[0] < ring.marks[1]:
                let_go(span_ns, ring, at, out[count])
                count += 1
            ring.marks[:] = 0
        here = ring.marks[1] % ROOM
        model_torque(frames, theta, row, at, rest, tau)
        ring.rows[here], ring.tau[here], ring.stamps[here] = row, tau[six:], stamp
        ring.marks[1] += 1
        if ring.marks[1] > 2:
            one, two = (here - 1) % ROOM, (here - 2) % ROOM
            step_s = 0.5e-9 * (stamp - ring.stamps[two])
            bend(tau[six:], ring.tau[one], ring.tau[two], step_s, ring.bends)
        while ring.marks[0] < ring.marks[1] and (
            stamp - ring.stamps[ring.marks[0] % ROOM] >= span_ns
            or 2 * (ring.marks[1] - ring.marks[0]) >= ROOM
        ):
            let_go(span_ns, ring, at, out[count])
            count += 1
    return count


@jit
def coming(table, span_ns, waiting, out, ends):
    """What `follow` will give for each of some states (m, w), but for rates.

    Args:
        waiting: `Waiting`, as a plain tuple; nothing is changed.
        out: (k, w) filled; ends: (m,) filled with how many of them are given by then.

    Returns:
        How many of the states come without a hole in time.
    """
    ring = Waiting(*waiting)
    first, known, given, w = ring.marks[0], ring.marks[1], 0, ring.rows.shape[1]
    if not known:
        return 0
    last = ring.stamps[(known - 1) % ROOM]
    for m in range(table.shape[0]):
        stamp = table[m, :1].view(np.int64)[0]
        if not 0 < stamp - last <= LONGEST_STEP_NS:
            return m
        last, behind = stamp, known + m + 1
        while first < behind:
            old = ring.rows[first % ROOM] if first < known else table[first - known, :w]
            waits = stamp - old[:1].view(np.int64)[0] < span_ns
            if waits and 2 * (behind - first) < ROOM:
                break
            out[given] = old
            given += 1
            first += 1
        ends[m] = given
    return table.shape[0]


class TorqueRates:
    """States with the rates of their torque, as soon as those can be told.

    Args:
        tree: N; smoothing_s: how long the filter before takes a step of torque.
        delay_s: of that filter.

    Attributes:
        rows, tau, stamps, marks, bends: see `Waiting`.
    """

    def __init__(self, tree: Tree, smoothing_s: float, delay_s: float) -> None:
        layout = StateLayout(tree.n, tree.floating)
        self._parent = np.array(tree.parent, dtype=np.int64)
        self._slides = np.array(tree.slides)
        self._width = layout.before_links.stop
        self._span_ns = round(1e9 * max(smoothing_s, 5e-3))  # where no filter was
        rows, tau = np.zeros((ROOM, self._width)), np.zeros((ROOM, tree.n))
        stamps, marks, bends = np.zeros(ROOM, np.int64), np.zeros(2, np.int64), np.zeros(tree.n + 1)
        self._ring = Waiting(rows, tau, stamps, marks, bends)
        self.rows, self.tau, self.stamps, self.marks, self.bends = self._ring
        self._delay_s, self._span = delay_s, self._span_ns
        self._triples: Array | None = None
        self._arm: tuple[Any, ...] | None = None
        self._one = np.empty((ROOM + 1, self._width))

    def take_every(self, states: int, triples: Array | None = None) -> None:
        """Expect every so-manyth state, the others being left out.

        Differences are then taken over a span of so many whole steps, and the noise is that of
        triples (t, 3, w) of neighbours among all states; steps are the median of theirs.
        """
        if self._triples is not None:
            self.bends[:] = self._bends()
        self._span_ns, self._triples = self._span, None
        if states > 1 and triples is not None and len(triples):
            stamps = np.ascontiguousarray(triples[:, :, 0]).view(np.int64)
            step_ns = states * int(np.median(np.diff(stamps, axis=1)))
            self._span_ns = max(round(self._span / step_ns), 1) * step_ns
            self._triples = np.ascontiguousarray(triples)

    @property
    def noise(self) -> Array:
        """(n,) variance, (N m)², that noise of the measured motion puts on the model's torque.

        White noise of dq that leaves the filter as ddq bends from sample to sample in a known
        proportion to its size (poles at 45 degrees, k1 = 2 / delay); motion hardly bends there.
        """
        bends = self._bends()
        return np.asarray(bends[:-1] / max(bends[-1], 1.0) * self._delay_s / 8.0)

    def _bends(self) -> Array:
        """(n + 1,) see `Waiting`."""
        if self._triples is None or self._arm is None:
            return self.bends
        bends = np.zeros_like(self.bends)
        bend_all(self._arm, self._triples, bends)
        return bends

    def coming(self, table: Array) -> tuple[Array, NDArray[np.int64]]:
        """What `follow` gives for each of the states (m, size), if they came one by one.

        Returns:
            (k, columns `before_links`) without rates, and (c,) how many of them come with each
            of the first c states; there is a hole in time behind those.
        """
        own = np.ascontiguousarray(table[:, : self._width])
        out = np.empty((ROOM + len(own), self._width))
        ends = np.zeros(len(own), dtype=np.int64)
        ends = ends[: coming(own, self._span_ns, tuple(self._ring), out, ends)]
        return out[: ends[-1] if len(ends) else 0], ends

    @property
    def parts(self) -> tuple[Any, ...]:
        """Span in ns, what waits, and room for rows that are given at a time; see `steps`."""
        return self._span_ns, tuple(self._ring), self._one

    def follow(self, table: Array, frames: tuple[Array, Array], theta: Array, base: Array) -> Array:
        """States (k, columns `before_links`) that are complete now; the next call may reuse them.

        Args:
            table: (m, size) states, or their `before_links`, that follow those before.
            frames: R0 (n, 3, 3) and p (n, 3); theta: (bodies, 10).
            base: (12,) motion of a base that rests; empty where the states have it.
        """
        table = table[:, : self._width]
        out = self._one if len(table) == 1 else np.empty((ROOM + len(table), self._width))
        arm = self._arm = (self._parent, *frames, self._slides), theta, base
        return out[: follow(arm, table, self._span_ns, tuple(self._ring), out)]
