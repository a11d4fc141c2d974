"""Physical effects beside the rigid body, a file for each kind: see `catalogue.CATALOGUE`."""

from adapter.effects.active import Active, active_effects, lasting_effects
from adapter.effects.base import Effect, LinearEffect
from adapter.effects.catalogue import CATALOGUE, LEARNED, effects_by_name

__all__ = [
    "CATALOGUE",
    "LEARNED",
    "Active",
    "Effect",
    "LinearEffect",
    "active_effects",
    "effects_by_name",
    "lasting_effects",
]
