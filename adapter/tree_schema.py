"""λ of a tree whose base moves: the arm's learner of λ, with the base as one more link.

`SchemaLearner` knows of a base only its constant motion. Here the base is link 0 of a tree grown
by one, hanging on a world that stands still by a joint that nothing shows: no data ever reach
that joint (its parent does not move), while the base's measured motion, and the noise in it, are
treated as those of every other link.

Where nothing measures the links' velocity (gyroscopes and accelerometers do not), a frame's place
shows in accelerations alone. Then what they show of it counts when it is judged what the data
show, the noise in dw and in products of w taken out as that of w and a is.
"""

from __future__ import annotations

import numpy as np

from adapter.filters import THIRD_DIFFERENCE_GAIN
from adapter.records import MOTION_MEASURED, Array
from adapter.schema_kernels import DERIVATIVES, profiled, without_noise
from adapter.schema_learner import MISFIT_FLOOR, NOISE_FLOOR, SchemaLearner, SchemaSettings
from adapter.spatial import log_rotation
from adapter.tree import BASE, Tree

SPIN = slice(9, 12)  # dw in a motion row [v w a dw]
LONG_AGO_NS = -(2**61)  # before any stamp: the first sample follows none
# Where dw is carried by λ: samples between two looks at λ, and the turn (rad) in between that
# spoils them.
CARRIED_SAMPLES, CARRIED_TURN = 400, 2e-3
PRODUCTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of w, as `schema_kernels` has them


class GrownSchema(SchemaLearner):
    """`SchemaLearner` of the grown tree, which can do without measured velocities.

    Attributes:
        spin_power: (bodies,) sum of squared third differences of dw.
        velocities: whether any velocity was measured so far.
    """

    def __init__(self, tree: Tree, settings: SchemaSettings | None, seed: int) -> None:
        still: Array = np.zeros(12)
        super().__init__(tree, still, settings, seed=seed)
        self.spin_power = np.zeros(tree.n)
        self.velocities = False
        self.last_stamps[0] = LONG_AGO_NS

    def take(self, record: Array, motion: Array) -> None:
        """Add one sample (1, size) with motion rows (bodies, 12) to the moments."""
        before = self.last_motion[:, :, SPIN]
        third = motion[:, SPIN] - before[0] - 3.0 * (before[2] - before[1])
        self.absorb(record)
        self.velocities = self.velocities or bool(motion[:, :3].any())
        if not self.velocities:  # w alone would say that no frame has a place (v = w x p = 0)
            self.M[:, 1, 6:9, 6:9] = 0.0
        if self.counts[2] >= 4.0:  # no hole in time among the four
            self.spin_power += np.einsum("ja,ja->j", third, third) / 3.0

    def begin_anew(self) -> None:
        """Drop all samples; λ goes on from where it is."""
        self.converged = False
        for part in (self.M, self.noise_power, self.counts, self.spin_power):
            part[:] = 0.0

    def _profile(self) -> None:
        if self.velocities:
            super()._profile()
            return
        clean = self._without_noise()
        levels = NOISE_FLOOR, MISFIT_FLOOR, True, self.gradient, self._H
        profiled(self.M, clean, self.count, DERIVATIVES, self.R0, self.p, *levels)

    def _without_noise(self) -> Array:
        """Moments with the noise of the parents' w, a, dw and products of w taken out."""
        clean, variance = np.empty_like(self.M), self.noise_variance()
        without_noise(self._parent, self.M, self.count, variance, clean)
        clean[:, 1] = 0.0
        clean[:, 2, 6:], clean[:, 2, :, 6:] = self.M[:, 2, 6:], self.M[:, 2, :, 6:]
        spin = self.spin_power / (THIRD_DIFFERENCE_GAIN * max(self.counts[1], 1.0))
        has = self._parent >= 0
        turning = np.where(has, variance[self._parent, 1], 0.0)
        square = np.einsum("jaa->ja", self.M[:, 0, 3:6, 3:6])
        for a in range(3):
            clean[:, 2, 6 + a, 6 + a] -= self.count * np.where(has, spin[self._parent], 0.0)
        for k, (a, b) in enumerate(PRODUCTS):
            by = 4.0 * square[:, a] if a == b else square[:, a] + square[:, b]
            clean[:, 2, 9 + k, 9 + k] -= turning * by
        return clean


