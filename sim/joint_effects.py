"""Effects in the motion of the joints: their torques, and the step that friction allows.

Each effect on a joint becomes one row of numbers; one compiled walk over the rows adds them up.
Where the torque is stiff in the velocity (friction) a row adds to the coefficients of

    f(v) = viscous v + (level_pos if v > 0 else level_neg) tanh(v / COULOMB_WIDTH),

which enters the step implicitly; all else is taken as it is at the middle of the sub-step.

What is in an arm's way are stiff springs with dampers that appear at an instant: joints are held at
the angles they have then (or next to them, which pushes), a wall stands across the way that the
hand goes, so far ahead. A floor is level, at a height; what touches it does not slide before it is
pushed sideways by half of what it is pressed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Any

import numpy as np

from sim.dynamics import Frames, compiled, end_effector
from sim.effects import MOTION, OBSTACLE, SPECS, Effect
from sim.truth import FLANGE, Array, Truth

COULOMB_WIDTH = 0.01  # rad/s: Fc sign(dq) is simulated as Fc tanh(dq / COULOMB_WIDTH)

# Kinds of rows, one for each effect on a motion: kind, joint, other joint, three parameters in the
# order of `SPECS`, start and end.
_enumerated: Any = IntEnum  # its members' names come from the table
Row = _enumerated("Row", [k.upper() for k, (place, *_) in SPECS.items() if place == MOTION])
ROW = 8  # numbers


def friction(parts: Array, v: Array) -> Array:
    """f(v) (n,) N m of the parts (5, n) that `add_up` gives."""
    _, viscous, positive, negative, _ = parts
    level = np.where(v > 0, positive, negative)
    return np.asarray(viscous * v + level * np.tanh(v / COULOMB_WIDTH))


def rows_of(truth: Truth) -> Array:
    """A truth's effects in the motion of its joints as rows of numbers (r, ROW)."""
    effects = (effect for effect in truth.effects if effect.place == MOTION)
    rows = [row for effect in effects for row in _rows(effect, truth.n)]
    return np.array(rows).reshape(-1, ROW)


def _rows(effect: Effect, n: int) -> list[list[float]]:
    _, needed, optional = SPECS[effect.name]
    kind, keys = Row[effect.name.upper()], needed + optional
    numbers = [effect.number(key) for key in keys] + [0.0] * (3 - len(keys))
    columns: Sequence[int] = effect.columns(n)
    pairs = [(j, j) for j in columns]
    if effect.name == "x_cross_viscous":
        pairs = [(columns[1], columns[0])]
    return [[kind, j, other, *numbers, effect.start_s, effect.end_s] for j, other in pairs]


@compiled
def add_up(rows: Array, t: float, q: Array, v: Array, rigid: Array, bent: Array) -> Array:
    """(5, n): explicit, viscous, positive, negative, armature of all rows at t (s), q, v (n,).

    Args:
        rigid: (n,) N m, the rigid arm's torque.
        bent: (r,) N m, what each row of the Dahl model holds in its bristles.
    """
    out = np.zeros((5, len(q)))
    for r in range(len(rows)):
        _, j, other, a, b, c, start, end = rows[r]
        if t < start or t >= end:
            continue
        kind, i, level = int(rows[r, 0]), int(j), 0.0  # level: of friction alike in both directions
        if kind == Row.VISCOUS_FRICTION:
            out[1, i] += a
        elif kind == Row.COULOMB_FRICTION:
            level = a
        elif kind == Row.ASYMMETRIC_FRICTION:
            out[2, i] += a
            out[3, i] += b
        elif kind == Row.MOTOR_INERTIA:
            out[4, i] += a
        elif kind == Row.X_QUADRATIC_DRAG:
            out[1, i] += a * abs(v[i])
        elif kind == Row.X_VELOCITY_RIPPLE:
            out[1, i] += a * np.sin(b * q[i] + c)
        elif kind == Row.BRISTLE_FRICTION:
            out[0, i] += bent[r]
        elif kind == Row.X_CROSS_VISCOUS:
            out[0, i] += a * v[int(other)]
        elif kind == Row.TORQUE_RIPPLE:
            out[0, i] += a * np.sin(b * q[i] + c)
        elif kind == Row.JOINT_SPRING:
            out[0, i] += a * (q[i] - b)
        elif kind == Row.X_CUBIC_SPRING:
            out[0, i] += a * (q[i] - b) ** 3
        elif kind == Row.X_SINE_DISTURBANCE:
            out[0, i] += a * np.sin(2 * np.pi * b * t + c)
        elif kind == Row.STRIBECK_FRICTION:
            level = a + (b - a) * np.exp(-((v[i] / c) ** 2))
        elif kind == Row.LOAD_DEPENDENT_FRICTION:
            level = a * abs(rigid[i])
        elif kind == Row.FRICTION_DRIFT:
            level = a * (t - max(start, 0.0))
        else:  # of the position
            level = a * (1.0 + np.sin(q[i] + b))
        out[2, i] += level
        out[3, i] += level
    return out


@compiled
def bend(rows: Array, v: Array, h: float, bent: Array) -> None:
    """Carry the Dahl bristles (r,) on by h (s) of motion at v (n,), N m: s0 dz = Fc dq - z |dq|."""
    for r in range(len(rows)):
        if int(rows[r, 0]) == Row.BRISTLE_FRICTION:
            speed, level, way = v[int(rows[r, 1])], rows[r, 3], rows[r, 4]
            goal = level if speed > 0 else -level
            bent[r] = goal + (bent[r] - goal) * np.exp(-abs(speed) * h / way)


