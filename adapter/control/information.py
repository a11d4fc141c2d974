"""What a motion tells of an arm's parameters, before it is made.

Torques are linear in the inertial parameters and in the coefficients of friction and its like:
tau = Y x. With torque noise of variance s_j² on joint j, samples that are independent add
Y' diag(1/s²) Y to the information on x, whatever x is, so a motion can be judged, and chosen,
before anything is known of the arm (Swevers et al., Optimal robot excitation and identification,
IEEE T-RA 13, 1997). Only the combinations that torques depend on at all are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from adapter.effects.base import LearnedEffect, of_sliding
from adapter.effects.by_joint import JointSignals
from adapter.effects.catalogue import effects_by_name
from adapter.model.inertia import PARAMETERS, UNITS
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.identifiability import BODY_SIZE, base_parameters
from adapter.physics.rigid_arm import RigidArm
from adapter.signals.filters import JointFilter
from adapter.signals.settings import FilterSettings

# Before any data: so many times a body of 1 kg, 10 cm across, and an effect's own prior.
BELIEF = 5.0
# Of an arm whose torque noise nobody knows; a Panda's torques are off by 0.2 to 0.4 % of its effort
# limits once its model is as good as it gets (Gaz et al., RA-L 4, 2019).
NOISE_SHARE = 0.003
# Learned beside the inertias; of friction with a memory its steps, which is where it is seen.
EFFECTS = ("viscous_friction", "coulomb_friction", "torque_offset", "motor_inertia")


@dataclass(frozen=True)
class Expected:
    """Standard deviation of what is shown of each parameter.

    Attributes:
        names: "link7 mass", "joint1 Fc", ...; units of each.
        std: in those units; wanted: the goal.
        shown: False for what this motion tells no more of than was believed before it.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    std: Array
    wanted: Array
    shown: np.ndarray

    @property
    def worst(self) -> float:
        """Largest std over wanted of what is shown; 0 where nothing is."""
        ratio = (self.std / self.wanted)[self.shown]
        return float(ratio.max()) if len(ratio) else 0.0


