"""Lasting effects as tables over the joints: for one sample at a time, in real time.

What an effect does over a recording is in its own file; here is what one instant allows of it:
entries of all joints go through one call, and nothing is looked up by name on the way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from adapter.effects.active import Active
from adapter.effects.base import Array, JointTorque, Values
from adapter.fast import jit

Laws = tuple[tuple[JointTorque, dict[str, Array]], ...]


@dataclass(eq=False)
class ByJoint:
    """Effects of n joints; what a joint has none of is zero.

    Attributes:
        laws: effects at the joints with each parameter (n,); one twice where a joint has two.
        wrench: (6,) [f; m] on the last link, base axes.
        offset: (n,) rad, q_measured - q; ripple, phase: (n,) of `encoder_ripple`, rad.
        half_play: (n,) half a backlash, rad.
        compliance: (n,) 1/k of the gears, rad/(N m).
        gain: (n,) of the torque sensors; delay_s: (n,) of theirs.
        left_out: names of what a single instant cannot show.
    """

    laws: Laws
    wrench: Array
    offset: Array
    ripple: Array
    phase: Array
    half_play: Array
    compliance: Array
    gain: Array
    delay_s: Array
    left_out: tuple[str, ...]

    @classmethod
    def of(cls, effects: Sequence[Active], n: int) -> ByJoint:
        """The effects, whatever their intervals; those of bodies are not for here."""
        read = partial(_total, effects, n)
        wave = read("encoder_ripple", lambda v: v["a"] * np.exp(1j * v["phase"]))
        pull = [a.values for a in effects if a.effect.name == "external_wrench"]
        keys = ("fx", "fy", "fz", "mx", "my", "mz")
        wrench = np.array([[v[key] for key in keys] for v in pull], dtype=np.float64)
        names = {a.effect.name for a in effects if not isinstance(a.effect, JointTorque)}
        return cls(
            laws=_laws(effects, n),
            wrench=wrench.reshape(-1, 6).sum(axis=0),
            offset=read("encoder_offset", lambda v: v["o"]).real.copy(),
            ripple=np.abs(wave),
            phase=np.angle(wave),
            half_play=read("backlash", lambda v: 0.5 * v["b"]).real.copy(),
            compliance=read("joint_elasticity", lambda v: 1.0 / v["k"]).real.copy(),
            gain=np.expm1(read("torque_gain", lambda v: np.log1p(v["g"])).real),
            delay_s=read("signal_delay", lambda v: v["d"]).real.copy(),
            left_out=tuple(sorted(names - _SHOWN)),
        )

    @cached_property
    def moves(self) -> bool:
        """Whether the links move otherwise than the sensors say."""
        tables = (self.offset, self.ripple, self.half_play, self.compliance)
        return any(bool(np.any(table)) for table in tables)

    @cached_property
    def pushed(self) -> bool:
        """Whether there is a wrench on the last link."""
        return bool(np.any(self.wrench))

    def torque(
        self, q: Array, dq: Array, ddq: Array, tau: Array, smoothing_s: float = 0.0
    ) -> Array | float:
        """Sum of the laws (..., n) for signals of that shape; the wrench is not in it."""
        total: Array | float = 0.0
        for effect, values in self.laws:
            total = total + effect.law(q, dq, ddq, tau, values, smoothing_s)
        return total


_SHOWN = {
    "backlash",
    "encoder_offset",
    "encoder_ripple",
    "external_wrench",
    "joint_elasticity",
    "signal_delay",
    "torque_gain",
}


def _total(
    effects: Sequence[Active], n: int, name: str, read: Callable[[Values], complex]
) -> NDArray[np.complex128]:
    """(n,) complex sum over the effects of this name; one without a joint counts on all."""
    out = np.zeros(n, dtype=complex)
    for active in effects:
        if active.effect.name == name:
            out[slice(None) if active.joint < 0 else active.joint] += read(active.values)
    return out


def _laws(effects: Sequence[Active], n: int) -> Laws:
    """Entries of one effect side by side in one table, a second one where a joint is taken."""
    found: list[tuple[JointTorque, dict[str, Array]]] = []
    taken: list[set[int]] = []
    for active in effects:
        effect = active.effect
        if not isinstance(effect, JointTorque):
            continue
        free = (k for k, (own, _) in enumerate(found) if own is effect)
        at = next((k for k in free if active.joint not in taken[k]), len(found))
        if at == len(found):
            # what zero is not allowed for (a velocity scale) stands at its least
            absent = {p.key: np.full(n, np.clip(0.0, p.lower, p.upper)) for p in effect.parameters}
            found.append((effect, absent))
            taken.append(set())
        taken[at].add(active.joint)
        for key, value in active.values.items():
            found[at][1][key][active.joint] = float(value)
    return tuple(found)


@jit
def to_links(q, dq, ddq, tau, dtau, ddtau, offset, ripple, phase, compliance):
    """Turn the motion q, dq, ddq (n,) that encoders say into that of the links, in place.

    tau, dtau, ddtau (n,): joint torque and its rates, which twist the gears.
    """
    for j in range(q.shape[0]):
        sine = ripple[j] * np.sin(q[j] + phase[j])
        cosine = ripple[j] * np.cos(q[j] + phase[j])
        v = dq[j]
        q[j] -= offset[j] + sine + compliance[j] * tau[j]
        dq[j] -= cosine * v + compliance[j] * dtau[j]
        ddq[j] -= cosine * ddq[j] - sine * v * v + compliance[j] * ddtau[j]
