"""What pushed the arm, as results tell it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapter.control.contact_kind import kind_of
from adapter.control.observer import ContactObserver
from adapter.learning.learner import OnlineLearner
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from drivers.interface import JointSample

ADOPT_EVERY = 100  # samples


class ReplayObserver:
    """The contact observer beside a learner in the same thread.

    Args:
        documented: the arm; on a fixed base.
        learner: whose estimate it goes on with once it has converged.
    """

    def __init__(self, documented: SelfModel, learner: OnlineLearner) -> None:
        effects = learner.settings.effects
        self.observer, self._learner = ContactObserver(documented, effects), learner
        self._samples = 0

    def step(self, sample: JointSample) -> None:
        """Take a sample that the learner has seen."""
        signals = np.array([[sample.q, sample.dq, sample.tau]])
        self.step_each(np.array([sample.stamp_ns]), signals)

    def step_each(self, stamp_ns: NDArray[np.int64], signals: Array) -> None:
        """Take samples that the learner has seen: stamps (m,), and q, dq, tau (m, 3, n) of each."""
        begin = 0
        while begin < len(signals):
            end = min(begin + ADOPT_EVERY - self._samples % ADOPT_EVERY, len(signals))
            self.observer.step_each(stamp_ns[begin:end], signals[begin:end])
            self._samples += end - begin
            begin = end
            learner = self._learner
            if self._samples % ADOPT_EVERY or not learner.theta_converged:
                continue
            theta, std = learner.theta, learner.theta.variance() ** 0.5
            now = theta.theta, theta.effect_values, theta.shapes, std
            self.observer.adopt(learner.schema.lam, *now)


def contacts_of(observer: ContactObserver, documented: SelfModel) -> list[dict[str, Any]]:
    """Each contact: stamps, joint (from 1), largest torques and their std by joint, what it was."""
    effort = documented.limits.effort
    return [
        {
            "begin_ns": contact.begin_ns,
            "end_ns": contact.end_ns,
            "joint": contact.joint + 1,
            "torque_nm": contact.torque.tolist(),
            "std_nm": contact.std.tolist(),
            "kind": kind_of(contact, observer.frames, documented.gravity, effort).value,
        }
        for contact in observer.contacts
    ]


def contact_lines(
    contacts: Sequence[dict[str, Any]], names: Sequence[str], start_s: float
) -> list[str]:
    """A sentence on the contacts, where there were any; times from the stamp `start_s`."""
    if not contacts:
        return []
    first = contacts[0]
    j = first["joint"] - 1
    more = f", and {len(contacts) - 1} more" if len(contacts) > 1 else ""
    return [
        f"something pushed the arm: {first['kind']} at {1e-9 * first['begin_ns'] - start_s:.3f} s, "
        f"{first['torque_nm'][j]:+.1f} N m on {names[j]}{more}"
    ]
