"""Effects in MuJoCo: in a loop of ours, or in any other by its passive forces."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from adapter import optional
from adapter.errors import ModelError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.model.urdf_text import ARMATURE
from adapter.simulate.arm import SimulatedArm, plain_urdf
from adapter.simulate.effects import Effects


class MujocoArm(SimulatedArm):
    """The joints of a model in a MuJoCo simulation.

    Damping, dry friction and springs of these joints are taken out of MuJoCo's model and the
    armature set to the learned one: the effects do the rest, and nothing counts twice. What
    else is in the model (a gripper, a table) stays as it is.

    Args:
        model: learned; its joints are found by name.
        simulated: MuJoCo's model and data; None: the arm alone, steps of `period_s`.
        period_s: of such a step.

    Raises:
        MeansError: no MuJoCo. ModelError: a joint that is not there or no hinge, a body that
            cannot exist.
    """

    def __init__(
        self, model: SelfModel, simulated: tuple[Any, Any] | None = None, period_s: float = 1e-3
    ) -> None:
        self._mujoco = optional.load("mujoco")
        if simulated is None:
            try:
                alone = self._mujoco.MjModel.from_xml_string(plain_urdf(model))
            except ValueError as error:
                raise ModelError(f"MuJoCo does not take {model.name}: {error}") from None
            alone.opt.timestep = period_s
            alone.opt.gravity[:] = np.asarray(model.gravity)
            simulated = alone, self._mujoco.MjData(alone)
        self.model, self.data = simulated
        super().__init__(Effects(model, float(self.model.opt.timestep), "bodies and armature"))
        joints = [self._joint(name) for name in model.tree.joint_names]
        self._qpos, self._dofs = self.model.jnt_qposadr[joints], self.model.jnt_dofadr[joints]
        lost = dict.fromkeys(("dof_damping", "dof_dampingpoly", "dof_frictionloss"), self._dofs)
        lost |= dict.fromkeys(("jnt_stiffness", "jnt_stiffnesspoly"), joints)
        for name, where in lost.items():
            if hasattr(self.model, name):  # polynomials are MuJoCo 4's
                getattr(self.model, name)[where] = 0.0
        self.model.dof_armature[self._dofs] = self.effects.held(ARMATURE)
        self._mujoco.mj_setConst(self.model, self._mujoco.MjData(self.model))

    def read(self) -> tuple[Array, Array]:
        """From the data."""
        return self.data.qpos[self._qpos].copy(), self.data.qvel[self._dofs].copy()

    def put(self, q: Array, dq: Array) -> None:
        """Into the data."""
        self.data.qpos[self._qpos], self.data.qvel[self._dofs] = q, dq
        self._mujoco.mj_forward(self.model, self.data)

    def advance(self, torque: Array) -> None:
        """By `mj_step` with applied torques."""
        self.data.qfrc_applied[self._dofs] = torque
        self._mujoco.mj_step(self.model, self.data)

    def close(self) -> None:
        """Nothing: MuJoCo's data go with this object."""

    @contextmanager
    def acting(self) -> Iterator[None]:
        """Within it every `mj_step` of this simulation has the effects, whoever calls it.

        They come as MuJoCo's passive forces (`mjcb_passive`); the drives' torques are those of the
        actuators and `qfrc_applied`, the time is the data's.
        """
        before = self._mujoco.get_mjcb_passive()
        self._mujoco.set_mjcb_passive(self._passive)
        try:
            yield
        finally:
            self._mujoco.set_mjcb_passive(before)

    def _passive(self, model: Any, data: Any) -> None:
        if data is not self.data:
            return
        self._mujoco.mj_fwdActuation(model, data)  # MuJoCo itself comes to it later
        own = self._dofs
        self.t, self._tau = float(data.time), data.qfrc_actuator[own] + data.qfrc_applied[own]
        state = data.qpos[self._qpos], data.qvel[own], data.qacc[own]
        data.qfrc_passive[own] += self.effects(*state, self._tau, self.t)

    def _joint(self, name: str) -> int:
        """Number of the hinge of that name. Raises ModelError."""
        kind = self._mujoco.mjtObj.mjOBJ_JOINT
        number: int = self._mujoco.mj_name2id(self.model, kind, name)
        if number < 0:
            have = [self.model.joint(k).name for k in range(self.model.njnt)]
            raise ModelError(f"MuJoCo's model has no joint '{name}'; has: {', '.join(have)}")
        if self.model.jnt_type[number] != self._mujoco.mjtJoint.mjJNT_HINGE:
            raise ModelError(f"joint '{name}' is no hinge in MuJoCo's model")
        return number
