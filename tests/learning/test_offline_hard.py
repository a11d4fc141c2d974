"""Cases that broke the offline learner once: odd trees, few samples, dull motion, bad numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from adapter.errors import ModelError
from adapter.experiments.networks import NetworkSettings, schema_by_networks
from adapter.learning.batch.prediction_errors import kinematic_errors, predicted_torques
from adapter.learning.batch.schema import schema_from_moments
from adapter.learning.batch.theta import learn_theta
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.inertia import min_eigenvalue, theta_from_body
from adapter.model.tree import Tree
from adapter.physics.networks import FrameMotion, link_motion
from sim.falls.fall import TreeTruth
from tests.helpers.random_trees import random_tree
from tests.helpers.torque_errors import torque_errors


def fall(
    truth: TreeTruth,
    count: int,
    seed: int,
    spin: tuple[float, float, float] = (1.0, 1.0, 1.0),
    speed: float = 1.0,
    rest: tuple[int, ...] = (),
) -> TreeData:
    """A tree in free fall: random states, and the base's acceleration that leaves no wrench on it.

    Torques and link motion come from the networks of `adapter`, which have oracles of their own
    (`test_dynamics`, `test_kinematics`).

    Args:
        spin: standard deviation of the base's angular velocity by axis, rad/s.
        speed: of the joints, rad/s; rest: joints that stay where they are.
    """
    tree, lam, theta = Tree(truth.parent, True), truth.lam, truth.theta
    rng = np.random.default_rng(seed)
    q, dq, ddq = (s * rng.normal(size=(count, tree.n)) for s in (1.0, speed, 3.0 * speed))
    for j in rest:
        q[:, j], dq[:, j], ddq[:, j] = 0.3, 0.0, 0.0
    w, v = rng.normal(size=(2, count, 3)) * np.array([spin, (1.0, 1.0, 1.0)])[:, None]
    still = TreeData(
        tree,
        q,
        dq,
        ddq,
        np.zeros((count, tree.rows)),
        BodyMotion(w, np.zeros_like(w), np.zeros_like(w), v),
    )
    wrench = predicted_torques(still, lam, theta)[:, :6]
    answers = np.empty((count, 6, 6))
    for k, unit in enumerate(np.eye(6)):
        a, dw = (np.tile(x, (count, 1)) for x in (unit[:3], unit[3:]))
        pushed = replace(still, base=BodyMotion(w, a, dw, v))
        answers[:, :, k] = predicted_torques(pushed, lam, theta)[:, :6] - wrench
    free = np.linalg.solve(answers, -wrench[..., None])[..., 0]
    data = replace(still, base=BodyMotion(w, free[:, :3], free[:, 3:], v))
    joints, base = tuple(map(torch.from_numpy, data.joints())), FrameMotion.of(data.base.rows())
    k = link_motion(tree, torch.from_numpy(lam), joints, base)
    links = BodyMotion(*(x[:, 1:].numpy() for x in (k.w, k.a, k.dw, k.v)))
    return replace(data, links=links, tau=predicted_torques(data, lam, theta))


@pytest.mark.parametrize("how", [{}, {"speed": 3.0, "rest": (2,)}])
def test_a_base_is_not_driven_to_the_edge(how: dict[str, Any]) -> None:
    """Fitted alone to what the branches left open, it lost this tree's θ (median 0.06 and 1.0)."""
    truth = random_tree(5, 0)
    data, control = (fall(truth, 400, seed, **how) for seed in (0, 1))
    found = learn_theta(data, truth.lam)
    error = torque_errors(control, truth.lam, found.theta)
    assert error.median < 1e-9 and error.p99 < 1e-6
    assert found.converged and all(stage.converged for stage in found.stages)
    assert found.min_eigenvalue > 0.0
    assert sum(stage.steps for stage in found.stages) < 500


@pytest.mark.parametrize("seed", range(0, 8, 2))
def test_any_tree_from_few_samples(seed: int) -> None:
    truth = random_tree(5 + 2 * seed, 40 + seed)
    data, control = fall(truth, 120, seed), fall(truth, 100, seed + 100)
    lam = schema_from_moments(data).lam
    found = learn_theta(data, lam)
    error = torque_errors(control, lam, found.theta)
    assert found.converged and found.min_eigenvalue > 0.0
    assert error.median < 1e-6 and error.p99 < 1e-3


def test_torques_of_nothing_leave_possible_bodies() -> None:
    truth = random_tree(5, 1)
    data = fall(truth, 100, 2)
    assert learn_theta(data, truth.lam, possible=False).converged
    nothing = learn_theta(replace(data, tau=np.zeros_like(data.tau)), truth.lam)
    assert nothing.min_eigenvalue > 0.0 and np.isfinite(nothing.theta).all()


def test_an_svd_that_gives_up_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """LAPACK's divide and conquer does so now and then, on matrices that are none the worse."""
    truth = random_tree(5, 2)
    data, fast = fall(truth, 100, 2), np.linalg.svd

    def gives_up(matrix: Any, **how: Any) -> Any:
        if len(matrix) > 20:
            raise np.linalg.LinAlgError("SVD did not converge")
        return fast(matrix, **how)

    monkeypatch.setattr(np.linalg, "svd", gives_up)
    found = learn_theta(data, truth.lam)
    assert found.converged and found.min_eigenvalue > 0.0
    assert found.rank == 45 and torque_errors(data, truth.lam, found.theta).median < 1e-6


