"""Learning from a whole table of filtered states at once: the same moments, fewer ADAM steps.

λ takes all states first, then θ takes them all with the λ they led to; live, θ has to do
without the states before λ had converged. Moments need no steps to be complete, so as many steps
as live are taken until λ and θ have converged, and few from there on, for many states at once.
What θ needs of the states waits in a temporary file while λ takes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from adapter.learning.learner import OnlineLearner
from adapter.model.spatial import Array
from adapter.signals.records import stamp_of
from drivers.files.rows import RowsFile

SCHEMA_STEPS = 2000  # at most, at the end, until λ has converged
SCHEMA_POLISH = 300  # more of them, to the optimum
# States taken at once where few steps are; more, and a change at the hand would be seen late.
SETTLED = 100
# θ takes as many steps as states at first, at a higher rate, then while that gains more than this
# share of the joints' error variances, as a look at every so many batches tells; else a few.
FIRST_STEPS, FIRST_RATE = 2000, 1.75
GAIN, LOOK_EVERY, FEW_STEPS = 0.003, 4, 4
# (steps, share of the usual rate) at the end, to the optimum
THETA_POLISH = ((250, 1.0), (250, 0.3))


def learn_batch(
    learner: OnlineLearner, tables: Iterable[Array], every: int, progress: Callable[[int], None]
) -> None:
    """Learn from states, `every` of them at a time.

    Args:
        tables: states (m, size), one table after the other.
        progress: called with the number of states done.
    """
    torque, waiting = _learn_schema(learner, tables, every)
    if learner.settings.wait_for_schema and not learner.schema.converged:
        return
    learner.learn_schema(_NO_STATES, SCHEMA_POLISH)
    if not len(torque):
        return
    learner.start_theta(stamp_of(torque.rows(0, 1)[0]))
    _learn_theta(learner, torque, every, waiting, progress)
    for steps, share in THETA_POLISH:
        learner.set_rate(share * learner.settings.theta.rate)
        learner.learn_theta(_NO_STATES, steps)
        learner.theta.adapt_prior(None if learner.rates is None else learner.rates.noise)
    learner.follow_convergence()


def _learn_schema(
    learner: OnlineLearner, tables: Iterable[Array], every: int
) -> tuple[RowsFile, int]:
    """Let λ take all states.

    Returns:
        What θ needs of them (m, columns `before_links`), and how many came before λ had converged.
    """
    kept, waiting, before = RowsFile(learner.layout.before_links.stop), 0, 0
    for table in tables:
        states = learner.without_known(table)
        kept.append(states[:, learner.layout.before_links])
        done = 0
        while done < len(states):
            settled = learner.schema.converged
            batch = states[done : done + (SETTLED if settled else every)]
            done += len(batch)
            if not settled:
                waiting = before + done
            learner.learn_schema(batch, 1 if settled else every)
        before += len(states)
    for _ in range(SCHEMA_STEPS):
        if learner.schema.converged:
            break
        learner.learn_schema(_NO_STATES)
    return kept, waiting


def _learn_theta(
    learner: OnlineLearner,
    torque: RowsFile,
    every: int,
    waiting: int,
    progress: Callable[[int], None],
) -> None:
    """Let θ take all states; it begins to step behind the first `waiting` of them, as live."""
    theta, usual = learner.theta, learner.settings.theta.rate
    for start in range(0, waiting, SETTLED):
        learner.learn_theta(torque.rows(start, min(start + SETTLED, waiting)), 0)
    moving, start, number = True, waiting, 0
    while start < len(torque):
        progress(start)
        batch = torque.rows(start, start + (every if moving else SETTLED))
        learner.set_rate(FIRST_RATE * usual if theta.updates < FIRST_STEPS else usual)
        before = theta.th.copy()
        learner.learn_theta(batch, every if moving else FEW_STEPS)
        if not moving or number % LOOK_EVERY == 0:
            moving = theta.updates < FIRST_STEPS or _gain(learner, before) > GAIN
        start, number = start + len(batch), number + 1


def _gain(learner: OnlineLearner, before: Array) -> float:
    """Mean share of the joints' error variances that went, on all samples, from `before` (P,)."""
    theta = learner.theta
    return float(np.mean(1.0 - theta.variance() / theta.variance(before)))


_NO_STATES = np.empty((0, 0))
