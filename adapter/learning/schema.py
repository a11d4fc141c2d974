"""λ, the body schema: ADAM's gradient from the moments of eqs. 8a-8c (eq. 18), joint by joint.

Each joint frame moves in its own tangent (turn phi about its axes, shift d), so no angle triple
has a singular place to start from or pass through; λ is read off the frame. Four cares beside
plain ADAM, each a consequence of the moments being there:

- each channel's noise level is profiled (weight = 1 / its own residual variance);
- when it is judged what the data show, the noise of measured parent motion is taken out of the
  moments, where it would pass for excitation;
- a step is kept out of directions the data do not show: those stay where they started;
- a step is at most as long as a share of the distance to the optimum, which the curvature
  tells: full speed at first, no spikes later.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from adapter.learning import schema_kernels as kernels
from adapter.learning.frame_fit import Evidence, Frame, SchemaCheck
from adapter.learning.settings import SchemaSettings
from adapter.model.spatial import (
    Array,
    exp_rotation,
    log_rotation,
    matrix_from_zxz,
    zxz_from_matrix,
)
from adapter.model.tree import Tree
from adapter.signals.filters import THIRD_DIFFERENCE_GAIN
from adapter.signals.records import KIND, LinkMotionKind, StateLayout, stamp_of

# Curvature that counts as shown, and as known, where nothing but rounding (some 1e-6) disturbs it.
SHOWN_EXACTLY, KNOWN_EXACTLY = 1.0, 1.6e5
NEAR = 2.5e-3  # rad, m: from where the curvature alone finds the way, where nothing disturbs it
LONGEST_WAIT_NS = 50_000_000  # what counts of the time between two looks at a λ that stands still
# Where dw is carried by λ: samples between two looks at λ, and the turn (rad) in between that
# spoils them.
CARRIED_SAMPLES, CARRIED_TURN = 400, 2e-3


@dataclass(frozen=True)
class RestingBase:
    """Motion rows (12,) of a base that does not move, nothing but a = -gravity.

    Attributes:
        documented: that synthesized link motion is made with; measured: what sensors feel.
    """

    documented: Array
    measured: Array


class Schema:
    """λ of every joint of a tree, its uncertainty and what of it the data show.

    Args:
        tree: N and A; nothing else of the robot is known.
        base: motion of a base that rests; of a floating one the states tell.
        settings: how it is learned.
        each_sample: learn from the newest sample alone, as the paper does.
        seed: of the random start.

    Attributes:
        R0 (n, 3, 3), p (n, 3): the frames; `lam` reads λ off them.
        tangent, gradient: (n, 6) what ADAM steps on (zero between steps), and its gradient.
        moments: of all samples so far.
        weight: samples that one that is given stands for, where the others are left out.
        looked: whether the newest update looked at the curvature.
        information: (n, 6, 6) of (phi, d).
        identifiable: (n, 6, 6) projector on the directions the data show, if roughly: ADAM keeps
            to them. rank: their number over all joints.
        certain: (n, 6, 6) projector on those that are known as well as is asked for; ranks: (n,)
            their number by joint.
        converged: whether λ has settled (see SchemaSettings), in no joint in a wrong valley.
        check: looks for wrong valleys; counts `restarts`.
        started_anew: joints that were moved since ADAM last forgot its averages of them.
    """

    def __init__(
        self,
        tree: Tree,
        base: RestingBase | None,
        settings: SchemaSettings,
        each_sample: bool = False,
        seed: int = 0,
    ) -> None:
        n = tree.n
        self.settings, self.each_sample = settings, each_sample
        self.layout = StateLayout(n, tree.floating)
        self._parent = np.array(tree.parent, dtype=np.int64)
        self._base = base
        rng = np.random.default_rng(seed)
        start = settings.start_rms * rng.normal(size=(n, 6))
        self.R0 = np.ascontiguousarray(exp_rotation(start[:, :3]))
        self.p = np.ascontiguousarray(start[:, 3:])
        # plain tuples: numba takes 3 µs longer for a named one
        self._frames = self._parent, self.R0, self.p, np.array(tree.slides)
        self.start_lam = self.lam
        self.kind = LinkMotionKind.NONE  # taken from the first state that has link motion
        newest = n if each_sample or settings.forget_s is not None else 0
        self.moments = kernels.MotionMoments(
            np.zeros((n, 3, 15, 15)),
            np.zeros((newest, 3, 15, 15)),
            np.zeros((n + 1, 4)),
            np.zeros((3, n + 1, 12)),
            np.array([-(2**61), 2**62]),  # before any stamp: the first sample follows none
            np.zeros(len(kernels.Count)),
        )
        self._moments = tuple(self.moments)
        self._clean = np.zeros_like(self.moments.M)
        self.updates, self.weight, self.looked = 0, 1.0, False
        self.tangent, self.gradient = np.zeros((n, 6)), np.zeros((n, 6))
        self._distance = np.zeros((n, 2))
        self.information = np.zeros((n, 6, 6))
        self.identifiable = np.zeros((n, 6, 6))
        # by directions that are known, and those that are not yet
        self._may_move, self._inverse = np.zeros((2, n, 2, 6, 6))
        self.certain = np.zeros((n, 6, 6))
        self.rank = 0
        self.ranks, self._there = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool)
        self._left = np.zeros((n, 6))
        self.check = SchemaCheck(n)
        self.started_anew: list[int] = []
        self._calm_ns = self._looked_ns = 0
        self.converged = False
        self._rough, self._then = not settings.spin_measured, self.R0.copy()

    @property
    def lam(self) -> Array:
        """λ (n, 6): [α β γ p]."""
        return np.concatenate([zxz_from_matrix(self.R0), self.p], axis=1)

    def more_state(self) -> dict[str, Array]:
        """What a checkpoint holds of a kind of schema beside what it holds of all."""
        return {}

    def take_state(self, state: Mapping[str, Array]) -> None:
        """Go on from what `more_state` gave."""

    @property
    def notes(self) -> list[str]:
        """What is wrong with the link motion, a sentence each."""
        return []

    def set_lam(self, lam: Array) -> None:
        """Start from a given λ (n, 6), e.g. a checkpoint's."""
        self.R0[:] = matrix_from_zxz(lam[:, :3])
        self.p[:] = lam[:, 3:]

    @property
    def count(self) -> float:
        """Samples in the moments (fewer where some were forgotten)."""
        return float(self.moments.counts[kernels.Count.SAMPLES])

    def absorb(self, table: Array) -> None:
        """Add a table (m, size) of filtered states to the moments."""
        if self.kind != LinkMotionKind.MEASURED:
            newest = LinkMotionKind(
                int(table[0, KIND] if len(table) == 1 else table[:, KIND].max())
            )
            if newest == LinkMotionKind.MEASURED:
                self._forget_all()
            self.kind = newest or self.kind
        base = self._base_motion()
        if not self.settings.spin_measured and self.kind == LinkMotionKind.MEASURED:
            table = table.copy()
            kernels.carry_spin(self._frames, base, table)
        keep = self._keep(1e3 * self.settings.forget_s) if self.settings.forget_s else 1.0
        kernels.absorb(
            self._frames, base, table, self._moments, float(self.kind), (keep, self.weight)
        )

    def steady(self, table: Array) -> int:
        """How many states (m, size) go by until more is due than steps and looks."""
        s = self.settings
        if self.each_sample or self._rough or s.forget_s is not None:
            return 0
        if not s.spin_measured and self.kind == LinkMotionKind.MEASURED:
            return 0
        other = np.flatnonzero(table[:, KIND] != float(self.kind))
        return int(other[0]) if len(other) else len(table)

    def until_look(self, table: Array) -> int:
        """How many states (m, size), the first of which it has seen, go by until the next look."""
        every = self.settings.judge_every
        for k in range(1 + -self.updates % every, len(table), every):
            if self._look_due(stamp_of(table[k])):
                return k
        return len(table)

    def _look_due(self, stamp_ns: int) -> bool:
        """Whether curvature is looked at with a state of this stamp, where it may be."""
        return not self.converged or not 0 < stamp_ns - self._looked_ns < LONGEST_WAIT_NS

    def parts(self) -> tuple[Any, ...]:
        """What `steps` needs of it."""
        s = self.settings
        return (
            self._frames,
            self._moments,
            self._base_motion(),
            float(self.kind),
            self.weight,
            self._may_move,
            self._inverse,
            self._distance,
            (s.rate, s.share),
            self.tangent,
            self.gradient,
        )

    def _base_motion(self) -> Array:
        """(12,) motion of a base at rest; empty where the states tell of the base."""
        if self._base is None:
            return np.empty(0)
        measured = self.kind == LinkMotionKind.MEASURED
        return self._base.measured if measured else self._base.documented

    def _forget_all(self) -> None:
        """Drop all samples; λ goes on from where it is."""
        for part in (self.moments.M, self.moments.noise_power, self.moments.counts):
            part[:] = 0.0
        self._calm_ns, self.converged = 0, False

    def _keep(self, window: float) -> float:
        """Forgetting factor per sample; one while the window would lose what it shows."""
        if self.count < 0.9 * window:
            return 1.0
        # whether the newest sample moves every joint that the moments know about
        fresh = np.abs(self.moments.newest[:, 0, 3:6, 3:6]).max(axis=(1, 2))
        held = np.abs(self.moments.M[:, 0, 3:6, 3:6]).max(axis=(1, 2)) / max(self.count, 1.0)
        return 1.0 - 1.0 / window if (fresh >= 1e-2 * held).all() else 1.0

    def noise_variance(self) -> Array:
        """(n + 1, 4) noise variance of measured v, w, a, dw of the base and of each link.

        Zero where motion is synthesized. From third differences, which jerky motion can exceed; so
        of v, w and a at most half of what the fit leaves, the other half being the child's own
        noise.
        """
        moments, differences = self.moments, self.moments.counts[kernels.Count.DIFFERENCES]
        if self.kind != LinkMotionKind.MEASURED or differences < 50:  # too few to tell
            return np.zeros_like(moments.noise_power)
        found = moments.noise_power / (THIRD_DIFFERENCE_GAIN * differences)
        left = np.empty((len(self.p), 3))
        kernels.residual_variance(self._frames, moments.M, self.count, left)
        for j, i in enumerate(self._parent):
            # channels are w, v, a
            found[i + 1, :3] = np.minimum(found[i + 1, :3], 0.5 * left[j, [1, 0, 2]])
        return found

    def compute_gradient(self) -> None:
        """Fill `gradient` for one ADAM step; looks at the curvature now and then."""
        may_look = self.updates % self.settings.judge_every == 0
        self.looked = looking = may_look and self._look_due(int(self.moments.last_stamps[0]))
        self.updates += 1
        frames, moments = self._frames, self.moments
        if looking:
            # the gradient from the moments as they are (noise in them bends λ by 1e-4 of its
            # size), and the curvature from what of them is motion
            clean = moments.M
            if self.kind == LinkMotionKind.MEASURED:
                clean, noise = self._clean, self.noise_variance()
                kernels.without_noise(self._parent, moments.M, moments.counts, noise, clean)
            kernels.profiled(frames, moments.M, self.count, clean, self.gradient, self.information)
            self._judge()
        if self.each_sample:
            kernels.steepest(frames, moments.newest, self.gradient)
        elif looking:
            kernels.distances(self._inverse, self.count, self.gradient, self._distance)
        else:
            outputs = self.gradient, self._distance
            kernels.descend(frames, moments.M, self.count, self._inverse, *outputs)
        if self._rough and self.count >= CARRIED_SAMPLES:
            # begin anew where the frames that carried dw were not yet those of now
            turned = log_rotation(np.swapaxes(self._then, 1, 2) @ self.R0)
            shown = np.einsum("jaa->j", self.identifiable)
            self._rough = bool(np.abs(turned).max() > CARRIED_TURN or shown.min() < 1.0)
            if self._rough:
                self._carry_anew()

    def _carry_anew(self) -> None:
        """Drop moments that other frames than those of now have carried dw in."""
        self._forget_all()
        self._rough, self._then = True, self.R0.copy()

    def apply_step(self, rate: float) -> None:
        """Move the frames by ADAM's step in `tangent`, taken at `rate`, and zero it."""
        s = self.settings
        if self.each_sample:
            everywhere = np.zeros_like(self._may_move)
            everywhere[:, 0] = np.eye(6)
            unlimited = np.tile([np.inf, 0.0], (len(self.p), 1))
            kernels.retract(
                self._frames, self.tangent, everywhere, unlimited, (s.sample_rate, 1.0, rate)
            )
        else:
            pace = s.rate, s.share, rate
            kernels.retract(self._frames, self.tangent, self._may_move, self._distance, pace)

    @property
    def _exact(self) -> bool:
        """Whether nothing but rounding disturbs what all moments say: synthesized motion."""
        return self.kind == LinkMotionKind.DOCUMENTED and not self.each_sample

    @property
    def _limits(self) -> tuple[float, float]:
        """Curvatures above which a direction is shown, and known."""
        if self._exact:
            return SHOWN_EXACTLY, KNOWN_EXACTLY
        # noise alone makes eigenvalues of the size sqrt(count); 400 is a std of 0.05 rad or m
        return max(400.0, 10.0 * np.sqrt(self.count)), 1.0 / self.settings.std_goal**2

    def _judge(self) -> None:
        """Which directions the data show, how far the optimum is, whether λ has settled."""
        curvature, before = np.linalg.eigh(self.information), self.ranks.copy()
        stds = (0.0, 0.0) if self._exact else (1.0, 3.0)  # standard deviations that may be left
        goals = self.settings.distance_goal, *stds
        out = self._may_move, self._inverse, self._left, self.ranks, self._there
        self.rank = kernels.directions(tuple(curvature), self._limits, goals, self.gradient, out)
        np.add(self._may_move[:, 0], self._may_move[:, 1], out=self.identifiable)
        self.certain[:] = self._may_move[:, 0]
        same = self.ranks.any() and bool((self.ranks == before).all())
        looked_ns, self._looked_ns = self._looked_ns, int(self.moments.last_stamps[0])
        since_ns = min(self._looked_ns - looked_ns, LONGEST_WAIT_NS)
        self._calm_ns = self._calm_ns + since_ns if same and self._there.all() else 0
        self._settle()

    def _settle(self) -> None:
        """Mend what stands wrong, and say whether λ has converged."""
        if self._exact:  # ADAM forgets the large gradients of its way too slowly to come close soon
            kernels.finish(self._frames, self._left, NEAR, self.gradient)
        else:
            # Steps keep out of shifts that the data do not show, but while noise still tilts the
            # picture of what is shown, a little leaks into them: back to where they started.
            unshown = np.eye(6) - self.identifiable
            pure = np.abs(unshown[:, :3, 3:]).max(axis=(1, 2)) < 0.05  # hardly any turn
            leaked = np.einsum("jab,jb->ja", unshown[:, 3:, 3:], self.p - self.start_lam[:, 3:])
            self.p -= pure[:, None] * leaked
        checked = self.each_sample
        if not self.each_sample and not self._rough:
            self._check_valleys()
            checked = bool((self.check.passed_rank == self.ranks).all())
        calm = 1e-9 * self._calm_ns / self.settings.stable_s
        settled = checked and calm >= 1.0 and not self._rough
        if self._exact:  # no noise hides for long what is shown
            # Times that λ has to stand still for where something shown is not known yet. Without
            # noise that is soon over, unless a brake holds a joint.
            known = self.rank == self.ranks.sum() or calm >= 5
            settled = settled and known and bool(np.abs(self._left).max() < 1e-6)  # rad, m
        self.converged = settled

    def _check_valleys(self) -> None:
        """Start joints anew that stand in a wrong valley; ADAM goes on from there."""
        least = self._limits[1 if self._exact else 0]
        clean = self._clean if self.kind == LinkMotionKind.MEASURED else self.moments.M
        still = self._there & (self.ranks > 0)
        urgent = self.ranks if self._calm_ns else None
        for j in self.check.next_joints(urgent):
            sums = self.moments.M[j], clean[j]
            known = Evidence(*sums, self.count, int(self.ranks[j]), least, bool(still[j]))
            start = Frame(matrix_from_zxz(self.start_lam[j, :3]), self.start_lam[j, 3:])
            found = self.check.better(j, Frame(self.R0[j].copy(), self.p[j].copy()), start, known)
            if found is not None:
                self.R0[j], self.p[j], self.gradient[j] = found.R0, found.p, 0.0
                self.started_anew.append(j)
                self._calm_ns = 0
        if self.started_anew and not self.settings.spin_measured:
            self._carry_anew()

    def covariance(self) -> Array:
        """(n, 6, 6) covariance of (phi, d) in the directions the data show, zero in others."""
        return np.asarray(self._inverse.sum(axis=1))

    def moved_from(self, R0: Array, p: Array) -> Array:
        """(n, 6) small turns and shifts (phi, d) from other frames to these, rad and m.

        Sines of the turns; inf for more than a quarter turn.
        """
        by = np.empty((len(p), 6))
        kernels.moved(self._frames, R0, p, by)
        return by

    def strayed(self, R0: Array, p: Array, allowed: Array) -> bool:
        """Whether a frame has left others by more than (n, 6), see `moved_from`."""
        return bool(kernels.strayed(self._frames, R0, p, allowed))
