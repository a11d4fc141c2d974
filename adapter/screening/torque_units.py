"""Whether a recording's torques are those of the model in another unit, sign or order.

A model may be wrong by much and friction large, and still nobody flipped a sign. So each reading
of the torque signals ("as they are", "joint 3 negated", "N m times 1000", ...) is judged by how
well the model fits after everything that may well be wrong was corrected as far as it is
plausible: inertias by 40 %, a payload, friction, offsets, gains. The cost of a reading is that of
the residual plus that of the corrections; a wrong reading needs negative masses, which cost.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import linear_sum_assignment

from adapter.effects.by_joint import smooth_sign
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.rigid_arm import RigidArm

EFFECTIVE = 50.0  # independent samples per joint: more would let the data pay for negative masses
FLOOR_NM, FLOOR_SHARE = 0.15, 0.1  # what no correction explains: N m, and share of the torque
INERTIA_SHARE, RADIUS_M = 0.4, 0.1  # plausible error of masses; of where they sit
PAYLOAD = (3.0, 0.3, 0.05)  # kg, kg m, kg m2
FRICTION = (1.0, 2.0, 1.0, 0.1)  # std of offset, Coulomb, viscous (N m, N m, N m s/rad), gain
SMOOTHING_S = 0.018  # of a step by the 10 Hz low-pass that motion and torque went through
SIZE_STD = 0.4  # of the logarithm of all torques' size: no mass anywhere is no small error, ...
LEAST_SIZE = 1e-3  # ... and negative mass everywhere is taken for so little of it
GAIN_OF_EVIDENCE = 25.0  # cost (twice a log-likelihood) that another reading must save, and ...
CLEAR_SHARE_OF_COST = 0.25  # so much less needs no other evidence
# ... the share of the cost, and the cost, that it may leave, unless it lies much nearer.
SHARE_OF_COST, MUCH = 0.75, 200.0  # an own arm with 40 % wrong inertias leaves less than 100
# Of the misfit of the model as it is: a reading must lie nearer without any correction, too.
SHARE_OF_MISFIT, FAR_SHARE_OF_MISFIT = 0.8, 0.5
ALIKE = 0.7  # correlation of torques and model that makes them the same in another size
LARGE_FACTOR = 7.0  # of the torque; models are not wrong by so much, units are
UNITS = {
    1000.0: "N mm",
    100.0: "N cm",
    10.1972: "kgf cm or lbf in",
    0.101972: "kgf m",
    0.01: "torque of the motors before gears of 1:100",
    0.001: "kN m",
}
G, ASKEW_RAD = 9.81, np.deg2rad(15.0)  # m/s²; a load bends what torques say of gravity so far
SEEN_NM = 0.3  # rms of a joint's model torque below which nothing is read from it


@dataclass(frozen=True)
class TorqueReading:
    """A way to understand the torque signals.

    Attributes:
        kind: "as recorded", "sign", "scale", "gravity", "mounting" or "order".
        tau: (m, n) N m, to be compared with the model.
        cost: of the residual and of the corrections it needs.
        joints: from 0, which it concerns.
        detail: factors (n,), gravity (3,) or the order (n,), as the kind has it.
    """

    kind: str
    tau: Array
    cost: float
    joints: tuple[int, ...]
    detail: Array


class TorqueComparison:
    """Costs of readings of one recording.

    Args:
        arm: rigid body of the model, tool included.
        q, dq, ddq: (m, n) smoothed motion, some 25 Hz; tau_model: (m, n) N m of the model.

    Attributes:
        model: tau_model; sigma: (n,) N m, what no correction explains of it.
        friction: (3, m, n) one, sign of the motion and dq: torques that do not hang on masses.
    """

    def __init__(self, arm: RigidArm, q: Array, dq: Array, ddq: Array, tau_model: Array) -> None:
        self.model, self._arm, self._q = tau_model, arm, q
        self.sigma = FLOOR_NM + FLOOR_SHARE * np.sqrt(np.mean(tau_model**2, axis=0))
        self._row = np.sqrt(EFFECTIVE / len(q)) / self.sigma
        self.friction = np.stack([np.ones_like(dq), smooth_sign(dq, ddq, SMOOTHING_S), dq])
        inertial = arm.regressor(q, dq, ddq) * inertial_std(arm).ravel()
        joint = self._at_joints()
        rows = [(x * self._row[None, :, None]).reshape(-1, x.shape[2]) for x in (inertial, joint)]
        self._columns = np.concatenate(rows, axis=1)
        self._factor = _ridge(self._columns)
        self._joint_columns = rows[1][:, : (len(FRICTION) - 1) * q.shape[1]]  # gains left out
        self._joint_factor = _ridge(self._joint_columns)

    def _at_joints(self) -> Array:
        """(m, n, 4 n) torque per standard deviation of offset, friction and gain, in this order."""
        m, n = self.model.shape
        joint = np.zeros((m, n, len(FRICTION), n))
        columns = (*self.friction, self.model)
        for k, (std, column) in enumerate(zip(FRICTION, columns, strict=True)):
            for j in range(n):
                joint[:, j, k, j] = std * column[:, j]
        return joint.reshape(m, n, -1)

    def gravity(self, along: Array | None = None) -> Array:
        """(m, n) N m that the model says gravity takes, or would along another one (3,), m/s²."""
        still = np.zeros_like(self._q)
        return self._arm.changed(gravity=along).torque(self._q, still, still)

    def cost(self, tau: Array) -> float:
        """Of a reading (m, n), N m."""
        r = ((tau - self.model) * self._row).ravel()
        b = self._columns.T @ r
        left = float(r @ r - b @ cho_solve(self._factor, b))
        return left + (np.log(self._share(tau)) / SIZE_STD) ** 2

    def _share(self, tau: Array) -> float:
        """Which share of the model's torque a reading holds beside friction and offsets.

        Between `LEAST_SIZE` and 1, on the side of 1 by a standard deviation.
        """
        model, read = ((x * self._row).ravel() for x in (self.model, tau))
        b = self._joint_columns.T @ model
        free = model - self._joint_columns @ cho_solve(self._joint_factor, b)
        size = float(free @ model)
        share = float(free @ read) / size
        left = read - share * model
        b = self._joint_columns.T @ left
        rest = float(left @ left - b @ cho_solve(self._joint_factor, b))
        std = np.sqrt(max(1.0, rest / EFFECTIVE) / size)
        return float(np.clip(share + std, LEAST_SIZE, 1.0))

    def misfit(self, tau: Array, joints: tuple[int, ...]) -> float:
        """RMSE of a reading against the model as it is, in `sigma`, over some joints."""
        apart = (tau - self.model) / self.sigma
        return float(np.sqrt(np.mean(apart[:, list(joints)] ** 2)))

    def error(self, tau: Array) -> Array:
        """RMSE (n,) N m of the model, uncorrected, against a reading."""
        return np.asarray(np.sqrt(np.mean((tau - self.model) ** 2, axis=0)))


def _ridge(columns: Array) -> tuple[Array, bool]:
    """Factor of the normal equations with a unit prior on every coefficient."""
    return cho_factor(columns.T @ columns + np.eye(columns.shape[1]))


def inertial_std(arm: RigidArm) -> Array:
    """(n, 10) plausible errors of a model's inertias, a payload on the last link among them."""
    theta = arm.theta
    mass = np.abs(theta[:, :1])
    first = INERTIA_SHARE * (np.abs(theta[:, 1:4]) + RADIUS_M * mass)
    second = INERTIA_SHARE * (np.abs(theta[:, 4:]) + RADIUS_M**2 * mass)
    std = np.concatenate([INERTIA_SHARE * mass, first, second], axis=1)
    std[-1] += np.repeat(PAYLOAD, (1, 3, 6))
    return np.asarray(std)


