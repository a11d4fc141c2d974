"""The rigid arm as it is between two changes: inertias, payloads and the base's tilt by time."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pybullet as bullet

from sim.effects import BODY, Effect
from sim.truth import Array, Payload, Truth, body_of, turn
from sim.urdf_writer import principal, urdf

FLAT = 1e-6  # of the largest moment: so far below zero a principal moment may be by rounding


@dataclass(frozen=True, eq=False)
class Stage:
    """An arm in a PyBullet client of its own that holds from `start_s` on.

    PyBullet keeps what it computed of a body's masses and of gravity: a change is another body.
    Its inverse dynamics refuses bodies with a moment of inertia larger than the sum of the other
    two, which its simulation takes; for them a second client holds the arm with that moment cut.

    Attributes:
        start_s: from when on.
        truth: the rigid arm.
        client: where the arm moves.
        arm: its number there.
        asked: the client that is asked for mass matrix and inverse dynamics, arm number alike.
    """

    start_s: float
    truth: Truth
    client: int
    arm: int
    asked: int

    @property
    def clients(self) -> tuple[int, ...]:
        """PyBullet's clients of this stage."""
        return (self.client,) if self.asked == self.client else (self.client, self.asked)

    def mass_matrix(self, q: Array) -> Array:
        """(n, n) kg m²."""
        return np.array(
            bullet.calculateMassMatrix(self.arm, q.tolist(), physicsClientId=self.asked)
        )

    def rigid(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Inverse dynamics (n,) N m."""
        motion = q.tolist(), dq.tolist(), ddq.tolist()
        return np.array(
            bullet.calculateInverseDynamics(self.arm, *motion, physicsClientId=self.asked)
        )


def rigid_truths(truth: Truth, grid_s: float) -> list[tuple[float, Truth]]:
    """From when on which rigid arm holds, first start -inf, effects on the bodies worked in.

    Args:
        truth: with its effects and its payload events.
        grid_s: of the ticks; a change acts from the tick on whose start is nearest to it.
    """
    bodies = [effect for effect in truth.effects if effect.place == BODY]
    times = {time for effect in bodies for time in (effect.start_s, effect.end_s)}
    times |= {event.t_s for event in truth.events}
    starts = [-np.inf, *sorted(time for time in times if np.isfinite(time))]
    out = []
    for start in starts:
        theta, gravity = truth.theta.copy(), truth.gravity
        for event in truth.events:
            if event.t_s <= start:
                theta[-1] += payload_theta(event)
        for effect in bodies:
            if effect.start_s <= start < effect.end_s:
                gravity = _work_in(effect, theta, gravity)
        rigid = truth.with_changes(theta=theta, gravity=gravity, events=(), effects=())
        out.append((start - grid_s / 2, rigid))
    return out


def _work_in(effect: Effect, theta: Array, gravity: Array) -> Array:
    """Add an effect to theta (n, 10) in place; gravity (3,) as it is seen from then on."""
    if effect.name == "payload":
        com = np.array([effect.number(key) for key in ("cx", "cy", "cz")])
        xx, xy, xz, yy, yz, zz = np.asarray(effect.parameters.get("inertia", [0.0] * 6), float)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        theta[-1] += payload_theta(Payload(0.0, effect.number("m"), com, inertia))
    elif effect.name == "link_inertia":
        theta[effect.columns(len(theta))[0]] += np.asarray(effect.parameters["dtheta"], float)
    else:
        return _tilted(gravity, effect.number("rx"), effect.number("ry"))
    return gravity


def payload_theta(load: Payload) -> Array:
    """(10,) of a payload about the origin of the last link."""
    c = load.com
    about_origin = load.inertia + load.m * (c @ c * np.eye(3) - np.outer(c, c))
    return np.array([load.m, *(load.m * c), *about_origin[np.triu_indices(3)]])


def _tilted(gravity: Array, rx: float, ry: float) -> Array:
    """R(r)^T g for the base turned by the rotation vector [rx, ry, 0]."""
    angle, way = float(np.hypot(rx, ry)), float(np.arctan2(ry, rx))
    about_x = turn(2, way) @ turn(0, angle) @ turn(2, -way)
    return np.asarray(about_x.T @ gravity)


def load(start_s: float, truth: Truth) -> Stage:
    """The rigid arm of a truth in a fresh PyBullet client.

    Raises:
        ValueError: a body without mass or with a negative moment of inertia.
    """
    moments = np.array([_checked(truth, j) for j in range(truth.n)])
    client, arm = _connect(truth, moments)
    others = moments.sum(axis=1, keepdims=True) - moments
    cut = np.minimum(moments, (1.0 - FLAT) * others)
    whole = bool((moments <= (1.0 + FLAT) * others).all())
    asked = client if whole else _connect(truth, cut)[0]
    return Stage(start_s, truth, client, arm, asked)


def _connect(truth: Truth, moments: Array) -> tuple[int, int]:
    """A client with the arm, its bodies' principal moments (n, 3) kg m² as given; client, arm."""
    client = bullet.connect(bullet.DIRECT)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(urdf(truth.with_changes(theta=_round_bodies(truth), events=())), "utf-8")
        flags = bullet.URDF_USE_INERTIA_FROM_FILE
        arm = bullet.loadURDF(str(path), useFixedBase=True, flags=flags, physicsClientId=client)
    # The reader of URDF files sets moments to zero that no rigid body has, learned ones among
    # them; set one by one they are kept.
    for j, three in enumerate(moments.tolist()):
        bullet.changeDynamics(arm, j, localInertiaDiagonal=three, physicsClientId=client)
    bullet.setGravity(*truth.gravity.tolist(), physicsClientId=client)
    return client, arm


def _checked(truth: Truth, j: int) -> Array:
    """Principal moments (3,) of link j, kg m². Raises ValueError for what cannot be simulated."""
    name, mass = truth.link_names[j], truth.theta[j, 0]
    if not np.isfinite(truth.theta[j]).all() or not mass > 0.0:
        raise ValueError(f"{name} has a mass of {mass} kg; a simulated body needs mass above 0")
    moments, _ = principal(body_of(truth.theta[j])[2])
    if moments.min() < -FLAT * max(moments.max(), 0.0) or moments.max() < 0.0:
        told = ", ".join(f"{moment:.3g}" for moment in moments)
        raise ValueError(
            f"{name} has principal moments of inertia of {told} kg m² about its centre; "
            "a simulated body needs them from 0 up"
        )
    return np.maximum(moments, 0.0)


def _round_bodies(truth: Truth) -> Array:
    """theta (n, 10) with bodies that PyBullet's reader takes, axes and centres unchanged."""
    out = truth.theta.copy()
    for j in range(truth.n):
        m, c, inertia = body_of(truth.theta[j])
        moments, axes = principal(inertia)
        spread = 0.1 * np.array([1.0, 1.1, 1.2]) * max(moments.max(), 1e-9)
        about_origin = axes @ np.diag(spread) @ axes.T + m * (c @ c * np.eye(3) - np.outer(c, c))
        out[j, 4:] = about_origin[np.triu_indices(3)]
    return out
