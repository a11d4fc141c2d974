"""Time of one update with differentiable-robot-model (extra [peers]), for `adapter bench`."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import torch

from adapter.export import to_urdf
from adapter.robots import documented


def time_peer(repeats: int) -> list[int]:
    """Nanoseconds of each ADAM step on one sample, the link masses being learned."""
    from differentiable_robot_model.rigid_body_params import UnconstrainedTensor
    from differentiable_robot_model.robot_model import DifferentiableRobotModel

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "panda.urdf"
        path.write_text(to_urdf(documented("panda")))
        model = DifferentiableRobotModel(os.fspath(path), device="cpu")
    for k in range(1, 8):
        model.make_link_param_learnable(
            f"panda_link{k}", "mass", UnconstrainedTensor(dim1=1, dim2=1)
        )
    adam = torch.optim.Adam(model.parameters(), lr=1e-3)
    q, dq, ddq, tau = torch.rand(4, 1, 7)
    times = []
    for _ in range(repeats):
        before = time.perf_counter_ns()
        adam.zero_grad()
        hat = model.compute_inverse_dynamics(q, dq, ddq, include_gravity=True)
        ((hat - tau) ** 2).sum().backward()
        adam.step()
        times.append(time.perf_counter_ns() - before)
    return times
