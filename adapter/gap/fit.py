"""The model as it stands: nominal, its small inertial corrections, and the effects named so far.

Everything is refitted together and exactly: Gauss and Newton on the torque that the stages of
`adapter.torque` predict, with the inertias held to their prior and the noise coloured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from adapter.effects import CATALOGUE
from adapter.effects.active import WHOLE, Active
from adapter.effects.base import Motion, TorqueEffect
from adapter.gap.candidates import Candidate
from adapter.gap.evidence import Carried, Score, score
from adapter.gap.noise import LEAST_NM, ORDER, Noise, noise_of
from adapter.gap.signals import Signals
from adapter.records import Array
from adapter.rigid_arm import RigidArm
from adapter.torque import bodies, moved_links, sensed_torque

TIMING_STD_S = 4e-4  # half a sample of hold is no effect of the arm
STEP = 0.01  # of a coefficient's prior, for differences
EDGE = 0.3  # of a jump: friction turns round more softly than its equation
JUMP_ROWS = (4, 2)  # before and after a row, in which a jump concerns it
EDGE_S = 0.06  # a change takes so long, and its date is no better known
BAND_HZ = 25.0  # samples a second
LIGHT_KG, SMALL_M = 0.1, 0.05
SPREAD = 0.25  # a parameter of zero may be off by the share of so much of its kind's size


@dataclass(frozen=True, eq=False)
class Named:
    """An effect that has been named.

    Attributes:
        candidate: what and where; x: (k,) its coefficients.
        interval_s: when; recording: in which one, None in all.
    """

    candidate: Candidate
    x: Array
    interval_s: tuple[float, float] = WHOLE
    recording: int | None = None

    @property
    def is_pattern(self) -> bool:
        """Whether it has no name in the catalogue."""
        return self.candidate.effect.name not in CATALOGUE

    @property
    def values(self) -> dict[str, Any]:
        """Its parameters."""
        return self.candidate.template.decode(self.x)

    def active(self) -> Active:
        """As the model uses it."""
        c = self.candidate
        return Active(c.effect, c.joint, self.values, self.interval_s)

    def at(self, x: Array) -> Named:
        """With other coefficients."""
        return replace(self, x=x)


def theta_prior(theta: Array, share: float) -> Array:
    """(n, 10) standard deviation of inertial parameters that are known to a `share` of their size.

    A parameter that happens to be near zero is no better known than its like: to its own size a
    quarter of its kind's (mass, first moment, mean moment of inertia) is added, and no body is
    lighter than 0.1 kg or smaller than 5 cm for that.
    """
    kind = np.empty_like(theta)
    kind[:, 0] = theta[:, 0]
    mass = np.maximum(theta[:, :1], LIGHT_KG)
    kind[:, :1] = mass
    first, second = np.linalg.norm(theta[:, 1:4], axis=1), theta[:, [4, 7, 9]].mean(axis=1)
    kind[:, 1:4] = np.maximum(first[:, None], SMALL_M * mass)
    kind[:, 4:] = np.maximum(np.abs(second)[:, None], SMALL_M**2 * mass)
    return np.asarray(share * np.hypot(theta, SPREAD * kind))


@dataclass(frozen=True, eq=False)
class Fit:
    """A model fitted to recordings.

    Attributes:
        recordings: as the search sees them; their arm is the nominal one.
        prior: (n, 10) standard deviation of the nominal inertias.
        noise: one model per recording.
        dtheta: (n, 10) correction of the nominal inertias.
        delay_s: by how much torques are late, within the timing of a sample.
        named: effects named so far.
        known: effects that the nominal model has already.
        still: joints (from 0) that stand, per recording: their friction takes whatever torque
            there is.
        timing_std_s: how far the torques' timing may be off without being an effect.
        weights: (k, n) by which white rows count, per recording; empty where all count alike.
    """

    recordings: tuple[Signals, ...]
    prior: Array
    noise: tuple[Noise, ...]
    dtheta: Array
    delay_s: float = 0.0
    named: tuple[Named, ...] = ()
    weights: tuple[Array, ...] = ()
    known: tuple[Active, ...] = ()
    still: tuple[tuple[int, ...], ...] = ()
    timing_std_s: float = TIMING_STD_S

    @property
    def arm(self) -> RigidArm:
        """With its corrections."""
        nominal = self.recordings[0].motion.arm
        return nominal.changed(nominal.theta + self.dtheta)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.recordings[0].motion.arm.n

    @property
    def is_linear(self) -> bool:
        """Whether the predicted torque is linear in all coefficients (a delay of 1 ms is)."""
        return all(
            isinstance(e.candidate.effect, TorqueEffect) or e.candidate.columns_are_theta
            for e in self.named
        )

    def without_patterns(self) -> Fit:
        """With the effects of the catalogue alone."""
        return replace(self, named=tuple(e for e in self.named if not e.is_pattern))

    def actives(self, recording: int) -> tuple[Active, ...]:
        """Effects at work in a recording, the timing's error among them."""
        own = [*self.known]
        own += [e.active() for e in self.named if e.recording in (None, recording)]
        own.append(Active(CATALOGUE["signal_delay"], -1, {"d": self.delay_s}))
        return tuple(own)

    def signals(self, recording: int) -> Signals:
        """A recording with the corrected arm."""
        own = self.recordings[recording]
        return replace(own, motion=replace(own.motion, arm=self.arm))

    def predicted(self, recording: int) -> Array:
        """(k, n) torque in the band."""
        own = self.signals(recording)
        return own.low(sensed_torque(own.motion, self.actives(recording)))

    def residual(self, recording: int) -> Array:
        """(k, n) measured less predicted, N m."""
        return self.recordings[recording].tau - self.predicted(recording)

    def with_noise(self, noise: Sequence[Noise] | None = None) -> Fit:
        """The same under another noise model; that of its own residuals where None is given."""
        if noise is None:
            noise = [noise_of(r, LEAST_NM) for r in self.residuals()]
        fit = replace(self, noise=tuple(noise))
        return replace(fit, weights=tuple(fit._weights(i) for i in range(len(fit.recordings))))

    def _weights(self, recording: int) -> Array:
        """Rows count less where a named effect is strong, for its equation is an idealisation.

        They don't count at all around its start and end: nobody picks up a load in no time.
        """
        own, level = self.recordings[recording], self.noise[recording].level
        weight = np.ones_like(own.tau)
        if self.still:
            weight[:, self.still[recording]] = 0.0
        for k, e in enumerate(self.named):
            if e.recording not in (None, recording):
                continue
            if e.candidate.effect.inexact:
                torque = self.contribution(recording, k)
                unsure = np.hypot(e.candidate.effect.inexact * torque, EDGE * _jumps(torque))
                weight /= np.sqrt(1.0 + (unsure / level) ** 2)
            for edge in e.interval_s:
                after = EDGE_S + ORDER / BAND_HZ
                weight[(own.t > edge - EDGE_S) & (own.t < edge + after)] = 0.0
        return weight

    def contribution(self, recording: int, place: int) -> Array:
        """(k, n) what a named effect adds to the torque in the band, N m."""
        others = self.named[:place] + self.named[place + 1 :]
        return self.predicted(recording) - replace(self, named=others).predicted(recording)

    def residuals(self) -> list[Array]:
        """Of every recording."""
        return [self.residual(i) for i in range(len(self.recordings))]

    def whiten(self, tables: Sequence[Array]) -> Array:
        """Tables (..., k, n), one per recording, white and in one row each (..., r)."""
        white = [noise.whiten(x) for noise, x in zip(self.noise, tables, strict=True)]
        if self.weights:
            white = [x * w[ORDER:] for x, w in zip(white, self.weights, strict=True)]
        return np.concatenate([x.reshape(*x.shape[:-2], -1) for x in white], axis=-1)

    @property
    def coefficients(self) -> Array:
        """All that is fitted: corrections, delay, coefficients of the named effects."""
        return np.concatenate([self.dtheta.ravel(), [self.delay_s], *(e.x for e in self.named)])

    @property
    def prior_std(self) -> Array:
        """Of the coefficients."""
        own = [e.candidate.prior_std for e in self.named]
        return np.concatenate([self.prior.ravel(), [self.timing_std_s], *own])

    def at(self, x: Array) -> Fit:
        """The same model with other coefficients."""
        size = self.dtheta.size
        named, k = [], size + 1
        for e in self.named:
            named.append(e.at(x[k : k + len(e.x)]))
            k += len(e.x)
        dtheta = x[:size].reshape(self.dtheta.shape)
        return replace(self, dtheta=dtheta, delay_s=float(x[size]), named=tuple(named))

    def carried_signatures(self, recording: int) -> Array:
        """(c, k, n) change of the torque per unit of each coefficient, where they are."""
        own, effects = self.signals(recording), self.actives(recording)
        links = moved_links(own.motion, effects)
        rigid = bodies(links, effects)
        Y = links.arm.regressor(links.q, links.dq, links.ddq)
        total = sensed_torque(own.motion, effects)
        tables = [np.moveaxis(own.low(Y), 2, 0), -own.low(own.motion.rate(total))[None]]
        for place, e in enumerate(self.named):
            shape = (len(e.x), *own.tau.shape)
            if e.recording not in (None, recording):
                tables.append(np.zeros(shape))
            elif isinstance(e.candidate.effect, TorqueEffect):
                tables.append(own.low_all(self._added(e, links, rigid)))
            elif e.candidate.columns_are_theta:
                k = 10 * e.candidate.joint if e.candidate.joint >= 0 else Y.shape[2] - 10
                columns = np.moveaxis(Y[:, :, k : k + 10], 2, 0)
                tables.append(own.low_all(columns * self._gate(e, links.t)))
            else:
                changes = [self._difference(recording, place, i, total) for i in range(len(e.x))]
                tables.append(np.array(changes))
        return np.concatenate(tables)

    @staticmethod
    def _gate(e: Named, t: Array) -> Array:
        begin, end = e.interval_s
        return np.asarray(((t >= begin) & (t < end)).astype(float)[:, None])

    def _added(self, e: Named, links: Motion, rigid: Array) -> Array:
        """(c, m, n) change of an added torque per unit of each of its coefficients."""
        gate = self._gate(e, links.t)
        effect, decode = e.candidate.effect, e.candidate.template.decode
        assert isinstance(effect, TorqueEffect)
        if np.isfinite(e.interval_s[0]):
            links = replace(links, t=links.t - e.interval_s[0])
        at = effect.torque(links, rigid, e.candidate.joint, decode(e.x))
        out = []
        for i, std in enumerate(e.candidate.prior_std):
            x = e.x.copy()
            x[i] += STEP * std
            moved = effect.torque(links, rigid, e.candidate.joint, decode(x))
            out.append((moved - at) / (STEP * std) * gate)
        return np.array(out)

    def _difference(self, recording: int, place: int, i: int, total: Array) -> Array:
        e = self.named[place]
        x = e.x.copy()
        h = STEP * e.candidate.prior_std[i]
        x[i] += h
        named = [*self.named[:place], e.at(x), *self.named[place + 1 :]]
        other = replace(self, named=tuple(named))
        own = other.signals(recording)
        return own.low((sensed_torque(own.motion, other.actives(recording)) - total) / h)

    def carried(self, tables: Sequence[Array] | None = None) -> Carried:
        """What is carried along when further effects are sought, about the present model."""
        if tables is None:
            tables = [self.carried_signatures(i) for i in range(len(self.recordings))]
        N = self.whiten(tables)
        data = self.whiten(self.residuals()) + self.coefficients @ N
        return Carried(N, self.prior_std, data)


