"""The baselines on small arms and functions, their mechanics and scores by independent means."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch

from adapter.errors import MeansError, ModelError
from adapter.experiments.baselines.by_physics import (
    DeepLagrangian,
    MassNetwork,
    RegressorLeastSquares,
    lagrange_torque,
)
from adapter.experiments.baselines.compare import (
    Choice,
    compare,
    contenders,
    select,
    validation_part,
)
from adapter.experiments.baselines.learner import (
    Baseline,
    Columns,
    Scale,
    arm_problem,
    sub_chain,
    sub_parents,
)
from adapter.experiments.baselines.paper import (
    ElmCommittee,
    FeedForward,
    GaussianProcess,
    negative_log_likelihood,
)
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.spatial import matrix_from_zxz
from adapter.model.tree import Tree
from adapter.physics.networks import FrameMotion, inverse_dynamics, theta_from_log_cholesky
from tests.helpers.arm_data import free_answers, pin_tree
from tests.helpers.robot_models import relative

# A leg (joint 0), a torso (1) and an arm on it that branches (2, 3, 4).
TREE = Tree((-1, -1, 1, 2, 2), floating=True)
ARM, CARRIER = ("joint3", "joint4", "joint5"), "link2"


def robot(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """λ (n, 6) and consistent θ (bodies, 10) of `TREE`."""
    rng = np.random.default_rng(seed)
    lam = np.column_stack([rng.uniform(-2, 2, (TREE.n, 3)), rng.uniform(-0.4, 0.4, (TREE.n, 3))])
    return lam, theta_from_log_cholesky(rng.normal(size=(TREE.bodies, 10)) * 0.3)


def samples(seed: int, count: int) -> TreeData:
    """Independent random states of the robot, torques from Pinocchio."""
    lam, theta = robot(seed)
    rng = np.random.default_rng([seed, count])
    q, dq, ddq = (rng.uniform(-s, s, (count, TREE.n)) for s in (1.0, 1.0, 3.0))
    w, a, dw, v = rng.normal(size=(4, count, 3))
    frames = matrix_from_zxz(lam[:, :3]), lam[:, 3:]
    model = pin_tree(TREE.parent, *frames, theta, np.zeros(3), free=True)
    tau, motion, _ = free_answers(model, (q, dq, ddq), (v, w, a, dw))
    links = BodyMotion(*(motion[:, :, k] for k in (1, 2, 3, 0)))
    return TreeData(TREE, q, dq, ddq, tau, BodyMotion(w, a, dw, v), links)


@pytest.mark.parametrize("seed", [0, 1])
def test_arm_problem_is_well_posed_and_complete(seed: int) -> None:
    """Known λ and X alone give the torques."""
    data = samples(seed, 40)
    x, y = arm_problem(data, ARM, CARRIER)
    columns = Columns(3)
    assert x.shape == (40, columns.width) and np.array_equal(y, data.tau[:, [8, 9, 10]])
    squares = least_squares(seed)
    squares.fit(x, y)
    more, truth = arm_problem(samples(seed, 60), ARM, CARRIER)
    assert relative(squares.predict(more), truth) < 1e-9


def least_squares(seed: int) -> RegressorLeastSquares:
    index = sub_chain(TREE, ARM, CARRIER)
    assert sub_parents(TREE, index) == (-1, 0, 0)
    return RegressorLeastSquares(Columns(3), sub_parents(TREE, index), robot(seed)[0][index])


def test_what_is_no_sub_chain_is_refused() -> None:
    data = samples(0, 5)
    for joints, carrier, words in (
        (("joint3", "joint4"), CARRIER, "all that hangs on it"),
        (("joint3", "joint5", "joint4", "joint1"), CARRIER, "all that hangs on it"),
        (ARM, "link1", "hangs on link 'link2'"),
        (("elbow",), CARRIER, "no joint 'elbow'"),
    ):
        with pytest.raises(ModelError, match=words):
            arm_problem(data, joints, carrier)


def test_lagranges_form_with_the_true_mass_matrix_is_inverse_dynamics() -> None:
    """Against Pinocchio's torques on a moving base; v is free to choose (Galilei)."""
    data = samples(0, 30)
    lam, theta = (torch.from_numpy(x) for x in robot(0))

    def mass(q: torch.Tensor) -> torch.Tensor:
        """Columns are wrench and torques of unit accelerations from rest."""
        still, columns = torch.zeros_like(q), []
        zero = q.new_zeros((len(q), 3))
        for unit in torch.eye(6 + TREE.n, dtype=torch.float64):
            a, dw, ddq = (x.expand(len(q), -1) for x in unit.split([3, 3, TREE.n]))
            base = FrameMotion(zero, zero, a, dw)
            columns.append(inverse_dynamics(TREE, lam, theta, (q, still, ddq), base))
        return torch.stack(columns, dim=2)

    base = FrameMotion.of(data.base.rows())
    for v in (base.v, torch.zeros_like(base.v)):
        moving = FrameMotion(v, base.w, base.a, base.dw)
        tau = lagrange_torque(mass, *map(torch.from_numpy, data.joints()), moving).detach().numpy()
        assert relative(tau, data.tau[:, 6:]) < 1e-9


