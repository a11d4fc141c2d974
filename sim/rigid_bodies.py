"""The rigid arm in PyBullet, as it is between two changes: inertias, payloads, the base's tilt."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pybullet as bullet

from sim.effects import BODY, Effect
from sim.truth import Array, Truth, body_of, principal, theta_of, turn, urdf


@dataclass(frozen=True, eq=False)
class ArmClient:
    """An arm in a PyBullet client of its own that holds from `start_s` on.

    PyBullet keeps what it computed of a body's masses: a change is another body.

    Attributes:
        start_s: from when on.
        truth: the rigid arm.
        client: where the arm moves.
        arm: its number there.
    """

    start_s: float
    truth: Truth
    client: int
    arm: int


def rigid_truths(truth: Truth, grid_s: float) -> list[tuple[float, Truth]]:
    """From when on which rigid arm holds, first start -inf, effects on the bodies worked in.

    Args:
        truth: with its effects.
        grid_s: of the ticks; a change acts from the tick on whose start is nearest to it.
    """
    bodies = [effect for effect in truth.effects if effect.place == BODY]
    times = {time for effect in bodies for time in (effect.start_s, effect.end_s)}
    starts = [-np.inf, *sorted(time for time in times if np.isfinite(time))]
    out = []
    for start in starts:
        theta, gravity = truth.theta.copy(), truth.gravity
        for effect in bodies:
            if not effect.start_s <= start < effect.end_s:
                continue
            if effect.name == "payload":
                theta[-1] += payload_theta(effect)
            elif effect.name == "link_inertia":
                dtheta = np.asarray(effect.parameters["dtheta"], float)
                theta[effect.columns(len(theta))[0]] += dtheta
            else:  # the base is turned by the rotation vector [rx, ry, 0]
                rx, ry = effect.number("rx"), effect.number("ry")
                angle, way = float(np.hypot(rx, ry)), float(np.arctan2(ry, rx))
                gravity = (turn(2, way) @ turn(0, angle) @ turn(2, -way)).T @ gravity
        rigid = truth.with_changes(theta=theta, gravity=gravity, effects=())
        out.append((start - grid_s / 2, rigid))
    return out


def payload_theta(load: Effect) -> Array:
    """(10,) of an effect `payload` about the origin of the last link."""
    com = [load.number(key) for key in ("cx", "cy", "cz")]
    inertia = np.asarray(load.parameters.get("inertia", [0.0] * 6), float)
    return theta_of(load.number("m"), com, inertia.tolist())


def load(start_s: float, truth: Truth, period_s: float) -> ArmClient:
    """The rigid arm of a truth in a fresh PyBullet client that steps by `period_s`.

    Raises:
        ValueError: a body without mass or with a negative moment of inertia.
    """
    moments = np.array([_checked(truth, j) for j in range(truth.n)])
    client = bullet.connect(bullet.DIRECT)
    rounder = truth.theta.copy()  # bodies that the reader takes, axes and centres unchanged
    for j in range(truth.n):
        m, c, inertia = body_of(truth.theta[j])
        three, axes = principal(inertia)
        spread = 0.1 * np.array([1.0, 1.1, 1.2]) * max(three.max(), 1e-9)
        round_ = axes @ np.diag(spread) @ axes.T
        rounder[j, 4:] = theta_of(m, c.tolist(), round_[np.triu_indices(3)].tolist())[4:]
    arm = load_urdf(urdf(truth.with_changes(theta=rounder)), client, fixed=True)
    # The reader of URDF files sets moments to zero that no rigid body has, learned ones among
    # them; set one by one they are kept.
    for j, three in enumerate(moments.tolist()):
        bullet.changeDynamics(arm, j, localInertiaDiagonal=three, physicsClientId=client)
    bullet.setGravity(*truth.gravity.tolist(), physicsClientId=client)
    bullet.setTimeStep(period_s, physicsClientId=client)
    return ArmClient(start_s, truth, client, arm)


def load_urdf(text: str, client: int, fixed: bool) -> int:
    """A robot of revolute joints, bare of all that PyBullet adds on its own account; its number.

    That is damping, friction, sleep, the cap of velocities and the motors that hold joints.
    """
    within = {"physicsClientId": client}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(text, "utf-8")
        how = {"useFixedBase": fixed, "flags": bullet.URDF_USE_INERTIA_FROM_FILE}
        robot: int = bullet.loadURDF(str(path), **how, **within)
    lossy = "linearDamping", "angularDamping", "jointDamping", "lateralFriction"
    bare = {**dict.fromkeys(lossy, 0.0), "maxJointVelocity": 1e6}  # in place of 100 rad/s
    bare["activationState"] = bullet.ACTIVATION_STATE_DISABLE_SLEEPING
    count = bullet.getNumJoints(robot, **within)
    for link in range(-1, count):
        bullet.changeDynamics(robot, link, **bare, **within)
    motors, off = (robot, list(range(count))), [0.0] * count
    bullet.setJointMotorControlArray(*motors, bullet.VELOCITY_CONTROL, forces=off, **within)
    return robot


def disconnect(clients: list[int]) -> None:
    """Free PyBullet's clients, those that are still there."""
    for client in clients:
        if bullet.isConnected(physicsClientId=client):
            bullet.disconnect(physicsClientId=client)
    clients.clear()


def _checked(truth: Truth, j: int) -> Array:
    """Principal moments (3,) of link j, kg m². Raises ValueError for what cannot be simulated."""
    name, mass = truth.link_names[j], truth.theta[j, 0]
    if not np.isfinite(truth.theta[j]).all() or not mass > 0.0:
        raise ValueError(f"{name} has a mass of {mass} kg; a simulated body needs mass above 0")
    moments, _ = principal(body_of(truth.theta[j])[2])
    if moments.min() < -1e-6 * max(moments.max(), 0.0) or moments.max() < 0.0:
        told = ", ".join(f"{moment:.3g}" for moment in moments)
        raise ValueError(
            f"{name} has principal moments of inertia of {told} kg m² about its centre; "
            "a simulated body needs them from 0 up"
        )
    return np.maximum(moments, 0.0)
