"""Learning from a whole table of filtered states at once: the same moments, fewer ADAM steps.

λ takes all states first, then θ takes them all with the λ they led to; live, θ has to do
without the states before λ had converged. Moments need no steps to be complete, so as many steps
as live are taken until λ and θ have converged, and few from there on, for many states at once.
What θ needs of the states waits in a temporary file while λ takes them.

Neighbours behind a filter of some hertz tell the same a thousand times a second. So of states
whose link motion was synthesized only every k-th is taken, with the weight of k: `PER_SAMPLE`
for each independent one that the filter lets through (its band and the rate of the states say
how many states that is). What the rest would add is some percent of a standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import Mode
from adapter.model.spatial import Array
from adapter.signals.records import KIND, LinkMotionKind, stamp_of, stamps_of
from drivers.files.rows import RowsFile

# States taken at once where few steps are; more, and a change at the hand would be seen late. Of a
# long recording it is one of so many parts, up to another number of states that are taken.
SETTLED, PARTS, MOST_TAKEN = 100, 2000, 50
# θ takes as many steps as states at first, at a higher rate, then while so many of them or more
# gain more than this share of the joints' error variances; else a few.
FIRST_STEPS, FIRST_RATE = 2000, 1.75
GAIN_STEPS, GAIN, FEW_STEPS = 40, 0.003, 4
# (steps, share of the usual rate) at the end, at most so many times, to the optimum
PER_SAMPLE = 10  # states taken for each independent one
TRIPLES, APART = 2000, 8  # of neighbouring states, which tell the noise; at first so many apart


class Waiting(NamedTuple):
    """What waits for θ.

    Attributes:
        rows: columns `before_links` of every `every`-th state.
        before: how many of them came before λ had converged.
        every: see there.
        triples: (t, 3, w) the same of neighbouring states, t at most `TRIPLES`.
    """

    rows: RowsFile
    before: int
    every: int
    triples: Array


def learn_batch(
    learner: OnlineLearner, tables: Iterable[Array], every: int, progress: Callable[[int], None]
) -> None:
    """Learn from states, `every` of them at a time.

    Args:
        tables: states (m, size), one table after the other.
        progress: called with the number of states done.
    """
    waiting = _learn_schema(learner, tables, every)
    if learner.settings.wait_for_schema and not learner.schema.converged:
        return
    learner.learn_schema(_NO_STATES, 300)  # more steps, to the optimum
    if not len(waiting.rows):
        return
    learner.start_theta(stamp_of(waiting.rows.rows(0, 1)[0]))
    learner.take_every(waiting.every, waiting.triples)
    _learn_theta(learner, waiting, every, progress)
    for _ in range(8):
        for steps, share in ((250, 1.0), (250, 0.3)):
            learner.adam.rate = share * learner.settings.theta.rate
            learner.learn_theta(_NO_STATES, steps)
            learner.theta.adapt_prior(None if learner.rates is None else learner.rates.noise)
        if _gain(learner, learner.theta.least_squares()) > -GAIN:
            break
    learner.follow_convergence()
    learner.take_every(1)


def thinning(learner: OnlineLearner, table: Array) -> int:
    """Of how many states one is enough for a learner that knows nothing yet."""
    s = learner.settings
    forgets = s.schema.forget_s is not None or s.theta.forget_s is not None
    steps_ns = np.diff(stamps_of(table))
    if learner.tree.floating or learner.learned or forgets or s.mode != Mode.MOMENTS:
        return 1
    if not len(steps_ns):
        return 1
    longest = 10_000_000 // max(int(np.median(steps_ns)), 1)  # ns from one to the next
    return int(max(min(learner.theta.noise_gain // PER_SAMPLE, longest), 1))


def _learn_schema(learner: OnlineLearner, tables: Iterable[Array], every: int) -> Waiting:
    """Let λ take all states."""
    at = learner.layout.before_links
    kept, thin, triples = RowsFile(at.stop), 0, _Triples(at.stop)
    before = waiting = 0
    for table in tables:
        states = learner.without_known(table)
        if not len(states):
            continue
        thin = thin or thinning(learner, states)
        taken = np.ascontiguousarray(states[-before % thin :: thin])
        kept.append(taken[:, at])
        triples.take(states[:, at])
        if (states[:, KIND] == LinkMotionKind.DOCUMENTED).all():
            _take_for_schema(learner, taken, every, thin)
            learner.learned += len(states) - len(taken)
        else:
            _take_for_schema(learner, states, every, 1)
        before += len(states)
        if not learner.schema.converged:
            waiting = len(kept)
    learner.take_every(1)
    for _ in range(2000):  # at most, until λ has converged
        if learner.schema.converged:
            break
        learner.learn_schema(_NO_STATES)
    return Waiting(kept, waiting, max(thin, 1), triples.rows())


def _take_for_schema(learner: OnlineLearner, states: Array, every: int, thin: int) -> None:
    learner.schema.weight, done = float(thin), 0
    together = max(every // thin, 1)
    while done < len(states):
        settled = learner.schema.converged
        batch = states[done : done + (SETTLED if settled else together)]
        done += len(batch)
        learner.learn_schema(batch, 1 if settled else together * thin)


def _learn_theta(
    learner: OnlineLearner, waiting: Waiting, every: int, progress: Callable[[int], None]
) -> None:
    """Let θ take all states; it begins to step behind those that came before λ, as live."""
    theta, usual = learner.theta, learner.settings.theta.rate
    torque, before, thin, _ = waiting
    together = max(every // thin, 1)
    settled = max(SETTLED // thin, min(len(torque) // PARTS, MOST_TAKEN))
    for start in range(0, before, settled):
        learner.learn_theta(torque.rows(start, min(start + settled, before)), 0)
    moving, start, looked_at, seen = True, before, theta.updates, theta.th.copy()
    while start < len(torque):
        progress(thin * start)
        batch = torque.rows(start, start + (together if moving else settled))
        learner.adam.rate = FIRST_RATE * usual if theta.updates < FIRST_STEPS else usual
        learner.learn_theta(batch, together * thin if moving else FEW_STEPS)
        if not moving or theta.updates >= looked_at + GAIN_STEPS:
            moving = theta.updates < FIRST_STEPS or _gain(learner, seen) > GAIN
            looked_at, seen = theta.updates, theta.th.copy()
        start += len(batch)


def _gain(learner: OnlineLearner, before: Array) -> float:
    """Mean share of the joints' error variances that went, on all samples, from `before` (P,)."""
    theta = learner.theta
    return float(np.mean(1.0 - theta.variance() / theta.variance(before)))


class _Triples:
    """Three neighbouring states, again and again; ever further apart the more there are."""

    def __init__(self, width: int) -> None:
        self._kept, self._apart = [np.zeros((0, 3, width))], APART

    def take(self, table: Array) -> None:
        """Take states (m, w) that follow."""
        first = np.arange(0, len(table) - 2, self._apart)
        self._kept.append(table[first[:, None] + np.arange(3)])
        while sum(map(len, self._kept)) > TRIPLES:
            self._kept, self._apart = [self.rows()[::2]], 2 * self._apart

    def rows(self) -> Array:
        """(t, 3, w)."""
        return np.concatenate(self._kept)


_NO_STATES = np.empty((0, 0))
