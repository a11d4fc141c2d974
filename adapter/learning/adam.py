"""torch's ADAM on one flat parameter, without the ceremony of `torch.optim.Optimizer.step`.

`torch.optim.Adam(fused=True).step()` takes 29 µs for 150 numbers, most of it hooks and grouping;
the fused operator that it ends in takes 5. That operator is private: where a torch has none,
`torch.optim.Adam` steps instead, on the same memory. Tests hold all three together.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:  # loaded by the first step: takes a second, and who sums moments takes none
    import torch

FUSED = "_fused_adam_"
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
        self.parameters, self.gradient, self.first, self.second = np.zeros((4, size))
        self._count = np.zeros((), dtype=np.float32)

    @cached_property
    def _tensors(self) -> list[torch.Tensor]:
        """Parameters, gradient and the two means, on the same memory, and the count of steps."""
        import torch

        arrays = self.parameters, self.gradient, self.first, self.second, self._count
        return [torch.from_numpy(x) for x in arrays]

    @cached_property
    def _fused(self) -> Any:
        import torch

        return getattr(torch, FUSED, None)

    @cached_property
    def _optimizer(self) -> torch.optim.Optimizer:
        """torch's optimizer on our memory, its state included."""
        import torch

        parameters, gradient, first, second, steps = self._tensors
        parameters.grad = gradient
        optimizer = torch.optim.Adam([parameters], lr=self.rate, betas=self._betas, eps=EPS)
        state = {"step": steps, "exp_avg": first, "exp_avg_sq": second}
        optimizer.state[parameters] = state
        return optimizer

    @property
    def steps(self) -> int:
        """Steps taken."""
        return int(self._count)

    @steps.setter
    def steps(self, count: int) -> None:
        self._count[...] = count

    def step(self) -> None:
        """One ADAM step on the gradient as it stands."""
        if self._fused is None:
            self._optimizer.param_groups[0]["lr"] = self.rate
            self._optimizer.step()
            return
        parameters, gradient, first, second, steps = self._tensors
        self._count += 1.0
        self._fused(
            [parameters],
            [gradient],
            [first],
            [second],
            [],
            [steps],
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
