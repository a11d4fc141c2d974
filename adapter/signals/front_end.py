"""From a driver's sample to a filtered state: checks, filter, twist synthesis. Pure, no clock."""

from __future__ import annotations

import math
from collections import Counter
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import jit
from adapter.signals.filters import NEVER, FilterState, Gains, JointFilter, filter_step
from adapter.signals.records import StateLayout
from adapter.signals.settings import FilterSettings, FrontEndSettings
from adapter.signals.twist import TwistSynthesis
from drivers.interface import JointSample


class Verdict(IntEnum):
    """Why a sample is not learned from; counted under these names in lower case."""

    GOOD = 0
    NON_FINITE = 1
    OUT_OF_RANGE = 2
    REPEATED = 3
    TIME_BACKWARDS = 4
    FILTER_SETTLING = 5
    AT_REST = 6
    TORQUE_SATURATED = 7
    IMPLAUSIBLE_STEP = 8
    STUCK_JOINT = 9
    ENCODER_JUMP = 10
    TIME_AHEAD = 11


NOTEWORTHY = (
    Verdict.NON_FINITE,
    Verdict.OUT_OF_RANGE,
    Verdict.TIME_BACKWARDS,
    Verdict.TORQUE_SATURATED,
    Verdict.IMPLAUSIBLE_STEP,
    Verdict.STUCK_JOINT,
    Verdict.ENCODER_JUMP,
)
# What no joint of an arm does, where its documentation is silent: rad, rad/s, N m.
Q_CAP, DQ_CAP, TAU_CAP = 1e4, 1e3, 1e5
RESYNC_AFTER = 100  # stamps in a row that lie before the newest: the newest was wrong
STREAK = 10  # so many old stamps in a row are a clock put back, not late samples
# From one sample to the next a reading may change by so many times its usual change, plus, for
# every period between them, these shares of documented speed and effort; a position, beyond what
# its speed explains, by this share of a period's way at full speed.
USUAL_STEPS, Q_STEP, DQ_STEP, TAU_STEP = 6.0, 0.5, 0.02, 0.02
PLAY_RAD = 0.012  # a motor crosses the play of its gear in no time: no step of an encoder
USUAL_OVER = 200.0  # samples that "usual" looks back on
JUMP_CONFIRMED = 3  # samples in a row that confirm a step of position
STUCK_RAD = 3e-3  # a joint's readings stand still while its speed would have brought it so far


class Rules(NamedTuple):
    """What does not change from sample to sample.

    Attributes:
        range: (4, n) lowest and highest q, highest |dq| and |tau|.
        effort: (n,) |tau| from which a torque counts as saturated.
        floor: (3, n) change of q, dq, tau from sample to sample that is always believed.
        rest_dq: rad/s; gap_ns: a longer hole restarts the filter.
        gains: of the filter.
    """

    range: Array
    effort: Array
    floor: Array
    rest_dq: float
    gap_ns: int
    gains: Gains


class Memory(NamedTuple):
    """What the front end remembers; overwritten in place.

    Attributes:
        last: (3, n) q, dq, tau of the last sample in range.
        good, doubted: (3, n) the last believed reading, the last one that was not.
        usual: (3, n) squares of the readings' usual changes.
        since: (n,) int64 stamps at which the joints' readings last changed.
        ahead: (3 n,) the reading whose stamp lay far ahead.
        marks: (9,) int64, see `Mark`.
        filter: of the filter.
    """

    last: Array
    good: Array
    doubted: Array
    usual: Array
    since: NDArray[np.int64]
    ahead: Array
    marks: NDArray[np.int64]
    filter: FilterState


class Mark(IntEnum):
    """Places in `Memory.marks`: stamps (NEVER: none), counts, and a joint (from 1, 0: none)."""

    SATURATED_UNTIL = 0
    FIRST_MOVING = 1
    OLD_STAMPS = 2  # how many samples in a row came with a stamp before the newest
    SEEN = 3  # newest stamp in order
    AHEAD = 4  # a stamp far ahead that nobody has confirmed yet
    DOUBTED = 5  # stamp of a step that nobody has confirmed yet
    CONFIRMED = 6  # how many samples in a row confirm it
    JUMPED = 7  # joint whose encoder jumped
    USUAL_DT = 8  # ns between samples


