"""Our call of torch's functional ADAM against torch's optimizer."""

import numpy as np
import pytest
import torch

from adapter.learning.adam import EPS, FUSED, FlatAdam, same_bits


@pytest.mark.parametrize("seed", range(3))
def test_steps_are_those_of_torch_bit_for_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    betas, rate = (0.97, 0.99), 3e-3
    size = 152  # whole vectors of any processor, as `FlatAdam` always has them
    ours, theirs = FlatAdam(size, rate, betas), torch.zeros(size, dtype=torch.float64)
    optimizer = torch.optim.Adam([theirs], lr=rate, betas=betas, eps=EPS, fused=True)
    for k in range(200):
        gradient = rng.normal(size=size) * 10.0 ** rng.uniform(-6, 6)
        ours.gradient[:] = gradient
        theirs.grad = torch.from_numpy(gradient)
        if k == 100:
            ours.rate = optimizer.param_groups[0]["lr"] = 1e-4
        ours.step()
        optimizer.step()
    assert np.array_equal(ours.parameters, theirs.numpy())
    assert ours.steps == 200


@pytest.mark.parametrize("size", [40, 157])
def test_without_the_private_operator_the_numbers_are_the_same(monkeypatch, size: int) -> None:
    """Rates that change, averages forgotten and a count put back included.

    To the bit where this processor rounds as torch was compiled to, which `same_bits` tells.
    """
    rng, betas = np.random.default_rng(size), (0.97, 0.99)
    fused = FlatAdam(size, 3e-3, betas)
    monkeypatch.delattr(torch, FUSED)
    plain = FlatAdam(size, 3e-3, betas)
    plain.step()  # which looks for it; without a gradient nothing moves
    plain.steps = 0
    monkeypatch.undo()
    for k in range(300):
        gradient = rng.normal(size=size) * 10.0 ** rng.uniform(-6, 6)
        for adam in (fused, plain):
            adam.gradient[:] = gradient
            adam.rate = 3e-3 if k < 100 else 1e-4
            if k == 150:
                adam.forget(slice(10, 20))
            if k == 200:
                adam.steps = 20
            adam.step()
    for name in ("parameters", "first", "second"):
        a, b = getattr(plain, name), getattr(fused, name)
        assert np.allclose(a, b, rtol=1e-10, atol=1e-14)
        assert np.array_equal(a, b) or not same_bits()
    assert plain.steps == fused.steps == 120 and np.abs(plain.parameters).min() > 0.0


def test_forgetting_a_part_leaves_the_rest() -> None:
    adam = FlatAdam(4, 1e-2, (0.9, 0.999))
    adam.gradient[:] = 1.0
    adam.step()
    adam.forget(slice(2, None))
    assert (adam.first[:2] > 0).all() and not adam.first[2:].any() and not adam.second[2:].any()
