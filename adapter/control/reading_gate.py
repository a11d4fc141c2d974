"""Which joint readings a controller may act upon, and when it has to give up.

And how far an arm's time goes from sample to sample, from stamps that may lie.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from adapter.errors import ControlError
from adapter.model.spatial import Array
from adapter.physics.kernels import jit
from drivers.interface import JointSample


class SampleClock:
    """Turns stamps into steps of time that never go back and never leap.

    By stamps alone, a stamp that repeats, or lies before the newest, is a step of nothing; one
    that leaps further than `longest_ns` is a step of one period, since a clock that was set looks
    like that. Where the instants at which samples are handled are told as well, these decide in
    whole periods, since nobody sets that clock: it tells a hole from a leap. An instant halfway
    between two ticks leaves the choice between them to the stamp, and so does one much later than
    a stamp that follows its predecessor: no sample is missing, nobody was there to take it.

    Args:
        period_ns: of the arm.
        longest_ns: longest step of the stamps that is believed.

    Attributes:
        fresh: the last stamp was newer than those before it.
        stamp_step_ns: the last step by the stamps alone.
        leapt: the last stamp was further ahead than is believed.
        clock_step_ns: since the last call by the instants alone.
    """

    def __init__(self, period_ns: int, longest_ns: int) -> None:
        self._period_ns, self._longest_ns = period_ns, longest_ns
        self._newest_ns: int | None = None
        self._behind_ns, self._behind = 0, 0
        self._tick_ns: int | None = None
        self._last_ns = 0
        self.fresh, self.leapt, self.stamp_step_ns, self.clock_step_ns = True, False, 0, 0

    def step(self, stamp_ns: int, now_ns: int = 0) -> int:
        """Time since the last call, ns; 0 at the first one.

        Args:
            stamp_ns: of the sample.
            now_ns: instant at which it is handled, on a clock that nobody sets; 0 for none.
        """
        step_ns = self.stamp_step_ns = self._by_stamp(stamp_ns)
        return self._by_clock(now_ns, step_ns) if now_ns else step_ns

    def _by_stamp(self, stamp_ns: int) -> int:
        newest, self.fresh, self.leapt = self._newest_ns, True, False
        if newest is None:
            self._newest_ns = stamp_ns
            return 0
        if stamp_ns > newest:
            self._newest_ns, self._behind = stamp_ns, 0
            step_ns = stamp_ns - newest
            self.leapt = step_ns > self._longest_ns
            return self._period_ns if self.leapt else step_ns
        goes_on = self._behind and stamp_ns > self._behind_ns
        self._behind = self._behind + 1 if goes_on else 1
        self._behind_ns = stamp_ns
        if self._behind < 5:  # in a row: the clock was set back
            self.fresh = False
            return 0
        self._newest_ns, self._behind = stamp_ns, 0
        return self._period_ns

    def _by_clock(self, now_ns: int, step_ns: int) -> int:
        if self._tick_ns is None:
            self._tick_ns = self._last_ns = now_ns
            return 0
        self.clock_step_ns, self._last_ns = max(now_ns - self._last_ns, 0), now_ns
        period, since_ns = self._period_ns, max(now_ns - self._tick_ns, 0)
        if self.fresh and not self.leapt and since_ns - step_ns > 20 * period:  # nobody was there
            self._tick_ns = now_ns
            return step_ns
        ticks = round(since_ns / period)
        off_ns = since_ns - ticks * period
        if abs(off_ns) > 0.35 * period:  # nearer, it belongs to the tick
            stamped = round(step_ns / period)
            if abs(stamped * period - since_ns) < period:
                ticks, off_ns = stamped, since_ns - stamped * period
        if ticks:
            self._tick_ns += ticks * period + off_ns // 16
        return ticks * period


# What an honest reading keeps between two samples. A jump that stays below the first two moves
# the spring of a stiff joint (600 N m/rad) by 3 N m.
JUMP = 0.005  # rad, beyond what the measured speeds say: noise, steps of the encoder
DRIFT = 0.25  # of the documented speed, by which the measured one may be wrong or late
FASTER = 1.5  # of the documented speed is more than a joint does
HARDER = 100.0  # rad/s² is more than an arm does, five times what a Panda may
BLIND_NS = 20_000_000  # without a usable reading for so long, the controller gives up
_SINCE = f"for {1e-9 * BLIND_NS:g} s; the arm is stopped"


class ReadingVerdict(IntEnum):
    """What a reading is found to be."""

    GOOD = 0
    NON_FINITE = 1
    JUMPED = 2  # moved as no joint moves
    STUCK = 3  # stands still while the arm should move
    REPEATED = 4  # not newer than those before it
    BROKEN_OFF = 5  # a jump behind a hole: of all samples, or of this joint's


@jit
def judge_reading(q, dq, q_ref, between_s, bounds, last):
    """(verdict, joint) on a reading; `last` is overwritten if it is good.

    Args:
        q, dq: (n,) the reading; q_ref: (n,) the reference.
        between_s: (least, most) time since the last good reading.
        bounds: rows (2, n): documented speed, rad/s; how far the reference may move while the
            reading stays the same to the last bit, rad.
        last: rows (4, n): q and dq of the last good reading, NaN before the first; the reference
            when q changed at last; the way that the measured speed has made since then, rad.
    """
    n = q.shape[0]
    least_s, most_s = between_s
    velocity, wind = bounds[0], bounds[1]
    last_q, last_dq, reference, way = last[0], last[1], last[2], last[3]
    for j in range(n):
        if not (math.isfinite(q[j]) and math.isfinite(dq[j])):
            return ReadingVerdict.NON_FINITE.value, j
    for j in range(n):
        if not math.isfinite(last_q[j]):
            continue
        moved = q[j] - last_q[j]
        speed = 0.5 * (dq[j] + last_dq[j])
        low, high = min(speed * least_s, speed * most_s), max(speed * least_s, speed * most_s)
        room = JUMP + DRIFT * velocity[j] * most_s
        if abs(dq[j]) > FASTER * velocity[j]:
            return ReadingVerdict.JUMPED.value, j
        if abs(dq[j] - last_dq[j]) > DRIFT * velocity[j] + HARDER * most_s:
            return ReadingVerdict.JUMPED.value, j
        if abs(moved) > JUMP + FASTER * velocity[j] * most_s:
            return ReadingVerdict.JUMPED.value, j
        if moved < low - room or moved > high + room:
            return ReadingVerdict.JUMPED.value, j
    for j in range(n):
        if q[j] != last_q[j]:
            continue
        wound = abs(q_ref[j] - reference[j]) > wind[j]
        if wound or abs(way[j] + dq[j] * least_s) > 0.02:  # rad
            return ReadingVerdict.STUCK.value, j
    for j in range(n):
        if q[j] != last_q[j]:
            reference[j], way[j] = q_ref[j], 0.0
        else:
            way[j] += dq[j] * least_s
        last_q[j], last_dq[j] = q[j], dq[j]
    return ReadingVerdict.GOOD.value, 0


_WHY = {
    ReadingVerdict.NON_FINITE: f"no usable joint reading {_SINCE}",
    ReadingVerdict.GOOD: f"no usable joint reading {_SINCE}",
    ReadingVerdict.REPEATED: f"no newer joint reading {_SINCE}; look at the arm's clock and the "
    "connection",
    ReadingVerdict.JUMPED: f"joint {{}} reads what no joint can move to {_SINCE}; look at "
    "its encoder",
    ReadingVerdict.STUCK: "joint {} reads the same while it should move; the arm is stopped; "
    "something holds it, or its encoder stands still",
    ReadingVerdict.BROKEN_OFF: "the samples broke off and joint {} is elsewhere now; the arm is "
    "stopped; look at the connection",
}


class ReadingGate:
    """Takes every sample; says how far time went and whether its reading may be acted upon.

    Args:
        velocity: (n,) documented speeds, rad/s.
        effort: (n,) limits, N m (may be infinite); stiffness: (n,) of the controller, N m/rad.
        period_ns: of the arm.

    Attributes:
        unusable: readings that may not be acted upon.
    """

    def __init__(self, velocity: Array, effort: Array, stiffness: Array, period_ns: int) -> None:
        with np.errstate(divide="ignore", invalid="ignore"):
            wind = 0.1 * np.asarray(effort) / stiffness  # of the limit, in the spring
        wind = np.where(np.isfinite(wind), wind, np.inf)
        self._bounds = np.array([velocity, wind], dtype=np.float64)
        self._last, self._joint = np.full((4, len(velocity)), np.nan), 0
        self._last[3] = 0.0
        still = np.zeros(len(velocity))  # compiled now, not in the first tick
        judge_reading(still, still, still, (0.0, 0.0), self._bounds, self._last.copy())
        self._period_ns = period_ns
        self._clock = SampleClock(period_ns, 20_000_000)  # ns; longer, a clock was set
        self._started = self._leapt = False
        self.unusable = 0
        self._blind_ns = self._handled_ns = self._stamped_ns = 0
        self._unmeasured: NDArray[np.bool_] | None = None  # since its last measured, good reading

    def look(self, sample: JointSample, now_ns: int) -> int:
        """Time since the last sample, ns; see `SampleClock.step`.

        Where only stamps are known, a call without a newer one still counts as a period blind.
        """
        step_ns = self._clock.step(sample.stamp_ns, now_ns)
        if self._started:
            self._blind_ns += step_ns if now_ns else max(step_ns, self._period_ns)
            self._handled_ns += self._clock.clock_step_ns if now_ns else self._period_ns
            self._stamped_ns += self._clock.stamp_step_ns
            self._leapt = self._leapt or self._clock.leapt
        self._started = True
        return step_ns

    def usable(self, sample: JointSample, q_ref: Array) -> bool:
        """Whether to act upon the sample that was looked at; q_ref (n,) rad is the reference.

        Raises ControlError after 20 ms without one, also if this one is; at once for a joint that
        stands still, since its spring is wound up.
        """
        verdict = ReadingVerdict.REPEATED
        if self._clock.fresh:
            times = 1e-9 * self._handled_ns, 1e-9 * self._stamped_ns
            reading = sample.q, sample.dq, q_ref, (min(times), max(times))
            found, self._joint = judge_reading(*reading, self._bounds, self._last)
            verdict = ReadingVerdict(found)
        unmeasured = np.isnan(sample.tau)  # what a driver predicts has no torque
        if self._unmeasured is not None:
            self._unmeasured |= unmeasured
            hole = self._leapt or bool(self._unmeasured[self._joint])
            if verdict == ReadingVerdict.JUMPED and hole:
                verdict = ReadingVerdict.BROKEN_OFF
        if self._blind_ns > BLIND_NS or verdict == ReadingVerdict.STUCK:
            raise ControlError(_WHY[verdict].format(self._joint + 1))
        if verdict != ReadingVerdict.GOOD:
            self.unusable += 1
            return False
        self._blind_ns = self._handled_ns = self._stamped_ns = 0
        self._leapt, self._unmeasured = False, unmeasured
        return True