def test_mass_matrix_of_the_network_is_positive_definite_and_learns() -> None:
    """Symmetric, and the torque's gradient by the weights is that by differences."""
    torch.manual_seed(0)
    net = MassNetwork(torch.rand(8, 8, dtype=torch.float64) + 0.5, (5, 4), seed=0).double()
    q, dq, ddq = (torch.randn(3, 2, dtype=torch.float64) for _ in range(3))
    base = FrameMotion(*(torch.randn(3, 3, dtype=torch.float64) for _ in range(4)))
    m = net(10.0 * q)
    assert torch.equal(m, m.mT) and torch.linalg.eigvalsh(m).min() > 0.0

    def run(weight: torch.Tensor) -> torch.Tensor:
        def mass(at: torch.Tensor) -> torch.Tensor:
            return torch.func.functional_call(net, {"inner.0.weight": weight}, (at,))

        return lagrange_torque(mass, q, dq, ddq, base)

    weight = net.inner[0].weight.detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(run, (weight,))


# Small sizes of each, and the share of the torque's deviation that is left on samples not seen.
LEARNERS: dict[str, tuple[Callable[[], Baseline], float]] = {
    "network": (partial(FeedForward, units=60, epochs=24, batch=50), 0.5),
    "committee": (partial(ElmCommittee, members=3, units=300, points=1200), 0.35),
    "process": (partial(GaussianProcess, points=500, tuned_on=120, steps=15), 0.35),
    "lagrangian": (
        partial(DeepLagrangian, Columns(3), (24, 24), steps=200, batch=64, rate=1e-2),
        0.25,
    ),
    "least squares": (partial(least_squares, 1), 1e-9),
}


@pytest.fixture(scope="module")
def table() -> tuple[np.ndarray, np.ndarray]:
    return arm_problem(samples(1, 2000), ARM, CARRIER)


@pytest.mark.parametrize("name", LEARNERS)
def test_every_learner_learns_an_arm(name: str, table: tuple[np.ndarray, np.ndarray]) -> None:
    (x, y), (learner, most) = table, LEARNERS[name]
    told: list[str] = []
    found = learner()
    with pytest.raises(ModelError, match="call fit first"):
        found.predict(x)
    found.fit(x[:1500], y[:1500], told.append)
    rest = found.predict(x[1500:]) - y[1500:]
    share = np.sqrt(np.mean(rest**2, axis=0)) / y.std(axis=0)
    assert np.max(share) < most, share
    assert told and found.tuning and found.train_s > 0.0 and found.sizes

    again = learner()
    again.fit(x[:1500], y[:1500])
    np.testing.assert_allclose(again.predict(x[1500:]), found.predict(x[1500:]), atol=1e-6)

    with pytest.raises(ModelError, match="got shape"):
        found.predict(x[:, 1:])
    bad = x[:50].copy()
    bad[3, 2] = np.nan
    with pytest.raises(ModelError, match="X holds values that are not finite"):
        found.fit(bad, y[:50])
    with pytest.raises(ModelError, match="Y holds values that are not finite"):
        found.fit(x[:50], np.full_like(y[:50], np.inf))