@compiled
def step(M: Array, bias: Array, v: Array, h: float, parts: Array, drive: Array) -> Array:
    """What of the drives' torques reaches the rigid arm in a sub-step of h (s), (n,) N m.

    Solves (M + B) dv = h (tau(dv) - explicit - bias - f(v + share dv)) for dv by Newton's method.
    The share is one half (second order) as long as friction is not stiff on its joint, and goes
    to one where it is: there the midpoint rule would keep a joint swinging about its standstill.
    tau(dv) is what the drives give: push - damping (v + dv / 2), cut at their limits.

    Args:
        M: (n, n) mass matrix, kg m²; overwritten.
        bias: (n,) inverse dynamics without acceleration, N m.
        v: (n,) rad/s at the start of the sub-step.
        parts: (5, n) of `add_up`.
        drive: (3, n) push (N m), damping (N m s/rad), limit (N m).
    """
    n = len(v)
    explicit, viscous, positive, negative, armature = parts
    push, damping, most = drive
    share, f, slope = np.empty(n), np.empty(n), np.empty(n)
    tau, tau_slope = np.empty(n), np.empty(n)
    for i in range(n):
        M[i, i] += armature[i]
        stiff = max(positive[i], negative[i], 0.0) / COULOMB_WIDTH * h / M[i, i]
        share[i] = max(0.5, 1.0 - 1.0 / max(stiff, 1.0))
    dv = np.zeros(n)
    for _ in range(8):
        A = M / h
        for i in range(n):
            speed = v[i] + share[i] * dv[i]
            level = positive[i] if speed > 0 else negative[i]
            s = np.tanh(speed / COULOMB_WIDTH)
            f[i] = viscous[i] * speed + level * s
            slope[i] = share[i] * (viscous[i] + max(level, 0.0) / COULOMB_WIDTH * (1.0 - s * s))
            tau[i] = push[i] - damping[i] * (v[i] + dv[i] / 2)
            tau_slope[i] = damping[i] / 2
            if abs(tau[i]) > most[i]:
                tau[i], tau_slope[i] = min(max(tau[i], -most[i]), most[i]), 0.0
            A[i, i] += slope[i] + tau_slope[i]
        gap = tau - explicit - bias - f - M @ dv / h
        change = np.linalg.solve(A, gap)
        dv += change
        if np.abs(change).max() < 1e-12:  # rad/s
            break
    # f and tau belong to the dv before the last change; the slopes carry them over.
    return tau - explicit - f - (slope + tau_slope) * change - armature * dv / h


# Our choice: a joint gives 0.02 rad to 100 N m, a wall 5 mm to 100 N.
WALL_STIFFNESS, WALL_DAMPING = 20000.0, 200.0  # N/m, N s/m


class Obstacles:
    """All that is in the way of one arm.

    Attributes:
        torque: (n,) N m that they put on the joints at present.
        force: N, of walls and floors on the hand.
    """

    def __init__(self, effects: Iterable[Effect], n: int) -> None:
        self._effects = [effect for effect in effects if effect.place == OBSTACLE]
        self._n = n
        self._places: dict[int, tuple[Array, float]] = {}
        self.torque, self.force = np.zeros(n), 0.0

    def __len__(self) -> int:
        return len(self._effects)

    def act(self, t: float, q: Array, dq: Array, frames: Frames) -> tuple[Array, Array]:
        """What they add to the motion at t (s): torque (n,) N m against the drives, and damping
        (n,) N m s/rad, at q, dq (n,) rad, rad/s.
        """
        against, damping = np.zeros(self._n), np.zeros(self._n)
        self.force = 0.0
        for number, effect in enumerate(self._effects):
            if not effect.acts(t):
                self._places.pop(number, None)
            elif effect.name in ("x_wall", "x_floor"):
                pose, J = end_effector(frames, q, FLANGE)
                touch = self._wall if effect.name == "x_wall" else self._floor
                push = touch(number, effect, pose[:3, 3], J[:3] @ dq)
                self.force += float(np.linalg.norm(push))
                against -= J[:3].T @ push
            else:
                joints = effect.columns(self._n)
                k = effect.number("k", 5000.0)  # N m/rad
                at, _ = self._places.setdefault(number, (q + effect.number("push") / k, 0.0))
                against[joints] += k * (q - at)[joints]
                damping[joints] += 50.0  # N m s/rad
        self.torque = -against - damping * dq
        return against, damping

    def _wall(self, k: int, effect: Effect, hand: Array, speed: Array) -> Array:
        """Force (3,) N of a wall upon the hand, which is there (m) at that speed (m/s)."""
        if k not in self._places:
            fast = float(np.linalg.norm(speed))
            if fast < 1e-3:
                return np.zeros(3)  # there is no way to stand across yet
            way = speed / fast
            self._places[k] = way, float(way @ hand) + effect.number("gap")
        way, at = self._places[k]
        depth = float(way @ hand) - at
        push = max(WALL_STIFFNESS * depth + WALL_DAMPING * float(way @ speed), 0.0)
        return np.asarray(-push * way if depth > 0.0 else np.zeros(3))

    def _floor(self, k: int, effect: Effect, hand: Array, speed: Array) -> Array:
        """Force (3,) N of a level plane upon the hand."""
        depth = effect.number("height") - hand[2]
        if depth <= 0.0:
            self._places.pop(k, None)
            return np.zeros(3)
        touched, _ = self._places.setdefault(k, (hand.copy(), 0.0))
        push = WALL_STIFFNESS * (touched - hand) - WALL_DAMPING * speed
        push[2] = max(WALL_STIFFNESS * depth - WALL_DAMPING * speed[2], 0.0)
        side, most = float(np.hypot(*push[:2])), 0.5 * push[2]  # friction of the floor
        if side > most:  # it slides, and what it holds on to comes along
            push[:2] *= most / side
            touched[:2] = hand[:2] + push[:2] / WALL_STIFFNESS
        return push
