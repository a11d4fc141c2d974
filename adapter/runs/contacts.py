"""What pushed the arm, as results tell it: at the hand, a load, friction, or elsewhere.

The external torques of a contact's first 0.3 s are explained four ways, each with a prior of its
own; the name is the one that the data make most probable. A load that hangs still and a push
straight down are one and the same; a load in motion has its inertia as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapter.control.observer import Contact, ContactObserver
from adapter.control.safety import MOVING
from adapter.learning.learner import OnlineLearner
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import Frames, JointMotion, base_at_rest, regressors, wrench_torques

ADOPT_EVERY = 100  # samples

PUSH = np.array([20.0, 20.0, 20.0, 5.0, 5.0, 5.0])  # std of N and N m
LOAD = np.array([2.0, 0.2, 0.2, 0.2])  # std of kg and kg m


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
    seen = contact.seen[8:]  # at the beginning the observer still follows
    if len(seen) < 10:  # samples that a name takes
        return Kind.OPEN
    since_s, q, dq, torque, std = np.array(seen).transpose(1, 0, 2).copy()
    times = since_s[:, 0]
    rates = np.polynomial.polynomial.polyder(np.polynomial.polynomial.polyfit(times, dq, 3))
    ddq = np.ascontiguousarray(np.polynomial.polynomial.polyval(times, rates).T)
    joints = JointMotion(q, dq, ddq)
    crude = 0.2 * np.sqrt((torque**2).mean(axis=0))  # a way may be off by
    weight = 1.0 / np.sqrt(3.0 * (std**2 + crude**2))  # samples alike by noise
    ways = _ways(joints, frames, gravity, np.where(np.isfinite(effort), effort, 10.0))
    names, evidence = [], []
    for name, columns in ways:
        names.append(name)
        evidence.append(_evidence((weight[..., None] * columns), weight * torque))
    odds = np.exp(np.array(evidence) - max(evidence))
    for name in Kind:
        share = sum(own for own, other in zip(odds, names, strict=True) if other == name)
        if share > 0.9 * odds.sum():  # probable
            return name
    return Kind.OPEN


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
    size = 0.05 * effort  # std, N m
    ways = [(Kind.PUSH, push), (Kind.LOAD, load)]
    for j in range(n):
        rubs = np.zeros((*q.shape, 1))
        rubs[:, j, 0] = -size[j] * np.where(np.abs(dq[:, j]) < MOVING, 0.0, np.sign(dq[:, j]))
        ways.append((Kind.FRICTION, rubs))
    for j in range(n - 3):  # a push at the hand and one at its last links are alike
        ways.append((Kind.ARM, np.broadcast_to(np.diag(size)[:, : j + 1], (*q.shape, j + 1))))
    return ways


def _evidence(columns: Array, torque: Array) -> float:
    """Log evidence of white torques (m, n) for columns (m, n, k) whose factors are about 1."""
    X, y = columns.reshape(-1, columns.shape[-1]), torque.ravel()
    H = X.T @ X + np.eye(X.shape[1])
    fitted = X.T @ y
    return float(0.5 * fitted @ np.linalg.solve(H, fitted) - 0.5 * np.linalg.slogdet(H)[1])


class ReplayObserver:
    """The contact observer beside a learner in the same thread.

    Args:
        documented: the arm; on a fixed base.
        learner: whose estimate it goes on with once it has converged.
    """

    def __init__(self, documented: SelfModel, learner: OnlineLearner) -> None:
        effects = learner.settings.effects
        self.observer, self._learner = ContactObserver(documented, effects), learner
        self._samples = 0

    def step_each(self, stamp_ns: NDArray[np.int64], signals: Array) -> None:
        """Take samples that the learner has seen: stamps (m,), and q, dq, tau (m, 3, n) of each."""
        begin = 0
        while begin < len(signals):
            end = min(begin + ADOPT_EVERY - self._samples % ADOPT_EVERY, len(signals))
            self.observer.step_each(stamp_ns[begin:end], signals[begin:end])
            self._samples += end - begin
            begin = end
            learner = self._learner
            if self._samples % ADOPT_EVERY or not learner.theta_converged:
                continue
            theta, std = learner.theta, learner.theta.variance() ** 0.5
            now = theta.theta, theta.effect_values, theta.shapes, std
            self.observer.adopt(learner.schema.lam, *now)


def contacts_of(observer: ContactObserver, documented: SelfModel) -> list[dict[str, Any]]:
    """Each contact: stamps, joint (from 1), largest torques and their std by joint, what it was."""
    effort = documented.limits.effort
    return [
        {
            "begin_ns": contact.begin_ns,
            "end_ns": contact.end_ns,
            "joint": contact.joint + 1,
            "torque_nm": contact.torque.tolist(),
            "std_nm": contact.std.tolist(),
            "kind": kind_of(contact, observer.frames, documented.gravity, effort).value,
        }
        for contact in observer.contacts
    ]


def contact_lines(
    contacts: Sequence[dict[str, Any]], names: Sequence[str], start_s: float
) -> list[str]:
    """A sentence on the contacts, where there were any; times from the stamp `start_s`."""
    if not contacts:
        return []
    first = contacts[0]
    j = first["joint"] - 1
    more = f", and {len(contacts) - 1} more" if len(contacts) > 1 else ""
    return [
        f"something pushed the arm: {first['kind']} at {1e-9 * first['begin_ns'] - start_s:.3f} s, "
        f"{first['torque_nm'][j]:+.1f} N m on {names[j]}{more}"
    ]
