"""Two learners that know mechanics: a deep Lagrangian network, and least squares with known λ.

The deep Lagrangian network (Lutter, Ritter, Peters 2019) is that of an arm on a moving link. It
gives the mass matrix M(q) of the arm's joints and its carrier, positive definite by its Cholesky
factor; the rest is mechanics. The kinetic energy is T = ½ xᵀ M(q) x with x = [V; dq], V the
carrier's twist [v; w] in its own axes. The joints are true coordinates, so

    τ = d/dt (∂T/∂dq) - ∂T/∂q,    dV/dt = [a - w × v; dw],

with `a` the accelerometer's reading: seen from a frame in free fall there is no potential.
Torques don't depend on v, so the frame may fly along with the carrier: v = 0 and dV/dt = [a; dw].
This is how the network is trained; it then obeys Galilei's relativity without learning it.

Least squares on the regressor is what a user would take today, and no baseline of the paper: it is
told the body schema, which all other learners have to do without or find. It shows what the data
hold.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from adapter.experiments.baselines.learner import Baseline, Columns, Progress, Told, accelerator
from adapter.learning.batch.prediction_errors import LEAST_TORQUE, predicted_torques
from adapter.learning.batch.theta_factors import row_factors, scales, system
from adapter.learning.batch.theta_solvers import least_squares_theta
from adapter.learning.tree_data import TreeData
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.networks import FrameMotion

BASE_ROWS = 6  # [v; w] of the carrier come before the joints in x
LEAST_DIAGONAL = 1e-3  # of the scaled Cholesky factor, so that M stays invertible

MassMatrix = Callable[[Tensor], Tensor]


def lagrange_torque(
    mass: MassMatrix, q: Tensor, dq: Tensor, ddq: Tensor, base: FrameMotion
) -> Tensor:
    """Joint torques (m, n), N m, of an arm whose mass matrix is `mass`.

    Args:
        mass: q (m, n) into M (m, 6 + n, 6 + n), symmetric, rows and columns in the order
            [v; w; dq]; differentiable twice where the torques are to be differentiated.
        q: (m, n) joint angles, rad; dq (rad/s) and ddq (rad/s²) likewise.
        base: motion of the link that carries the arm, (m, 3) each, in its frame, `a` with gravity.
    """
    v, w, a, dw = base
    x = torch.cat([v, w, dq], dim=1)
    rate = torch.cat([a - torch.linalg.cross(w, v), dw, ddq], dim=1)
    with torch.enable_grad():
        if not q.requires_grad:
            q = q.detach().requires_grad_()
        m, m_rate, *_ = torch.func.jvp(mass, (q,), (dq,))
        twice = torch.einsum("mi,mij,mj->m", x, m, x)
        (by_q,) = torch.autograd.grad(twice.sum(), q, create_graph=True)
    momentum_rate = torch.einsum("mij,mj->mi", m, rate) + torch.einsum("mij,mj->mi", m_rate, x)
    return momentum_rate[:, BASE_ROWS:] - 0.5 * by_q


class MassNetwork(nn.Module):
    """q (m, n) into a positive definite M (m, 6 + n, 6 + n) = L Lᵀ.

    Attributes:
        scale: (6 + n, 6 + n) of the order of L's entries, by which the network's answers count.
    """

    scale: Tensor
    place: Tensor

    def __init__(self, scale: Tensor, hidden: tuple[int, ...], seed: int) -> None:
        """Softplus layers of these sizes on cos q and sin q; M starts close to a constant."""
        super().__init__()
        self.size = len(scale)
        self.register_buffer("scale", scale)
        # flat places of the factor's diagonal, then of what is below it
        diagonal = torch.arange(self.size) * (self.size + 1)
        rows, columns = torch.tril_indices(self.size, self.size, -1)
        self.register_buffer("place", torch.cat([diagonal, rows * self.size + columns]))
        sizes = (2 * (self.size - BASE_ROWS), *hidden, len(self.place))
        generator = torch.Generator().manual_seed(seed)
        layers = [nn.Linear(ins, outs) for ins, outs in pairwise(sizes)]
        for layer in layers:
            gain = 0.1 if layer is layers[-1] else 1.0  # first answers are small
            nn.init.xavier_normal_(layer.weight, gain, generator=generator)
            nn.init.zeros_(layer.bias)
        self.inner, self.last = nn.ModuleList(layers[:-1]), layers[-1]

    def forward(self, q: Tensor) -> Tensor:
        """M (m, 6 + n, 6 + n)."""
        h = torch.cat([torch.cos(q), torch.sin(q)], dim=1)
        for layer in self.inner:
            h = nn.functional.softplus(layer(h))
        flat = self.last(h)
        diagonal = nn.functional.softplus(flat[:, : self.size]) + LEAST_DIAGONAL
        values = torch.cat([diagonal, flat[:, self.size :]], dim=1)
        empty = values.new_zeros((len(q), self.size**2))
        factor = empty.index_copy(1, self.place, values).reshape(-1, self.size, self.size)
        factor = self.scale * factor
        return factor @ factor.mT


class DeepLagrangian(Baseline):
    """The network with its training: ADAM on all joints' errors in deviations of their torque."""

    def __init__(
        self,
        columns: Columns,
        hidden: tuple[int, ...] = (128, 128),
        steps: int = 6000,
        batch: int = 512,
        rate: float = 2e-3,
        seed: int = 0,
    ) -> None:
        """Nothing is computed before `fit`.

        Args:
            columns: layout of X.
            hidden: units of the hidden layers.
            steps: of ADAM; the rate falls to nothing along half a cosine.
            batch: samples of one step, drawn from all.
            rate: of ADAM at the start.
            seed: of weights and batches.
        """
        self.columns, self.hidden, self.steps = columns, hidden, steps
        self.batch, self.rate, self.seed = batch, rate, seed

    def _learn(self, X: Array, Y: Array, progress: Progress) -> Told:
        """Train in float32, on a GPU where there is one.

        Raises ModelError where Y has not one column by joint.
        """
        self.columns.check(X, Y)
        torque = np.maximum(np.sqrt(np.mean(Y**2, axis=0)), LEAST_TORQUE)
        weight = 1.0 / torque
        sizes = torch.from_numpy(self._sizes(X, torque)).float()
        place = accelerator() or torch.device("cpu")
        mass = MassNetwork(sizes, self.hidden, self.seed).to(place)
        x, y, weight_t = (torch.from_numpy(t).float().to(place) for t in (X, Y * weight, weight))
        adam = torch.optim.Adam(mass.parameters(), lr=self.rate)
        falling = torch.optim.lr_scheduler.CosineAnnealingLR(adam, self.steps)
        generator = torch.Generator().manual_seed(self.seed)
        for step in range(self.steps):
            rows = torch.randint(len(x), (min(self.batch, len(x)),), generator=generator).to(place)
            loss = torch.mean((self._torque(mass, x[rows]) * weight_t - y[rows]) ** 2)
            adam.zero_grad()
            loss.backward()
            adam.step()
            falling.step()
            if (step + 1) % max(1, self.steps // 20) == 0:
                progress(f"Lagrangian network: step {step + 1}, loss {float(loss.detach()):.2e}")
        self._mass = mass.requires_grad_(False)
        layers = " and ".join(str(units) for units in self.hidden)
        return {"samples": len(x), "steps": self.steps, "inputs": self.columns.width}, (
            f"Mass matrix of {BASE_ROWS + self.columns.n} rows from layers of {layers} softplus "
            "units on cos q and sin q; gravity and the carrier's motion enter by mechanics.",
            f"ADAM with batches of {self.batch} for {self.steps} steps, rate {self.rate:g} "
            "falling along half a cosine, float32.",
        )

    def _sizes(self, X: Array, torque: Array) -> Array:
        """Order of the factor's entries (6 + n, 6 + n).

        Row i of M times the accelerations is the torque t_i; with accelerations r_j and a
        diagonal e_j = √(t_j / r_j) that makes L_ij = t_i / (r_j e_j). The wrench on the carrier
        is taken to be as large as the largest torque.
        """
        motion = self.columns.carrier(X)
        rate = np.concatenate([motion.a, motion.dw, self.columns.joints(X)[2]], axis=1)
        rates = np.maximum(np.sqrt(np.mean(rate**2, axis=0)), 1e-9)
        wrench = np.append(np.full(BASE_ROWS, torque.max()), torque)
        return wrench[:, None] / np.sqrt(wrench * rates)

    def _torque(self, mass: MassNetwork, x: Tensor) -> Tensor:
        """Torques of rows of X, the frame flying along with the carrier."""
        n = self.columns.n
        q, dq, ddq, w, a, dw = torch.split(x[:, : 3 * n + 9], [n, n, n, 3, 3, 3], dim=1)
        return lagrange_torque(mass, q, dq, ddq, FrameMotion(torch.zeros_like(w), w, a, dw))

    def _answer(self, x: Array) -> Array:
        place = self._mass.last.weight.device
        torque = self._torque(self._mass, torch.from_numpy(x).float().to(place))
        return torque.detach().double().cpu().numpy()


class RegressorLeastSquares(Baseline):
    """Inertial parameters of an arm from its torques, weighted by joint, smallest norm."""

    def __init__(self, columns: Columns, parents: Sequence[int], lam: Array) -> None:
        """With a known body schema.

        Args:
            columns: layout of X.
            parents: for each joint of the arm the arm's link that it hangs on, -1 for the
                carrier (`sub_parents`).
            lam: (n, 6) λ of these joints.
        """
        self.tree = Tree(tuple(parents), floating=True)
        self.columns, self.lam = columns, np.asarray(lam, dtype=np.float64)

    def _learn(self, X: Array, Y: Array, progress: Progress) -> Told:
        """Solve with equal weights, then with each joint's rest as its noise."""
        self.columns.check(X, Y)
        every = row_factors(self._samples(X, Y), self.lam)
        rows = [row for row in every if row.kind == "torque"]  # nothing measures the wrench
        progress(f"least squares: {len(X)} samples are taken in")
        std = size = scales(rows)
        theta, links = np.zeros((self.tree.bodies, 10)), tuple(range(1, self.tree.bodies))
        for _ in range(2):
            found = least_squares_theta(*system(rows, std, links), np.zeros((self.tree.n, 10)))
            theta[1:] = found.theta
            # no joint's torque is taken for better than this share of its size
            std = np.maximum([row.residual(theta) for row in rows], 1e-12 * size)
        self._theta = theta
        return {"samples": len(X), "parameters": theta[1:].size, "rank": found.rank}, (
            "λ is known; θ by weighted least squares (QR), the weights from each joint's rest, "
            "the solution of smallest norm.",
        )

    def _samples(self, x: Array, y: Array | None = None) -> TreeData:
        """Rows of X as samples of the arm as a tree on its carrier."""
        tau = np.zeros((len(x), self.tree.rows))
        tau[:, BASE_ROWS:] = 0.0 if y is None else y
        return TreeData(self.tree, *self.columns.joints(x), tau, self.columns.carrier(x))

    def _answer(self, x: Array) -> Array:
        return predicted_torques(self._samples(x), self.lam, self._theta)[:, BASE_ROWS:]
