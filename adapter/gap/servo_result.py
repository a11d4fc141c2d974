"""What is found of an arm's servos, and when a number of theirs has a name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from adapter.gap import servo_kernels as col
from adapter.gap.result import WORSE, InUnits, RolloutCurves
from adapter.gap.servo_fit import JointFit
from adapter.gap.servo_kernels import NO_GROUND, Ground
from adapter.gap.servo_model import ServoModel
from adapter.model.spatial import Array

SURE = 4.0  # standard deviations from the documented value, from which on it is another one
DOCUMENTED_SHARE = 0.01  # of a documented value, to which it is meant; one standard deviation
SHOWN = 2.0  # from zero, where nobody documented a value: every servo has some of it
OPEN_SHARE = 0.3  # standard deviation of a position gain, of its size, from which on it is open

EFFECTS = {  # what each is called, its parameter and its unit, where a joint turns
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
        effect: one of `EFFECTS`; joints: from 1, all turning or all sliding; unit: of its values.
        values, std, documented: one for each joint, SI; documented is None where nobody says.
        open: what cannot be told apart from it; empty where it stands alone.
    """

    effect: str
    joints: tuple[int, ...]
    values: tuple[float, ...]
    std: tuple[float, ...]
    documented: tuple[float | None, ...]
    unit: str
    open: str = ""


@dataclass(frozen=True, eq=False)
class ServoGap(InUnits):
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
        slides: (n,) whether each joint does: its figures are then in N and m.
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
    slides: tuple[bool, ...] = ()

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


class Findings(InUnits):
    """Findings as they come, joint by joint."""

    def __init__(self, documented: ServoModel, slides: tuple[bool, ...]) -> None:
        self.docs, self.slides = documented, slides
        self.rows: dict[str, list[tuple[int, float, float, float | None]]] = {
            x: [] for x in EFFECTS
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
            title, unit = EFFECTS[effect][0], self.unit(EFFECTS[effect][2], j)
            self.notes.append(
                f"joint {j + 1}: {title} of {value:.3g} {unit} is in the model and not named: "
                "inertias as wrong as they may be explain as much"
            )

    def add_joint(self, j: int, fit: JointFit) -> None:
        """What a joint's fit found."""
        docs, free = self.docs, fit.freedom.free
        values, std = fit.values, np.sqrt(np.diagonal(fit.doubt))
        gain = float(docs.velocity_gain[j])
        if free[col.A]:
            self.add("servo_position_gain", j, values[0], std[0], float(docs.position_gain[j]))
            if std[0] > OPEN_SHARE * values[0]:
                self.scale_open.append(j + 1)
        if free[col.LEAD]:
            self.add("servo_velocity_gain", j, values[1], std[1], gain)
        if fit.x[col.LEAD] > 0.0 and (free[col.LEAD] or free[col.DAMPING]):
            apart = np.eye(col.WITHIN)[col.DAMPING] - np.eye(col.WITHIN)[col.LEAD]
            doubt = float(np.sqrt(apart @ fit.doubt @ apart))
            self.add("viscous_friction", j, float(apart @ values), doubt, float(docs.viscous[j]))
        elif free[col.DAMPING] and gain > 0.0:
            self.add("viscous_friction", j, values[2] - gain, std[2], float(docs.viscous[j]))
        elif free[col.DAMPING]:
            self.together = True
            self.add("servo_velocity_gain", j, values[2], std[2], gain)
        if free[col.TIGHT] and values[col.TIGHT] > 0.0:
            limit, off = 1.0 / values[col.TIGHT], std[col.TIGHT] / values[col.TIGHT] ** 2
            self.add("servo_torque_limit", j, limit, off, float(docs.torque_limit[j]))
        for effect, k, times, told in (
            ("motor_inertia", col.INERTIA, 1.0, docs.armature),
            ("coulomb_friction", col.RUBS, 1.0, docs.coulomb),
            ("static_friction", col.STICKS, 1.0, docs.stiction),
            ("servo_dead_band", col.DEAD, 1.0, docs.dead_band),
            ("backlash", col.PLAY, 2.0, docs.backlash),
        ):
            if free[k]:
                self.add(effect, j, times * values[k], times * std[k], float(told[j]))

    def findings(self) -> tuple[ServoFinding, ...]:
        """By effect and unit."""
        found = []
        for effect, entries in self.rows.items():
            both = self.together and effect == "servo_velocity_gain"
            said = WITH_FRICTION if both else ""
            units = [self.unit(EFFECTS[effect][2], row[0] - 1) for row in entries]
            for unit in dict.fromkeys(units):
                own = [row for row, its in zip(entries, units, strict=True) if its == unit]
                joints, values, stds, documented = zip(*own, strict=True)
                found.append(ServoFinding(effect, joints, values, stds, documented, unit, said))
        return tuple(found)
