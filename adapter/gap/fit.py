"""The model as it stands: nominal, its small inertial corrections, and the effects named so far.

Everything is refitted together and exactly: Gauss and Newton on the torque that the stages of
`adapter.effects.torque` predict, with the inertias held to their prior and noise with a memory.
`Model` is what predicts, and remembers what it predicted; `Fit` adds priors and noise.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from adapter.effects.active import WHOLE, Active
from adapter.effects.base import ArmDynamics, SensorEffect, TorqueEffect
from adapter.effects.catalogue import LATENESS
from adapter.effects.law import Curve
from adapter.effects.torque import added, sensors
from adapter.gap.candidates import Candidate, Pattern, Stages, stages_of
from adapter.gap.evidence import Carried, Moments, Noise, Score, noise_of
from adapter.gap.hand import ANYWHERE, Hand
from adapter.gap.signals import Signals
from adapter.model.spatial import Array

TIMING_STD_S = 2.5e-4  # half a sample of hold, two of these, is no effect of the arm
STEP = 0.01  # of a coefficient's prior, for differences
EDGE_S = 0.06  # a change takes so long, and its date is no better known
BLOCK = 25  # samples: errors of the model last so long, noise does not
DATE_REACHES_S, DATE_REACH = (0.06, 0.02, 0.008), 3  # steps in which a date is sought; how many
SHAPE_STEPS = (1.25, 1.08, 1.03)  # factors by which a nonlinear setting is changed
WIDER = 2.0  # than what any arm has: what may have a name beside it


@dataclass(frozen=True, eq=False)
class Named:
    """An effect that has been named.

    Attributes:
        candidate: what and where; x: (k,) its coefficients.
        interval_s: when; recording: in which one, None in all.
        assumed: whether any arm has it: it stays in the model, and is told by name where it is
            worth it.
        tried: keys of the effects that were tried in its place, and gave way to it.
    """

    candidate: Candidate
    x: Array
    interval_s: tuple[float, float] = WHOLE
    recording: int | None = None
    assumed: bool = False
    tried: frozenset[tuple[str, int]] = frozenset()

    @property
    def is_pattern(self) -> bool:
        """Whether it has neither a name nor a law."""
        return isinstance(self.candidate.effect, Pattern)

    @property
    def is_curve(self) -> bool:
        """Whether it is free enough to stand for an effect."""
        return isinstance(self.candidate.effect, Pattern | Curve)

    @property
    def values(self) -> dict[str, Any]:
        """Its parameters."""
        return self.candidate.template.decode(self.x)

    @property
    def possible(self) -> bool:
        """Whether physics allows its parameters."""
        return self.candidate.possible(self.x, self.interval_s)

    def covers(self, candidate: Candidate) -> bool:
        """Whether a candidate is no more than it: what any arm has is small, a name need not be."""
        own, other = self.candidate.prior_std[0], candidate.prior_std[0]
        return self.candidate.key == candidate.key and not (self.assumed and other > WIDER * own)

    def active(self) -> Active:
        """As the model uses it."""
        c = self.candidate
        return Active(c.effect, c.joint, self.values, self.interval_s)

    def at(self, x: Array) -> Named:
        """With other coefficients."""
        return replace(self, x=x)

    def gate(self, t: Array) -> Array:
        """(m, 1) one where it acts, zero elsewhere."""
        begin, end = self.interval_s
        return np.asarray(((t >= begin) & (t < end)).astype(float)[:, None])


@dataclass(frozen=True, eq=False)
class Model:
    """A nominal arm with corrections and effects, on recordings.

    It never changes: what it predicts is computed once and kept.

    Attributes:
        recordings: as the search sees them; their arm is the nominal one.
        dtheta: (n, 10) correction of the nominal inertias.
        delay_s: by how much torques are late, within the timing of a sample.
        named: effects named so far.
        known: effects that the nominal model has already.
        hand: where a load is.
    """

    recordings: tuple[Signals, ...]
    dtheta: Array
    delay_s: float = 0.0
    named: tuple[Named, ...] = ()
    known: tuple[Active, ...] = ()
    hand: Hand = ANYWHERE
    _kept: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def arm(self) -> ArmDynamics:
        """With its corrections."""
        nominal = self.recordings[0].motion.arm
        return nominal.changed(nominal.theta + self.dtheta)

    @property
    def coefficients(self) -> Array:
        """All that is fitted: corrections, delay, coefficients of the named effects."""
        always = self.dtheta.ravel(), [self.delay_s]
        return np.concatenate([*always, *(e.x for e in self.named)])

    def at(self, x: Array) -> Model:
        """The same model with other coefficients."""
        size = self.dtheta.size
        named, k = [], size + 1
        for e in self.named:
            named.append(e.at(x[k : k + len(e.x)]))
            k += len(e.x)
        dtheta = x[:size].reshape(self.dtheta.shape)
        return replace(self, dtheta=dtheta, delay_s=float(x[size]), named=tuple(named))

    def actives(self, recording: int, but: int | None = None) -> tuple[Active, ...]:
        """Effects at work in a recording, the timing's error among them; one may be left out."""
        own = [*self.known]
        for k, e in enumerate(self.named):
            if k != but and e.recording in (None, recording):
                own.append(e.active())
        own.append(Active(LATENESS, -1, {"d": self.delay_s}))
        return tuple(own)

    def _once(self, key: Hashable, compute: Callable[[], Any]) -> Any:
        if key not in self._kept:
            self._kept[key] = compute()
        return self._kept[key]

    def stages(self, recording: int) -> Stages:
        """What it predicts stage by stage, at the motion's rate."""
        own = self.recordings[recording]
        made: Stages = self._once(
            ("stages", recording), lambda: stages_of(own, self.actives(recording), self.arm)
        )
        return made

    def predicted(self, recording: int) -> Array:
        """(k, n) torque in the band, N m."""
        own, key = self.recordings[recording], ("low", recording)
        return np.asarray(self._once(key, lambda: own.low(self.stages(recording).sensed)))

    def residual(self, recording: int) -> Array:
        """(k, n) measured less predicted, N m; zero where nothing was measured."""
        own = self.recordings[recording]
        return own.heard * (own.tau - self.predicted(recording))

    def residuals(self) -> list[Array]:
        """Of every recording."""
        return [self.residual(i) for i in range(len(self.recordings))]

    def contribution(self, recording: int, place: int) -> Array:
        """(k, n) what a named effect adds to the torque in the band, N m."""
        key = ("contribution", recording, place)
        return np.asarray(self._once(key, lambda: self._contribution(recording, place)))

    def _contribution(self, recording: int, place: int) -> Array:
        e, own = self.named[place], self.recordings[recording]
        if e.recording not in (None, recording):
            return np.zeros_like(own.tau)
        at, others = self.stages(recording), self.actives(recording, but=place)
        if isinstance(e.candidate.effect, TorqueEffect):  # bodies and motion stay as they are
            alone = added(at.links, at.rigid, (e.active(),)) - at.rigid
            return own.low(at.sensed - sensors(at.links, at.total - alone, others))
        if isinstance(e.candidate.effect, SensorEffect):
            return own.low(at.sensed - sensors(at.links, at.total, others))
        return own.low(at.sensed - stages_of(own, others, self.arm).sensed)

    def signatures(self, recording: int) -> Array:
        """(c, k, n) change of the torque per unit of each coefficient, where they are."""
        made = self._once(("signatures", recording), lambda: self._signatures(recording))
        return np.asarray(made)

    def _signatures(self, recording: int) -> Array:
        own, at = self.recordings[recording], self.stages(recording)
        tables = [at.low_regressor(), -own.low(own.motion.rate(at.sensed))[None]]
        for place, e in enumerate(self.named):
            if e.recording not in (None, recording):
                tables.append(np.zeros((len(e.x), *own.tau.shape)))
            elif isinstance(e.candidate.effect, TorqueEffect):
                tables.append(self.torque_slopes(e, at))
            elif e.candidate.columns_are_theta:
                link = e.candidate.joint if e.candidate.joint >= 0 else len(self.dtheta) - 1
                gate = None if e.interval_s == WHOLE else e.gate(at.links.t)
                tables.append(np.tensordot(e.candidate.theta, at.low_regressor(link, gate), 1))
            else:
                tables.append(self._slopes(recording, place))
        return np.concatenate(tables)

    def torque_slopes(self, e: Named, at: Stages) -> Array:
        """(c, k, n) change of an added torque per unit of each of its coefficients.

        Those of an effect that hangs on the measured motion alone are the same in every fit.
        """
        effect, template = e.candidate.effect, e.candidate.template
        if effect.by_load or not (template.linear and at.unmoved):  # type: ignore[attr-defined]
            return self._torque_differences(e, at)
        shape = repr(template.decode(e.candidate.prior_std))
        key = "slopes", e.candidate.key, shape, e.interval_s
        return at.signals.once(key, lambda: self._torque_differences(e, at))

    def _torque_differences(self, e: Named, at: Stages) -> Array:
        effect, decode, joint = e.candidate.effect, e.candidate.template.decode, e.candidate.joint
        assert isinstance(effect, TorqueEffect)
        links = at.links
        if np.isfinite(e.interval_s[0]):
            links = replace(links, t=links.t - e.interval_s[0])
        torque = effect.torque(links, at.rigid, joint, decode(e.x))
        gate, out = e.gate(at.links.t), []
        for i, std in enumerate(e.candidate.prior_std):
            x = e.x.copy()
            x[i] += STEP * std
            moved = effect.torque(links, at.rigid, joint, decode(x))
            out.append(at.signals.low_on((moved - torque) / (STEP * std) * gate, joint))
        return np.array(out)

    def _slopes(self, recording: int, place: int) -> Array:
        """(c, k, n) change of the whole torque per unit of each coefficient of an effect."""
        e, own, out = self.named[place], self.recordings[recording], []
        at = self.stages(recording)
        for i, std in enumerate(e.candidate.prior_std):
            x = e.x.copy()
            x[i] += STEP * std
            other = replace(self, named=(*self.named[:place], e.at(x), *self.named[place + 1 :]))
            if isinstance(e.candidate.effect, SensorEffect):  # what they read stays as it is
                sensed = sensors(at.links, at.total, other.actives(recording))
            else:
                sensed = other.stages(recording).sensed
            out.append(own.low((sensed - at.sensed) / (STEP * std)))
        return np.array(out)


