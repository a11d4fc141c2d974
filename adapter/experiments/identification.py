"""figaroh beside our own ways of learning: torque of one log that none of them has seen.

figaroh (Apache-2.0, https://github.com/thanhndv212/figaroh-plus) identifies base parameters by
weighted least squares. It is set up as its users would: viscous and Coulomb friction, an offset and
a motor inertia in every joint. All are learned before a second of the log and scored after it.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import io
import os
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from adapter.effects.export import to_urdf
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.runs.library import find_gap, learn
from adapter.runs.replay import seconds
from adapter.signals.matching import matching
from adapter.signals.validation import EDGE_S, GRID_S, smooth
from drivers.files.mcap import Log

# Torque RMSE of joints 1 to 7, N m, that figaroh 1.0.2 leaves of the log of a real Panda (Gaz et
# al. 2019) after 14 s, learned before; measured by `adapter bench --log`.
STATED_RMSE_NM = (0.157, 0.223, 0.139, 0.167, 0.063, 0.042, 0.049)
STATED = "stated: figaroh 1.0.2, log of Gaz et al. 2019, learned on 14 s"
MISSING = "extra [peers] is not installed"

Signals = tuple[Array, Array, Array, Array]


def held_out(log: Log, robot: SelfModel, split_s: float) -> list[dict[str, Any]]:
    """One row per way to learn: what, rmse_nm (n,) N m on the log after `split_s`, note.

    Raises:
        SettingsError: `split_s` is outside the log.
        ValueError: the log is of another robot, or a part of it is too short.
    """
    online = learn(log, robot, validate_from_s=split_s).held_out_rmse_nm
    batch = find_gap(log, robot, validate_from_s=split_s).after.torque_rmse_nm
    rows = [_row("ours, online", online, "one pass"), _row("ours, `gap`", batch, "")]
    if importlib.util.find_spec("figaroh") is None:
        return [*rows, stated()]
    version = importlib.metadata.version("figaroh")
    rmse = figaroh_rmse(matching(log, robot), robot, split_s)
    return [*rows, _row(f"figaroh {version}", rmse, "weighted least squares")]


def stated() -> dict[str, Any]:
    """figaroh's row where it, or its log, is not there."""
    missing = importlib.util.find_spec("figaroh") is None
    note = f"{STATED}; {MISSING}" if missing else STATED
    return _row("figaroh", np.array(STATED_RMSE_NM), note)


def _row(what: str, rmse: Array, note: str) -> dict[str, Any]:
    return {"what": what, "rmse_nm": np.asarray(rmse).tolist(), "note": note}


def figaroh_rmse(log: Log, robot: SelfModel, split_s: float) -> Array:
    """Torque RMSE (n,) N m on the log after `split_s`, identified before it, by our recipe."""
    late, edge = seconds(log) >= split_s, round(EDGE_S / GRID_S)
    parts: list[Signals] = []
    for rows in (~late, late):
        q, dq, ddq, tau = smooth(seconds(log)[rows], log.q[rows], log.dq[rows], log.tau[rows])
        parts.append((q[edge:-edge], dq[edge:-edge], ddq[edge:-edge], tau[edge:-edge]))
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")  # of its compiled parts, which register a type twice
        error = _errors(robot, *parts)
    return np.asarray(np.sqrt(np.mean(error**2, axis=0)))


def _errors(robot: SelfModel, learned: Signals, unseen: Signals) -> Array:
    """Torque errors (m, n) N m on `unseen` of what figaroh identifies from `learned`."""
    from figaroh.identification.base_identification import BaseIdentification
    from figaroh.tools.load_robot import load_robot
    from figaroh.tools.regressor import build_regressor_basic

    class Identification(BaseIdentification):
        """Its workflow on signals that are filtered already."""

        def load_trajectory_data(self, data_source: str | None = None) -> dict[str, Array]:
            names = ("positions", "velocities", "accelerations", "torques")
            times: Array = GRID_S * np.arange(len(learned[0]), dtype=np.float64)
            return {"timestamps": times, **dict(zip(names, learned, strict=True))}

        def process_kinematics_data(self, filter_config: object = None) -> None:
            self.processed_data = dict(self.raw_data)

    with tempfile.TemporaryDirectory() as folder:
        urdf, settings = Path(folder) / "arm.urdf", Path(folder) / "settings.yaml"
        urdf.write_text(to_urdf(robot))
        settings.write_text(_settings(robot))
        arm = load_robot(os.fspath(urdf), load_by_urdf=True)
        work = Identification(arm, os.fspath(settings))
    joints = list(range(robot.tree.n))
    work.identif_config.update(act_idxq=joints, act_idxv=joints)
    work.initialize()
    found = work.solve(decimate=False, plotting=False, wls=True)
    Y = build_regressor_basic(arm, *unseen[:3], work.identif_config)
    Y = np.delete(Y, work._idx_eliminated, axis=1)[:, work._base_indices]
    return np.asarray(unseen[3] - (Y @ found).reshape(robot.tree.n, -1).T)


def _settings(robot: SelfModel) -> str:
    """Its file of settings: every joint with friction, offset and motor inertia, as from zero."""
    names, zeros = ", ".join(robot.tree.joint_names), [0] * robot.tree.n
    return f"""
robot:
  name: arm
  properties: {{joints: {{active_joints: [{names}]}}}}
tasks:
  identification:
    type: identification
    problem:
      model_components: {{friction: true, actuator_inertia: true, joint_offset: true}}
    mechanics:
      friction_coefficients: {{viscous: {zeros}, static: {zeros}}}
      actuator_inertias: {zeros}
      joint_offsets: {zeros}
"""
