"""The online learner of a whole robot: λ, then θ, of any tree with a moving base, at 1 kHz.

Each sample adds to the moments of λ and of θ; each update is one step of torch's ADAM on both,
with the gradient that the moments of all samples hold. θ begins when λ has settled, with the
samples held until then, and its moments are rebuilt from held samples whenever λ has left the
one they were made with.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from adapter.adam import FlatAdam
from adapter.errors import ModelError, SettingsError
from adapter.learner import CONVERGED_EXCESS, JUDGE_THETA_EVERY, REBUILD_FLOOR
from adapter.records import Array
from adapter.schema_learner import SchemaSettings
from adapter.theta_settings import ThetaSettings
from adapter.tree import Tree
from adapter.tree_data import BodyMotion, TreeData
from adapter.tree_schema import TreeSchema
from adapter.tree_theta import TreeTheta

# No joint of a robot shows more; beyond, a sample is refused as a NaN is.
CAP_Q, CAP_DQ, CAP_DDQ, CAP_TAU = 1e4, 60.0, 2e4, 1e5  # rad, rad/s, rad/s², N m (and N)
CAP_MOTION = np.repeat([1e3, 60.0, 2e3, 2e4], 3)  # [v w a dw], m/s (a fall is fast), rad/s, ...
FOLLOW_EVERY = 100  # updates between two looks at whether λ has left θ's moments
JUDGE_SCHEMA_EVERY = 20  # updates; looking at 31 frames takes 0.6 ms


@dataclass(frozen=True)
class TreeSample:
    """One instant of a tree.

    Attributes:
        stamp_ns: of the sample.
        q, dq, ddq: (n,) rad, rad/s, rad/s².
        tau: (rows,) N m; with a floating base its wrench [f; m] first (zero in free fall).
        base: (12,) motion row [v w a dw] of the base in its own frame, `a` with gravity.
        links: (n, 12) the same of every link, as measured; None: λ learns nothing from this one.
    """

    stamp_ns: int
    q: Array
    dq: Array
    ddq: Array
    tau: Array
    base: Array
    links: Array | None


def motion_rows(motion: BodyMotion) -> Array:
    """Motion rows [v w a dw] (m, 12) or (m, n, 12); zero for a velocity that nothing measures."""
    v = np.zeros_like(motion.w) if motion.v is None else motion.v
    return np.concatenate([v, motion.w, motion.a, motion.dw], axis=-1)


def samples_of(
    data: TreeData, first_ns: int = 0, period_ns: int = 1_000_000
) -> Iterator[TreeSample]:
    """The samples of one trajectory, one by one, as a robot would give them."""
    base = motion_rows(data.base)
    links = None if data.links is None else motion_rows(data.links)
    for k in range(len(data)):
        yield TreeSample(
            first_ns + k * period_ns,
            data.q[k],
            data.dq[k],
            data.ddq[k],
            data.tau[k],
            base[k],
            None if links is None else links[k],
        )


@dataclass(frozen=True)
class TreeLearnerSettings:
    """How a tree is learned online.

    Attributes:
        seed: of the random start of λ.
        update_every: samples for each ADAM step; every sample joins the moments.
        held_samples: newest samples kept to rebuild θ's moments from when λ has moved.
        rebuild_rows: how many of them each sample redoes.
        rebuild_stds: by how many of its standard deviations λ may leave θ's moments.
        schema, theta: of the parts.
    """

    seed: int = 0
    update_every: int = 1
    held_samples: int = 40_000
    rebuild_rows: int = 3
    rebuild_stds: float = 3.0
    schema: SchemaSettings = field(
        default_factory=lambda: SchemaSettings(judge_every=JUDGE_SCHEMA_EVERY)
    )
    theta: ThetaSettings = field(default_factory=ThetaSettings)

    def __post_init__(self) -> None:
        if self.update_every < 1:
            raise SettingsError(f"update_every must be at least 1, got {self.update_every}")
        if self.rebuild_rows < 2:
            raise SettingsError(f"rebuild_rows must be at least 2, got {self.rebuild_rows}")
        if self.held_samples < 1000:
            raise SettingsError(f"held_samples must be at least 1000, got {self.held_samples}")


class TreeLearner:
    """Takes samples of a tree, keeps λ and θ. Deterministic; no clock, no I/O.

    Args:
        tree: N and A; the networks are built from them alone.
        settings: of the learner.
        noise_gain: correlated samples that one independent sample is worth (filtered signals).
        links_dw: whether the links' angular acceleration is measured, see `TreeSchema`.

    Attributes:
        schema, theta: the parts, with what they know.
        learned, refused: samples taken, and samples refused for numbers that are not finite or
            that no robot shows.
        theta_started_ns: stamp at which θ began; None before.
        rebuilds: times that θ's moments were rebuilt for a better λ.
    """

    def __init__(
        self,
        tree: Tree,
        settings: TreeLearnerSettings | None = None,
        *,
        noise_gain: float = 1.0,
        links_dw: bool = True,
    ) -> None:
        self.tree, self.settings = tree, settings or TreeLearnerSettings()
        s, n = self.settings, tree.n
        self.schema = TreeSchema(tree, s.schema, s.seed, links_dw)
        self.theta = TreeTheta(tree, s.theta, noise_gain)
        frames = 6 * (n + 1)
        self.adam = FlatAdam(frames + self.theta.P, s.theta.rate, s.theta.betas)
        self._bind(frames)
        ends = np.cumsum([0, n, n, n, tree.rows, 12, 12 * n])
        self._parts = [slice(a, b) for a, b in pairwise(ends)]
        caps = [CAP_Q, CAP_DQ, CAP_DDQ, CAP_TAU]
        widths = [n, n, n, tree.rows]
        self._cap = np.concatenate([np.repeat(caps, widths), np.tile(CAP_MOTION, n + 1)])
        self._record = np.zeros(ends[-1])
        self._held = np.zeros((s.held_samples, ends[-2]))
        self._held_from, self._held_to = 0, 0  # running numbers of the oldest and next row
        self._R0, self._p = self.schema.R0.copy(), self.schema.p.copy()
        self._shadow: tuple[Array, Array] | None = None
        self._shadow_at = 0
        self.learned, self.refused, self.updates, self.rebuilds = 0, 0, 0, 0
        self.theta_started_ns: int | None = None

    def _bind(self, frames: int) -> None:
        """Let λ's tangent, θ's parameters and their gradients be views of ADAM's flat arrays."""
        parameters, gradient = self.adam.parameters, self.adam.gradient
        parameters[frames:] = self.theta.x
        self.schema.learner.tangent = parameters[:frames].reshape(-1, 6)
        self.schema.learner.gradient = gradient[:frames].reshape(-1, 6)
        self.theta.x, self.theta.gradient = parameters[frames:], gradient[frames:]

    @property
    def frames(self) -> tuple[Array, Array]:
        """(R0, p) that θ is learned with: λ as it was when θ's moments were last rebuilt."""
        return self._R0, self._p

    def step(self, sample: TreeSample) -> bool:
        """Learn from one sample; False where it was refused, and nothing is changed.

        Raises:
            ModelError: shapes that don't fit the tree.
        """
        if not self._fill(sample):
            self.refused += 1
            return False
        self.learned += 1
        q, dq, ddq, tau, base, links = (self._record[part] for part in self._parts)
        if sample.links is not None:
            self.schema.absorb(sample.stamp_ns, q, dq, ddq, base, links.reshape(-1, 12))
        self._hold()
        if self.theta_started_ns is not None:
            rows = [x[None] for x in (q, dq, ddq, tau, base)]
            self.theta.absorb(self._R0, self._p, rows)
            if not self._looking():  # never two dear things in one sample
                self._rebuild_some()
        elif self.schema.converged:
            self.theta_started_ns = sample.stamp_ns
            self._begin_rebuild()
        if self.learned % self.settings.update_every == 0:
            self.update()
        return True

    def _fill(self, sample: TreeSample) -> bool:
        """Copy a sample into the record; whether it can be learned from."""
        parts = (sample.q, sample.dq, sample.ddq, sample.tau, sample.base)
        try:
            for part, value in zip(self._parts, parts, strict=False):
                self._record[part] = value
            links = self._record[self._parts[-1]].reshape(-1, 12)
            links[:] = 0.0 if sample.links is None else sample.links
        except ValueError as error:
            n, rows = self.tree.n, self.tree.rows
            raise ModelError(
                f"a sample of this tree has q, dq, ddq ({n},), tau ({rows},), base (12,) and links "
                f"({n}, 12): {error}"
            ) from None
        return bool((np.abs(self._record) < self._cap).all())  # false for NaN

    def update(self) -> None:
        """One ADAM step on λ and θ from the moments as they are."""
        self.updates += 1
        self.schema.compute_gradient()
        ready = self.theta_started_ns is not None and self.theta.compute_gradient()
        s = self.settings.theta
        self.adam.rate = s.settled_rate if self.theta.converged else s.rate
        if not ready:
            self.theta.gradient[:] = 0.0
        self.adam.step()
        self.schema.learner.apply_step(self.adam.rate)
        if not ready:
            return
        self.theta.after_step()
        if self.theta.updates % JUDGE_THETA_EVERY == 0:
            self.theta.judge(CONVERGED_EXCESS)
        if self.updates % FOLLOW_EVERY == 1 and self._shadow is None:
            self._follow_schema()

    def _looking(self) -> bool:
        """Whether the next update of λ looks at curvature and identifiability."""
        every = self.settings.schema.judge_every
        return every > 1 and self.schema.learner.updates % every == 0

    def predict(self, data: TreeData) -> Array:
        """τ (m, rows) of joint signals and base motion with λ and θ in use; nothing is learned."""
        base, zero = motion_rows(data.base), np.zeros_like(data.tau)
        signals = [np.ascontiguousarray(x) for x in (data.q, data.dq, data.ddq)]
        nowhere = self.theta.A[:0], self.theta.C
        return -self.theta.absorb(self._R0, self._p, [*signals, zero, base], into=nowhere)

    def _hold(self) -> None:
        size = len(self._held)
        self._held[self._held_to % size] = self._record[: self._held.shape[1]]
        self._held_to += 1
        self._held_from = max(self._held_from, self._held_to - size)

    def _follow_schema(self) -> None:
        """Begin to rebuild θ's moments when λ has left them by more than it is sure of."""
        std = np.sqrt(np.einsum("jaa->ja", self.schema.covariance))
        allowed = np.maximum(self.settings.rebuild_stds * std, REBUILD_FLOOR)
        if (np.abs(self.schema.moved(self._R0, self._p)) > allowed).any():
            self._begin_rebuild()

    def _begin_rebuild(self) -> None:
        self._R0[:], self._p[:] = self.schema.R0, self.schema.p
        self._shadow, self._shadow_at = self.theta.empty_moments(), self._held_from

    def _rebuild_some(self) -> None:
        """Redo some of the samples still held with the present λ; swap when all are done."""
        if self._shadow is None:
            return
        start = max(self._shadow_at, self._held_from)
        stop = min(start + self.settings.rebuild_rows, self._held_to)
        rows = self._held[np.arange(start, stop) % len(self._held)]
        signals = [np.ascontiguousarray(rows[:, part]) for part in self._parts[:5]]
        self.theta.absorb(self._R0, self._p, signals, into=self._shadow)
        self._shadow_at = stop
        if stop == self._held_to:
            self.theta.replace(self._shadow, float(stop - self._held_from))
            self._shadow = None
            self.rebuilds += 1
