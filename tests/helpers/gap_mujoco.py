"""Hidden-effect trials in MuJoCo: another engine, another friction, another controller.

The arm is written as MJCF from the truth's numbers. Dry friction of any law is MuJoCo's own
friction constraint, its level renewed every step, so that joints truly stick. MuJoCo stores
velocity of the stamp and position half a step later; the torque is that of the middle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import pinocchio as pin

from drivers.files.mcap import Log
from sim.truth import Truth, body_of
from tests.helpers.gap_effects import (
    Array,
    encoder_error,
    link_side,
    rigid_stages,
    slope,
    torque_sensor,
)
from tests.helpers.gap_tools import recorded
from tests.helpers.robot_models import text_of
from tests.hidden import Trial

H_S, SUBSTEPS = 0.5e-3, 2
STIFF, DAMP = 900.0, 60.0  # 1/s2 and 1/s, feedback of the controller
SLOW = 6.0  # 1/s, share of its integral
DRY = {
    "coulomb_friction",
    "asymmetric_friction",
    "stribeck_friction",
    "load_dependent_friction",
    "friction_drift",
    "x_position_friction",
}
PUSHES = {"viscous_friction", "torque_ripple", "joint_spring"}
Push = Callable[[Array, Array, Array], Array]  # q, dq and rigid torque (n,) to torques (n,)


def mjcf(truth: Truth, armature: Array) -> str:
    """The arm as MuJoCo XML, frames and bodies as in the truth."""
    head = (
        f'<mujoco><compiler angle="radian" autolimits="false"/><option timestep="{H_S}"'
        f' integrator="implicitfast" gravity="{text_of(truth.gravity)}">'
        '<flag contact="disable"/></option><worldbody>'
    )
    for j, name in enumerate(truth.link_names):
        m, c, inertia = body_of(truth.theta[j])
        quat = pin.Quaternion(truth.R[j]).coeffs()[[3, 0, 1, 2]]
        order = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        head += (
            f'<body name="{name}" pos="{text_of(truth.p[j])}" quat="{text_of(quat)}">'
            f'<inertial pos="{text_of(c)}" mass="{float(m)!r}" fullinertia="{text_of(order)}"/>'
            f'<joint name="{truth.joint_names[j]}" type="hinge" axis="0 0 1"'
            f' armature="{float(armature[j])!r}" frictionloss="1e-9" solreffriction="0.001 1"/>'
        )
    return head + "</body>" * truth.n + "</worldbody></mujoco>"


class Arm:
    """The simulated arm: its stages, its dry friction and whatever else pushes its joints."""

    def __init__(self, trial: Trial, more: Push | None = None) -> None:
        self._effects, self._more = trial.effects, more
        self._stages = [
            (start, mujoco.MjModel.from_xml_string(mjcf(arm, trial.motor_inertia)))
            for start, arm in rigid_stages(trial.arm, trial.effects)
        ]
        self._model = self._stages.pop(0)[1]
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = trial.motion.middle
        mujoco.mj_forward(self._model, self._data)
        self._bristles: dict[int, float] = {}
        self._rigid = np.zeros(trial.arm.n)
        self._friction = trial.friction
        if trial.friction is not None:
            self._bent = trial.friction.start * trial.friction.coulomb

    def state(self) -> tuple[Array, Array]:
        """q, dq (n,) at the stamp."""
        return self._data.qpos - H_S / 2 * self._data.qvel, self._data.qvel.copy()

    def step(self, t: float, tau: Array) -> None:
        """One step of H_S at the middle of which it is t (s) under torques tau (n,)."""
        if self._stages and t >= self._stages[0][0]:
            _, model = self._stages.pop(0)
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = self._data.qpos, self._data.qvel
            data.qacc_warmstart[:] = self._data.qacc_warmstart
            self._model, self._data = model, data
            mujoco.mj_forward(model, data)
        data, model = self._data, self._model
        data.qfrc_applied[:] = tau - self._pushes(t)
        # What touches the origin of the last link
        body, data = self._model.nbody - 1, self._data
        data.xfrc_applied[body] = 0.0
        for effect in (e for e in self._effects if e.name == "external_wrench" and e.acts(t)):
            f, m = np.split(
                np.array([effect.number(key) for key in ("fx", "fy", "fz", "mx", "my", "mz")]), 2
            )
            lever = data.xpos[body] - data.xipos[body]
            data.xfrc_applied[body] += [*f, *(m + np.cross(lever, f))]
        mujoco.mj_step(model, data)

    def _pushes(self, t: float) -> Array:
        """Torques (n,) that smooth effects take; sets the levels of the dry ones."""
        q, v, n = self._data.qpos, self._data.qvel, len(self._rigid)
        out, level = np.zeros(n), np.full(n, 1e-9)
        if self._friction is not None:
            self._bent = self._friction.after(self._bent, v, H_S)
            out += self._bent + self._friction.viscous * v
        if self._more or any(e.name == "load_dependent_friction" for e in self._effects):
            mujoco.mj_rne(self._model, self._data, 1, self._rigid)
        for effect in (e for e in self._effects if e.acts(t)):
            if effect.name == "x_cross_viscous":
                source, j = effect.columns(n)
                out[j] += effect.number("c") * v[source]
            elif effect.name == "bristle_friction":
                # Dahl's bristles, one explicit step
                j = effect.joints[0] - 1
                z, v = self._bristles.get(j, 0.0), float(self._data.qvel[j])
                self._bristles[j] = z = z + H_S * (v - abs(v) * z) / effect.number("s0")
                out[j] += effect.number("Fc") * z
            elif effect.name in DRY or effect.name in PUSHES or effect.name.startswith("x_"):
                target = level if effect.name in DRY else out
                for j in effect.columns(n):
                    rows = (np.array([x]) for x in (t, q[j], v[j] or 1e-12, 0.0, self._rigid[j]))
                    torque = float(link_side(effect, *rows)[0])
                    target[j] += abs(torque) if effect.name in DRY else torque
        self._model.dof_frictionloss[:] = level
        return out if self._more is None else out + self._more(q, v, self._rigid)


class Controller:
    """Computed torque of the nominal arm by MuJoCo's inverse dynamics."""

    def __init__(self, trial: Trial) -> None:
        n = trial.nominal.n
        self._model = mujoco.MjModel.from_xml_string(mjcf(trial.nominal, trial.motor_inertia))
        self._model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        self._data = mujoco.MjData(self._model)
        self._sum, self._effort = np.zeros(n), trial.nominal.limits.effort

    def torque(self, q: Array, dq: Array, wanted: Sequence[Array]) -> Array:
        """Torque (n,) for the wanted q, dq, ddq."""
        data, behind = self._data, wanted[0] - q
        self._sum += 1e-3 * SLOW * behind
        data.qpos[:], data.qvel[:] = q, dq
        data.qacc[:] = wanted[2] + STIFF * (behind + self._sum) + DAMP * (wanted[1] - dq)
        mujoco.mj_inverse(self._model, data)
        return np.clip(data.qfrc_inverse, -self._effort, self._effort)