class Information:
    """What motions tell of one arm.

    Args:
        model: as documented; its inertias have no say.
        filtering: of the signals that are learned from: how long it takes a step, and how many of
            its samples are worth an independent one.
        effects: names of those learned beside the inertias, of the motion of the instant alone.
        torque_std: (n,) N m, noise of the joint torques; None for `NOISE_SHARE` of the effort.

    Attributes:
        basis: (columns, rank) orthonormal, of what torques depend on.
        prior: (rank, rank) information from before.
        size: (columns,) usual size of each parameter.
        samples_per_s: independent ones.
    """

    def __init__(
        self,
        model: SelfModel,
        filtering: FilterSettings | None = None,
        effects: Sequence[str] = EFFECTS,
        torque_std: Array | None = None,
    ) -> None:
        self._model, self._arm = model, RigidArm.of(model)
        self._effects: list[LearnedEffect] = list(effects_by_name(effects))
        n = model.tree.n
        joints = JointFilter(filtering)
        self._smoothing_s = joints.delay_s
        self.samples_per_s = 1.0 / (joints.noise_gain * joints.settings.period_s)
        if torque_std is None:
            effort = model.limits.effort
            torque_std = NOISE_SHARE * np.where(np.isfinite(effort), effort, 10.0)
        self._weight = 1.0 / np.asarray(torque_std)
        gravity = np.array(model.gravity)
        extra = self._columns if self._effects else None
        self.basis = base_parameters(model.tree, model.lam, gravity, extra=extra).basis
        self._inertial = base_parameters(model.tree, model.lam, gravity).basis
        own = [x.learned_std * x.drums(model.tree.slides) for x in self._effects]
        self.size = np.concatenate([np.tile(BODY_SIZE, n), *own])
        scaled = self.basis / (BELIEF * self.size[:, None])
        self.prior: Array = scaled.T @ scaled

    def regressor(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Y (m, n, columns) of a table of motion, (m, n) each: rad, rad/s, rad/s²."""
        rigid = self._arm.regressor(q, dq, ddq)
        if not self._effects:
            return rigid
        return np.concatenate([rigid, self._columns(q, dq, ddq)], axis=2)

    def rows(self, q: Array, dq: Array, ddq: Array) -> tuple[Array, Array]:
        """Regressors of a table, on what torques depend on: (m n, rank) in units of the noise,
        and (m n, own rank) of the inertias alone, in N m."""
        Y = self.regressor(q, dq, ddq)
        own = Y[:, :, : len(self._inertial)].reshape(-1, len(self._inertial))
        Y = (Y * self._weight[:, None]).reshape(-1, Y.shape[2])
        return Y @ self.basis, own @ self._inertial

    def on_rows(self, of_first: Array, of_second: Array) -> Array:
        """(n, columns, columns) by joint: a sum of quadratic forms in both kinds of `rows` as one
        form in a row of the regressor."""
        G = self._weight[:, None, None] ** 2 * (self.basis @ of_first @ self.basis.T)
        k = len(self._inertial)
        G[:, :k, :k] += self._inertial @ of_second @ self._inertial.T
        return np.asarray(G)

    def mean(self, q: Array, dq: Array, ddq: Array) -> Array:
        """(rank, rank) information of one independent sample, in the mean over a table."""
        Z, _ = self.rows(q, dq, ddq)
        return np.asarray(Z.T @ Z / len(q))

    def expected(self, information: Array, share: float) -> Expected:
        """What the parameters' standard deviations become with an information (rank, rank).

        Args:
            information: of motions, without `prior`.
            share: of each parameter's usual size that is wanted.
        """
        # in units of the prior, where no sum has an eigenvalue below one, however little moves
        back = np.linalg.inv(np.linalg.cholesky(self.prior).T)
        gained, axes = np.linalg.eigh(back.T @ information @ back)
        shown = self._shown_map()
        believed = shown @ back
        std = np.linalg.norm(believed @ axes / np.sqrt(1.0 + np.maximum(gained, 0.0)), axis=1)
        before = np.linalg.norm(believed, axis=1)
        exists = np.linalg.norm(shown, axis=1) > 1e-9 * self.size  # less is not shown
        tree, names = self._model.tree, list[str]()
        units: list[str] = []
        for link in tree.link_names:
            names += [f"{link} {part}" for part in PARAMETERS]
            units += UNITS
        for effect in self._effects:
            names += [f"{joint} {effect.key}" for joint in tree.joint_names]
            units += [of_sliding(effect.unit) if slides else effect.unit for slides in tree.slides]
        known = exists & (std < 0.5 * before)
        return Expected(tuple(names), tuple(units), std, share * self.size, known)

    def condition(self, q: Array, dq: Array, ddq: Array) -> float:
        """Condition number of a table's regressor of the base parameters, inertias alone."""
        return float(np.linalg.cond(self.rows(q, dq, ddq)[1]))

    @cached_property
    def in_wanted_units(self) -> Array:
        """(rank, rank) W: trace(W C) is the sum of all variances over sizes squared, C (rank,
        rank) being the covariance."""
        scaled = self._shown_map() / self.size[:, None]
        return np.asarray(scaled.T @ scaled)

    def _shown_map(self) -> Array:
        """(columns, rank): from what torques show to the smallest parameters that show it."""
        rows, triangle = np.linalg.qr(self.basis * self.size[:, None])
        return np.asarray(self.size[:, None] * np.linalg.solve(triangle, rows.T).T)

    def _columns(self, q: Array, dq: Array, ddq: Array) -> Array:
        """(m, n, e n) of the effects: the coefficient of joint j acts on joint j alone."""
        at = JointSignals(q, dq, ddq, smoothing_s=self._smoothing_s)
        n, out = q.shape[1], np.zeros((*q.shape, len(self._effects) * q.shape[1]))
        for k, effect in enumerate(self._effects):
            column = np.broadcast_to(effect.basis(at)[0], q.shape)
            for j in range(n):
                out[:, j, k * n + j] = column[:, j]
        return out
