"""Effects of the catalogue by formulas of the tests' own, on Pinocchio's rigid-body torque.

`sense` goes from the arm's motion to what its sensors read; `predict` from what they read to the
torque they should read. All signals are (m, n) tables at the times t (m,) s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from sim.effects import Effect
from sim.truth import Truth
from tests.helpers.arm_data import PIN_ORDER, pin_model
from tests.helpers.arm_data import rnea as rnea_of_model

Array = np.ndarray
CROSSING_S = 0.02  # in which the motor crosses the play of a gear on reversal
PAD = 2000  # samples before and after a recording, for its spectrum
PUSH_SPEED = 0.01  # rad/s, below it the motor doesn't push in full


def rnea(truth: Truth, *motion: Array) -> Array:
    """Rigid-body torques (m, n)."""
    return rnea_of_model(pin_model(truth), *motion)


def regressor(truth: Truth, q: Array, dq: Array, ddq: Array) -> Array:
    """Y (m, n, 10 n), columns in the order of θ."""
    model = pin_model(truth)
    data = model.createData()
    rows = zip(q, dq, ddq, strict=True)
    Y = np.array([pin.computeJointTorqueRegressor(model, data, *row).copy() for row in rows])
    columns = np.concatenate([10 * j + np.array(PIN_ORDER) for j in range(truth.n)])
    return Y[:, :, columns]


def _theta_change(effect: Effect, truth: Truth) -> Array:
    p: dict[str, Any] = dict(effect.parameters)
    change = np.zeros_like(truth.theta)
    if effect.name == "link_inertia":
        change[effect.joints[0] - 1] = p["dtheta"]
        return change
    m, c = p["m"], np.array([p["cx"], p["cy"], p["cz"]])
    about_origin = m * (c @ c * np.eye(3) - np.outer(c, c))
    own = np.asarray(p.get("inertia", np.zeros(6)), float)
    change[-1] = [m, *(m * c), *(about_origin[np.triu_indices(3)] + own)]
    return change


def rigid_stages(truth: Truth, effects: Sequence[Effect]) -> list[tuple[float, Truth]]:
    """(from s, arm) in order of time, the effects that change bodies or gravity worked in."""
    changes = [e for e in effects if e.name in ("payload", "link_inertia", "base_tilt")]
    times = {time for e in changes for time in (e.start_s, e.end_s) if np.isfinite(time)}
    stages = []
    for start in (-np.inf, *sorted(times)):
        arm = truth
        for effect in (e for e in changes if e.start_s <= start < e.end_s):
            if effect.name == "base_tilt":
                R = pin.exp3(np.array([effect.number("rx"), effect.number("ry"), 0.0]))
                arm = arm.with_changes(gravity=R.T @ arm.gravity)
            else:
                arm = arm.with_changes(theta=arm.theta + _theta_change(effect, arm))
        stages.append((start, arm))
    return stages


def rigid(truth: Truth, effects: Sequence[Effect], t: Array, *motion: Array) -> Array:
    """Rigid-body torque (m, n) with the effects that change the body or gravity."""
    stages = rigid_stages(truth, effects)
    which = np.searchsorted([start for start, _ in stages], t + 1e-9, side="right") - 1
    tau = np.zeros_like(motion[0])
    for i, (_, arm) in enumerate(stages):
        rows = which == i
        if rows.any():
            tau[rows] = rnea(arm, *(x[rows] for x in motion))
    return tau


def _wrench_torque(truth: Truth, effect: Effect, q: Array, on: Array) -> Array:
    p = effect.parameters
    wrench = np.array([p.get(k, 0.0) for k in ("fx", "fy", "fz", "mx", "my", "mz")])
    model = pin_model(truth)
    data = model.createData()
    tau = np.zeros_like(q)
    for i in np.flatnonzero(on):
        J = pin.computeJointJacobians(model, data, q[i])
        J = pin.getJointJacobian(model, data, truth.n, pin.LOCAL_WORLD_ALIGNED)
        tau[i] = -J.T @ wrench
    return tau


def link_side(effect: Effect, t: Array, q: Array, dq: Array, ddq: Array, tau: Array) -> Array:
    """Torque (m,) of an effect on one joint, from that joint's motion and rigid torque."""
    p: dict[str, Any] = dict(effect.parameters)
    sign = np.sign(np.round(dq, 6))  # no rounding error of a joint at rest throws it about
    match effect.name:
        case "viscous_friction":
            return p["Fv"] * dq
        case "coulomb_friction":
            return p["Fc"] * sign
        case "asymmetric_friction":
            return np.where(dq > 0, p["Fc_pos"], p["Fc_neg"]) * sign
        case "stribeck_friction":
            return (p["Fc"] + (p["Fs"] - p["Fc"]) * np.exp(-((dq / p["vs"]) ** 2))) * sign
        case "bristle_friction":
            return p["Fc"] * _dahl(q, dq, p["s0"])
        case "load_dependent_friction":
            return p["Fl"] * np.abs(tau) * sign
        case "friction_drift":
            start = 0.0 if effect.interval_s is None else effect.interval_s[0]
            return p["dFc"] * (t - start) * sign
        case "motor_inertia":
            return p["B"] * ddq
        case "torque_ripple":
            return p["a"] * np.sin(p["n"] * q + p["phase"])
        case "joint_spring":
            return p["k"] * (q - p["q0"])
        case "x_quadratic_drag":
            return p["c"] * dq * np.abs(dq)
        case "x_cubic_spring":
            return p["c"] * (q - p["q0"]) ** 3
        case "x_position_friction":
            return p["A"] * (1 + np.sin(q + p["phase"])) * sign
        case "x_sine_disturbance":
            return p["a"] * np.sin(2 * np.pi * p["f"] * t + p["phase"])
        case "x_velocity_ripple":
            return p["a"] * np.sin(p["n"] * q + p["phase"]) * dq
    return np.zeros_like(q)