class Samples(NamedTuple):
    """Raw samples: stamps (m,) int64 ns; q, dq, tau (m, n)."""

    stamps: NDArray[np.int64]
    q: Array
    dq: Array
    tau: Array


class Answers(NamedTuple):
    """What became of samples.

    Attributes:
        records: (m, size), stamp and filtered signals filled where the verdict is GOOD.
        verdicts: (m,) int64 of `Verdict`.
        holes: (m, 2) int64 stamps before and behind a gap that restarted the filter; else 0.
    """

    records: Array
    verdicts: NDArray[np.int64]
    holes: NDArray[np.int64]


@jit
def judge(q, dq, tau, allowed, last):
    """Verdict on raw readings: GOOD, NON_FINITE, OUT_OF_RANGE or REPEATED, all those of `last`.

    `last` (3, n) is overwritten with good readings.
    """
    lower, upper, dq_max, tau_max = allowed[0], allowed[1], allowed[2], allowed[3]
    same = True
    for j in range(q.shape[0]):
        if not (np.isfinite(q[j]) and np.isfinite(dq[j]) and np.isfinite(tau[j])):
            return Verdict.NON_FINITE
    for j in range(q.shape[0]):
        if q[j] < lower[j] or q[j] > upper[j] or abs(dq[j]) > dq_max[j] or abs(tau[j]) > tau_max[j]:
            return Verdict.OUT_OF_RANGE
        same = same and q[j] == last[0, j] and dq[j] == last[1, j] and tau[j] == last[2, j]
    if same:
        return Verdict.REPEATED
    last[0], last[1], last[2] = q, dq, tau
    return Verdict.GOOD


@jit
def in_order(stamp, gap_ns, times, marks):
    """Verdict on a stamp: GOOD, TIME_BACKWARDS, or TIME_AHEAD until the next one confirms it."""
    if times[0] == NEVER:
        marks[Mark.SEEN] = stamp
        return Verdict.GOOD
    if stamp <= times[0]:
        marks[Mark.OLD_STAMPS] += 1
        if marks[Mark.OLD_STAMPS] < RESYNC_AFTER:
            return Verdict.TIME_BACKWARDS
    elif stamp - max(times[0], marks[Mark.SEEN]) > gap_ns:
        confirmed = marks[Mark.AHEAD] != NEVER and 0 < stamp - marks[Mark.AHEAD] <= gap_ns
        marks[Mark.AHEAD] = stamp
        if not confirmed:
            return Verdict.TIME_AHEAD
    marks[Mark.SEEN] = stamp
    return Verdict.GOOD


@jit
def off(s, j, x, reference, dt_ns):
    """How far reading s of joint j is from where the reference says it is after dt_ns."""
    way = 1e-9 * dt_ns * reference[1, j] if s == 0 else 0.0
    return abs(x[s, j] - reference[s, j] - way)


@jit
def steps(x, reference, dt_ns, usual, floor, usual_dt_ns):
    """Readings x (3, n) that a step away from the reference: 0 none, 1 some, 2 a position too."""
    ratio, found = max(1.0, dt_ns / usual_dt_ns), 0
    for s in range(3):
        for j in range(x.shape[1]):
            most = USUAL_STEPS * math.sqrt(usual[s, j]) + ratio * floor[s, j]
            most += PLAY_RAD if s == 0 else 0.0
            if off(s, j, x, reference, dt_ns) > most:
                found = max(found, 2 if s == 0 else 1)
    return found


@jit
def get_used(x, reference, dt_ns, usual, floor):
    """Let the usual changes follow; what is out of the usual counts as just not."""
    for s in range(3):
        for j in range(x.shape[1]):
            most = USUAL_STEPS * math.sqrt(usual[s, j]) + floor[s, j]
            e = min(off(s, j, x, reference, dt_ns), most)
            usual[s, j] += (e * e - usual[s, j]) / USUAL_OVER