@dataclass(frozen=True, eq=False)
class Fit:
    """A model under noise and priors.

    Attributes:
        model: that is fitted.
        prior: (n, 10) standard deviation of the nominal inertias.
        noise: one model per recording.
        timing_std_s: how far the torques' timing may be off without being an effect.
        doubts: (k, n) variance beside the noise, N^2 m^2, per recording: what named effects may be
            otherwise, infinite where rows count for nothing; empty where all count alike.
    """

    model: Model
    prior: Array
    noise: tuple[Noise, ...] = ()
    timing_std_s: float = TIMING_STD_S
    doubts: tuple[Array, ...] = ()

    @property
    def recordings(self) -> tuple[Signals, ...]:
        """As the search sees them."""
        return self.model.recordings

    @property
    def named(self) -> tuple[Named, ...]:
        """Effects named so far."""
        return self.model.named

    @property
    def dtheta(self) -> Array:
        """(n, 10) correction of the nominal inertias."""
        return self.model.dtheta

    @property
    def coefficients(self) -> Array:
        """All that is fitted."""
        return self.model.coefficients

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.dtheta)

    @property
    def heard(self) -> set[int]:
        """Joints (from 0) whose torque is measured in some recording."""
        return {
            j for own in self.recordings for j in np.flatnonzero(own.heard.any(axis=0)).tolist()
        }

    @property
    def is_linear(self) -> bool:
        """Whether the predicted torque is linear in all coefficients (a delay of 1 ms is)."""
        return all(
            (isinstance(e.candidate.effect, TorqueEffect) and e.candidate.template.linear)
            or e.candidate.columns_are_theta
            for e in self.named
        )

    @property
    def prior_std(self) -> Array:
        """Of the coefficients."""
        own = [e.candidate.prior_std for e in self.named]
        return np.concatenate([self.prior.ravel(), [self.timing_std_s], *own])

    def at(self, x: Array) -> Fit:
        """The same with other coefficients."""
        return replace(self, model=self.model.at(x))

    def with_named(self, named: Sequence[Named]) -> Fit:
        """The same with these effects."""
        return replace(self, model=replace(self.model, named=tuple(named)))

    def without(self, place: int) -> Fit:
        """The same without one of its effects."""
        return self.with_named(self.named[:place] + self.named[place + 1 :])

    def instead(self, place: int, other: Named) -> Fit:
        """The same with another effect in the place of one."""
        return self.with_named((*self.named[:place], other, *self.named[place + 1 :]))

    @cached_property
    def weights(self) -> tuple[Array, ...]:
        """(k, n) or (n,) share of its noise in what a row may be off by, per recording."""
        none = (np.zeros(self.n),) * len(self.noise)
        parts = zip(self.noise, self.doubts or none, strict=True)
        return tuple(own.level / np.sqrt(own.level**2 + doubt) for own, doubt in parts)

    def noise_of(self, left: Sequence[Array]) -> tuple[Noise, ...]:
        """Noise that what is left (k, n), N m, of each recording shows where it counts.

        What an effect leaves where its equation is an idealisation, friction where it turns round,
        is that one's, and is no noise elsewhere; but where next to no row is certain, all that is
        left says as much as one row that is.
        """
        sliding = [own.sliding for own in self.recordings]
        if not (self.doubts and self.noise):
            return tuple(map(noise_of, left, sliding))
        out = []
        for x, rows, weight in zip(left, sliding, self.weights, strict=True):
            certain, every = noise_of(x, rows * weight**2), noise_of(x, rows * (weight > 0.0))
            told, one = np.sum(rows * weight**4, axis=0), every.memory
            square = (told * certain.level**2 + one * every.level**2) / (told + one)
            out.append(replace(certain, level=np.sqrt(square)))
        return tuple(out)

    def own_noise(self) -> tuple[Noise, ...]:
        """Noise that its residuals show."""
        return self.noise_of(self.model.residuals())

    def noise_beside(self, known: Carried) -> tuple[Noise, ...]:
        """Noise that its residuals show, and that its coefficients have fitted away (Bessel).

        Of a motion of some seconds as many rows are independent as there are coefficients.
        """
        shares = np.sum(known.N * known.solved(known.N.T).T, axis=0)  # that each row decided
        ends = np.cumsum([own.tau.size for own in self.recordings])[:-1]
        out = []
        parts = zip(self.recordings, self.own_noise(), self.weights, strict=True)
        for (own, noise, weight), share in zip(parts, np.split(shares, ends), strict=True):
            rows = np.maximum(np.sum(own.sliding * weight**2, axis=0) / noise.memory, 1.0)
            fitted = np.minimum(share.reshape(own.tau.shape).sum(axis=0) / rows, 0.5)  # at most
            out.append(replace(noise, level=noise.level / np.sqrt(1.0 - fitted)))
        return tuple(out)

    def with_noise(self, noise: Sequence[Noise] | None = None) -> Fit:
        """The same under another noise model; that of its own residuals where None is given."""
        fit = replace(self, doubts=tuple(self._doubt(i) for i in range(len(self.recordings))))
        return replace(fit, noise=fit.own_noise() if noise is None else tuple(noise))

    def _doubt(self, recording: int) -> Array:
        """Rows count less where a named effect is strong, for its equation is an idealisation.

        They don't count at all around its start and end: nobody picks up a load in no time.
        """
        own = self.recordings[recording]
        out = np.zeros_like(own.tau)
        for k, e in enumerate(self.named):
            if e.recording not in (None, recording):
                continue
            if e.candidate.effect.inexact:
                out += unsure(self.model, recording, k) ** 2
            for edge in e.interval_s:
                out[(own.t > edge - EDGE_S) & (own.t < edge + EDGE_S)] = np.inf
        return out

    def whiten(self, tables: Sequence[Array]) -> Array:
        """Tables (..., k, n), one per recording, white and in one row each (..., r)."""
        parts = zip(self.recordings, self.noise, self.weights, tables, strict=True)
        white = [noise.whiten(x) * (own.heard * weight) for own, noise, weight, x in parts]
        flat = [x.reshape(*x.shape[:-2], -1) for x in white]
        return flat[0] if len(flat) == 1 else np.concatenate(flat, axis=-1)

    def carried(self) -> Carried:
        """What is carried along when further effects are sought, about the present model."""
        model = self.model
        N = self.whiten([model.signatures(i) for i in range(len(self.recordings))])
        data = self.whiten(model.residuals()) + self.coefficients @ N
        return Carried(N, self.prior_std, data)


