"""A raw sample and the command given upon it, as one record of a ring."""

from __future__ import annotations

import numpy as np

from adapter.model.spatial import Array
from drivers.interface import JointSample, LinkMotion

HAS_LINKS, HAS_COMMAND, HAS_EXTERNAL = 1, 2, 4


class RawLayout:
    """Where a raw sample lies in `size` float64: stamp (int64 bits, ns), flags (int64 bits),
    q, dq, tau, command, external torque (n each), and link motion [twist accel] (links, 12) where
    links > 0.
    """

    def __init__(self, n: int, links: int = 0) -> None:
        self.n, self.links = n, links
        self.size = 2 + 5 * n + 12 * links
        self.q, self.dq, self.tau, self.command, self.external = (
            slice(2 + k * n, 2 + (k + 1) * n) for k in range(5)
        )
        self.motion = slice(2 + 5 * n, self.size)

    def new(self) -> Array:
        """An empty record."""
        return np.zeros(self.size)

    def fill(
        self,
        record: Array,
        sample: JointSample,
        command: Array | None,
        external: Array | None = None,
    ) -> None:
        """Write a sample, the torques (n,) commanded upon it and those from outside."""
        flags = 0
        record[self.q], record[self.dq], record[self.tau] = sample.q, sample.dq, sample.tau
        if command is not None:
            record[self.command] = command
            flags |= HAS_COMMAND
        if external is not None:
            record[self.external] = external
            flags |= HAS_EXTERNAL
        if sample.links is not None and self.links:
            motion = record[self.motion].reshape(self.links, 12)
            motion[:, :6], motion[:, 6:] = sample.links.twist, sample.links.accel
            flags |= HAS_LINKS
        words = record[:2].view(np.int64)
        words[0], words[1] = sample.stamp_ns, flags

    def sample(self, record: Array) -> tuple[JointSample, Array | None, Array | None]:
        """Sample, command and external torque of a record, as views; None for what is not there."""
        stamp_ns, flags = (int(word) for word in record[:2].view(np.int64))
        links = None
        if flags & HAS_LINKS:
            motion = record[self.motion].reshape(self.links, 12)
            links = LinkMotion(motion[:, :6], motion[:, 6:])
        command = record[self.command] if flags & HAS_COMMAND else None
        external = record[self.external] if flags & HAS_EXTERNAL else None
        parts = record[self.q], record[self.dq], record[self.tau]
        return JointSample(stamp_ns, *parts, links), command, external