@jit
def stands_still(stamp, x, good, since):
    """Whether a joint's readings are those of before, although its speed says it moves."""
    stuck = False
    for j in range(x.shape[1]):
        if x[0, j] != good[0, j] or x[1, j] != good[1, j] or x[2, j] != good[2, j]:
            since[j] = stamp
        stuck = stuck or abs(x[1, j]) * 1e-9 * (stamp - since[j]) > STUCK_RAD
    return stuck


@jit
def plausible(stamp, x, rules, memory):
    """Verdict on readings x (3, n) after the last good ones: whether an arm can do that.

    A step is believed when the next sample confirms it: a spike lasts for one. A step of position
    that the speed does not explain is believed after `JUMP_CONFIRMED`, and to be the encoder's.
    Behind a gap nothing can be said of steps.
    """
    good, doubted, usual, marks = memory.good, memory.doubted, memory.usual, memory.marks
    dt_ns = stamp - memory.filter.times[0]
    if marks[Mark.USUAL_DT] == 0:
        marks[Mark.USUAL_DT] = dt_ns
    marks[Mark.USUAL_DT] += (min(dt_ns, 2 * marks[Mark.USUAL_DT]) - marks[Mark.USUAL_DT]) // 64
    if stands_still(stamp, x, good, memory.since):
        return Verdict.STUCK_JOINT
    if dt_ns > rules.gap_ns:
        return Verdict.GOOD
    usual_dt = marks[Mark.USUAL_DT]
    found = steps(x, good, dt_ns, usual, rules.floor, usual_dt)
    get_used(x, good, dt_ns, usual, rules.floor)
    if found == 0:
        return Verdict.GOOD
    marks[Mark.CONFIRMED] += 1
    since_ns = stamp - marks[Mark.DOUBTED]
    if marks[Mark.DOUBTED] == NEVER or steps(x, doubted, since_ns, usual, rules.floor, usual_dt):
        marks[Mark.CONFIRMED] = 0
    doubted[:] = x
    marks[Mark.DOUBTED] = stamp
    if found == 1 and marks[Mark.CONFIRMED] > 0:
        return Verdict.GOOD
    if found == 2 and marks[Mark.CONFIRMED] >= JUMP_CONFIRMED:
        for j in range(x.shape[1]):
            worst = marks[Mark.JUMPED] - 1
            if worst < 0 or off(0, j, x, good, dt_ns) > off(0, worst, x, good, dt_ns):
                marks[Mark.JUMPED] = j + 1
        return Verdict.ENCODER_JUMP
    return Verdict.IMPLAUSIBLE_STEP


@jit
def believed(stamp, x, rules, memory):
    """(verdict, whether a gap lies before it) of readings x (3, n) in range and in order."""
    marks, times = memory.marks, memory.filter.times
    if times[0] == NEVER:
        memory.since[:] = stamp
        marks[Mark.JUMPED] = 0
        return Verdict.GOOD, False
    if marks[Mark.JUMPED]:
        return Verdict.ENCODER_JUMP, False
    verdict = plausible(stamp, x, rules, memory)
    gap = stamp - times[0] > rules.gap_ns
    if verdict == Verdict.ENCODER_JUMP and stamp - times[1] < rules.gains.settle_ns:
        # it was the first that was wrong
        marks[Mark.JUMPED] = 0
        times[0] = NEVER
        return Verdict.GOOD, gap
    return verdict, gap


