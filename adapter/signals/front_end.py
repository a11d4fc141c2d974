"""From a driver's sample to a filtered state: checks, filter, twist synthesis. Pure, no clock.

The links' motion is synthesized from the documented kinematics, or as it was measured. The paper's
Panda has no sensors on its links; it computes their motion from the joint signals and the
documented λ. What is learned from that can only reproduce the documentation, and is labelled so.
Synthesized motion uses the same q and dq that the learner sees, so their noise cancels. So does
that of a floating base, whose links' motion is always synthesized: the base's has passed the
filter, and theirs would be of another instant. Measured motion is handed on unfiltered beside the
q and dq of its own stamp: the body-schema moments average its noise, and a low-pass would shift
products of fast signals.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import (
    Frames,
    JointMotion,
    base_at_rest,
    borrowed,
    frames_of,
    jit,
    link_motion,
)
from adapter.signals.bristles import wind
from adapter.signals.checks import (
    STREAK,
    Mark,
    Verdict,
    believed,
    in_order,
    judge,
    new_memory,
    packed,
    rules_of,
    unpacked,
)
from adapter.signals.filters import NEVER, JointFilter, filter_step
from adapter.signals.records import KIND, LinkMotionKind, StateLayout, columns
from adapter.signals.settings import FilterSettings, FrontEndSettings
from drivers.interface import DriverError, JointSample

SAID = {  # of the first sample of each kind; all others are counted
    Verdict.NON_FINITE: "a reading is not a finite number; the sample was refused",
    Verdict.OUT_OF_RANGE: "a reading is out of range",
    Verdict.TIME_BACKWARDS: "time does not increase; the sample was refused",
    Verdict.TORQUE_SATURATED: "a torque is at its limit; nothing is learned around it",
    Verdict.IMPLAUSIBLE_STEP: "a reading steps further than the arm moves; the sample was refused",
    Verdict.STUCK_JOINT: "a joint moves, its readings stand still; refused until they move",
    Verdict.ENCODER_JUMP: "an encoder jumped",
    Verdict.BASE_UNHEARD: "nothing is known of the base's motion; the sample was refused",
}
BASE = 9  # numbers of a floating base's motion in a sample, [v, w, a]
FASTER = 1.1  # of the documented speed, which is then not the arm's: said, not refused


@jit
def taken(signals, answer, rules, memory, records):
    """Verdict on a sample; the states since the one before are filtered into its records."""
    stamp, hole, marks = answer[0], answer[2:], memory.marks
    times, gains, n = memory.filter.times, rules.gains, rules.effort.shape[0]
    x = signals[: 3 * n].reshape(3, n)
    verdict = judge(stamp, x[0], x[1], x[2], rules, memory)
    if not np.isfinite(signals[3 * n :]).all():
        verdict = Verdict.BASE_UNHEARD
    seen, ahead_ns = marks[Mark.SEEN], marks[Mark.AHEAD]
    if verdict == Verdict.GOOD:
        verdict = in_order(stamp, rules.gap_ns, times, marks)
    if verdict == Verdict.TIME_AHEAD:
        memory.ahead[: signals.shape[0]] = signals
    if verdict != Verdict.GOOD:
        return verdict
    gap = times[0] != NEVER and (
        stamp <= times[0] or stamp - seen > rules.gap_ns or marks[Mark.OLD_STAMPS] >= STREAK
    )
    marks[Mark.OLD_STAMPS] = 0
    if gap:  # nothing can be said of steps
        memory.since[:] = stamp
        marks[Mark.JUMPED] = 0
    else:
        verdict, gap = believed(stamp, x, rules, memory)
        if verdict != Verdict.GOOD:
            return verdict
    memory.good[:] = x
    dt_s = np.inf if gap or times[0] == NEVER else 1e-9 * (stamp - times[0])
    marks[Mark.DOUBTED] = NEVER
    marks[Mark.AHEAD] = NEVER
    if gap:
        hole[0], hole[1] = times[0], stamp
        times[0] = NEVER
        if ahead_ns != NEVER and 0 < stamp - ahead_ns <= rules.gap_ns:  # it began there
            hole[1] = ahead_ns
            filtered(ahead_ns, np.inf, memory.ahead[: signals.shape[0]].copy(), gains, memory)
            dt_s = 1e-9 * (stamp - ahead_ns)
    settled, old, old_stamp = False, memory.filter.old[: signals.shape[0]].copy(), times[0]
    many = rules.states if dt_s < np.inf else 1
    for k in range(rules.states):  # all its records are filled, the first ones twice at a start
        share = min((k + 1) / many, 1.0)
        if k < many:
            at = stamp if share == 1.0 else old_stamp + int(share * (stamp - old_stamp))
            now = signals if share == 1.0 else old + share * (signals - old)
            settled = filtered(at, dt_s / many, now, gains, memory)
        fill(records[k], times[0] - gains.delay_ns, signals.shape[0], memory)
    return worth(stamp, x, settled, rules, memory)


@jit
def fill(row, stamp, known, memory):
    """Let a record say what the filter says; `known` signals are the joints' and the base's."""
    y, dy, n = memory.filter.y, memory.filter.dy, memory.good.shape[1]
    at = columns(n, known > 3 * n)
    row[:1].view(np.int64)[0] = stamp
    row[at.q : at.ddq] = y[: 2 * n]
    row[at.ddq : at.tau] = dy[n : 2 * n]
    row[at.base - n : at.base] = y[2 * n : 3 * n]
    if known > 3 * n:
        row[at.base : at.base + BASE] = y[3 * n : 3 * n + BASE]
        row[at.base + BASE : at.bent] = dy[3 * n + 3 : 3 * n + 6]  # rate of w
    row[at.bent : at.rates] = y[known:]


@jit
def filtered(stamp, dt_s, signals, gains, memory):
    """Take a sample dt_s after the one before, with the bristles; whether the filter has settled.

    What has a memory is made of raw readings and then filtered as they are.
    """
    n, known = memory.good.shape[1], signals.shape[0]
    whole = np.empty(memory.filter.y.shape[0])
    whole[:known] = signals
    wind(dt_s, signals[:n], signals[n : 2 * n], memory.bristles, whole[known:])
    return filter_step(stamp, whole, gains, memory.filter)


@jit
def worth(stamp, x, settled, rules, memory):
    """Verdict on a filtered sample: whether it teaches anything; remembers when it moved."""
    marks, n = memory.marks, x.shape[1]
    moving, fast = False, False
    marks[Mark.WITHOUT] += 1
    for j in range(n):
        fast = fast or abs(x[1, j]) > rules.rest_dq
        moving = moving or abs(memory.filter.y[n + j]) >= rules.rest_dq
        if abs(x[2, j]) >= rules.effort[j]:
            marks[Mark.SATURATED_UNTIL] = stamp + rules.gains.settle_ns
    if fast and marks[Mark.FIRST_MOVING] == NEVER:
        marks[Mark.FIRST_MOVING] = stamp
    if not settled:
        return Verdict.FILTER_SETTLING
    for j in range(n):
        memory.fastest[j] = max(memory.fastest[j], abs(memory.filter.y[n + j]))
    if not moving:
        return Verdict.AT_REST
    if stamp <= marks[Mark.SATURATED_UNTIL]:
        return Verdict.TORQUE_SATURATED
    if marks[Mark.WITHOUT] < rules.samples:
        return Verdict.BETWEEN
    marks[Mark.WITHOUT] = 0
    return Verdict.GOOD


@jit
def process(signals, rules, memory, records, answers):
    """Check and filter samples in order; one call serves one sample or a whole recording.

    Takes few plain arrays, since handing over a record of many takes longer than the work itself.

    Args:
        signals: (m, 3 n + b) q, dq, tau, and the b = 9 numbers of a base that floats.
        rules, memory: see `packed` and `new_memory`.
        records: (m K, size), filled from the first on, K for each sample whose verdict is GOOD.
        answers: (m, 4) int64 [stamp ns, verdict, stamps before and behind a gap]; the first is
            given, the others are filled.
    """
    own, kept = borrowed(unpacked(rules, memory))
    signals, records, answers = borrowed((signals, records, answers))
    end = own.states
    for i in range(signals.shape[0]):
        answers[i, 2:] = 0
        answers[i, 1] = taken(signals[i], answers[i], own, kept, records[end - own.states : end])
        if answers[i, 1] == Verdict.GOOD:
            end += own.states


class FrontEnd:
    """Checks, filters and completes samples, one by one.

    Args:
        documented: the arm's documented kinematics, limits and gravity.
        imus: whether links carry sensors mounted anyhow (see `LinkMotionKind`).

    Attributes:
        refused: how many samples were not passed on, by reason.
        gaps: (stamp_ns, seconds) of each hole that restarted the filter.
        start_ns: stamp of the first sample, which sentences count from; None before it.
    """

    def __init__(
        self,
        documented: SelfModel,
        filter_settings: FilterSettings | None = None,
        settings: FrontEndSettings | None = None,
        imus: bool = False,
    ) -> None:
        n = documented.tree.n
        self.settings = settings or FrontEndSettings()
        self.names = documented.tree.joint_names
        self.layout = StateLayout(n, documented.tree.floating)
        self.filter = JointFilter(filter_settings)
        self.twist = TwistSynthesis(documented, imus)
        self._rules = rules_of(documented.limits, self.settings, self.filter)
        self._packed = packed(self._rules)
        base = BASE if documented.tree.floating else 0
        self._kept = new_memory(n, base)
        self._memory = unpacked(self._packed, self._kept)[1]
        self._memory.last[:] = np.nan
        self._memory.bristles.place[:] = np.nan
        self._memory.filter.times[:] = NEVER
        unseen = Mark.SATURATED_UNTIL, Mark.FIRST_MOVING, Mark.SEEN, Mark.AHEAD, Mark.DOUBTED
        self._memory.marks[[*unseen, Mark.LAST]] = NEVER
        self._signals, self._answers = np.empty((1, 3 * n + base)), np.zeros((1, 4), np.int64)
        self._records = self.layout.new(self._rules.states)
        self.refused: Counter[str] = Counter()
        self.gaps: list[tuple[int, float]] = []
        self.start_ns: int | None = None
        self._told: list[str] = []
        self._velocity = documented.limits.velocity

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
    def messages(self) -> list[str]:
        """One sentence for each kind of trouble, in the order of first occurrence."""
        fastest, known = self._memory.fastest, self._velocity
        fast = [j for j, v in enumerate(known) if v > 0.0 and fastest[j] > FASTER * v]
        if not fast:
            return list(self._told)
        told = ", ".join(f"{self.names[j]} {fastest[j]:.3g} ({known[j]:.3g})" for j in fast)
        said = f"faster than documented, and learned from: {told} rad/s; the limits of another arm?"
        return [*self._told, said]

    @property
    def fault(self) -> str | None:
        """What makes all further samples useless, or None: an encoder that jumped."""
        joint = int(self._memory.marks[Mark.JUMPED])
        if not joint:
            return None
        step = self._memory.doubted[0, joint - 1] - self._memory.good[0, joint - 1]
        name = self.names[joint - 1]
        return f"the encoder of {name} jumped by {step:.3g} rad; reference the arm, then run again"

    def step(self, sample: JointSample) -> Array:
        """The filtered states (k, size) that this sample completes; none where it teaches nothing.

        At 1 kHz it is one at most, at lower rates as many as milliseconds have gone by. The records
        are reused by the next call. Reasons are counted in `refused`.

        Raises:
            DriverError: a sample of another number of joints, or a stamp that is no whole number.
        """
        signals, answers, n = self._signals, self._answers, self.layout.n
        row = signals[0]
        try:
            row[:n], row[n : 2 * n], row[2 * n : 3 * n] = sample.q, sample.dq, sample.tau
        except ValueError:
            sizes = [np.size(x) for x in (sample.q, sample.dq, sample.tau)]
            raise DriverError(
                f"a sample of the driver has {sizes[0]} positions, {sizes[1]} velocities and "
                f"{sizes[2]} torques, the robot {n} joints ({', '.join(self.names)})"
            ) from None
        if self.layout.floating:
            row[3 * n :] = np.nan if sample.base is None else sample.base
        if not isinstance(sample.stamp_ns, (int, np.integer)):
            said = "it counts whole nanoseconds (time.monotonic_ns())"
            raise DriverError(f"stamp_ns of a sample of the driver is {sample.stamp_ns!r}; {said}")
        answers[0, 0] = sample.stamp_ns
        process(signals, self._packed, self._kept, self._records, answers)
        if answers[0, 1]:
            self._refuse(answers[0, 1], sample, answers[0, 2:])
            return self._records[:0]
        said, last = sample.links, np.array([len(self._records) - 1])
        links = None if said is None else (said.twist[None], said.accel[None])
        self.twist.fill(self._records, Raw(last, sample.q[None], sample.dq[None], links))
        return self._records

    def step_table(
        self,
        stamp_ns: NDArray[np.int64],
        q: Array,
        dq: Array,
        tau: Array,
        links: tuple[Array, Array] | None = None,
        base: Array | None = None,
    ) -> Array:
        """The filtered states (k, size) of a whole recording, as `step` makes them one by one.

        Args:
            stamp_ns: (m,); q, dq, tau: (m, n); links: twists and accels (m, n, 6), NaN where not
                measured; base: (m, 9) of a base that floats, see `JointSample`.
        """
        parts = [q, dq, tau]
        if self.layout.floating:
            parts.append(np.full((len(q), BASE), np.nan) if base is None else base)
        signals, states = np.concatenate(parts, axis=1), self._rules.states
        records = self.layout.new(states * len(q))
        answers = np.zeros((len(q), 4), dtype=np.int64)
        answers[:, 0] = stamp_ns
        process(signals, self._packed, self._kept, records, answers)
        for i in np.flatnonzero(answers[:, 1]):
            sample = JointSample(int(stamp_ns[i]), q[i], dq[i], tau[i])
            self._refuse(answers[i, 1], sample, answers[i, 2:])
        good = np.flatnonzero(answers[:, 1] == Verdict.GOOD)
        records = records[: states * len(good)]
        last = states - 1 + states * np.arange(len(good))  # the others are of instants in between
        own = None if links is None else (links[0][good], links[1][good])
        self.twist.fill(records, Raw(last, q[good], dq[good], own))
        return records

    @property
    def start_s(self) -> float:
        """Stamp of the first sample, s; 0 before it."""
        return 1e-9 * (self.start_ns or 0)

    def _refuse(self, verdict: int, sample: JointSample, hole: NDArray[np.int64]) -> None:
        if self.start_ns is None:  # nothing is learned of a first sample, so it comes here
            self.start_ns = sample.stamp_ns
        if hole.any():
            before_ns, behind_ns = int(hole[0]), int(hole[1])
            gap_s = 1e-9 * (behind_ns - before_ns)
            if not self.gaps:
                at = f"at {1e-9 * (before_ns - self.start_ns):.3f} s"
                said = f"{gap_s:.3f} s without a sample; the filter starts anew"
                self._told.append(f"{at}: {said}")
            self.gaps.append((before_ns, gap_s))
        reason = Verdict(verdict)
        name = reason.name.lower()
        if reason in SAID and not self.refused[name]:
            self._told.append(self._sentence(reason, sample))
        self.refused[name] += 1

    def _sentence(self, reason: Verdict, sample: JointSample) -> str:
        at = f"at {1e-9 * (sample.stamp_ns - (self.start_ns or 0)):.3f} s"
        if reason == Verdict.OUT_OF_RANGE:
            lower, upper, dq_max, tau_max = self._rules.range
            for signal, value, low, high in (
                ("q", sample.q, lower, upper),
                ("dq", sample.dq, -dq_max, dq_max),
                ("tau", sample.tau, -tau_max, tau_max),
            ):
                for j in np.flatnonzero((value < low) | (value > high))[:1]:
                    hint = "; degrees instead of radians?" if signal != "tau" else "; N m?"
                    outside = f"{value[j]:.4g}, outside [{low[j]:.4g}, {high[j]:.4g}]"
                    return f"{at}: {signal} of {self.names[j]} is {outside}{hint}"
        return f"{at}: {self.fault if reason == Verdict.ENCODER_JUMP else SAID[reason]}"


# No link of an arm moves faster: m/s, rad/s, m/s², rad/s².
MOTION_CAP = np.repeat([30.0, 60.0, 2e3, 2e4], 3)


class Raw(NamedTuple):
    """Samples as they came, behind a filter that makes several states of each.

    Attributes:
        rows: (m,) the state that is of the sample's own instant; states between it and that of
            the sample before are of instants at which no link was heard.
        q, dq: (m, n).
        links: twists and accels (m, n, 6), NaN where nothing was heard; None: of no link.
    """

    rows: NDArray[np.intp]
    q: Array
    dq: Array
    links: tuple[Array, Array] | None


class TwistSynthesis:
    """Fills the link-motion part of a filtered state.

    Args:
        documented: whose λ and gravity the synthesized motion follows.
        imus: links carry sensors mounted anyhow, and what they read is handed on.
    """

    def __init__(self, documented: SelfModel, imus: bool = False) -> None:
        self._imus = imus
        self.layout = StateLayout(documented.tree.n, documented.tree.floating)
        # a plain tuple: numba takes 3 µs longer for a named one
        self._frames = tuple(frames_of(documented.tree, documented.lam))
        self._base = np.empty(0) if self.layout.floating else base_at_rest(documented.gravity)

    def fill(self, records: Array, raw: Raw) -> None:
        """Complete records (m, size) of these samples, whose q, dq, ddq are filled."""
        if self._imus:
            self._of_imus(records, raw)
            return
        if raw.links is None or self.layout.floating:
            synthesize(self._frames, self._base, records)
            return
        motion = np.concatenate(raw.links, axis=2)
        said = np.asarray(~np.isnan(motion).all(axis=(1, 2)))
        records[:, KIND] = LinkMotionKind.NONE
        at, rows, motion = self.layout, raw.rows[said], motion[said]
        records[rows, at.motion_q], records[rows, at.motion_dq] = raw.q[said], raw.dq[said]
        records[rows, at.motion] = motion.reshape(len(rows), 12 * at.n)
        # a link that was not heard of at this stamp, or whose sensor is mad, leaves the body
        # schema a sample short
        usable = (np.abs(motion) < MOTION_CAP).all(axis=(1, 2))  # false for NaN
        records[rows, KIND] = np.where(usable, LinkMotionKind.MEASURED, LinkMotionKind.NONE)
        silent = ~said[np.searchsorted(raw.rows, np.arange(len(records)))]
        part = records[silent]
        synthesize(self._frames, self._base, part)
        records[silent] = part

    def _of_imus(self, records: Array, raw: Raw) -> None:
        at, rows = self.layout, raw.rows
        records[:, at.motion], records[:, KIND] = 0.0, LinkMotionKind.NONE
        records[rows, at.motion_q], records[rows, at.motion_dq] = raw.q, raw.dq
        records[rows, KIND] = LinkMotionKind.IMU
        if raw.links is None:
            return
        twists, accels = raw.links
        told = np.concatenate([twists[..., 3:], accels[..., :3]], axis=2)  # w and a
        heard = (np.abs(told) < MOTION_CAP[3:9]).all(axis=2)  # false for NaN
        motion = np.zeros((len(rows), at.n, 12))
        motion[..., 0], motion[..., 3:9] = heard, np.where(heard[..., None], told, 0.0)
        records[rows, at.motion] = motion.reshape(len(rows), 12 * at.n)


@jit
def synthesize(frames, base, records):
    """Fill the link motion of records (m, size) from their filtered q, dq, ddq.

    `base` is the motion (12,) of a base at rest; empty where the records hold the base's.
    """
    frames, base, records = borrowed((frames, base, records))
    arm = Frames(*frames)
    n = arm.parent.shape[0]
    at = columns(n, base.shape[0] == 0)
    for i in range(records.shape[0]):
        row = records[i]
        row[KIND] = LinkMotionKind.DOCUMENTED.value
        row[at.motion_q : at.motion] = row[at.q : at.ddq]
        joints = JointMotion(row[at.q : at.dq], row[at.dq : at.ddq], row[at.ddq : at.tau])
        moves = row[at.base : at.bent] if base.shape[0] == 0 else base
        link_motion(arm, joints, moves, row[at.motion :].reshape((n, 12)))
