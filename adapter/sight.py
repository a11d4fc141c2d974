"""How long a controller has seen nothing it could act upon, and when it has to give up."""

from __future__ import annotations

from adapter.errors import ControlError
from adapter.pace import Pace
from adapter.readings import GOOD, JUMPED, NON_FINITE, STUCK, Readings
from adapter.records import Array
from drivers.interface import JointSample

BLIND_NS = 20_000_000  # without a usable reading for so long, the controller gives up
LONGEST_STEP_NS = 20_000_000  # a longer step of the stamps alone is a clock that was set
REPEATED = -1  # verdict on a sample that is not newer than those before it
BROKEN_OFF = -2  # a jump behind a leap of the stamps

_SINCE = f"for {1e-9 * BLIND_NS:g} s; the arm is stopped"
_WHY = {
    NON_FINITE: f"no usable joint reading {_SINCE}",
    GOOD: f"no usable joint reading {_SINCE}",
    REPEATED: f"no newer joint reading {_SINCE}; look at the arm's clock and the connection",
    JUMPED: f"joint {{}} reads what no joint can move to {_SINCE}; look at its encoder",
    STUCK: "joint {} reads the same while it should move; the arm is stopped; look at its encoder",
    BROKEN_OFF: "the samples broke off and joint {} is elsewhere now; the arm is stopped; look at "
    "the connection",
}


class Sight:
    """Takes every sample; says how far time went and whether its reading may be acted upon.

    Args:
        readings: judge of the numbers.
        period_ns: of the arm.

    Attributes:
        unusable: readings that may not be acted upon.
    """

    def __init__(self, readings: Readings, period_ns: int) -> None:
        self._readings, self._period_ns = readings, period_ns
        self._pace = Pace(period_ns, LONGEST_STEP_NS)
        self._started = self._leapt = False
        self.unusable = 0
        self._blind_ns = self._handled_ns = self._stamped_ns = 0

    def look(self, sample: JointSample, now_ns: int) -> int:
        """Time since the last sample, ns; see `Pace.step`.

        Where only stamps are known, a call without a newer one still counts as a period blind.
        """
        step_ns = self._pace.step(sample.stamp_ns, now_ns)
        if self._started:
            self._blind_ns += step_ns if now_ns else max(step_ns, self._period_ns)
            self._handled_ns += self._pace.clock_step_ns if now_ns else self._period_ns
            self._stamped_ns += self._pace.stamp_step_ns
            self._leapt = self._leapt or self._pace.leapt
        self._started = True
        return step_ns

    def usable(self, sample: JointSample, q_ref: Array) -> bool:
        """Whether to act upon the sample that was looked at; q_ref (n,) rad is the reference.

        Raises ControlError after 20 ms without one, also if this one is; at once for a joint that
        stands still, since its spring is wound up.
        """
        verdict = REPEATED
        if self._pace.fresh:
            times = 1e-9 * self._handled_ns, 1e-9 * self._stamped_ns
            q, dq = sample.q, sample.dq
            verdict = self._readings.judge(q, dq, q_ref, min(times), max(times))
        if verdict == JUMPED and self._leapt:
            verdict = BROKEN_OFF
        if self._blind_ns > BLIND_NS or verdict == STUCK:
            raise ControlError(_WHY[verdict].format(self._readings.joint + 1))
        if verdict != GOOD:
            self.unusable += 1
            return False
        self._blind_ns = self._handled_ns = self._stamped_ns = 0
        self._leapt = False
        return True