@jit
def taken(samples, i, rules, memory, answers):
    """Verdict on sample i; filtered into its record where it teaches something."""
    stamp, dq, tau, marks = samples.stamps[i], samples.dq[i], samples.tau[i], memory.marks
    times, gains = memory.filter.times, rules.gains
    verdict = judge(samples.q[i], dq, tau, rules.range, memory.last)
    seen, ahead_ns = marks[Mark.SEEN], marks[Mark.AHEAD]
    if verdict == Verdict.GOOD:
        verdict = in_order(stamp, rules.gap_ns, times, marks)
    n = dq.shape[0]
    if verdict == Verdict.TIME_AHEAD:
        memory.ahead[:n], memory.ahead[n : 2 * n] = samples.q[i], dq
        memory.ahead[2 * n :] = tau
    if verdict != Verdict.GOOD:
        return verdict
    gap = times[0] != NEVER and (
        stamp <= times[0] or stamp - seen > rules.gap_ns or marks[Mark.OLD_STAMPS] >= STREAK
    )
    marks[Mark.OLD_STAMPS] = 0
    x = np.empty((3, n))
    x[0], x[1], x[2] = samples.q[i], dq, tau
    if gap:  # nothing can be said of steps
        memory.since[:] = stamp
        marks[Mark.JUMPED] = 0
    else:
        verdict, gap = believed(stamp, x, rules, memory)
        if verdict != Verdict.GOOD:
            return verdict
    memory.good[:] = x
    marks[Mark.DOUBTED] = NEVER
    marks[Mark.AHEAD] = NEVER
    if gap:
        answers.holes[i, 0], answers.holes[i, 1] = times[0], stamp
        times[0] = NEVER
        if ahead_ns != NEVER and 0 < stamp - ahead_ns <= rules.gap_ns:  # it began there
            answers.holes[i, 1] = ahead_ns
            filter_step(ahead_ns, memory.ahead, gains, memory.filter)
    settled = filter_step(stamp, x.reshape(3 * n), gains, memory.filter)
    return worth(stamp, x, settled, rules, memory)


@jit
def worth(stamp, x, settled, rules, memory):
    """Verdict on a filtered sample: whether it teaches anything; remembers when it moved."""
    marks, n = memory.marks, x.shape[1]
    moving, fast = False, False
    for j in range(n):
        fast = fast or abs(x[1, j]) > rules.rest_dq
        moving = moving or abs(memory.filter.y[n + j]) >= rules.rest_dq
        if abs(x[2, j]) >= rules.effort[j]:
            marks[Mark.SATURATED_UNTIL] = stamp + rules.gains.settle_ns
    if fast and marks[Mark.FIRST_MOVING] == NEVER:
        marks[Mark.FIRST_MOVING] = stamp
    if not settled:
        return Verdict.FILTER_SETTLING
    if not moving:
        return Verdict.AT_REST
    if stamp <= marks[Mark.SATURATED_UNTIL]:
        return Verdict.TORQUE_SATURATED
    return Verdict.GOOD


@jit
def process(signals, rules, memory, whole, records, answers):
    """Check and filter samples in order; one call serves one sample or a whole recording.

    Takes few plain arrays, since handing over a record of many takes longer than the work itself.

    Args:
        signals: (m, 3, n) q, dq, tau.
        rules: as packed by `packed`; memory: (8, 3, n) and whole: (n + 11,) int64, see `unpacked`.
        records: (m, size), filled where the verdict is GOOD.
        answers: (m, 4) int64 [stamp ns, verdict, stamps before and behind a gap]; the first is
            given, the others are filled.
    """
    own, kept = unpacked(rules, memory, whole)
    samples = Samples(answers[:, 0], signals[:, 0], signals[:, 1], signals[:, 2])
    found = Answers(records, answers[:, 1], answers[:, 2:])
    n, y, dy = signals.shape[2], kept.filter.y, kept.filter.dy
    for i in range(signals.shape[0]):
        found.holes[i] = 0
        verdict = taken(samples, i, own, kept, found)
        found.verdicts[i] = verdict
        if verdict == Verdict.GOOD:
            row = records[i]
            row[:1].view(np.int64)[0] = samples.stamps[i] - own.gains.delay_ns
            row[2 : 2 + 2 * n] = y[: 2 * n]
            row[2 + 2 * n : 2 + 3 * n] = dy[n : 2 * n]
            row[2 + 3 * n : 2 + 4 * n] = y[2 * n :]


def packed(rules: Rules) -> Array:
    """The rules in one array; its inverse is in `unpacked`."""
    tables = (rules.range.ravel(), rules.effort, rules.floor.ravel())
    return np.concatenate([*tables, [rules.rest_dq, rules.gap_ns, *rules.gains]])


