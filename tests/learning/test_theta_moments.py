"""θ's moments on any tree, held to the torch networks: rows, cost and gradient, batch solution."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from adapter.effects.by_joint import SMOOTHING_DQ, JointSignals
from adapter.learning.settings import LearnerSettings, ThetaSettings
from adapter.learning.theta import HANGING_SHARE, PRIOR_STD, Filtered, KnownArm, Theta
from adapter.learning.theta_kernels import forget_along
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.spatial import matrix_from_zxz
from adapter.model.tree import Tree
from adapter.physics.kernels import base_at_rest
from adapter.physics.networks import (
    FrameMotion,
    regressor,
    theta_from_log_cholesky,
    theta_from_log_cholesky_torch,
)
from adapter.signals.records import StateLayout

SEEDS = range(3)
EFFECTS = ("viscous_friction", "coulomb_friction", "torque_offset")
PARENTS = ((-1, -1, 0, 0, 2, 1, 3), (-1, 0, 1, 1, -1, 4), (-1, 0, 1, 2, 3, 4, 5))
GAIN = 3.0  # noise_gain
TOOL = theta_from_log_cholesky(np.array([-0.5, -2, -2, -2, 0, 0, 0, 0.1, 0, 0.2]))
LINK = theta_from_log_cholesky(np.array([0.2, -2, -2, -2, 0, 0, 0, 0.1, 0, 0]))


@dataclass
class Case:
    """A tree in random states that don't follow one another, torques of pure noise, and its λ."""

    data: TreeData
    lam: np.ndarray

    @property
    def tree(self) -> Tree:
        return self.data.tree

    @property
    def frames(self) -> tuple[np.ndarray, np.ndarray]:
        lam = self.lam
        return np.ascontiguousarray(matrix_from_zxz(lam[:, :3])), np.ascontiguousarray(lam[:, 3:])

    def regressor(self) -> np.ndarray:
        """(m, rows, 10 bodies) by the torch network."""
        base = FrameMotion.of(self.data.base.rows())
        signals = tuple(map(torch.from_numpy, self.data.joints()))
        return regressor(self.tree, torch.from_numpy(self.lam), signals, base).numpy()

    def states(self, part: slice = slice(None)) -> np.ndarray:
        return self.data.states()[part]


def case(seed: int, floating: bool, rows: int = 61) -> Case:
    rng = np.random.default_rng(seed)
    tree = Tree(PARENTS[seed], floating)
    q, dq, ddq = rng.normal(size=(3, rows, tree.n))
    v, w, a, dw = rng.normal(size=(4, rows, 3))
    if not floating:
        v, w, dw, a = 0 * v, 0 * w, 0 * dw, np.tile([0.1, -0.2, 9.8], (rows, 1))
    data = TreeData(tree, q, dq, ddq, rng.normal(size=(rows, tree.rows)), BodyMotion(w, a, dw, v))
    return Case(data, rng.normal(size=(tree.n, 6)))


def make(of: Case, effects: tuple[str, ...] = EFFECTS, tool: np.ndarray | None = None, **settings):
    """θ of a tree; the hand is the last but one link, so that no place is taken by accident."""
    base = np.empty(0) if of.tree.floating else base_at_rest(np.array([-0.1, 0.2, -9.8]))
    known = KnownArm(hand=of.tree.n - 2, tool_theta=tool)
    how = LearnerSettings(effects=effects, theta=ThetaSettings(**settings))
    theta = Theta(of.tree, base, how, Filtered(GAIN), known)
    theta.rests[:] = 1.0
    return theta


def somewhere(theta: Theta, seed: int = 7) -> Theta:
    """With random parameters in use."""
    theta.x += 0.3 * np.random.default_rng(seed).normal(size=theta.P)
    theta.mean[:] = theta.x
    theta.after_step(settled=False)
    theta.updates = 0
    return theta