def joint_torque(
    truth: Truth, effects: Sequence[Effect], t: Array, q: Array, dq: Array, ddq: Array
) -> Array:
    """Torque (m, n) on the joints of the arm in motion, before any sensor."""
    body = rigid(truth, effects, t, q, dq, ddq)
    tau = body.copy()
    for effect in effects:
        on = effect.acts(t)
        if effect.name == "external_wrench":
            tau += _wrench_torque(truth, effect, q, on)
        if effect.name == "x_cross_viscous":
            tau[:, effect.joints[1] - 1] += effect.number("c") * dq[:, effect.joints[0] - 1]
        for j in effect.columns(truth.n):
            tau[:, j] += on * link_side(effect, t, q[:, j], dq[:, j], ddq[:, j], body[:, j])
    return tau


def _dahl(q: Array, dq: Array, s0: float) -> Array:
    """How far bristles are bent (m,): s0 dz/dq = 1 - z sign(dq), solved exactly between samples."""
    z, out = 0.0, np.zeros_like(q)
    path = np.abs(np.diff(q, prepend=q[0]))
    for i, (goal, fade) in enumerate(zip(np.sign(dq), np.exp(-path / s0), strict=True)):
        z = goal + (z - goal) * fade
        out[i] = z
    return out


def _odd_sensor(effects: Sequence[Effect], tau: Array) -> Array:
    """Torque sensors (m, n) that no catalogue knows."""
    read = tau.copy()
    for effect in effects:
        p: dict[str, Any] = dict(effect.parameters)
        j = effect.joints[-1] - 1 if effect.joints else 0
        match effect.name:
            case "x_torque_crosstalk":
                read[:, j] += p["share"] * tau[:, effect.joints[0] - 1]
            case "x_torque_deadband":
                read[:, j] -= np.clip(tau[:, j], -p["w"], p["w"])
            case "x_torque_saturation":
                read[:, j] = p["s"] * np.tanh(tau[:, j] / p["s"])
    return read


def _low_passed(t: Array, x: Array, d: float, c: float) -> Array:
    """x (m,) behind 1 / (1 + d s + (d^2 - c) s^2), by its spectrum; constant before the start."""
    padded = np.pad(x, PAD, mode="linear_ramp", end_values=x[0])
    s = 2j * np.pi * np.fft.rfftfreq(len(padded), t[1] - t[0])
    spectrum = np.fft.rfft(padded) / (1 + d * s + (d * d - c) * s**2)
    return np.fft.irfft(spectrum, len(padded))[PAD:-PAD]


