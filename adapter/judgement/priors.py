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

import numpy as np

from adapter.model.spatial import Array
from adapter.screening.likelihood import LOAD_STD

DOCUMENTED_SHARE = 0.05
OFFSET_NM, COULOMB_NM, VISCOUS_NM_S, STATIC_NM, MOTOR_KG_M2 = 1.0, 2.0, 1.0, 0.5, 0.05
SPREAD, LIGHT_KG, SMALL_M = 0.25, 0.1, 0.05  # of `theta_prior`


def prior_std(theta: Array, share: float = DOCUMENTED_SHARE) -> Array:
    """(10 + 15 n,) of all that may be off an arm with documented inertias theta (n, 10).

    Ten of the load about the last link's origin, 10 n of the links, and by joint offset, Coulomb
    and viscous friction, motor inertia and static friction.
    """
    joint = (OFFSET_NM, COULOMB_NM, VISCOUS_NM_S, MOTOR_KG_M2, STATIC_NM)
    own = np.repeat(joint, len(theta))
    return np.concatenate([LOAD_STD, theta_prior(theta, share).ravel(), own])


def positive(n: int) -> slice:
    """Friction and motors of n joints among these: no arm has less than none of them."""
    return slice(10 + 11 * n, 10 + 14 * n)


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
