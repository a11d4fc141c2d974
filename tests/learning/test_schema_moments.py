"""Cost, gradient and curvature of λ from second moments, against sums over samples."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch

from adapter.learning.schema import RestingBase, Schema
from adapter.learning.schema_kernels import (
    N_SIGNALS,
    PRODUCTS,
    Count,
    accumulate,
    channel_cost,
    signals,
    without_noise,
)
from adapter.learning.settings import SchemaSettings
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.spatial import exp_rotation
from adapter.model.tree import Tree
from adapter.physics.kernels import base_at_rest
from adapter.physics.networks import skew, turn_z
from tests.helpers.tree_motion import in_motion, random_tree_text

CHANNELS = range(3)
SEEDS = range(4)


class Data:
    """Random motion of a parent and a child that don't belong together, and their moments."""

    def __init__(self, seed: int, keep: float = 1.0) -> None:
        rng, samples = np.random.default_rng(seed), 40
        self.slides, self.ddq = bool(seed % 2), rng.normal(size=samples)
        self.q, self.dq = rng.normal(size=(2, samples)) * 2.0
        self.parent, self.child = rng.normal(size=(2, samples, 12))
        self.R = exp_rotation(rng.normal(size=3))
        self.p = rng.normal(size=3) * 0.5
        self.M = np.zeros((3, 15, 15))
        self.s = np.full((samples, 3, 15), np.nan)
        for m in range(samples):
            joint = self.q[m], self.dq[m], self.ddq[m]
            signals(self.slides, joint, self.parent[m], self.child[m], self.s[m])
            accumulate(self.s[m], keep, self.M)

    def residuals(self, ch: int, R: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
        """y - R0^T z (m, 3), straight from eqs. 8a to 8c."""
        v, w, a, dw = (torch.from_numpy(self.parent[:, k : k + 3]) for k in (0, 3, 6, 9))
        cross = torch.linalg.cross
        P = p.expand_as(w)
        z = (w, v + cross(w, P), a + cross(dw, P) + cross(w, cross(w, P)))[ch]
        own = torch.from_numpy(self.child[:, (3, 0, 6)[ch] : (6, 3, 9)[ch]])
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        q, dq, ddq = (torch.from_numpy(x)[:, None] * axis for x in (self.q, self.dq, self.ddq))
        if self.slides:  # what the way along the axis makes, seen from the child
            spin, turning = (torch.from_numpy(self.child[:, k : k + 3]) for k in (3, 9))
            far = cross(turning, q) + cross(spin, cross(spin, q)) + 2.0 * cross(spin, dq) + ddq
            return own - (torch.zeros_like(q), dq + cross(spin, q), far)[ch] - z @ R
        return turn_z(torch.from_numpy(self.q), own - dq if ch == 0 else own) - z @ R

    def moved(self, ch: int, x: torch.Tensor) -> torch.Tensor:
        """Residuals (3 m,) after a turn and shift x (6,) of the frame."""
        turn = torch.linalg.matrix_exp(skew(x[:3]))
        R, p = torch.from_numpy(self.R) @ turn, torch.from_numpy(self.p) + x[3:]
        return self.residuals(ch, R, p).ravel()

    def cost(self, ch: int, curved: bool = True):
        """Cost, gradient and curvature of the kernel."""
        g, H = np.zeros(6), np.zeros((6 if curved else 0, 6))
        return channel_cost(self.M, ch, self.R, self.p, g, H), g, H


@pytest.mark.parametrize("ch", CHANNELS)
@pytest.mark.parametrize("seed", SEEDS)
def test_cost_gradient_and_curvature_are_those_of_the_samples(ch: int, seed: int) -> None:
    """The summed squared residual, its gradient by autograd and Gauss-Newton's curvature."""
    data = Data(seed)
    x = torch.zeros(6, dtype=torch.float64)
    residuals = data.moved(ch, x).numpy()
    jacobian = torch.autograd.functional.jacobian(lambda x: data.moved(ch, x), x).numpy()
    cost, g, H = data.cost(ch)
    assert cost == pytest.approx(float((residuals**2).sum()), rel=1e-12)
    for found, expected in ((g, jacobian.T @ residuals), (H, jacobian.T @ jacobian)):
        assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()
    assert np.allclose(H, H.T, rtol=0, atol=1e-12 * np.abs(H).max())


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("keep", [1.0, 0.9])
def test_moments_are_sums_over_samples_that_fade(seed: int, keep: float) -> None:
    data = Data(seed, keep)
    weight = keep ** np.arange(len(data.q) - 1, -1, -1.0)
    for ch, width in enumerate(N_SIGNALS):
        k = 3 + width
        s = data.s[:, ch, :k]
        assert np.isfinite(s).all()
        expected = (s * weight[:, None]).T @ s
        assert np.allclose(data.M[ch, :k, :k], expected, rtol=1e-12, atol=1e-12)
        assert (data.M[ch, k:] == 0.0).all() and (data.M[ch, :, k:] == 0.0).all()


def one_link(up, q, dq, ddq, schema, j, turn, shift):  # type: ignore[no-untyped-def]
    """Motion [v w a] (m, 9) of link j from its parent's row (m, 12), its frame turned, shifted."""
    R = torch.from_numpy(schema.R0[j].copy()) @ torch.linalg.matrix_exp(skew(turn))
    p = (torch.from_numpy(schema.p[j].copy()) + shift).expand(len(q), 3)
    v, w, a, dw = up[:, :3], up[:, 3:6], up[:, 6:9], up[:, 9:]
    cross = torch.linalg.cross
    moved = v + cross(w, p), w, a + cross(dw, p) + cross(w, cross(w, p))
    into = [turn_z(-q, x @ R) for x in moved]
    into[1] = into[1] + torch.stack([0 * dq, 0 * dq, dq], dim=1)
    return torch.cat(into, dim=1)


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("parents", [(-1, -1, 0, 0, 2), (-1, 0, 1, 1, -1, 4)])
def test_gradient_of_a_tree_is_autograds(parents, floating: bool, velocities: bool) -> None:
    """The profiled cost of each joint's channels, by turns about and shifts of its frame."""
    rng, tree, m = np.random.default_rng(len(parents)), Tree(parents, floating), 60
    q, dq, ddq = rng.normal(size=(3, m, tree.n))
    links, base = rng.normal(size=(m, tree.n, 12)), rng.normal(size=(m, 12))
    if not floating:
        base[:] = base_at_rest(np.array([0.1, -0.2, -9.8]))
    if not velocities:
        links[..., :3], base[:, :3] = 0.0, 0.0
    schema = Schema(tree, None if floating else RestingBase(-base[0], base[0]), SchemaSettings())
    zero = np.zeros((m, tree.rows))
    bodies = [BodyMotion(x[..., 3:6], x[..., 6:9], x[..., 9:], x[..., :3]) for x in (base, links)]
    states = TreeData(tree, q, dq, ddq, zero, *bodies).states()
    for part in (states[:1], states[1:20], states[20:]):
        schema.absorb(part)
    schema.updates = 1  # the gradient alone; how far steps may go is another matter
    schema.compute_gradient()
    turn = torch.zeros(tree.n, 3, dtype=torch.float64, requires_grad=True)
    shift = torch.zeros(tree.n, 3, dtype=torch.float64, requires_grad=True)
    cost = torch.zeros((), dtype=torch.float64)
    signals = [torch.from_numpy(x) for x in (q, dq, ddq)]
    for j, i in enumerate(tree.parent):
        up = torch.from_numpy(base if i < 0 else links[:, i])
        hat = one_link(up, *(s[:, j] for s in signals), schema, j, turn[j], shift[j])
        seen = torch.from_numpy(links[:, j])
        for channel in (0, 1, 2) if velocities else (1, 2):  # v, w, a
            part = slice(3 * channel, 3 * channel + 3)
            square = ((hat[:, part] - seen[:, part]) ** 2).sum()
            own = seen[:, part] - torch.eye(3)[2] * signals[1][:, j, None] * (channel == 1)
            count = 3.0 * m
            loose = count * 1e-8 + 1e-6 * float((own**2).sum())  # floors of the weights
            cost = cost + 0.5 * square * (count / (square.detach() + loose))
    gradients = torch.autograd.grad(cost / m, (turn, shift))
    expected = np.concatenate([g.numpy() for g in gradients], axis=1)
    assert np.abs(schema.gradient - expected).max() < 1e-9 * np.abs(expected).max()


# Standard deviations of v, w, a, dw of the base and of link 0, each another.
STD = np.array([[0.02, 0.05, 0.3, 0.4], [0.03, 0.04, 0.2, 0.6]])
SIGNS = np.array(list(product((-1.0, 1.0), repeat=3)))


def moments_of(motion: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """M (2, 3, 15, 15) of a chain of two joints, from motion (m, 3, 12) of base and links."""
    M, s = np.zeros((2, 3, 15, 15)), np.zeros((3, 15))
    for m in range(len(motion)):
        for j in range(2):
            signals(False, (q[m, j], dq[m, j], 0.0), motion[m, j], motion[m, j + 1], s)
            accumulate(s, 1.0, M[j])
    return M


@pytest.mark.parametrize("velocities", [True, False])
def test_moments_without_their_known_noise_are_those_of_the_exact_motion(velocities: bool) -> None:
    """Every sample comes with each sign of the noise of each axis, so nothing is left to chance.

    A product w_x w_y has noise of variance s² (w_x² + w_y²), a square w_x² of 4 s² w_x², beside
    a constant s²; the constant is no noise and stays, which is 2 s² w_x² of the second moment.
    """
    rng = np.random.default_rng(6)
    m, variance = 40, np.vstack([STD, np.zeros(4)]) ** 2
    exact, (q, dq) = rng.normal(size=(m, 3, 12)), rng.normal(size=(2, m, 2))
    if not velocities:
        exact[:, :, :3], variance[:, 0] = 0.0, 0.0
    noise = (SIGNS[:, None, None] * np.sqrt(variance)[..., None]).reshape(len(SIGNS), 3, 12)
    motion = (exact[:, None] + noise).reshape(-1, 3, 12)
    q, dq, exact = (np.repeat(x, len(SIGNS), axis=0) for x in (q, dq, exact))
    M, true = moments_of(motion, q, dq), moments_of(exact, q, dq)
    counts, clean = np.zeros(len(Count)), np.full_like(M, np.nan)
    counts[Count.SAMPLES], counts[Count.VELOCITIES] = len(motion), velocities
    without_noise(np.array([-1, 0]), M, counts, variance, clean)

    def diagonal(x: np.ndarray, channel: int, part: slice) -> np.ndarray:
        return np.diagonal(x[:, channel], axis1=1, axis2=2)[:, part]

    linear = [(0, slice(3, 6)), (2, slice(3, 6))]
    linear += [(1, slice(3, 9))] if velocities else [(2, slice(6, 9))]
    for channel, part in linear:
        theirs = diagonal(true, channel, part)
        assert np.allclose(diagonal(clean, channel, part), theirs, rtol=1e-12)
        assert not np.allclose(diagonal(M, channel, part), theirs, rtol=1e-6)
    off = ~np.eye(15, dtype=bool)
    kept = clean[:, 0][:, off], clean[:, 2, :6, :6][:, off[:6, :6]]
    assert all(map(np.array_equal, kept, (M[:, 0][:, off], M[:, 2, :6, :6][:, off[:6, :6]])))
    if velocities:
        assert not clean[:, 2, 6:].any() and not clean[:, 2, :, 6:].any()
        return
    assert not clean[:, 1].any()
    power, s2 = diagonal(true, 0, slice(3, 6)), variance[:2, 1]
    for k, (x, y) in enumerate(PRODUCTS):
        raw, ours, theirs = (z[:, 2, 9 + k, 9 + k] for z in (M, clean, true))
        stays = 2.0 * s2 * power[:, x] if x == y else 0.0
        assert np.allclose(ours - theirs, stays, atol=0.01 * (raw - theirs).min())


NOISE = {"v": 6e-3, "w": 1e-3, "a": 8e-2, "dw": 2e-1}


@pytest.mark.parametrize("channel", NOISE)
@pytest.mark.parametrize("floating", [True, False])
def test_each_channels_own_noise_is_found_and_taken_out(channel: str, floating: bool) -> None:
    """One channel is five times as noisy as usual; the others are told to be what they are."""
    model, data = in_motion(random_tree_text(4, 5), floating, 2.0, 5)
    rng, levels = np.random.default_rng(2), {**NOISE, channel: 5 * NOISE[channel]}

    def noisy(motion: BodyMotion) -> BodyMotion:
        parts = {k: getattr(motion, k) for k in levels}
        return BodyMotion(**{k: x + levels[k] * rng.normal(size=x.shape) for k, x in parts.items()})

    rest = None if floating else RestingBase(*[base_at_rest(model.gravity)] * 2)
    base = noisy(data.base) if floating else data.base
    blurred = replace(data, base=base, links=noisy(data.links))
    exact, schema = (Schema(model.tree, rest, SchemaSettings()) for _ in range(2))
    for one, samples in ((exact, data), (schema, blurred)):
        one.set_lam(model.lam)
        one.absorb(samples.states())
    found = schema.noise_variance()
    true = np.array([levels[k] for k in ("v", "w", "a", "dw")]) ** 2
    bodies = found if floating else found[1:]
    inner = sorted({i + 1 for i in model.tree.parent if i >= 0 or floating})
    assert (bodies < 1.3 * true).all() and (found[inner] > 0.75 * true).all()
    if not floating:
        assert not found[0].any()
    clean = np.empty_like(schema.moments.M)
    without_noise(schema._parent, schema.moments.M, schema.moments.counts, found, clean)
    for part, number in ((slice(3, 6), 0), (slice(3, 6), 1), (slice(6, 9), 1), (slice(3, 6), 2)):
        for j, i in enumerate(model.tree.parent):
            if i < 0 and not floating:
                continue
            level = {0: 1, 1: 0 if part.start == 3 else 1, 2: 2}[number]
            ours, theirs = (M[j, number, part, part].trace() for M in (clean, exact.moments.M))
            raw = schema.moments.M[j, number, part, part].trace()
            noise = 3 * schema.count * true[level]
            spread = 8.0 * np.sqrt(theirs * true[level]) + 0.2 * noise  # of motion times noise
            assert abs(ours - theirs) < spread
            assert raw - ours == pytest.approx(3 * schema.count * found[i + 1, level])
