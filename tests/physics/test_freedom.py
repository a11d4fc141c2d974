"""Frames that move alike: found from small directions, walked over any distance."""

from __future__ import annotations

import numpy as np
import pytest

from adapter.model.spatial import exp_rotation, matrix_from_zxz, rot_z, rotation_angle
from adapter.model.tree import Tree
from adapter.physics.freedom import Freedom
from adapter.physics.identifiability import frame_observability, random_motion
from adapter.physics.kernels import base_at_rest, link_motions, placed
from tests.helpers.random_trees import cad_tree

DOWN = np.array([0.0, 0.0, -9.81])
# Shoulder and elbow of an upright arm, with the offsets that a UR has.
LAM = np.array([[0, 0, 0.3, 0, 0, 0.15], [0.4, 1.5708, 0, 0.02, 0.12, 0.05], [0, 0, 0, 0.4, 0, 0]])
TREE = Tree((-1, 0, 1))


def motion(tree: Tree, R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Motion of all links (50, n, 12) at random."""
    joints = random_motion(tree, 50, 3)
    out = np.empty((*joints.q.shape, 12))
    frames = placed(tree, R, p)
    link_motions(frames, joints, base_at_rest(DOWN)[None], out)
    return out


@pytest.mark.parametrize("angle", [0.1, 1.5, -3.0])
def test_a_frame_turned_about_the_axis_before_it_moves_alike_and_comes_back(angle: float) -> None:
    R, p = matrix_from_zxz(LAM[:, :3]), LAM[:, 3:]
    there, at = R.copy(), p.copy()
    there[1], at[1] = rot_z(angle) @ R[1], rot_z(angle) @ p[1] + [0, 0, 0.7]
    there[0], at[0] = rot_z(-angle) @ R[0], p[0] + 1.0
    np.testing.assert_allclose(motion(TREE, there, at), motion(TREE, R, p), atol=1e-12)
    freedom = frame_observability(TREE, LAM, DOWN).freedom
    back, placed = freedom.nearest(there, at, R, p)
    assert rotation_angle(back, R).max() < 1e-9 and np.abs(placed - p).max() < 1e-9
    off = exp_rotation([[0.02, 0.01, 0.0], [0.0, 0.03, 0.0], [0.0, 0.0, 0.01]])
    back, placed = freedom.nearest(there, at, off @ R, p)
    np.testing.assert_allclose(motion(TREE, back, placed), motion(TREE, R, p), atol=1e-9)
    assert rotation_angle(back, R).max() < 0.05 and np.abs(placed - p)[:, :2].max() < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_hidden_directions_follow_the_frame(seed: int) -> None:
    """What small directions show of a frame elsewhere on its way is what the freedom says."""
    model = cad_tree(seed, joints=6)
    seen = frame_observability(model.tree, model.lam, model.gravity)
    R, p = matrix_from_zxz(model.lam[:, :3]), model.lam[:, 3:]
    hidden = np.eye(6) - seen.projectors
    np.testing.assert_allclose(seen.freedom.hidden(p), hidden, atol=1e-8)
    rng = np.random.default_rng(seed)
    goal = exp_rotation(rng.normal(size=(6, 3))), rng.normal(size=(6, 3))
    there, at = seen.freedom.nearest(R, p, *goal)
    again = Freedom.of(seen.freedom.hidden(at), at).nearest(there, at, R, p)
    assert rotation_angle(again[0], R).max() < 1e-7 and np.abs(again[1] - p).max() < 1e-7
    np.testing.assert_allclose(motion(model.tree, there, at), motion(model.tree, R, p), atol=1e-7)
    nearer = np.linalg.norm(at - goal[1], axis=1) ** 2 + 0.5 * ((there - goal[0]) ** 2).sum((1, 2))
    before = np.linalg.norm(p - goal[1], axis=1) ** 2 + 0.5 * ((R - goal[0]) ** 2).sum((1, 2))
    assert (nearer <= before + 1e-12).all() and (nearer[0] < before[0])


def test_words_name_the_joint_and_its_freedom() -> None:
    freedom = frame_observability(TREE, LAM, DOWN).freedom
    first, second = freedom.words(TREE)
    assert "turn about [0 0 1] and its place in base" in first
    assert "turn about [0 0 1] and its place along [0 0 1]" in second
    assert Freedom.none(3).words(TREE) == []