def torque_sensor(effects: Sequence[Effect], t: Array, tau: Array) -> Array:
    """What the torque sensors read (m, n): low-passed and late, then scaled, then shifted."""
    read = _odd_sensor(effects, tau)
    for effect in (e for e in effects if e.name == "torque_filter"):
        d, c = effect.number("d"), effect.number("c")
        for j in effect.columns(tau.shape[1]):
            read[:, j] = np.where(effect.acts(t), _low_passed(t, read[:, j], d, c), read[:, j])
    for name in ("signal_delay", "torque_gain", "torque_offset"):
        for effect in (e for e in effects if e.name == name):
            p: dict[str, Any] = dict(effect.parameters)
            on = effect.acts(t)
            for j in effect.columns(tau.shape[1]):
                late = np.interp(t - p.get("d", 0.0), t, read[:, j])
                changed = (1 + p.get("g", 0.0)) * late + p.get("o", 0.0)
                read[:, j] = np.where(on, changed, read[:, j])
    return read


def _side(t: Array, dq: Array) -> Array:
    """Which flank of the gear the motor pushes (m,), -1 to 1: ahead of the link, forwards."""
    speed = np.clip(dq / PUSH_SPEED, -1, 1) * 2 / CROSSING_S * np.median(np.diff(t))
    side, out = float(np.sign(dq[np.argmax(np.abs(dq) > PUSH_SPEED)])), np.empty_like(dq)
    for i, change in enumerate(speed.tolist()):
        out[i] = side = min(max(side + change, -1.0), 1.0)
    return out


def _encoder_error(effect: Effect, t: Array, q: Array, dq: Array, tau: Array) -> Array:
    """What an encoder reads beside the link's angle q (m,), rad."""
    p: dict[str, Any] = dict(effect.parameters)
    match effect.name:
        case "encoder_offset":
            return np.full_like(q, p["o"])
        case "encoder_ripple":
            return p["a"] * np.sin(q + p["phase"])
        case "joint_elasticity":
            return tau / p["k"]
        case "backlash":
            return p["b"] / 2 * _side(t, dq)
    return np.zeros_like(q)


def encoder_error(effects: Sequence[Effect], t: Array, q: Array, dq: Array, tau: Array) -> Array:
    """Sum over the effects (m, n), rad; tau is the torque through the joints."""
    error = np.zeros_like(q)
    for effect in effects:
        on = effect.acts(t)
        for j in effect.columns(q.shape[1]):
            error[:, j] += on * _encoder_error(effect, t, q[:, j], dq[:, j], tau[:, j])
    return error


def slope(t: Array, x: Array) -> Array:
    """Derivative (m, n) by central differences."""
    return np.gradient(x, t, axis=0)


def sense(
    truth: Truth,
    effects: Sequence[Effect],
    t: Array,
    q: Array,
    dq: Array,
    ddq: Array,
    rubs: Array | float = 0.0,
) -> tuple[Array, Array, Array]:
    """What noise-free sensors read of the arm's motion: q, dq, tau (m, n); `rubs` N m on top."""
    tau = joint_torque(truth, effects, t, q, dq, ddq) + rubs
    error = encoder_error(effects, t, q, dq, tau)
    return q + error, dq + slope(t, error), torque_sensor(effects, t, tau)


def predict(
    truth: Truth,
    effects: Sequence[Effect],
    t: Array,
    q: Array,
    dq: Array,
    ddq: Array,
    tau: Array | None = None,
) -> Array:
    """Torque (m, n) that should be read where this motion was read.

    Args:
        tau: torque read, which the flexing of elastic joints is taken from; the rigid body's
            where None.
    """
    if tau is None:
        tau = joint_torque(truth, effects, t, q, dq, ddq)
    error = encoder_error(effects, t, q, dq, tau)
    error = encoder_error(effects, t, q - error, dq, tau)  # at the link's angle, second pass
    if np.any(error):
        q, dq, ddq = q - error, dq - slope(t, error), ddq - slope(t, slope(t, error))
    return torque_sensor(effects, t, joint_torque(truth, effects, t, q, dq, ddq))


def effect_from(entry: Effect | Mapping[str, Any]) -> Effect:
    """The effect of a canonical entry: effect, joints, interval_s, parameters.

    No other key counts.

    Raises:
        ValueError: unknown name, a key that is missing, unknown or not a number.
    """
    if isinstance(entry, Effect):
        return entry
    if "effect" not in entry or "parameters" not in entry:
        raise ValueError(f"an effect entry has {sorted(entry)}; needs: effect, parameters")
    span = entry.get("interval_s")
    interval = None if span is None else (float(span[0] or 0.0), span[1])
    joints = tuple(entry.get("joints") or ())
    return Effect(entry["effect"], joints, entry["parameters"], interval)
