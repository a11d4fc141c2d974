"""Base parameters of whole trees: as many as Pinocchio's regressor has, and by branch."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from robot_models import PANDA, pin_model, random_urdf, read_quietly, shared, urdf_text

from adapter.identifiability import base_parameters, numerical_rank
from adapter.offline.branches import branches
from adapter.tree import Tree


def pinocchio_rank(text: str, floating: bool, seed: int = 0) -> int:
    """Rank of Pinocchio's torque regressor over random motion."""
    oracle = pin_model(text, floating)
    data = oracle.createData()
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(max(20, 40 * oracle.njoints // oracle.nv + 10)):
        q = pin.integrate(oracle, pin.neutral(oracle), rng.uniform(-3.0, 3.0, oracle.nv))
        v, a = rng.normal(size=oracle.nv), 3.0 * rng.normal(size=oracle.nv)
        rows.append(pin.computeJointTorqueRegressor(oracle, data, q, v, a).copy())
    return numerical_rank(np.concatenate(rows))[0]


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("robot", ["talos", "panda", "tree5", "tree17", "tree33", "tree60"])
def test_base_parameters_are_those_of_pinocchio(robot: str, floating: bool) -> None:
    text = urdf_text(robot)
    model = read_quietly(text, floating)
    assert model.tree.n == pin_model(text).nv  # both move the same joints
    found = base_parameters(model.tree, model.lam, model.gravity)
    assert found.rank == pinocchio_rank(text, floating)
    if floating:
        assert found.rank == 10 + 7 * model.tree.n  # every revolute joint adds seven


def test_panda_on_a_floating_base_has_59() -> None:
    model = read_quietly(PANDA.read_text(), True)
    assert base_parameters(model.tree, model.lam, model.gravity).rank == 59


@pytest.mark.parametrize(("robot", "joints"), [("atlas", 30), ("talos", 32)])
def test_branches_of_humanoids(robot: str, joints: int) -> None:
    path = {"atlas": "models/atlas_v5.urdf", "talos": "models/talos_reduced.urdf"}[robot]
    tree = read_quietly(shared(path).read_text(), True).tree
    found = {branch.name: branch for branch in branches(tree)}
    assert set(found) == {"right leg", "left leg", "upper body"}
    assert len(found["right leg"].joints) == len(found["left leg"].joints) == 6
    assert len(found["upper body"].joints) == joints - 12
    assert sorted(j for b in found.values() for j in b.joints) == list(range(joints))
    for side in ("right", "left"):
        names = " ".join(tree.joint_names[j] for j in found[f"{side} leg"].joints)
        assert "leg" in names and (f"{side}_" in names or f"{side[0]}_leg" in names)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_branches_of_any_tree_are_trees_of_their_own(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parent = tuple(int(rng.integers(-1, j)) if j % 5 else -1 for j in range(17))
    tree = Tree(parent, bool(seed % 2))
    found = branches(tree)
    assert len(found) == parent.count(-1)
    assert [b.name for b in found] == [f"branch {k + 1}" for k in range(len(found))]
    assert sorted(j for b in found for j in b.joints) == list(range(17))
    for branch in found:
        assert not branch.tree.floating
        for k, j in enumerate(branch.joints):
            below = branch.tree.parent[k]
            assert parent[j] == (-1 if below == -1 else branch.joints[below])
            assert branch.tree.link_names[k] == tree.link_names[j]


def test_one_branch_for_an_arm() -> None:
    tree = read_quietly(random_urdf(6, 3)).tree
    chain = Tree((-1, 0, 1, 2), joint_names=tree.joint_names[:4])
    (only,) = branches(chain)
    assert only.joints == (0, 1, 2, 3) and only.tree.parent == chain.parent
