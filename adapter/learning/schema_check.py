"""Whether λ stands in a wrong valley, joint by joint, and the place to start anew from.

The cost of a rotation has saddle points half a turn away from its minimum, and with the position
beside it other valleys: there ADAM stands still at the wrong frame. The moments tell, since a
closed form on them needs no start (`frame_fit`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from adapter.learning import frame_fit
from adapter.model.spatial import Array

# Logarithms of what frames leave unexplained, summed over the channels.
CLEARLY_BETTER = 0.5
AGAIN = 2.0  # a joint is checked again when there are so many times the samples
LOOKS = 20  # until a joint's turn comes again


class Evidence(NamedTuple):
    """What is known of one joint.

    Attributes:
        sums, clean: (3, 15, 15) moments of so many samples, and what of them is motion.
        rank: directions known. least: curvature above which a direction follows the data.
        still: whether ADAM has arrived where the gradient leads it.
    """

    sums: Array
    clean: Array
    samples: float
    rank: int
    least: float
    still: bool


class SchemaCheck:
    """Looks at every joint once in so many looks, and rarely solves for one.

    Args:
        n: joints.

    Attributes:
        misfit: (n,) what each frame left unexplained when it was last looked at.
        passed_at, passed_rank: (n,) samples and directions shown when it was last found right.
        turn: the number of the next look.
        restarts: joints that were started anew so far.
    """

    def __init__(self, n: int) -> None:
        self.misfit = np.full(n, np.inf)
        self.passed_at, self.passed_rank = np.zeros(n), np.full(n, -1)
        self.turn = self.restarts = 0

    def next_joints(self, ranks: np.ndarray | None) -> list[int]:
        """The joints that this look is at.

        Args:
            ranks: (n,) directions shown where λ stands still, waiting for its check alone: then a
                joint that has not been found right with them comes out of turn.
        """
        joints = list(range(self.turn, len(self.misfit), LOOKS))
        self.turn = (self.turn + 1) % LOOKS
        if ranks is not None:
            joints += [int(j) for j in np.flatnonzero(self.passed_rank != ranks)[:1]]
        return joints

    def better(
        self, j: int, frame: frame_fit.Frame, start: frame_fit.Frame, known: Evidence
    ) -> frame_fit.Frame | None:
        """Where joint j is to start anew; None where it is right, or still on its way.

        Args:
            frame: where it stands; start: where it stays in what the data do not show.
        """
        misfit, before = frame_fit.log_misfit(known.sums, known.samples, frame), self.misfit[j]
        self.misfit[j] = misfit
        due = known.rank != self.passed_rank[j] or known.samples > AGAIN * self.passed_at[j]
        if not due or (misfit < before - 0.2 and not known.still):  # ADAM is on its way
            return None
        found = self._solved(frame, start, known, misfit)
        self.passed_at[j], self.passed_rank[j] = known.samples, known.rank
        if found is not None:
            self.misfit[j] = frame_fit.log_misfit(known.sums, known.samples, found)
            self.restarts += 1
        return found

    @staticmethod
    def _solved(
        frame: frame_fit.Frame, start: frame_fit.Frame, known: Evidence, misfit: float
    ) -> frame_fit.Frame | None:
        """The closed form's frame where it is clearly better."""
        sums, count = known.sums, known.samples
        found, _ = frame_fit.best_frame(sums, frame_fit.profiled_weights(sums, count, frame), frame)
        weights = frame_fit.profiled_weights(sums, count, found)
        found, _ = frame_fit.descend(sums, weights, found)
        if frame_fit.log_misfit(sums, count, found) > misfit - CLEARLY_BETTER:
            return None
        weights = frame_fit.profiled_weights(sums, count, found)
        freedom = frame_fit.hidden_freedom(known.clean, weights, found, known.least)
        held = frame_fit.nearest(sums, weights, found, start, freedom)
        return held if frame_fit.log_misfit(sums, count, held) < misfit - CLEARLY_BETTER else found
