"""Motion of a position-controlled arm under its commands, compiled.

A servo, divided by its position gain kp (so that what encoders alone show stands apart from the
scale that only the documented masses set):

    q_cmd(t - d) - q + lead dq_cmd(t - d) = a tau_rigid + inertia ddq + damping dq + f(dq) sign(dq)

with a = 1 / kp, lead the fed-forward speed's gain over kp (s), damping (s) that of the velocity
gain and viscous friction together, inertia the armature's (s²), and f = rubs + sticks max(0, 1 -
|dq| / slips) dry friction: Coulomb's, and what it takes more to break a joint loose (rad).
A servo may drive nothing while its error is within `dead` (rad), and no harder than at an error of
1 / tight (rad), the part `within` (s) of its damping included. A gear with backlash gives way to
its load by `play` (rad), half of what it has: the motor, by which the servo steers, is ahead by it.
Both simulations take the implicit midpoint rule, and friction holds a joint whose speed would
change sign. Where the hand rests on something level, a stiff spring carries it (`Ground`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from adapter.model.spatial import Array
from adapter.physics.kernels import (
    Frames,
    JointMotion,
    inverse_dynamics,
    jit,
    link_motion,
    place_frames,
)

SWEEPS, SETTLED = 60, 1e-9  # of the joints' speeds in a step; rad/s
# rad/s (or m/s where a joint slides) at which nothing is left of it, where nobody says otherwise:
# Stribeck's curve as a line, which simulators can hold. It has the area of one of 0.1, the upper
# end of published ones of gears
SLIP = 0.2

# columns of a table of servos; the delay acts on commands, before all this
A, LEAD, DAMPING, INERTIA, RUBS, DELAY, STICKS, TIGHT, DEAD, PLAY, SLIPS, WITHIN = range(12)
LEAST_LOAD = 0.02  # N m, from which on a gear rests on one side of its play


class Load(NamedTuple):
    """What the arm makes of one joint's motion, at every step's middle, (m,) each.

    Attributes:
        mass: moment of inertia that the joint moves, kg m².
        other: the rigid torque beside mass times acceleration, N m.
        lift: what the hand rises by per rad of the joint, times the root of the ground's stiffness.
        gap: how far it is above the ground with the joint at zero, times the same.
        push: what of the ground's force, over the depth times the same, acts on the joint: `lift`
            where nothing rubs.
        side: on which side of its play the rigid torque holds the gear, -1 to 1.
    """

    mass: Array
    other: Array
    lift: Array
    gap: Array
    push: Array
    side: Array


class Ground(NamedTuple):
    """Something level and stiff that carries the hand where it comes down on it, and rubs it.

    Attributes:
        link: (from 0) that touches it; point: (3,) m, where, in that link's frame.
        up: (3,) unit vector, base axes; height: m, over the base's origin.
        root: of its stiffness, sqrt(N/m), along it as well; 0 where there is none.
        rubs: coefficient of friction, along it.
    """

    link: int
    point: Array
    up: Array
    height: float
    root: float
    rubs: float = 0.0


NO_GROUND = Ground(0, np.zeros(3), np.zeros(3), 0.0, 0.0)


class Body(NamedTuple):
    """The rigid arm, and what it may come down on, as compiled code takes it."""

    frames: Frames
    theta: Array
    base: Array
    ground: Ground


@jit
def over_ground(frames, ground, q, way, place):
    """Where the hand is over the ground and along it, times the root of its stiffness.

    Args:
        frames: `Frames`; ground: `Ground`; q: (n,) rad.
        way: (3, n) how far it goes up and along both axes per rad (or m) of each joint, filled.
        place: (3,) how far it is above the ground and along both axes, filled.
    """
    n, link, up = q.shape[0], ground.link, ground.up
    R, o = np.empty((n, 3, 3)), np.empty((n, 3))
    place_frames(frames, q, R, o)
    axes, x, goes = np.empty((3, 3)), np.empty(3), np.empty(3)
    least = 0
    for r in range(3):
        axes[0, r] = up[r]
        x[r] = o[link, r]
        for k in range(3):
            x[r] += R[link, r, k] * ground.point[k]
        if abs(up[r]) < abs(up[least]):
            least = r
    size = np.sqrt(1.0 - up[least] ** 2)
    for r in range(3):
        axes[1, r] = ((1.0 if r == least else 0.0) - up[least] * up[r]) / size
    for r in range(3):
        s, t = (r + 1) % 3, (r + 2) % 3
        axes[2, r] = up[s] * axes[1, t] - up[t] * axes[1, s]
    for i in range(3):
        place[i] = ground.root * (axes[i, 0] * x[0] + axes[i, 1] * x[1] + axes[i, 2] * x[2])
    place[0] -= ground.root * ground.height
    way[:] = 0.0
    j = link
    while j >= 0:
        for r in range(3):
            s, t = (r + 1) % 3, (r + 2) % 3
            goes[r] = R[j, s, 2] * (x[t] - o[j, t]) - R[j, t, 2] * (x[s] - o[j, s])
            if frames.slides[j]:
                goes[r] = R[j, r, 2]
        for i in range(3):
            along = axes[i, 0] * goes[0] + axes[i, 1] * goes[1] + axes[i, 2] * goes[2]
            way[i, j] = ground.root * along
        j = frames.parent[j]


@jit
def dragged(place, anchor, most):
    """Whether what a spring pulls (place, (3,), whose first is the height) to `anchor` slides.

    The anchor, (2,), follows so far that the spring pulls no more than `most`.
    """
    one, other = place[1] - anchor[0], place[2] - anchor[1]
    far = np.hypot(one, other)
    if far <= most:
        return False
    share = most / far
    anchor[0], anchor[1] = place[1] - share * one, place[2] - share * other
    return True


@jit
def touches(frames, ground, q, lift, above, push):
    """Along a motion q (m, n): lift, push (m, n), above (m,) as in `Load`, filled."""
    way, place, anchor = np.empty((3, q.shape[1])), np.empty(3), np.zeros(2)
    for k in range(q.shape[0]):
        over_ground(frames, ground, q[k], way, place)
        lift[k], push[k], above[k] = way[0], way[0], place[0]
        if place[0] < 0.0:
            dragged(place, anchor, -ground.rubs * place[0])
            one, other = place[1] - anchor[0], place[2] - anchor[1]
            push[k] += (way[1] * one + way[2] * other) / place[0]
        else:
            anchor[:] = place[1:]


@jit
def between(at, t, table, out):
    """A table (k, n) over t (k,), at (m,), between its rows by a line: out (m, n). Both ascend."""
    k, last = 0, t.shape[0] - 2
    for i in range(at.shape[0]):
        while k < last and t[k + 1] <= at[i]:
            k += 1
        share = 0.0
        if at[i] >= t[k + 1]:  # also where both are of one instant
            share = 1.0
        elif at[i] > t[k]:
            share = (at[i] - t[k]) / (t[k + 1] - t[k])
        for j in range(table.shape[1]):
            out[i, j] = table[k, j] + share * (table[k + 1, j] - table[k, j])


@jit
def dry_friction(x, speed):
    """Of a servo x (12,) at a speed, rad."""
    left = max(0.0, 1.0 - abs(speed) / x[SLIPS]) if x[STICKS] > 0.0 else 0.0
    return x[RUBS] + x[STICKS] * left


@jit
def kept_back(x, error, moves, damps):
    """What the drive of a servo x (12,) lacks, rad, in the mean of a step.

    Means over a straight way, so that edges within a step come out as they are.

    Args:
        error: rad, at its beginning; moves: what the joint goes in it; damps: what damping adds.
    """
    after, lost = error - moves, 0.0
    if x[DEAD] > 0.0:
        if abs(moves) > 1e-12:
            within, beyond = min(abs(error), x[DEAD]), min(abs(after), x[DEAD])
            lost = 0.5 * (within * within - beyond * beyond) / moves
        elif abs(error) < x[DEAD]:
            lost = error
    if x[TIGHT] > 0.0:
        edge = 1.0 / x[TIGHT]
        one, other = error - lost + damps, after - lost + damps
        if abs(moves) > 1e-12:
            over, under = max(abs(one) - edge, 0.0), max(abs(other) - edge, 0.0)
            lost += 0.5 * (over * over - under * under) / moves
        elif abs(one) > edge:
            lost += one - (edge if one > 0.0 else -edge)
    return lost


@jit
def follow_alone(x, goal, load, start, step, q):
    """One joint under its commands, the others' motion known.

    Args:
        x: (12,) the servo.
        goal: (2, m) q_cmd, and lead dq_cmd, over each step, rad.
        load: `Load`; start: (2,) q, dq before the first step; step: s.
        q: (m,) rad after each step, filled.
    """
    at, speed = start[0], start[1]
    damping = x[DAMPING]
    for k in range(goal.shape[1]):
        mass = x[A] * load.mass[k] + x[INERTIA]
        steers, holds = goal[0, k] - x[PLAY] * load.side[k], 1.0
        error, damps = steers - at, goal[1, k] - x[WITHIN] * speed
        steers += goal[1, k] - x[A] * load.other[k] - kept_back(x, error, step * speed, damps)
        if load.gap[k] + load.lift[k] * at < 0.0:
            steers -= x[A] * load.push[k] * load.gap[k]
            holds += x[A] * max(load.push[k] * load.lift[k], 0.0)
        left = step
        if speed != 0.0:
            way = 1.0 if speed > 0.0 else -1.0
            pull = 2.0 * mass / step * speed + steers - holds * at - way * dry_friction(x, speed)
            after = 2.0 * pull / (2.0 * mass / step + 0.5 * step * holds + damping) - speed
            # It stops within the step: only up to there does friction act this way. What follows
            # from the numbers then has no jumps, which a fit would be caught by.
            share = speed / (speed - after) if after * way < 0.0 else 1.0
            at += 0.5 * share * step * (speed + (after if share == 1.0 else 0.0))
            speed = after if share == 1.0 else 0.0
            left = (1.0 - share) * step
        force, rubs = steers - holds * at, dry_friction(x, 0.0)
        if left > 0.0 and abs(force) > rubs:
            force -= rubs if force > 0.0 else -rubs
            middle = force / (2.0 * mass / left + 0.5 * left * holds + damping)
            speed, at = 2.0 * middle, at + left * middle
        q[k] = at


@jit
def follow_together(x, goal, body, start, step, q):
    """All joints under their commands.

    Args:
        x: (n, 12) the servos; goal: (2, m, n) as for one joint.
        body: `Body`; start: (2, n) q, dq before the first step; step: s.
        q: (m, n) rad after each step, filled.
    """
    n = x.shape[0]
    at, speed, middle = start[0].copy(), start[1].copy(), start[1].copy()
    still, unit, motion = np.zeros(n), np.zeros(n), np.empty((n, 12))
    bias, column, base = np.empty(n), np.empty(n), np.zeros(12)
    mass, pull, ahead = np.empty((n, n)), np.empty(n), np.empty(n)
    before, way, place, anchor = speed.copy(), np.zeros((3, n)), np.ones(3), np.zeros(2)
    carries, stiff, rubs = np.zeros(n), np.zeros((n, n)), np.zeros(n)
    for k in range(goal.shape[1]):
        if body.ground.root > 0.0:
            over_ground(body.frames, body.ground, at, way, place)
        if place[0] < 0.0:
            slides = dragged(place, anchor, -body.ground.rubs * place[0])
            place[1] -= anchor[0]
            place[2] -= anchor[1]
            for j in range(n):
                carries[j] = -place[0] * way[0, j] - place[1] * way[1, j] - place[2] * way[2, j]
            sides = 1 if slides else 3
            for j in range(n):
                for i in range(n):
                    stiff[j, i] = 0.0
                    for r in range(sides):
                        stiff[j, i] += way[r, j] * way[r, i]
        else:
            anchor[:] = place[1:]
            stiff[:], carries[:] = 0.0, 0.0
        for j in range(n):
            ahead[j] = 1.5 * speed[j] - 0.5 * before[j]
        midway = at + 0.5 * step * speed
        link_motion(body.frames, JointMotion(midway, ahead, still), body.base, motion)
        inverse_dynamics(body.frames, body.theta, midway, motion, body.base, bias)
        for j in range(n):
            unit[j] = 1.0
            link_motion(body.frames, JointMotion(midway, still, unit), base, motion)
            inverse_dynamics(body.frames, body.theta, midway, motion, base, column)
            mass[:, j] = column
            unit[j] = 0.0
        for j in range(n):
            own = x[j, INERTIA] * speed[j]
            for i in range(n):
                own += x[j, A] * mass[j, i] * speed[i]
            error = goal[0, k, j] - at[j]
            pull[j] = 2.0 / step * own + goal[1, k, j] - x[j, A] * (bias[j] - carries[j])
            if x[j, PLAY] > 0.0:
                carried = bias[j]
                for i in range(n):
                    carried += mass[j, i] * (speed[i] - before[i]) / step
                error -= x[j, PLAY] * carried / np.hypot(carried, LEAST_LOAD)
            damps = goal[1, k, j] - x[j, WITHIN] * speed[j]
            pull[j] += error - kept_back(x[j], error, step * speed[j], damps)
            rubs[j] = dry_friction(x[j], speed[j])
        for _ in range(SWEEPS):
            change = 0.0
            for j in range(n):
                left = pull[j]
                for i in range(n):
                    if i != j:
                        both = 2.0 / step * mass[j, i] + 0.5 * step * stiff[j, i]
                        left -= x[j, A] * both * middle[i]
                own = 2.0 / step * (x[j, A] * mass[j, j] + x[j, INERTIA])
                own += 0.5 * step * x[j, A] * stiff[j, j]
                new = 0.0
                if abs(left) > rubs[j]:
                    left -= rubs[j] if left > 0.0 else -rubs[j]
                    new = left / (own + 0.5 * step + x[j, DAMPING])
                change = max(change, abs(new - middle[j]))
                middle[j] = new
            if change < SETTLED:
                break
        for j in range(n):
            before[j] = speed[j]
            speed[j] = 2.0 * middle[j] - speed[j] if middle[j] != 0.0 else 0.0
            at[j] += step * middle[j]
            q[k, j] = at[j]
