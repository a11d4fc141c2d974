"""The online learner of a floating tree: its moments and gradients, and λ and θ come back."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from tree_motion import in_motion, random_tree_text, with_noise

from adapter.dynamics import inverse_dynamics, regressor, skew, theta_from_log_cholesky_torch
from adapter.errors import ModelError
from adapter.identifiability import frame_observability
from adapter.inertia import is_consistent
from adapter.kinematics import link_motion, turn_z
from adapter.outcome import frame_errors
from adapter.spatial import matrix_from_zxz
from adapter.tree import Tree
from adapter.tree_data import BodyMotion, TreeData
from adapter.tree_learner import (
    TreeLearner,
    TreeLearnerSettings,
    TreeSample,
    motion_rows,
    samples_of,
)
from adapter.tree_schema import TreeSchema
from adapter.tree_theta import HANGING_SHARE, TreeTheta

SEEDS = range(3)
PARENTS = ((-1, -1, 0, 0, 2, 1, 3), (-1, 0, 1, 1, -1, 4), (-1, 0, 0, -1, 3, 3, 5, 2))
BRANCH_OF_FIRST = {0: (0, 2, 3, 4, 6), 1: (0, 1, 2, 3), 2: (0, 1, 2, 7)}  # links, by seed


def random_samples(seed: int, floating: bool, rows: int = 60) -> tuple[TreeData, np.ndarray]:
    """Samples of a random tree in unrelated random states, torques noise, and its λ."""
    rng = np.random.default_rng(seed)
    tree = Tree(PARENTS[seed], floating)
    lam = rng.normal(size=(tree.n, 6))
    q, dq, ddq = rng.normal(size=(3, rows, tree.n))
    v, w, a, dw = rng.normal(size=(4, rows, 3))
    tau = rng.normal(size=(rows, tree.rows))
    return TreeData(tree, q, dq, ddq, tau, BodyMotion(w, a, dw, v)), lam


def frames_of(lam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(matrix_from_zxz(lam[:, :3])), np.ascontiguousarray(lam[:, 3:])


def absorbed(data: TreeData, lam: np.ndarray) -> TreeTheta:
    """θ's learner with random parameters after all samples, in three parts."""
    theta = TreeTheta(data.tree, noise_gain=3.0)
    theta.x += 0.3 * np.random.default_rng(7).normal(size=theta.P)
    theta.mean[:] = theta.x
    theta.after_step()
    for part in np.array_split(np.arange(len(data)), 3):
        d = data.take(part)
        theta.absorb(*frames_of(lam), (d.q, d.dq, d.ddq, d.tau, motion_rows(d.base)))
    return theta


