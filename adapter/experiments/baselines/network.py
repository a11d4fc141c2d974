"""A feed-forward network, as the paper's first baseline: scikit-learn, one hidden layer, ADAM."""

from __future__ import annotations

import warnings

import numpy as np

from adapter.errors import ModelError
from adapter.experiments.baselines.learner import Progress, ScaledBaseline, Told
from adapter.model.spatial import Array

UNITS = 1000  # the paper's
# (share of the epochs, share of ADAM's first rate): constant rates leave the loss where their
# noise is.
SCHEDULE = ((0.35, 1.0), (0.3, 0.5), (0.2, 0.15), (0.15, 0.05))


class FeedForward(ScaledBaseline):
    """tanh units in one hidden layer, inputs and outputs standardised, trained by ADAM."""

    at_once = 20_000  # so that the hidden layer stays below 100 MB

    def __init__(
        self,
        units: int = UNITS,
        epochs: int = 120,
        batch: int = 200,
        rate: float = 2e-3,
        seed: int = 0,
    ) -> None:
        """Nothing is imported before `fit`.

        Args:
            units: of the hidden layer.
            epochs: passes over all samples; the rate falls as in `SCHEDULE`.
            batch: samples of one step.
            rate: of ADAM at the start.
            seed: of the weights and of the order of samples.
        """
        self.units, self.epochs, self.batch, self.seed = units, epochs, batch, seed
        self.rate = rate

    def _learn_scaled(self, x: Array, y: Array, progress: Progress) -> Told:
        """Train on all samples in float32. Raises ModelError without scikit-learn."""
        try:
            from sklearn.neural_network import MLPRegressor
        except ImportError:
            said = "the feed-forward network needs scikit-learn; "
            raise ModelError(f"{said}pip install 'panda-adapter[experiment]'") from None
        x, y = x.astype(np.float32), y.astype(np.float32)
        self._net = MLPRegressor(
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
        for share, part in SCHEDULE:
            epochs, rate = max(1, round(share * self.epochs)), part * self.rate
            self._net.set_params(learning_rate_init=rate, max_iter=epochs)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that it stopped at the last epoch, as told to
                self._net.fit(x, y if y.shape[1] > 1 else y[:, 0])
            progress(f"network: {epochs} epochs at rate {rate:g}, loss {self._net.loss_:.2e}")
        own = {"units": self.units, "epochs": self.epochs}
        rates = ", ".join(f"{part * self.rate:g} for {share:.0%}" for share, part in SCHEDULE)
        return {**own, "samples": len(x), "inputs": x.shape[1]}, (
            "Inputs and outputs at zero mean and unit deviation, float32, no weight decay.",
            f"ADAM with batches of {self.batch} for {self.epochs} epochs, its rate falling in "
            f"steps: {rates} of the epochs.",
        )

    def _answer_scaled(self, x: Array) -> Array:
        found = self._net.predict(x.astype(np.float32))
        return np.asarray(found.reshape(len(x), -1), dtype=np.float64)
