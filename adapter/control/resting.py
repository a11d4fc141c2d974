"""Whether an arm at rest holds what its model says: asked before the first motion.

    |tau_measured - g(q) - load(q)| <= band   for every joint and some load that a hand may carry

Friction, offsets and what a model is wrong by stay within a band of the effort limit; a load's
mass and first moment enter linearly, so the load that leaves least is a linear program. Another
robot or another mounting is off by the weight of whole links, also about axes that no load can
turn: about an axis along gravity, say.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from adapter.control.feedforward import ModelFeedforward
from adapter.errors import SettingsError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm


def check_resting_torque(model: SelfModel, q: Array, tau: Array) -> None:
    """Refuse an arm at rest that does not hold what its model says.

    Args:
        model: with gravity and tool.
        q: (n,) rad, at rest.
        tau: (n,) measured there, gravity included, N m.

    Raises:
        SettingsError: with every joint that is off, and the numbers.
    """
    if not (np.isfinite(q).all() and np.isfinite(tau).all()):
        raise SettingsError("the arm at rest does not measure every joint's position and torque")
    weight = CarriedWeight(model)
    weight.begin(q, tau)
    if weight.refusal is not None:
        raise SettingsError(weight.refusal)


class CarriedWeight:
    """What an arm may be carried with: its model's weight, a load at the hand, and a band.

    The load is what explains best the torques that were measured before the start. A push of
    something that holds the arm is neither, and an arm that is braked must not keep it up.

    Args:
        model: with gravity and tool.
        trusted: whatever the arm holds before the start is its weight, also beyond the band.

    Attributes:
        refusal: why the arm may not be moved; None where it holds what it may.
    """

    def __init__(self, model: SelfModel, trusted: bool = False) -> None:
        effort = np.where(np.isfinite(model.limits.effort), model.limits.effort, 0.0)
        self._model, self._plain = model, ModelFeedforward.of(model)
        # N m: friction, offsets, model error
        self._band = np.maximum(0.1 * effort, 0.5)
        self._heaviest = 1 / 3 * float(model.theta[:, 0].sum())  # that a hand may carry unsaid
        self._loaded, self._trusted = self._plain, trusted
        self._more = np.zeros(len(effort))
        self.refusal: str | None = None

    def begin(self, q: Array, tau: Array) -> None:
        """Find the load of an arm that holds tau (n,) N m at rest at q (n,) rad."""
        said = self._plain.unbent(q)
        n, still = len(q), np.zeros((1, len(q)))
        Y = RigidArm.of(self._model).regressor(q[None], still, still)[0].reshape(n, n, 10)
        hands = [link for link in range(n) if link not in self._model.tree.parent]
        columns = Y[:, hands, :4].reshape(n, -1)  # per kg and kg m of a load on each hand
        load = _best_load(tau - said, columns, self._band, self._heaviest)
        theta = self._model.theta.copy()
        theta[hands, :4] += load.reshape(-1, 4)
        self._loaded = ModelFeedforward.of(replace(self._model, theta=theta))
        left = tau - said - columns @ load
        if self._trusted:
            self._more = left - np.clip(left, -self._band, self._band)
            return
        off = np.flatnonzero(np.abs(left) > (1.0 + 1e-6) * self._band)  # a load ends on it exactly
        self.refusal = self._said(off, tau, said, left) if len(off) else None

    def within(self, q: Array, wanted: Array) -> Array:
        """What is nearest to `wanted` (n,) N m that may carry the arm at q (n,) rad."""
        weight = self._loaded.unbent(q) + self._more
        carried: Array = np.clip(wanted, weight - self._band, weight + self._band)
        return carried

    def _said(self, off: NDArray[np.intp], tau: Array, said: Array, left: Array) -> str:
        each = ", ".join(
            f"{self._model.tree.joint_names[j]} holds {tau[j]:+.1f} N m where the model says "
            f"{said[j]:+.1f} ({abs(left[j]):.1f} unexplained, {self._band[j]:.1f} may be)"
            for j in off
        )
        return (
            f"at rest {each}; model {self._model.name}, friction of so much and any load of up to "
            f"{self._heaviest:.1f} kg at the hand counted. Is something holding the arm or does it "
            "lean on something, is it another robot (--robot), mounted otherwise (--gravity X Y Z) "
            "or carrying more ([tool] in --config)? --trust-model moves it all the same"
        )


def _best_load(wanted: Array, loads: Array, band: Array, heaviest: float) -> Array:
    """Mass and first moment (4 hands) with which least is left, in units of the band.

    Least beyond the band over all joints, so that one that is pushed is not hidden by a load that
    spreads it over others; within the band, the least of the largest.
    """
    n, count = loads.shape
    scaled, one = loads / band[:, None], np.ones((n, 1))
    rows, ends = [], []
    for sign in (1.0, -1.0):  # unknowns: loads, what each joint is beyond its band, the largest
        rows.append(np.c_[sign * scaled, -np.eye(n), 0.0 * one])
        rows.append(np.c_[sign * scaled, 0.0 * np.eye(n), -one])
        ends += [sign * wanted / band + 1.0, sign * wanted / band]
    for k in range(count):
        if k % 4:  # a first moment: at most the reach times its mass, to both sides
            for sign in (1.0, -1.0):
                row = np.zeros(count + n + 1)
                row[k], row[k - k % 4] = sign, -0.35  # m
                rows.append(row[None])
                ends.append(np.zeros(1))
    goal = np.r_[np.zeros(count), np.ones(n), 0.01]  # of the largest beside the sum
    bounds: list[tuple[float | None, float | None]] = [
        (0.0, heaviest) if k % 4 == 0 else (None, None) for k in range(count)
    ]
    bounds += [(0.0, None)] * (n + 1)
    found = linprog(goal, np.vstack(rows), np.concatenate(ends), bounds=bounds)
    load: Array = np.zeros(count) if found.x is None else found.x[:count]
    return load
