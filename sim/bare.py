"""A body in PyBullet without what PyBullet adds on its own account."""

from __future__ import annotations

import pybullet as bullet

NO_CAP = 1e6  # rad/s and m/s, in place of PyBullet's velocity cap of 100


def make_bare(body: int, client: int) -> None:
    """Switch off damping, friction, sleep and the velocity cap of every link."""
    count = bullet.getNumJoints(body, physicsClientId=client)
    for link in range(-1, count):
        bullet.changeDynamics(
            body,
            link,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            lateralFriction=0.0,
            maxJointVelocity=NO_CAP,
            activationState=bullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=client,
        )
