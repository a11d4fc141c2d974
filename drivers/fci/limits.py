"""The last look at a torque command before it goes out: the robot's own limits."""

from __future__ import annotations

import math
from collections import deque

from drivers.fci.codec import JOINTS

# N m, the same for Panda/FER and FR3; Franka FCI documentation, robot limits.
TORQUE_LIMIT = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
# N m from one command to the next; the robot allows 1 (1000 N m/s at 1 kHz) and stops beyond.
TORQUE_STEP = 0.99

SETTLE_TICKS = 3  # an accepted torque that stays for so long is not on its way to ours
OWN_COMMANDS = 32  # an accepted torque is one of so many that were sent last
SAME = 1e-3  # N m; rounding of an f32 and some
STRANGE_TICKS = 3  # a torque that is none of ours is believed when it comes so often in a row


class TorqueLimiter:
    """Keeps commands within the torque and torque rate limits.

    A step counts from the command sent last and from the one that the robot says it accepted
    last, for a step from the wrong one is answered by a reflex. Where these are more than two
    steps apart, commands are still on their way, or they got lost: then nothing goes out until
    the accepted torque comes near or stands still, and in the latter case it is what counts. The
    robot holds its torque meanwhile; it puts up with 20 missing commands.

    Plain floats: for seven joints they take a third of the time of arrays.

    Attributes:
        last: 7 torques, N m, of the last command.
        cut: commands that were changed or kept back.
    """

    def __init__(self) -> None:
        self.last = [0.0] * JOINTS
        self.cut = 0
        self._fresh, self._waited, self._strange = True, 0, 0
        self._seen: list[float] = self.last
        self._accepted: list[float] = self.last
        self._sent: deque[list[float]] = deque(maxlen=OWN_COMMANDS)

    def reset(self) -> None:
        """A new motion begins; its first step counts from what the robot then drives with."""
        self.last, self._fresh = [0.0] * JOINTS, True
        self._waited = self._strange = 0
        self._sent.clear()

    def limit(self, tau: list[float], accepted: list[float]) -> list[float] | None:
        """The command that may go out for a wanted one; None where none should.

        Args:
            tau: 7 torques, N m, wanted, finite.
            accepted: 7 torques, N m, that the robot says it accepted last.
        """
        if self._fresh:
            finite = all(map(math.isfinite, accepted))
            self.last = self._accepted = accepted if finite else self.last
            self._fresh = False
        believed = self._believed(accepted)
        if believed is None:
            self.cut += 1
            return None
        accepted = self._accepted = believed
        both = zip(self.last, accepted, strict=True)
        if any(abs(last - own) > 2.0 * TORQUE_STEP for last, own in both):
            self._waited = self._waited + 1 if accepted == self._seen else 0
            self._seen = accepted
            if self._waited < SETTLE_TICKS:
                self.cut += 1
                return None
            self.last = accepted  # it stands still: it is not on its way to the one sent last
        self._waited = 0
        out = []
        for want, last, own, limit in zip(tau, self.last, accepted, TORQUE_LIMIT, strict=True):
            low, high = max(last, own) - TORQUE_STEP, min(last, own) + TORQUE_STEP
            out.append(min(max(want, low, -limit), high, limit))
        self.cut += out != tau
        self.last = out
        self._sent.append(out)
        return out

    def _believed(self, accepted: list[float]) -> list[float] | None:
        """The torque that the robot drives with: one of ours. None for any other: bits can flip."""
        for known in (self._accepted, *reversed(self._sent)):
            if all(abs(own - other) <= SAME for own, other in zip(accepted, known, strict=True)):
                self._strange = 0
                return known
        self._strange += 1
        if self._strange < STRANGE_TICKS or not all(map(math.isfinite, accepted)):
            return None
        return accepted
