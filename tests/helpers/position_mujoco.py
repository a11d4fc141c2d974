"""MuJoCo alone stepping an exported MJCF under the commands of a recording."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from adapter.model.mjcf_drives import SPEED
from drivers.files.mcap import Log

Array = NDArray[np.float64]


def followed(model: mujoco.MjModel, log: Log, start: Array) -> Array:
    """(k, n) rad at the stamps of a log, whose commands are the actuators', held each.

    Args:
        start: (2, n) q, dq at the first stamp.
    """
    data, names, orders = mujoco.MjData(model), log.joint_names, log.commands
    assert orders is not None and orders.q is not None
    at = [int(model.joint(name).qposadr[0]) for name in names]
    data.qpos[at] = start[0]
    data.qvel[[int(model.joint(name).dofadr[0]) for name in names]] = start[1]
    told_s, step = 1e-9 * (orders.stamp_ns - log.stamp_ns[0]), model.opt.timestep
    width = np.maximum(np.diff(told_s), 0.5 * np.median(np.diff(told_s)))[:, None]
    speed = np.concatenate([0.0 * orders.q[:1], np.diff(orders.q, axis=0) / width])
    columns = []
    for number in range(model.nu):
        actuator = model.actuator(number)
        joint = names.index(model.joint(actuator.trnid[0]).name)
        columns.append((speed if actuator.name.endswith(SPEED) else orders.q)[:, joint])
        if history := int(model.actuator_history[number, 0]):
            first = np.full(history, columns[-1][0])
            mujoco.mj_initCtrlHistory(model, data, number, None, first)
    controls, stamp_s = np.column_stack(columns), 1e-9 * (log.stamp_ns - log.stamp_ns[0])
    ends = step * np.arange(round(float(stamp_s[-1]) / step) + 2)
    current = np.maximum(np.searchsorted(told_s, ends + 1e-9, side="right") - 1, 0)
    q = np.empty((len(ends), len(names)))
    for k, row in enumerate(current):
        q[k] = data.qpos[at]
        data.ctrl[:] = controls[row]
        mujoco.mj_step(model, data)
    return np.column_stack([np.interp(stamp_s, ends, column) for column in q.T])


def error_in_mujoco(text: str, log: Log, start: Array) -> Array:
    """(n,) rad, rms of the readings less those of MuJoCo stepping an MJCF text."""
    model = mujoco.MjModel.from_xml_string(text)
    judged = log.stamp_ns - log.stamp_ns[0] >= 0.5e9  # s, as of our own simulation
    left = (log.q - followed(model, log, start))[judged]
    return np.sqrt(np.mean(left**2, axis=0))