@jit
def unpacked(rules, memory, whole):
    """`Rules` and `Memory` as views of (8 n + 6,), (8, 3, n) and (n + 11,)."""
    n = memory.shape[2]
    at = 8 * n
    rest_dq, gap_ns, k1, k2 = rules[at], rules[at + 1], rules[at + 2], rules[at + 3]
    delay_ns, settle_ns = rules[at + 4], rules[at + 5]
    gains = Gains(k1, k2, int(delay_ns), int(settle_ns))
    allowed, floor = rules[: 4 * n].reshape(4, n), rules[5 * n : 8 * n].reshape(3, n)
    own = Rules(allowed, rules[4 * n : 5 * n], floor, rest_dq, int(gap_ns), gains)
    since, marks, times = whole[:n], whole[n : n + 9], whole[n + 9 :]
    ahead, old, y, dy = (
        memory[4].reshape(3 * n),
        memory[5].reshape(3 * n),
        memory[6].reshape(3 * n),
        memory[7].reshape(3 * n),
    )
    state = FilterState(times, old, y, dy)
    last, good, doubted, usual = memory[0], memory[1], memory[2], memory[3]
    return own, Memory(last, good, doubted, usual, since, ahead, marks, state)


class FrontEnd:
    """Checks, filters and completes samples, one by one.

    Args:
        documented: the arm's documented kinematics, limits and gravity.

    Attributes:
        refused: how many samples were not passed on, by reason.
        gaps: (stamp_ns, seconds) of each hole that restarted the filter.
        messages: one sentence for each kind of trouble, at its first occurrence.
    """

    def __init__(
        self,
        documented: SelfModel,
        filter_settings: FilterSettings | None = None,
        settings: FrontEndSettings | None = None,
    ) -> None:
        n = documented.tree.n
        self.settings = settings or FrontEndSettings()
        self.names = documented.tree.joint_names
        self.layout = StateLayout(n)
        self.filter = JointFilter(n, filter_settings)
        self.twist = TwistSynthesis(documented)
        self._rules = self._rules_of(documented)
        self._packed = packed(self._rules)
        self._kept, self._whole = np.zeros((8, 3, n)), np.zeros(n + 11, dtype=np.int64)
        self._memory = unpacked(self._packed, self._kept, self._whole)[1]
        self._memory.last[:] = np.nan
        self._memory.filter.times[:] = NEVER
        for mark in (Mark.SATURATED_UNTIL, Mark.FIRST_MOVING, Mark.SEEN, Mark.AHEAD, Mark.DOUBTED):
            self._memory.marks[mark] = NEVER
        self.filter.use(self._memory.filter)
        self._signals, self._answers = np.empty((1, 3, n)), np.zeros((1, 4), dtype=np.int64)
        self._records = self.layout.new(1)
        self.refused: Counter[str] = Counter()
        self.gaps: list[tuple[int, float]] = []
        self.messages: list[str] = []

    def _rules_of(self, documented: SelfModel) -> Rules:
        limits, s = documented.limits, self.settings
        allowed = [
            np.nan_to_num(limits.lower - s.q_margin, nan=-Q_CAP),
            np.nan_to_num(limits.upper + s.q_margin, nan=Q_CAP),
            np.nan_to_num(limits.velocity * s.range_factor, nan=DQ_CAP),
            np.nan_to_num(limits.effort * s.range_factor, nan=TAU_CAP),
        ]
        floor = np.array(
            [
                Q_STEP * self.filter.settings.period_s * limits.velocity,
                DQ_STEP * limits.velocity,
                TAU_STEP * limits.effort,
            ]
        )
        floor[np.isnan(floor)] = np.inf  # where nothing is documented
        effort, gap_ns = limits.effort * s.saturation, round(1e9 * s.max_gap_s)
        return Rules(np.array(allowed), effort, floor, s.rest_dq, gap_ns, self.filter.gains)

    @property
    def delay_s(self) -> float:
        """Age of a filtered state against its sample, s."""
        return self.filter.delay_s

    @property
    def first_moving_ns(self) -> int | None:
        """Stamp of the first sample with any measured |dq| above `rest_dq`."""
        stamp = int(self._memory.marks[Mark.FIRST_MOVING])
        return None if stamp == NEVER else stamp

    @property
    def fault(self) -> str | None:
        """What makes all further samples useless, or None: an encoder that jumped."""
        joint = int(self._memory.marks[Mark.JUMPED])
        if not joint:
            return None
        step = self._memory.doubted[0, joint - 1] - self._memory.good[0, joint - 1]
        name = self.names[joint - 1]
        return f"the encoder of {name} jumped by {step:.3g} rad; reference the arm, then run again"

    def step(self, sample: JointSample) -> Array | None:
        """The filtered state that this sample completes, or None where it teaches nothing.

        The record is reused by the next call. Reasons are counted in `refused`.
        """
        signals, answers = self._signals, self._answers
        signals[0, 0], signals[0, 1], signals[0, 2] = sample.q, sample.dq, sample.tau
        answers[0, 0] = sample.stamp_ns
        process(signals, self._packed, self._kept, self._whole, self._records, answers)
        if answers[0, 1]:
            self._refuse(answers[0, 1], sample, answers[0, 2:])
            return None
        record = self._records[0]
        self.twist.fill(record, sample)
        return record

    def step_table(
        self,
        stamp_ns: NDArray[np.int64],
        q: Array,
        dq: Array,
        tau: Array,
        twists: Array | None = None,
        accels: Array | None = None,
    ) -> Array:
        """The filtered states (k, size) of a whole recording, as `step` makes them one by one.

        Args:
            stamp_ns: (m,); q, dq, tau: (m, n); twists, accels: (m, n, 6), NaN where not measured.
        """
        signals = np.ascontiguousarray(np.stack([q, dq, tau], axis=1))
        records, answers = self.layout.new(len(q)), np.zeros((len(q), 4), dtype=np.int64)
        answers[:, 0] = stamp_ns
        process(signals, self._packed, self._kept, self._whole, records, answers)
        for i in np.flatnonzero(answers[:, 1]):
            sample = JointSample(int(stamp_ns[i]), q[i], dq[i], tau[i])
            self._refuse(answers[i, 1], sample, answers[i, 2:])
        good = answers[:, 1] == Verdict.GOOD
        records = records[good]
        self.twist.fill_table(
            records,
            q[good],
            dq[good],
            None if twists is None else twists[good],
            None if accels is None else accels[good],
        )
        return records

    def _refuse(self, verdict: int, sample: JointSample, hole: NDArray[np.int64]) -> None:
        if hole.any():
            before_ns, behind_ns = int(hole[0]), int(hole[1])
            gap_s = 1e-9 * (behind_ns - before_ns)
            if not self.gaps:
                self.messages.append(
                    f"at {1e-9 * before_ns:.3f} s: {gap_s:.3f} s without a sample; the filter "
                    "starts anew"
                )
            self.gaps.append((before_ns, gap_s))
        reason = Verdict(verdict)
        name = reason.name.lower()
        if reason in NOTEWORTHY and not self.refused[name]:
            self.messages.append(self._sentence(reason, sample))
        self.refused[name] += 1

    def _sentence(self, reason: Verdict, sample: JointSample) -> str:
        at = f"at {1e-9 * sample.stamp_ns:.3f} s"
        if reason == Verdict.OUT_OF_RANGE:
            lower, upper, dq_max, tau_max = self._rules.range
            for signal, value, low, high in (
                ("q", sample.q, lower, upper),
                ("dq", sample.dq, -dq_max, dq_max),
                ("tau", sample.tau, -tau_max, tau_max),
            ):
                for j in np.flatnonzero((value < low) | (value > high))[:1]:
                    hint = "; degrees instead of radians?" if signal != "tau" else "; N m?"
                    return (
                        f"{at}: {signal} of {self.names[j]} is {value[j]:.4g}, outside "
                        f"[{low[j]:.4g}, {high[j]:.4g}]{hint}"
                    )
        if reason == Verdict.NON_FINITE:
            return f"{at}: a reading is not a finite number; the sample was refused"
        if reason == Verdict.TORQUE_SATURATED:
            return f"{at}: a torque is at its limit; nothing is learned around it"
        if reason == Verdict.IMPLAUSIBLE_STEP:
            return f"{at}: a reading steps further than the arm moves; the sample was refused"
        if reason == Verdict.STUCK_JOINT:
            return f"{at}: a joint moves, its readings stand still; refused until they move"
        if reason == Verdict.ENCODER_JUMP:
            return f"{at}: {self.fault}"
        return f"{at}: time does not increase; the sample was refused"
