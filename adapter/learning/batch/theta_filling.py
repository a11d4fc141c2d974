"""Bodies with what torques did not show taken from the documentation.

Torques show combinations of inertial parameters (base parameters), and those of a given motion
fewer: what they tell worse than a documented body is large is not told. Of all possible bodies that
have the learned combinations, those nearest to the documented ones are the model's. Near is by
the documented body's own measure: with J = L Lᵀ its pseudo-inertia, |L⁻¹ (J' - J) L⁻ᵀ|, a share
of its mass and size that does not depend on the frame (the affine-invariant distance of Lee,
Wensing and Park 2020, for small changes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import ModelError
from adapter.learning.batch.conic import NONNEGATIVE, POSSIBLE, entries, matrices, solve_conic
from adapter.model.inertia import (
    PARAMETERS,
    is_consistent,
    pseudo_inertia,
    theta_from_pseudo_inertia,
)
from adapter.model.spatial import Array
from adapter.physics.identifiability import SHOWN_ALONE

KEPT = 0.05  # of a documented body that is left of it at least, where what was learned allows it
LEAST_SIZE = 1e-3  # share of a measuring body, and kg, that a documented one has at least
NEARNESS = 1e-8  # weight of nearness beside the torques, where both cannot be had
UNSOLVED = "no possible bodies were found near what was learned; is it sound?"


@dataclass(frozen=True)
class FilledTheta:
    """θ as it leaves the house.

    Attributes:
        theta: (bodies, 10), every body possible.
        kept: least share that is left of any documented body.
        possible: whether possible bodies have the learned combinations; else θ is that of the
            possible bodies nearest to them, by torque.
    """

    theta: Array
    kept: float
    possible: bool


def filled_theta(learned: Array, told: Array, basis: Array, regressor: Array) -> FilledTheta:
    """The possible bodies nearest to the documented ones that have the learned combinations.

    Args:
        learned, told: (bodies, 10) θ as learned and as documented.
        basis: (10 bodies, rank) orthonormal, the combinations that torques show.
        regressor: (m, 10 bodies) torques over motion, what is near where no possible body has
            the learned combinations.

    Raises:
        ModelError: the solver gave up without an answer.
    """
    measure = Measure(told)
    start = measure.of(learned)
    hidden = np.linalg.svd(basis.T)[2][basis.shape[1] :]
    free = np.linalg.qr(measure.of(hidden.reshape(-1, *told.shape)).T)[0]
    toward = free.T @ (measure.told - start)
    share = start + free @ toward
    least = measure.least(share)
    if least < KEPT:
        room = _most_room(measure, start, free)
        if room <= 0.0:
            return _nearest_by_torque(measure, start, regressor)
        margin = min(KEPT, 0.5 * room)
        y = solve_conic(
            np.eye(free.shape[1]), -toward, -free, start - margin * measure.own, measure.cones
        )[0]
        share = start + free @ y
        least = measure.least(share) if np.isfinite(share).all() else 0.0
    if least <= 0.0:
        raise ModelError(UNSOLVED)
    return FilledTheta(measure.theta(share), least, True)


def possible_theta(learned: Array, told: Array, information: Array) -> Array:
    """θ (bodies, 10) itself if its bodies are possible, else the nearest ones by what data tell.

    Args:
        learned: (bodies, 10); told: some that are possible, by which nearness is measured.
        information: (10 bodies, 10 bodies) that data have on θ.
    """
    if is_consistent(learned):
        return learned
    worth, ways = np.linalg.eigh(information)
    root, measure = (ways * np.sqrt(np.maximum(worth, 0.0))).T, Measure(told)
    return _nearest_by_torque(measure, measure.of(learned), root).theta


def told_basis(information: Array, told: Array) -> Array:
    """(10 bodies, rank) orthonormal, the combinations that data have told.

    Args:
        information: (10 bodies, 10 bodies) that data have on θ; told: (bodies, 10) as documented.
    """
    units = Measure(told).units
    worth, ways = np.linalg.eigh(units @ information @ units.T)
    # Information on a share of a documented body from which data tell it: with less they know it no
    # better than as somewhere between nothing and twice as much. After 2 to 15 s of real logs
    # torque errors on the rest were 0.67 to 1.05 times those of all that any motion can show (at
    # 10: to 1.7).
    return np.linalg.qr(np.linalg.solve(units, ways[:, worth > 1.0]))[0]


def filled_words(basis: Array, names: tuple[str, ...]) -> list[str]:
    """What of θ torques did not show alone, so that the documentation says it; by link.

    Args:
        basis: as of `filled_theta`; names: of the bodies.
    """
    shown = np.einsum("ab,ab->a", basis, basis).reshape(-1, len(PARAMETERS)) > SHOWN_ALONE
    found = []
    for name, flags in zip(names, shown, strict=True):
        own = [p for p, flag in zip(PARAMETERS, flags, strict=True) if flag]
        rest = [p for p in PARAMETERS if p not in own]
        most = f"all but {' '.join(own)}" if own else "all"
        if rest:
            found.append(f"{name}: {most if len(rest) > len(own) else ' '.join(rest)}")
    return found


class Measure:
    """Bodies as shares of the documented ones: entries (10 bodies,) of L⁻¹ J L⁻ᵀ, one by one.

    Attributes:
        told: the documented bodies themselves; own: the same, rods and points given some size;
            cones: of as many possible bodies.
    """

    def __init__(self, told: Array) -> None:
        whole, mass = pseudo_inertia(told), np.maximum(told[:, :1], LEAST_SIZE)
        centre = whole[:, :3, 3] / mass
        spread = whole[:, :3, :3] - mass[..., None] * centre[:, :, None] * centre[:, None, :]
        values, vectors = np.linalg.eigh(spread)
        self._root = np.zeros_like(whole)
        # m: as if documented bodies were spread so far about their centres at least, others are
        # measured. A rod or a point is not spread; beside a flat one (the Panda's second link) some
        # millimetres weighed more than 20 kg.
        self._root[:, :3, :3] = vectors * np.sqrt(np.maximum(values, mass * 0.03**2))[:, None, :]
        self._root[:, :3, 3], self._root[:, 3, 3:] = np.sqrt(mass) * centre, np.sqrt(mass)
        self._inverse = np.linalg.inv(self._root)
        self.told, self.cones = self.of(told), [POSSIBLE] * len(told)
        values, vectors = np.linalg.eigh(matrices(self.told.reshape(-1, 10)))
        size = np.sqrt(np.clip(values, LEAST_SIZE, 1.0))[:, None, :]
        back = np.swapaxes(vectors, -1, -2)
        self.own = entries(vectors * size**2 @ back).ravel()
        self._whiten = vectors / size @ back

    def of(self, theta: Array) -> Array:
        """(..., 10 bodies) of θ (..., bodies, 10)."""
        inverse = self._inverse
        shares = entries(inverse @ pseudo_inertia(theta) @ np.swapaxes(inverse, -1, -2))
        return shares.reshape(*shares.shape[:-2], -1)

    def theta(self, share: Array) -> Array:
        """θ (bodies, 10) back."""
        return theta_from_pseudo_inertia(
            self._root @ matrices(share.reshape(-1, 10)) @ np.swapaxes(self._root, -1, -2)
        )

    @property
    def units(self) -> Array:
        """(10 bodies, 10 bodies) θ, flat, of each unit."""
        size = self.told.size
        return np.array([self.theta(unit).ravel() for unit in np.eye(size)])

    def least(self, share: Array) -> float:
        """Least share of a documented body (of its `own`) that is left in any direction."""
        whole = self._whiten @ matrices(share.reshape(-1, 10)) @ self._whiten
        return float(np.linalg.eigvalsh(whole).min())


def _most_room(measure: Measure, start: Array, free: Array) -> float:
    """The largest share, up to `KEPT`, that can be left of every body at once; 0 where none."""
    count = free.shape[1]
    x, _, _ = solve_conic(
        NEARNESS * np.diag(np.append(np.ones(count), 0.0)),
        np.append(np.zeros(count), -1.0),
        np.vstack([np.column_stack([-free, measure.own]), np.append(np.zeros(count), 1.0)]),
        np.append(start, KEPT),
        [*measure.cones, NONNEGATIVE],
    )
    if not np.isfinite(x).all():
        return 0.0
    return min(float(x[-1]), measure.least(start + free @ x[:-1]))


def _nearest_by_torque(measure: Measure, start: Array, regressor: Array) -> FilledTheta:
    """Possible bodies whose torques are nearest to those of what was learned."""
    table = regressor @ measure.units.T
    root = np.asarray(np.linalg.qr(table, mode="r"))
    table = root / max(float(np.linalg.norm(root @ start)), 1e-300)
    quadratic = table.T @ table + NEARNESS * np.eye(len(start))
    share, _, _ = solve_conic(
        quadratic,
        -table.T @ (table @ start) - NEARNESS * measure.told,
        -np.eye(len(start)),
        -1e-3 * measure.own,  # the same where no possible body has what was learned
        measure.cones,
    )
    least = measure.least(share) if np.isfinite(share).all() else 0.0
    if least <= 0.0:
        raise ModelError(UNSOLVED)
    return FilledTheta(measure.theta(share), least, False)
