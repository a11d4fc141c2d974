"""From a driver's sample to a filtered state: checks, filter, twist synthesis. Pure, no clock."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapter.errors import SettingsError
from adapter.fast import jit
from adapter.filters import NEVER, SETTLING_DELAYS, FilterSettings, JointFilter, filter_step
from adapter.model import SelfModel
from adapter.plausibility import (
    AHEAD,
    DOUBTED,
    DQ_STEP,
    JUMPED,
    OLD_STAMPS,
    Q_STEP,
    SEEN,
    STREAK,
    TAU_STEP,
    in_order,
    new_marks,
    plausible,
)
from adapter.records import Array, StateLayout
from adapter.twist import TwistSynthesis
from drivers.interface import JointSample

# Why a sample is not learned from; `refused` counts them by these names.
NON_FINITE, OUT_OF_RANGE, REPEATED = "non_finite", "out_of_range", "repeated"
TIME_BACKWARDS, SETTLING = "time_backwards", "filter_settling"
AT_REST, SATURATED = "at_rest", "torque_saturated"
IMPLAUSIBLE, STUCK = "implausible_step", "stuck_joint"
ENCODER_JUMP, TIME_AHEAD = "encoder_jump", "time_ahead"
# What no joint of an arm does, where its documentation is silent: rad, rad/s, N m.
Q_CAP, DQ_CAP, TAU_CAP = 1e4, 1e3, 1e5
NOTEWORTHY = (
    NON_FINITE,
    OUT_OF_RANGE,
    TIME_BACKWARDS,
    SATURATED,
    IMPLAUSIBLE,
    STUCK,
    ENCODER_JUMP,
)
VERDICTS = (
    "",
    NON_FINITE,
    OUT_OF_RANGE,
    REPEATED,
    TIME_BACKWARDS,
    SETTLING,
    AT_REST,
    SATURATED,
    IMPLAUSIBLE,
    STUCK,
    ENCODER_JUMP,
    TIME_AHEAD,
)


@dataclass(frozen=True)
class FrontEndSettings:
    """What counts as a usable sample.

    Attributes:
        rest_dq: below this on every joint (filtered, rad/s) the arm rests and teaches nothing.
        max_gap_s: a longer hole in the stamps restarts the filter.
        q_margin: how far beyond a documented position limit a reading may lie, rad.
        range_factor: how far beyond documented speed and effort, as a factor.
        saturation: share of the effort limit from which a torque counts as saturated.
    """

    rest_dq: float = 0.02
    max_gap_s: float = 0.02
    q_margin: float = 0.3
    range_factor: float = 3.0
    saturation: float = 0.98

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"front_end.{name} must be above zero")


@jit
def judge(q, dq, tau, last, lower, upper, dq_max, tau_max):
    """Verdict on raw readings: 0 good, 1 non-finite, 2 out of range, 3 all the same as `last`.

    `last` (3, n) is overwritten with good readings.
    """
    same = True
    for j in range(q.shape[0]):
        if not (np.isfinite(q[j]) and np.isfinite(dq[j]) and np.isfinite(tau[j])):
            return 1
    for j in range(q.shape[0]):
        if q[j] < lower[j] or q[j] > upper[j] or abs(dq[j]) > dq_max[j] or abs(tau[j]) > tau_max[j]:
            return 2
        same = same and q[j] == last[0, j] and dq[j] == last[1, j] and tau[j] == last[2, j]
    if same:
        return 3
    last[0], last[1], last[2] = q, dq, tau
    return 0


@jit
def process(
    stamps,
    q,
    dq,
    tau,
    limits,
    effort,
    rest_dq,
    gap_ns,
    k1,
    k2,
    delay_ns,
    last,
    floor,
    trail,
    since,
    ahead,
    marks,
    times,
    old,
    y,
    dy,
    out,
    verdicts,
    before,
):
    """Check and filter samples in order; one call serves one sample or a whole recording.

    Args:
        stamps: (m,) int64 ns; q, dq, tau: (m, n).
        limits: (4, n) lowest and highest q, highest |dq| and |tau|; effort: (n,) saturation.
        floor: (3, n) change of q, dq, tau from sample to sample that is always believed.
        trail: (3, 3, n) last good and last doubted readings, squares of their usual changes.
        since: (n,) int64 stamps at which the joints' readings last changed.
        ahead: (3 n,) the reading whose stamp lay far ahead.
        marks: (9,) int64: stamps saturated until, of the first moving sample; how many
            samples in a row came with a stamp before the newest; newest stamp in order; stamps
            not confirmed yet (far ahead, a step); joint whose encoder jumped; usual dt, ns.
        last, times, old, y, dy: state, see `judge` and `filter_step`.
        out: (m, size) records, stamp and filtered signals filled where the verdict is 0.
        verdicts: (m,) index into `VERDICTS`; negative where a gap restarted the filter.
        before: (m, 2) int64 the stamps before and behind that gap.
    """
    n = q.shape[1]
    u, x = np.empty(3 * n), np.empty((3, n))
    for i in range(stamps.shape[0]):
        stamp = stamps[i]
        verdict = judge(q[i], dq[i], tau[i], last, limits[0], limits[1], limits[2], limits[3])
        seen, ahead_ns = marks[SEEN], marks[AHEAD]
        if verdict == 0:
            verdict = in_order(stamp, gap_ns, times, marks)
        if verdict == 11:
            ahead[:n], ahead[n : 2 * n], ahead[2 * n :] = q[i], dq[i], tau[i]
        if verdict:
            verdicts[i] = verdict
            continue
        gap = times[0] != NEVER and (
            stamp <= times[0] or stamp - seen > gap_ns or marks[OLD_STAMPS] >= STREAK
        )
        marks[OLD_STAMPS] = 0
        x[0], x[1], x[2] = q[i], dq[i], tau[i]
        if times[0] == NEVER or gap:
            since[:] = stamp
            marks[JUMPED] = 0
        elif marks[JUMPED]:
            verdict = 10
        else:
            verdict = plausible(
                stamp, x, times[0], gap_ns, floor, trail[0], trail[1], trail[2], since, marks
            )
            gap = stamp - times[0] > gap_ns
            if verdict == 10 and stamp - times[1] < SETTLING_DELAYS * delay_ns:
                verdict, marks[JUMPED], times[0] = 0, 0, NEVER  # it was the first that was wrong
        verdicts[i] = verdict
        if verdict:
            continue
        trail[0] = x
        marks[DOUBTED] = NEVER
        marks[AHEAD] = NEVER
        if gap:
            before[i, 0], before[i, 1] = times[0], stamp
            times[0] = NEVER
            if ahead_ns != NEVER and 0 < stamp - ahead_ns <= gap_ns:  # it began there
                before[i, 1] = ahead_ns
                filter_step(ahead_ns, ahead, k1, k2, SETTLING_DELAYS * delay_ns, times, old, y, dy)
        u[:n], u[n : 2 * n], u[2 * n :] = q[i], dq[i], tau[i]
        settled = filter_step(stamp, u, k1, k2, SETTLING_DELAYS * delay_ns, times, old, y, dy)
        moving, fast = False, False
        for j in range(n):
            fast = fast or abs(dq[i, j]) > rest_dq
            moving = moving or abs(y[n + j]) >= rest_dq
            if abs(tau[i, j]) >= effort[j]:
                marks[0] = stamp + SETTLING_DELAYS * delay_ns
        if fast and marks[1] == NEVER:
            marks[1] = stamp
        if not settled:
            verdicts[i] = -5 if gap else 5
        elif not moving:
            verdicts[i] = 6
        elif stamp <= marks[0]:
            verdicts[i] = 7
        else:
            row = out[i]
            row[:1].view(np.int64)[0] = stamp - delay_ns
            row[2 : 2 + 2 * n] = y[: 2 * n]
            row[2 + 2 * n : 2 + 3 * n] = dy[n : 2 * n]
            row[2 + 3 * n : 2 + 4 * n] = y[2 * n :]


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
        limits, s = documented.limits, self.settings
        self._effort = limits.effort * s.saturation
        self._limits = np.array(
            [
                np.nan_to_num(limits.lower - s.q_margin, nan=-Q_CAP),
                np.nan_to_num(limits.upper + s.q_margin, nan=Q_CAP),
                np.nan_to_num(limits.velocity * s.range_factor, nan=DQ_CAP),
                np.nan_to_num(limits.effort * s.range_factor, nan=TAU_CAP),
            ]
        )
        self._last = np.full((3, n), np.nan)
        self._marks = new_marks()
        self._floor = np.array(
            [
                Q_STEP * self.filter.settings.period_s * limits.velocity,
                DQ_STEP * limits.velocity,
                TAU_STEP * limits.effort,
            ]
        )
        self._floor[np.isnan(self._floor)] = np.inf  # where nothing is documented
        self._trail = np.zeros((3, 3, n))
        self._since = np.zeros(n, dtype=np.int64)
        self._ahead = np.zeros(3 * n)
        self._before = np.zeros((1, 2), dtype=np.int64)
        self._record = self.layout.new(1)
        self._verdict = np.zeros(1, dtype=np.int64)
        self.refused: Counter[str] = Counter()
        self.gaps: list[tuple[int, float]] = []
        self.messages: list[str] = []

    @property
    def delay_s(self) -> float:
        """Age of a filtered state against its sample, s."""
        return self.filter.delay_s

    @property
    def first_moving_ns(self) -> int | None:
        """Stamp of the first sample with any measured |dq| above `rest_dq`."""
        return None if self._marks[1] == NEVER else int(self._marks[1])

    @property
    def fault(self) -> str | None:
        """What makes all further samples useless, or None: an encoder that jumped."""
        joint = int(self._marks[JUMPED])
        if not joint:
            return None
        step = self._trail[1, 0, joint - 1] - self._trail[0, 0, joint - 1]
        name = self.names[joint - 1]
        return f"the encoder of {name} jumped by {step:.3g} rad; reference the arm, then run again"

    def step(self, sample: JointSample) -> Array | None:
        """The filtered state that this sample completes, or None where it teaches nothing.

        The record is reused by the next call. Reasons are counted in `refused`.
        """
        self._process(
            np.array([sample.stamp_ns]),
            sample.q[None],
            sample.dq[None],
            sample.tau[None],
            self._record,
            self._verdict,
            self._before,
        )
        verdict = self._verdict[0]
        if verdict:
            self._refuse(verdict, sample, self._before[0])
            return None
        record = self._record[0]
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
        records = self.layout.new(len(q))
        verdicts = np.zeros(len(q), dtype=np.int64)
        before = np.zeros((len(q), 2), dtype=np.int64)
        self._process(stamp_ns, q, dq, tau, records, verdicts, before)
        for i in np.flatnonzero(verdicts):
            sample = JointSample(int(stamp_ns[i]), q[i], dq[i], tau[i])
            self._refuse(verdicts[i], sample, before[i])
        good = verdicts == 0
        records = records[good]
        self.twist.fill_table(
            records,
            q[good],
            dq[good],
            None if twists is None else twists[good],
            None if accels is None else accels[good],
        )
        return records

    def _process(
        self,
        stamps: NDArray[np.int64],
        q: Array,
        dq: Array,
        tau: Array,
        records: Array,
        verdicts: NDArray[np.int64],
        before: NDArray[np.int64],
    ) -> None:
        f, s = self.filter, self.settings
        process(
            stamps,
            q,
            dq,
            tau,
            self._limits,
            self._effort,
            s.rest_dq,
            round(1e9 * s.max_gap_s),
            f.k1,
            f.k2,
            f.delay_ns,
            self._last,
            self._floor,
            self._trail,
            self._since,
            self._ahead,
            self._marks,
            f.times,
            f.old,
            f.y,
            f.dy,
            records,
            verdicts,
            before,
        )

    def _refuse(self, verdict: int, sample: JointSample, hole: NDArray[np.int64]) -> None:
        if verdict < 0:
            before_ns, behind_ns = int(hole[0]), int(hole[1])
            gap_s = 1e-9 * (behind_ns - before_ns)
            if not self.gaps:
                self.messages.append(
                    f"at {1e-9 * before_ns:.3f} s: {gap_s:.3f} s without a sample; the filter "
                    "starts anew"
                )
            self.gaps.append((before_ns, gap_s))
        reason = VERDICTS[abs(verdict)]
        if reason in NOTEWORTHY and not self.refused[reason]:
            self.messages.append(self._sentence(reason, sample))
        self.refused[reason] += 1

    def _sentence(self, reason: str, sample: JointSample) -> str:
        at = f"at {1e-9 * sample.stamp_ns:.3f} s"
        if reason == OUT_OF_RANGE:
            lower, upper, dq_max, tau_max = self._limits
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
        if reason == NON_FINITE:
            return f"{at}: a reading is not a finite number; the sample was refused"
        if reason == SATURATED:
            return f"{at}: a torque is at its limit; nothing is learned around it"
        if reason == IMPLAUSIBLE:
            return f"{at}: a reading steps further than the arm moves; the sample was refused"
        if reason == STUCK:
            return f"{at}: a joint moves, its readings stand still; refused until they move"
        if reason == ENCODER_JUMP:
            return f"{at}: {self.fault}"
        return f"{at}: time does not increase; the sample was refused"