def under_own_noise(fit: Fit) -> tuple[Fit, Carried]:
    """A fit under the noise that it leaves itself, and what is known of its coefficients."""
    fit, known = refitted(fit.with_noise())
    return refitted(fit.with_noise(fit.noise_beside(known)))


def unsure(model: Model, recording: int, place: int) -> Array:
    """(k, n) by how much a named effect's torque may be otherwise in truth, N m."""
    effect, own = model.named[place].candidate.effect, model.recordings[recording]
    torque, (back, ahead) = model.contribution(recording, place), (4, 2)  # rows around a jump
    size, shift = back + ahead + 1, (back - ahead) // 2
    # how much it changes around each instant
    jumps = maximum_filter1d(torque, size, axis=0, origin=shift)
    jumps -= minimum_filter1d(torque, size, axis=0, origin=shift)
    band = effect.band * np.abs(torque).max(axis=0) * own.slowness
    edge = 0.3 if isinstance(effect, TorqueEffect) else 0.0  # friction turns more softly
    return np.asarray(np.hypot(band, np.hypot(effect.inexact * torque, edge * jumps)))


def honest_covariance(fit: Fit, known: Carried | Moments) -> Array:
    """Of all coefficients: by the noise, and no less than by what seconds of the log disagree.

    What a model gets wrong does not average out as noise does. The information of the rows is
    replaced by the spread of the gradients of whole seconds (White 1980, by clusters).
    """
    plain = known.covariance()
    if isinstance(known, Moments):
        seconds = known.seconds
    else:
        white = known.data - known.x @ known.N
        ends = np.cumsum([len(s.tau) * s.tau.shape[1] for s in fit.recordings])
        cuts = [np.arange(a, b, BLOCK * fit.n) for a, b in pairwise([0, *ends])]
        scores = np.add.reduceat(known.N * white, np.concatenate(cuts), axis=1)
        seconds = scores @ scores.T
    robust = plain @ (seconds + np.diag(known.prior_std**-2.0)) @ plain
    wider = np.sqrt(np.maximum(np.diagonal(robust) / np.diagonal(plain), 1.0))
    return plain * np.outer(wider, wider)


