"""Robots by name or file, with what their joints have beside the rigid arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from adapter.effects.active import check_effects
from adapter.effects.catalogue import CATALOGUE
from adapter.model.mjcf import read_mjcf
from adapter.model.mjcf_text import MJCF_PLACES
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel


def read_robot(
    name: str | Path,
    joints: Sequence[str] | None = None,
    floating: bool = False,
    gravity: ArrayLike | None = None,
    lock: Mapping[str, float] | None = None,
) -> SelfModel:
    """As `model.robots.documented`, and MJCF (.xml), whose joints bring their effects.

    Raises:
        ModelError: as there; effects that are not in the catalogue.
    """
    if Path(name).suffix.lower() != ".xml":
        return check_effects(documented(name, joints, floating, gravity, lock), name)
    model, extras = read_mjcf(name, joints, floating, gravity, lock)
    return check_effects(replace(model, effects=_effects(extras)), name)


def _effects(joints: Sequence[dict[str, float]]) -> tuple[dict[str, Any], ...]:
    """Entries of a model file for what MuJoCo's joints have."""
    found = []
    for effect in CATALOGUE.values():
        key = MJCF_PLACES.get(effect.place, "")
        having = [j for j, joint in enumerate(joints) if key in joint]
        if having:
            keys = (key, "springref")[: len(effect.parameters)]
            values = {
                parameter.key: [joints[j].get(k, 0.0) for j in having]
                for parameter, k in zip(effect.parameters, keys, strict=True)
            }
            numbers = [j + 1 for j in having]
            found.append({"effect": effect.name, "joints": numbers, "parameters": values})
    return tuple(found)
