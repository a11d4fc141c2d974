"""Sizes of what a model of an arm may lack, one standard deviation each; nothing widens them.

load: mass, first, second moments   3 kg, 0.3 kg m, 0.05 kg m²: arms of this size carry 3 to 5 kg
                                    within 0.1 m of the hand
documented inertias                 5 % of their size, see `theta_prior`: what is left, link by
                                    link, of Gaz et al. 2019 against other Pandas
torque offset                       1 N m: of real Pandas 0.2 to 1 N m
Coulomb, viscous friction           2 N m, 1 N m s/rad: a Panda's 0.2 to 0.5 and 0.03 to 0.09,
                                    gearboxes of a UR10 3 to 8
static friction at rest             0.5 N m: a Panda's; a rest holds whatever lies within it
motor inertia that the model lacks  0.05 kg m²: 5e-6 kg m² at a motor behind gears of 1:100
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from adapter.model.spatial import Array

LOAD_KG, LOAD_KG_M, LOAD_KG_M2 = 3.0, 0.3, 0.05
DOCUMENTED_SHARE = 0.05
OFFSET_NM, COULOMB_NM, VISCOUS_NM_S, STATIC_NM, MOTOR_KG_M2 = 1.0, 2.0, 1.0, 0.5, 0.05
SPREAD, LIGHT_KG, SMALL_M = 0.25, 0.1, 0.05  # of `theta_prior`


class Place(NamedTuple):
    """Where a parameter of an arm of n joints stands in the vector of all."""

    n: int

    @property
    def load(self) -> slice:
        """Ten of the load about the last link's origin."""
        return slice(0, 10)

    @property
    def theta(self) -> slice:
        """10 n of the links."""
        return slice(10, 10 + 10 * self.n)

    def joint(self, k: int) -> slice:
        """n of the joints: offset 0, Coulomb 1, viscous 2, motor 3, static friction 4."""
        return slice(10 + (10 + k) * self.n, 10 + (11 + k) * self.n)

    @property
    def positive(self) -> slice:
        """Coulomb and viscous friction and motors: no arm has less than none."""
        return slice(self.joint(1).start, self.joint(3).stop)

    @property
    def size(self) -> int:
        """How many there are."""
        return 10 + 15 * self.n


def prior_std(theta: Array, share: float = DOCUMENTED_SHARE) -> Array:
    """(15 n + 10,) in the order of `Place`, of an arm with documented inertias theta (n, 10)."""
    load = np.repeat((LOAD_KG, LOAD_KG_M, LOAD_KG_M2), (1, 3, 6))
    joint = (OFFSET_NM, COULOMB_NM, VISCOUS_NM_S, MOTOR_KG_M2, STATIC_NM)
    return np.concatenate([load, theta_prior(theta, share).ravel(), np.repeat(joint, len(theta))])


def theta_prior(theta: Array, share: float) -> Array:
    """(n, 10) standard deviation of inertial parameters that are known to a `share` of their size.

    A parameter that happens to be near zero is no better known than its like: to its own size a
    quarter of its kind's (mass, first moment, mean moment of inertia) is added, and no body is
    lighter than 0.1 kg or smaller than 5 cm for that.
    """
    kind = np.empty_like(theta)
    mass = np.maximum(theta[:, :1], LIGHT_KG)
    kind[:, :1] = mass
    first, second = np.linalg.norm(theta[:, 1:4], axis=1), theta[:, [4, 7, 9]].mean(axis=1)
    kind[:, 1:4] = np.maximum(first[:, None], SMALL_M * mass)
    kind[:, 4:] = np.maximum(np.abs(second)[:, None], SMALL_M**2 * mass)
    return np.asarray(share * np.hypot(theta, SPREAD * kind))
