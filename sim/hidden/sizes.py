"""Which effects a hidden-effect trial plants, where, how large, and from when on.

Torques on joints 5 to 7 are four tenths of the ranges. Sizes are log-uniform over three times the
range (the ratio of its ends): a learner that believes in the ranges is wrong about some.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim.effects import PAIRS, Effect
from sim.truth import Array, Truth

SECONDS = 20.0
WIDER = np.sqrt(3.0)  # either end of a range of sizes is further out by this
WRIST = 5  # joints from here on (counted from 1) get WRIST_SHARE of a torque
WRIST_SHARE = 0.4
START_S = (5.0, 15.0)  # of effects that begin mid-recording
CONTACT_S = (1.0, 3.0)  # how long a contact lasts
LATE_SHARE = {"payload": 0.5, "torque_offset": 0.25, "coulomb_friction": 0.25}
WHOLE_ARM_DELAY_SHARE = 0.5

COULOMB = (0.3, 2.0)  # N m
VISCOUS = (0.1, 1.0)  # N m s/rad
ASYMMETRY = (1.3, 3.0)  # larger over smaller Fc
STRIBECK_RATIO, STRIBECK_SPEED = (1.3, 3.0), (0.05, 0.2)  # Fs/Fc; rad/s
LOAD_SHARE = (0.02, 0.1)
ARMATURE = (0.05, 0.3)  # kg m2
STIFFNESS = (3000.0, 20000.0)  # N m/rad
PLAY = (2e-3, 10e-3)  # rad
RIPPLE = (0.1, 0.5)  # N m
RIPPLE_ORDERS = (1, 2, 3, 4, 6, 8, 10, 12)  # per turn
SPRING = (0.2, 2.0)  # N m/rad
OFFSET = (0.2, 1.0)  # N m
GAIN = (0.03, 0.1)
ENCODER_OFFSET, ENCODER_RIPPLE = (5e-3, 20e-3), (2e-3, 10e-3)  # rad
DELAY = (1e-3, 5e-3)  # s
BRISTLE = (5e-4, 1e-2)  # rad over which friction winds up
LOW_PASS, LOW_PASS_POLES = (0.015, 0.03), (0.75, 1.0)  # d, s; c / d^2: two equal poles to one
MASS = (0.3, 3.0)  # kg
FLANGE_M = 0.107  # m, from the frame of link 7 along z (franka_ros)
BODY_M = (0.02, 0.06)  # half side of the box that a payload is
BEYOND_M, ASIDE_M = (0.02, 0.1), 0.05  # its centre from the flange, along and across
TILT = (np.radians(0.5), np.radians(3.0))
CONTACT_N = (5.0, 30.0)
DRIFT = (0.02, 0.1)  # N m/s
LINK_ERROR = (0.15, 0.4)  # of a link's mass, or of its centre's distance
DRAG = (0.3, 1.5)  # N m s2/rad2, torque with the square of the speed
CUBIC = (0.5, 3.0)  # N m/rad3
SINE_HZ = (0.7, 4.0)
CROSSTALK = (0.03, 0.1)  # of another joint's torque
DEADBAND = (0.15, 0.6)  # N m
SATURATION = (0.6, 1.2)  # of the joint's effort limit

Numbers = dict[str, float | list[float]]
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


def _torque(key: str, span: tuple[float, float], signed: bool = False) -> Maker:
    def make(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
        return {key: torque_size(rng, joint, span) * (_sign(rng) if signed else 1.0)}

    return make


def _plain(key: str, span: tuple[float, float], signed: bool = False) -> Maker:
    def make(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
        return {key: wide(rng, span) * (_sign(rng) if signed else 1.0)}

    return make


def _asymmetric(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    large, ratio = torque_size(rng, joint, COULOMB), log_uniform(rng, ASYMMETRY)
    pair = (large, large / ratio) if rng.random() < 0.5 else (large / ratio, large)
    return {"Fc_pos": pair[0], "Fc_neg": pair[1]}


def _stribeck(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    Fc = torque_size(rng, joint, COULOMB)
    Fs = Fc * log_uniform(rng, STRIBECK_RATIO)
    return {"Fc": Fc, "Fs": Fs, "vs": log_uniform(rng, STRIBECK_SPEED)}


def _ripple(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    order = float(rng.choice(RIPPLE_ORDERS))
    phase = float(rng.uniform(-np.pi, np.pi))
    return {"a": torque_size(rng, joint, RIPPLE), "n": order, "phase": phase}


def _spring(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    rest = float(arm.ready[joint - 1] + rng.uniform(-0.5, 0.5))
    return {"k": torque_size(rng, joint, SPRING), "q0": rest}


def _encoder_ripple(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    phase = float(rng.uniform(-np.pi, np.pi))
    return {"a": wide(rng, ENCODER_RIPPLE), "phase": phase}


def _payload(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    m = wide(rng, MASS)
    half = rng.uniform(*BODY_M, 3)
    xx, yy, zz = (m / 3 * (half @ half - half**2)).tolist()  # a box's, from its half sides
    x, y = rng.uniform(-ASIDE_M, ASIDE_M, 2).tolist()
    z = FLANGE_M + float(rng.uniform(*BEYOND_M))
    return {"m": m, "cx": x, "cy": y, "cz": z, "inertia": [xx, 0.0, 0.0, yy, 0.0, zz]}


def _link_inertia(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    """A link that weighs more or less by a share, all ten numbers in proportion, or whose centre
    is elsewhere (a body of the same inertia about its centre, moved)."""
    theta = arm.theta[joint - 1]
    share = wide(rng, LINK_ERROR) * _sign(rng)
    if rng.random() < 0.5:
        return {"dtheta": (share * theta).tolist()}
    m, c = theta[0], theta[1:4] / theta[0]
    moved = c + abs(share) * np.linalg.norm(c) * direction(rng)
    shift = m * (moved @ moved * np.eye(3) - np.outer(moved, moved))
    shift -= m * (c @ c * np.eye(3) - np.outer(c, c))
    return {"dtheta": [0.0, *(m * (moved - c)).tolist(), *shift[np.triu_indices(3)].tolist()]}


def _tilt(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    size, way = wide(rng, TILT), rng.uniform(0, 2 * np.pi)
    return {"rx": float(size * np.cos(way)), "ry": float(size * np.sin(way))}


def _contact(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    x, y, z = (wide(rng, CONTACT_N) * direction(rng)).tolist()
    return {"fx": x, "fy": y, "fz": z, "mx": 0.0, "my": 0.0, "mz": 0.0}


def _quadratic_drag(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    return {"c": torque_size(rng, joint, DRAG)}


def _cubic_spring(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    rest = float(arm.ready[joint - 1] + rng.uniform(-0.3, 0.3))
    return {"c": torque_size(rng, joint, CUBIC), "q0": rest}


def _position_friction(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    return {"A": torque_size(rng, joint, COULOMB), "phase": float(rng.uniform(-np.pi, np.pi))}


def _sine_disturbance(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    phase = float(rng.uniform(-np.pi, np.pi))
    return {"a": torque_size(rng, joint, RIPPLE), "f": log_uniform(rng, SINE_HZ), "phase": phase}


def _velocity_ripple(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    phase = float(rng.uniform(-np.pi, np.pi))
    order = float(rng.choice(RIPPLE_ORDERS))
    return {"a": torque_size(rng, joint, VISCOUS), "n": order, "phase": phase}


def _bristle(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    return {"Fc": torque_size(rng, joint, COULOMB), "s0": wide(rng, BRISTLE)}


def _low_pass(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    d = wide(rng, LOW_PASS)
    return {"d": d, "c": d * d * float(rng.uniform(*LOW_PASS_POLES))}


def _saturation(rng: np.random.Generator, joint: int, arm: Truth) -> Numbers:
    return {"s": log_uniform(rng, SATURATION) * float(arm.limits.effort[joint - 1])}


# Name -> (joints it may sit on, how its numbers are drawn); no joints: acts on the whole arm.
CATALOGUE: dict[str, tuple[tuple[int, ...], Maker]] = {
    "viscous_friction": (ALL, _torque("Fv", VISCOUS)),
    "coulomb_friction": (ALL, _torque("Fc", COULOMB)),
    "asymmetric_friction": (ALL, _asymmetric),
    "stribeck_friction": (ALL, _stribeck),
    "load_dependent_friction": (ALL, _plain("Fl", LOAD_SHARE)),
    "motor_inertia": (ALL, _torque("B", ARMATURE)),
    "joint_elasticity": (ALL, _plain("k", STIFFNESS)),
    "backlash": (ALL, _plain("b", PLAY)),
    "torque_ripple": (ALL, _ripple),
    "joint_spring": (ALL, _spring),
    "torque_offset": (ALL, _torque("o", OFFSET, signed=True)),
    "torque_gain": (ALL, _plain("g", GAIN, signed=True)),
    "encoder_offset": (ALL, _plain("o", ENCODER_OFFSET, signed=True)),
    "encoder_ripple": (ALL, _encoder_ripple),
    "signal_delay": (ALL, _plain("d", DELAY)),
    "payload": ((), _payload),
    "link_inertia": ((2, 3, 4, 5, 6, 7), _link_inertia),
    "base_tilt": ((), _tilt),
    "external_wrench": ((), _contact),
    "friction_drift": (ALL, _torque("dFc", DRIFT)),
    "bristle_friction": (ALL, _bristle),
    "torque_filter": (ALL, _low_pass),
}

# Effects that are in no list, by the names under which `sim.effects` simulates them.
OUTSIDE: dict[str, tuple[tuple[int, ...], Maker]] = {
    "x_quadratic_drag": (ALL, _quadratic_drag),
    "x_cubic_spring": (ALL, _cubic_spring),
    "x_position_friction": (ALL, _position_friction),
    "x_sine_disturbance": (ALL, _sine_disturbance),
    "x_velocity_ripple": (ALL, _velocity_ripple),
    "x_cross_viscous": (ALL, _torque("c", VISCOUS)),
    "x_torque_crosstalk": (ALL, _plain("share", CROSSTALK, signed=True)),
    "x_torque_deadband": (ALL, _torque("w", DEADBAND)),
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
    if name == "signal_delay" and rng.random() < WHOLE_ARM_DELAY_SHARE:
        on = ()
    return Effect(name, on, numbers, _interval(rng, name))


def _interval(rng: np.random.Generator, name: str) -> tuple[float, float | None] | None:
    start, length = float(rng.uniform(*START_S)), float(rng.uniform(*CONTACT_S))
    late = rng.random() < LATE_SHARE.get(name, 0.0)
    if name == "external_wrench":
        return start, start + length
    return (start, None) if late else None


def direction(rng: np.random.Generator) -> Array:
    """A unit vector, all directions alike."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)