def readings(comparison: TorqueComparison, tau: Array) -> list[TorqueReading]:
    """All readings of tau (m, n), the recorded one first, then by cost."""
    n = tau.shape[1]
    as_is = TorqueReading("as recorded", tau, comparison.cost(tau), tuple(range(n)), np.ones(n))
    others = [
        *_signs(comparison, tau, as_is.cost),
        *_scales(comparison, tau),
        *_orders(comparison, tau),
    ]
    free = tau + comparison.gravity()
    others.append(TorqueReading("gravity", free, comparison.cost(free), as_is.joints, np.ones(n)))
    others.append(_mounting(comparison, tau))
    other_size = _other_size(comparison, tau)
    others.sort(key=lambda reading: (reading.kind != "scale" if other_size else 0, reading.cost))
    return [as_is, *others]


def _sizes(comparison: TorqueComparison, tau: Array) -> tuple[NDArray[np.bool_], Array]:
    """(n,) joints whose model torque says something, and how large tau is against it."""
    model = np.sqrt(np.mean(comparison.model**2, axis=0))
    return model > SEEN_NM, np.sqrt(np.mean(tau**2, axis=0)) / np.maximum(model, 1e-6)


def _other_size(comparison: TorqueComparison, tau: Array) -> bool:
    """Whether all joints' torques have the model's shape in much another size.

    Torques without gravity are small, too, but have another shape.
    """
    seen, size = _sizes(comparison, tau)
    if not seen.any() or not np.all(size[seen] > 0):
        return False
    factor = np.log(size[seen])
    middle = float(np.median(factor))
    a, b = (
        (x / comparison.sigma)[:, seen].ravel() for x in (tau / np.exp(middle), comparison.model)
    )
    alike = abs(float(a @ b)) / float(np.linalg.norm(a) * np.linalg.norm(b))
    one_way = np.all(factor * np.sign(middle) > 0.5 * np.log(LARGE_FACTOR))
    return bool(one_way and abs(middle) > np.log(LARGE_FACTOR) and alike > ALIKE)


