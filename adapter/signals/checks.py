"""What an arm can show: verdicts on readings and stamps, and what must be remembered for them.

A reading is refused that is not finite, outside the documented ranges, the one before again, out
of order, or a step that no arm makes and the next sample does not confirm.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.effects.by_joint import WAYS_RAD
from adapter.model.self_model import Limits
from adapter.model.spatial import Array
from adapter.physics.kernels import jit
from adapter.signals.bristles import Bristles
from adapter.signals.filters import NEVER, FilterState, Gains, JointFilter
from adapter.signals.settings import FrontEndSettings

# What no joint of an arm does, where its documentation is silent: rad, rad/s, N m.
Q_CAP, DQ_CAP, TAU_CAP = 1e4, 1e3, 1e5
# A documented speed is the maker's, or what somebody typed: readings beyond its range are believed
# up to the fastest joint there is, where the positions between two samples move so.
SLOWEST, FASTEST, SO_ALIKE = 2.0, 30.0, 0.5  # rad/s, rad/s, share of the speed
RESYNC_AFTER = 100  # stamps in a row that lie before the newest: the newest was wrong
STREAK = 10  # so many old stamps in a row are a clock put back, not late samples
# From one sample to the next a reading may change by so many times its usual change, plus, for
# every period between them, these shares of documented speed and effort; a position, beyond what
# its speed explains, by this share of a period's way at full speed.
# Those of speed and effort are of a millisecond, or of a shorter period.
USUAL_STEPS, Q_STEP, DQ_STEP, TAU_STEP = 6.0, 0.5, 0.02, 0.02
PLAY_RAD = 0.012  # a motor crosses the play of its gear in no time: no step of an encoder
USUAL_OVER = 200  # samples that "usual" looks back on
# Readings whose noise nobody knows yet: what speeds and torques do from one to the next is usual.
# The filter settles meanwhile, so that nothing is learned from them.
UNKNOWN = 10
JUMP_CONFIRMED = 3  # samples in a row that confirm a step of position
GAP_PERIODS = 3.0  # samples that may be missing are no hole
STUCK_RAD = 3e-3  # a joint's readings stand still while its speed would have brought it so far


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
    BASE_UNHEARD = 12
    BETWEEN = 13  # of several within a millisecond, not the one that becomes a state


class Rules(NamedTuple):
    """What does not change from sample to sample.

    Attributes:
        range: (4, n) lowest and highest q, highest |dq| and |tau|.
        effort: (n,) |tau| from which a torque counts as saturated.
        floor: (3, n) change of q, dq, tau from sample to sample that is always believed.
        rest_dq: rad/s; gap_ns: a longer hole restarts the filter.
        states: that a sample completes; samples: of which one becomes a state.
        gains: of the filter.
    """

    range: Array
    effort: Array
    floor: Array
    rest_dq: float
    gap_ns: int
    states: int
    samples: int
    gains: Gains


class Memory(NamedTuple):
    """What the front end remembers; overwritten in place.

    Attributes:
        last: (3, n) q, dq, tau of the last sample in range.
        good, doubted: (3, n) the last believed reading, the last one that was not.
        usual: (3, n) squares of the readings' usual changes.
        since: (n,) int64 stamps at which the joints' readings last changed.
        ahead: (c,) the reading whose stamp lay far ahead, as it goes into the filter.
        marks: (MARKS,) int64, see `Mark`.
        filter: of the filter.
        fastest: (n,) highest filtered |dq|, rad/s.
        bristles: in the joints.
    """

    last: Array
    good: Array
    doubted: Array
    usual: Array
    since: NDArray[np.int64]
    ahead: Array
    marks: NDArray[np.int64]
    filter: FilterState
    fastest: Array
    bristles: Bristles


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
    LAST = 9  # stamp of `Memory.last`
    WITHOUT = 10  # samples since the last one that became a state
    COMPARED = 11  # samples whose steps made "usual", at most USUAL_OVER


MARKS = len(Mark)


def rules_of(limits: Limits, settings: FrontEndSettings, joint_filter: JointFilter) -> Rules:
    """Where the documentation is silent the caps above hold, and every step is believed.

    An effort of zero is what exporters write where nobody said.
    """
    velocity = np.maximum(limits.velocity, SLOWEST)
    known_effort = np.where(limits.effort > 0.0, limits.effort, np.nan)
    allowed = [
        np.nan_to_num(limits.lower - settings.q_margin, nan=-Q_CAP),
        np.nan_to_num(limits.upper + settings.q_margin, nan=Q_CAP),
        np.nan_to_num(velocity * settings.range_factor, nan=DQ_CAP),
        np.nan_to_num(known_effort * settings.range_factor, nan=TAU_CAP),
    ]
    period_s, times = joint_filter.settings.period_s, joint_filter.settings.states_per_sample
    speed, torque = DQ_STEP * times * velocity, TAU_STEP * times * known_effort
    floor = np.array([Q_STEP * period_s * velocity, speed, torque])
    floor[np.isnan(floor)] = np.inf
    effort = known_effort * settings.saturation
    gap_ns = round(1e9 * max(settings.max_gap_s, GAP_PERIODS * period_s))
    per = times, joint_filter.settings.samples_per_state
    gains = joint_filter.gains
    return Rules(np.array(allowed), effort, floor, settings.rest_dq, gap_ns, *per, gains)


def packed(rules: Rules) -> tuple[Array, Array]:
    """The rules by joint (8, n) and the others (8,); its inverse is in `unpacked`."""
    numbers = rules.rest_dq, rules.gap_ns, rules.states, rules.samples, *rules.gains
    return np.vstack([rules.range, rules.effort, rules.floor]), np.array(numbers, dtype=np.float64)


def new_memory(n: int, base: int) -> tuple[Array, Array, NDArray[np.int64]]:
    """`Memory` of n joints and so many numbers of a base, of nothing yet, as `unpacked` takes it.

    Rows of n: last, good, doubted, usual (3 each), fastest, then of the bristles place, edge,
    direction (1 each) and held. Four rows of what passes the filter: the joints' 3 n, the base's
    motion, and the bristles', K n. Whole numbers.
    """
    ways = len(WAYS_RAD)
    whole = np.zeros(n + MARKS + 2, dtype=np.int64)
    return np.zeros((16 + ways, n)), np.zeros((4, 3 * n + base + ways * n)), whole


@jit
def unpacked(rules, memory):
    """`Rules` and `Memory` as views of what `packed` and `new_memory` gave."""
    (table, numbers), (rows, wide, whole) = rules, memory
    n = table.shape[1]
    gains = Gains(numbers[4], numbers[5], int(numbers[6]), int(numbers[7]))
    per = int(numbers[1]), int(numbers[2]), int(numbers[3])
    own = Rules(table[:4], table[4], table[5:], numbers[0], per[0], per[1], per[2], gains)
    since, marks, times = whole[:n], whole[n : n + MARKS], whole[n + MARKS :]
    state = FilterState(times, wide[1], wide[2], wide[3])
    bristles = Bristles(rows[13], rows[14], rows[15], rows[16:])
    tables = rows[:3], rows[3:6], rows[6:9], rows[9:12]
    return own, Memory(*tables, since, wide[0], marks, state, rows[12], bristles)


@jit
def judge(stamp, q, dq, tau, rules, memory):
    """Verdict on raw readings: GOOD, NON_FINITE, OUT_OF_RANGE or REPEATED, all those of `last`.

    `memory.last` is overwritten with readings whose positions and torques are in range.
    """
    allowed, last, marks = rules.range, memory.last, memory.marks
    lower, upper, dq_max, tau_max = allowed[0], allowed[1], allowed[2], allowed[3]
    dt_ns = stamp - marks[Mark.LAST] if marks[Mark.LAST] != NEVER else 0
    dt_s = 1e-9 * dt_ns if dt_ns <= rules.gap_ns else 0.0
    same, fast = True, False
    for j in range(q.shape[0]):
        if not (np.isfinite(q[j]) and np.isfinite(dq[j]) and np.isfinite(tau[j])):
            return Verdict.NON_FINITE
    for j in range(q.shape[0]):
        if q[j] < lower[j] or q[j] > upper[j] or abs(tau[j]) > tau_max[j]:
            return Verdict.OUT_OF_RANGE
        moved_so = abs(q[j] - last[0, j] - dq[j] * dt_s) < SO_ALIKE * abs(dq[j]) * dt_s
        so = dt_s > 0.0 and abs(dq[j]) < FASTEST and moved_so
        fast = fast or (abs(dq[j]) > dq_max[j] and not so)
        same = same and q[j] == last[0, j] and dq[j] == last[1, j] and tau[j] == last[2, j]
    if same and not fast:
        return Verdict.REPEATED
    last[0], last[1], last[2] = q, dq, tau
    marks[Mark.LAST] = stamp
    return Verdict.OUT_OF_RANGE if fast else Verdict.GOOD


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
def get_used(x, reference, dt_ns, usual, floor, over):
    """Let the usual changes over so many samples follow; what is out of them counts as just not."""
    for s in range(3):
        for j in range(x.shape[1]):
            most = USUAL_STEPS * math.sqrt(usual[s, j]) + floor[s, j]
            e = min(off(s, j, x, reference, dt_ns), most)
            usual[s, j] += (e * e - usual[s, j]) / over


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
    marks[Mark.COMPARED] = min(marks[Mark.COMPARED] + 1, USUAL_OVER)
    get_used(x, good, dt_ns, usual, rules.floor, marks[Mark.COMPARED])
    if found == 0 or (found == 1 and marks[Mark.COMPARED] <= UNKNOWN):
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
