"""Sizes of what a model of an arm may lack, one standard deviation each; nothing widens them.

load: mass, first, second moments   3 kg, 0.3 kg m, 0.05 kg m²: arms of this size carry 3 to 5 kg
                                    within 0.1 m of the hand
documented inertias                 5 % of their size, see `theta_prior`: what is left, link by
                                    link, of Gaz et al. 2019 against other Pandas; 30 % where a
                                    file says that nobody measured them (PyBullet's Panda)
torque offset                       1 N m: of real Pandas 0.2 to 1 N m
Coulomb, viscous friction           5 N m, 1 N m s/rad: a Panda's 0.2 to 0.5 and 0.03 to 0.09,
                                    gearboxes of a UR10 3 to 8
static friction at rest             0.5 N m: a Panda's; a rest holds whatever lies within it
spring of cables along the arm      0.1 N m/rad: a Panda's 0.01 to 0.2; without it motors would
                                    have less than no inertia
motor inertia that the model lacks  0.1 kg m²: 5e-6 to 3e-5 kg m² at a motor behind gears of 1:100
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adapter.effects.base import on_drum
from adapter.effects.catalogue import LEARNED
from adapter.model.inertia import LIGHT_KG
from adapter.model.robot_file import made_up
from adapter.model.spatial import Array
from adapter.screening.likelihood import LOAD_STD

DOCUMENTED_SHARE, MADE_UP_SHARE = 0.05, 0.3
OFFSET_NM, COULOMB_NM, VISCOUS_NM_S, STATIC_NM, MOTOR_KG_M2 = 1.0, 5.0, 1.0, 0.5, 0.1
SPRING_NM_RAD = 0.1
EFFECT_STD = {  # the same, of the effects' parameters
    "torque_offset": OFFSET_NM,
    "coulomb_friction": COULOMB_NM,
    "bristle_friction": COULOMB_NM,
    "viscous_friction": VISCOUS_NM_S,
    "motor_inertia": MOTOR_KG_M2,
    "joint_spring": SPRING_NM_RAD,
}
SPREAD, SMALL_M, CENTRE_M = 0.25, 0.05, 0.1  # of `documented_std`


def is_shown(effect: str, key: str, std: float | None, slides: bool = False) -> bool:
    """Whether data told a parameter of an effect on a joint, and not its prior alone."""
    if std is None or effect not in EFFECT_STD or key != LEARNED[effect].key:
        return True
    drum = on_drum(LEARNED[effect].unit) if slides else 1.0
    return std < 0.5 * EFFECT_STD[effect] * drum  # or it was not shown


def prior_std(theta: Array, slides: Sequence[bool], share: float = DOCUMENTED_SHARE) -> Array:
    """(10 + 16 n,) of all that may be off an arm with documented inertias theta (n, 10).

    What joints have that slide is that of one that turns a drum (`effects.base.DRUM_M`).

    Ten of the load about the last link's origin, 10 n of the links, and by joint offset, Coulomb
    and viscous friction, motor inertia, spring and static friction.
    """
    joint = (OFFSET_NM, COULOMB_NM, VISCOUS_NM_S, MOTOR_KG_M2, SPRING_NM_RAD, STATIC_NM)
    units = "N m", "N m", "N m s/rad", "kg m2", "N m/rad", "N m"
    each = zip(joint, units, strict=True)
    own = np.concatenate([std * np.where(slides, on_drum(unit), 1.0) for std, unit in each])
    return np.concatenate([LOAD_STD, theta_prior(theta, share).ravel(), own])


def positive(std: Array, n: int) -> NDArray[np.bool_]:
    """(c,) where friction and motors of n joints are among these: no arm has less than none."""
    at = np.arange(len(std))
    return (at >= 10 + 11 * n) & (at < 10 + 14 * n)


def theta_prior(theta: Array, share: float) -> Array:
    """(n, 10) standard deviation of inertial parameters that are documented to a `share`.

    Of bodies that somebody made up little is known but the last one's mass, for which a load would
    be taken.
    """
    std = documented_std(theta, share)
    if made_up(theta):
        mass, std = std[-1, 0], np.maximum(std, documented_std(theta, MADE_UP_SHARE))
        std[-1, 0] = mass
    return std


def documented_std(theta: Array, share: float) -> Array:
    """(n, 10) of inertial parameters that are known to a `share` of their size.

    A parameter that happens to be near zero is no better known than its like: to a moment of
    inertia's own size a quarter of the mean one's is added, to a first moment's that of a centre
    0.1 m away, so that centres are known to 5 mm where masses are to 5 %. No body is lighter than
    0.1 kg or smaller than 5 cm for that.
    """
    like = np.zeros_like(theta)
    mass = np.maximum(theta[:, :1], LIGHT_KG)
    like[:, :1] = SPREAD * mass
    like[:, 1:4] = CENTRE_M * mass
    second = np.abs(theta[:, [4, 7, 9]].mean(axis=1))[:, None]
    like[:, 4:] = SPREAD * np.maximum(second, SMALL_M**2 * mass)
    return np.asarray(share * np.hypot(theta, like))
