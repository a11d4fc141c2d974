"""Our ADAM against torch's optimizer."""

import numpy as np
import pytest
import torch

from adapter.learning.adam import EPS, FlatAdam


@pytest.mark.parametrize("seed", range(3))
def test_steps_are_those_of_torch(seed: int) -> None:
    """To the bit where this processor rounds as torch was compiled to."""
    rng = np.random.default_rng(seed)
    betas, rate = (0.97, 0.99), 3e-3
    size = 152  # whole vectors of any processor: torch may round a rest otherwise
    ours, theirs = FlatAdam(size, rate, betas), torch.zeros(size, dtype=torch.float64)
    optimizer = torch.optim.Adam([theirs], lr=rate, betas=betas, eps=EPS, fused=True)
    for k in range(200):
        gradient = rng.normal(size=size) * 10.0 ** rng.uniform(-6, 6)
        ours.gradient[:] = gradient
        theirs.grad = torch.from_numpy(gradient)
        if k == 100:
            ours.rate = optimizer.param_groups[0]["lr"] = 1e-4
        if k == 150:  # averages forgotten and a count put back included
            ours.forget(slice(10, 20))
            optimizer.state[theirs]["exp_avg"][10:20] = 0.0
            optimizer.state[theirs]["exp_avg_sq"][10:20] = 0.0
            ours.steps = 20
            optimizer.state[theirs]["step"][...] = 20.0
        ours.step()
        optimizer.step()
    np.testing.assert_allclose(ours.parameters, theirs.numpy(), rtol=1e-10, atol=1e-14)
    assert ours.steps == 70 and np.abs(ours.parameters).min() > 0.0


def test_no_gradient_no_step() -> None:
    adam = FlatAdam(5, 1e-2, (0.9, 0.999))
    adam.parameters[:] = np.arange(5)
    for _ in range(10):
        adam.step()
    assert np.array_equal(adam.parameters, np.arange(5))


def test_forgetting_a_part_leaves_the_rest() -> None:
    adam = FlatAdam(4, 1e-2, (0.9, 0.999))
    adam.gradient[:] = 1.0
    adam.step()
    adam.forget(slice(2, None))
    assert (adam.first[:2] > 0).all() and not adam.first[2:].any() and not adam.second[2:].any()