def under_own_noise(fit: Fit) -> tuple[Fit, Carried]:
    """A fit under the noise that it leaves itself, and what is known of its coefficients.

    That noise is taken from a fit that counts all frequencies alike. Taken from a fit under
    coloured noise, and again, what a model gets slightly wrong would turn into noise step by
    step, and the effect with it.
    """
    flat = [noise.flat() for noise in fit.with_noise().noise]
    fit, _ = refitted(fit.with_noise(flat))
    return refitted(fit.with_noise())


def _jumps(torque: Array) -> Array:
    """(k, n) by how much a torque (k, n) changes around each instant."""
    back, ahead = JUMP_ROWS
    size, shift = back + ahead + 1, (back - ahead) // 2
    high = maximum_filter1d(torque, size, axis=0, origin=shift)
    return np.asarray(high - minimum_filter1d(torque, size, axis=0, origin=shift))


def worth(fit: Fit, carried: Carried, place: int) -> Score:
    """Evidence of one of the named effects, what is carried with it eliminated."""
    own, rest = beside(fit, place)
    others = Carried(carried.N[rest], carried.prior_std[rest], carried.data)
    return score(*others.without(carried.N[own]), carried.prior_std[own])


def beside(fit: Fit, place: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of a named effect, and those that are carried along when it is judged.

    These are all others; but an effect of the catalogue need not pay beside patterns, which
    could stand for it.
    """
    own = place_of(fit, place)
    left_out = [own]
    if not fit.named[place].is_pattern:
        left_out += [place_of(fit, k) for k, e in enumerate(fit.named) if e.is_pattern]
    return own, np.delete(np.arange(len(fit.coefficients)), np.concatenate(left_out))


def place_of(fit: Fit, k: int) -> np.ndarray:
    """Where the coefficients of the k-th named effect are among all."""
    begin = fit.dtheta.size + 1 + sum(len(e.x) for e in fit.named[:k])
    return np.arange(begin, begin + len(fit.named[k].x))


def refitted(fit: Fit, rounds: int = 3) -> tuple[Fit, Carried]:
    """The model at its most probable coefficients, and what is known of them."""
    carried = fit.carried()
    if fit.is_linear:  # the first step is the last one
        return fit.at(carried.x), carried
    for _ in range(rounds):
        before = fit.coefficients
        fit = fit.at(carried.x)
        carried = fit.carried()
        if np.all(np.abs(carried.x - before) < 0.02 * carried.std()):
            break
    return fit, carried
