"""The step that friction allows: dry friction is stiff, so it is solved for, not looked up."""

from __future__ import annotations

import numpy as np

from adapter.effects.by_joint import SMOOTHING_DQ
from adapter.physics.kernels import jit

ROUNDS = 60
DONE = 1e-10  # rad/s
ENOUGH = 1e-4  # share of the expected descent that a step must bring


@jit
def speed_change(M, push, v, losses, h):
    """Change of speed dv (n,) rad/s and the speed (n,) at which friction acts in a step of h (s).

    Solves M dv = h (push - f(v + share dv)), f(u) = viscous u + level tanh(u / SMOOTHING_DQ), by
    Newton's method on the convex function whose gradient that is. The share is one half (second
    order) where friction is not stiff, and goes to one where it is: with the friction of the
    step's start, or of its middle, a joint would swing about its standstill.

    Args:
        M: (n, n) mass matrix with what turns with the joints, kg m².
        push: (n,) all other torques, N m.
        v: (n,) speed at the start, rad/s.
        losses: (3, n) viscous, N m s/rad, level forwards and backwards, N m; none negative.
    """
    n = v.shape[0]
    dv, share, step = np.zeros(n), np.empty(n), np.empty(n)
    gradient, hessian = np.empty(n), np.empty((n, n))
    for i in range(n):
        stiff = (losses[0, i] + max(losses[1, i], losses[2, i]) / SMOOTHING_DQ) * h / M[i, i]
        share[i] = max(0.5, 1.0 - 1.0 / max(stiff, 1.0))
    cost = _cost(M, h * push, v, (losses, share, h), dv)
    for _ in range(ROUNDS):
        gradient[:] = M @ dv - h * push
        hessian[:] = M
        for i in range(n):
            u = v[i] + share[i] * dv[i]
            level = losses[1, i] if u > 0.0 else losses[2, i]
            s = np.tanh(u / SMOOTHING_DQ)
            slope = losses[0, i] + level / SMOOTHING_DQ * (1.0 - s * s)
            gradient[i] += h * (losses[0, i] * u + level * s)
            hessian[i, i] += h * share[i] * slope
        step[:] = np.linalg.solve(hessian, -gradient)
        descent = gradient @ step
        new = _cost(M, h * push, v, (losses, share, h), dv + step)
        while new > cost + ENOUGH * descent and np.abs(step).max() > DONE:
            step *= 0.5
            descent *= 0.5
            new = _cost(M, h * push, v, (losses, share, h), dv + step)
        dv += step
        cost = new
        if np.abs(step).max() < DONE:
            break
    return dv, v + share * dv


@jit
def _cost(M, kick, v, friction, dv):
    """dv'M dv / 2 - kick dv + h times the potential of the losses."""
    losses, share, h = friction
    total = 0.5 * dv @ (M @ dv) - kick @ dv
    for i in range(v.shape[0]):
        u = v[i] + share[i] * dv[i]
        level = losses[1, i] if u > 0.0 else losses[2, i]
        x = abs(u) / SMOOTHING_DQ
        dry = level * SMOOTHING_DQ * (x + np.log1p(np.exp(-2.0 * x)) - np.log(2.0))
        total += h / share[i] * (0.5 * losses[0, i] * u * u + dry)
    return total