class TreeSchema:
    """λ of every joint of a tree, learned from the measured motion of its base and links.

    Args:
        tree: N and A; nothing else of the robot is known.
        settings: of the learner of λ.
        seed: of the random start.
        links_dw: whether the links' angular acceleration is measured. Where it is not, the base's
            is carried along the tree by eq. 8d with the present λ; moments made while that
            still turned are dropped.

    Attributes:
        learner: of the tree grown by the base, see above.
        R0 (n, 3, 3), p (n, 3): the frames as learned so far (views).
    """

    def __init__(
        self,
        tree: Tree,
        settings: SchemaSettings | None = None,
        seed: int = 0,
        links_dw: bool = True,
    ) -> None:
        self.tree = tree
        grown = Tree((BASE, *(i + 1 for i in tree.parent)))
        self.learner = GrownSchema(grown, settings, seed)
        self.R0, self.p = self.learner.R0[1:], self.learner.p[1:]
        self._record = self.learner.layout.new(1)
        self._stamp = self._record[0, :1].view(np.int64)
        self._record[0, 1] = MOTION_MEASURED
        at = self.learner.layout
        self._q = self._record[0, at.motion_q][1:]
        self._dq = self._record[0, at.motion_dq][1:]
        self._motion = self._record[0, at.motion].reshape(-1, 12)
        self._carried_dw = not links_dw
        self._rough, self._then = self._carried_dw, self.R0.copy()

    @property
    def lam(self) -> Array:
        """λ (n, 6): [α β γ p]."""
        return self.learner.lam[1:]

    @property
    def converged(self) -> bool:
        """Whether λ has settled."""
        return self.learner.converged and not self._rough

    @property
    def covariance(self) -> Array:
        """(n, 6, 6) covariance of turns and shifts (phi, d); zero where the data show nothing."""
        return self.learner.covariance()[1:]

    def absorb(
        self, stamp_ns: int, q: Array, dq: Array, ddq: Array, base: Array, links: Array
    ) -> None:
        """Add one sample to the moments.

        Args:
            stamp_ns: of the sample; a hole in time keeps motion from passing for noise.
            q, dq, ddq: (n,).
            base: (12,) motion row [v w a dw] of the base; links: (n, 12) those of the links.
                Zero where nothing measures a velocity v.
        """
        self._stamp[0] = stamp_ns
        self._q[:], self._dq[:] = q, dq
        self._motion[0], self._motion[1:] = base, links
        if self._carried_dw:
            self._carry_dw(ddq)
        self.learner.take(self._record, self._motion)

    def _carry_dw(self, ddq: Array) -> None:
        """The links' dw by eq. 8d from the base's, with w as measured and the present λ."""
        w, dw = self._motion[1:, 3:6], self._motion[:, SPIN]
        cos, sin = np.cos(self._q), np.sin(self._q)
        for j, i in enumerate(self.tree.parent):
            x, y, z = dw[i + 1] @ self.R0[j]
            dw[j + 1, 0] = cos[j] * x + sin[j] * y + w[j, 1] * self._dq[j]
            dw[j + 1, 1] = cos[j] * y - sin[j] * x - w[j, 0] * self._dq[j]
            dw[j + 1, 2] = z + ddq[j]

    def compute_gradient(self) -> None:
        """Fill `learner.gradient` for one ADAM step."""
        self.learner.compute_gradient()
        if self._rough and self.learner.count >= CARRIED_SAMPLES:
            self._check_carried()

    def _check_carried(self) -> None:
        """Begin anew where the frames that carried dw were not yet those of now."""
        turned = log_rotation(np.swapaxes(self._then, 1, 2) @ self.R0)
        shown = np.einsum("jaa->j", self.learner.identifiable[1:])
        self._rough = bool(np.abs(turned).max() > CARRIED_TURN or shown.min() < 1.0)
        if self._rough:
            self.learner.begin_anew()
            self._then = self.R0.copy()

    def moved(self, R0: Array, p: Array) -> Array:
        """(n, 6) turns and shifts from other frames to these, rad and m."""
        turned = log_rotation(np.swapaxes(R0, 1, 2) @ self.R0)
        return np.concatenate([turned, self.p - p], axis=1)
