"""torch's ADAM on one flat parameter, without the ceremony of `torch.optim.Optimizer.step`.

`torch.optim.Adam(fused=True).step()` takes 29 µs for 150 numbers, most of it hooks and grouping;
the fused operator that it ends in takes 5. A test holds the two together bit for bit.
"""

from __future__ import annotations

import torch

EPS = 1e-12  # gradients come in units of information per sample; far below any that matters


class FlatAdam:
    """One parameter vector with its gradient; numpy and torch see the same memory.

    Args:
        size: of the vector.
        rate: learning rate; may be changed at any time.
        betas: averaging constants.

    Attributes:
        parameters, gradient: (size,) numpy views, to be read and written freely.
        first, second: (size,) ADAM's running means of the gradient and of its square.
    """

    def __init__(self, size: int, rate: float, betas: tuple[float, float]) -> None:
        self.rate, self._betas = rate, betas
        self._tensors = [torch.zeros(size, dtype=torch.float64) for _ in range(4)]
        self._steps = torch.zeros((), dtype=torch.float32)
        self._count = self._steps.numpy()
        self.parameters, self.gradient, self.first, self.second = (
            tensor.numpy() for tensor in self._tensors
        )

    @property
    def steps(self) -> int:
        """Steps taken."""
        return int(self._count)

    @steps.setter
    def steps(self, count: int) -> None:
        self._count[...] = count

    def step(self) -> None:
        """One ADAM step on the gradient as it stands."""
        parameters, gradient, first, second = self._tensors
        self._count += 1.0
        torch._fused_adam_(
            [parameters],
            [gradient],
            [first],
            [second],
            [],
            [self._steps],
            lr=self.rate,
            beta1=self._betas[0],
            beta2=self._betas[1],
            weight_decay=0.0,
            eps=EPS,
            amsgrad=False,
            maximize=False,
        )

    def forget(self, part: slice) -> None:
        """Clear the running means of a part: after a jump they are of no use."""
        self.first[part] = 0.0
        self.second[part] = 0.0
