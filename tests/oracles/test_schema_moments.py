"""Cost, gradient and curvature of λ from second moments, against sums over samples."""

import numpy as np
import pytest
import torch

from adapter.kinematics import joint_rotation
from adapter.schema_kernels import DERIVATIVES, N_SIGNALS, accumulate, channel_cost, signals
from adapter.spatial import exp_rotation, matrix_from_zxz

CHANNELS = range(3)
SEEDS = range(4)


class Data:
    """Random motion of a parent and a child that don't belong together, and their moments."""

    def __init__(self, seed: int, samples: int = 40, keep: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        self.q, self.dq = rng.normal(size=(2, samples)) * 2.0
        self.parent, self.child = rng.normal(size=(2, samples, 12))
        self.R = exp_rotation(rng.normal(size=3))
        self.p = rng.normal(size=3) * 0.5
        self.M = np.zeros((3, 15, 15))
        self.s = np.full((samples, 3, 15), np.nan)
        for m in range(samples):
            signals(self.q[m], self.dq[m], self.parent[m], self.child[m], self.s[m])
            accumulate(self.s[m], keep, self.M)

    def residuals(self, ch: int, R: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
        """y - R0^T z (m, 3), straight from eqs. 8a to 8c."""
        v, w, a, dw = (torch.from_numpy(self.parent[:, k : k + 3]) for k in (0, 3, 6, 9))
        cross = torch.linalg.cross
        P = p.expand_as(w)
        own = torch.from_numpy(self.child[:, (3, 0, 6)[ch] : (6, 3, 9)[ch]])
        if ch == 0:
            z = w
            own = own - torch.from_numpy(self.dq)[:, None] * torch.tensor([0.0, 0.0, 1.0])
        elif ch == 1:
            z = v + cross(w, P)
        else:
            z = a + cross(dw, P) + cross(w, cross(w, P))
        c, s = np.cos(self.q), np.sin(self.q)
        turn = np.zeros((len(c), 3, 3))
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = c, -s, s, c
        turn[:, 2, 2] = 1.0
        y = torch.einsum("mab,mb->ma", torch.from_numpy(turn), own)
        return y - z @ R

    def moved(self, ch: int, x: torch.Tensor) -> torch.Tensor:
        """Residuals (3 m,) after a turn and shift x (6,) of the frame."""
        a, b, c = x[:3]
        zero = torch.zeros_like(a)
        turn = torch.linalg.matrix_exp(
            torch.stack([zero, -c, b, c, zero, -a, -b, a, zero]).reshape(3, 3)
        )
        R, p = torch.from_numpy(self.R) @ turn, torch.from_numpy(self.p) + x[3:]
        return self.residuals(ch, R, p).ravel()

    def cost(self, ch: int, R=None, p=None, curved: bool = True):
        """Cost, gradient and curvature of the kernel."""
        g, H = np.zeros(6), np.zeros((6, 6))
        R = self.R if R is None else R
        c = channel_cost(
            self.M,
            DERIVATIVES,
            ch,
            np.ascontiguousarray(R),
            self.p if p is None else p,
            curved,
            g,
            H,
        )
        return c, g, H


@pytest.mark.parametrize("ch", CHANNELS)
@pytest.mark.parametrize("seed", SEEDS)
def test_cost_is_the_summed_squared_residual(ch: int, seed: int) -> None:
    data = Data(seed)
    expected = float((data.moved(ch, torch.zeros(6).double()) ** 2).sum())
    assert data.cost(ch)[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("ch", CHANNELS)
@pytest.mark.parametrize("seed", SEEDS)
def test_gradient_is_autograds(ch: int, seed: int) -> None:
    data = Data(seed)
    x = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    (0.5 * (data.moved(ch, x) ** 2).sum()).backward()
    expected = x.grad.numpy()
    assert np.abs(data.cost(ch)[1] - expected).max() < 1e-10 * np.abs(expected).max()


@pytest.mark.parametrize("ch", CHANNELS)
@pytest.mark.parametrize("seed", SEEDS)
def test_gradient_is_the_slope_of_the_cost(ch: int, seed: int) -> None:
    data, step = Data(seed), 1e-5
    _, g, _ = data.cost(ch)
    for k in range(6):
        x = step * np.eye(6)[k]
        up, down = (
            data.cost(ch, data.R @ exp_rotation(sign * x[:3]), data.p + sign * x[3:])[0]
            for sign in (1.0, -1.0)
        )
        assert g[k] == pytest.approx(0.25 * (up - down) / step, rel=1e-5, abs=1e-4)


@pytest.mark.parametrize("ch", CHANNELS)
@pytest.mark.parametrize("seed", SEEDS)
def test_curvature_is_gauss_newtons(ch: int, seed: int) -> None:
    data = Data(seed)
    jacobian = torch.autograd.functional.jacobian(
        lambda x: data.moved(ch, x), torch.zeros(6, dtype=torch.float64)
    ).numpy()
    expected = jacobian.T @ jacobian
    H = data.cost(ch)[2]
    assert np.abs(H - expected).max() < 1e-10 * np.abs(expected).max()
    assert np.allclose(H, H.T, rtol=0, atol=1e-12 * np.abs(H).max())


@pytest.mark.parametrize("ch", CHANNELS)
def test_gradient_and_curvature_are_added_to_what_is_there(ch: int) -> None:
    data = Data(0)
    _, g, H = data.cost(ch)
    more_g, more_H = np.ones(6), np.ones((6, 6))
    channel_cost(data.M, DERIVATIVES, ch, data.R, data.p, True, more_g, more_H)
    assert np.allclose(more_g, 1.0 + g, rtol=1e-12, atol=1e-9)
    assert np.allclose(more_H, 1.0 + H, rtol=1e-12, atol=1e-9)


def test_without_curvature_none_is_touched() -> None:
    data = Data(1)
    c, g, H = data.cost(1, curved=False)
    full = data.cost(1)
    assert (H == 0.0).all()
    assert c == full[0] and np.array_equal(g, full[1])


@pytest.mark.parametrize("seed", SEEDS)
def test_moments_are_sums_over_samples(seed: int) -> None:
    data = Data(seed)
    for ch, width in enumerate(N_SIGNALS):
        k = 3 + width
        s = data.s[:, ch, :k]
        assert np.isfinite(s).all()
        assert np.allclose(data.M[ch, :k, :k], s.T @ s, rtol=1e-12, atol=1e-12)
        assert (data.M[ch, k:] == 0.0).all() and (data.M[ch, :, k:] == 0.0).all()


def test_forgotten_moments_are_weighted_sums() -> None:
    keep = 0.9
    data = Data(5, keep=keep)
    weight = keep ** np.arange(len(data.q) - 1, -1, -1.0)
    for ch, width in enumerate(N_SIGNALS):
        s = data.s[:, ch, : 3 + width]
        expected = (s * weight[:, None]).T @ s
        assert np.allclose(data.M[ch, : 3 + width, : 3 + width], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_cost_of_the_true_frame_is_zero(seed: int) -> None:
    """Motion made by eqs. 8a to 8c with numpy alone, for angles of the paper's z-x-z triple."""
    rng = np.random.default_rng(seed)
    lam = rng.normal(size=6)
    R0, p = matrix_from_zxz(lam[:3]), lam[3:]
    assert np.allclose(R0, joint_rotation(torch.from_numpy(lam)).numpy(), atol=1e-14)
    M, s = np.zeros((3, 15, 15)), np.zeros((3, 15))
    for _ in range(30):
        q, dq = rng.normal(size=2)
        up = rng.normal(size=12)
        v, w, a, dw = up.reshape(4, 3)
        c, t = np.cos(q), np.sin(q)
        R = R0 @ np.array([[c, -t, 0.0], [t, c, 0.0], [0.0, 0.0, 1.0]])
        acceleration = a + np.cross(dw, p) + np.cross(w, np.cross(w, p))
        own = np.concatenate(
            [R.T @ (v + np.cross(w, p)), R.T @ w + [0, 0, dq], R.T @ acceleration, np.zeros(3)]
        )
        signals(q, dq, up, own, s)
        accumulate(s, 1.0, M)
    for ch in CHANNELS:
        g, H = np.zeros(6), np.zeros((6, 6))
        power = np.trace(M[ch, :3, :3])
        cost = channel_cost(M, DERIVATIVES, ch, R0, p, True, g, H)
        assert abs(cost) < 1e-12 * power
        assert np.abs(g).max() < 1e-12 * power