def test_gradient_of_the_likelihood() -> None:
    """By differences, and the optimum over the signal variance by the full formula."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(25, 3)), rng.normal(size=(25, 2))
    at = np.array([0.1, 0.6, -0.2, -2.0])
    value, gradient = negative_log_likelihood(at, x, y)
    for k in range(4):
        step = np.zeros(4)
        step[k] = 1e-5
        ahead, behind = (negative_log_likelihood(at + s * step, x, y)[0] for s in (1, -1))
        assert gradient[k] == pytest.approx((ahead - behind) / 2e-5, rel=1e-5)

    def full(variance: float, column: np.ndarray) -> float:
        lag = (x[:, None] - x[None]) / np.exp(at[:3])
        gram = variance * (np.exp(-0.5 * np.sum(lag**2, axis=2)) + np.exp(at[3]) * np.eye(25))
        return 0.5 * np.linalg.slogdet(gram)[1] + 0.5 * column @ np.linalg.solve(gram, column)

    best = sum(min(full(v, c) for v in np.geomspace(0.1, 10, 2001)) for c in y.T)
    assert value + 25.0 == pytest.approx(best, abs=1e-3)  # 2 outputs x 25 / 2: the constant


def test_a_process_in_rounding_noise_still_solves() -> None:
    """Twice the same points: a singular kernel, unless noise is raised until it is not."""
    rng = np.random.default_rng(0)
    x = np.repeat(rng.normal(size=(60, 2)), 2, axis=0)
    y = np.sin(x[:, :1]) + x[:, 1:]
    found = GaussianProcess(points=120, tuned_on=60, steps=20)
    found.fit(x, y)
    assert np.abs(found.predict(x) - y).max() < 1e-2


def test_too_weak_a_ridge_is_said() -> None:
    """Equal samples: the Gram matrix has rank one."""
    with pytest.raises(ModelError, match="take a ridge above 1e-30"):
        ElmCommittee(1, 50, 20, ridge=1e-30).fit(np.ones((20, 2)), np.ones((20, 1)))


@pytest.mark.parametrize(
    "learner", [ElmCommittee(2, 40, 60), GaussianProcess(points=60, tuned_on=30, steps=10)]
)
def test_a_gpu_s_way_through_torch_gives_the_same(
    learner: ElmCommittee | GaussianProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Torch's way on whatever device there is, here mostly the CPU, against numpy's."""
    rng = np.random.default_rng(2)
    x = rng.normal(size=(80, 3))
    y = np.column_stack([np.sin(x[:, 0]), x[:, 1] * x[:, 2]])
    answers = []
    for place in (None, torch.device("cuda" if torch.cuda.is_available() else "cpu")):
        monkeypatch.setattr(
            "adapter.experiments.baselines.learner.accelerator", lambda place=place: place
        )
        learner.fit(x, y)
        answers.append(learner.predict(x))
    np.testing.assert_allclose(answers[1], answers[0], rtol=1e-4, atol=1e-6)


def test_scale_guards_constant_columns() -> None:
    table = np.column_stack([np.full(9, 0.1) * 3, np.arange(9.0)])
    scale = Scale.of(table)
    scaled = scale(table)
    assert np.abs(scaled[:, 0]).max() < 1e-12
    assert scaled[:, 1].std() == pytest.approx(1.0)
    np.testing.assert_allclose(scale.undo(scaled), table)


