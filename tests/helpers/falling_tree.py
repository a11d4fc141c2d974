"""A tree in free fall: random states, and the base's acceleration that leaves no wrench on it.

Torques and link motion come from the networks of `adapter`, which have oracles of their own
(`test_dynamics`, `test_kinematics`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from adapter.learning.batch.prediction_errors import predicted_torques
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.networks import link_motion


def falling(
    tree: Tree,
    lam: Array,
    theta: Array,
    count: int,
    seed: int,
    spin: tuple[float, float, float] = (1.0, 1.0, 1.0),
    speed: float = 1.0,
    rest: tuple[int, ...] = (),
) -> TreeData:
    """Samples of a floating tree.

    Args:
        spin: standard deviation of the base's angular velocity by axis, rad/s.
        speed: of the joints, rad/s.
        rest: joints that stay where they are.
    """
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
    k = link_motion(tree, torch.from_numpy(lam), data.joint_signals(), data.base.torch())
    links = BodyMotion(*(x[:, 1:].numpy() for x in (k.w, k.a, k.dw, k.v)))
    return replace(data, links=links, tau=predicted_torques(data, lam, theta))
