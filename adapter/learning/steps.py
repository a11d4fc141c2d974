"""Many steps of the learner in one call: what `OnlineLearner.step` does with one state, in order.

At 1 kHz a step waits for its state. A recording's states are all there, and between two looks at
λ nothing is decided that a kernel could not decide, so that these cost one call.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.learning.adam import adam_step
from adapter.learning.change import compare
from adapter.learning.schema_kernels import Count, MotionMoments, absorb, descend, retract
from adapter.learning.theta_kernels import Rows, gradient
from adapter.learning.theta_kernels import absorb as absorb_torque
from adapter.learning.theta_kernels import follow as follow_mean
from adapter.learning.torque_rates import follow as follow_rates
from adapter.model.spatial import Array
from adapter.physics.kernels import borrowed, jit


class SchemaParts(NamedTuple):
    """λ's, as `Schema` has them.

    Attributes:
        frames, moments: `Frames` and `MotionMoments` as plain tuples.
        base: (12,) motion of the base; kind: of link motion; weight: of a sample.
        may_move, inverse, distance: of `retract` and `descend`.
        pace: of `retract`, without ADAM's rate.
        tangent, gradient: (n, 6).
    """

    frames: tuple
    moments: tuple
    base: Array
    kind: float
    weight: float
    may_move: Array
    inverse: Array
    distance: Array
    pace: tuple[float, float]
    tangent: Array
    gradient: Array


class ThetaParts(NamedTuple):
    """θ's, as `Theta` has them.

    Attributes:
        frames: that its moments are made with; rows, given: of `absorb`, as plain tuples.
        sums: moments, rate of forgetting and weight of a sample, likewise.
        prior, weighing: of `gradient`, as plain tuples.
        x, mean, th: (P,); work: three of (P,), of `gradient`.
        in_use: (bodies,) see `Theta.in_use`.
        span: updates that the mean goes over; updates: so far.
    """

    frames: tuple
    rows: tuple
    given: tuple
    sums: tuple
    prior: tuple
    weighing: tuple
    x: Array
    mean: Array
    th: Array
    work: tuple
    in_use: NDArray[np.int64]
    span: float
    updates: int


class RateParts(NamedTuple):
    """What `TorqueRates` has.

    Attributes:
        span_ns: 0 where no effect asks for rates, and the rest is not looked at.
        waiting: `Waiting` as a plain tuple; bodies (b, 10) and buffer (k, w) are overwritten.
        which: (c, 2) columns of effects that are rates, and where these begin in a state.
    """

    span_ns: int
    waiting: tuple
    bodies: Array
    buffer: Array
    which: NDArray[np.int64]


class ChangeParts(NamedTuple):
    """What `ChangeDetector` has.

    Attributes:
        speeds: `fast` and `slow`; samples: so far.
        recent, level: (n,) of `compare`.
        most: ratios of `compare` below which nothing is an alarm; infinite while nothing is.
    """

    speeds: tuple[int, int]
    samples: int
    recent: Array
    level: Array
    most: tuple[float, float]


class AdamParts(NamedTuple):
    """What `FlatAdam` has: four of (P,), steps so far, and (rate, beta1, beta2)."""

    parameters: Array
    gradient: Array
    first: Array
    second: Array
    steps: int
    pace: tuple[float, float, float]


class Done(NamedTuple):
    """What `steps` leaves, by step (m) or by state that θ was given (k).

    Attributes:
        rows: (k, w) states that θ was given; columns: (k, e, n) of the effects; errors: (k, n) N m.
        ends: (m,) how many of them there were behind each step.
        ratios: (m, 2) of `compare`.
        th: (m, P) θ and effects before each step; R0 (m, n, 3, 3) and p (m, n, 3): λ after it.
    """

    rows: Array
    columns: Array
    errors: Array
    ends: NDArray[np.int64]
    ratios: Array
    th: Array
    R0: Array
    p: Array


@jit
def steps(table, parts, done):
    """Learn from states (m, size) one after the other; behind how many it stopped.

    It stops early behind a state whose error may be a change at the hand. λ has seen the first
    state already, and has its gradient.

    Args:
        parts: λ's, θ's, those of rates, of changes and of ADAM, as plain tuples.
        done: `Done` as a plain tuple, whose rows but for rates, columns and ends are filled.
    """
    parts, done = borrowed((parts, done))
    schema, theta, rates = SchemaParts(*parts[0]), ThetaParts(*parts[1]), RateParts(*parts[2])
    change, adam, out = ChangeParts(*parts[3]), AdamParts(*parts[4]), Done(*done)
    parent, R0, p = schema.frames
    known = MotionMoments(*schema.moments)
    sizes, n, begin = Rows(*theta.rows).steps, parent.shape[0], 0
    data = theta.sums[0][0], theta.sums[0][1]
    pace = schema.pace[0], schema.pace[1], adam.pace[0]
    before_links = table[:, : out.rows.shape[1]].copy()
    for m in range(table.shape[0]):
        one, end = table[m : m + 1], out.ends[m]
        if m:
            each = 1.0, schema.weight
            absorb(parent, schema.base, one, schema.moments, schema.kind, each)
            found = schema.gradient, schema.distance
            samples = known.counts[Count.SAMPLES]
            descend(schema.frames, known.M, samples, schema.inverse, *found)
        out.th[m] = theta.th
        if rates.span_ns:
            for b in range(theta.in_use.shape[0]):
                rates.bodies[b] = theta.th[10 * theta.in_use[b] : 10 * theta.in_use[b] + 10]
            arm = *theta.frames, rates.bodies, schema.base
            state = before_links[m : m + 1]
            follow_rates(arm, state, rates.span_ns, rates.waiting, rates.buffer)
            for k in range(begin, end):
                out.rows[k] = rates.buffer[k - begin]
                for c in range(rates.which.shape[0]):
                    at = rates.which[c, 1]
                    out.columns[k, rates.which[c, 0]] = out.rows[k, at : at + n]
        suspect = False
        if end > begin:
            own, columns = out.rows[begin:end], out.columns[begin:end]
            error = absorb_torque(theta.frames, theta.rows, theta.given, own, columns, theta.sums)
            out.errors[begin:end] = error
            levels = change.recent, change.level
            ratios = compare(error, 1, change.speeds, change.samples + end, *levels)
            out.ratios[m, 0], out.ratios[m, 1] = ratios
            suspect = ratios[0] > change.most[0] or ratios[1] > change.most[1]
        gradient(theta.x, theta.rows, data, theta.prior, theta.weighing, theta.work)
        moved = adam.parameters, adam.gradient, adam.first, adam.second
        adam_step(*moved, adam.steps + m + 1, adam.pace)
        retract(schema.frames, schema.tangent, schema.may_move, schema.distance, pace)
        span = min(float(theta.updates + m + 1), theta.span)
        follow_mean(theta.x, span, sizes, theta.mean, theta.th)
        out.R0[m], out.p[m] = R0, p
        if suspect:
            return m + 1
        begin = end
    return table.shape[0]
