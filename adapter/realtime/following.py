"""Whoever in the loop goes on with the estimate that a live learner publishes."""

from __future__ import annotations

from collections.abc import Sequence

from adapter.control.observer import ContactObserver
from adapter.model.spatial import Array
from adapter.realtime.snapshot import ExternalTorque, Snapshot, SnapshotReader, SnapshotWriter
from drivers.interface import JointSample

REFRESH_TICKS = 500  # an estimate taken over costs some 0.2 ms


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


class FollowingObserver(EstimateFollower):
    """Steps an observer and lets it go on with each new estimate that has converged.

    What it says of each sample is published beside the estimate.

    Args:
        observer: of the documented arm, fresh.
        stops: whether a contact ends the motion, once something was learned.
        names: of the joints.
    """

    def __init__(
        self, observer: ContactObserver, stops: bool = False, names: Sequence[str] = ()
    ) -> None:
        super().__init__()
        self.observer, self._stops, self._names = observer, stops, names
        self._ticks = 0
        self._board: SnapshotWriter | None = None

    def attach(self, name: str) -> None:
        """Follow the estimate of this name, and publish there. Raises SnapshotError."""
        super().attach(name)
        self._board = SnapshotWriter.attach(name)

    def detach(self) -> None:
        """Neither follow nor publish any longer."""
        super().detach()
        if self._board is not None:
            self._board.close()
        self._board = None

    @property
    def alarm(self) -> str | None:
        """Why the motion has to end; None while nothing pushes."""
        contact = self.observer.contact
        if contact is None or not self._stops or not self.observer.learned:
            return None
        j = contact.joint
        name = f" ({self._names[j]})" if self._names else ""
        return (
            f"something pushes joint {j + 1}{name} with {contact.torque[j]:+.1f} N m, "
            f"{abs(contact.torque[j]) / contact.std[j]:.0f} standard deviations of the learned "
            "model: look what touches the arm; the arm is stopped"
        )

    def step(self, sample: JointSample) -> Array:
        """External torque (n,) N m with this sample."""
        self._ticks += 1
        new = self.new_estimate() if self._ticks % REFRESH_TICKS == 0 else None
        if new is not None:
            values = new.lam, new.theta, new.effects, new.effect_shapes, new.torque_std
            self.observer.adopt(*values)
        external = self.observer.step(sample)
        if self._board is not None:
            seen = self.observer
            joint = None if seen.contact is None else seen.contact.joint
            what = seen.torque, seen.std, *seen.wrench(), joint
            self._board.publish_external(ExternalTorque(*what, seen.learned, sample.stamp_ns))
        return external
