"""θ and the effects beside it: ADAM's gradient from the moments of eq. 19, physically consistent.

Bodies live in log-Cholesky coordinates, so every step of ADAM is a possible body. What the data
do not show is held by a broad prior around a neutral body. The noise level of each joint is
profiled from its own residual. The value in use is a short running mean of ADAM's iterates.

A change at the hand (a payload) gets a body of its own, in the hand's place: what was known of the
other links stays known, and the payload is the difference to the hand before.

A floating base follows from its wrench, given the links (and moves what torques leave open of the
links that hang on it).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapter.effects.active import Active
from adapter.effects.base import LearnedEffect
from adapter.effects.by_joint import AT_REST, JointSignals, slowness
from adapter.effects.catalogue import effects_by_name
from adapter.judgement.noise import MEMORY_S
from adapter.learning import theta_kernels as kernels
from adapter.learning.known_effects import believed, told_shapes
from adapter.learning.settings import LearnerSettings, Mode
from adapter.model.inertia import log_cholesky_from_theta, min_eigenvalue, theta_from_body
from adapter.model.spatial import Array
from adapter.model.tree import BASE, Tree
from adapter.physics.kernels import jit
from adapter.physics.rigid_arm import RigidArm
from adapter.signals.records import StateLayout

# Prior: what a link of an arm may well be. Neutral body, and standard deviations around it.
PRIOR_STD = np.array([5.0, *[0.5] * 3, *[0.3] * 6])  # kg, kg m, kg m²

REAL_MODEL_ERROR, IDEAL_MODEL_ERROR = 0.01, 0.001  # N m
# An effect of this size in its unit (N m, N m s/rad, kg m²) is that of a real arm; one whose spread
# has fallen to this share of what it may be is not there.
REAL_EFFECT, SMALLEST_SPREAD = 0.05, 1e-3
# Of an effect that has several shapes: the first one in use, how many are tried at a look, and by
# what another must be better, in squares of standard deviations.
FIRST_SHAPE, SHAPES_TRIED, SHAPE_EVIDENCE = 2, 25, 2.0
# Effects of the torque's rates must explain so many times the variance that noise of the motion
# puts on the model's torque, which is the most that they could explain of that alone.
RATES_OVER_NOISE, TINY = 4.0, 1e-30

# A step of friction that has gone through the filter looks like tanh over this share of its delay
# (fitted on simulated reversals; 1 for a tanh as wide as the delay).
STEP_SMOOTHING = 0.6

# What the base's wrench has to say on the links that hang on it: enough to decide what torques
# leave open, little enough that the noise of the base's own motion bends nothing that they show.
HANGING_SHARE = 0.03


def neutral_body() -> Array:
    """(10,) what is believed of a link before any data."""
    return theta_from_body(1.0, np.zeros(3), 0.02 * np.eye(3))  # kg; kg m², about every axis


@dataclass(frozen=True)
class Filtered:
    """What the filter before the learner does to signals.

    Attributes:
        noise_gain: correlated samples that one independent sample is worth
            (`JointFilter.noise_gain`).
        delay_s: of the filter (`JointFilter.delay_s`).
        state_s: between filtered states.
    """

    noise_gain: float = 1.0
    delay_s: float = 0.0
    state_s: float = 1e-3


@dataclass(frozen=True)
class KnownArm:
    """What is known of the robot beside its topology.

    Attributes:
        hand: the link whose load may change; None for the last one.
        tool_theta: (10,) of a known tool on the hand, kept out of θ.
        effects: lasting ones that a model brings, none of bodies (`with_bodies`). Those that are
            learned start from the model's values; the others are taken off the states.
        arm: the model's rigid arm, needed where there are such effects. Its gravity is what
            torques and measured link motion show; where the base is tilted it is not that of
            the documentation, which synthesized link motion is made with.
        lam: (n, 6) documented λ, which sensors mounted anyhow start from; nobody else looks at it.
        theta: (n, 10) documented θ of the links, which the posterior is about; ADAM knows nothing
            of it.
    """

    hand: int | None = None
    tool_theta: Array | None = None
    effects: Sequence[Active] = ()
    arm: RigidArm | None = None
    lam: Array | None = None
    theta: Array | None = None


class Theta:
    """θ and the effects' parameters of a tree, their uncertainty, and a spare body for a change.

    Args:
        tree: N and A.
        base: (12,) motion of a base at rest; empty where it floats and the states tell.
        settings: of the learner; filtered: what the filter did to the states.
        known: what is known of the robot.

    Attributes:
        x: (P,) what ADAM steps on: log-Cholesky of the bodies (the base first if it floats, the
            links, the spare one), then the effects; `gradient`.
        mean: (P,) the running mean of x that is in use; `th` its values (θ, effects).
        moments: since the last change; `count` samples in them.
        weight: samples that one that is given stands for, where the others are left out.
        prior, prior_rhs: information (P, P) and (P,) from before: the prior and, after a change,
            all that was known then.
        hand, spare: (slices of P) the hand's body, and the one that stands in for it after a
            change, when `spare_in_use`.
        own: by effect, which of all effects' columns are its own.
        shapes: (e, n) of the effects that have several columns, chosen between their shapes by what
            the data say; NaN for the others.
        believed: (e, n) values of the effects' parameters and their standard deviations before any
            torque, from a model; NaN where it says nothing, which is held for absent until data
            show it.
        drums: (e, n) times which that holds, of joints of which some slide.
        effect_spread: (e,) of each effect's prior over the joints; body_spread: (bodies,) of each
            body's, in `PRIOR_STD`; see `adapt_prior`.
        smoothing_s: how long the filter takes a step of torque.
        rests: (n,) what is left of a sample of a joint at rest.
    """

    def __init__(
        self,
        tree: Tree,
        base: Array,
        settings: LearnerSettings,
        filtered: Filtered,
        known: KnownArm,
    ) -> None:
        self.tree, self.effects = tree, tuple(effects_by_name(settings.effects))
        self.settings, self.each_sample = settings.theta, settings.mode == Mode.SAMPLE
        self.layout = StateLayout(tree.n, tree.floating)
        self.noise_gain, self._wrench = filtered.noise_gain, float(settings.base_wrench)
        self.smoothing_s = STEP_SMOOTHING * filtered.delay_s
        n, e = tree.n, len(self.effects)
        self.bodies = tree.bodies + 1
        self.P = 10 * self.bodies + n * e
        hand = n - 1 if known.hand is None else known.hand
        first = 10 * (int(tree.floating) + hand)
        self.hand = slice(first, first + 10)
        self.spare = slice(self._effects_from - 10, self._effects_from)
        self._parent = np.array(tree.parent, dtype=np.int64)
        self._slides = np.array(tree.slides)
        widths = [len(effect.shapes) or 1 for effect in self.effects]
        self.columns = sum(widths)
        ends = np.cumsum(widths, dtype=int).tolist()
        self.own = [slice(end - width, end) for end, width in zip(ends, widths, strict=True)]
        self.rows = rows_of(tree, self.effects)
        self.shapes = np.full((e, n), np.nan)
        self._choose_shapes(told_shapes(known.effects, settings.effects, n))
        self._rows = tuple(self.rows)  # numba takes 3 µs longer for a named tuple
        self._places = self.rows.place.copy(), self.rows.base_place.copy()
        self.share = np.where(self.rows.near < 10, 1.0, HANGING_SHARE)
        self.moments, self.newest = self.empty_moments(), self.empty_moments()
        self._forgetting = 1e-3 / (self.settings.forget_s or np.inf)  # rate per sample
        self.count, self.weight = 0.0, 1.0
        self.body_spread = np.ones(self.bodies)
        self.effect_spread = np.array([effect.learned_std for effect in self.effects])
        self.drums = np.array([x.drums(tree.slides) for x in self.effects]).reshape(e, n)
        nothing: Array = np.full((2, e, n), np.nan)
        self.believed = believed(known.effects, settings.effects, n) or tuple(nothing)
        self._set_prior(*self._neutral_prior())
        self.x, self.gradient = np.zeros((2, self.P))
        self.x[: self._effects_from] = np.tile(log_cholesky_from_theta(neutral_body()), self.bodies)
        self.x[self._effects_from :] = np.nan_to_num(self.believed[0]).ravel() / self.rows.steps
        self.mean, self.th = self.x.copy(), np.zeros(self.P)
        kernels.values(self.mean, self.rows.steps, self.th)
        tool = np.zeros(10) if known.tool_theta is None else np.array(known.tool_theta)
        self._given = tuple(kernels.Given(base, tool, np.array([hand]), self.th))
        self._work = np.zeros(self.P), np.zeros(self.P)
        self.updates = 0
        usual = REAL_MODEL_ERROR if self.effects else IDEAL_MODEL_ERROR
        error = self.settings.model_error
        self.model_variance = (usual if error is None else error) ** 2
        self.floor, self.floor_count = np.full(n, self.model_variance), 1.0
        self.spare_in_use = False
        self.rests = np.ones(n)
        self._weigh_rests(np.square(self.effect_spread[:, None] * self.drums).ravel())

    @property
    def _effects_from(self) -> int:
        return 10 * self.bodies

    def _neutral_prior(self) -> tuple[Array, Array]:
        """Information of the prior: bodies and effects; the spare body waits without one."""
        std = np.full(self.P, np.inf)
        std[: self.spare.start] = np.outer(self.body_spread[:-1], PRIOR_STD).ravel()
        told = np.isfinite(self.believed[0])
        spread = np.where(told, self.believed[1], self.effect_spread[:, None] * self.drums)
        std[self._effects_from :] = spread.ravel()
        mean = np.zeros(self.P)
        mean[: self.spare.start] = np.tile(neutral_body(), self.bodies - 1)
        mean[self._effects_from :] = np.nan_to_num(self.believed[0]).ravel()
        information = 1.0 / std**2
        return np.diag(information), information * mean

    def effect_columns(self, table: Array) -> Array:
        """(m, c, n) columns of the effects for states (m, size), or their `before_links`."""
        at = self.layout.signals(table, self.smoothing_s)
        out = np.empty((len(table), self.columns, self.tree.n))
        for k, column in enumerate(x for effect in self.effects for x in effect.basis(at)):
            out[:, k] = column
        return out

    def torque_per_unit(self, at: JointSignals) -> list[Array]:
        """Torques (m, n) per unit of each effect's parameter, by signals (m, n)."""
        pairs = zip(self.effects, self.shapes, strict=True)
        return [effect.torque_per_unit(at, shape) for effect, shape in pairs]

    def empty_moments(self) -> kernels.Moments:
        """Moments of no samples, to be filled by `absorb` and put in place by `replace_moments`."""
        widths = self.rows.sizes + 1
        A = np.zeros(int((widths * (widths + 1) // 2).sum()))
        floating = int(self.tree.floating)
        C = np.zeros((2 * floating, len(self.rows.near), len(self.rows.base_place) + 1))
        level = np.zeros(6 * floating), np.array([0.0, 2000.0])  # samples it spans
        return kernels.Moments(A, C, *level, np.zeros(self.tree.n))

    def absorb(self, frames: tuple[Array, Array], table: Array) -> Array:
        """Add samples to the moments.

        Args:
            frames: R0 (n, 3, 3) and p (n, 3) to build the regressor with.
            table: (m, size) states, or their columns `before_links`.

        Returns:
            (m, rows) errors of the parameters in use, before: measured minus predicted torque,
            the base's wrench first if it floats.
        """
        error = self._absorb(frames, table, self.moments, self.weight)
        if self.each_sample:
            A, C = self.newest[:2]
            A[:], C[:] = 0.0, 0.0
            self._absorb(frames, table[-1:], kernels.Moments(A, C, *_NO_LEVEL, _NOTHING))
        self.count += self.weight * len(table)
        return error

    def absorb_again(
        self, frames: tuple[Array, Array], table: Array, into: kernels.Moments
    ) -> None:
        """Add samples seen before to other moments, see `replace_moments`."""
        self._absorb(frames, table, kernels.Moments(into.A, into.C, *_NO_LEVEL, into.counts))

    def errors(self, frames: tuple[Array, Array], table: Array) -> Array:
        """Torque errors (m, rows) of the parameters in use; nothing is learned."""
        nowhere = kernels.Moments(_NOTHING, self.moments.C[:0], *_NO_LEVEL, _NOTHING)
        return self._absorb(frames, table, nowhere)

    def _absorb(
        self, frames: tuple[Array, Array], table: Array, into: kernels.Moments, weight: float = 1.0
    ) -> Array:
        columns, placed = self.effect_columns(table), (self._parent, *frames, self._slides)
        sums = tuple(into), self._forgetting, weight, self.rests
        return kernels.absorb(placed, self._rows, self._given, table, columns, sums)

    def replace_moments(self, moments: kernels.Moments, count: float) -> None:
        """Put moments rebuilt with a better λ in place of the old ones.

        What was folded into the prior at a change cannot be rebuilt; it counts half from here on.
        """
        self.moments.A[:], self.moments.C[:], self.count = moments.A, moments.C, count
        self.moments.counts[:] = moments.counts
        if self.spare_in_use:
            neutral, neutral_rhs = self._neutral_prior()
            self._set_prior(0.5 * (self.prior + neutral), 0.5 * (self.prior_rhs + neutral_rhs))

    def _set_prior(self, H: Array, rhs: Array) -> None:
        full = H != 0.0
        some = full.any(axis=1)
        first, last = full.argmax(axis=1), len(H) - full[:, ::-1].argmax(axis=1)
        # first and one behind the last column that is not zero, of each row
        self._ranges = np.stack([np.where(some, first, 0), np.where(some, last, 0)], axis=1)
        self.prior, self.prior_rhs = H, rhs
        self._before = tuple(kernels.Prior(H, rhs, self._ranges, 1.0))

    def parts(self, frames: tuple[Array, Array], settled: bool) -> tuple[Any, ...]:
        """What `steps` needs of it; `settled` as for `after_step`."""
        s = self.settings
        into = tuple(self.moments), self._forgetting, self.weight, self.rests
        span = float(s.settled_average if settled else s.average)
        counts = self.moments.counts
        weighing = counts, self.noise_gain, self.floor, self.floor_count, self.model_variance
        return (
            (self._parent, *frames, self._slides),
            self._rows,
            self._given,
            into,
            self._before,
            (*weighing, self.base_weights(), self.share),
            self.x,
            self.mean,
            self.th,
            (*self._work, self.gradient),
            self.in_use,
            max(span, 1.0),
            self.updates,
        )

    def steady(self) -> bool:
        """Whether every state is one step, with nothing to start or restart at any of them."""
        if self.spare_in_use:
            return self.count > max(self.settings.restarts, default=0)
        return self.count >= self.settings.warm_up

    def compute_gradient(self) -> bool:
        """Fill the gradient of one ADAM step; False while there is too little to step on."""
        if self.count < self.settings.warm_up and not self.spare_in_use:
            self.gradient[:] = 0.0
            return False
        data, counts = self.moments[:2], self.moments.counts
        floor, floor_count, least = self.floor, self.floor_count, self.model_variance
        prior = self._before
        if self.each_sample:  # plain squared error of the newest sample, priors next to none
            data, counts = self.newest[:2], np.ones(self.tree.n)
            floor, floor_count = np.ones_like(floor), 1e9
            H, rhs = 1e-6 * self.prior, 1e-6 * self.prior_rhs
            prior = tuple(kernels.Prior(H, rhs, self._ranges, 1e-6))
        base = self.base_weights()
        weighing = counts, self.noise_gain, floor, floor_count, least, base, self.share
        out = *self._work, self.gradient
        kernels.gradient(self.x, self._rows, data, prior, weighing, out)
        return True

    def base_weights(self) -> Array:
        """(2,) weight of the base's force and moment rows: 1 / their running squared error.

        Zero where the wrench is not known.
        """
        if not self.tree.floating:
            return _NOTHING
        square = self.moments.base_level.reshape(2, 3).mean(axis=1)
        return self._wrench / (self.noise_gain * (square + self.model_variance))

    def restart_spare(self) -> None:
        """Put the spare body to the hand plus the point mass that fits the data best.

        Nothing happens where that is no possible body (a load was taken away, say).
        """
        spare, link = self.spare, self.th[self.hand]
        H, rhs = self.information()
        th = self.th.copy()
        th[spare] = link
        at = np.arange(spare.start, spare.start + 4)
        mass, *moment = np.linalg.solve(H[np.ix_(at, at)], rhs[at] - H[at] @ th)
        if mass < 0.01:  # kg; below it the start after a change is the link as it was
            return
        centre = np.array(moment) / mass
        load = theta_from_body(mass, centre, mass * 0.03**2 * np.eye(3))  # m, of gyration
        if min_eigenvalue(link + load) <= 0.0:
            return
        self.x[spare] = self.mean[spare] = log_cholesky_from_theta(link + load)
        kernels.values(self.mean, self.rows.steps, self.th)
        self.updates = 0

    def after_step(self, settled: bool, samples: float = 1.0) -> None:
        """Carry the running mean along after ADAM has moved x, once for so many samples."""
        self.updates += 1
        s = self.settings
        span = max((s.settled_average if settled else s.average) / samples, 1.0)
        kernels.follow(self.x, float(min(self.updates, span)), self.rows.steps, self.mean, self.th)

    def variance(self, th: Array | None = None) -> Array:
        """(n,) variance that weighs each joint: its residual's plus the model error's, (N m)².

        The residual is that of the parameters in use, or of others, th (P,).
        """
        cost = kernels.joint_costs(self._rows, self.th if th is None else th, self.moments.A)
        own = (cost + self.floor_count * self.floor) / (self.moments.counts + self.floor_count)
        return np.asarray(own + self.model_variance)

    def joint_moments(self, j: int, A: Array | None = None) -> Array:
        """(S + 1, S + 1) moments of joint j's row [y, tau]; `rows.place[j, :S]` are its columns.

        Args:
            A: of other moments than the present ones, see `Moments`.
        """
        moments = self.moments.A if A is None else A
        return np.asarray(kernels.unfolded(moments, self.rows.starts[j], self.rows.sizes[j] + 1))

    def information(self) -> tuple[Array, Array]:
        """All that is known of (θ, effects): information matrix (P, P) and right side (P,).

        That of a floating base is what its wrench tells when the links are what they are now.
        """
        H, rhs = self.data_information(self.moments.A, self.weights())
        H, rhs = H + self.prior, rhs + self.prior_rhs
        if self.tree.floating:
            wrench = self._base_information()
            H[:10, :10] += wrench[:, :10]
            rhs[:10] += wrench[:, -1] - wrench[:, 10:-1] @ self.th[self.rows.base_place[10:]]
        return H, rhs

    def told_before(self) -> tuple[Array, Array]:
        """Information (P, P), right side (P,) of data from before the last change at the hand."""
        neutral, neutral_rhs = self._neutral_prior()
        return self.prior - neutral, self.prior_rhs - neutral_rhs

    def data_information(self, A: Array, weights: Array) -> tuple[Array, Array]:
        """(P, P) and (P,) of what joints' torques alone tell.

        Args:
            A: see `Moments`.
            weights: (n,) of a sample of each joint, see `weights`.
        """
        H, rhs = np.zeros((self.P, self.P)), np.zeros(self.P)
        kernels.add_information(self._rows, A, weights, H, rhs)
        return H, rhs

    def costs(self, th: Array, A: Array) -> Array:
        """(n,) sums of squared torque errors of parameters th (P,) over the samples in A."""
        return np.asarray(kernels.joint_costs(self._rows, th, A))

    def weights(self) -> Array:
        """(n,) information of a sample of each joint's torque, 1/(N m)²."""
        return np.asarray(1.0 / (self.noise_gain * self.variance()))

    def _base_information(self) -> Array:
        """(10, 10 (n + 1) + 1) information of the base's wrench: base by [base, links, wrench]."""
        return np.einsum("h,hab->ab", self.base_weights(), self.moments.C[:, :10])

    def adapt_prior(self, motion_noise: Array | None = None) -> None:
        """Let the data say how wide the prior is, of bodies and of effects, and of what shape.

        `motion_noise` (n,) is the variance, (N m)², that noise of the measured motion puts on
        the model's torque, where that is known.
        """
        self._look_at_shapes()
        if motion_noise is not None:
            self._look_at_rates(motion_noise)
        diagonal = self.covariance().diagonal()
        self._adapt_bodies(diagonal)
        self._adapt_effects(diagonal)
        self._weigh_rests(diagonal[self._effects_from :])

    def _adapt_bodies(self, diagonal: Array) -> None:
        """Let the data say how heavy each body may be; the prior only ever gets wider.

        A humanoid's torso of 80 kg is no link of an arm. What data show of a body (variances below
        half of the prior's) says how far from the neutral body it is.
        """
        if self.spare_in_use:
            return
        at = np.arange(self.spare.start)
        x = (self.least_squares()[at].reshape(-1, 10) - neutral_body()) / PRIOR_STD
        variance = diagonal[at].reshape(-1, 10) / PRIOR_STD**2
        before = self.body_spread[:-1]
        pulled = variance / before[:, None] ** 2  # share of the prior in what is known
        shown = pulled < 0.5
        away = np.where(shown, x / np.maximum(1.0 - pulled, 0.5), 0.0)  # as data alone have it
        square = np.sum(away**2, axis=1) / np.maximum(shown.sum(axis=1), 1)
        spread = np.clip(np.sqrt(square), before, 100.0)  # times the prior's
        more = np.outer(1.0 / spread**2 - 1.0 / before**2, 1.0 / PRIOR_STD**2).ravel()
        self.prior[at, at] += more
        self.prior_rhs[at] += more * np.tile(neutral_body(), len(spread))
        self.body_spread[:-1] = spread

    def _adapt_effects(self, diagonal: Array) -> None:
        """Let the data say how large each effect is: the spread of its prior follows.

        Empirical Bayes, see `likely_spread`. An effect that is not there fades away, instead of
        taking a share of the data for itself; and where none is left, the model is trusted as
        that of an ideal arm. What a model told of keeps the spread that the model gave it.
        """
        if not self.effects:
            return
        n = self.tree.n
        variance = diagonal[self._effects_from :].reshape(-1, n) / self.drums**2
        widest = np.array([effect.learned_std for effect in self.effects])
        values, free = self.effect_values / self.drums, np.isnan(self.believed[0])
        ends = zip(self.rows.share, self.rows.sizes, strict=True)
        shares = [share[size - self.columns : size] for share, size in ends]
        first = [own.start for own in self.own]
        # whether an effect acts at all; of one that does not no data speak
        acting = np.add.reduceat(np.array(shares), first, axis=1).T > 0.0
        told = zip(values, variance, free, acting, self.effect_spread, strict=True)
        found = [
            likely_spread(x[f & on], v[f & on], before) if (f & on).any() else before * f.any()
            for x, v, f, on, before in told
        ]
        spread = np.clip(found, SMALLEST_SPREAD * widest, widest)
        at = np.arange(self._effects_from, self.P)
        change = np.repeat(1.0 / spread**2 - 1.0 / self.effect_spread**2, n)
        change /= self.drums.ravel() ** 2
        self.prior[at, at] += np.where(free.ravel(), change, 0.0)
        self.effect_spread[:] = spread
        if self.settings.model_error is None:
            size = np.sqrt(np.mean(values**2 + variance, axis=1))
            real = bool((np.where(free.all(axis=1), spread, size) > REAL_EFFECT).any())
            self.model_variance = (REAL_MODEL_ERROR if real else IDEAL_MODEL_ERROR) ** 2

    def _weigh_rests(self, variance: Array) -> None:
        """What is left of a sample of a joint at rest, by what its static friction may hold.

        That is one unknown value a rest, of which a second's samples tell as much as one that is
        known no better; `variance` (e n,) is of the effects' parameters.
        """
        squares = np.square(self.effect_values) + variance.reshape(len(self.effects), self.tree.n)
        held, own = AT_REST**2 * self.banded(squares), self.variance()
        self.rests[:] = own / (own + held / MEMORY_S[0])  # a second has so many independent ones

    def _choose_shapes(self, shapes: Array | None) -> None:
        """Let effects act with shapes (e, n) from now on; with their first where there are none."""
        for k, effect in enumerate(self.effects):
            if effect.shapes:
                told = np.full(self.tree.n, np.nan) if shapes is None else shapes[k]
                self.shapes[k] = np.where(np.isfinite(told), told, effect.shapes[FIRST_SHAPE])
        for effect, shape, own in zip(self.effects, self.shapes, self.own, strict=True):
            for j, size in enumerate(self.rows.sizes if effect.shapes else ()):
                begin = size - self.columns
                at = slice(begin + own.start, begin + own.stop)
                self.rows.share[j, at] = effect.shares(shape)[:, j]

    def _look_at_shapes(self) -> None:
        """Choose shapes anew where others explain all samples better, whatever the rest is then.

        With all other parameters integrated out a joint's columns k of an effect have information
        S and right side y; a parameter that acts through them with shares s then explains
        (s·y)² / s·S s, which is compared over a grid of shapes.
        """
        if not any(effect.shapes for effect in self.effects):
            return
        known, weights = self._known_of_all(), self.weights()
        chosen = self.shapes.copy()
        for k, effect in enumerate(self.effects):
            if not effect.shapes:
                continue
            grid = np.geomspace(effect.shapes[0], effect.shapes[-1], SHAPES_TRIED)
            for j in range(self.tree.n):
                S, y = self._reduced(j, k, weights[j], known)
                tried = np.r_[self.shapes[k, j], grid]
                s = effect.shares(tried).T
                gain = np.maximum(s @ y, 0.0) ** 2 / np.einsum("ga,ab,gb->g", s, S, s)
                if gain.max() > gain[0] + SHAPE_EVIDENCE:
                    chosen[k, j] = tried[gain.argmax()]
        self._choose_shapes(chosen)

    def _look_at_rates(self, motion_noise: Array) -> None:
        """Let effects of the torque's rates act where they explain more than noise of motion can.

        Noise of ddq is in the model's torque and, with the other sign, in its second rate: without
        anything there the one takes off what the other puts on, and is learned for that.
        """
        known, weights = self._known_of_all(), self.weights()
        for k, effect in enumerate(self.effects):
            for j, size in enumerate(self.rows.sizes if effect.by_rates else ()):
                S, y = self._reduced(j, k, weights[j], known)
                told = weights[j] * max(self.moments.counts[j], 1.0)
                explained = float(y[0] ** 2 / max(S[0, 0], TINY)) / told
                there = explained > RATES_OVER_NOISE * motion_noise[j] + REAL_MODEL_ERROR**2
                self.rows.share[j, size - self.columns + self.own[k].start] = float(there)
                if not there:
                    own = self._effects_from + k * self.tree.n + j
                    self.x[own] = self.mean[own] = 0.0
        kernels.values(self.mean, self.rows.steps, self.th)

    def _reduced(
        self, j: int, k: int, weight: float, known: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """(K, K) and (K,) information of joint j's columns of effect k, all else integrated out.

        Args:
            weight: of a sample of the joint's torque; known: see `_known_of_all`.
        """
        size, own = self.rows.sizes[j], self._effects_from + k * self.tree.n + j
        (covariance, mean), begin = known, size - self.columns
        split = begin + np.arange(self.own[k].start, self.own[k].stop)
        moments = weight * self.joint_moments(j)
        G, b = moments[np.ix_(split, split)], moments[split, -1]
        rest = np.delete(np.arange(size), split)
        across = np.zeros((self.P, len(split)))
        shared = self.rows.share[j, rest, None] * moments[np.ix_(rest, split)]
        np.add.at(across, self.rows.place[j, rest], shared)
        # what the rest tells, but for the effect's own parameter, which stands for its columns
        self_too, variance = covariance[own] @ across, covariance[own, own]
        G_rest = across.T @ covariance @ across - np.outer(self_too, self_too) / variance
        return G - G_rest, b - (mean @ across - self_too * mean[own] / variance)

    def _known_of_all(self) -> tuple[Array, Array]:
        """Covariance (P, P) and mean (P,) of all parameters by torques and prior alone."""
        H, rhs = self.information()
        covariance = self._inverse_of(H)
        return covariance, covariance @ rhs

    def _inverse_of(self, H: Array) -> Array:
        """(P, P) of information; zero for the idle spare body."""
        at, out = self.known(), np.zeros((self.P, self.P))
        out[np.ix_(at, at)] = np.linalg.inv(H[np.ix_(at, at)])
        return out

    def known(self) -> NDArray[np.intp]:
        """Indices of the parameters that have any information (the idle spare body has none)."""
        idle = np.zeros(self.P, dtype=bool)
        idle[self.spare] = not self.spare_in_use
        return np.flatnonzero(~idle)

    def least_squares(self) -> Array:
        """(P,) the batch solution on all samples so far, with the same prior, unconstrained."""
        H, rhs = self.information()
        at = self.known()
        out = self.th.copy()
        out[at] = np.linalg.solve(H[np.ix_(at, at)], rhs[at])
        if self.tree.floating:  # the base again, for these links
            links = self.rows.base_place[10:]
            other = rhs[:10] - self._base_information()[:, 10:-1] @ (out - self.th)[links]
            out[:10] = np.linalg.solve(H[:10, :10], other)
        return out

    def covariance(self) -> Array:
        """(P, P) covariance of (θ, effects); zero for the idle spare body."""
        H, _ = self.information()
        out = self._inverse_of(H)
        if self.tree.floating:
            follows = self._base_follows(H)
            across = follows @ out
            out[:10, :10] += across @ follows.T
            out[:10, 10:] = across[:, 10:]
            out[10:, :10] = across[:, 10:].T
        return out

    def _base_follows(self, H: Array) -> Array:
        """(10, P): a floating base takes the opposite of what the links are off."""
        follows = np.zeros((10, self.P))
        links = self.rows.base_place[10:]
        follows[:, links] = -np.linalg.solve(H[:10, :10], self._base_information()[:, 10:-1])
        return follows

    def told_by_data(self) -> Array:
        """(10 bodies, 10 bodies) information on θ in use that is the data's, whatever the effects.

        The bodies' prior is left out, that of the effects counts.
        """
        H, _ = self.information()
        if self.tree.floating:
            way = -self._base_follows(H)
            way[:, :10] += np.eye(10)
            base = H[:10, :10].copy()
            H[:10, :10] = 0.0
            H += way.T @ base @ way
        used = (10 * self.in_use[:, None] + np.arange(10)).ravel()
        believed = used[used < self.spare.start]
        H[believed, believed] -= self._neutral_prior()[0][believed, believed]
        rest = np.setdiff1d(self.known(), used)
        across = H[np.ix_(rest, used)]
        known = np.linalg.solve(H[np.ix_(rest, rest)], across)
        return np.asarray(H[np.ix_(used, used)] - across.T @ known)

    @property
    def in_use(self) -> NDArray[np.intp]:
        """(bodies,) numbers of the bodies in use: the spare one in the hand's place if it is."""
        out = np.arange(self.bodies - 1)
        if self.spare_in_use:
            out[self.hand.start // 10] = self.bodies - 1
        return out

    @property
    def theta(self) -> Array:
        """(bodies, 10) inertial parameters in use, the base first if it floats; the hand's with
        whatever it carries."""
        return self.th[: self._effects_from].reshape(-1, 10)[self.in_use]

    def theta_given(self, effects: Array) -> tuple[Array, Array]:
        """The bodies in use that go with other parameters (e, n) of the effects.

        They take over what the effects say less, as far as data do not tell the two apart.

        Returns:
            θ (bodies, 10), which need not be possible, and their information (10 bodies, 10 bodies)
            where all else stands still.
        """
        H, own = self.information()[0], slice(self._effects_from, None)
        at = (10 * self.in_use[:, None] + np.arange(10)).ravel()
        less, H_own = self.th[own] - effects.ravel(), H[np.ix_(at, at)]
        bodies = self.th[at] + np.linalg.solve(H_own, H[at, own] @ less)
        return bodies.reshape(-1, 10), H_own

    @property
    def payload(self) -> tuple[Array, Array] | None:
        """What the hand carries more than before the change: θ (10,), covariance (10, 10)."""
        if not self.spare_in_use:
            return None
        cov, hand, spare = self.covariance(), self.hand, self.spare
        across = cov[hand, spare]
        own = cov[hand, hand] + cov[spare, spare] - across - across.T
        return self.th[spare] - self.th[hand], own

    @property
    def effect_values(self) -> Array:
        """(e, n) parameters of the effects."""
        return self.th[self._effects_from :].reshape(len(self.effects), self.tree.n)

    def static_friction(self, dq: Array) -> Array:
        """(m, n) N m that friction may hold otherwise where a joint is slow or rests.

        Args:
            dq: (m, n) rad/s.
        """
        return np.sqrt(self.banded(np.square(self.effect_values))) * slowness(dq)

    def banded(self, squares: Array) -> Array:
        """(n,) variance of slow joints' friction, (N m)², by squares (e, n) of the parameters."""
        return np.asarray(np.square([effect.band for effect in self.effects]) @ squares)

    def start_change(self) -> None:
        """Something at the hand changed: keep what is known, open the spare body for the rest."""
        hand, spare = self.hand, self.spare
        H, rhs = self.information()
        if self.spare_in_use:
            # information about the rest when it is integrated out; zero rows in its place
            rest = np.setdiff1d(np.arange(len(H)), np.arange(spare.start, spare.stop))
            gain = np.linalg.solve(H[spare, spare], np.c_[H[spare, rest], rhs[spare]]).T
            out, out_rhs = np.zeros_like(H), np.zeros_like(rhs)
            out[np.ix_(rest, rest)] = H[np.ix_(rest, rest)] - H[rest, spare] @ gain[:-1].T
            out_rhs[rest] = rhs[rest] - H[rest, spare] @ gain[-1]
            H, rhs = out, out_rhs
        link = np.diag(1.0 / PRIOR_STD**2)
        H[hand, hand] += link
        H[spare, spare] += link
        H[hand, spare] -= link
        H[spare, hand] -= link
        self.floor, self.floor_count = self.variance() - self.model_variance, 500.0
        self._set_prior(H, rhs)
        self.moments.A[:], self.moments.C[:], self.count = 0.0, 0.0, 0.0
        self.moments.counts[:] = 0.0
        self.x[spare] = self.mean[spare] = self.mean[hand]
        kernels.values(self.mean, self.rows.steps, self.th)
        # columns of the hand are the spare body's from here on
        places = self.rows.place, self.rows.base_place
        for place, before in zip(places, self._places, strict=True):
            moved = (before >= hand.start) & (before < hand.stop)
            place[:] = np.where(moved, before + spare.start - hand.start, before)
        self.spare_in_use = True
        self.updates = 0


_NOTHING = np.empty(0)
_NO_LEVEL = _NOTHING, _NOTHING


@jit
def likely_spread(x: Array, variance: Array, spread: float) -> float:
    """Spread under which numbers that are zero but for it are most likely, from a wider one.

    Steps of expectation maximisation: the square becomes the mean of estimate² + variance, what
    the data alone say of each number being kept. Few of them leave an absent effect a share of
    the data for seconds, since it then falls with the root of their count; where no data speak,
    the spread stays.

    Args:
        x, variance: (k,) estimates and variances under the present `spread`.
    """
    data = np.maximum(1.0 / variance - 1.0 / spread**2, 0.0)
    told, square = x / variance, spread**2
    for _ in range(50):  # at each look at how large the effects are
        variance = 1.0 / (1.0 / square + data)
        square = float(np.mean((variance * told) ** 2 + variance))
    return math.sqrt(square)


def rows_of(tree: Tree, effects: Sequence[LearnedEffect]) -> kernels.Rows:
    """Which parameters each torque row of a tree touches, those of effects beside θ."""
    n, first = tree.n, int(tree.floating)
    bodies = tree.bodies + 1
    beyond = [[k for k in range(n) if j in tree.path_to(k)] for j in range(n)]
    owner = [k for k, effect in enumerate(effects) for _ in range(len(effect.shapes) or 1)]
    sizes = np.array([10 * len(links) + len(owner) for links in beyond], dtype=np.int64)
    place = np.zeros((n, int(sizes.max())), dtype=np.int64)
    slot = np.full((n, n), -1, dtype=np.int64)
    for j, links in enumerate(beyond):
        for number, k in enumerate(links):
            slot[j, k] = 10 * number
            place[j, 10 * number : 10 * (number + 1)] = 10 * (k + first) + np.arange(10)
        place[j, 10 * len(links) : sizes[j]] = 10 * bodies + n * np.array(owner, dtype=int) + j
    triangles = (sizes + 1) * (sizes + 2) // 2
    starts = np.concatenate([[0], np.cumsum(triangles)[:-1]]).astype(np.int64)
    near: list[int] = []
    if tree.floating:
        hanging = [k + 1 for k, i in enumerate(tree.parent) if i == BASE]
        near = [10 * body + i for body in (0, *hanging) for i in range(10)]
    every = np.arange(10 * (n + 1) if tree.floating else 0)
    share = np.ones(place.shape)
    for j, size in enumerate(sizes):  # nothing is known of rates at first
        share[j, size - len(owner) : size] = [not effects[k].by_rates for k in owner]
    steps = np.array([effect.step * effect.drums(tree.slides) for effect in effects]).ravel()
    touched = np.array(near, dtype=np.int64)
    return kernels.Rows(slot, sizes, starts, place, share, every, touched, steps.astype(np.float64))
