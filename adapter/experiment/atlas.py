"""Section IV.A of the paper: the body schema and the dynamics of a humanoid in free fall."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from adapter.experiment.results import BOX_PERCENTILES, Learned
from adapter.experiment.trajectories import SETS, Split, Trajectories, gathered, sets_of
from adapter.offline.kinematic_errors import KinematicErrors, kinematic_errors
from adapter.offline.schema import schema_from_moments
from adapter.offline.schema_networks import NetworkResult, schema_by_networks
from adapter.offline.theta import ThetaResult, ThetaSettings, learn_theta
from adapter.offline.torque_errors import predicted_torques, relative_errors
from adapter.spatial import Array
from adapter.tree_data import TreeData

Say = Callable[[str], None]


@dataclass(frozen=True)
class Body:
    """λ and θ of a tree as learned from 1 % of the training set.

    Attributes:
        networks: λ as the paper learns it.
        lam: (n, 6) λ from the moments of the same samples; θ was learned with it.
        theta: with its sub-problems.
        schema_s: of the networks; moments_s: of the moments; theta_s: of θ.
    """

    networks: NetworkResult
    lam: Array
    theta: ThetaResult
    schema_s: float
    moments_s: float
    theta_s: float

    @property
    def learning_s(self) -> float:
        """All three together."""
        return self.schema_s + self.moments_s + self.theta_s


def learn_body(data: TreeData, seed: int) -> Body:
    """λ by networks and by moments, then θ over bodies that can exist."""
    began = time.perf_counter()
    networks = schema_by_networks(data, seed)
    then = time.perf_counter()
    lam = schema_from_moments(data).lam
    middle = time.perf_counter()
    theta = learn_theta(data, lam, seed)
    end = time.perf_counter()
    return Body(networks, lam, theta, then - began, middle - then, end - middle)


class Errors:
    """Relative and absolute torque errors, gathered trajectory by trajectory."""

    def __init__(self, joints: int) -> None:
        self._joints = joints
        self._relative: dict[str, list[Array]] = {name: [] for name in SETS}
        self._square = {name: np.zeros(joints) for name in SETS}
        self._count = dict.fromkeys(SETS, 0)

    def add(self, name: str, tau: Array, estimate: Array) -> None:
        """Joint torques (m, joints) of a set, and what a learner says of them."""
        if len(tau):
            self._relative[name].append(relative_errors(tau, estimate))
            self._square[name] += np.square(tau - estimate).sum(axis=0)
            self._count[name] += len(tau)

    def into(self, learned: Learned) -> Learned:
        """Fill in boxes, percentiles and root mean squares."""
        for name in SETS:
            if not self._relative[name]:
                continue
            table = np.concatenate(self._relative[name])
            learned.boxes[name] = np.array([_percentiles(column) for column in table.T])
            every = table[~np.isnan(table)]
            learned.median[name], learned.p99[name] = map(float, np.percentile(every, (50, 99)))
            learned.rmse[name] = np.sqrt(self._square[name] / max(self._count[name], 1))
        return learned


def _percentiles(column: Array) -> Array:
    judged = column[~np.isnan(column)]
    if not len(judged):
        return np.full(len(BOX_PERCENTILES), np.nan)
    return np.asarray(np.percentile(judged, BOX_PERCENTILES))


@dataclass
class Judged:
    """What a learned body is worth on all samples.

    Attributes:
        learned: torque errors of all joints, as a learner of the comparison.
        arm: the same of the joints alone that the others learn.
        kinematics: on the control set; training: on the samples learned from.
        networks: on the control set, with λ as the networks left it; networks_training: that λ
            on the samples learned from.
    """

    learned: Learned
    arm: Learned
    kinematics: KinematicErrors
    training: KinematicErrors
    networks: KinematicErrors
    networks_training: KinematicErrors


def judge(
    body: Body, learned_from: TreeData, source: Trajectories, parts: Split, arm: Sequence[int]
) -> Judged:
    """Torques on every sample, of all joints and of an arm's; link motion on the control set."""
    n, some = learned_from.tree.n, list(arm)
    errors, arm_errors, kinematics, networks = Errors(n), Errors(len(some)), [], []
    for data, rows in sets_of(source, parts):
        estimate = predicted_torques(data, body.lam, body.theta.theta)[:, -n:]
        for name, own in rows.items():
            tau = data.tau[own][:, -n:]
            errors.add(name, tau, estimate[own])
            arm_errors.add(name, tau[:, some], estimate[own][:, some])
        if "control" in rows:
            kinematics.append(kinematic_errors(data, body.lam))
            networks.append(kinematic_errors(data, body.networks.lam))
    learned = Learned("FOPnet", "First-order-principles networks", train_s=body.learning_s)
    learned.tuning = [
        f"λ from {len(learned_from)} samples, 1 % of the training set: networks "
        f"{body.schema_s:.1f} s, moments {body.moments_s:.2f} s",
        f"θ over bodies that can exist, {len(body.theta.stages)} sub-problems in "
        f"{body.theta_s:.1f} s",
    ]
    training = kinematic_errors(learned_from, body.lam)
    of_arm = arm_errors.into(Learned("FOPnet, arm", learned.title, train_s=body.learning_s))
    of_networks = kinematic_errors(learned_from, body.networks.lam)
    return Judged(
        errors.into(learned), of_arm, worst(kinematics), training, worst(networks), of_networks
    )


def worst(parts: list[KinematicErrors]) -> KinematicErrors:
    """Errors of several sets of samples as one."""
    first = parts[0]
    return KinematicErrors(
        {k: max(p.largest[k] for p in parts) for k in first.largest},
        {k: np.sum([p.histogram[k] for p in parts], axis=0) for k in first.histogram},
        first.edges,
        {k: np.max([p.largest_by_link[k] for p in parts], axis=0) for k in first.largest},
    )


def noisy_trial(source: Trajectories, parts: Split, true_lam: Array, seed: int) -> dict[str, Any]:
    """Learned λ and θ against weighted least squares with true λ, all from noisy sensors.

    Both see the same filtered samples (1 % of the training set) and are judged on the control
    set, joints in units of what the least squares leaves there.
    """
    data = gathered(source, parts, parts.learned, noisy=True)
    n = data.tree.n
    lam = schema_from_moments(data).lam
    theta = learn_theta(data, lam, seed)
    best = learn_theta(data, true_lam, seed, ThetaSettings(solver="least squares"))
    square, count = np.zeros((2, n)), 0
    for k in parts.control:
        control = source.measured(k)
        for row, (frames, bodies) in enumerate(((lam, theta.theta), (true_lam, best.theta))):
            estimate = predicted_torques(control, frames, bodies)
            square[row] += np.square((control.tau - estimate)[:, -n:]).sum(axis=0)
        count += len(control)
    ours, least = np.sqrt(square / count)
    return {
        "samples": len(data),
        "control_torque_rmse_nm": ours,
        "least_squares_control_torque_rmse_nm": least,
        "ratio_by_joint": ours / least,
        "ratio": float(np.sqrt(np.mean(np.square(ours / least)))),
        "ratio_of_total": float(np.sqrt(np.sum(ours**2) / np.sum(least**2))),
        "min_pseudo_inertia_eigenvalue": theta.min_eigenvalue,
        "theta_converged": theta.converged,
    }
