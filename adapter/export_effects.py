"""What of a model's effects a URDF has a place for, and the words for what it has not.

A simulator that reads the URDF gets friction (<dynamics>), the load and the inertias, the zero of
the encoders and the tilt of the base under its own, upright gravity.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from adapter.effects.active import Active, active_effects
from adapter.effects.base_tilt import BaseTilt
from adapter.effects.payload import theta_of
from adapter.inertia import CONSISTENCY_TOLERANCE, is_consistent
from adapter.model import SelfModel, gravity_down
from adapter.spatial import Array


@dataclass
class UrdfParts:
    """Effects as a URDF holds them, and what is left.

    Attributes:
        damping, friction: (n,) of <dynamics>, N m s/rad and N m.
        offset: (n,) of the encoders, rad.
        dtheta: (n, 10) what links weigh more than the model's θ, in their frames.
        loads: (10,) each, of payloads in the last link's frame.
        tilt: (3, 3) how the base stands, None where upright.
        left_out: one sentence each; names: effects in it, sorted.
    """

    damping: Array
    friction: Array
    offset: Array
    dtheta: Array
    loads: list[Array] = field(default_factory=list)
    tilt: Array | None = None
    left_out: list[str] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, model: SelfModel) -> UrdfParts:
        """Sort the effects of a model."""
        n = model.tree.n
        parts = cls(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((n, 10)))
        if not np.array_equal(model.gravity, gravity_down()):
            parts.left_out.append(f"gravity {model.gravity.tolist()} m/s2 in base axes")
        effects = active_effects(model.effects, n)
        for active in effects:
            if not active.lasting:
                parts.left_out.append(f"{_said(model, active)} (it ended)")
            elif not parts._take(model, active):
                parts.left_out.append(_said(model, active))
        parts._only_losses(model)
        said = {line.split()[0].rstrip(",") for line in parts.left_out}
        parts.names = sorted(said & {a.effect.name for a in effects})
        return parts

    def _take(self, model: SelfModel, active: Active) -> bool:
        """Whether there is a place for an effect; one that is there in part is listed too."""
        name, j, v = active.effect.name, active.joint, active.values
        if name == "viscous_friction":
            self.damping[j] += v["Fv"]
        elif name == "coulomb_friction":
            self.friction[j] += v["Fc"]
        elif name == "stribeck_friction":
            self.friction[j] += v["Fc"]
            self._partly(model, active, "Fc is in <dynamics>")
        elif name == "asymmetric_friction":
            self.friction[j] += 0.5 * (v["Fc_pos"] + v["Fc_neg"])
            self._partly(model, active, "the mean of both is in <dynamics>")
        elif name == "encoder_offset":
            self.offset[j] += v["o"]
        elif name == "link_inertia":
            self.dtheta[j] += np.asarray(v["dtheta"], dtype=float)
        elif name == "payload":
            self._add_load(theta_of(v), model)
        elif name == "base_tilt" and not model.tree.floating:
            turn = BaseTilt.turn(v)
            self.tilt = turn if self.tilt is None else self.tilt @ turn
        else:
            return False
        return True

    def _add_load(self, theta: Array, model: SelfModel) -> None:
        """A payload as a body of its own, or within the last link where it could not be one."""
        if is_consistent(theta, -CONSISTENCY_TOLERANCE * float(np.max(np.abs(theta)))):
            self.loads.append(theta)
            return
        self.dtheta[-1] += theta
        self.left_out.append(
            f"payload of {theta[0]:g} kg, which has no possible inertia of its own and is part of "
            f"{model.tree.link_names[-1]}"
        )

    def _partly(self, model: SelfModel, active: Active, what: str) -> None:
        self.left_out.append(f"{_said(model, active)} ({what})")

    def _only_losses(self, model: SelfModel) -> None:
        """<dynamics> takes no negative numbers; say so where there are some."""
        for what, table in (("damping", self.damping), ("friction", self.friction)):
            for j in np.flatnonzero(table < 0.0):
                name = model.tree.joint_names[j]
                self.left_out.append(f"{what} of {name}, which is negative: {table[j]:g}")
                table[j] = 0.0


def comment(left_out: list[str]) -> str:
    """Text of the comment; XML forbids two hyphens in a row in one."""
    text = " This file has no place for: " + "; ".join(left_out) + " "
    return text.replace("--", "- -")


def _said(model: SelfModel, active: Active) -> str:
    """An effect in words: name, joint, parameters with units."""
    units = active.effect.units()
    where = "" if active.joint < 0 else f" of {model.tree.joint_names[active.joint]}"
    numbers = (f"{key} = {_number(x)} {units[key]}" for key, x in active.values.items())
    return f"{active.effect.name}{where}, {', '.join(numbers)}"


def _number(value: object) -> str:
    return repr(value) if isinstance(value, int | float) else str(np.asarray(value).tolist())
