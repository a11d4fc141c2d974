"""Learning from a whole table of filtered states at once: the same moments, fewer ADAM steps.

λ takes all states first, then θ takes them all with the λ they led to; live, θ has to do
without the states before λ had converged. Moments need no steps to be complete, so the steps
that were saved on the way are made up for, in part, at the end.
"""

from __future__ import annotations

from collections.abc import Callable

from adapter.learner import Learner
from adapter.records import Array, stamp_of

SCHEMA_STEPS = 2000  # at most, at the end, until λ has converged
SCHEMA_POLISH = 300  # more of them, to the optimum
# (steps, share of the usual rate) at the end; the first stretch covers the distance
THETA_STEPS = ((1500, 3.0), (1500, 1.0), (1000, 0.3))
ADAPT_EVERY = 250  # steps between two looks at how large the effects are
RATE_WHILE_READING = 3.0  # times the usual rate, to cover the distance in fewer steps


def learn_batch(
    learner: Learner, states: Array, every: int, progress: Callable[[int], None]
) -> None:
    """Learn from states (m, size), one update of λ and one of θ for every `every` of them.

    Args:
        progress: called with the number of states done.
    """
    if not len(states):
        return
    states = learner.without_known(states)
    starts = range(0, len(states), every)
    for start in starts:
        learner.learn_schema(states[start : start + every])
    for _ in range(SCHEMA_STEPS):
        if learner.schema.converged:
            break
        learner.learn_schema(states[:0])
    if learner.settings.wait_for_schema and not learner.schema.converged:
        return
    for _ in range(SCHEMA_POLISH):
        learner.learn_schema(states[:0])
    learner.start_theta(stamp_of(states[0]))
    usual = learner.adam.rate
    learner.set_rate(RATE_WHILE_READING * usual)
    for start in starts:
        learner.learn_theta(states[start : start + every])
        progress(start)
    for steps, share in THETA_STEPS:
        learner.set_rate(share * usual)
        for k in range(steps):
            learner.learn_theta(states[:0])
            if k % ADAPT_EVERY == 0:
                learner.theta.adapt_effects()
    learner.set_rate(usual)
