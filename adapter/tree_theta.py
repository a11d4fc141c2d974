"""θ of a tree from the moments of its regressor rows: the inner state of the online learner.

As in `theta_learner`: log-Cholesky coordinates, a broad prior around a neutral body, the noise
level of each joint profiled, a running mean of ADAM's iterates in use. The sub-trees that hang on
the base share no torque row, so each is a problem of its own in the same vector; the base follows
from its wrench, given those (and moves what torques leave open of the links that hang on it).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adapter.errors import ModelError
from adapter.inertia import log_cholesky_from_theta, theta_from_body
from adapter.records import Array
from adapter.theta_kernels import follow, values
from adapter.theta_settings import (
    IDEAL_MODEL_ERROR,
    NEUTRAL_INERTIA,
    NEUTRAL_MASS,
    PRIOR_STD,
    ThetaSettings,
)
from adapter.tree import BASE, Tree
from adapter.tree_kernels import absorb
from adapter.tree_slopes import gradient

# What the base's wrench has to say on the links that hang on it: enough to decide what torques
# leave open, little enough that the noise of the base's own motion bends nothing that they show.
HANGING_SHARE = 0.03
LEVEL_SAMPLES = 2000  # that the running mean of squared prediction errors spans

Indices = NDArray[np.int64]


class TreeTheta:
    """Moments and log-Cholesky parameters of every body of a tree.

    Args:
        tree: N and A.
        settings: of the learner of θ.
        noise_gain: correlated samples that one independent sample is worth.

    Attributes:
        x (P,): what ADAM steps on, ten numbers per body, the base first if it floats; `gradient`.
        mean (P,): the running mean of x that is in use; th (P,) its θ.
        A: flat upper triangles of the joints' moments; C (2, K, P + 1) those of the base, see
            `tree_kernels`; `near` (K,) are its columns.
        count: samples in the moments.
        level: (rows,) running mean of squared prediction errors, (N m)² or N².
        variance: (n,) of each joint's fit, model error included, as of the last gradient.
    """

    def __init__(
        self, tree: Tree, settings: ThetaSettings | None = None, noise_gain: float = 1.0
    ) -> None:
        self.tree, self.settings, self.noise_gain = tree, settings or ThetaSettings(), noise_gain
        self._parent = np.array(tree.parent, dtype=np.int64)
        self.place, self.sizes, self._slot = _columns(tree)
        triangles = (self.sizes + 1) * (self.sizes + 2) // 2
        self.starts = np.concatenate([[0], np.cumsum(triangles)[:-1]]).astype(np.int64)
        self.P = 10 * tree.bodies
        hanging = [k + 1 for k, i in enumerate(tree.parent) if i == BASE] if tree.floating else []
        near = [10 * body + i for body in [0, *hanging] for i in range(10)]
        self.near = np.array(near if tree.floating else [], dtype=np.int64)
        self.share = np.where(self.near < 10, 1.0, HANGING_SHARE)
        self.A, self.C = np.zeros(int(triangles.sum())), self._no_base_moments()
        self.count = 0.0
        neutral = theta_from_body(NEUTRAL_MASS, np.zeros(3), NEUTRAL_INERTIA * np.eye(3))
        self.prior = np.tile(1.0 / PRIOR_STD**2, tree.bodies)
        self.prior_mean = np.tile(neutral, tree.bodies)
        self.x = np.tile(log_cholesky_from_theta(neutral), tree.bodies)
        self.gradient = np.zeros(self.P)
        self.mean, self.th = self.x.copy(), np.zeros(self.P)
        values(self.mean, tree.bodies, self.th)
        error = self.settings.model_error
        self.model_variance = (IDEAL_MODEL_ERROR if error is None else error) ** 2
        self.level, self._span = np.zeros(tree.rows), np.array([0.0, LEVEL_SAMPLES])
        self.variance = np.full(tree.n, self.model_variance)
        self._th, self._g = np.zeros(self.P), np.zeros(self.P)
        self.updates = 0
        self.converged = False

    @property
    def theta(self) -> Array:
        """(bodies, 10) θ in use, the base first if it floats; every body of it is possible."""
        return self.th.reshape(-1, 10).copy()

    def _no_base_moments(self) -> Array:
        floating = int(self.tree.floating)
        return np.zeros((2 * floating, len(self.near), self.P + 1))

    def empty_moments(self) -> tuple[Array, Array]:
        """Moments of no samples, to be filled by `absorb` and put in place by `replace`."""
        return np.zeros_like(self.A), np.zeros_like(self.C)

    def absorb(
        self,
        R0: Array,
        p: Array,
        signals: Sequence[Array],
        into: tuple[Array, Array] | None = None,
    ) -> Array:
        """Add samples to the moments (or to `into`); returns the prediction errors before.

        Args:
            R0, p: frames to build the regressor with.
            signals: q, dq, ddq (m, n) each, tau (m, rows), motion rows of the base (m, 12).

        Returns:
            (m, rows) measured minus predicted torque; the base's wrench first if it floats.
        """
        A, C = (self.A, self.C) if into is None else into
        q, dq, ddq, tau, base = signals
        error = np.empty_like(tau)
        absorb(
            self._parent,
            self._slot,
            self.place,
            self.sizes,
            self.starts,
            self.near,
            R0,
            p,
            q,
            dq,
            ddq,
            tau,
            base,
            self.th,
            A,
            C,
            self.level if into is None else self.level[:0],
            self._span,
            error,
        )
        if into is None:
            self.count += len(q)
        return error

    def replace(self, moments: tuple[Array, Array], count: float) -> None:
        """Put moments rebuilt with a better λ in place of the old ones."""
        self.A, self.C = moments
        self.count = count

    def base_weights(self) -> Array:
        """(2,) weight of the base's force and moment rows: 1 / their running squared error."""
        if not self.tree.floating:
            return np.zeros(2)
        square = self.level[:6].reshape(2, 3).mean(axis=1)
        return 1.0 / (self.noise_gain * (square + self.model_variance))

    def compute_gradient(self) -> bool:
        """Fill the gradient of one ADAM step; False while there is too little to step on."""
        if self.count < self.settings.warm_up:
            self.gradient[:] = 0.0
            return False
        gradient(
            self.x,
            self.place,
            self.sizes,
            self.starts,
            self.near,
            self.share,
            self.A,
            self.C,
            self.count,
            self.noise_gain,
            self.model_variance,
            self.base_weights(),
            self.prior,
            self.prior_mean,
            self._th,
            self._g,
            self.variance,
            self.gradient,
        )
        return True

    def after_step(self) -> None:
        """Carry the running mean along after ADAM has moved x."""
        self.updates += 1
        span = self.settings.settled_average if self.converged else self.settings.average
        follow(self.x, float(min(self.updates, span)), self.tree.bodies, self.mean, self.th)

    def judge(self, excess: float) -> None:
        """θ has converged when it predicts the last seconds about as well as it fits all samples.

        Args:
            excess: mean over joints of predicted over fitted squared error that still counts.
        """
        joints = self.level[self.tree.rows - self.tree.n :]
        limit = 2.0 * excess if self.converged else excess
        long_enough = self._span[0] >= LEVEL_SAMPLES
        self.converged = bool(long_enough and np.mean(joints / self.variance) < limit)

    def joint_moments(self, j: int) -> Array:
        """(S + 1, S + 1) moments of joint j's row [y, tau]; `place[j, :S]` are its columns."""
        width = int(self.sizes[j]) + 1
        out = np.zeros((width, width))
        upper = np.triu_indices(width)
        out[upper] = self.A[self.starts[j] : self.starts[j] + len(upper[0])]
        return out + np.triu(out, 1).T

    def information(self, branch: int) -> tuple[Indices, Array, Array]:
        """What is known of a sub-tree that hangs on the base: its block of Yᵀ W Y and Yᵀ W tau.

        Args:
            branch: the joint it hangs by.

        Returns:
            Indices (k,) of its columns in θ, information (k, k) and right side (k,), prior
            included.

        Raises:
            ModelError: that joint does not hang on the base.
        """
        if self.tree.parent[branch] != BASE:
            choices = ", ".join(str(j) for j, i in enumerate(self.tree.parent) if i == BASE)
            raise ModelError(f"joint {branch} does not hang on the base; have: {choices}")
        at = self.place[branch, : self.sizes[branch]]
        H, rhs = np.diag(self.prior[at]), self.prior[at] * self.prior_mean[at]
        for j in range(self.tree.n):
            if branch in self.tree.path_to(j):
                own = np.searchsorted(at, self.place[j, : self.sizes[j]])
                moments = self.joint_moments(j) / (self.noise_gain * self.variance[j])
                H[np.ix_(own, own)] += moments[:-1, :-1]
                rhs[own] += moments[:-1, -1]
        return at, H, rhs

    def least_squares(self) -> Array:
        """(P,) the batch solution on all samples so far, same prior and weights, unconstrained."""
        out = self.th.copy()
        for j, i in enumerate(self.tree.parent):
            if i == BASE:
                at, H, rhs = self.information(j)
                out[at] = np.linalg.solve(H, rhs)
        if self.tree.floating:
            weighted = np.einsum("h,hab->ab", self.base_weights(), self.C[:, :10])
            H = weighted[:, :10] + np.diag(self.prior[:10])
            rhs = weighted[:, -1] - weighted[:, 10:-1] @ out[10:]
            out[:10] = np.linalg.solve(H, rhs + self.prior[:10] * self.prior_mean[:10])
        return out


def _columns(tree: Tree) -> tuple[Indices, Indices, Indices]:
    """Columns of θ that each joint's row touches (n, S), how many (n,), and where in the row the
    ten of link k start (n, n), -1 where k is not beyond j."""
    n, first = tree.n, int(tree.floating)
    beyond = [[k for k in range(n) if j in tree.path_to(k)] for j in range(n)]
    sizes = np.array([10 * len(links) for links in beyond], dtype=np.int64)
    place = np.zeros((n, int(sizes.max())), dtype=np.int64)
    slot = np.full((n, n), -1, dtype=np.int64)
    for j, links in enumerate(beyond):
        for number, k in enumerate(links):
            slot[j, k] = 10 * number
            place[j, 10 * number : 10 * (number + 1)] = 10 * (k + first) + np.arange(10)
    return place, sizes, slot