def worth(fit: Fit, carried: Carried | Moments, place: int) -> Score:
    """Evidence of one of the named effects, what is carried with it eliminated."""
    return carried.worth(*beside(fit, place))


def beside(fit: Fit, place: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of a named effect, and those that are carried along when it is judged.

    These are all others; but an effect of the catalogue need not pay beside curves, which
    could stand for it.
    """
    own = place_of(fit, place)
    left_out = [own]
    if not fit.named[place].is_curve:
        left_out += [place_of(fit, k) for k, e in enumerate(fit.named) if e.is_curve]
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


def dated(fit: Fit, place: int) -> Fit:
    """A named effect with the start (and end) that the data like best, on a grid of 8 ms.

    All rows count here, those around the dates above all.
    """
    fit = replace(fit, doubts=())
    for reach in DATE_REACHES_S:
        for side in (0, 1):
            centre = fit.named[place].interval_s[side]
            if np.isfinite(centre):
                steps = range(-DATE_REACH, DATE_REACH + 1)
                trials = [_moved(fit, place, side, centre + reach * k) for k in steps]
                fit = min(trials, key=_distance)
        fit, _ = refitted(fit, 1)
    return fit


def dated_anew(fit: Fit) -> Fit:
    """With the dates of all named effects sought again: one of them has another name now."""
    fit, _ = refitted(fit)
    for k, e in enumerate(fit.named):
        if e.interval_s != WHOLE:
            fit = dated(fit, k)
    return fit


def shaped(fit: Fit, place: int) -> Fit:
    """A named effect with the nonlinear setting that the data like best."""
    effect = fit.named[place].candidate.effect
    if not effect.reshaped(fit.named[place].values, 1.0):
        return fit
    if isinstance(effect, TorqueEffect) and not effect.by_load:
        # its own columns are all that changes; others stay as linear as they are
        carried = fit.carried()
        best, named = carried, fit.named[place]
        for step in (3.0, *SHAPE_STEPS):  # where others stay as they are
            for other in _other_shapes(named, step):
                trial = _with_shape(fit, carried, place, other)
                if trial.g @ trial.x > best.g @ best.x:
                    best, named = trial, other
        return fit.instead(place, named).at(best.x)
    for step in SHAPE_STEPS:
        named = fit.named[place]
        trials = [fit]
        for other in _other_shapes(named, step):
            trials.append(refitted(fit.instead(place, other), 1)[0])
        fit = min(trials, key=_distance)
    return fit


def _other_shapes(named: Named, step: float) -> list[Named]:
    """A named effect with one of its settings up to two steps larger or smaller."""
    out, own = [], named.candidate
    for ratio in (step**-2, 1.0 / step, step, step**2):
        for template in own.effect.reshaped(named.values, ratio):
            template = replace(template, prior_std=own.template.prior_std)
            out.append(replace(named, candidate=replace(own, template=template)))
    return out


def between(fit: Fit, place: int, value: float, step: float, at: Callable[[float], Named]) -> Fit:
    """A named effect with the setting near `value` that the data like best, up to a fine step."""
    carried = fit.carried()
    best, named = carried, fit.named[place]
    for finer in step * 0.5 ** np.arange(1, 7):  # each half of the one before
        for other in (value - finer, value + finer):
            trial = _with_shape(fit, carried, place, at(other))
            if trial.g @ trial.x > best.g @ best.x:
                best, named, value = trial, at(other), other
    return fit.instead(place, named).at(best.x)


def _with_shape(fit: Fit, carried: Carried, place: int, other: Named) -> Carried:
    """What is known where a named effect's columns are those of another shape."""
    N = carried.N.copy()
    slopes = [
        fit.model.torque_slopes(other, fit.model.stages(i))
        if other.recording in (None, i)
        else np.zeros((len(other.x), *x.tau.shape))
        for i, x in enumerate(fit.recordings)
    ]
    N[place_of(fit, place)] = fit.whiten(slopes)
    return Carried(N, carried.prior_std, carried.data)


def lost_at_once(fit: Fit, carried: Carried, place: int) -> float:
    """By how much less a fit explains (chi2) if bristles wind up over no way."""
    named = fit.named[place]
    *_, at_once = named.candidate.effect.reshaped(named.values, 0.0)
    other = replace(named, candidate=replace(named.candidate, template=at_once))
    trial = _with_shape(fit, carried, place, other)
    return float(carried.g @ carried.x - trial.g @ trial.x)


def _moved(fit: Fit, place: int, side: int, t: float) -> Fit:
    own = fit.named[place]
    begin, end = own.interval_s
    return fit.instead(place, replace(own, interval_s=(t, end) if side == 0 else (begin, t)))


def _distance(fit: Fit) -> float:
    """Squared distance, in units of the noise, with what the coefficients cost."""
    return distance_of(fit, fit.model.residuals())


def distance_of(fit: Fit, left: Sequence[Array]) -> float:
    """The same where a fit leaves `left` (k, n), N m, of each recording."""
    white = fit.whiten(left)
    return float(white @ white + np.sum((fit.coefficients / fit.prior_std) ** 2))
