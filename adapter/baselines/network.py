"""A feed-forward network, as the paper's first baseline: scikit-learn, one hidden layer, ADAM."""

from __future__ import annotations

import time
import warnings
from typing import Any

import numpy as np

from adapter.baselines.learner import Facts, Progress, Scale, at_least, checked, unfitted
from adapter.errors import ModelError
from adapter.spatial import Array

UNITS = 1000  # the paper's
BATCH = 200  # samples
# (share of the epochs, ADAM's rate): constant rates leave the loss where their noise is.
RATES = ((0.35, 2e-3), (0.3, 1e-3), (0.2, 3e-4), (0.15, 1e-4))
PREDICTED_AT_ONCE = 20_000  # samples, so that the hidden layer stays below 100 MB


def _regressor_class() -> Any:
    """scikit-learn's network; imported only when one is wanted."""
    try:
        from sklearn.neural_network import MLPRegressor
    except ImportError:
        raise ModelError(
            "the feed-forward network needs scikit-learn; pip install 'panda-adapter[experiment]'"
        ) from None
    return MLPRegressor


class FeedForward:
    """tanh units in one hidden layer, inputs and outputs standardised, trained by ADAM."""

    def __init__(
        self, units: int = UNITS, epochs: int = 120, batch: int = BATCH, seed: int = 0
    ) -> None:
        """Nothing is imported before `fit`.

        Args:
            units: of the hidden layer.
            epochs: passes over all samples; rates as in `RATES`.
            batch: samples of one step.
            seed: of the weights and of the order of samples.

        Raises:
            ModelError: sizes below 1; fewer epochs than rates.
        """
        at_least(1, units=units, batch=batch)
        at_least(len(RATES), epochs=epochs)
        self.units, self.epochs, self.batch, self.seed = units, epochs, batch, seed
        self._net: Any = None
        self._facts: Facts | None = None

    def fit(self, X: Array, Y: Array, progress: Progress | None = None) -> None:
        """Train on all samples in float32. Raises ModelError, also without scikit-learn."""
        begin = time.perf_counter()
        make = _regressor_class()
        X = checked(X, Y)
        self._in, self._out = Scale.of(X), Scale.of(Y)
        x, y = (s(table).astype(np.float32) for s, table in ((self._in, X), (self._out, Y)))
        self._net = make(
            hidden_layer_sizes=(self.units,),
            activation="tanh",
            solver="adam",
            alpha=0.0,
            batch_size=min(self.batch, len(x)),
            tol=0.0,
            n_iter_no_change=self.epochs + 1,  # never stop early
            warm_start=True,
            random_state=self.seed,
        )
        for share, rate in RATES:
            epochs = max(1, round(share * self.epochs))
            self._net.set_params(learning_rate_init=rate, max_iter=epochs)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that it stopped at the last epoch, as told to
                self._net.fit(x, y if y.shape[1] > 1 else y[:, 0])
            if progress is not None:
                progress(f"network: {epochs} epochs at rate {rate:g}, loss {self._net.loss_:.2e}")
        self._facts = self._told(len(x), x.shape[1], time.perf_counter() - begin)

    def predict(self, X: Array) -> Array:
        """Torques (m, n), N m."""
        if self._net is None:
            raise unfitted()
        x = self._in(checked(X, width=len(self._in.mean))).astype(np.float32)
        starts = range(0, len(x), PREDICTED_AT_ONCE)
        parts = [self._net.predict(x[k : k + PREDICTED_AT_ONCE]) for k in starts]
        return self._out.undo(np.concatenate(parts).reshape(len(x), -1).astype(np.float64))

    def facts(self) -> Facts:
        """Sizes, tuning and training time."""
        if self._facts is None:
            raise unfitted()
        return self._facts

    def _told(self, samples: int, inputs: int, train_s: float) -> Facts:
        sizes = {"units": self.units, "epochs": self.epochs, "samples": samples, "inputs": inputs}
        rates = ", ".join(f"{rate:g} for {share:.0%}" for share, rate in RATES)
        tuning = (
            "Inputs and outputs at zero mean and unit deviation, float32, no weight decay.",
            f"ADAM with batches of {self.batch} for {self.epochs} epochs, its rate falling in "
            f"steps: {rates} of the epochs.",
        )
        return Facts({k: float(v) for k, v in sizes.items()}, tuning, train_s)
