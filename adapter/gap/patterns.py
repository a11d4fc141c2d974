"""Patterns: torques that follow a signal of the arm as no effect of the catalogue does.

They compete with the catalogue by the same evidence. Where one wins, something is missing that
has no name here, and what it follows is what can be said of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from adapter.effects.base import (
    Array,
    Motion,
    Parameter,
    Template,
    TorqueEffect,
    Values,
    on_joint,
    smooth_sign,
)

UNEXPLAINED = "unexplained"
PIECES, DEGREE = 5, 3  # of a spline over a signal's range
SLOW_PIECES = 10  # over time
SIZE_NM = 0.3
LINE_RATIO = 30.0  # by which a spectral line must stand out to be looked at
LINE_HZ = (0.15, 9.0)


class Pattern(TorqueEffect):
    """A torque on one joint, linear in basis functions of the arm's signals.

    Args:
        label: tells patterns apart; depends_on: signals that it follows ("dq3"), own joint first.
        basis: motion and rigid torque to basis functions (m, k) at the joint.
        count: k; log_odds: before any data.
    """

    title = "something that is not in the catalogue"
    split_by = "repeat the motion and look whether what is left repeats"

    def __init__(
        self,
        label: str,
        depends_on: tuple[str, ...],
        basis: Callable[[Motion, Array, int], Array],
        count: int,
        log_odds: float = -7.0,
    ) -> None:
        self.name = f"{UNEXPLAINED}:{label}"  # type: ignore[misc]
        self.parameters = (Parameter("x", "N m", count=count),)  # type: ignore[misc]
        self.depends_on, self._basis, self._count = depends_on, basis, count
        self.log_odds = log_odds  # type: ignore[misc]

    @property
    def is_line(self) -> bool:
        """Whether it is a sine in time."""
        return self.name.endswith("Hz")

    def templates(self) -> tuple[Template, ...]:
        """All its coefficients at once."""
        return (Template((SIZE_NM,) * self._count, _decode),)

    def torque(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """Coefficients times basis."""
        return on_joint(motion, joint, self._basis(motion, tau, joint) @ np.asarray(values["x"]))


def _decode(x: Array) -> dict[str, Any]:
    return {"x": np.asarray(x)}


def patterns(n: int, joint: int) -> tuple[Pattern, ...]:
    """What the torque on a joint (from 0) of n may follow."""
    k = joint + 1
    own = [
        Pattern(f"q{k}", (f"q{k}",), _curve("q"), PIECES + DEGREE),
        Pattern(f"dq{k}", (f"dq{k}",), _curve("dq"), PIECES + DEGREE),
        Pattern(f"ddq{k}", (f"ddq{k}",), _curve("ddq"), PIECES + DEGREE),
        Pattern(f"tau{k}", (f"tau{k}",), _curve("tau"), PIECES + DEGREE),
        Pattern(f"q{k},sign", (f"q{k}", f"dq{k}"), _times_sign, PIECES + DEGREE),
        Pattern(f"q{k},dq", (f"q{k}", f"dq{k}"), _times_speed, PIECES + DEGREE),
        Pattern("t", ("t",), _over_time, SLOW_PIECES + DEGREE),
    ]
    for i in range(n):
        if i != joint:
            own.append(Pattern(f"dq{i + 1}", (f"dq{i + 1}",), _other("dq", i), 1, -7.0))
            own.append(Pattern(f"tau{i + 1}", (f"tau{i + 1}",), _other("tau", i), 1, -7.0))
    return tuple(own)


def line(residual: Array, rate_hz: float) -> Pattern | None:
    """A sine in time at the frequency that stands out of a residual (k,), if one does."""
    power = np.abs(np.fft.rfft(residual * np.hanning(len(residual)))) ** 2
    f = np.fft.rfftfreq(len(residual), 1.0 / rate_hz)
    inside = (f > LINE_HZ[0]) & (f < LINE_HZ[1])
    peak = int(np.argmax(np.where(inside, power, 0.0)))
    near = power[max(peak - 20, 1) : peak + 20]
    if power[peak] < LINE_RATIO * np.median(near):
        return None
    # the top of the parabola through the peak's logarithms
    a, b, c = np.log(power[peak - 1 : peak + 2] + 1e-300)
    hz = float(f[peak] + 0.5 * (a - c) / (a - 2 * b + c) * (f[1] - f[0]))
    return Pattern(f"t at {hz:.2f} Hz", ("t",), _sine(hz), 2, -7.0)


def _signal(name: str, motion: Motion, tau: Array, joint: int) -> Array:
    return np.asarray(tau[:, joint] if name == "tau" else getattr(motion, name)[:, joint])


def _spline(x: Array, pieces: int) -> Array:
    """Cubic B-splines (m, pieces + 3) over the range of x (m,)."""
    low, high = float(x.min()), float(x.max())
    step = max(high - low, 1e-9) / pieces
    knots = low + step * np.arange(-DEGREE, pieces + DEGREE + 1)
    inside = np.clip(x, low, high - 1e-9 * step)
    return np.asarray(BSpline.design_matrix(inside, knots, DEGREE).toarray())


def _curve(name: str) -> Callable[[Motion, Array, int], Array]:
    return lambda motion, tau, joint: _spline(_signal(name, motion, tau, joint), PIECES)


def _times_sign(motion: Motion, tau: Array, joint: int) -> Array:
    return _spline(motion.q[:, joint], PIECES) * smooth_sign(motion.dq[:, joint])[:, None]


def _times_speed(motion: Motion, tau: Array, joint: int) -> Array:
    return _spline(motion.q[:, joint], PIECES) * motion.dq[:, joint, None]


def _over_time(motion: Motion, tau: Array, joint: int) -> Array:
    return _spline(motion.t, SLOW_PIECES)


def _other(name: str, i: int) -> Callable[[Motion, Array, int], Array]:
    def basis(motion: Motion, tau: Array, joint: int) -> Array:
        x = _signal(name, motion, tau, i)
        return np.asarray(((x - x.mean()) / (x.std() + 1e-9))[:, None])

    return basis


def _sine(hz: float) -> Callable[[Motion, Array, int], Array]:
    def basis(motion: Motion, tau: Array, joint: int) -> Array:
        angle = 2.0 * np.pi * hz * motion.t
        return np.column_stack([np.sin(angle), np.cos(angle)])

    return basis
