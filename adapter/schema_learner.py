"""Learning λ, the body schema: ADAM on the moments of eqs. 8a-8c (eq. 18), joint by joint.

Each joint frame moves in its own tangent (turn phi about its axes, shift d), so no angle triple
has a singular place to start from or pass through; λ is read off the frame. Three cares beside
plain ADAM, each a consequence of the moments being there:

- each channel's noise level is profiled (weight = 1 / its own residual variance);
- when it is judged what the data show, the noise of measured parent motion is taken out of the
  moments, where it would pass for excitation;
- a step is kept out of directions the data do not show: those stay where they started;
- a step is at most as long as a share of the distance to the optimum, which the curvature
  tells: full speed at first, no spikes later.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import SettingsError
from adapter.filters import THIRD_DIFFERENCE_GAIN
from adapter.records import MOTION_DOCUMENTED, MOTION_MEASURED, Array, StateLayout, stamps_of
from adapter.schema_kernels import (
    DERIVATIVES,
    absorb,
    descend,
    distances,
    profiled,
    residual_variance,
    retract,
    steepest,
    without_noise,
)
from adapter.spatial import exp_rotation, matrix_from_zxz, zxz_from_matrix
from adapter.tree import Tree

NOISE_FLOOR = 1e-4  # m/s, rad/s, m/s²: below any sensor; keeps noise-free data from infinite weight
MISFIT_FLOOR = 1e-6  # share of a signal's power that no weight looks below while the fit is rough

PURE_SHIFT = 0.05  # share of turns below which an unshown direction is a shift alone


@dataclass(frozen=True)
class SchemaSettings:
    """How λ is learned.

    Attributes:
        rate: ADAM's longest step per sample, rad and m.
        share: longest step as a share of the distance to the optimum.
        sample_rate: ADAM's rate in mode `sample`.
        start_rms: spread of the random starting λ, rad and m.
        forget_s: time constant of the forgotten window in moving samples x 1 ms; None keeps all.
        judge_every: updates between two looks at curvature and identifiability.
        rotation_goal, position_goal: std and remaining distance below which λ has converged.
        stable_updates: for how many updates in a row that must hold.
    """

    rate: float = 1.5e-2
    share: float = 0.15
    sample_rate: float = 1e-3
    start_rms: float = 0.01
    forget_s: float | None = None
    judge_every: int = 10
    rotation_goal: float = 0.005
    position_goal: float = 0.0025
    stable_updates: int = 200

    def __post_init__(self) -> None:
        for name in ("rate", "share", "sample_rate", "start_rms", "judge_every"):
            if not getattr(self, name) > 0:
                raise SettingsError(f"schema.{name} must be above zero, got {getattr(self, name)}")
        if self.forget_s is not None and self.forget_s < 0.05:
            raise SettingsError(f"schema.forget_s must be at least 0.05 s, got {self.forget_s}")


class SchemaLearner:
    """λ of every joint, its uncertainty and what of it the data show.

    Args:
        tree: N and A; nothing else of the robot is known.
        base: (12,) motion of the base, as the documentation has it.
        noise_gain: correlated samples that one independent sample is worth, for synthesized
            (filtered) motion; measured motion is white.
        seed: of the random start.
        measured_base: (12,) the same where link motion was measured; `base` where None.

    Attributes:
        R0 (n, 3, 3), p (n, 3): the frames; `lam` reads λ off them.
        tangent, gradient: (n, 6) what ADAM steps on (zero between steps), and its gradient.
        information: (n, 6, 6) of (phi, d), eigen-directions in `project`.
        identifiable: (n, 6, 6) projector on the directions the data show.
        rank: their number over all joints.
        converged: whether λ has settled (see SchemaSettings).
    """

    def __init__(
        self,
        tree: Tree,
        base: Array,
        settings: SchemaSettings | None = None,
        *,
        mode: str = "moments",
        noise_gain: float = 1.0,
        seed: int = 0,
        measured_base: Array | None = None,
    ) -> None:
        n = tree.n
        self.settings, self.mode = settings or SchemaSettings(), mode
        self.layout = StateLayout(n)
        self._parent = np.array(tree.parent, dtype=np.int64)
        self._base, self._measured_base = base, base if measured_base is None else measured_base
        self._noise_gain = noise_gain
        rng = np.random.default_rng(seed)
        start = self.settings.start_rms * rng.normal(size=(n, 6))
        self.R0 = np.ascontiguousarray(exp_rotation(start[:, :3]))
        self.p = np.ascontiguousarray(start[:, 3:])
        self.start_lam = self.lam
        self.kind = 0  # of link motion, taken from the first sample that has one
        self.M = np.zeros((n, 3, 15, 15))
        self._clean, self._newest = np.zeros_like(self.M), np.zeros_like(self.M)
        self.noise_power, self.last_motion = np.zeros((n, 3)), np.zeros((3, n, 12))
        self.last_stamps = np.array([0, 2**62])
        self.counts = np.zeros(3)
        self.updates = 0
        self.tangent, self.gradient = np.zeros((n, 6)), np.zeros((n, 6))
        self._H, self._distance = np.zeros((n, 6, 6)), np.zeros(n)
        self._everything = np.tile(np.eye(6), (n, 1, 1))
        self.information = np.zeros((n, 6, 6))
        self.identifiable = np.zeros((n, 6, 6))
        self._inverse = np.zeros((n, 6, 6))
        self.rank = 0
        self._calm = 0
        self.converged = False

    @property
    def lam(self) -> Array:
        """λ (n, 6): [α β γ p]."""
        return np.concatenate([zxz_from_matrix(self.R0), self.p], axis=1)

    def set_lam(self, lam: Array) -> None:
        """Start from a given λ (n, 6), e.g. a checkpoint's."""
        self.R0[:] = matrix_from_zxz(lam[:, :3])
        self.p[:] = lam[:, 3:]

    @property
    def count(self) -> float:
        """Samples in the moments (fewer where some were forgotten)."""
        return float(self.counts[0])

    def absorb(self, table: Array) -> None:
        """Add a table (m, size) of filtered states to the moments."""
        at = self.layout
        if self.kind != MOTION_MEASURED:
            newest = int(table[0, 1] if len(table) == 1 else table[:, 1].max())
            if newest == MOTION_MEASURED:
                self._begin(MOTION_MEASURED)
            self.kind = newest or self.kind
        keep = 1.0
        if self.settings.forget_s is not None:
            keep = self._keep()
        absorb(
            self._parent,
            self._measured_base if self.kind == MOTION_MEASURED else self._base,
            stamps_of(table),
            table[:, 1],
            table[:, at.motion_q],
            table[:, at.motion_dq],
            table[:, at.motion].reshape(len(table), -1, 12),
            float(self.kind),
            keep,
            self.M,
            self._newest,
            self.noise_power,
            self.last_motion,
            self.last_stamps,
            self.counts,
        )

    def _begin(self, kind: int) -> None:
        """Learn from this kind of motion from here on; what came of another is forgotten."""
        self.kind = kind
        self.M[:], self.noise_power[:], self.counts[:] = 0.0, 0.0, 0.0
        self._calm, self.converged = 0, False

    def _keep(self) -> float:
        """Forgetting factor per sample; one while the window would lose what it shows."""
        window = self.settings.forget_s * 1e3 if self.settings.forget_s else np.inf
        return 1.0 - 1.0 / window if self.count >= 0.9 * window and self._excited() else 1.0

    def _excited(self) -> bool:
        """Whether the newest sample moves every joint that the moments know about."""
        fresh = np.abs(self._newest[:, 0, 3:6, 3:6]).max(axis=(1, 2))
        held = np.abs(self.M[:, 0, 3:6, 3:6]).max(axis=(1, 2)) / max(self.count, 1.0)
        return bool((fresh >= 1e-2 * held).all())

    def noise_variance(self) -> Array:
        """(n, 3) noise variance of measured v, w, a of each link; zero where synthesized.

        From third differences, which jerky motion can exceed; so at most half of what the fit
        leaves of v, w and a, the other half being the child's own noise.
        """
        if self.kind != MOTION_MEASURED or self.counts[1] < 50:
            return np.zeros_like(self.noise_power)
        found = self.noise_power / (THIRD_DIFFERENCE_GAIN * self.counts[1])
        left = np.empty((len(found), 3))
        residual_variance(self.M, self.count, DERIVATIVES, self.R0, self.p, left)
        for j, i in enumerate(self._parent):
            if i >= 0:
                found[i] = np.minimum(found[i], 0.5 * left[j, [1, 0, 2]])
        return found

    def compute_gradient(self) -> None:
        """Fill `gradient` for one ADAM step; looks at the curvature now and then."""
        looking = self.updates % self.settings.judge_every == 0
        self.updates += 1
        if looking:
            self._profile()
            self._judge()
        if self.mode == "sample":
            steepest(self._newest, DERIVATIVES, self.R0, self.p, self.gradient, self._H)
        elif looking:
            distances(self._inverse, self.count, self.gradient, self._distance)
        else:
            descend(
                self.M,
                self.count,
                DERIVATIVES,
                self.R0,
                self.p,
                NOISE_FLOOR,
                MISFIT_FLOOR,
                self._inverse,
                self.gradient,
                self._H,
                self._distance,
            )

    def apply_step(self, rate: float) -> None:
        """Move the frames by ADAM's step in `tangent`, taken at `rate`, and zero it."""
        s = self.settings
        if self.mode == "sample":
            unlimited = np.full(len(self.p), np.inf)
            frames = self._everything, self.R0, self.p
            retract(self.tangent, unlimited, s.sample_rate, 1.0, rate, *frames)
        else:
            frames = self.identifiable, self.R0, self.p
            retract(self.tangent, self._distance, s.rate, s.share, rate, *frames)

    def _profile(self) -> None:
        """Fill the gradient from the moments as they are (noise in them bends λ by 1e-4 of its
        size), and the curvature from what of them is motion."""
        clean = self.M
        if self.kind == MOTION_MEASURED:
            clean = self._clean
            without_noise(self._parent, self.M, self.count, self.noise_variance(), clean)
        profiled(
            self.M,
            clean,
            self.count,
            DERIVATIVES,
            self.R0,
            self.p,
            NOISE_FLOOR,
            MISFIT_FLOOR,
            True,
            self.gradient,
            self._H,
        )

    def _judge(self) -> None:
        """Which directions the data show, how far the optimum is, whether λ has settled."""
        gain = self._noise_gain if self.kind == MOTION_DOCUMENTED else 1.0
        self.information[:] = self._H / gain
        values, vectors = np.linalg.eigh(self._H)
        # noise alone makes eigenvalues of the size sqrt(count); 400 is a std of 0.05 rad or m
        shown = values > max(400.0, 10.0 * np.sqrt(self.count))
        kept = vectors * shown[:, None, :]
        self.identifiable[:] = kept @ kept.transpose(0, 2, 1)
        safe = np.where(shown, values, 1.0)
        self._inverse[:] = (kept / safe[:, None, :]) @ kept.transpose(0, 2, 1)
        rank = int(shown.sum())
        distance = np.abs(np.einsum("jab,jb->ja", self._inverse, self.gradient))
        std = np.sqrt(np.einsum("jaa->ja", self._inverse) * gain)
        goal = np.repeat([self.settings.rotation_goal, self.settings.position_goal], 3)
        calm = rank > 0 and rank == self.rank and bool((np.maximum(distance, std) < goal).all())
        self._calm = self._calm + self.settings.judge_every if calm else 0
        self.rank = rank
        self._hold_unshown()
        self.converged = self._calm >= self.settings.stable_updates

    def _hold_unshown(self) -> None:
        """Put shifts that the data do not show back to where they started.

        Steps keep out of such directions, but while noise still tilts the picture of what is
        shown, a little leaks into them.
        """
        for j in range(len(self.p)):
            unshown = np.eye(6) - self.identifiable[j]
            if np.abs(unshown[:3, 3:]).max() < PURE_SHIFT:
                self.p[j] -= unshown[3:, 3:] @ (self.p[j] - self.start_lam[j, 3:])

    def covariance(self) -> Array:
        """(n, 6, 6) covariance of (phi, d) in the directions the data show, zero in others."""
        gain = self._noise_gain if self.kind == MOTION_DOCUMENTED else 1.0
        return gain * self._inverse
