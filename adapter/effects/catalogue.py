"""All the physical effects beside the rigid body, by name."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TypeGuard

from adapter.effects import joint_torques
from adapter.effects.base import Effect, LearnedEffect
from adapter.effects.bodies import BaseTilt, ExternalWrench, LinkInertia, Payload
from adapter.effects.bristle_friction import BristleFriction, StribeckFriction
from adapter.effects.encoders import Backlash, EncoderOffset, EncoderRipple, JointElasticity
from adapter.effects.law import CURVES, LAWS, learned_law
from adapter.effects.sensors import SignalDelay, TorqueFilter, TorqueGain, TorqueOffset
from adapter.errors import SettingsError
from drivers.errors import choices

CATALOGUE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        joint_torques.ViscousFriction(),
        joint_torques.CoulombFriction(),
        joint_torques.AsymmetricFriction(),
        StribeckFriction(),
        BristleFriction(),
        joint_torques.LoadDependentFriction(),
        joint_torques.MotorInertia(),
        JointElasticity(),
        Backlash(),
        joint_torques.TorqueRipple(),
        joint_torques.JointSpring(),
        TorqueOffset(),
        TorqueGain(),
        TorqueFilter(),
        EncoderOffset(),
        EncoderRipple(),
        SignalDelay(),
        Payload(),
        LinkInertia(),
        BaseTilt(),
        ExternalWrench(),
        joint_torques.FrictionDrift(),
    )
}

# What files and findings may name: effects, and laws of what none of them is.
KNOWN: Mapping[str, Effect] = ChainMap(CATALOGUE, {**LAWS, **CURVES})


def learnable(effect: Effect) -> TypeGuard[LearnedEffect]:
    """Whether the learner can carry it beside θ from nothing: linear, and not by the load."""
    return isinstance(effect, LearnedEffect) and not getattr(effect, "by_load", False)


LEARNED: dict[str, LearnedEffect] = {
    name: effect for name, effect in CATALOGUE.items() if learnable(effect)
}

# What a real arm's joints have, as far as anybody knows before it has moved. Those that the data
# do not show fade.
REAL_ARM_EFFECTS = (
    *("viscous_friction", "bristle_friction", "torque_offset", "motor_inertia"),
    *("torque_filter", "joint_spring"),
)

# Effects that parts of the program need as such.
LATENESS = CATALOGUE["signal_delay"]  # what samples look like whose torques come late
HELD = CATALOGUE["payload"]  # what the hand carries
WRONG_LINK = CATALOGUE["link_inertia"]  # what inertias are that are wrong altogether


@contextmanager
def registered(effect: Effect) -> Iterator[Effect]:
    """The catalogue with one effect more, as long as the block lasts.

    For an effect of one's own: it is learned, looked for, simulated and exported like the others.
    """
    if effect.name in CATALOGUE:
        raise SettingsError(f"there is an effect '{effect.name}' already")
    CATALOGUE[effect.name] = effect
    if learnable(effect):
        LEARNED[effect.name] = effect
    try:
        yield effect
    finally:
        del CATALOGUE[effect.name]
        LEARNED.pop(effect.name, None)


def learned_effect(name: str) -> LearnedEffect:
    """The learner's effect of a name, a law among them. Raises SettingsError with the choices."""
    effect = LEARNED.get(name) or learned_law(name)
    if effect is None:
        raise SettingsError(f"no effect '{name}'; {choices(name, ('none', 'real', *LEARNED))}")
    return effect


def effects_by_name(names: Iterable[str]) -> tuple[LearnedEffect, ...]:
    """The learner's effects of these names, in order. Raises SettingsError with the choices."""
    return tuple(map(learned_effect, names))
