"""What a contact was: a push at the hand, a load that came or went, friction, or elsewhere.

The external torques of its first 0.3 s are explained four ways, each with a prior of its own; the
name is the one that the data make most probable. A load that hangs still and a push straight
down are one and the same; a load in motion has its inertia as well.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from adapter.control.observer import Contact
from adapter.model.spatial import Array
from adapter.physics.kernels import (
    Frames,
    JointMotion,
    base_at_rest,
    regressors,
    wrench_torques,
)

RISE = 8  # samples at the beginning, in which the observer still follows
LEAST = 10  # samples that a name takes
ALIKE = 3.0  # samples that are one by their noise
PUSH = np.array([20.0, 20.0, 20.0, 5.0, 5.0, 5.0])  # std of N and N m
LOAD = np.array([2.0, 0.2, 0.2, 0.2])  # std of kg and kg m
FRICTION_SHARE = 0.05  # std of a joint's friction, of its effort limit
PROBABLE = 0.9
CRUDE = 0.2  # of the torques, by which a way may be off: a load's inertia, a push that swells
HAND_JOINTS = 3  # whose links a push at the hand and one there are alike
SLOW = 0.02  # rad/s; slower, friction has no direction


class Kind(StrEnum):
    """What a contact was."""

    OPEN = "contact"
    PUSH = "push at the hand"
    LOAD = "load at the hand, or a push straight down"
    FRICTION = "friction of one joint"
    ARM = "push on the arm"


def kind_of(contact: Contact, frames: Frames, gravity: Array, effort: Array) -> Kind:
    """The name; `Kind.OPEN` where too little was seen or two names are as probable.

    Args:
        contact: as the observer keeps it.
        frames: of the arm; gravity: (3,) m/s²; effort: (n,) limits, N m.
    """
    seen = contact.seen[RISE:]
    if len(seen) < LEAST:
        return Kind.OPEN
    since_s, q, dq, torque, std = np.array(seen).transpose(1, 0, 2).copy()
    joints = JointMotion(q, dq, _rate(since_s[:, 0], dq))
    crude = CRUDE * np.sqrt((torque**2).mean(axis=0))
    weight = 1.0 / np.sqrt(ALIKE * (std**2 + crude**2))
    ways = _ways(joints, frames, gravity, np.where(np.isfinite(effort), effort, 10.0))
    names, evidence = [], []
    for name, columns in ways:
        names.append(name)
        evidence.append(_evidence((weight[..., None] * columns), weight * torque))
    odds = np.exp(np.array(evidence) - max(evidence))
    for name in Kind:
        share = sum(own for own, other in zip(odds, names, strict=True) if other == name)
        if share > PROBABLE * odds.sum():
            return name
    return Kind.OPEN


def _rate(times: Array, dq: Array) -> Array:
    """Accelerations (m, n) of velocities that a cubic follows."""
    factors = np.polynomial.polynomial.polyfit(times, dq, 3)
    rates = np.polynomial.polynomial.polyder(factors)
    return np.ascontiguousarray(np.polynomial.polynomial.polyval(times, rates).T)


def _ways(
    joints: JointMotion, frames: Frames, gravity: Array, effort: Array
) -> list[tuple[Kind, Array]]:
    """Names and columns (m, n, k), each as large as it may well be."""
    q, dq, _ = joints
    n = q.shape[1]
    push, Y = np.empty((*q.shape, 6)), np.empty((*q.shape, 10 * n))
    wrench_torques(frames, q, np.diag(PUSH), push)
    regressors(frames, joints, base_at_rest(gravity)[None], Y)
    load = -Y[..., 10 * (n - 1) : 10 * (n - 1) + len(LOAD)] * LOAD
    size = FRICTION_SHARE * effort
    ways = [(Kind.PUSH, push), (Kind.LOAD, load)]
    for j in range(n):
        rubs = np.zeros((*q.shape, 1))
        rubs[:, j, 0] = -size[j] * np.where(np.abs(dq[:, j]) < SLOW, 0.0, np.sign(dq[:, j]))
        ways.append((Kind.FRICTION, rubs))
    for j in range(n - HAND_JOINTS):
        ways.append((Kind.ARM, np.broadcast_to(np.diag(size)[:, : j + 1], (*q.shape, j + 1))))
    return ways


def _evidence(columns: Array, torque: Array) -> float:
    """Log evidence of white torques (m, n) for columns (m, n, k) whose factors are about 1."""
    X, y = columns.reshape(-1, columns.shape[-1]), torque.ravel()
    H = X.T @ X + np.eye(X.shape[1])
    fitted = X.T @ y
    return float(0.5 * fitted @ np.linalg.solve(H, fitted) - 0.5 * np.linalg.slogdet(H)[1])
