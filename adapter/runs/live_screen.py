"""Whether a live arm's torques are those of its model, from the first seconds of its motion."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from adapter.learning.learner import TorqueVerdict
from adapter.learning.trace import Trace
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.screening.screen import SHORTEST_S, RecordingRefused, torque_verdict
from adapter.signals.records import StateLayout, stamp_of, stamps_of
from adapter.signals.told import Told
from drivers.files.mcap import Log

# Of motion: the first verdict and the last. In between there is one each time the motion is twice
# as long: joints that stood at first are judged then, and a load that was picked up in the first
# seconds (its torques may look like another arm's) weighs less.
FIRST_S, LAST_S = 5.0, 40.0
HOLE_S = 0.02  # between states of one motion; in a longer one the arm rests
MOST_ROWS = 20_000  # kept; of more every second one


class LiveScreen:
    """The screen of recordings on the states that a live learner takes; see `learner.screen`.

    Args:
        documented: the arm; where its base floats, nothing is judged and nothing refused.
        say: takes the sentence that refuses, and one where more motion takes it back.
        trusted: what speaks against the torques is said and refuses nothing.
    """

    def __init__(
        self, documented: SelfModel, say: Callable[[str], None], trusted: bool = False
    ) -> None:
        self._arm, self._say, self._told = documented, say, {"told": Told(trusted=trusted)}
        self._verdict = TorqueVerdict(judged=documented.tree.floating)
        self._at = StateLayout(documented.tree.n)
        self._states = Trace(self._at.tau.stop, stride=1, capacity=MOST_ROWS)
        self._moved_s, self._last_ns, self._due_s = 0.0, 0, FIRST_S

    def __call__(self, state: Array) -> TorqueVerdict:
        """Take a filtered state (a record of `StateLayout`), in order; judge when it is time."""
        if self._due_s > LAST_S or self._arm.tree.floating:
            return self._verdict
        if self._states.due():
            self._states.keep(state[: self._at.tau.stop])
        self._moved_s += min(1e-9 * (stamp_of(state) - self._last_ns), HOLE_S)
        self._last_ns = stamp_of(state)
        if self._moved_s >= self._due_s:
            self._due_s *= 2.0
            self.judge()
        return self._verdict

    def judge(self) -> TorqueVerdict:
        """The verdict on the states so far; where they are too few, the one before stands."""
        if self._moved_s < SHORTEST_S:
            return self._verdict
        rows, at = self._states.rows, self._at
        signals = stamps_of(rows), rows[:, at.q], rows[:, at.dq], rows[:, at.tau]
        log = Log(Path("live"), self._arm.tree.joint_names, *signals, metadata=self._told)
        _, before, notes = self._verdict
        refusal = None
        try:
            torque, lines = torque_verdict(log, self._arm)
            if torque is None:
                return self._verdict
        except RecordingRefused as refused:
            refusal = str(refused)
            lines = [f"{refusal} Until that is mended nothing is called converged."]
        if before and not refusal:
            lines = ["live: with more motion the torques are those of this arm.", *lines]
        if bool(refusal) != bool(before) or not notes:  # other numbers alone are no news
            for line in lines:
                self._say(line)
            notes = (*notes, *lines)
        self._verdict = TorqueVerdict(True, refusal, notes)
        return self._verdict
