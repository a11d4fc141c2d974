"""Whether a sample can be what the arm did since the last: order of stamps, size of steps."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from adapter.fast import jit
from adapter.filters import NEVER

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
# Places in `marks`, int64.
SATURATED_UNTIL, FIRST_MOVING, OLD_STAMPS = 0, 1, 2
SEEN, AHEAD, DOUBTED, CONFIRMED, JUMPED, USUAL_DT = 3, 4, 5, 6, 7, 8


def new_marks() -> NDArray[np.int64]:
    """The whole numbers that the front end remembers, by the places above."""
    return np.array([NEVER, NEVER, 0, NEVER, NEVER, NEVER, 0, 0, 0])


@jit
def in_order(stamp, gap_ns, times, marks):
    """Verdict on a stamp: 0 good, 4 before the newest, 11 far ahead and nobody confirms it yet."""
    if times[0] == NEVER:
        marks[SEEN] = stamp
        return 0
    if stamp <= times[0]:
        marks[OLD_STAMPS] += 1
        if marks[OLD_STAMPS] < RESYNC_AFTER:
            return 4
    elif stamp - max(times[0], marks[SEEN]) > gap_ns:
        confirmed = marks[AHEAD] != NEVER and 0 < stamp - marks[AHEAD] <= gap_ns
        marks[AHEAD] = stamp
        if not confirmed:
            return 11
    marks[SEEN] = stamp
    return 0


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
def plausible(stamp, x, newest_ns, gap_ns, floor, good, doubted, usual, since, marks):
    """Verdict on readings x (3, n) after the last good ones: 0, 8 step, 9 stuck, 10 encoder jump.

    A step is believed when the next sample confirms it: a spike lasts for one. A step of position
    that the speed does not explain is believed after `JUMP_CONFIRMED`, and to be the encoder's.
    Behind a gap nothing can be said of steps.
    """
    dt_ns = stamp - newest_ns
    if marks[USUAL_DT] == 0:
        marks[USUAL_DT] = dt_ns
    marks[USUAL_DT] += (min(dt_ns, 2 * marks[USUAL_DT]) - marks[USUAL_DT]) // 64
    if stands_still(stamp, x, good, since):
        return 9
    if dt_ns > gap_ns:
        return 0
    usual_dt = marks[USUAL_DT]
    found = steps(x, good, dt_ns, usual, floor, usual_dt)
    get_used(x, good, dt_ns, usual, floor)
    if found == 0:
        return 0
    marks[CONFIRMED] += 1
    if marks[DOUBTED] == NEVER or steps(x, doubted, stamp - marks[DOUBTED], usual, floor, usual_dt):
        marks[CONFIRMED] = 0
    doubted[:] = x
    marks[DOUBTED] = stamp
    if found == 1 and marks[CONFIRMED] > 0:
        return 0
    if found == 2 and marks[CONFIRMED] >= JUMP_CONFIRMED:
        for j in range(x.shape[1]):
            worst = marks[JUMPED] - 1
            if worst < 0 or off(0, j, x, good, dt_ns) > off(0, worst, x, good, dt_ns):
                marks[JUMPED] = j + 1
        return 10
    return 8
