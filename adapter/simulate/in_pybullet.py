"""Effects in PyBullet: a loop that steps the joints of a learned arm."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from adapter import optional
from adapter.errors import ModelError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.simulate.arm import SimulatedArm, plain_urdf
from adapter.simulate.effects import Effects

NO_CAP = 1e6  # rad/s, in place of PyBullet's velocity cap of 100


class PybulletArm(SimulatedArm):
    """The joints of a model in a PyBullet simulation.

    Taken out are the motors that hold its joints and whatever damping the body has, PyBullet's own
    included: the effects do all that. PyBullet has no armature; the effects stand in for it, which
    is exact as long as nothing touches the arm.

    Args:
        model: learned; its joints are found by name.
        simulated: PyBullet's client and body, whose time step is `period_s`; None: the arm alone,
            in a client of its own.
        period_s: of a step.

    Raises:
        ModelError: a joint that is not there, a body that cannot exist.
        MeansError: PyBullet is not installed.
    """

    def __init__(
        self, model: SelfModel, simulated: tuple[int, int] | None = None, period_s: float = 1e-3
    ) -> None:
        pybullet = optional.load("pybullet")
        super().__init__(Effects(model, period_s, "bodies"))
        self._bullet, self._alone = pybullet, simulated is None
        self.client, self.body = simulated or _alone(model, period_s)
        body = self._within = {"physicsClientId": self.client}
        count = pybullet.getNumJoints(self.body, **body)
        names = [pybullet.getJointInfo(self.body, j, **body)[1].decode() for j in range(count)]
        lacking = [name for name in model.tree.joint_names if name not in names]
        if lacking:
            raise ModelError(
                f"PyBullet's body has no joint '{lacking[0]}'; has: {', '.join(names)}"
            )
        self._joints = [names.index(name) for name in model.tree.joint_names]
        for link in range(-1, count):
            pybullet.changeDynamics(self.body, link, linearDamping=0.0, angularDamping=0.0, **body)
        for j in self._joints:
            # in two calls: where the cap is set, PyBullet leaves the damping as it is
            pybullet.changeDynamics(self.body, j, maxJointVelocity=NO_CAP, **body)
            pybullet.changeDynamics(self.body, j, jointDamping=0.0, **body)
            pybullet.setJointMotorControl2(
                self.body, j, pybullet.VELOCITY_CONTROL, force=0.0, **body
            )

    def read(self) -> tuple[Array, Array]:
        """From the joints' states."""
        states = self._bullet.getJointStates(self.body, self._joints, **self._within)
        both = np.array([state[:2] for state in states])
        return both[:, 0].copy(), both[:, 1].copy()

    def put(self, q: Array, dq: Array) -> None:
        """By resetting the joints."""
        for j, at, speed in zip(self._joints, q.tolist(), dq.tolist(), strict=True):
            self._bullet.resetJointState(self.body, j, at, speed, **self._within)

    def advance(self, torque: Array) -> None:
        """By `stepSimulation` with torque control."""
        motors = self.body, self._joints, self._bullet.TORQUE_CONTROL
        self._bullet.setJointMotorControlArray(*motors, forces=torque.tolist(), **self._within)
        self._bullet.stepSimulation(**self._within)

    def close(self) -> None:
        """Disconnect a client of its own."""
        if self._alone and self._bullet.isConnected(**self._within):
            self._bullet.disconnect(**self._within)


def _alone(model: SelfModel, period_s: float) -> tuple[int, int]:
    """Client and body of the arm by itself."""
    pybullet = optional.load("pybullet")
    text = plain_urdf(model)
    client: int = pybullet.connect(pybullet.DIRECT)
    within, as_written = {"physicsClientId": client}, pybullet.URDF_USE_INERTIA_FROM_FILE
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(text, "utf-8")
        body: int = pybullet.loadURDF(str(path), useFixedBase=True, flags=as_written, **within)
    awake = pybullet.ACTIVATION_STATE_DISABLE_SLEEPING
    pybullet.changeDynamics(body, -1, activationState=awake, **within)
    pybullet.setGravity(*model.gravity.tolist(), **within)
    pybullet.setTimeStep(period_s, **within)
    return client, body
