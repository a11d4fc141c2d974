"""Whoever in the loop goes on with the estimate that a live learner publishes.

As feed-forward it is used as far as it can be believed. A published estimate may differ from the
documented model by a load and by friction that nobody documented, and by three standard deviations
of its own torque, at most as much again. Beyond that the documented model drives alone, until a
later estimate is inside. Every change fades in.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.control.feedforward import Feedforward, ModelFeedforward
from adapter.control.observer import ContactObserver
from adapter.effects.active import Active
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.kernels import JointMotion, base_at_rest, frames_of, regressors
from adapter.realtime.snapshot import ExternalTorque, Snapshot, SnapshotReader, SnapshotWriter
from drivers.interface import JointSample


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
        new = self.new_estimate() if self._ticks % 500 == 0 else None  # some 0.2 ms
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


FADE_CALLS = 500  # one in each tick


class FeedforwardBound:
    """By how much a learned model's torque may differ from the documented one's.

    Args:
        documented: the arm.
        model: its torques; share it with who asks for the same motions.
    """

    def __init__(self, documented: SelfModel, model: ModelFeedforward) -> None:
        self.model = model
        n, tree = documented.tree.n, documented.tree
        effort = np.where(np.isfinite(documented.limits.effort), documented.limits.effort, 0.0)
        mass = 0.25 * float(documented.theta[:, 0].sum())
        reach = mass * 0.15 * float(np.linalg.norm(documented.gravity))
        self._friction = 0.1 * effort + reach  # of the effort limit
        load = np.zeros((n, 10))
        load[-1, 0] = mass
        self._load = ModelFeedforward(tree, documented.gravity)
        self._load.set(documented.lam, load, np.zeros((0, n)))
        self._frames = frames_of(tree, documented.lam)
        self._base, self._Y = base_at_rest(documented.gravity)[None], np.zeros((1, n, 10 * n))
        still = np.zeros(n)
        self.at(still, still, still, np.zeros((n, 10)))  # compiled now

    def at(self, q: Array, dq: Array, ddq: Array, theta_std: Array) -> Array:
        """(n,) N m for a motion and standard deviations (n, 10) of θ."""
        allowed = np.abs(self._load(q, dq, ddq)) + self._friction
        regressors(self._frames, JointMotion(q[None], dq[None], ddq[None]), self._base, self._Y)
        variance = self._Y[0] ** 2 @ np.nan_to_num(theta_std.reshape(-1)) ** 2
        bound: Array = allowed + np.minimum(3.0 * np.sqrt(variance), allowed)
        return bound


class LearnedFeedforward(EstimateFollower, Feedforward):
    """Inverse dynamics of the estimate that a learner publishes; ready once θ has converged.

    Attach it (`attach`) when the snapshot exists; before that it is not ready.

    Args:
        tree: N and A.
        gravity: (3,) m/s² in base axes.
        effect_names: effects that the learner learns, in the order of the snapshot.
        tool_theta: (10,) of a known tool on the last link, which θ leaves out.
        known: lasting effects of the documented model that are not learned.
        bound: how far it may be from the documented model; anything goes where None.

    Attributes:
        ready: an estimate of a converged θ was read.
        notes: that it fell back, where it did.
    """

    def __init__(
        self,
        tree: Tree,
        gravity: Array,
        effect_names: Sequence[str] = (),
        tool_theta: Array | None = None,
        known: Sequence[Active] = (),
        bound: FeedforwardBound | None = None,
    ) -> None:
        super().__init__()
        self._model = ModelFeedforward(tree, gravity, effect_names, known)
        self._tool = np.zeros((tree.n, 10))
        if tool_theta is not None:
            self._tool[-1] = tool_theta
        self.ready = False
        self._bound, self._std = bound, np.zeros((tree.n, 10))
        self._asked = np.zeros((3, tree.n))
        self._most = np.full(tree.n, np.inf)
        self._jump, self._left = np.zeros((2, tree.n)), 0  # of the last change; calls to fade it
        self._believed, self._trust = True, 1.0
        self.notes: list[str] = []

    def refresh(self) -> None:
        """Take over the newest estimate if it is valid; one that is not leaves the last."""
        snapshot = self.new_estimate()
        if snapshot is not None:
            theta = snapshot.theta + self._tool
            if np.isfinite(theta).all() and np.isfinite(snapshot.lam).all():
                before = self._learned()
                effects = np.nan_to_num(snapshot.effects)
                self._model.set(snapshot.lam, theta, effects, snapshot.effect_shapes)
                # from what was said before to what the new parameters say
                self._left = 0
                if self.ready and self._trust > 0.0:
                    self._jump, self._left = before - self._learned(), FADE_CALLS
                self.ready = True
                if self._bound is not None and self._trust == 0.0:
                    q, dq, ddq = self._asked
                    apart = np.abs(self._model(q, dq, ddq) - self._bound.model(q, dq, ddq))
                    self._believed = bool((apart <= 0.8 * self._most).all())  # of the bound
                self._std = snapshot.theta_std
        if self.ready and self._bound is not None:
            q, dq, ddq = self._asked
            self._most = self._bound.at(q, dq, ddq, self._std)

    def _learned(self) -> Array:
        """(2, n) N m: what the present parameters say of the last motion, and of its posture."""
        moving = self._model(*self._asked) + self._jump[0] * self._left / FADE_CALLS
        return np.array(
            [moving, self._model.unbent(self._asked[0]) + self._jump[1] * self._left / FADE_CALLS]
        )

    def __call__(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Torques (n,) N m of a motion."""
        self._asked[0], self._asked[1], self._asked[2] = q, dq, ddq
        tau = self._model(q, dq, ddq)
        if self._left:
            self._left -= 1
            tau = tau + self._jump[0] * (self._left / FADE_CALLS)
        if self._bound is None or not self.ready:
            return tau
        documented = self._bound.model(q, dq, ddq)
        apart = tau - documented
        beyond = np.abs(apart) > self._most
        if beyond.any():
            j, self._believed = int(np.argmax(beyond)), False
            if not self.notes:
                self.notes.append(
                    f"the learned torque of joint {j + 1} was {apart[j]:.1f} N m from the "
                    f"documented model's (at most {self._most[j]:.1f} N m are believed); "
                    "feed-forward fell back to the documented model"
                )
            apart = np.minimum(np.maximum(apart, -self._most), self._most)
        step = 1.0 / FADE_CALLS
        self._trust = min(max(self._trust + (step if self._believed else -step), 0.0), 1.0)
        return documented + self._trust * apart

    def unbent(self, q: Array) -> Array:
        """Torques (n,) N m of holding still with nothing bent."""
        tau = self._model.unbent(q) + self._jump[1] * (self._left / FADE_CALLS)
        if self._bound is None or self._trust == 1.0:
            return tau
        documented = self._bound.model.unbent(q)
        apart = np.minimum(np.maximum(tau - documented, -self._most), self._most)
        return documented + self._trust * apart
