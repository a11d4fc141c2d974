"""Least squares on the regressor with known λ: what a user would take today.

Not a baseline of the paper: it is told the body schema, which all other learners have to do
without or find. It shows what the data hold.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from adapter.experiments.baselines.features import Columns
from adapter.experiments.baselines.learner import Baseline, Progress, Told
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.identifiability import RANK_TOLERANCE
from adapter.physics.networks import DTYPE, PER_BODY, FrameMotion, regressor


class RegressorLeastSquares(Baseline):
    """Inertial parameters of an arm from its torques, weighted by joint, smallest norm."""

    at_once = 5_000  # so that their regressor stays below 30 MB

    def __init__(self, columns: Columns, parents: Sequence[int], lam: Array) -> None:
        """With a known body schema.

        Args:
            columns: layout of X.
            parents: for each joint of the arm the arm's link that it hangs on, -1 for the
                carrier (`features.sub_parents`).
            lam: (n, 6) λ of these joints.
        """
        self.tree = Tree(tuple(parents), floating=True)
        self.columns, self.lam = columns, torch.as_tensor(np.asarray(lam), dtype=DTYPE)

    def _learn(self, X: Array, Y: Array, progress: Progress) -> Told:
        """Solve with equal weights, then with each joint's rest as its noise."""
        self.columns.check(X, Y)
        width = PER_BODY * self.tree.n + 1
        triangles: list[Array] = [np.zeros((0, width)) for _ in range(self.tree.n)]
        for k in range(0, len(X), self.at_once):
            rows = self._rows(X[k : k + self.at_once])
            for j, old in enumerate(triangles):
                new = np.column_stack([rows[:, j], Y[k : k + self.at_once, j]])
                triangles[j] = np.asarray(np.linalg.qr(np.vstack([old, new]), mode="r"))
            progress(f"least squares: {min(k + self.at_once, len(X))} of {len(X)} samples")
        size = np.maximum(np.sqrt(np.mean(Y**2, axis=0)), 1e-9)
        theta, rank = _solved(triangles, size)
        rest = [np.linalg.norm(r[:, :-1] @ theta - r[:, -1]) for r in triangles]
        # no joint's torque is taken for better than this share of its size
        noise = np.maximum(np.array(rest) / np.sqrt(len(X)), 1e-12 * size)
        self._theta, rank = _solved(triangles, noise)
        return {"samples": len(X), "parameters": PER_BODY * self.tree.n, "rank": rank}, (
            "λ is known; θ by weighted least squares (QR), the weights from each joint's rest, "
            "the solution of smallest norm.",
        )

    def _rows(self, x: Array) -> Array:
        """Regressor of the joint torques, (m, n, 10 n); the carrier's own inertia is in none."""
        q, dq, ddq = (torch.from_numpy(np.ascontiguousarray(s)) for s in self.columns.joints(x))
        full = regressor(
            self.tree, self.lam, (q, dq, ddq), FrameMotion.of(self.columns.carrier(x).rows())
        )
        return full[:, 6:, PER_BODY:].numpy()

    def _answer(self, x: Array) -> Array:
        return np.asarray(self._rows(x) @ self._theta)


def _solved(triangles: list[Array], noise: Array) -> tuple[Array, int]:
    """θ (10 n,) of the joints' triangular systems, each over its noise; and the rank found."""
    table = np.vstack([r / s for r, s in zip(triangles, noise, strict=True)])
    length = np.linalg.norm(table[:, :-1], axis=0)
    length = np.where(length > 0.0, length, 1.0)
    found, _, rank, _ = np.linalg.lstsq(table[:, :-1] / length, table[:, -1], rcond=RANK_TOLERANCE)
    return found / length, int(rank)