def test_the_experiments_learners_have_the_papers_sizes() -> None:
    """Full: as in section IV; else the committee is smaller; GPR has its 10 000 points in both."""
    index = sub_chain(TREE, ARM, CARRIER)
    schema = Columns(3), sub_parents(TREE, index), robot(0)[0][index]
    for full, members in ((True, 50), (False, 20)):
        found = {choice.key: choice.make() for choice in contenders(*schema, full=full)}
        assert list(found) == ["FFNN", "ELM", "GPR", "DeLaN", "WLS"]
        elm, gpr, net = found["ELM"], found["GPR"], found["FFNN"]
        assert net.units == 1000
        assert (elm.members, elm.units, elm.points, gpr.points) == (members, 4000, 10_000, 10_000)


class Echo(Baseline):
    """Answers with the torques' mean over what it learned from, and an error of its own."""

    def __init__(self, error: float, fitted: list[np.ndarray]) -> None:
        self.error, self.fitted = error, fitted

    def _learn(self, X, Y, progress):  # type: ignore[no-untyped-def]
        self.fitted.append(X)
        self.mean = Y.mean(axis=0)
        return {"samples": len(X)}, ()

    def _answer(self, x: np.ndarray) -> np.ndarray:
        return np.tile(self.mean, (len(x), 1)) + self.error


def test_settings_are_chosen_on_samples_that_no_trial_saw() -> None:
    """Held out as the test set is: a shuffled quarter, from every trajectory."""
    trajectory = np.repeat(np.arange(10), 40)
    x = np.column_stack([trajectory, np.arange(400.0)])
    y = np.full((400, 2), 5.0)
    parted = validation_part((x, y), seed=3)
    fit, judge = (set(part[0][:, 1]) for part in parted)
    assert len(fit) == 300 and len(judge) == 100 and not fit & judge
    assert set(parted[1][0][:, 0]) == set(range(10))
    same, other = (validation_part((x, y), seed)[1][0] for seed in (3, 4))
    assert np.array_equal(same, parted[1][0]) and not np.array_equal(other, parted[1][0])

    fitted: list[np.ndarray] = []
    errors = (2.0, -0.5, 3.0)
    choice = Choice("X", "X", partial(Echo, fitted=fitted), tuple({"error": e} for e in errors))
    found = select(choice, *parted, lambda said: None)
    assert found["chosen"] == {"error": -0.5}
    told = [row["validation_median"] for row in found["candidates"]]
    assert told == pytest.approx([2 / 7, 0.1, 3 / 8])
    for table in fitted:
        assert set(table[:, 1]) == fit
    alone = Choice("Y", "Y", partial(Echo, fitted=fitted))
    assert select(alone, *parted, lambda said: None) == {"chosen": {}, "candidates": []}


def test_the_test_and_the_control_set_have_no_say_in_the_settings() -> None:
    """Both replaced by sets in which another candidate is by far the best: the same bits."""
    x, y = np.random.default_rng(0).normal(size=(400, 4)), np.full((400, 2), 5.0)
    honest = {"train": (x, y), "test": (x[:90], y[:90]), "control": (x[90:], y[90:])}
    poisoned = honest | {"test": (x[:90], y[:90] + 3.0), "control": (-x, 2.0 * y)}
    candidates = ({"error": 2.0}, {"error": -0.5}, {"error": 3.0})
    found = []
    for sets in (honest, poisoned):
        fitted: list[np.ndarray] = []
        choice = Choice("X", "X", partial(Echo, fitted=fitted), candidates)
        (learned,) = compare(sets, [choice], 3, lambda said: None)
        assert len(fitted) == 4 and np.array_equal(fitted[-1], x)
        found.append((learned.selection, fitted, learned.median))
    (chosen, tables, median), (chosen_again, tables_again, median_again) = found
    assert chosen == chosen_again and chosen["chosen"] == {"error": -0.5}
    assert all(np.array_equal(*pair) for pair in zip(tables, tables_again, strict=True))
    assert median["train"] == median_again["train"] and median["test"] != median_again["test"]


def test_without_scikit_learn_the_error_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.neural_network", None)
    with pytest.raises(MeansError, match=r"pip install 'panda-adapter\[experiment\]'"):
        FeedForward(units=3).fit(np.ones((5, 2)), np.ones((5, 1)))
