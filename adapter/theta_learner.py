"""Learning θ and the effects beside it: ADAM on the moments of eq. 19, physically consistent.

Bodies live in log-Cholesky coordinates, so every step of ADAM is a possible body. What the data
do not show is held by a broad prior around a neutral body. The noise level of each joint is
profiled from its own residual. The value in use is a short running mean of ADAM's iterates.

A change at the hand (a payload) gets a body of its own, in the last link's place: what was
known of the other links stays known, and the payload is the difference to the link before.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.effects.base import LinearEffect
from adapter.errors import SettingsError
from adapter.inertia import log_cholesky_from_theta, min_eigenvalue, theta_from_body
from adapter.records import Array
from adapter.theta_kernels import absorb, follow, gradient, joint_costs, values
from adapter.theta_settings import (
    IDEAL_MODEL_ERROR,
    LOAD_RADIUS,
    NEUTRAL_INERTIA,
    NEUTRAL_MASS,
    PRIOR_STD,
    REAL_EFFECT,
    REAL_MODEL_ERROR,
    SMALLEST_LOAD,
    SMALLEST_SPREAD,
    STEP_SMOOTHING,
    ThetaSettings,
)
from adapter.tree import Tree


class ThetaLearner:
    """θ and the effects' parameters, their uncertainty, and a spare body for a change.

    Args:
        tree: of a fixed-base arm.
        base: (12,) motion of the base.
        effects: learned beside θ.
        noise_gain: correlated samples that one independent sample is worth.
        tool_theta: (10,) of a known tool on the last link, kept out of θ.
        delay_s: of the filter that torque and motion went through.
        believed: (e, n) values of the effects' parameters and their standard deviations, from a
            model; NaN where it says nothing, which is held for absent until data show it.

    Attributes:
        x: (P,) what ADAM steps on: log-Cholesky of the links and of the spare body, then effects.
        mean: (P,) the running mean of x that is in use; `th` its values (θ, effects).
        A: (n, S+1, S+1) moments since the last change; `count` samples in them.
        prior, prior_rhs: information (P, P) and (P,) from before: the prior and, after a change,
            all that was known then.
        spare_in_use: whether the spare body stands in for the last link.
        effect_std: (e,) spread of each effect's prior over the joints, see `adapt_effects`.
        smoothing_s: how long the filter takes a step of torque.
    """

    def __init__(
        self,
        tree: Tree,
        base: Array,
        effects: Sequence[LinearEffect] = (),
        settings: ThetaSettings | None = None,
        *,
        mode: str = "moments",
        noise_gain: float = 1.0,
        tool_theta: Array | None = None,
        delay_s: float = 0.0,
        believed: tuple[Array, Array] | None = None,
    ) -> None:
        if tree.floating:
            raise SettingsError("the online learner of θ needs a fixed base; this tree floats")
        self.tree, self.effects, self.mode = tree, tuple(effects), mode
        self.settings = settings or ThetaSettings()
        self.noise_gain = noise_gain
        self.smoothing_s = STEP_SMOOTHING * delay_s
        self._tool = np.zeros(10) if tool_theta is None else np.array(tool_theta)
        n = tree.n
        self.bodies = n + 1
        self.P = 10 * self.bodies + n * len(self.effects)
        self._parent, self._base = np.array(tree.parent, dtype=np.int64), base
        self._support, self._sizes = self._columns()
        # effects come after the spare body in the flat parameters
        self.place = self._support + 10 * (self._support >= 10 * n)
        width = int(self._sizes[:, 1].max()) + 1
        self.A = np.zeros((n, width, width))
        self.newest = np.zeros((n, width, width) if mode == "sample" else (0, width, width))
        self.count = 0.0
        self.effect_std = np.array([effect.prior_std for effect in self.effects])
        nothing: Array = np.full((len(self.effects), n), np.nan)
        self._believed, self._belief_std = believed or (nothing, nothing)
        self.prior, self.prior_rhs = self._neutral_prior()
        self.x, self.gradient = self._neutral(), np.zeros(self.P)
        self.mean, self.th = self.x.copy(), np.zeros(self.P)
        values(self.mean, self.bodies, self.th)
        self._th, self._g = np.zeros(self.P), np.zeros(self.P)
        self.updates = 0
        error = self.settings.model_error
        if error is None:
            error = REAL_MODEL_ERROR if self.effects else IDEAL_MODEL_ERROR
        self.model_variance = error**2
        self.floor, self.floor_count = np.full(n, self.model_variance), 1.0
        self.spare_in_use = False

    def _columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Which columns each joint's torque depends on: links beyond it, then its effects."""
        n, e = self.tree.n, len(self.effects)
        beyond = [[k for k in range(n) if j in self.tree.path_to(k)] for j in range(n)]
        sizes = np.array([[10 * len(b), 10 * len(b) + e] for b in beyond], dtype=np.int64)
        support = np.zeros((n, int(sizes[:, 1].max())), dtype=np.int64)
        for j, links in enumerate(beyond):
            columns = [10 * k + i for k in links for i in range(10)]
            columns += [10 * n + k * n + j for k in range(e)]
            support[j, : len(columns)] = columns
        return support, sizes

    def _neutral(self) -> Array:
        body = theta_from_body(NEUTRAL_MASS, np.zeros(3), NEUTRAL_INERTIA * np.eye(3))
        x = np.zeros(self.P)
        x[: 10 * self.bodies] = np.tile(log_cholesky_from_theta(body), self.bodies)
        x[10 * self.bodies :] = np.nan_to_num(self._believed).ravel()
        return x

    def _neutral_prior(self) -> tuple[Array, Array]:
        """Information of the prior: links and effects; the spare body waits without one."""
        n = self.tree.n
        std = np.full(self.P, np.inf)
        std[: 10 * n] = np.tile(PRIOR_STD, n)
        told = np.isfinite(self._believed)
        spread = np.where(told, self._belief_std, self.effect_std[:, None])
        std[10 * self.bodies :] = spread.ravel()
        mean = np.zeros(self.P)
        mean[10 * self.bodies :] = np.nan_to_num(self._believed).ravel()
        neutral = theta_from_body(NEUTRAL_MASS, np.zeros(3), NEUTRAL_INERTIA * np.eye(3))
        mean[: 10 * n] = np.tile(neutral, n)
        information = 1.0 / std**2
        return np.diag(information), information * mean

    def effect_columns(self, q: Array, dq: Array, ddq: Array) -> Array:
        """(m, e, n) columns of the effects for tables (m, n)."""
        out = np.empty((len(q), len(self.effects), self.tree.n))
        for k, effect in enumerate(self.effects):
            out[:, k] = effect.column(q, dq, ddq, self.smoothing_s)
        return out

    def absorb(
        self,
        R0: Array,
        p: Array,
        q: Array,
        dq: Array,
        ddq: Array,
        tau: Array,
        into: Array | None = None,
    ) -> Array:
        """Add samples (m, n) to the moments (or to `into`); returns the errors (m, n) before."""
        target = self.A if into is None else into
        error = np.empty_like(tau)
        forget = self.settings.forget_s
        absorb(
            self._parent,
            R0,
            p,
            self._base,
            q,
            dq,
            ddq,
            tau,
            self.effect_columns(q, dq, ddq),
            self._tool,
            self._support,
            self._sizes,
            self.place,
            self.th,
            0.0 if forget is None else 1e-3 / forget,
            target,
            self.newest if into is None else self.newest[:0],
            error,
        )
        if into is None:
            self.count += len(q)
        return error

    def errors(self, R0: Array, p: Array, q: Array, dq: Array, ddq: Array, tau: Array) -> Array:
        """Torque errors (m, n) of the parameters in use; nothing is learned."""
        return self.absorb(R0, p, q, dq, ddq, tau, into=np.zeros_like(self.A))

    def replace_moments(self, A: Array, count: float) -> None:
        """Put moments rebuilt with a better λ in place of the old ones.

        What was folded into the prior at a change cannot be rebuilt; it counts half from here on.
        """
        self.A, self.count = A, count
        if self.spare_in_use:
            neutral, neutral_rhs = self._neutral_prior()
            self.prior = 0.5 * (self.prior + neutral)
            self.prior_rhs = 0.5 * (self.prior_rhs + neutral_rhs)

    def compute_gradient(self) -> bool:
        """Fill the gradient of one ADAM step; False while there is too little to step on."""
        if self.count < self.settings.warm_up and not self.spare_in_use:
            self.gradient[:] = 0.0
            return False
        if self.mode == "sample":  # plain squared error of the newest sample, priors next to none
            moments, count = self.newest, 1.0
            noise = np.ones_like(self.floor), 1e9
            priors = 1e-6 * self.prior, 1e-6 * self.prior_rhs, 1e-6
        else:
            moments, count = self.A, self.count
            noise = self.floor, self.floor_count
            priors = self.prior, self.prior_rhs, 1.0
        gradient(
            self.x,
            self.bodies,
            moments,
            self._sizes,
            self.place,
            count,
            self.noise_gain,
            *noise,
            self.model_variance,
            *priors,
            self._th,
            self._g,
            self.gradient,
        )
        return True

    def restart_due(self, added: int) -> bool:
        """Whether the newest samples reached a restart of the spare body."""
        before = self.count - added
        return self.spare_in_use and any(before < k <= self.count for k in self.settings.restarts)

    def restart_spare(self) -> None:
        """Put the spare body to the last link plus the point mass that fits the data best.

        Nothing happens where that is no possible body (a load was taken away, say).
        """
        n = self.tree.n
        spare = slice(10 * n, 10 * n + 10)
        link = self.th[10 * n - 10 : 10 * n]
        H, rhs = self.information()
        th = self.th.copy()
        th[spare] = link
        at = np.arange(10 * n, 10 * n + 4)
        mass, *moment = np.linalg.solve(H[np.ix_(at, at)], rhs[at] - H[at] @ th)
        if mass < SMALLEST_LOAD:
            return
        centre = np.array(moment) / mass
        load = theta_from_body(mass, centre, mass * LOAD_RADIUS**2 * np.eye(3))
        if min_eigenvalue(link + load) <= 0.0:
            return
        self.x[spare] = self.mean[spare] = log_cholesky_from_theta(link + load)
        values(self.mean, self.bodies, self.th)
        self.updates = 0

    def after_step(self, settled: bool) -> None:
        """Carry the running mean along after ADAM has moved x."""
        self.updates += 1
        s = self.settings
        span = s.settled_average if settled else s.average
        follow(self.x, float(min(self.updates, span)), self.bodies, self.mean, self.th)

    def variance(self, th: Array | None = None) -> Array:
        """(n,) variance that weighs each joint: its residual's plus the model error's, (N m)².

        The residual is that of the parameters in use, or of others, th (P,).
        """
        cost = np.empty(self.tree.n)
        joint_costs(self.th if th is None else th, self.A, self._sizes, self.place, cost)
        own = (cost + self.floor_count * self.floor) / (self.count + self.floor_count)
        return own + self.model_variance

    def information(self) -> tuple[Array, Array]:
        """All that is known of (θ, effects): information matrix (P, P) and right side (P,)."""
        H, rhs = self.prior.copy(), self.prior_rhs.copy()
        for j, weight in enumerate(1.0 / (self.noise_gain * self.variance())):
            s = self._sizes[j, 1]
            at = self.place[j, :s]
            H[np.ix_(at, at)] += weight * self.A[j, :s, :s]
            rhs[at] += weight * self.A[j, :s, s]
        return H, rhs

    def adapt_effects(self) -> None:
        """Let the data say how large each effect is: the spread of its prior follows.

        One step of empirical Bayes a call: the square of the spread becomes the mean over the
        joints of estimate² + variance. An effect that is not there fades away, instead of taking
        a share of the data for itself; and where none is left, the model is trusted as that of
        an ideal arm. What a model told of keeps the spread that the model gave it.
        """
        if not self.effects:
            return
        n = self.tree.n
        variance = self.covariance().diagonal()[10 * self.bodies :].reshape(-1, n)
        widest = np.array([effect.prior_std for effect in self.effects])
        square = self.effect_values**2 + variance
        free = np.isnan(self._believed)
        found = [
            np.sqrt(np.mean(s[f])) if f.any() else 0.0 for s, f in zip(square, free, strict=True)
        ]
        spread = np.clip(found, SMALLEST_SPREAD * widest, widest)
        at = np.arange(10 * self.bodies, self.P)
        change = np.repeat(1.0 / spread**2 - 1.0 / self.effect_std**2, n)
        self.prior[at, at] += np.where(free.ravel(), change, 0.0)
        self.effect_std[:] = spread
        if self.settings.model_error is None:
            size = np.sqrt(np.mean(square, axis=1))
            real = bool((np.where(free.all(axis=1), spread, size) > REAL_EFFECT).any())
            self.model_variance = (REAL_MODEL_ERROR if real else IDEAL_MODEL_ERROR) ** 2

    def known(self) -> np.ndarray:
        """Indices of the parameters that have any information (the idle spare body has none)."""
        idle = np.zeros(self.P, dtype=bool)
        if not self.spare_in_use:
            idle[10 * self.tree.n : 10 * self.bodies] = True
        return np.flatnonzero(~idle)

    def least_squares(self) -> Array:
        """(P,) the batch solution on all samples so far, with the same prior, unconstrained."""
        H, rhs = self.information()
        at = self.known()
        out = self.th.copy()
        out[at] = np.linalg.solve(H[np.ix_(at, at)], rhs[at])
        return out

    def covariance(self) -> Array:
        """(P, P) covariance of (θ, effects); zero for the idle spare body."""
        H, _ = self.information()
        at = self.known()
        out = np.zeros((self.P, self.P))
        out[np.ix_(at, at)] = np.linalg.inv(H[np.ix_(at, at)])
        return out

    @property
    def theta(self) -> Array:
        """(n, 10) inertial parameters in use; the last link's with whatever it carries."""
        th = self.th[: 10 * self.bodies].reshape(-1, 10)
        out = th[:-1].copy()
        if self.spare_in_use:
            out[-1] = th[-1]
        return out

    @property
    def payload(self) -> tuple[Array, Array] | None:
        """What the last link carries more than before the change: θ (10,), covariance (10, 10)."""
        if not self.spare_in_use:
            return None
        n = self.tree.n
        th = self.th[: 10 * self.bodies].reshape(-1, 10)
        cov = self.covariance()[10 * (n - 1) : 10 * self.bodies, 10 * (n - 1) : 10 * self.bodies]
        J = np.hstack([-np.eye(10), np.eye(10)])
        return th[-1] - th[-2], J @ cov @ J.T

    @property
    def effect_values(self) -> Array:
        """(e, n) parameters of the effects."""
        return self.th[10 * self.bodies :].reshape(len(self.effects), self.tree.n)

    def start_change(self) -> None:
        """Something at the hand changed: keep what is known, open the spare body for the rest."""
        n = self.tree.n
        last, spare = slice(10 * (n - 1), 10 * n), slice(10 * n, 10 * self.bodies)
        H, rhs = self.information()
        if self.spare_in_use:
            H, rhs = _marginalise(H, rhs, spare)
        link = 1.0 / PRIOR_STD**2
        rows = np.arange(10)
        H[last, last][rows, rows] += link
        H[spare, spare][rows, rows] += link
        H[last, spare][rows, rows] -= link
        H[spare, last][rows, rows] -= link
        self.floor, self.floor_count = self.variance() - self.model_variance, 500.0
        self.prior, self.prior_rhs = H, rhs
        self.A[:], self.count = 0.0, 0.0
        self.x[spare] = self.mean[spare] = self.mean[last]
        values(self.mean, self.bodies, self.th)
        moved = self._support >= 10 * (n - 1)  # the last link's columns, and the effects' as ever
        self.place = self._support + 10 * moved
        self.spare_in_use = True
        self.updates = 0


def _marginalise(H: Array, rhs: Array, block: slice) -> tuple[Array, Array]:
    """Information about the rest when `block` is integrated out; zero rows in its place."""
    rest = np.setdiff1d(np.arange(len(H)), np.arange(block.start, block.stop))
    gain = np.linalg.solve(H[block, block], np.c_[H[block, rest], rhs[block]]).T
    out, out_rhs = np.zeros_like(H), np.zeros_like(rhs)
    out[np.ix_(rest, rest)] = H[np.ix_(rest, rest)] - H[rest, block] @ gain[:-1].T
    out_rhs[rest] = rhs[rest] - H[rest, block] @ gain[-1]
    return out, out_rhs