def convincing(comparison: TorqueComparison, best: TorqueReading, as_is: TorqueReading) -> bool:
    """Whether another reading is so much better than the recorded one that it must be told."""
    if best.kind == "scale" and _other_size(comparison, as_is.tau):
        return True
    if best.cost > as_is.cost - GAIN_OF_EVIDENCE:
        return False
    before, after = (comparison.misfit(r.tau, best.joints) for r in (as_is, best))
    if best.kind != "scale" and after >= before:  # offsets and gains alone make it the cheaper one
        return False
    if best.kind == "scale" or best.cost < CLEAR_SHARE_OF_COST * as_is.cost:
        return True
    if best.cost > min(SHARE_OF_COST * as_is.cost, MUCH):  # much is left, which no reading explains
        return after < FAR_SHARE_OF_MISFIT * before
    return after < SHARE_OF_MISFIT * before


def _signs(comparison: TorqueComparison, tau: Array, cost: float) -> Iterator[TorqueReading]:
    """All joints negated; and those, one after the other, that it pays to negate."""
    n = tau.shape[1]
    yield TorqueReading("sign", -tau, comparison.cost(-tau), tuple(range(n)), -np.ones(n))
    sign = np.ones(n)
    for _ in range(n - 1):
        trials = []
        for j in np.flatnonzero(sign > 0):
            trial = sign.copy()
            trial[j] = -1.0
            trials.append((comparison.cost(tau * trial), int(j)))
        lowest, joint = min(trials)
        if lowest > cost - GAIN_OF_EVIDENCE:
            break
        cost, sign[joint] = lowest, -1.0
        turned = tuple(np.flatnonzero(sign < 0).tolist())
        yield TorqueReading("sign", tau * sign, cost, turned, sign)


def _scales(comparison: TorqueComparison, tau: Array) -> Iterator[TorqueReading]:
    """One large factor on all joints, or each joint its own (gears, motor currents)."""
    model, n = comparison.model, tau.shape[1]
    seen, own = _sizes(comparison, tau)
    if not seen.any() or not np.all(own[seen] > 0):
        return
    common = float(np.median(own[seen]))
    if abs(np.log(common)) < np.log(LARGE_FACTOR):
        return
    sign = np.where(np.sum(tau * model, axis=0) < 0, -1.0, 1.0)
    near = [u for u in UNITS if abs(np.log(u / common)) < np.log(3.0)]
    factors = [sign * np.where(seen, own, common)]
    factors += [np.full(n, side * size) for size in (*near, common) for side in (1.0, -1.0)]
    for factor in factors:
        read = tau / factor
        yield TorqueReading("scale", read, comparison.cost(read), tuple(range(n)), factor)


def _orders(comparison: TorqueComparison, tau: Array) -> Iterator[TorqueReading]:
    """The columns in the order that fits best: column by column first, then by swaps."""
    n = tau.shape[1]
    apart = np.abs(tau[:, None, :] - comparison.model[:, :, None]) / comparison.sigma[:, None]
    order = linear_sum_assignment(np.mean(np.minimum(apart, 20.0) ** 2, axis=0))[1]
    cost = comparison.cost(tau[:, order])
    while n > 1:
        swaps = []
        for a, b in combinations(range(n), 2):
            trial = order.copy()
            trial[[a, b]] = trial[[b, a]]
            swaps.append((comparison.cost(tau[:, trial]), trial.tolist()))
        lowest, trial_order = min(swaps)
        if lowest >= cost - 1.0:
            break
        cost, order = lowest, np.array(trial_order)
    moved = np.flatnonzero(order != np.arange(n))
    if moved.size:
        yield TorqueReading(
            "order", tau[:, order], cost, tuple(moved.tolist()), order.astype(float)
        )


