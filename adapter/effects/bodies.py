"""Payloads, wrong inertias and a tilted base as part of the rigid body they change."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from adapter.effects.active import active_effects
from adapter.effects.base import BodyEffect

if TYPE_CHECKING:
    from adapter.model import SelfModel


def with_bodies(model: SelfModel) -> SelfModel:
    """The model with its lasting `BodyEffect`s in θ and gravity, and without their entries.

    An effect that ends with its recording is over and left as it is. A model without any is
    returned itself.
    """
    n, theta, gravity, kept = model.tree.n, model.theta.copy(), model.gravity, []
    for entry in model.effects:
        for active in active_effects([entry], n):
            if not (isinstance(active.effect, BodyEffect) and active.lasting):
                kept.append(entry)
                break
            links, gravity = active.effect.body(theta[-n:], gravity, active.joint, active.values)
            theta[-n:] = links
    if len(kept) == len(model.effects):
        return model
    return replace(model, theta=theta, gravity=np.array(gravity), effects=tuple(kept))
