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
        parts: as plain tuples, `SchemaParts`; `ThetaParts`; of rates `TorqueRates.parts`, the span
            0 where no effect asks for them, room (b, 10) for θ in use, and (c, 2) columns of
            effects that are rates, and where these begin in a state; `ChangeDetector.parts`;
            `FlatAdam.parts`.
        done: `Done` as a plain tuple, whose rows but for rates, columns and ends are filled.
    """
    parts, done = borrowed((parts, done))
    schema, theta, out = SchemaParts(*parts[0]), ThetaParts(*parts[1]), Done(*done)
    span_ns, waiting, buffer, bodies, which = parts[2]
    speeds, samples, recent, level, most = parts[3]
    parameters, slope, first, second, taken, adam_pace = parts[4]
    parent, R0, p, _ = schema.frames
    known = MotionMoments(*schema.moments)
    sizes, n, begin = Rows(*theta.rows).steps, parent.shape[0], 0
    data = theta.sums[0][0], theta.sums[0][1]
    pace = schema.pace[0], schema.pace[1], adam_pace[0]
    before_links = table[:, : out.rows.shape[1]].copy()
    for m in range(table.shape[0]):
        one, end = table[m : m + 1], out.ends[m]
        if m:
            each = 1.0, schema.weight
            absorb(schema.frames, schema.base, one, schema.moments, schema.kind, each)
            found = schema.gradient, schema.distance
            count = known.counts[Count.SAMPLES]
            descend(schema.frames, known.M, count, schema.inverse, *found)
        out.th[m] = theta.th
        if span_ns:
            for b in range(theta.in_use.shape[0]):
                bodies[b] = theta.th[10 * theta.in_use[b] : 10 * theta.in_use[b] + 10]
            arm = theta.frames, bodies, schema.base
            state = before_links[m : m + 1]
            follow_rates(arm, state, span_ns, waiting, buffer)
            for k in range(begin, end):
                out.rows[k] = buffer[k - begin]
                for c in range(which.shape[0]):
                    at = which[c, 1]
                    out.columns[k, which[c, 0]] = out.rows[k, at : at + n]
        suspect = False
        if end > begin:
            own, columns = out.rows[begin:end], out.columns[begin:end]
            error = absorb_torque(theta.frames, theta.rows, theta.given, own, columns, theta.sums)
            out.errors[begin:end] = error
            ratios = compare(error, 1, speeds, samples + end, recent, level)
            out.ratios[m, 0], out.ratios[m, 1] = ratios
            suspect = ratios[0] > most[0] or ratios[1] > most[1]
        gradient(theta.x, theta.rows, data, theta.prior, theta.weighing, theta.work)
        adam_step(parameters, slope, first, second, taken + m + 1, adam_pace)
        retract(schema.frames, schema.tangent, schema.may_move, schema.distance, pace)
        span = min(float(theta.updates + m + 1), theta.span)
        follow_mean(theta.x, span, sizes, theta.mean, theta.th)
        out.R0[m], out.p[m] = R0, p
        if suspect:
            return m + 1
        begin = end
    return table.shape[0]