@pytest.mark.parametrize("size", [1e-6, 1e-3, 1.0])
def test_noise_of_any_size_ends_at_possible_bodies(size: float) -> None:
    truth = random_tree(6, 3)
    data = fall(truth, 200, 3)
    noise = size * np.random.default_rng(3).normal(size=data.tau.shape)
    noise[:, :6] = 0.0
    found = learn_theta(replace(data, tau=data.tau + noise), truth.lam)
    assert found.converged and found.min_eigenvalue > 0.0
    gap = predicted_torques(data, truth.lam, found.theta) - data.tau
    assert np.sqrt(np.mean(gap[:, 6:] ** 2)) < size


def test_bodies_without_extent_are_approached_and_stay_possible() -> None:
    truth = random_tree(5, 4)
    mass = truth.theta[:, 0]
    centre = truth.theta[:, 1:4] / mass[:, None]
    points = np.stack(
        [theta_from_body(m, c, np.zeros((3, 3))) for m, c in zip(mass, centre, strict=True)]
    )
    data = fall(replace(truth, theta=points), 150, 4)
    found = learn_theta(data, truth.lam)
    assert found.min_eigenvalue > 0.0 >= min_eigenvalue(points).min() - 1e-12
    assert torque_errors(data, truth.lam, found.theta).median < 1e-3


@pytest.mark.parametrize(
    ("links", "seed", "count", "spin"),
    [
        (5, 0, 400, (1.0, 1.0, 1.0)),
        (9, 1, 600, (1.0, 1.0, 1.0)),
        (6, 2, 600, (0.02, 0.02, 1.0)),  # about one axis: most of p hardly shows
        (7, 3, 600, (0.3, 0.3, 0.3)),
    ],
)
def test_networks_need_few_samples_and_little_motion(
    links: int, seed: int, count: int, spin: tuple[float, float, float]
) -> None:
    truth = random_tree(links, seed)
    data = fall(truth, count, seed, spin=spin)
    found = schema_by_networks(data, seed)
    control = fall(truth, 100, seed + 100)
    assert found.converged.all()
    assert max(kinematic_errors(control, found.lam).largest.values()) < 1e-6


def test_networks_say_which_joints_they_did_not_learn() -> None:
    truth = random_tree(6, 5)
    data = fall(truth, 300, 5)
    short = schema_by_networks(data, 0, NetworkSettings(cycles=1, starts=1, minibatch=30))
    assert short.converged.shape == (6,) and not short.converged.all()
    wrong = ~(short.final_loss[:, 0] < 1e-12)
    assert (short.converged == ~wrong).all()
    rng = np.random.default_rng(0)
    links = replace(data.links, w=data.links.w + 1e-2 * rng.normal(size=data.links.w.shape))
    noisy = schema_by_networks(replace(data, links=links), 0)
    assert noisy.converged.all() and noisy.final_loss.min() > 1e-6
    best = schema_from_moments(replace(data, links=links), None).lam
    ours, theirs = (np.abs(x - truth.lam)[:, 3:].max() for x in (noisy.lam, best))
    assert ours < 10.0 * theirs + 1e-3
    links = replace(links, w=rng.normal(size=data.links.w.shape))  # of another robot
    assert not schema_by_networks(replace(data, links=links), 0).converged.any()


ENTRIES: dict[str, Callable[[TreeData, np.ndarray, np.ndarray], object]] = {
    "networks": lambda d, lam, theta: schema_by_networks(d, 0, NetworkSettings(cycles=1)),
    "moments": lambda d, lam, theta: schema_from_moments(d),
    "kinematic errors": lambda d, lam, theta: kinematic_errors(d, lam),
    "theta": lambda d, lam, theta: learn_theta(d, lam),
    "torque errors": lambda d, lam, theta: torque_errors(d, lam, theta),
}
OF_MOTION = ("links.w", "links.v", "base.w", "base.v", "q", "ddq")
OF_TORQUES = ("tau", "q", "dq", "base.a", "base.dw")
SEEN = dict.fromkeys(("networks", "moments", "kinematic errors"), OF_MOTION)
SEEN |= dict.fromkeys(("theta", "torque errors"), OF_TORQUES)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("entry", ENTRIES)
def test_one_broken_number_is_named(entry: str, value: float) -> None:
    truth = random_tree(5, 6)
    data = fall(truth, 20, 6)
    for name in SEEN[entry]:
        with pytest.raises(ModelError, match=rf"(^|measured torque|{name}) holds .* row 7"):
            ENTRIES[entry](_broken(data, name, value), truth.lam, truth.theta)
    if entry not in ("networks", "moments"):
        with pytest.raises(ModelError, match="λ holds"):
            ENTRIES[entry](data, truth.lam * value, truth.theta)


def _broken(data: TreeData, name: str, value: float) -> TreeData:
    """The same samples with one number of sample 7 replaced; `name` is that of a signal."""
    first, _, second = name.partition(".")
    holder = getattr(data, first)
    table = (getattr(holder, second) if second else holder).copy()
    table[(7, *(0,) * (table.ndim - 2), -1)] = value
    return replace(data, **{first: replace(holder, **{second: table}) if second else table})


@pytest.mark.parametrize("constant", [0.0, 1.0])
def test_the_gain_may_fall_at_once_or_never(constant: float) -> None:
    truth = random_tree(5, 7)
    found = schema_by_networks(fall(truth, 300, 7), 0, NetworkSettings(constant=constant))
    assert np.isfinite(found.lam).all() and (found.converged.all() or constant == 0.0)
