"""Motion of a position-controlled arm under its commands, compiled.

A servo, divided by its position gain kp (so that what encoders alone show stands apart from the
scale that only the documented masses set):

    q_cmd(t - d) - q + lead dq_cmd(t - d) = a tau_rigid + inertia ddq + damping dq + rubs sign(dq)

with a = 1 / kp, lead the fed-forward speed's gain over kp (s), damping (s) that of the velocity
gain and viscous friction together, inertia the armature's (s²), rubs Coulomb friction's (rad).
Both simulations take the implicit midpoint rule, and friction holds a joint whose speed would
change sign.
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
)

SWEEPS, SETTLED = 60, 1e-9  # of the joints' speeds in a step; rad/s

A, LEAD, DAMPING, INERTIA, RUBS = range(5)  # columns of a table of servos


class Load(NamedTuple):
    """What the arm makes of one joint's motion, at every step's middle, (m,) each.

    Attributes:
        mass: moment of inertia that the joint moves, kg m².
        other: the rigid torque beside mass times acceleration, N m.
    """

    mass: Array
    other: Array


class Body(NamedTuple):
    """The rigid arm as compiled code takes it."""

    frames: Frames
    theta: Array
    base: Array


@jit
def follow_alone(x, goal, load, start, step, q):
    """One joint under its commands, the others' motion known.

    Args:
        x: (5,) the servo.
        goal: (m,) q_cmd + lead dq_cmd over each step, rad.
        load: `Load`; start: (2,) q, dq before the first step; step: s.
        q: (m,) rad after each step, filled.
    """
    at, speed = start[0], start[1]
    damping, rubs = x[DAMPING], x[RUBS]
    for k in range(goal.shape[0]):
        mass = x[A] * load.mass[k] + x[INERTIA]
        steers = goal[k] - x[A] * load.other[k]
        left = step
        if speed != 0.0:
            way = 1.0 if speed > 0.0 else -1.0
            pull = 2.0 * mass / step * speed + steers - at - way * rubs
            after = 2.0 * pull / (2.0 * mass / step + 0.5 * step + damping) - speed
            # It stops within the step: only up to there does friction act this way. What follows
            # from the numbers then has no jumps, which a fit would be caught by.
            share = speed / (speed - after) if after * way < 0.0 else 1.0
            at += 0.5 * share * step * (speed + (after if share == 1.0 else 0.0))
            speed = after if share == 1.0 else 0.0
            left = (1.0 - share) * step
        force = steers - at
        if left > 0.0 and abs(force) > rubs:
            force -= rubs if force > 0.0 else -rubs
            middle = force / (2.0 * mass / left + 0.5 * left + damping)
            speed, at = 2.0 * middle, at + left * middle
        q[k] = at


@jit
def follow_together(x, goal, body, start, step, q):
    """All joints under their commands.

    Args:
        x: (n, 5) the servos; goal: (m, n) as for one joint.
        body: `Body`; start: (2, n) q, dq before the first step; step: s.
        q: (m, n) rad after each step, filled.
    """
    n = x.shape[0]
    at, speed, middle = start[0].copy(), start[1].copy(), start[1].copy()
    still, unit, motion = np.zeros(n), np.zeros(n), np.empty((n, 12))
    bias, column, base = np.empty(n), np.empty(n), np.zeros(12)
    mass, pull, ahead = np.empty((n, n)), np.empty(n), np.empty(n)
    before = speed.copy()
    for k in range(goal.shape[0]):
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
            pull[j] = 2.0 / step * own + goal[k, j] - at[j] - x[j, A] * bias[j]
        for _ in range(SWEEPS):
            change = 0.0
            for j in range(n):
                left = pull[j]
                for i in range(n):
                    if i != j:
                        left -= 2.0 / step * x[j, A] * mass[j, i] * middle[i]
                own = 2.0 / step * (x[j, A] * mass[j, j] + x[j, INERTIA])
                new = 0.0
                if abs(left) > x[j, RUBS]:
                    left -= x[j, RUBS] if left > 0.0 else -x[j, RUBS]
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
