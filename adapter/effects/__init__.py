"""Physical effects beside the rigid body, one file each: see `CATALOGUE`."""

from __future__ import annotations

from collections.abc import Iterable

from adapter.effects.base import JointEffect
from adapter.effects.coulomb_friction import CoulombFriction
from adapter.effects.motor_inertia import MotorInertia
from adapter.effects.torque_offset import TorqueOffset
from adapter.effects.viscous_friction import ViscousFriction
from adapter.errors import SettingsError

CATALOGUE: dict[str, type[JointEffect]] = {
    effect.name: effect for effect in (ViscousFriction, CoulombFriction, TorqueOffset, MotorInertia)
}


def effects_by_name(names: Iterable[str]) -> tuple[JointEffect, ...]:
    """The effects of these names, in this order. Raises SettingsError naming the choices."""
    chosen = list(names)
    for name in chosen:
        if name not in CATALOGUE:
            raise SettingsError(f"no effect '{name}'; have: {', '.join(CATALOGUE)}")
    return tuple(CATALOGUE[name]() for name in chosen)
