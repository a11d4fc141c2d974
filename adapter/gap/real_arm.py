"""What comes before any search: the load, and beside it what any arm has.

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
from adapter.gap.candidates import Candidate, is_finer, slides
from adapter.gap.evidence import Carried, Moments
from adapter.gap.fit import (
    TIMING_STD_S,
    Fit,
    Model,
    Named,
    honest_covariance,
    place_of,
    refitted,
    shaped,
    under_own_noise,
    worth,
)
from adapter.gap.hand import MASSES_KG, hand_of
from adapter.gap.long_recording import LongRecording
from adapter.gap.rivals import price
from adapter.gap.scan import BELIEF
from adapter.gap.signals import Recorded, prepare
from adapter.judgement.priors import EFFECT_STD, theta_prior
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.timing import TIMING_SHARE

COULOMB, OFFSET = CATALOGUE["coulomb_friction"], CATALOGUE["torque_offset"]
BRISTLES = CATALOGUE["bristle_friction"]
SPRING = CATALOGUE["joint_spring"]
DRIVEN = (CATALOGUE["viscous_friction"], CATALOGUE["motor_inertia"])
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
    trial = _as_any_arm(fit.with_named(loads), joints)
    for _ in range(3):
        found, known = under_own_noise(trial)
        fitting = [e if e.assumed else fitting_way(fit, e) for e in found.named]
        if list(map(_way, fitting)) == list(map(_way, trial.named)):
            break
        trial = fit.with_named(fitting)
    return RealArm(found, known, len(loads))


def as_driven(fit: Fit, joints: Sequence[int], first: Sequence[Named]) -> Fit:
    """A fit with these effects first, and beside them friction, motors and offsets at zero.

    Gearboxes rub much more than a Panda's joints, so that it counts how soon a joint slides:
    Coulomb friction is beside that of bristles. Beside springs gravity would not tell the gains.

    Args:
        joints: (from 0) that move.
    """
    fit = _beside(fit.with_named(first), joints, DRIVEN)
    at_once = [_assumed(fit, COULOMB, j) for j in joints]
    return fit.with_named([*fit.named, *at_once])


def load_in(fit: Fit, recording: int | None) -> Named:
    """A load at zero in a recording, or in all where None."""
    return replace(_named(HELD, fit.model.hand.templates()[1], -1), recording=recording)


def with_a_load(fit: Fit) -> tuple[Named, ...]:
    """A load in the first recording, then what may be beside it in every joint, at zero."""
    return _beside(fit.with_named([load_in(fit, 0)]), range(fit.n)).named


def fitting_way(fit: Fit, load: Named) -> Named:
    """A load, looked for as one of about its mass."""
    mass = max(float(load.x[0]), 0.1)  # kg
    way = min(range(len(MASSES_KG)), key=lambda k: abs(float(np.log(mass / MASSES_KG[k]))))
    template = fit.model.hand.templates()[way]
    return replace(load, candidate=replace(load.candidate, template=template))


def _way(e: Named) -> tuple[str, tuple[float, ...]]:
    return e.candidate.template.label, tuple(e.candidate.template.prior_std)


def start(fit: Fit, joints: Sequence[int]) -> Fit:
    """What a search starts from: all that any arm has, and the loads that are there.

    None of it is dropped for being weak: what all offsets together leave open of a load's mass,
    they would leave to the inertias alone.

    Args:
        fit: the nominal model on the recordings, with their loads where these are known already.
        joints: (from 0) that move.
    """
    if fit.named:
        begun = under_own_noise(_as_any_arm(fit, joints))[0]
    else:
        every = range(len(fit.recordings))
        arm = real_arm(fit, joints, every)
        there = [k for k in every if arm.is_there(k)]
        begun = (arm if len(there) == arm.loads else real_arm(fit, joints, there)).fit
    begun = begun.with_noise()
    while True:  # without what came out as no arm has it: friction that drives, a sensor ahead
        begun, _ = refitted(begun)
        kept = [e for e in begun.named if e.possible]
        if len(kept) == len(begun.named):
            break
        begun = begun.with_named(kept)
    begun = usually_shaped(begun)
    return begun.with_named([e for e in begun.named if e.possible])


def usually_shaped(fit: Fit) -> Fit:
    """A fit in which what any arm has is of the shape (bristles of the way) that data like best.

    Beside a simpler form by name it would take that one's place.
    """
    for k in range(len(fit.named)):
        own, *others = fit.named[k].candidate, *(e.candidate for e in fit.without(k).named)
        if fit.named[k].assumed and not any(is_finer(own, other) for other in others):
            fit = shaped(fit, k)
    return fit


def _named(effect: Effect, template: Template, joint: int) -> Named:
    """An effect at zero, to be fitted."""
    return Named(Candidate(effect, template, joint, ()), np.zeros(len(template.prior_std)))


def _assumed(fit: Fit, effect: Effect, joint: int) -> Named:
    """An effect that any arm has, of its usual size (`priors`, or as its template says)."""
    template = effect.templates()[1 if effect is BRISTLES else 0]  # bristles of a Panda
    if effect.name in EFFECT_STD:
        std = EFFECT_STD[effect.name], *[1e-3] * (len(template.prior_std) - 1)  # N m/rad
        template = replace(template, prior_std=std)
    named, on_slide = _named(effect, template, joint), slides(fit.model.arm, joint)
    if on_slide:
        own = replace(named.candidate, template=effect.on_sliding(template), slides=True)
        named = replace(named, candidate=own)
    return replace(named, assumed=True)


def _beside(fit: Fit, joints: Sequence[int], moving: Sequence[Effect] = (*DRIVEN, SPRING)) -> Fit:
    """With dry friction and offsets of all torques and what joints (from 0) that move have."""
    own = [
        _assumed(fit, effect, j)
        for effects, where in (((BRISTLES, OFFSET), sorted(fit.heard)), (moving, joints))
        for effect in effects
        for j in where
    ]
    return fit.with_named([*fit.named, *own])


def _as_any_arm(fit: Fit, joints: Sequence[int]) -> Fit:
    """The same, with what the whole arm has: a filter of its torques, a table that is not level."""
    fit = _beside(fit, joints)
    whole = [_assumed(fit, CATALOGUE[name], -1) for name in ("torque_filter", "base_tilt")]
    return fit.with_named([*fit.named, *whole])
