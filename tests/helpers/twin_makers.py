"""Recordings of `tests.hidden.twins`: Pinocchio's torques along the motion, or MuJoCo's motion."""

from __future__ import annotations

import mujoco
import numpy as np

from drivers.files.mcap import Log
from tests.helpers.gap_effects import rnea
from tests.helpers.gap_mujoco import mjcf
from tests.hidden.twins import STEP_S, Twin, recorded

STIFF, DAMP, SLOW = 3600.0, 120.0, 6.0  # 1/s2, 1/s and 1/s of the controller
SUBSTEPS = 4


def by_pinocchio(twin: Twin) -> Log:
    """The arm does exactly what it is told."""
    q, dq, ddq = twin.motion
    tau = rnea(twin.arm, q, dq, ddq) + twin.friction.along(dq, STEP_S)
    return recorded(twin, q, dq, tau)


def by_mujoco(twin: Twin) -> Log:
    """The arm under computed torque of the nominal model, simulated forward.

    Raises:
        RuntimeError: the arm went away from what it was told.
    """
    wanted, still = twin.motion, np.zeros(twin.arm.n)
    model = mujoco.MjModel.from_xml_string(mjcf(twin.arm, still))
    plan = mujoco.MjModel.from_xml_string(mjcf(twin.nominal, still))
    for each in (model, plan):  # friction is the bristles' alone
        each.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        each.opt.timestep = STEP_S / SUBSTEPS
    arm, goal = mujoco.MjData(model), mujoco.MjData(plan)
    arm.qpos[:], arm.qvel[:] = wanted[0][0], wanted[1][0]
    z, behind = twin.friction.start * twin.friction.coulomb, still.copy()
    out = np.empty((3, *wanted[0].shape))
    for k, (q, dq, ddq) in enumerate(zip(*wanted, strict=True)):
        behind = behind + STEP_S * (q - arm.qpos)
        goal.qpos[:], goal.qvel[:] = arm.qpos, arm.qvel
        push = STIFF * (q - arm.qpos + SLOW * behind) + DAMP * (dq - arm.qvel)
        goal.qacc[:] = ddq + push
        mujoco.mj_inverse(plan, goal)
        tau = goal.qfrc_inverse.copy()
        out[:, k] = arm.qpos, arm.qvel, tau
        for _ in range(SUBSTEPS):
            z = twin.friction.after(z, arm.qvel, STEP_S / SUBSTEPS)
            arm.qfrc_applied[:] = tau - z - twin.friction.viscous * arm.qvel
            mujoco.mj_step(model, arm)
    if np.abs(out[0] - wanted[0]).max() > 0.5:
        raise RuntimeError(f"twin {twin.seed}: the arm went away from what it was told")
    # the torque of a row acts from its stamp to the next one: half a step later than the motion
    out[2, 1:] = (out[2, 1:] + out[2, :-1]) / 2
    return recorded(twin, *out)