def full_rows(theta: Theta, of: Case) -> np.ndarray:
    """(m, rows, P) rows of the whole model, effects included."""
    n, Y = of.tree.n, of.regressor()
    out = np.zeros((*Y.shape[:2], theta.P))
    out[:, :, : Y.shape[2]] = Y
    if theta.spare_in_use:
        out[:, :, theta.spare] = out[:, :, theta.hand]
        out[:, :, theta.hand] = 0.0
    joint, first = np.arange(n), of.tree.rows - n
    for k, effect in enumerate(theta.effects):
        (column,) = effect.basis(JointSignals(of.data.q, of.data.dq, of.data.ddq))
        out[:, first + joint, 10 * theta.bodies + k * n + joint] = column
    return out


def both(floating: bool, seed: int, changed: bool = False) -> tuple[Theta, Case, np.ndarray]:
    """θ that has absorbed a case in parts of several sizes, the case, and its full rows."""
    of = case(seed, floating)
    theta = somewhere(make(of))
    if changed:
        theta.absorb(of.frames, of.states(slice(20)))
        theta.start_change()
    for part in np.array_split(np.arange(len(of.data)), 9):
        theta.absorb(of.frames, of.states(part))
    return theta, of, full_rows(theta, of)


ON_TREES = pytest.mark.parametrize("floating", [True, False])


