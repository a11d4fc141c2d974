"""ADAM on one flat parameter, to the last bit as `torch.optim.Adam(fused=True)` steps.

That takes 30 µs for 150 numbers, most of it hooks and grouping; this takes 2, and a recording's
steps can share a call. Tests hold the two together.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numba.extending import intrinsic

from adapter.physics.kernels import jit

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

    `pace` is (rate, beta1, beta2).
    """
    rate, beta1, beta2 = pace
    size = rate / (1.0 - math.pow(beta1, float(steps)))
    root = math.sqrt(1.0 - math.pow(beta2, float(steps)))
    for i in range(parameters.shape[0]):
        g = gradient[i]
        first[i] = fused(1.0 - beta1, g - first[i], first[i])  # type: ignore[call-arg]
        second[i] = fused((1.0 - beta2) * g, g, beta2 * second[i])
        parameters[i] -= size * first[i] / (math.sqrt(second[i]) / root + EPS)


class FlatAdam:
    """One parameter vector with its gradient.

    Args:
        size: of the vector.
        rate: learning rate; may be changed at any time.
        betas: averaging constants.

    Attributes:
        parameters, gradient: (size,), to be read and written freely.
        first, second: (size,) ADAM's running means of the gradient and of its square.
        steps: taken.
    """

    def __init__(self, size: int, rate: float, betas: tuple[float, float]) -> None:
        self.rate, self.betas, self.steps = rate, betas, 0
        self.parameters, self.gradient, self.first, self.second = np.zeros((4, size))

    def parts(self) -> tuple[np.ndarray | int | tuple[float, ...], ...]:
        """What `adam_step` takes, with the steps taken so far."""
        vectors = self.parameters, self.gradient, self.first, self.second
        return (*vectors, self.steps, (self.rate, *self.betas))

    def step(self) -> None:
        """One ADAM step on the gradient as it stands."""
        self.steps += 1
        adam_step(*self.parts())

    def forget(self, part: slice) -> None:
        """Clear the running means of a part: after a jump they are of no use."""
        self.first[part] = 0.0
        self.second[part] = 0.0
