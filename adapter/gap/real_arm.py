"""What comes before any search: the load, and inertias as wrong as the data say they are.

Documented inertias are those of another unit, every joint has friction, every sensor an offset,
and the commonest thing that a model lacks is what the hand holds. All of these are fitted together
before anything rarer is looked for: one by one they would be taken for springs, pushes and delays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from adapter.effects.active import active_effects
from adapter.effects.base import Effect, Template
from adapter.effects.catalogue import CATALOGUE, HELD
from adapter.gap.candidates import Candidate
from adapter.gap.evidence import Carried, Moments, score
from adapter.gap.fit import (
    TIMING_STD_S,
    Fit,
    Model,
    Named,
    honest_covariance,
    place_of,
    refitted,
    under_own_noise,
    worth,
)
from adapter.gap.hand import MASSES_KG, hand_of
from adapter.gap.long_recording import LongRecording
from adapter.gap.rivals import price
from adapter.gap.scan import BELIEF
from adapter.gap.signals import Recorded, prepare
from adapter.judgement.priors import theta_prior
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.timing import TIMING_SHARE

BRISTLES = CATALOGUE["bristle_friction"].templates()[1]  # a Panda's
WHERE_IT_MOVES = (
    (CATALOGUE["bristle_friction"], BRISTLES),
    *(
        (CATALOGUE[name], CATALOGUE[name].templates()[0])
        for name in ("viscous_friction", "motor_inertia")
    ),
)
COULOMB, OFFSET = CATALOGUE["coulomb_friction"], CATALOGUE["torque_offset"]
# Of a real arm: what its torques lack of the motion's band, and a table that is not level
OF_THE_WHOLE = (CATALOGUE["torque_filter"], CATALOGUE["base_tilt"])
SHARES = (1.0, 2.0, 4.0, 8.0)  # times the prior of the inertias, that are tried
MADE_UP, MADE_UP_NATS = 32.0, 20.0  # times the prior of inertias that nobody measured; if so sure
LAST_SHARE = 2.5  # of the last link at most: an error of it that looks like a load is called one
OPEN_NATS = 1.5  # by which a narrower prior must be the better one to be believed
OTHER_UNIT = 4.0  # times the prior from which on these are the inertias of another unit
CAUTION = 300.0  # nats times seconds: what is rare must show the more, the shorter a log is
WAY_ROUNDS = 3
LIGHTEST_KG = 0.1
LARGER = 2.0  # times what is believed of friction: an arm that has it has larger joints
SHOWN, SURE = 2.5, 3.0  # standard deviations of its mass: a load is there if believed; anyway


def nominal_fit(
    recordings: Sequence[Recorded],
    model: SelfModel,
    inertia_prior: float,
    period_s: float,
    others: Sequence[Recorded] = (),
) -> Fit:
    """The nominal model on smoothed recordings, under the noise that it leaves.

    Args:
        inertia_prior: by which share its inertias may be off, one standard deviation.
        period_s: the longest sample period.
        others: recordings of the same motion may be among these too.
    """
    arm = RigidArm.of(model)
    every = [x for x in (*recordings, *others) if not isinstance(x, LongRecording)]
    signals = tuple(
        r.signals(arm) if isinstance(r, LongRecording) else prepare(r, arm, r.repeated_in(every))
        for r in recordings
    )
    known = active_effects(model.effects, arm.n)
    return Fit(
        Model(signals, np.zeros_like(arm.theta), known=known, hand=hand_of(model)),
        theta_prior(arm.theta, inertia_prior),
        timing_std_s=max(TIMING_STD_S, TIMING_SHARE * period_s),
    ).with_noise()


@dataclass(frozen=True, eq=False)
class RealArm:
    """All that any arm may have, fitted together.

    Attributes:
        fit: with the loads first, then friction, motor inertia and offsets.
        known: of its coefficients.
        loads: how many loads there may be, one in each of so many recordings.
    """

    fit: Fit
    known: Carried | Moments
    loads: int

    @cached_property
    def mass_std(self) -> Array:
        """(loads,) kg, one standard deviation of the loads' masses."""
        at = [place_of(self.fit, k)[0] for k in range(self.loads)]
        return np.sqrt(np.diagonal(honest_covariance(self.fit, self.known))[at])

    def value(self, k: int) -> float:
        """Nats that the k-th effect is worth, what it was worth before the data included."""
        return worth(self.fit, self.known, k).log_evidence + price(self.fit.named[k])

    def is_there(self, k: int) -> bool:
        """Whether the k-th load is."""
        shown = self.fit.named[k].x[0] / self.mass_std[k]
        return bool(shown > SURE or (shown > SHOWN and self.value(k) > BELIEF))


def real_arm(fit: Fit, joints: Sequence[int], loaded: Sequence[int]) -> RealArm:
    """The nominal model with all that any arm may have.

    Args:
        fit: the nominal model on the recordings; joints: (from 0) that move.
        loaded: recordings (from 0) in which the hand may hold something.
    """
    loads = [load_in(fit, None if len(fit.recordings) == 1 else i) for i in loaded]
    return loaded_arm(fit, joints, loads)


def loaded_arm(fit: Fit, joints: Sequence[int], loads: Sequence[Named]) -> RealArm:
    """The nominal model with these loads, and all that any arm may have; see `real_arm`."""
    trial = _beside(fit.with_named(loads), joints)
    for _ in range(WAY_ROUNDS):
        found, known = _as_wide_as_open(trial)
        fitting = [_fitting(fit, e) for e in found.named]
        if list(map(_way, fitting)) == list(map(_way, trial.named)):
            break
        trial = fit.with_named(fitting)
    return RealArm(found, known, len(loads))


