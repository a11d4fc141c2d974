"""Feed-forward from what is being learned at this moment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.control.feedforward import ModelFeedforward
from adapter.effects.active import Active
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.realtime.snapshot import SnapshotReader


class LearnedFeedforward:
    """Inverse dynamics of the estimate that a learner publishes; ready once θ has converged.

    Attach it (`attach`) when the snapshot exists; before that it is not ready.

    Args:
        tree: N and A.
        gravity: (3,) m/s² in base axes.
        effect_names: effects that the learner learns, in the order of the snapshot.
        tool_theta: (10,) of a known tool on the last link, which θ leaves out.
        known: lasting effects of the documented model that are not learned.
    """

    def __init__(
        self,
        tree: Tree,
        gravity: Array,
        effect_names: Sequence[str] = (),
        tool_theta: Array | None = None,
        known: Sequence[Active] = (),
    ) -> None:
        self._model = ModelFeedforward(tree, gravity, effect_names, known)
        self._tool = np.zeros((tree.n, 10))
        if tool_theta is not None:
            self._tool[-1] = tool_theta
        self._reader: SnapshotReader | None = None
        self._ready, self._version = False, 0

    def attach(self, name: str) -> None:
        """Follow the estimate of this name from now on. Raises SnapshotError."""
        self.detach()
        self._reader = SnapshotReader(name)

    def detach(self) -> None:
        """Follow no longer; what was read last stays."""
        if self._reader is not None:
            self._reader.close()
        self._reader = None

    @property
    def ready(self) -> bool:
        """An estimate of a converged θ was read."""
        return self._ready

    def refresh(self) -> None:
        """Take over the newest estimate if it is valid; one that is not leaves the last."""
        if self._reader is None:
            return
        snapshot = self._reader.read()
        usable = snapshot.lam_converged and snapshot.theta_converged
        if snapshot.version == self._version or not usable:
            return
        theta = snapshot.theta + self._tool
        if np.isfinite(theta).all() and np.isfinite(snapshot.lam).all():
            effects = np.nan_to_num(snapshot.effects)
            self._model.set(snapshot.lam, theta, effects, snapshot.effect_shapes)
            self._ready, self._version = True, snapshot.version

    def __call__(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Torques (n,) N m of a motion."""
        return self._model(q, dq, ddq)

    def unbent(self, q: Array) -> Array:
        """Torques (n,) N m of holding still with nothing bent."""
        return self._model.unbent(q)
