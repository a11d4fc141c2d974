"""Effects that a simulated arm can hold: names, parameters, intervals.

Sign of all of them: `tau_measured = tau_rigid(q, dq, ddq) + sum of effects`. Names, keys, units
and frames of the catalogue are those of its table; names that begin with `x_` are in no
catalogue: what is to be said of them is that something is unexplained. A `torque_filter` is the
low-pass of second order whose series begins with its d and c: b read'' + d read' + read = tau with
b = d^2 - c, of first order where b is zero.

| name | torque on the joint, or what its sensor makes of it | keys (unit) |
|---|---|---|
| x_quadratic_drag | c dq abs(dq) | c (N m s²/rad²) |
| x_cubic_spring | c (q - q0)³ | c (N m/rad³), q0 (rad) |
| x_position_friction | A (1 + sin(q + phase)) sign(dq) | A (N m), phase (rad) |
| x_sine_disturbance | a sin(2 pi f t + phase) | a (N m), f (Hz), phase (rad) |
| x_velocity_ripple | a sin(n q + phase) dq | a (N m s/rad), n (per turn), phase (rad) |
| x_cross_viscous | joints [i, j]: c dq_i on joint j | c (N m s/rad) |
| x_torque_crosstalk | joints [i, j]: sensor j reads share tau_i on top | share (1) |
| x_torque_deadband | the sensor reads tau - clip(tau, -w, w) | w (N m) |
| x_torque_saturation | the sensor's curve bends: s tanh(tau/s) | s (N m) |
| x_held_joint | a spring holds it where it is when this begins, or pushes | push (N m), k |
| x_wall | a stiff plane across the hand's way when this begins, `gap` ahead | gap (m) |
| x_floor | a stiff level plane below the hand, with friction | height (m, base axes) |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import choices

Array = NDArray[np.float64]
Number = float | list[float]

# Where an effect acts: on the motion of a joint, on the rigid bodies, at the flange, on what an
# encoder or a torque sensor says. Name -> (place, needed keys, keys with a default).
MOTION, BODY, WRENCH, ENCODER, TORQUE = "motion", "body", "wrench", "encoder", "torque"
OBSTACLE = "obstacle"  # `sim.joint_effects`
SPECS: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "viscous_friction": (MOTION, ("Fv",), ()),
    "coulomb_friction": (MOTION, ("Fc",), ()),
    "asymmetric_friction": (MOTION, ("Fc_pos", "Fc_neg"), ()),
    "stribeck_friction": (MOTION, ("Fc", "Fs", "vs"), ()),
    "bristle_friction": (MOTION, ("Fc", "s0"), ()),
    "load_dependent_friction": (MOTION, ("Fl",), ()),
    "friction_drift": (MOTION, ("dFc",), ()),
    "motor_inertia": (MOTION, ("B",), ()),
    "torque_ripple": (MOTION, ("a", "n"), ("phase",)),
    "joint_spring": (MOTION, ("k", "q0"), ()),
    "payload": (BODY, ("m", "cx", "cy", "cz"), ("inertia",)),
    "link_inertia": (BODY, ("dtheta",), ()),
    "base_tilt": (BODY, ("rx", "ry"), ()),
    "external_wrench": (WRENCH, ("fx", "fy", "fz"), ("mx", "my", "mz")),
    "joint_elasticity": (ENCODER, ("k",), ()),
    "backlash": (ENCODER, ("b",), ()),
    "encoder_offset": (ENCODER, ("o",), ()),
    "encoder_ripple": (ENCODER, ("a",), ("phase",)),
    "torque_gain": (TORQUE, ("g",), ()),
    "torque_filter": (TORQUE, ("d", "c"), ()),
    "torque_offset": (TORQUE, ("o",), ()),
    "signal_delay": (TORQUE, ("d",), ()),
    "x_quadratic_drag": (MOTION, ("c",), ()),
    "x_cubic_spring": (MOTION, ("c",), ("q0",)),
    "x_position_friction": (MOTION, ("A",), ("phase",)),
    "x_sine_disturbance": (MOTION, ("a", "f"), ("phase",)),
    "x_velocity_ripple": (MOTION, ("a", "n"), ("phase",)),
    "x_cross_viscous": (MOTION, ("c",), ()),
    "x_torque_crosstalk": (TORQUE, ("share",), ()),
    "x_torque_deadband": (TORQUE, ("w",), ()),
    "x_torque_saturation": (TORQUE, ("s",), ()),
    "x_held_joint": (OBSTACLE, (), ("push", "k")),
    "x_wall": (OBSTACLE, (), ("gap",)),
    "x_floor": (OBSTACLE, ("height",), ()),
}
PAIRS = ("x_cross_viscous", "x_torque_crosstalk")  # joints [from, to]
LENGTHS = {"inertia": 6, "dtheta": 10}
POSITIVE = {
    "joint_elasticity": "k",
    "stribeck_friction": "vs",
    "bristle_friction": "s0",
    "torque_filter": "d",
    "x_torque_saturation": "s",
}
NOT_NEGATIVE = {"signal_delay": "d", "backlash": "b", "motor_inertia": "B"}


@dataclass(frozen=True)
class Effect:
    """One effect of a simulated arm.

    Attributes:
        name: one of `SPECS`.
        joints: counted from 1; what acts on the whole arm needs none, `signal_delay` without
            joints acts on all.
        parameters: by key; SI.
        interval_s: [from, to) in seconds of plant time, `to` None to the end; None for always.
    """

    name: str
    joints: tuple[int, ...]
    parameters: Mapping[str, Number] = field(hash=False)
    interval_s: tuple[float, float | None] | None = None

    def __post_init__(self) -> None:
        if self.name not in SPECS:
            raise ValueError(f"no effect {self.name!r}; {choices(self.name, SPECS)}")
        object.__setattr__(self, "joints", tuple(int(j) for j in self.joints))
        _, needed, optional = SPECS[self.name]
        for key in needed:
            if key not in self.parameters:
                raise ValueError(f"{self.name} has no {key!r}; needs: {', '.join(needed)}")
        for key, value in self.parameters.items():
            if key not in needed + optional:
                raise ValueError(
                    f"{self.name} has no parameter {key!r}; {choices(key, needed + optional)}"
                )
            shape = (LENGTHS[key],) if key in LENGTHS else ()
            try:
                numbers = np.asarray(value, dtype=float)
            except (TypeError, ValueError):
                numbers = np.array(np.nan)
            if numbers.shape != shape or not np.isfinite(numbers).all():
                raise ValueError(
                    f"{self.name}: {key} is {value!r}; needs {shape or 'one'} number(s)"
                )
        for table, fits in ((POSITIVE, np.greater), (NOT_NEGATIVE, np.greater_equal)):
            if self.name in table and not fits(self.number(table[self.name]), 0.0):
                raise ValueError(f"{self.name}: {table[self.name]} is too small")
        joints = self.joints
        whole = self.place in (BODY, WRENCH) or self.name in ("signal_delay", "x_wall", "x_floor")
        if any(j < 1 for j in joints):
            raise ValueError(f"{self.name} is on joints {list(joints)}; they count from 1")
        if self.name == "link_inertia" and len(joints) != 1:
            raise ValueError("link_inertia needs the one joint that moves its link")
        if self.name in PAIRS and len(joints) != 2:
            raise ValueError(f"{self.name} needs two joints: [from, to]")
        if not joints and not whole:
            raise ValueError(f"{self.name} needs at least one joint")
        if self.interval_s is not None and not self.start_s < self.end_s:
            raise ValueError(f"{self.name}: interval {self.interval_s} ends before it starts")

    @property
    def place(self) -> str:
        """Where it acts: motion, body, wrench, encoder, torque or obstacle."""
        return SPECS[self.name][0]

    @property
    def start_s(self) -> float:
        """When it begins; -inf where it always acts."""
        return -np.inf if self.interval_s is None else float(self.interval_s[0])

    @property
    def end_s(self) -> float:
        """When it ends; inf where it does not."""
        last = None if self.interval_s is None else self.interval_s[1]
        return np.inf if last is None else float(last)

    def number(self, key: str, default: float = 0.0) -> float:
        """A parameter that is one number."""
        return float(self.parameters.get(key, default))  # type: ignore[arg-type]

    def acts(self, t: Any) -> Any:
        """Whether it acts at t (s), a number or an array."""
        return (t >= self.start_s - 1e-9) & (t < self.end_s - 1e-9)

    def columns(self, n: int) -> list[int]:
        """Its joints counted from 0; all of n where none is named.

        Raises:
            ValueError: a joint that the arm does not have.
        """
        if any(j > n for j in self.joints):
            raise ValueError(f"{self.name} is on joints {list(self.joints)}; have: 1 to {n}")
        return [j - 1 for j in self.joints] or list(range(n))

    def as_dict(self) -> dict[str, Any]:
        """The entry of a truth file."""
        return {
            "effect": self.name,
            "joints": list(self.joints),
            "interval_s": None if self.interval_s is None else list(self.interval_s),
            "parameters": dict(self.parameters),
        }


def per_joint(name: str, key: str, values: Sequence[float] | Array) -> tuple[Effect, ...]:
    """An effect of one parameter on every joint whose value (n,) is not zero."""
    numbers = [float(value) for value in values]
    return tuple(Effect(name, (j,), {key: x}) for j, x in enumerate(numbers, 1) if x)


def payload(
    m: float, com: Sequence[float] | Array, inertia: Array | None = None, t_s: float | None = None
) -> Effect:
    """A rigid body that the last link carries from `t_s` on.

    It is taken over in motion: the joint velocities do not jump and the body arrives with the
    velocity of the link, so that from then on only more force is needed to move it.

    Args:
        m: mass, kg.
        com: (3,) centre of mass in the frame of the last link, m.
        inertia: (3, 3) about it, axes of the last link, kg m²; a point's where None.
        t_s: when, s of plant time; always where None.
    """
    cx, cy, cz = (float(x) for x in com)
    numbers: dict[str, Number] = {"m": float(m), "cx": cx, "cy": cy, "cz": cz}
    if inertia is not None:
        numbers["inertia"] = np.asarray(inertia, float)[np.triu_indices(3)].tolist()
    return Effect("payload", (), numbers, None if t_s is None else (t_s, None))