def _mounting(comparison: TorqueComparison, tau: Array) -> TorqueReading:
    """Gravity of the usual size along another direction of the base."""
    n = tau.shape[1]
    axes = np.stack([comparison.gravity(axis) for axis in np.eye(3)], axis=2)
    gravity_only = comparison.gravity()
    dynamic = comparison.model - gravity_only
    rows = (axes / comparison.sigma[None, :, None]).reshape(-1, 3)
    found = np.linalg.lstsq(rows, ((tau - dynamic) / comparison.sigma).ravel(), rcond=None)[0]
    size = float(np.linalg.norm(found))
    gravity = found * (G / size) if size else found
    read = tau + gravity_only - axes @ gravity
    return TorqueReading("mounting", read, comparison.cost(read), tuple(range(n)), gravity)


def unit(reading: TorqueReading) -> str | None:
    """Name of the unit whose factor all joints have, whatever the sign."""
    size = np.abs(reading.detail)
    return UNITS.get(float(size[0])) if np.ptp(size) == 0 else None


def in_words(
    best: TorqueReading, as_is: TorqueReading, comparison: TorqueComparison, tree: Tree, tau: Array
) -> str:
    """What a reading says, with the evidence and what to do."""
    before, after = (comparison.error(r.tau) for r in (as_is, best))
    joints = slice(None) if len(best.joints) == len(before) else list(best.joints)
    worst = f"the model is off by {rms(before[joints]):.3g} N m"
    if best.kind == "scale":
        return _scale_words(best, rms(tau), rms(comparison.model), rms(after))
    if best.kind == "sign":
        names = [tree.joint_names[j] for j in best.joints]
        which = "all joints" if len(names) == tree.n else ", ".join(names)
        return (
            f"the torque of {which} has the wrong sign: {worst} there as recorded and by "
            f"{rms(after[joints]):.3g} N m with the sign turned; tau is positive along the "
            f"joint's axis and holds the arm against gravity: {tau_gain(best.detail)} turns it."
        )
    if best.kind == "gravity":
        return (
            f"the torques hold no gravity: {worst} as recorded and by {rms(after):.3g} N m when "
            "the model's gravity torque is added; record them with gravity, or "
            "--tau gravity-compensated adds the model's (--gravity 0 0 0 where that of the load "
            "was taken off, too)."
        )
    if best.kind == "mounting":
        g = ", ".join(f"{x:.1f}" for x in best.detail)
        upright = np.where(np.abs(best.detail) > G * np.cos(ASKEW_RAD), G, 0.0)
        mounted = np.copysign(upright, best.detail) if upright.any() else best.detail
        given = " ".join(f"{x:.4g}" for x in mounted + 0.0)
        return (
            f"gravity acts along [{g}] m/s² of the base and not as in the model: {worst} as "
            f"recorded and by {rms(after):.3g} N m so; say how the arm is mounted, as in "
            f"--gravity {given}."
        )
    held = [tree.joint_names[int(k)] for k in best.detail]
    pairs = ", ".join(f"{held[j]} holds that of {tree.joint_names[j]}" for j in best.joints)
    return (
        f"the torques are in another order than the positions, the column of {pairs}: {worst} "
        f"there as recorded and by {rms(after[joints]):.3g} N m put in order; record them in the "
        "order of the joint names."
    )


def _scale_words(best: TorqueReading, recorded: float, model: float, after: float) -> str:
    """Of torques in another unit; rms of them, of the model and of what division leaves, N m."""
    size = np.abs(best.detail)
    same = np.ptp(size) == 0
    what = f"{size[0]:.4g} times" if same else ", ".join(f"{x:.3g}" for x in size) + " times"
    turned = " and with the opposite sign" if np.all(best.detail < 0) else ""
    guess = unit(best) or "gears (torque of the motors), motor currents or another unit"
    return (
        f"the torques are {what} what the model needs{turned} (rms {recorded:.3g} against "
        f"{model:.3g} N m, {after:.3g} N m off after division): {guess}? "
        f"{tau_gain(1.0 / best.detail)} makes N m at the link of them."
    )


def tau_gain(gain: Array) -> str:
    """The option for gains (n,), in N m per recorded unit."""
    told = gain[:1] if np.ptp(gain) == 0 else gain
    return "--tau-gain=" + ",".join(f"{x:.4g}" for x in told)


def rms(x: Array) -> float:
    """Root of the mean square of all of x."""
    return float(np.sqrt(np.mean(np.square(x))))