@ON_TREES
@pytest.mark.parametrize("changed", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_moments_are_the_sums_over_samples(seed: int, floating: bool, changed: bool) -> None:
    theta, of, Y = both(floating, seed, changed)
    first = of.tree.rows - of.tree.n
    assert theta.count == len(of.data)
    for j in range(of.tree.n):
        at = theta.rows.place[j, : theta.rows.sizes[j]]
        z = np.concatenate([Y[:, first + j, at], of.data.tau[:, first + j, None]], axis=1)
        expected = z.T @ z
        assert np.abs(theta.joint_moments(j) - expected).max() < 1e-9 * np.abs(expected).max()
        unseen = np.setdiff1d(np.arange(theta.P), at)
        assert np.abs(Y[:, first + j, unseen]).max() == 0.0  # the row holds all there is
    for h, rows in enumerate((slice(0, 3), slice(3, 6)) if floating else ()):
        columns = Y[:, rows][:, :, theta.rows.base_place]
        whole = np.concatenate([columns, of.data.tau[:, rows, None]], axis=2)
        expected = np.einsum("mra,mrb->ab", columns[:, :, theta.rows.near], whole)
        assert np.abs(theta.moments.C[h] - expected).max() < 1e-9 * np.abs(expected).max()


@ON_TREES
@pytest.mark.parametrize("seed", SEEDS)
def test_errors_are_measured_minus_predicted(seed: int, floating: bool) -> None:
    of = case(seed, floating)
    theta = somewhere(make(of, tool=TOOL))
    carried = np.zeros(theta.P)
    carried[theta.hand] = TOOL
    expected = of.data.tau - full_rows(theta, of) @ (theta.th + carried)
    found = theta.errors(of.frames, of.states())
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    assert theta.count == 0 and (theta.moments.A == 0.0).all() and (theta.moments.C == 0.0).all()
    assert (theta.moments.base_level == 0.0).all()
    assert np.array_equal(theta.absorb(of.frames, of.states()), found)
    level = (found[:, : of.tree.rows - of.tree.n] ** 2).mean(axis=0)
    assert np.allclose(theta.moments.base_level, level)


@ON_TREES
def test_a_known_tool_leaves_the_moments_of_a_bare_hand(floating: bool) -> None:
    of = case(0, floating)
    bare, loaded = make(of), make(of, tool=TOOL)
    load = full_rows(bare, of)[:, :, bare.hand] @ TOOL
    bare.absorb(of.frames, of.states())
    with_tool = replace(of.data, tau=of.data.tau + load)
    loaded.absorb(of.frames, with_tool.states())
    for a, b in zip(bare.moments, loaded.moments, strict=True):
        assert np.allclose(a, b, rtol=1e-8, atol=1e-7)


@ON_TREES
@pytest.mark.parametrize("changed", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_information_is_that_of_the_normal_equations(
    seed: int, floating: bool, changed: bool
) -> None:
    theta, of, Y = both(floating, seed, changed)
    first = of.tree.rows - of.tree.n
    error = of.data.tau - Y @ theta.th
    mean = (error[:, first:] ** 2).sum(axis=0) + theta.floor_count * theta.floor
    variance = mean / (len(Y) + theta.floor_count) + theta.model_variance
    assert np.allclose(theta.variance(), variance, rtol=1e-7)
    H, rhs = theta.information()
    joints, weight = Y[:, first:], 1.0 / (GAIN * variance)
    expected = theta.prior + np.einsum("mja,j,mjb->ab", joints, weight, joints)
    right = theta.prior_rhs + np.einsum("mja,j,mj->a", joints, weight, of.data.tau[:, first:])
    if floating:  # of the base, given the links
        own = np.repeat(theta.base_weights(), 3)[None, :, None] * Y[:, :6, :10]
        expected[:10, :10] += np.einsum("mra,mrb->ab", own, Y[:, :6, :10])
        rest = of.data.tau[:, :6] - Y[:, :6, 10:] @ theta.th[10:]
        right[:10] += np.einsum("mra,mr->a", own, rest)
    assert np.allclose(H, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    assert np.allclose(rhs, right, rtol=1e-7, atol=1e-8 * np.abs(right).max())


@ON_TREES
@pytest.mark.parametrize("seed", SEEDS)
def test_least_squares_and_covariance_are_numpys(seed: int, floating: bool) -> None:
    """Links and effects from the joints' torques, then the base from its wrench."""
    theta, of, Y = both(floating, seed)
    first, at = of.tree.rows - of.tree.n, theta.known()
    at = at[at >= 10] if floating else at
    weight = np.sqrt(1.0 / (GAIN * theta.variance()))[:, None]
    with np.errstate(divide="ignore"):  # the idle spare body has no prior
        std = np.nan_to_num(1.0 / np.sqrt(np.diag(theta.prior)), posinf=0.0)
    rows = np.vstack([(weight * Y[:, first:]).reshape(-1, theta.P)[:, at], np.diag(1 / std[at])])
    right = (weight[:, 0] * of.data.tau[:, first:]).ravel()
    right = np.concatenate([right, (theta.prior_rhs * std)[at]])
    expected = np.linalg.lstsq(rows, right, rcond=None)[0]
    found, covariance = theta.least_squares(), theta.covariance()
    assert np.abs(found[at] - expected).max() < 1e-6 * np.abs(expected).max()
    links = np.linalg.inv(rows.T @ rows)
    assert np.allclose(covariance[np.ix_(at, at)], links, rtol=1e-5, atol=1e-9)
    assert not covariance[theta.spare].any()
    if not floating:
        return
    weight = np.sqrt(np.repeat(theta.base_weights(), 3))[:, None]
    own, other = (weight * Y[:, :6])[:, :, :10].reshape(-1, 10), (weight * Y[:, :6])[:, :, at]
    right = (weight[:, 0] * of.data.tau[:, :6]).ravel() - other.reshape(-1, len(at)) @ expected
    rows = np.vstack([own, np.diag(1 / std[:10])])
    base = np.linalg.lstsq(rows, np.append(right, (theta.prior_rhs * std)[:10]), rcond=None)[0]
    assert np.abs(found[:10] - base).max() < 1e-6 * np.abs(base).max()
    own_part = np.linalg.inv(rows.T @ rows)
    follows = -own_part @ own.T @ other.reshape(-1, len(at))
    expected = own_part + follows @ links @ follows.T
    assert np.allclose(covariance[:10, :10], expected, rtol=1e-5, atol=1e-9)
    assert np.allclose(covariance[:10, at], follows @ links, rtol=1e-5, atol=1e-9)
    assert np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-12)


def values_of(x: torch.Tensor, bodies: int) -> torch.Tensor:
    """θ and effects (P,) of the flat parameters, by torch."""
    k = 10 * bodies
    return torch.cat([theta_from_log_cholesky_torch(x[:k].reshape(-1, 10)).ravel(), x[k:]])


@ON_TREES
@pytest.mark.parametrize("changed", [False, True])
@pytest.mark.parametrize("each_sample", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_gradient_is_autograds(seed: int, floating: bool, changed: bool, each_sample: bool) -> None:
    """Of the weighted cost over all samples, or of the newest sample's plain squared error."""
    theta, of, Y = both(floating, seed, changed)
    theta.each_sample = each_sample
    theta.absorb(of.frames, of.states(slice(-1, None)))
    Y, tau = (np.concatenate([x, x[-1:]]) for x in (Y, of.data.tau))
    assert theta.compute_gradient()
    variance, first = theta.variance(), of.tree.rows - of.tree.n
    if each_sample:
        Y, tau = Y[-1:], tau[-1:]
        square = (tau - Y @ values_of(torch.from_numpy(theta.x), theta.bodies).numpy())[0] ** 2
        variance = (square[first:] + 1e9) / (1 + 1e9) + theta.model_variance
    x = torch.tensor(theta.x, requires_grad=True)
    th = values_of(x, theta.bodies)
    error = torch.from_numpy(tau) - torch.from_numpy(Y) @ th
    joints = (error[:, first:] ** 2 / torch.from_numpy(GAIN * variance)).sum()
    (expected,) = torch.autograd.grad(joints / (2 * len(Y)), x, retain_graph=True)
    if floating:
        weight = torch.from_numpy(np.repeat(theta.base_weights(), 3))
        wrench = (error[:, :6] ** 2 * weight).sum() / (2 * len(Y))
        (extra,) = torch.autograd.grad(wrench, x, retain_graph=True)
        share = torch.zeros(theta.P, dtype=torch.float64)
        share[theta.rows.base_place[theta.rows.near]] = HANGING_SHARE
        share[:10] = 1.0
        expected = expected + share * extra
    prior, rhs = torch.from_numpy(theta.prior), torch.from_numpy(theta.prior_rhs)
    radii = x[: 10 * theta.bodies].reshape(-1, 10)[:, 1:4]  # log-normal: 0.1 m, std 2
    before = 0.5 * th @ prior @ th - rhs @ th + 0.5 * ((radii - np.log(0.1)) ** 2).sum() / 4.0
    share = 1e-6 if each_sample else 1.0
    expected = expected + torch.autograd.grad(share * before / len(Y), x)[0]
    error = np.abs(theta.gradient - expected.numpy())
    assert error.max() < 1e-9 * np.abs(expected.numpy()).max()


def test_too_few_samples_give_no_gradient() -> None:
    of = case(0, False)
    theta = make(of, warm_up=50)
    theta.absorb(of.frames, of.states(slice(49)))
    assert not theta.compute_gradient() and not theta.gradient.any()
    theta.absorb(of.frames, of.states(slice(49, 50)))
    assert theta.compute_gradient() and theta.gradient.any()


@ON_TREES
@pytest.mark.parametrize("seed", SEEDS)
def test_two_changes_leave_what_a_batch_of_all_three_hands_knows(seed: int, floating: bool) -> None:
    """Three hands, one after the other: the second is integrated out, nothing else is lost."""
    of = case(seed, floating, rows=180)
    theta = somewhere(make(of))
    size, link = theta.P + 10, 1.0 / np.array([5.0, *[0.5] * 3, *[0.3] * 6]) ** 2
    H, rhs = np.zeros((size, size)), np.zeros(size)  # the third hand behind all others
    H[: theta.P, : theta.P], rhs[: theta.P] = theta.prior, theta.prior_rhs
    hands = theta.hand, theta.spare, slice(theta.P, size)
    first = of.tree.rows - of.tree.n
    for number, (hand, part) in enumerate(zip(hands, np.split(np.arange(180), 3), strict=True)):
        if number:
            theta.start_change()
            for a, b in ((hand, theta.hand), (theta.hand, hand)):
                H[a, a] += np.diag(link)
                H[a, b] -= np.diag(link)
        theta.absorb(of.frames, of.states(part))
        plain = make(of)
        Y = np.zeros((60, of.tree.rows, size))
        Y[:, :, : theta.P] = full_rows(plain, Case(of.data.take(part), of.lam))
        Y[:, :, hand], own = Y[:, :, theta.hand], Y[:, :, theta.hand].copy()
        if number:
            Y[:, :, theta.hand] = 0.0
        assert number or np.array_equal(Y[:, :, hand], own)
        weight = 1.0 / (GAIN * theta.variance())
        rows, tau = Y[:, first:], of.data.tau[part][:, first:]
        H += np.einsum("mja,j,mjb->ab", rows, weight, rows)
        rhs += np.einsum("mja,j,mj->a", rows, weight, tau)
    links = np.r_[10 * floating : theta.spare.start, theta.spare.stop : theta.P]
    keep = np.r_[links, theta.P : size]
    covariance = np.linalg.inv(H[10 * floating :, 10 * floating :])
    best = covariance @ rhs[10 * floating :]
    ours = np.r_[links, theta.spare]
    found = theta.least_squares()[ours]
    assert np.allclose(found, best[keep - 10 * floating], rtol=1e-5, atol=1e-7 * np.abs(best).max())
    theirs = covariance[np.ix_(keep - 10 * floating, keep - 10 * floating)]
    assert np.allclose(theta.covariance()[np.ix_(ours, ours)], theirs, rtol=1e-4, atol=1e-9)
    (load, spread), more = theta.payload, np.zeros((10, len(ours)))
    more[:, -10:] = np.eye(10)
    more[:, np.searchsorted(links, np.arange(theta.P)[theta.hand])] = -np.eye(10)
    assert np.allclose(load, more @ theta.th[ours], rtol=1e-9, atol=1e-12)
    assert np.allclose(spread, more @ theirs @ more.T, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_forgetting_takes_only_what_the_row_knows(seed: int) -> None:
    """A stays positive, loses rate z' A z along z, and nothing of what is conjugate to z."""
    rng = np.random.default_rng(seed)
    of, rate = case(1, False), 0.05
    theta = make(of, effects=())
    j = 3  # of ten columns
    theta.absorb(of.frames, of.states())
    before = theta.joint_moments(j)
    z = np.zeros((of.tree.n, theta.rows.place.shape[1] + 1))
    z[j, :11] = rng.normal(size=11)
    forget_along(theta.rows, z, rate, theta.moments.A)
    A, z = theta.joint_moments(j), z[j, :11]
    assert z @ A @ z == pytest.approx((1 - rate) * (z @ before @ z))
    other = rng.normal(size=11)
    other -= z * (other @ before @ z) / (z @ before @ z)
    assert other @ A @ other == pytest.approx(other @ before @ other)
    assert np.linalg.eigvalsh(A)[0] > -1e-9 * np.abs(A).max()


@ON_TREES
def test_forgetting_in_a_table_is_forgetting_one_by_one(floating: bool) -> None:
    of = case(0, floating)
    whole, single = make(of, forget_s=0.5), make(of, forget_s=0.5)
    whole.absorb(of.frames, of.states())
    for k in range(len(of.data)):
        single.absorb(of.frames, of.states(slice(k, k + 1)))
    for a, b in zip(whole.moments, single.moments, strict=True):
        assert np.allclose(a, b, rtol=1e-10, atol=1e-12)
    plain = make(of)
    plain.absorb(of.frames, of.states())
    assert np.abs(whole.moments.A).sum() < np.abs(plain.moments.A).sum()


@ON_TREES
def test_a_change_leaves_what_is_predicted_and_carries_nothing_yet(floating: bool) -> None:
    """Whatever the hand takes up, it weighs nothing until the next sample says so."""
    of = case(0, floating)
    theta = somewhere(make(of))
    theta.absorb(of.frames, of.states())
    before = theta.errors(of.frames, of.states())
    theta.start_change()
    after = theta.errors(of.frames, of.states())
    assert np.allclose(after, before, rtol=1e-12, atol=1e-12)
    assert theta.payload is not None and not theta.payload[0].any()


@ON_TREES
def test_what_was_known_before_a_change_counts_half_after_a_rebuild(floating: bool) -> None:
    """It was learned with the old λ: the same best guess, with twice its variance."""
    of = case(0, floating, rows=200)
    tau = of.regressor() @ np.tile(LINK, of.tree.bodies)
    tau += 0.05 * np.random.default_rng(4).normal(size=tau.shape)
    theta = make(of)
    theta.absorb(of.frames, replace(of.data, tau=tau).states())
    for _ in range(2):  # the weights are those of the fit
        theta.th[:] = theta.least_squares()
    theta.start_change()
    links = slice(10 * floating, theta.spare.start)
    std = np.tile(PRIOR_STD, (links.stop - links.start) // 10)

    def known() -> tuple[np.ndarray, np.ndarray]:
        covariance = np.linalg.inv(theta.prior)
        return (covariance @ theta.prior_rhs)[links], covariance[links, links]

    best, covariance = known()
    theta.replace_moments(theta.empty_moments(), 0.0)
    after, wider = known()
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    shown = vectors[:, values < 1e-3] / std[:, None]
    assert shown.shape[1] > 0.5 * len(std)
    was, now = (np.einsum("ak,ab,bk->k", shown, c, shown) for c in (covariance, wider))
    assert np.allclose(now, 2.0 * was, rtol=0.02)
    assert (np.abs(shown.T @ (after - best)) < 0.3 * np.sqrt(was)).all()
    assert (np.abs(shown.T @ best) > 3.0 * np.sqrt(was)).any()  # twice of it would be seen


def test_an_effect_that_no_data_show_may_still_be_there() -> None:
    """Nothing was seen of it, so nothing is known of its size: its spread stays."""
    of = case(1, False)
    theta = make(of)
    for _ in range(20):
        theta.adapt_prior()
    widest = [effect.prior_std for effect in theta.effects]
    assert np.allclose(theta.effect_spread, widest, rtol=1e-6)


def test_a_rest_counts_by_what_static_friction_may_hold() -> None:
    """A joint at rest counts at a share, in its moments and in its number of samples."""
    of = case(0, False)
    states, rests = of.states(), slice(None, None, 2)
    states[rests, StateLayout(of.tree.n).dq.start] = 0.0
    theta, whole, alone = make(of), make(of), make(of)
    theta.rests[0] = 0.25
    theta.absorb(of.frames, states)
    whole.absorb(of.frames, states)
    alone.absorb(of.frames, states[rests])
    for j, share in enumerate([0.75, *[0.0] * (of.tree.n - 1)]):
        less = whole.joint_moments(j) - share * alone.joint_moments(j)
        np.testing.assert_allclose(theta.joint_moments(j), less, rtol=1e-9, atol=1e-9)
        moves = np.abs(states[:, StateLayout(of.tree.n).dq.start + j]) > SMOOTHING_DQ
        assert theta.moments.counts[j] == moves.sum() + (1.0 - share) * (~moves).sum()
    assert theta.count == len(states)


def test_rests_say_less_the_more_friction_there_is() -> None:
    theta = make(case(0, False), ("coulomb_friction",))
    small = np.full(theta.tree.n, 1e-6)
    theta.effect_values[0] = 0.0
    theta._weigh_rests(small)
    assert (theta.rests > 0.5).all()
    theta.effect_values[0] = 1.0
    theta._weigh_rests(small)
    assert (theta.rests < 0.01).all()