def simulate(trial: Trial, more: Push | None = None) -> tuple[Array, Array, Array, Array]:
    """Noise-free readings q, dq, tau and commands (m, n); `more` takes torques of its own."""
    t, disturbance = trial.times, trial.disturbance()
    wanted = trial.motion.at(np.append(t, t[-1] + 1e-3))
    arm, controller = Arm(trial, more), Controller(trial)
    q, dq, drive, command = (np.empty_like(disturbance) for _ in range(4))
    before = after = controller.torque(*arm.state(), [x[0] for x in wanted]) - disturbance[0]
    for k in range(len(t)):
        q[k], dq[k] = arm.state()
        drive[k] = after
        command[k] = controller.torque(q[k], dq[k], [x[k + 1] for x in wanted])
        before, after = after, command[k] - disturbance[min(k + 1, len(t) - 1)]
        for i in range(SUBSTEPS):
            part = (i + 0.5) / SUBSTEPS
            arm.step(t[k] + part * 1e-3, before + part * (after - before))
    error = encoder_error(trial.effects, t, q, dq, drive)
    tau = torque_sensor(trial.effects, t, drive) + disturbance
    return q + error, dq + slope(t, error), tau, command


def mujoco_recording(trial: Trial) -> Log:
    """The recording of a trial."""
    q, dq, tau, commands = simulate(trial)
    return recorded(trial, q, dq, tau, commands if trial.commands else None)
