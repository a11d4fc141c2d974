"""An arm in a simulator, moved with the effects of its model: what all simulators share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np

from adapter.effects.robots import robot_urdf
from adapter.model.self_model import Limits, SelfModel
from adapter.model.spatial import Array
from adapter.simulate.effects import Effects


class SimulatedArm(ABC):
    """The joints of a learned arm in a running simulation.

    Attributes:
        effects: of the model, told what the simulator's arm holds.
        t: s since the recording began that the effects' times refer to.
    """

    def __init__(self, effects: Effects, t: float = 0.0) -> None:
        self.effects, self.t = effects, t
        self._ddq: Array | None = None
        self._tau = np.zeros(len(effects.joint_names))

    @abstractmethod
    def read(self) -> tuple[Array, Array]:
        """q, dq (n,) rad and rad/s as the simulator stores them."""

    @abstractmethod
    def put(self, q: Array, dq: Array) -> None:
        """Set what it stores."""

    @abstractmethod
    def advance(self, torque: Array) -> None:
        """One step under joint torques (n,) N m."""

    @abstractmethod
    def close(self) -> None:
        """Free what the simulator holds."""

    def step(self, tau: Array) -> None:
        """One step under the drives' torques tau (n,) N m and the effects."""
        tau = np.asarray(tau, dtype=float)
        q, dq = self.read()
        self.advance(tau + self.effects.at_middle(q, dq, self._ddq, tau, self.t))
        self.t += self.effects.period_s
        self._ddq, self._tau = (self.read()[1] - dq) / self.effects.period_s, tau

    def place(self, q: Array, dq: Array, t: float = 0.0) -> None:
        """Put the arm at q (n,) rad with dq (n,) rad/s at the time t (s).

        The simulators step by v' = v + h a(q, v), q' = q + h v'. Taken as the position of half a
        step later, the stored one makes this second order.
        """
        q, dq = np.asarray(q, dtype=float), np.asarray(dq, dtype=float)
        self.effects.reset()
        self.put(q + 0.5 * self.effects.period_s * dq, dq)
        self.t, self._ddq = t, None

    def state(self) -> tuple[Array, Array]:
        """q, dq (n,) of the joints at the time t."""
        q, dq = self.read()
        return q - 0.5 * self.effects.period_s * dq, dq

    def measured(self) -> tuple[Array, Array, Array]:
        """What the sensors say at the time t: q, dq, tau (n,); once a step."""
        return self.effects.measured(*self.state(), self._tau, self.t)


def plain_urdf(model: SelfModel) -> str:
    """The bare arm as URDF text: no ends of joints' ranges, no frames that a reader gives a mass.

    Raises:
        ModelError: a body that cannot exist.
    """
    bare = replace(model, frames=(), limits=Limits.unknown(model.tree.n))
    return robot_urdf(bare, alone=True).text
