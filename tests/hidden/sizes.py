"""Which effects a hidden-effect trial plants, where, how large, and from when on.

Torques on joints 5 to 7 are four tenths of the ranges. Sizes are log-uniform over three times the
range (the ratio of its ends): a learner that believes in the ranges is wrong about some.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.effects import PAIRS, Effect
from sim.truth import FLANGE_M, Array, Truth, direction

SECONDS = 20.0
WIDER = np.sqrt(3.0)  # either end of a range of sizes is further out by this
WRIST = 5  # joints from here on (counted from 1) get WRIST_SHARE of a torque
WRIST_SHARE = 0.4
CONTACT_S = (1.0, 3.0)  # how long a contact lasts

LATE_SHARE = {"payload": 0.5, "torque_offset": 0.25, "coulomb_friction": 0.25}
COULOMB = (0.3, 2.0)  # N m
VISCOUS = (0.1, 1.0)  # N m s/rad
STRIBECK_RATIO, STRIBECK_SPEED = (1.3, 3.0), (0.05, 0.2)  # Fs/Fc; rad/s
RIPPLE = (0.1, 0.5)  # N m
ENCODER_OFFSET, ENCODER_RIPPLE = (5e-3, 20e-3), (2e-3, 10e-3)  # rad
LOW_PASS, LOW_PASS_POLES = (0.015, 0.03), (0.75, 1.0)  # d, s; c / d^2: two equal poles to one
BEYOND_M, ASIDE_M = (0.02, 0.1), 0.05  # its centre from the flange, along and across

Numbers = dict[str, float | list[float]]
Draw = Callable[[np.random.Generator, int, Truth], float]  # of a joint (from 1) of an arm
Maker = Callable[[np.random.Generator, int, Truth], Numbers]
ALL = (1, 2, 3, 4, 5, 6, 7)


def log_uniform(rng: np.random.Generator, span: tuple[float, float]) -> float:
    """A size from a span, all orders of magnitude alike."""
    return float(np.exp(rng.uniform(np.log(span[0]), np.log(span[1]))))


def wide(rng: np.random.Generator, span: tuple[float, float]) -> float:
    """A size from three times a span, all orders of magnitude alike."""
    return log_uniform(rng, (span[0] / WIDER, span[1] * WIDER))


def _sign(rng: np.random.Generator) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


def torque_size(rng: np.random.Generator, joint: int, span: tuple[float, float]) -> float:
    """A size of a torque on `joint` (from 1), four tenths on joints 5 to 7; see `wide`."""
    return wide(rng, span) * (WRIST_SHARE if joint >= WRIST else 1.0)


def wrist_shares(n: int) -> Array:
    """(n,) of a torque on each joint: one, WRIST_SHARE from joint WRIST (from 1) on."""
    return np.where(np.arange(1, n + 1) >= WRIST, WRIST_SHARE, 1.0)


def _of(**draws: Draw) -> Maker:
    """Numbers by key, drawn one after the other in the order in which they stand."""

    def make(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
        return {key: draw(rng, joint, arm) for key, draw in draws.items()}

    return make


def _torque(span: tuple[float, float], signed: bool = False) -> Draw:
    return lambda rng, joint, arm: torque_size(rng, joint, span) * (_sign(rng) if signed else 1.0)


def _plain(span: tuple[float, float], signed: bool = False) -> Draw:
    return lambda rng, joint, arm: wide(rng, span) * (_sign(rng) if signed else 1.0)


def _exact(span: tuple[float, float]) -> Draw:
    return lambda rng, joint, arm: log_uniform(rng, span)


def _phase(rng: np.random.Generator, joint: int, arm: Truth) -> float:
    return float(rng.uniform(-np.pi, np.pi))


def _order(rng: np.random.Generator, joint: int, arm: Truth) -> float:
    return float(rng.choice((1, 2, 3, 4, 6, 8, 10, 12)))  # per turn


def _rest(reach: float) -> Draw:
    """A position so far from the ready one at most."""
    return lambda rng, joint, arm: float(arm.ready[joint - 1] + rng.uniform(-reach, reach))


def _asymmetric(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    large, ratio = torque_size(rng, joint, COULOMB), log_uniform(rng, (1.3, 3.0))
    pair = (large, large / ratio) if rng.random() < 0.5 else (large / ratio, large)
    return {"Fc_pos": pair[0], "Fc_neg": pair[1]}


def _stribeck(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    Fc = torque_size(rng, joint, COULOMB)
    Fs = Fc * log_uniform(rng, STRIBECK_RATIO)
    return {"Fc": Fc, "Fs": Fs, "vs": log_uniform(rng, STRIBECK_SPEED)}


def box_moments(m: float, half: Array) -> Array:
    """(3,) kg m² of a box of mass m about its centre, from its half sides (3,) m."""
    return np.asarray(m / 3 * (half @ half - half**2))


def _payload(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    m = wide(rng, (0.3, 3.0))  # kg
    # a box of these half sides, m
    xx, yy, zz = box_moments(m, rng.uniform(0.02, 0.06, 3)).tolist()
    x, y = rng.uniform(-ASIDE_M, ASIDE_M, 2).tolist()
    z = FLANGE_M + float(rng.uniform(*BEYOND_M))
    return {"m": m, "cx": x, "cy": y, "cz": z, "inertia": [xx, 0.0, 0.0, yy, 0.0, zz]}


def _link_inertia(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    """A link that weighs more or less by a share, all ten numbers in proportion, or whose centre
    is elsewhere (a body of the same inertia about its centre, moved)."""
    theta = arm.theta[joint - 1]
    share = wide(rng, (0.15, 0.4)) * _sign(rng)  # of a link's mass, or of its centre's distance
    if rng.random() < 0.5:
        return {"dtheta": (share * theta).tolist()}
    m, c = theta[0], theta[1:4] / theta[0]
    moved = c + abs(share) * np.linalg.norm(c) * direction(rng)
    shift = m * (moved @ moved * np.eye(3) - np.outer(moved, moved))
    shift -= m * (c @ c * np.eye(3) - np.outer(c, c))
    return {"dtheta": [0.0, *(m * (moved - c)).tolist(), *shift[np.triu_indices(3)].tolist()]}


def _tilt(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    size, way = wide(rng, (np.radians(0.5), np.radians(3.0))), rng.uniform(0, 2 * np.pi)
    return {"rx": float(size * np.cos(way)), "ry": float(size * np.sin(way))}


def _contact(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    x, y, z = (wide(rng, (5.0, 30.0)) * direction(rng)).tolist()  # N
    return {"fx": x, "fy": y, "fz": z, "mx": 0.0, "my": 0.0, "mz": 0.0}


def _low_pass(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    d = wide(rng, LOW_PASS)
    return {"d": d, "c": d * d * float(rng.uniform(*LOW_PASS_POLES))}


def _saturation(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    # a share of the joint's effort limit
    return {"s": log_uniform(rng, (0.6, 1.2)) * float(arm.limits.effort[joint - 1])}


# Name -> (joints it may sit on, how its numbers are drawn); no joints: acts on the whole arm.
CATALOGUE: dict[str, tuple[tuple[int, ...], Maker]] = {
    "viscous_friction": (ALL, _of(Fv=_torque(VISCOUS))),
    "coulomb_friction": (ALL, _of(Fc=_torque(COULOMB))),
    "asymmetric_friction": (ALL, _asymmetric),
    "stribeck_friction": (ALL, _stribeck),
    "load_dependent_friction": (ALL, _of(Fl=_plain((0.02, 0.1)))),
    "motor_inertia": (ALL, _of(B=_torque((0.05, 0.3)))),  # kg m2
    "joint_elasticity": (ALL, _of(k=_plain((3000.0, 20000.0)))),  # N m/rad
    "backlash": (ALL, _of(b=_plain((2e-3, 10e-3)))),  # rad
    "torque_ripple": (ALL, _of(n=_order, phase=_phase, a=_torque(RIPPLE))),
    "joint_spring": (ALL, _of(q0=_rest(0.5), k=_torque((0.2, 2.0)))),  # N m/rad
    "torque_offset": (ALL, _of(o=_torque((0.2, 1.0), signed=True))),  # N m
    "torque_gain": (ALL, _of(g=_plain((0.03, 0.1), signed=True))),
    "encoder_offset": (ALL, _of(o=_plain(ENCODER_OFFSET, signed=True))),
    "encoder_ripple": (ALL, _of(phase=_phase, a=_plain(ENCODER_RIPPLE))),
    "signal_delay": (ALL, _of(d=_plain((1e-3, 5e-3)))),  # s
    "payload": ((), _payload),
    "link_inertia": ((2, 3, 4, 5, 6, 7), _link_inertia),
    "base_tilt": ((), _tilt),
    "external_wrench": ((), _contact),
    "friction_drift": (ALL, _of(dFc=_torque((0.02, 0.1)))),  # N m/s
    "bristle_friction": (ALL, _of(Fc=_torque(COULOMB), s0=_plain((5e-4, 1e-2)))),  # N m, rad
    "torque_filter": (ALL, _low_pass),
}

# Effects that are in no list, by the names under which `sim.effects` simulates them.
OUTSIDE: dict[str, tuple[tuple[int, ...], Maker]] = {
    "x_quadratic_drag": (ALL, _of(c=_torque((0.3, 1.5)))),  # N m s2/rad2
    "x_cubic_spring": (ALL, _of(q0=_rest(0.3), c=_torque((0.5, 3.0)))),  # N m/rad3
    "x_position_friction": (ALL, _of(A=_torque(COULOMB), phase=_phase)),
    "x_sine_disturbance": (ALL, _of(phase=_phase, a=_torque(RIPPLE), f=_exact((0.7, 4.0)))),  # Hz
    "x_velocity_ripple": (ALL, _of(phase=_phase, n=_order, a=_torque(VISCOUS))),
    "x_cross_viscous": (ALL, _of(c=_torque(VISCOUS))),
    "x_torque_crosstalk": (ALL, _of(share=_plain((0.03, 0.1), signed=True))),
    "x_torque_deadband": (ALL, _of(w=_torque((0.15, 0.6)))),  # N m
    "x_torque_saturation": ((2, 4), _saturation),
}


def draw_effect(rng: np.random.Generator, name: str, arm: Truth) -> Effect:
    """One effect by name, with joint, size, sign and interval drawn."""
    joints, make = {**CATALOGUE, **OUTSIDE}[name]
    joint = int(rng.choice(joints)) if joints else arm.n
    numbers = make(rng, joint, arm)
    on: tuple[int, ...] = (joint,) if joints else ()
    if name in PAIRS:
        on = (int(rng.choice([j for j in joints if j != joint])), joint)
    if name == "signal_delay" and rng.random() < 0.5:
        on = ()
    return Effect(name, on, numbers, _interval(rng, name))


def _interval(rng: np.random.Generator, name: str) -> tuple[float, float | None] | None:
    start, length = float(rng.uniform(5.0, 15.0)), float(rng.uniform(*CONTACT_S))
    late = rng.random() < LATE_SHARE.get(name, 0.0)
    if name == "external_wrench":
        return start, start + length
    return (start, None) if late else None


# --- friction with a memory ----------------------------------------------------------------------

RUB_COULOMB, RUB_VISCOUS = (0.2, 1.0), (0.05, 0.5)  # N m, N m s/rad
RUB_STICTION, RUB_SPEED = (1.0, 1.6), (0.02, 0.1)  # of Coulomb's; rad/s


@dataclass(frozen=True, eq=False)
class Bristles:
    """Friction with a memory in every joint; of another shape than any learner's.

    LuGre's (Canudas de Wit et al. 1995), without damping of the bristles.

    Attributes:
        coulomb, stiction, speed, viscous, deflection: (n,) N m, N m, rad/s, N m s/rad, rad.
        start: (n,) deflection at the first sample, of the largest.
    """

    coulomb: Array
    stiction: Array
    speed: Array
    viscous: Array
    deflection: Array
    start: Array

    def along(self, dq: Array, step_s: float) -> Array:
        """Torque (m, n) N m along joint velocities (m, n)."""
        out, z = np.empty_like(dq), self.start * self.coulomb
        for k, v in enumerate(dq):
            z = self.after(z, v, step_s)
            out[k] = z + self.viscous * v
        return out

    def after(self, z: Array, v: Array, step_s: float) -> Array:
        """Torque (n,) of the bristles a step at velocity v (n,) later: exact for a constant v."""
        level = self.coulomb + (self.stiction - self.coulomb) * np.exp(-np.square(v / self.speed))
        rate = np.abs(v) * self.coulomb / (self.deflection * level)
        end = np.sign(v) * level
        return np.asarray(end + (z - end) * np.exp(-rate * step_s))


def draw_bristles(rng: np.random.Generator, n: int) -> Bristles:
    """Of n joints, their torques by `wrist_shares`."""
    share = wrist_shares(n)
    coulomb = share * sizes(rng, RUB_COULOMB, n)
    return Bristles(
        coulomb,
        coulomb * rng.uniform(*RUB_STICTION, n),
        rng.uniform(*RUB_SPEED, n),
        share * sizes(rng, RUB_VISCOUS, n),
        sizes(rng, (0.3e-3, 4e-3), n),  # rad over which a joint winds up
        rng.uniform(-1, 1, n),
    )


def sizes(rng: np.random.Generator, span: tuple[float, float], n: int) -> Array:
    """(n,) sizes from a span, all orders of magnitude alike."""
    return np.array([log_uniform(rng, span) for _ in range(n)])
