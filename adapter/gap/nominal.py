"""The model as it was given, on recordings: where every fit begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.effects.active import active_effects
from adapter.gap.fit import TIMING_STD_S, Fit, Model
from adapter.gap.hand import hand_of
from adapter.gap.long_recording import LongRecording
from adapter.gap.signals import Recorded, prepare
from adapter.judgement.priors import theta_prior
from adapter.model.self_model import SelfModel
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.timing import TIMING_SHARE


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