def as_driven(fit: Fit, joints: Sequence[int], first: Sequence[Named]) -> Fit:
    """A fit with these effects first, and beside them friction, motors and offsets at zero.

    Gearboxes rub much more than a Panda's joints, so that it counts how soon a joint slides:
    Coulomb friction is beside that of bristles.

    Args:
        joints: (from 0) that move.
    """
    fit = _beside(fit.with_named(first), joints)
    at_once = [_assumed(COULOMB, COULOMB.templates()[0], j) for j in joints]
    return fit.with_named([*fit.named, *at_once])


def load_in(fit: Fit, recording: int | None) -> Named:
    """A load at zero in a recording, or in all where None."""
    return replace(_named(HELD, fit.model.hand.templates()[1], -1), recording=recording)


def with_a_load(fit: Fit) -> tuple[Named, ...]:
    """A load in the first recording, then what may be beside it in every joint, at zero."""
    return _beside(fit.with_named([load_in(fit, 0)]), range(fit.n)).named


def fitting_way(fit: Fit, load: Named) -> Named:
    """A load, looked for as one of about its mass."""
    mass = max(float(load.x[0]), LIGHTEST_KG)
    way = min(range(len(MASSES_KG)), key=lambda k: abs(float(np.log(mass / MASSES_KG[k]))))
    template = fit.model.hand.templates()[way]
    return replace(load, candidate=replace(load.candidate, template=template))


def _way(e: Named) -> tuple[str, tuple[float, ...]]:
    return e.candidate.template.label, tuple(e.candidate.template.prior_std)


def _fitting(fit: Fit, e: Named) -> Named:
    """An effect, looked for as one of about its size: arms are small and large."""
    if not e.assumed:
        return fitting_way(fit, e)
    own, size = np.array(e.candidate.prior_std), np.abs(e.x)
    if np.all(size < LARGER * own):
        return e
    template = replace(e.candidate.template, prior_std=tuple(map(float, np.maximum(own, size))))
    return replace(e, candidate=replace(e.candidate, template=template))


def _as_wide_as_open(fit: Fit) -> tuple[Fit, Carried]:
    """A fit with the widest prior of the inertias that its data do not speak against."""
    wide, known = under_own_noise(replace(fit, prior=_shared(fit, SHARES[-1])))
    std, worths = known.prior_std.copy(), []
    for share in (*SHARES, MADE_UP):
        std[: fit.dtheta.size] = _shared(fit, share).ravel()
        worths.append(score(known.G, known.g, std).log_evidence)
    *open_to, made_up = worths
    if made_up > max(open_to) + MADE_UP_NATS:
        return under_own_noise(replace(fit, prior=_shared(fit, MADE_UP)))
    share = SHARES[int(np.flatnonzero(np.array(open_to) > max(open_to) - OPEN_NATS)[-1])]
    return refitted(replace(wide, prior=_shared(fit, share)))


def _shared(fit: Fit, share: float) -> Array:
    """(n, 10) prior of the inertias, so many times as wide."""
    times = np.full((fit.n, 10), share)
    times[-1, : 1 if share == MADE_UP else 10] = min(share, LAST_SHARE)
    return np.asarray(times * fit.prior)


def start(fit: Fit, joints: Sequence[int]) -> Fit:
    """What a search starts from.

    That is the nominal model itself, unless the hand holds something or the inertias are those of
    another unit: then it has all that any arm may have. None of that is dropped for being weak:
    what all offsets together leave open of a load's mass, they would leave to the inertias alone.

    Args:
        fit: the nominal model on the recordings, with their loads where these are known already.
        joints: (from 0) that move.
    """
    every = range(len(fit.recordings))
    if fit.named:
        loaded = list(range(len(fit.named)))
        arm = RealArm(*_as_wide_as_open(_beside(fit, joints)), len(loaded))
    else:
        arm = real_arm(fit, joints, every)
        loaded = [k for k in every if arm.is_there(k)]
    if len(loaded) < arm.loads:
        arm = real_arm(fit, joints, loaded)
    if not loaded and not _is_another_unit(arm, fit):
        return refitted(fit)[0]
    begun = arm.fit
    if _is_another_unit(arm, fit):
        whole = [_named(effect, effect.templates()[0], -1) for effect in OF_THE_WHOLE]
        begun = begun.with_named([*begun.named, *whole])
    begun = begun.with_noise()
    while True:  # without what came out as no arm has it: friction that drives, a sensor ahead
        begun, _ = refitted(begun)
        kept = [e for e in begun.named if e.possible]
        if len(kept) == len(begun.named):
            break
        begun = begun.with_named(kept)
    seconds = sum(float(np.ptp(own.t)) for own in fit.recordings)
    caution = CAUTION / seconds if _is_another_unit(arm, fit) else 0.0
    return replace(begun, caution=caution, hand_judged=caution > 0.0)


def _is_another_unit(arm: RealArm, fit: Fit) -> bool:
    return bool(arm.fit.prior[0, 0] >= OTHER_UNIT * fit.prior[0, 0])


def _named(effect: Effect, template: Template, joint: int) -> Named:
    """An effect at zero, to be fitted."""
    return Named(Candidate(effect, template, joint, ()), np.zeros(len(template.prior_std)))


def _assumed(effect: Effect, template: Template, joint: int) -> Named:
    return replace(_named(effect, template, joint), assumed=True)


def _beside(fit: Fit, joints: Sequence[int]) -> Fit:
    """With friction and motors of joints (from 0) that move and offsets of all torques, at zero."""
    own = [_assumed(effect, way, j) for effect, way in WHERE_IT_MOVES for j in joints]
    own += [_assumed(OFFSET, OFFSET.templates()[0], j) for j in sorted(fit.heard)]
    return fit.with_named([*fit.named, *own])
