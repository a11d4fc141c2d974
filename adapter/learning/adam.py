"""torch's ADAM on one flat parameter, without the ceremony of `torch.optim.Optimizer.step`.

`torch.optim.Adam(fused=True).step()` takes 29 µs for 150 numbers, most of it hooks and grouping;
the fused operator that it ends in takes 5. That operator is private: where a torch has none,
`adam_step` steps in its place. Tests hold both to `torch.optim.Adam`.
"""

from __future__ import annotations

import math
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from adapter.physics.kernels import jit

if TYPE_CHECKING:  # loaded by the first step: takes a second, and who sums moments takes none
    import torch

FUSED = "_fused_adam_"
VECTOR = 8  # numbers that a processor takes at a time, at most
EPS = 1e-12  # gradients come in units of information per sample; far below any that matters


@intrinsic
def fused(context, a, b, c):
    """a b + c, rounded once."""

    def code(context, builder, signature, args):
        return builder.fma(*args)

    return types.float64(a, b, c), code


@jit
def adam_step(parameters, gradient, first, second, steps, pace):
    """One step on vectors (P,), the one that makes it so many `steps`, rounded as torch's.

    For recordings, where many steps share a call; `pace` is (rate, beta1, beta2).
    """
    rate, beta1, beta2 = pace
    size = rate / (1.0 - math.pow(beta1, float(steps)))
    root = math.sqrt(1.0 - math.pow(beta2, float(steps)))
    for i in range(parameters.shape[0]):
        g = gradient[i]
        first[i] = fused(1.0 - beta1, g - first[i], first[i])  # type: ignore[call-arg]
        second[i] = fused((1.0 - beta2) * g, g, beta2 * second[i])
        parameters[i] -= size * first[i] / (math.sqrt(second[i]) / root + EPS)


@cache
def same_bits() -> bool:
    """Whether `adam_step` rounds as torch does on this machine; tried on some steps of chance."""
    rng, size = np.random.default_rng(0), 32 * VECTOR
    ours, theirs = (FlatAdam(size, 1e-2, (0.9, 0.999)) for _ in range(2))
    for step in range(1, 9):
        ours.gradient[:] = theirs.gradient[:] = rng.normal(size=size) * 10.0 ** (step - 6)
        theirs.step()
        pace = ours.rate, *ours.betas
        adam_step(ours.parameters, ours.gradient, ours.first, ours.second, step, pace)
    return np.array_equal(ours.parameters, theirs.parameters)


class FlatAdam:
    """One parameter vector with its gradient; numpy and torch see the same memory.

    Args:
        size: of the vector.
        rate: learning rate; may be changed at any time.
        betas: averaging constants.

    Attributes:
        parameters, gradient: (size,) numpy views, to be read and written freely.
        betas: see above.
        first, second: (size,) ADAM's running means of the gradient and of its square.
    """

    def __init__(self, size: int, rate: float, betas: tuple[float, float]) -> None:
        self.rate, self.betas = rate, betas
        # no rest that torch's vectors leave: it may round otherwise
        self._whole = np.zeros((4, -(-size // VECTOR) * VECTOR))
        self.parameters, self.gradient, self.first, self.second = self._whole[:, :size]
        self._count = np.zeros((), dtype=np.float32)

    @cached_property
    def _tensors(self) -> list[torch.Tensor]:
        """Parameters, gradient and the two means, on the same memory, and the count of steps."""
        import torch

        return [torch.from_numpy(x) for x in (*self._whole, self._count)]

    @cached_property
    def _fused(self) -> Any:
        import torch

        return getattr(torch, FUSED, None)

    @property
    def steps(self) -> int:
        """Steps taken."""
        return int(self._count)

    @steps.setter
    def steps(self, count: int) -> None:
        self._count[...] = count

    def step(self) -> None:
        """One ADAM step on the gradient as it stands."""
        self._count += 1.0
        if self._fused is None:
            p, g, m, v = self._whole
            adam_step(p, g, m, v, self.steps, (self.rate, *self.betas))
            return
        parameters, gradient, first, second, steps = self._tensors
        self._fused(
            [parameters],
            [gradient],
            [first],
            [second],
            [],
            [steps],
            lr=self.rate,
            beta1=self.betas[0],
            beta2=self.betas[1],
            weight_decay=0.0,
            eps=EPS,
            amsgrad=False,
            maximize=False,
        )

    def forget(self, part: slice) -> None:
        """Clear the running means of a part: after a jump they are of no use."""
        self.first[part] = 0.0
        self.second[part] = 0.0
