"""The newest estimate of a live learner, for whoever in the loop goes on with it."""

from __future__ import annotations

from adapter.realtime.snapshot import Snapshot, SnapshotReader


class EstimateFollower:
    """Follows the estimate that a learner publishes; attach it when the snapshot exists."""

    def __init__(self) -> None:
        self._reader: SnapshotReader | None = None
        self._version = 0

    def attach(self, name: str) -> None:
        """Follow the estimate of this name from now on. Raises SnapshotError."""
        self.detach()
        self._reader = SnapshotReader(name)

    def detach(self) -> None:
        """Follow no longer; what was read last stays."""
        if self._reader is not None:
            self._reader.close()
        self._reader = None

    def new_estimate(self) -> Snapshot | None:
        """An estimate that has converged and was not handed out before; None without one."""
        if self._reader is None:
            return None
        found = self._reader.read()
        if found.version == self._version or not (found.lam_converged and found.theta_converged):
            return None
        self._version = found.version
        return found
