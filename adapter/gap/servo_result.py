"""What is found of an arm's servos, and when a number of theirs has a name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from adapter.gap.result import WORSE, RolloutCurves
from adapter.gap.servo_fit import JointFit
from adapter.gap.servo_kernels import (
    DAMPING,
    DEAD,
    INERTIA,
    LEAD,
    NO_GROUND,
    PLAY,
    RUBS,
    STICKS,
    TIGHT,
    WITHIN,
    A,
    Ground,
)
from adapter.gap.servo_model import ServoModel
from adapter.model.spatial import Array

SURE = 4.0  # standard deviations from the documented value, from which on it is another one
DOCUMENTED_SHARE = 0.01  # of a documented value, to which it is meant; one standard deviation
SHOWN = 2.0  # from zero, where nobody documented a value: every servo has some of it
OPEN_SHARE = 0.3  # standard deviation of a position gain, of its size, from which on it is open

EFFECTS = {  # what each is called, its parameter and its unit
    "servo_position_gain": ("position gain", "kp", "N m/rad"),
    "servo_velocity_gain": ("velocity gain", "kd", "N m s/rad"),
    "servo_delay": ("delay of commands", "d", "s"),
    "coulomb_friction": ("Coulomb friction", "Fc", "N m"),
    "static_friction": ("static beyond Coulomb friction", "Fs - Fc", "N m"),
    "viscous_friction": ("viscous friction", "Fv", "N m s/rad"),
    "motor_inertia": ("motor inertia (armature)", "B", "kg m2"),
    "servo_torque_limit": ("torque limit", "tau_max", "N m"),
    "servo_dead_band": ("dead band", "e0", "rad"),
    "backlash": ("backlash", "b", "rad"),
}
DAMPS = ("servo_velocity_gain", "viscous_friction")
WITH_FRICTION = "velocity gain and viscous friction together: no command's speed tells them apart"


@dataclass(frozen=True)
class ServoFinding:
    """One effect on some joints, whose number is not the documented one.

    Attributes:
        effect: one of `EFFECTS`; joints: from 1.
        values, std, documented: one for each joint, SI; documented is None where nobody says.
        open: what cannot be told apart from it; empty where it stands alone.
    """

    effect: str
    joints: tuple[int, ...]
    values: tuple[float, ...]
    std: tuple[float, ...]
    documented: tuple[float | None, ...]
    open: str = ""


@dataclass(frozen=True, eq=False)
class ServoGap:
    """All that is said of a position-controlled arm.

    Attributes:
        joint_names, model_name, recordings: of the arm, its model and the files.
        findings: by effect; servos: the new model.
        curves: what the fit has not seen, recordings held out or the last third, by name: measured,
            and foretold by commands alone, before by the documented and after by the new servos.
        scored: which data these are, in words.
        hand: the frame at the hand; hand_before, hand_after: (n + 1,) m, rms by which it is off, by
            each joint's error alone and, last, by all of them.
        scale_open: joints (from 1) whose documented masses do not show the gains' scale.
        ground: what the hand came down on beside what is documented, if anything; touched: for how
            long, s, in each recording that is fitted.
        notes: a sentence each.
    """

    joint_names: tuple[str, ...]
    model_name: str
    recordings: tuple[str, ...]
    findings: tuple[ServoFinding, ...]
    servos: ServoModel
    curves: tuple[tuple[str, RolloutCurves], ...]
    scored: str
    hand: str
    hand_before: Array
    hand_after: Array
    scale_open: tuple[int, ...] = ()
    ground: Ground = NO_GROUND
    touched: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()

    @cached_property
    def before(self) -> Array:
        """(n,) rad, rms tracking error of the documented servos, all recordings counting alike."""
        return rms([x.before - x.measured for _, x in self.curves])

    @cached_property
    def after(self) -> Array:
        """(n,) rad, the same of the new servos."""
        return rms([x.after - x.measured for _, x in self.curves])

    @property
    def worse(self) -> list[int]:
        """Joints (from 1) that the new servos foretell worse than the documented ones."""
        return [int(j) + 1 for j in np.flatnonzero(self.after > (1.0 + WORSE) * self.before)]


def rms(left: Sequence[Array]) -> Array:
    """Root mean square over the rows of tables that count alike."""
    return np.asarray(np.sqrt(np.mean([np.mean(x**2, axis=0) for x in left], axis=0)))


class Findings:
    """Findings as they come, joint by joint."""

    def __init__(self, documented: ServoModel) -> None:
        self.docs = documented
        self.rows: dict[str, list[tuple[int, float, float, float | None]]] = {
            e: [] for e in EFFECTS
        }
        self.together = False
        self.scale_open: list[int] = []
        self.notes: list[str] = []

    def add(self, effect: str, j: int, value: float, std: float, documented: float) -> None:
        """A value of joint j (from 0), where it is another one than documented."""
        told = bool(np.isfinite(self.docs.position_gain[j]) and np.isfinite(documented))
        far = abs(value - documented) if told else value
        meant = DOCUMENTED_SHARE * max(documented, self.docs.velocity_gain[j] * (effect in DAMPS))
        if far > (SURE * np.hypot(std, meant) if told else SHOWN * std):
            row = j + 1, float(value), float(std), float(documented) if told else None
            self.rows[effect].append(row)
        else:
            title, _, unit = EFFECTS[effect]
            self.notes.append(
                f"joint {j + 1}: {title} of {value:.3g} {unit} is in the model and not named: "
                "inertias as wrong as they may be explain as much"
            )

    def add_joint(self, j: int, fit: JointFit) -> None:
        """What a joint's fit found."""
        docs, free = self.docs, fit.freedom.free
        values, std = fit.values, np.sqrt(np.diagonal(fit.doubt))
        gain = float(docs.velocity_gain[j])
        if free[A]:
            self.add("servo_position_gain", j, values[0], std[0], float(docs.position_gain[j]))
            if std[0] > OPEN_SHARE * values[0]:
                self.scale_open.append(j + 1)
        if free[LEAD]:
            self.add("servo_velocity_gain", j, values[1], std[1], gain)
        if fit.x[LEAD] > 0.0 and (free[LEAD] or free[DAMPING]):
            apart = np.eye(WITHIN)[DAMPING] - np.eye(WITHIN)[LEAD]
            doubt = float(np.sqrt(apart @ fit.doubt @ apart))
            self.add("viscous_friction", j, float(apart @ values), doubt, float(docs.viscous[j]))
        elif free[DAMPING] and gain > 0.0:
            self.add("viscous_friction", j, values[2] - gain, std[2], float(docs.viscous[j]))
        elif free[DAMPING]:
            self.together = True
            self.add("servo_velocity_gain", j, values[2], std[2], gain)
        if free[INERTIA]:
            self.add("motor_inertia", j, values[3], std[3], float(docs.armature[j]))
        if free[RUBS]:
            self.add("coulomb_friction", j, values[4], std[4], float(docs.coulomb[j]))
        if free[STICKS]:
            self.add("static_friction", j, values[STICKS], std[STICKS], float(docs.stiction[j]))
        if free[TIGHT] and values[TIGHT] > 0.0:
            limit, off = 1.0 / values[TIGHT], std[TIGHT] / values[TIGHT] ** 2
            self.add("servo_torque_limit", j, limit, off, float(docs.torque_limit[j]))
        if free[DEAD]:
            self.add("servo_dead_band", j, values[DEAD], std[DEAD], float(docs.dead_band[j]))
        if free[PLAY]:
            self.add("backlash", j, 2 * values[PLAY], 2 * std[PLAY], float(docs.backlash[j]))

    def findings(self) -> tuple[ServoFinding, ...]:
        """By effect."""
        found = []
        for effect, entries in self.rows.items():
            if entries:
                joints, values, stds, documented = zip(*entries, strict=True)
                both = self.together and effect == "servo_velocity_gain"
                said = WITH_FRICTION if both else ""
                found.append(ServoFinding(effect, joints, values, stds, documented, said))
        return tuple(found)