def torch_rows(data: TreeData, lam: np.ndarray) -> np.ndarray:
    signals = data.joint_signals()
    return regressor(data.tree, torch.from_numpy(lam), *signals, data.base.torch()).numpy()


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("seed", SEEDS)
def test_moments_are_those_of_the_networks_regressor(seed: int, floating: bool) -> None:
    data, lam = random_samples(seed, floating)
    theta = absorbed(data, lam)
    Y, first = torch_rows(data, lam), data.tree.rows - data.tree.n
    assert theta.count == len(data)
    for j in range(data.tree.n):
        at = theta.place[j, : theta.sizes[j]]
        z = np.concatenate([Y[:, first + j, at], data.tau[:, first + j, None]], axis=1)
        expected = z.T @ z
        assert np.abs(theta.joint_moments(j) - expected).max() < 1e-9 * np.abs(expected).max()
        unseen = np.setdiff1d(np.arange(theta.P), at)
        assert np.abs(Y[:, first + j, unseen]).max() == 0.0  # the row holds all there is
    for h, rows in enumerate((slice(0, 3), slice(3, 6)) if floating else ()):
        left = Y[:, rows][:, :, theta.near]
        whole = np.concatenate([Y[:, rows], data.tau[:, rows, None]], axis=2)
        expected = np.einsum("mra,mrb->ab", left, whole)
        assert np.abs(theta.C[h] - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_branch_is_its_block_of_the_normal_equations(seed: int) -> None:
    data, lam = random_samples(seed, True)
    theta = absorbed(data, lam)
    theta.compute_gradient()
    at, H, rhs = theta.information(0)
    links = BRANCH_OF_FIRST[seed]
    assert list(at) == [10 * (k + 1) + i for k in links for i in range(10)]
    Y = torch_rows(data, lam)[:, 6:][:, links]
    weight = 1.0 / (3.0 * theta.variance[list(links)])
    expected = np.einsum("mja,j,mjb->ab", Y, weight, Y)[np.ix_(at, at)] + np.diag(theta.prior[at])
    right = np.einsum("mja,j,mj->a", Y, weight, data.tau[:, 6:][:, links])[at]
    assert np.abs(H - expected).max() < 1e-9 * np.abs(expected).max()
    assert np.allclose(rhs, right + theta.prior[at] * theta.prior_mean[at], rtol=1e-9, atol=1e-9)
    with pytest.raises(ModelError, match="does not hang on the base"):
        theta.information(links[1])


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("seed", SEEDS)
def test_gradient_is_autograds_through_the_networks(seed: int, floating: bool) -> None:
    data, lam = random_samples(seed, floating)
    theta = absorbed(data, lam)
    assert theta.compute_gradient()
    ours = theta.gradient.copy()
    theta.A[:], theta.C[:] = 0.0, 0.0
    weights, variance = theta.base_weights(), theta.variance.copy()
    theta.compute_gradient()
    ours -= theta.gradient  # priors, whatever they are, cancel
    first = data.tree.rows - data.tree.n
    x = torch.tensor(theta.x, requires_grad=True)
    body = theta_from_log_cholesky_torch(x.reshape(-1, 10))
    signals = torch.from_numpy(lam), body, *data.joint_signals()
    error = inverse_dynamics(data.tree, *signals, data.base.torch()) - torch.from_numpy(data.tau)
    mean_square = (error[:, first:] ** 2).mean(dim=0).detach().numpy()
    assert np.allclose(variance, mean_square + theta.model_variance, rtol=1e-9)
    joints = (error[:, first:] ** 2 / torch.from_numpy(3.0 * variance)).sum() / (2 * len(data))
    (expected,) = torch.autograd.grad(joints, x, retain_graph=True)
    if floating:
        wrench = (error[:, :6] ** 2 * torch.from_numpy(np.repeat(weights, 3))).sum()
        (extra,) = torch.autograd.grad(wrench / (2 * len(data)), x)
        share = torch.zeros(theta.P, dtype=torch.float64)
        share[theta.near] = HANGING_SHARE
        share[:10] = 1.0
        expected = expected + share * extra
    assert np.abs(ours - expected.numpy()).max() < 1e-9 * np.abs(expected.numpy()).max()


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("seed", SEEDS)
def test_gradient_of_lambda_is_autograds(seed: int, velocities: bool) -> None:
    """The profiled cost of each joint's channels, by turns about and shifts of its frame."""
    data, lam = random_samples(seed, True)
    tree = data.tree
    signals = data.joint_signals()
    moving = link_motion(tree, torch.from_numpy(lam), *signals, data.base.torch())
    v, w, a, dw = (x[:, 1:].numpy() for x in moving)
    rng = np.random.default_rng(seed)
    links = np.concatenate([v, w, a, dw], axis=2) + 0.1 * rng.normal(size=(len(data), tree.n, 12))
    base = motion_rows(data.base)
    if not velocities:
        links[..., :3], base[:, :3] = 0.0, 0.0
    schema = TreeSchema(tree, seed=seed)
    for k in range(len(data)):
        schema.absorb(k * 10**6, data.q[k], data.dq[k], data.ddq[k], base[k], links[k])
    schema.learner.updates = 1  # the gradient alone; how far steps may go is another matter
    schema.compute_gradient()
    turn = torch.zeros(tree.n, 3, dtype=torch.float64, requires_grad=True)
    shift = torch.zeros(tree.n, 3, dtype=torch.float64, requires_grad=True)
    cost = torch.zeros((), dtype=torch.float64)
    for j, i in enumerate(tree.parent):
        up = torch.from_numpy(base if i < 0 else links[:, i])
        hat = _one_link(up, *(s[:, j] for s in signals), schema, j, turn[j], shift[j])
        seen = torch.from_numpy(links[:, j])
        for channel in (0, 1, 2) if velocities else (1, 2):  # v, w, a
            part = slice(3 * channel, 3 * channel + 3)
            square = ((hat[:, part] - seen[:, part]) ** 2).sum()
            power = (seen[:, part] - torch.eye(3)[2] * signals[1][:, j, None] * (channel == 1)) ** 2
            count = 3.0 * len(data)
            loose = count * 1e-8 + 1e-6 * float(power.sum())  # floors of the weights
            cost = cost + 0.5 * square * (count / (square.detach() + loose))
    gradients = torch.autograd.grad(cost / len(data), (turn, shift))
    expected = np.concatenate([g.numpy() for g in gradients], axis=1)
    found = schema.learner.gradient[1:]
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()
    assert np.abs(schema.learner.gradient[0]).max() == 0.0  # the base hangs on nothing


def _one_link(up, q, dq, ddq, schema, j, turn, shift):  # type: ignore[no-untyped-def]
    """Motion [v w a] (m, 9) of link j from its parent's row (m, 12), its frame turned, shifted."""
    R = torch.from_numpy(schema.R0[j].copy()) @ torch.linalg.matrix_exp(skew(turn))
    p = (torch.from_numpy(schema.p[j].copy()) + shift).expand(len(q), 3)
    v, w, a, dw = up[:, :3], up[:, 3:6], up[:, 6:9], up[:, 9:]
    cross = torch.linalg.cross
    moved = v + cross(w, p), w, a + cross(dw, p) + cross(w, cross(w, p))
    into = [turn_z(-q, x @ R) for x in moved]
    into[1] = into[1] + torch.stack([0 * dq, 0 * dq, dq], dim=1)
    return torch.cat(into, dim=1)


@cache
def falling(seed: int) -> tuple:
    """A random floating tree of six joints: model, two motions to learn from, one to judge by."""
    text = random_tree_text(6, seed)
    model, first = in_motion(text, True, 3.0, 10 * seed)
    others = [in_motion(text, True, s, 10 * seed + k)[1] for k, s in ((1, 3.0), (2, 0.5))]
    return model, (first, others[0]), others[1]


def bare(data: TreeData) -> TreeData:
    """What gyroscopes and accelerometers leave: no velocities."""
    assert data.links is not None
    return replace(data, base=replace(data.base, v=None), links=replace(data.links, v=None))


@pytest.mark.parametrize("seed,kind", [(1, "all"), (2, "bare"), (3, "carried")])
def test_a_falling_tree_is_learned_online(seed: int, kind: str) -> None:
    model, parts, test = falling(seed)
    learner = TreeLearner(model.tree, links_dw=kind != "carried")
    for k, part in enumerate(parts):
        data = with_noise(part if kind == "all" else bare(part), seed + k)
        if kind == "carried":
            assert data.links is not None
            data = replace(data, links=replace(data.links, dw=np.zeros_like(data.links.dw)))
        for sample in samples_of(data, first_ns=k * 10**10):
            assert learner.step(sample)
    seen = frame_observability(model.tree, model.lam, model.gravity)
    turn, shift = frame_errors(learner.schema.lam[None], model.lam, seen.projectors)
    assert learner.theta_started_ns is not None and learner.theta_started_ns < 4e9
    assert turn.max() < 2e-3 and shift.max() < 3e-3
    error = (learner.predict(test) - test.tau)[:, 6:]
    assert (error**2).mean() < 0.05**2 * (test.tau[:, 6:] ** 2).mean()
    in_use = learner.theta.th.copy()
    learner.theta.th[:] = learner.theta.least_squares()
    batch = (learner.predict(test) - test.tau)[:, 6:]
    learner.theta.th[:] = in_use
    assert (error**2).mean() < 1.5**2 * (batch**2).mean()
    assert is_consistent(learner.theta.theta)


def test_a_fixed_base_learns_too_with_fewer_updates() -> None:
    model, data = in_motion(random_tree_text(3, 4), False, 4.0, 4)
    learner = TreeLearner(model.tree, TreeLearnerSettings(update_every=2))
    for sample in samples_of(data.take(slice(0, 3500))):
        assert learner.step(sample)
    test = data.take(slice(3500, None))
    assert learner.updates == 1750 and learner.theta_started_ns is not None
    error = learner.predict(test) - test.tau
    assert np.sqrt((error**2).mean()) < 0.02 * np.sqrt((test.tau**2).mean())


def test_what_is_not_finite_is_refused_and_counted() -> None:
    model, parts, _ = falling(1)
    learner = TreeLearner(model.tree)
    samples = list(samples_of(parts[0]))
    for sample in samples[:600]:
        learner.step(sample)
    learner.theta_started_ns = learner.theta_started_ns or 0  # so that θ's moments are at risk too
    before = learner.adam.parameters.copy(), learner.schema.lam, learner.theta.A.copy()
    bad = 0
    for name in ("q", "dq", "ddq", "tau", "base", "links"):
        for value in (np.nan, np.inf, 1e300):
            part = getattr(samples[600], name).copy()
            part.flat[-1] = value
            assert not learner.step(replace(samples[600], **{name: part}))
            bad += 1
    assert learner.refused == bad and learner.learned == 600
    after = learner.adam.parameters, learner.schema.lam, learner.theta.A
    assert all(np.array_equal(x, y) for x, y in zip(before, after, strict=True))
    for sample in samples[600:1200]:
        assert learner.step(sample)
    assert np.isfinite(learner.adam.parameters).all() and np.isfinite(learner.theta.th).all()
    s = samples[0]
    wrong = TreeSample(0, s.q[:-1], s.dq, s.ddq, s.tau, s.base, s.links)
    with pytest.raises(ModelError, match=r"q, dq, ddq \(6,\)"):
        learner.step(wrong)
