"""How θ is learned, and what is believed of a link before any data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import SettingsError

# Prior: what a link of an arm may well be. Neutral body, and standard deviations around it.
NEUTRAL_MASS = 1.0  # kg
NEUTRAL_INERTIA = 0.02  # kg m², about every axis
PRIOR_STD = np.array([5.0, *[0.5] * 3, *[0.3] * 6])  # kg, kg m, kg m²

REAL_MODEL_ERROR, IDEAL_MODEL_ERROR = 0.025, 0.001  # N m
# An effect of this size in its unit (N m, N m s/rad, kg m²) is that of a real arm; one whose spread
# has fallen to this share of what it may be is not there.
REAL_EFFECT, SMALLEST_SPREAD = 0.05, 1e-3

# A step of friction that has gone through the filter looks like tanh over this share of its delay
# (fitted on simulated reversals; 1 for a tanh as wide as the delay).
STEP_SMOOTHING = 0.6

SMALLEST_LOAD = 0.01  # kg; below it the start after a change is the link as it was
LOAD_RADIUS = 0.03  # m; of gyration of a load whose inertia is not known yet


@dataclass(frozen=True)
class ThetaSettings:
    """How θ is learned.

    Attributes:
        rate: ADAM's rate per sample on the log-Cholesky parameters.
        settled_rate: the same once θ has converged: smaller steps, no spikes.
        betas: ADAM's averaging constants.
        average: samples that the reported running mean spans.
        settled_average: the same once θ has converged.
        restarts: samples after a change at which the spare body is put to the point mass that
            fits best so far; ADAM refines it from there.
        warm_up: samples in the moments before the first step.
        forget_s: time constant of directional forgetting in moving samples x 1 ms; None: none.
        model_error: torque that the model is not trusted to explain, N m; no weight looks below
            it. None: 0.025 where friction or another effect is found (a real arm, whose friction
            no such model explains better), 0.001 else.
        sample_rate: ADAM's rate in mode `sample`.
    """

    rate: float = 3e-3
    settled_rate: float = 1e-3
    betas: tuple[float, float] = (0.97, 0.99)
    average: int = 100
    settled_average: int = 30
    restarts: tuple[int, ...] = (50, 100, 200, 400)
    warm_up: int = 50
    forget_s: float | None = None
    model_error: float | None = None
    sample_rate: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("rate", "settled_rate", "average", "settled_average", "sample_rate"):
            if not getattr(self, name) > 0:
                raise SettingsError(f"theta.{name} must be above zero, got {getattr(self, name)}")
        if len(self.betas) != 2 or not all(0.0 <= beta < 1.0 for beta in self.betas):
            raise SettingsError(f"theta.betas must be two numbers in [0, 1), got {self.betas}")
        if self.forget_s is not None and self.forget_s < 0.5:
            raise SettingsError(f"theta.forget_s must be at least 0.5 s, got {self.forget_s}")
