"""The contact observer beside a live learner: it follows the estimate that is published."""

from __future__ import annotations

from collections.abc import Sequence

from adapter.control.observer import ContactObserver
from adapter.model.spatial import Array
from adapter.realtime.estimates import EstimateFollower
from drivers.interface import JointSample

REFRESH_TICKS = 500  # an estimate taken over costs some 0.2 ms


class FollowingObserver(EstimateFollower):
    """Steps an observer and lets it go on with each new estimate that has converged.

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
        return self.observer.step(sample)
