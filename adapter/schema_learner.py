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
from adapter.fast import jit
from adapter.filters import THIRD_DIFFERENCE_GAIN
from adapter.records import MOTION_DOCUMENTED, MOTION_MEASURED, Array, StateLayout, stamps_of
from adapter.schema_kernels import DERIVATIVES, accumulate, channel_cost, signals
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

    rate: float = 1e-2
    share: float = 0.3
    sample_rate: float = 1e-3
    start_rms: float = 0.01
    forget_s: float | None = None
    judge_every: int = 20
    rotation_goal: float = 0.005
    position_goal: float = 0.0025
    stable_updates: int = 200

    def __post_init__(self) -> None:
        for name in ("rate", "share", "sample_rate", "start_rms", "judge_every"):
            if not getattr(self, name) > 0:
                raise SettingsError(f"schema.{name} must be above zero, got {getattr(self, name)}")
        if self.forget_s is not None and self.forget_s < 0.05:
            raise SettingsError(f"schema.forget_s must be at least 0.05 s, got {self.forget_s}")


@jit
def absorb(
    parent,
    base,
    stamps,
    kinds,
    q,
    dq,
    motion,
    kind,
    keep,
    M,
    newest,
    noise_power,
    last_motion,
    last_stamps,
    counts,
):
    """Add a table of samples to the moments.

    Args:
        kinds: (m,) kind of link motion of each sample; only `kind` is taken.
        q, dq: (m, n); motion: (m, n, 12); base: (12,).
        M: (n, 3, 15, 15) moments; newest: (n, 3, 15, 15) those of the last sample alone.
        noise_power: (n, 3) sum of squared third differences of v, w, a of each link.
        last_motion: (3, n, 12) the three motions before.
        last_stamps: (2,) int64 stamp of the last one, and the shortest step so far, ns.
        counts: (3,) samples in the moments, third differences taken, motions since a hole.
    """
    n = parent.shape[0]
    s = np.zeros((3, 15))
    for m in range(kinds.shape[0]):
        if kinds[m] != kind:
            continue
        for j in range(n):
            up = base if parent[j] < 0 else motion[m, parent[j]]
            signals(q[m, j], dq[m, j], up, motion[m, j], s)
            accumulate(s, keep, M[j])
            accumulate(s, 0.0, newest[j])
        counts[0] = keep * counts[0] + 1.0
        step = stamps[m] - last_stamps[0]
        last_stamps[0] = stamps[m]
        last_stamps[1] = min(last_stamps[1], max(step, 1))
        if 2 * step > 5 * last_stamps[1]:
            counts[2] = 0.0  # across a hole, motion would pass for noise
        if counts[2] >= 3.0:
            counts[1] += 1.0
            for j in range(n):
                for k in range(9):
                    d = motion[m, j, k] - last_motion[0, j, k]
                    d -= 3.0 * (last_motion[2, j, k] - last_motion[1, j, k])
                    noise_power[j, k // 3] += d * d / 3.0
        counts[2] += 1.0
        for k in range(2):
            last_motion[k] = last_motion[k + 1]
        last_motion[2] = motion[m]


@jit
def without_noise(parent, M, count, variance, out):
    """out = M with the parents' noise variance (n, 3; order v, w, a) taken out.

    Angular accelerations and products of angular velocities leave altogether: what they show of
    a frame's place, the twists show as well, and their noise cannot be told from jerky motion.
    """
    for j in range(parent.shape[0]):
        out[j] = M[j]
        i = parent[j]
        if i < 0:
            continue
        for a in range(3):
            out[j, 0, 3 + a, 3 + a] -= count * variance[i, 1]
            out[j, 1, 3 + a, 3 + a] -= count * variance[i, 0]
            out[j, 1, 6 + a, 6 + a] -= count * variance[i, 1]
            out[j, 2, 3 + a, 3 + a] -= count * variance[i, 2]
        out[j, 2, 6:, :] = 0.0
        out[j, 2, :, 6:] = 0.0


@jit
def profiled(M, clean, count, D, R0, p, floor, misfit, curved, g, H):
    """Gradient g (n, 6), every channel weighted by its own residual.

    If `curved`, also the curvature H (n, 6, 6) that the moments `clean` have with these weights.
    """
    gc, Hc, unused = np.zeros(6), np.zeros((6, 6)), np.zeros(6)
    for j in range(R0.shape[0]):
        g[j] = 0.0
        if curved:
            H[j] = 0.0
        for ch in range(3):
            gc[:], Hc[:] = 0.0, 0.0
            cost = max(channel_cost(M[j], D, ch, R0[j], p[j], False, gc, Hc), 0.0)
            power = M[j, ch, 0, 0] + M[j, ch, 1, 1] + M[j, ch, 2, 2]
            weight = 3.0 * count / (cost + 3.0 * count * floor * floor + misfit * power + 1e-300)
            for a in range(6):
                g[j, a] += weight * gc[a]
            if curved:
                channel_cost(clean[j], D, ch, R0[j], p[j], True, unused, Hc)
                H[j] += weight * Hc


@jit
def residual_variance(M, count, D, R0, p, out):
    """out (n, 3): mean square of what each channel's fit leaves, per component."""
    g, H = np.zeros(6), np.zeros((6, 6))
    for j in range(R0.shape[0]):
        for ch in range(3):
            cost = channel_cost(M[j], D, ch, R0[j], p[j], False, g, H)
            out[j, ch] = max(cost, 0.0) / (3.0 * max(count, 1.0))


@jit
def steepest(M, D, R0, p, g, H):
    """Gradient g (n, 6) of the plain squared error (eq. 18)."""
    for j in range(R0.shape[0]):
        g[j] = 0.0
        for ch in range(3):
            channel_cost(M[j], D, ch, R0[j], p[j], False, g[j], H[j])


@jit
def distances(inverse, g, out):
    """out (n,): longest entry of each joint's Newton step, rad or m."""
    for j in range(g.shape[0]):
        out[j] = np.abs(inverse[j] @ g[j]).max()


@jit
def retract(step, scale, project, R0, p):
    """Move every frame by its projected step (n, 6), scaled by (n,): R0 exp(phi), p + d."""
    turn = np.empty((3, 3))
    for j in range(R0.shape[0]):
        x = scale[j] * (project[j] @ step[j])
        a = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
        s = np.sin(a) / a if a > 1e-8 else 1.0
        h = (1.0 - np.cos(a)) / (a * a) if a > 1e-8 else 0.5
        for r in range(3):
            for c in range(3):
                turn[r, c] = h * x[r] * x[c]
            turn[r, r] += 1.0 - h * a * a
        turn[0, 1] -= s * x[2]
        turn[0, 2] += s * x[1]
        turn[1, 0] += s * x[2]
        turn[1, 2] -= s * x[0]
        turn[2, 0] -= s * x[1]
        turn[2, 1] += s * x[0]
        R0[j] = R0[j] @ turn
        p[j] += x[3:]


class SchemaLearner:
    """λ of every joint, its uncertainty and what of it the data show.

    Args:
        tree: N and A; nothing else of the robot is known.
        base: (12,) motion of the base.
        noise_gain: correlated samples that one independent sample is worth, for synthesized
            (filtered) motion; measured motion is white.
        seed: of the random start.

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
    ) -> None:
        n = tree.n
        self.settings, self.mode = settings or SchemaSettings(), mode
        self.layout = StateLayout(n)
        self._parent, self._base = np.array(tree.parent, dtype=np.int64), base
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
        if self.kind != MOTION_MEASURED and (table[:, 1] == MOTION_MEASURED).any():
            self._begin(MOTION_MEASURED)
        elif not self.kind:
            self.kind = int(table[0, 1])
        keep = 1.0
        if self.settings.forget_s is not None:
            keep = self._keep()
        absorb(
            self._parent,
            self._base,
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
        if looking or self.mode == "moments":
            self._profile(looking)
        if looking:
            self._judge()
        if self.mode == "sample":
            steepest(self._newest, DERIVATIVES, self.R0, self.p, self.gradient, self._H)
        else:
            distances(self._inverse, self.gradient, self._distance)
            self.gradient /= max(self.count, 1.0)

    def apply_step(self, rate: float) -> None:
        """Move the frames by ADAM's step in `tangent`, taken at `rate`, and zero it."""
        s = self.settings
        if self.mode == "sample":
            scale = np.full(len(self.p), s.sample_rate / rate)
            retract(self.tangent, scale, self._everything, self.R0, self.p)
        else:
            scale = np.minimum(s.rate, s.share * self._distance) / rate
            retract(self.tangent, scale, self.identifiable, self.R0, self.p)
        self.tangent[:] = 0.0

    def _profile(self, curved: bool) -> None:
        """Fill the gradient from the moments as they are (noise in them bends λ by 1e-4 of its
        size), and the curvature from what of them is motion."""
        clean = self.M
        if curved and self.kind == MOTION_MEASURED:
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
            curved,
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
