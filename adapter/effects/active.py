"""Effects at work: the entries of model files and findings, checked, one joint at a time."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from adapter.effects import base
from adapter.effects.by_joint import ByJoint
from adapter.effects.catalogue import CATALOGUE, KNOWN
from adapter.effects.law import Law
from adapter.errors import ModelError
from adapter.model.self_model import SelfModel
from drivers.errors import choices

WHOLE = (-np.inf, np.inf)
NEEDED = ("effect", "parameters")
SHOWN_STD = 3.0  # so many standard deviations from zero is more than noise


@dataclass(frozen=True, eq=False)
class Active:
    """An effect at work.

    Attributes:
        effect: of the catalogue.
        joint: from 0; -1 where the effect has no joint of its own.
        values: its parameters.
        interval_s: (from, to) s of the recording in which it acts.
        std: of the parameters, None where unknown.
    """

    effect: base.Effect
    joint: int
    values: base.Values
    interval_s: tuple[float, float] = WHOLE
    std: Mapping[str, float | None] = field(default_factory=dict)

    def on(self, t: base.Array) -> base.Flags | None:
        """(m,) where it acts; None where it always does."""
        if self.interval_s == WHOLE:
            return None
        return np.asarray((t >= self.interval_s[0]) & (t < self.interval_s[1]))

    @property
    def lasting(self) -> bool:
        """Whether it has no end: it is there in whatever comes after the recording."""
        return self.interval_s[1] == np.inf

    @property
    def entry(self) -> dict[str, Any]:
        """Of a model file, as if it acted always."""
        joints = {"joints": [self.joint + 1]} if self.joint >= 0 else {}
        return {"effect": self.effect.name, "parameters": dict(self.values), **joints}

    def starts(self, names: Container[str] | None = None) -> dict[str, float]:
        """Where parameters of learned effects start, by name, if it is learned with these."""
        parts = self.effect.learned_from(self.values)
        parts = {x: value for k, (x, value) in enumerate(parts.items()) if value or k == 0}
        return parts if names is None or all(name in names for name in parts) else {}

    @property
    def shown(self) -> bool:
        """Whether any number that was learned is more than noise; or nobody knows of any."""
        stds = {key: self.std.get(key) for key in self.values}
        known = {key: std for key, std in stds.items() if std is not None}
        return not known or any(
            np.any(np.abs(np.asarray(self.values[key], float)) > SHOWN_STD * np.asarray(std, float))
            for key, std in known.items()
        )


def active_effects(entries: Iterable[Mapping[str, Any]], n: int) -> tuple[Active, ...]:
    """The effects in a model file's or report's entries, one for each joint named.

    A parameter is one value for all joints of the entry, or a list with one for each of them.

    Raises:
        ModelError: an effect that is not in the catalogue, a joint outside 1 to n, a parameter
            that is missing or out of range, an interval that is none.
    """
    return tuple(active for entry in entries for active in _of_entry(entry, n))


def lasting_effects(entries: Iterable[Mapping[str, Any]], n: int) -> tuple[Active, ...]:
    """Those without an end, taken as acting always: what holds beyond the recording."""
    return tuple(replace(a, interval_s=WHOLE) for a in active_effects(entries, n) if a.lasting)


def check_effects(model: SelfModel, where: str | Path) -> SelfModel:
    """The model itself, its effects being what the catalogue has.

    Raises:
        ModelError: as `active_effects`, naming `where` the model came from.
    """
    try:
        active_effects(model.effects, model.tree.n)
    except ModelError as error:
        raise ModelError(f"{where}: {error}") from None
    return model


def with_bodies(model: SelfModel) -> SelfModel:
    """The model with its lasting `BodyEffect`s in θ and gravity, and without their entries.

    An effect that ends with its recording is over and left as it is. A model without any is
    returned itself.
    """
    n, theta, gravity, kept = model.tree.n, model.theta.copy(), model.gravity, []
    for entry in model.effects:
        for active in active_effects([entry], n):
            if not (isinstance(active.effect, base.BodyEffect) and active.lasting):
                kept.append(entry)
                break
            links, gravity = active.effect.body(theta[-n:], gravity, active.joint, active.values)
            theta[-n:] = links
    if len(kept) == len(model.effects):
        return model
    return replace(model, theta=theta, gravity=np.array(gravity), effects=tuple(kept))


def by_joint(effects: Iterable[Active], n: int) -> ByJoint:
    """Sums over n joints of effects, whatever their intervals; those of bodies stay out."""
    sums, left_out = ByJoint.zero(n), set()
    for active in effects:
        joint = slice(None) if active.joint < 0 else active.joint
        if not active.effect.at_instant(sums, joint, active.values):
            left_out.add(active.effect.name)
    sums.left_out = tuple(sorted(left_out))
    return sums


def _of_entry(entry: Any, n: int) -> list[Active]:
    if not isinstance(entry, Mapping) or any(key not in entry for key in NEEDED):
        raise ModelError(f"an effect needs {' and '.join(NEEDED)}, got {entry!r}")
    name = entry["effect"]
    if not isinstance(name, str) or name not in KNOWN:
        raise ModelError(f"no effect '{name}'; {choices(name, CATALOGUE)}")
    effect = KNOWN[name]
    if isinstance(effect, Law) and effect.by > n:
        raise ModelError(f"{effect.name}: no joint {effect.by}; have: 1 to {n}")
    values = entry["parameters"]
    if not isinstance(values, Mapping):
        raise ModelError(f"{effect.name}: 'parameters' must hold {_keys(effect)}, got {values!r}")
    joints, interval = _joints(effect, entry.get("joints"), n), _interval(effect, entry)
    std = entry.get("std") or {}
    if not isinstance(std, Mapping):
        raise ModelError(f"{effect.name}: 'std' must hold {_keys(effect)}, got {std!r}")
    if not joints:
        effect.check(values)
        return [Active(effect, -1, values, interval, std)]
    found = []
    for k, joint in enumerate(joints):
        own = {key: _of_joint(effect, key, value, k, len(joints)) for key, value in values.items()}
        effect.check(own)
        spread = {key: _of_joint(effect, key, s, k, len(joints)) for key, s in std.items()}
        found.append(Active(effect, joint - 1, own, interval, spread))
    return found


def _keys(effect: base.Effect) -> str:
    return ", ".join(f"'{p.key}'" for p in effect.parameters)


def _joints(effect: base.Effect, joints: Any, n: int) -> list[int]:
    """The joints that the effect has for its own; none for one of the flange, the base or all."""
    given = [] if joints is None else joints
    if not isinstance(given, Sequence | np.ndarray) or isinstance(given, str):
        raise ModelError(f"{effect.name}: 'joints' must be a list of 1 to {n}, got {joints!r}")
    for j in given:
        if isinstance(j, bool) or not isinstance(j, int | np.integer) or not 1 <= j <= n:
            raise ModelError(f"{effect.name}: no joint {j!r}; have: 1 to {n}")
    if effect.scope in (base.JOINT, base.LINK) and not len(given):
        raise ModelError(f"{effect.name} needs 'joints'; have: 1 to {n}")
    return [int(j) for j in given] if effect.scope in (base.JOINT, base.LINK, base.ALL) else []


def _interval(effect: base.Effect, entry: Mapping[str, Any]) -> tuple[float, float]:
    """(from, to) in s; infinite where the entry leaves an end open."""
    given = entry.get("interval_s")
    if given is None:
        return WHOLE
    try:
        begin, end = given
        found = (-np.inf if begin is None else float(begin), np.inf if end is None else float(end))
    except (TypeError, ValueError):
        raise ModelError(
            f"{effect.name}: 'interval_s' must be [from, to] in s, or null; got {given!r}"
        ) from None
    if not found[0] < found[1]:
        raise ModelError(f"{effect.name}: 'interval_s' {given!r} does not end after it begins")
    return found


def _of_joint(effect: base.Effect, key: str, value: Any, k: int, joints: int) -> Any:
    """A parameter of the k-th joint: entries may hold one value for each."""
    parameter: base.Parameter | None = next((p for p in effect.parameters if p.key == key), None)
    if parameter is None or np.ndim(value) == (0 if parameter.count == 1 else 1):
        return value
    if not hasattr(value, "__len__") or len(value) != joints:
        raise ModelError(f"{effect.name}: '{key}' holds not one value for each of {joints} joints")
    return value[k]
