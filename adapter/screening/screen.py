"""Whether a recording is one that an arm can be learned from: what is refused, and what is told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial

import numpy as np
from numpy.typing import NDArray

from adapter.model.robot_file import in_grams
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.screening.likelihood import EVIDENCE, ROWS, Rows, Telling, explains_nothing, lateness_s
from adapter.screening.readings import angle, other_hand, otherwise_told
from adapter.screening.timing import (
    RecordingClock,
    check_timing,
    put_forward,
    source_stamps,
    uniform,
    unsaid,
    unwrapped,
)
from adapter.signals.matching import matching, most_moved, several
from adapter.signals.told import told_of
from adapter.signals.validation import GRID_S, smooth
from drivers.files.mcap import Log
from drivers.interface import DriverError

MOVES_RAD, MOVES_DQ = 0.1, 0.1  # range and 95th percentile of speed below which a joint stands
SHORTEST_S, FEWEST = 1.5, 100  # seconds and samples of a recording
WANTED_RAD, WANTED_DQ = 0.3, 0.3  # what to ask for
DEGREES = 180.0 / np.pi
TURNS_RAD = 4.0 * np.pi  # no arm joint turns further than two turns either way
BEYOND_RAD, BEYOND_SHARE = 0.2, 0.05  # over the limit, and in which share of the samples
EVERY = 40  # ms at least between the rows that are judged
EDGE = 300  # ms at either end, where the filter has no neighbours


class RecordingFault(StrEnum):
    """What is wrong with a recording, as in the JSON file."""

    ROBOT = "robot"
    DATA = "data"
    VELOCITY = "velocity"
    DEGREES = "degrees"
    MOTION = "motion"
    TORQUE = "torque"
    SIGN = "sign"
    SCALE = "scale"
    GRAVITY = "gravity"
    MOUNTING = "mounting"
    ORDER = "order"
    JOINT = "joint"

    @property
    def is_an_answer(self) -> bool:
        """Whether nothing is wrong with the recording, it only holds too little."""
        return self is RecordingFault.MOTION


class RecordingRefused(ValueError):
    """A recording that the search for the gap must not use; one sentence says why.

    Attributes:
        kind: of what is wrong.
    """

    def __init__(self, kind: RecordingFault, sentence: str) -> None:
        super().__init__(sentence)
        self.kind = kind


def _unmeasured(log: Log) -> NDArray[np.bool_]:
    """(m, n) where a torque is not measured."""
    t = 1e-9 * (log.stamp_ns - log.stamp_ns[0])
    return stuck(t, log.dq, log.tau) | unsaid(log.tau)[:, None]


@dataclass(frozen=True)
class Judged:
    """The torques of a recording that passes.

    Attributes:
        late_s: how much later than the motion they come.
        model: of them, after corrections of a plausible size, by instants; None where unknown.
        doubts: what speaks against a recording that is trusted.
        gravity: (3,) m/s² in the base's axes, where it stands askew; else None.
    """

    late_s: float = 0.0
    model: Callable[[Rows], Array] | None = None
    doubts: tuple[str, ...] = ()
    gravity: Array | None = None

    @property
    def notes(self) -> list[str]:
        """What to know of them, a sentence each."""
        side = "after" if self.late_s > 0.0 else "before"
        late = f"The torques come {1e3 * abs(self.late_s):.0f} ms {side} the motion."
        said = [*self.doubts, *([late] if self.late_s else [])]
        if self.gravity is not None:
            along = " ".join(f"{x:.4g}" for x in self.gravity)
            said.append(f"The base stands askew, by its torques: --gravity {along} says so.")
        return said

    def mounted(self, model: SelfModel) -> SelfModel:
        """The arm as its base stands."""
        return model if self.gravity is None else replace(model, gravity=self.gravity)

    def in_time(self, log: Log) -> Log:
        """A recording with torques at their own instants, without samples that have none then."""
        if not self.late_s:
            return log
        log = log.take(uniform(log.stamp_ns, log.q, log.dq, log.tau))
        t = 1e-9 * (log.stamp_ns - log.stamp_ns[0])
        at = t + self.late_s
        behind = np.searchsorted(t, at)
        kept = (behind > 0) & (behind < len(t)) & ~np.isin(behind - 1, pauses(t))
        tau = np.column_stack([np.interp(at, t, column) for column in log.tau.T])
        return replace(log, tau=tau).take(kept)

    def whole(self, log: Log) -> Log:
        """A recording with the model's torques where none were measured: they teach nothing new."""
        torque_of = self.model
        if torque_of is None:
            return log

        def told(piece: Log) -> Log:
            missing = _unmeasured(piece)
            if not missing.any():
                return piece
            t = 1e-9 * (piece.stamp_ns - piece.stamp_ns[0])
            around = max(round(0.02 / max(float(np.median(np.diff(t))), 1e-9)), 1)  # s either side
            back, ahead = (np.clip(np.arange(len(t)) + k, 0, len(t) - 1) for k in (-around, around))
            span = np.maximum(t[ahead] - t[back], GRID_S)[:, None]
            ddq = (piece.dq[ahead] - piece.dq[back]) / span
            model = torque_of(Rows(piece.q, piece.dq, ddq, piece.tau))
            return replace(piece, tau=np.where(missing, model, piece.tau))

        return log.changed(told) if any(_unmeasured(x).any() for x in log.pieces()) else log


@dataclass(frozen=True)
class Screened:
    """A recording that can be used.

    Attributes:
        log: joints in the model's order; strictly increasing stamps, finite, without repeats.
        timing: of the recording as it was.
        moving: joints (from 0) that move enough to tell anything of them.
        beyond, standing, silent: what to report of joints beyond their limits, of joints that do
            not move and of torques, a sentence each.
        torque: what was found of the torques.
    """

    log: Log
    timing: RecordingClock
    moving: tuple[int, ...]
    beyond: list[str]
    standing: list[str]
    silent: list[str]
    torque: Judged

    @property
    def notes(self) -> list[str]:
        """What to report beside the findings, a sentence each."""
        return [*self.timing.words(), *self.beyond, *self.standing, *self.silent]


def refuse(log: Log, model: SelfModel) -> Screened:
    """Let a recording pass or say in one sentence why not.

    Args:
        log: as read; model: whose joints it should have.

    Raises:
        Refusal: another robot; no second of data; units or sign of velocities or positions;
            too little motion; units, sign, order or meaning of the torques.
    """
    recorded, names = log.joint_names, model.tree.joint_names
    log, timing, outside = cleaned(log, model)
    renamed = not set(names) <= set(recorded)
    q, dq, ddq, tau = smoothed_rows(log)
    moving = moving_joints(q, dq)
    if not moving:
        wide, fast = _extent(q, dq)
        k, in_motion = int(np.argmax(wide)), np.abs(dq).max(axis=1) > 0.5 * MOVES_DQ
        raise RecordingRefused(
            RecordingFault.MOTION,
            f"{log.path}: too little motion to tell anything: {names[k]} moves most, by "
            f"{wide[k]:.2g} rad at {fast[k]:.2g} rad/s, and the arm is in motion for "
            f"{in_motion.sum() * GRID_S:.2g} s; move {', '.join(names)} by at least {WANTED_RAD} "
            f"rad with at least {WANTED_DQ} rad/s, all of them at once, for some 20 s.",
        )
    dead = silent(log, names)
    torque = judged(log, model, (q, dq, ddq, tau), recorded if renamed else ())
    said = standing(names, moving, q, dq)
    late_s = torque.late_s if abs(torque.late_s) >= 0.02 else 0.0  # less is for `gap`
    torque = replace(torque, late_s=late_s, gravity=None)  # `gap` names a tilt, with its doubt
    return Screened(log, timing, moving, outside, said, dead + torque.notes, torque)


def cleaned(log: Log, model: SelfModel) -> tuple[Log, RecordingClock, list[str]]:
    """The usable samples of a recording, whether it moves or rests.

    Args:
        log: as read; model: whose joints it should have.

    Returns:
        The recording with the model's joints, its clock, and notes on joints beyond their limits.

    Raises:
        Refusal: another robot, too few samples, units or sign of velocities or positions.
    """
    recorded = log.joint_names
    log = of_this_robot(log, model)
    stamps, back = put_forward(log.stamp_ns)
    q, turned = unwrapped(log.q, model.limits.lower, model.limits.upper)
    if turned.size:
        names = ", ".join(model.tree.joint_names[j] for j in turned)
        back.append(f"{names} is told within one turn: a step of a whole turn is taken for none.")
    log, signals = replace(log, stamp_ns=stamps, q=q), (q, log.dq, log.tau)
    timing = check_timing(log.stamp_ns, *signals)
    log = log.take(uniform(log.stamp_ns, *signals))
    log, timing, said = at_source(log, timing)
    if timing.span_s < SHORTEST_S or len(log) < FEWEST:
        raise RecordingRefused(
            RecordingFault.DATA,
            f"{log.path}: only {timing.span_s:.2g} s and {len(log)} usable samples of "
            f"{timing.samples}; record at least {SHORTEST_S:g} s, better 20 s, of motion.",
        )
    _check_motion_units(log, model, timing)
    renamed = not set(model.tree.joint_names) <= set(recorded)
    return log, timing, [*back, *said, *_outside_limits(log, model, recorded, renamed)]


def at_source(log: Log, timing: RecordingClock) -> tuple[Log, RecordingClock, list[str]]:
    """Samples of `uniform` at the times of their states, where a publisher showed some twice."""
    stamps = source_stamps(log.stamp_ns, log.q, log.dq)
    moved_s = 1e-9 * float(np.abs(stamps - log.stamp_ns).max(initial=0))
    if not moved_s:
        return log, timing, []
    log = replace(log, stamp_ns=stamps)
    own = check_timing(stamps, log.q, log.dq, log.tau)
    late = {key: getattr(own, key) for key in ("lateness_s", "lateness_std_s", "velocity_gain")}
    said = (
        "The repeats are states shown twice, not lost: after them the arm is where it was a period "
        f"before. The times of the states are taken, up to {1e3 * moved_s:.2g} ms from the stamps."
    )
    return log, replace(timing, **late), [said]


def of_this_robot(log: Log, model: SelfModel) -> Log:
    """A recording with the joints of the model in its order. Raises Refusal: another robot."""
    try:
        return matching(log, model)
    except DriverError:
        if arms := several(model.tree.joint_names, log):
            raise RecordingRefused(RecordingFault.ROBOT, arms) from None
        missing = [name for name in model.tree.joint_names if name not in log.joint_names]
        why = f"it lacks {', '.join(missing)}"
        raise _another_robot(log, model, log.joint_names, why) from None


def _another_robot(
    log: Log, model: SelfModel, recorded: Sequence[str], why: str
) -> RecordingRefused:
    return RecordingRefused(
        RecordingFault.ROBOT,
        f"{log.path} is a recording of another robot than {model.name}: {why}; its "
        f"{len(recorded)} joints are {', '.join(recorded)}, those of the model "
        f"({model.tree.n}) are {', '.join(model.tree.joint_names)}; give the model of the arm "
        "that was recorded.",
    )


def _check_motion_units(log: Log, model: SelfModel, timing: RecordingClock) -> None:
    names = model.tree.joint_names
    gain = timing.velocity_gain
    seen = np.flatnonzero(np.isfinite(gain))
    share = (np.abs(log.q) > TURNS_RAD).mean(axis=0)
    upper = np.nan_to_num(np.fmax(np.abs(model.limits.lower), np.abs(model.limits.upper)))
    beyond = np.flatnonzero((share > BEYOND_SHARE) & (upper < TURNS_RAD) & (upper > 0))
    middle = float(np.median(gain[seen])) if seen.size else 1.0
    if 1 / 1.2 < middle / DEGREES < 1.2:
        raise RecordingRefused(
            RecordingFault.DEGREES,
            f"{log.path}: dq is {middle:.3g} times the rate of q, so dq is in degrees per second "
            "while q is in radians; convert dq to rad/s (`adapter import` does).",
        )
    if beyond.size or 1 / 1.2 < middle * DEGREES < 1.2:
        k = int(np.argmax(np.abs(log.q).max(axis=0)))
        raise RecordingRefused(
            RecordingFault.DEGREES,
            f"{log.path}: {names[k]} reaches {np.abs(log.q[:, k]).max():.3g}, where its limit is "
            f"{upper[k]:.3g} rad, and dq is {middle:.3g} times the rate of q: positions look like "
            "degrees; convert them to radians (`adapter import` does).",
        )
    wrong = [j for j in seen if not 0.5 < gain[j] < 2.0]
    if wrong:
        told = ", ".join(f"{names[j]} {gain[j]:.3g}" for j in wrong)
        raise RecordingRefused(
            RecordingFault.VELOCITY,
            f"{log.path}: dq is not the rate of q, their ratio is {told} instead of 1; check "
            "sign, unit and order of the velocities, or leave them out of the recording.",
        )


def _outside_limits(
    log: Log, model: SelfModel, recorded: Sequence[str], renamed: bool
) -> list[str]:
    """A note on a joint beyond its limits; Refusal where joints were matched by number alone."""
    low, high = model.limits.lower, model.limits.upper
    over = np.maximum(log.q - high, low - log.q) > BEYOND_RAD
    beyond = np.flatnonzero((over.mean(axis=0) > BEYOND_SHARE) & (high > low))
    if not beyond.size:
        return []
    k = int(beyond[0])
    name = recorded[k] if renamed else model.tree.joint_names[k]
    why = (
        f"{name} goes from {log.q[:, k].min():.3g} to {log.q[:, k].max():.3g} rad where the "
        f"model's {model.tree.joint_names[k]} may go from {low[k]:.3g} to {high[k]:.3g}"
    )
    if renamed:
        raise _another_robot(log, model, recorded, why)
    return [f"{why}: is this the arm of the model, with its zero positions?"]


def _extent(q: Array, dq: Array) -> tuple[Array, Array]:
    """Range rad and speed rad/s (n,) of each joint, without the most extreme samples."""
    return np.ptp(np.percentile(q, (1, 99), axis=0), axis=0), np.percentile(np.abs(dq), 95, axis=0)


def moving_joints(q: Array, dq: Array, period_s: float = GRID_S) -> tuple[int, ...]:
    """Joints (from 0) that move enough; q, dq (m, n) rad, rad/s, smoothed, period_s apart."""
    wide, fast = _extent(q, dq)
    long = (np.abs(dq) > 0.5 * MOVES_DQ).sum(axis=0) * period_s
    moves = (wide >= MOVES_RAD) & (fast >= MOVES_DQ) & (long >= 0.2)  # s
    return tuple(np.flatnonzero(moves).tolist())


def standing(names: Sequence[str], moving: Sequence[int], q: Array, dq: Array) -> list[str]:
    """Notes on joints that move too little, or not at all; q, dq (m, n) rad, rad/s, smoothed."""
    still = [name for j, name in enumerate(names) if j not in moving]
    wide, fast = _extent(q, dq)
    little = [names[j] for j in moving if wide[j] < WANTED_RAD or fast[j] < WANTED_DQ]
    unknown = "nothing can be told of their friction, inertia, elasticity or encoders"
    told = [(still, f"stand still: {unknown}")]
    told.append((little, "move little: what is told of them is uncertain"))
    mend = f"move them by at least {WANTED_RAD} rad with at least {WANTED_DQ} rad/s."
    return [f"{', '.join(joints)} {said}; {mend}" for joints, said in told if joints]


def silent(log: Log, names: Sequence[str]) -> list[str]:
    """Notes on joints whose torque does not change. Raises Refusal where no torque ever does."""
    dead = [name for name, span in zip(names, np.ptp(log.tau, axis=0), strict=True) if span == 0]
    if len(dead) == len(names):
        raise RecordingRefused(
            RecordingFault.TORQUE,
            f"{log.path}: the torques never change ({', '.join(f'{x:.3g}' for x in log.tau[0])} "
            "N m throughout) though the arm moves; record measured joint torques.",
        )
    said = [f"The torque of {', '.join(dead)} never changes: is it measured?"] if dead else []
    t = 1e-9 * (log.stamp_ns - log.stamp_ns[0])
    for name, rows in zip(names, stuck(t, log.dq, log.tau).T, strict=True):
        if rows.any() and name not in dead:
            span = f"{np.diff(t)[rows[1:]].sum():.2g} s in motion, from {t[rows][0]:.2f} s on"
            said.append(f"The torque of {name} stays the same for {span}.")
    return said


def judged(
    log: Log,
    model: SelfModel,
    smoothed: tuple[Array, Array, Array, Array],
    renamed: Sequence[str] = (),
) -> Judged:
    """Judge the torques of a recording as it was told; one that is trusted is never refused.

    Args:
        smoothed: q, dq, ddq, tau (m, n) on the grid of `validation.smooth`.
        renamed: joint names of a recording whose joints were matched by number, so that it may be
            one of another arm altogether.

    Raises:
        Refusal: units, sign, order or meaning of the torques; joints told otherwise.
    """
    told = told_of(log)
    try:
        return _judged(log, model, smoothed, renamed, told.unit_known)
    except RecordingRefused as refusal:
        if told.trusted:
            return Judged(doubts=(f"{refusal} It is trusted all the same.",))
        said = f"{refusal} If it is as the model has it, --trust-log takes it so."
        links = zip(model.tree.link_names, model.theta, strict=True)
        if heavy := [f"{name} ({x[0]:.4g} kg)" for name, x in links if in_grams(x)]:
            said = f"{model.name}: no torque fits links denser than any metal: {', '.join(heavy)}"
            said += "; give their masses in kg, not in grams, in the robot's file"
        raise RecordingRefused(refusal.kind, said) from None


def _judged(
    log: Log,
    model: SelfModel,
    smoothed: tuple[Array, Array, Array, Array],
    renamed: Sequence[str],
    unit_known: bool,
) -> Judged:
    rows, telling = judged_rows(log, model, smoothed, unit_known)
    found, now = otherwise_told(rows, telling)
    late_s = lateness_s([x[EDGE:-EDGE] for x in smoothed], telling)
    if late_s:
        behind = round(late_s / GRID_S)
        ends = slice(max(-behind, 0), len(smoothed[0]) - max(behind, 0))
        tau = np.roll(smoothed[3], -behind, axis=0)
        in_time = [x[ends] for x in (*smoothed[:3], tau)]
        rows, telling = judged_rows(log, model, in_time, unit_known)
        found_then, then = otherwise_told(rows, telling)
        late_s = late_s if then.cost < now.cost else 0.0
        if late_s:
            found, now = found_then, then
    moving = [j for j in moving_joints(*smoothed[:2]) if telling.alive[j]]
    share = now.share[moving]
    if explains_nothing(share) and explains_nothing(other_hand(rows, telling).share[moving]):
        if renamed:
            why = "the joints are named otherwise and its torques are not those of such an arm"
            raise _another_robot(log, model, renamed, why)
        raise RecordingRefused(
            RecordingFault.TORQUE,
            f"{log.path}: the torques are not those of this motion of {model.name}: whatever its "
            f"load, friction and inertias, the model explains {100 * np.median(share):.0f} "
            "% of how they change; are they measured, of this arm and of the same instants?",
        )
    if found:
        said = "; ".join(reading.said for reading in found)
        said = f"{log.path}: {said}; the model explains the torques then and not as recorded."
        raise RecordingRefused(RecordingFault(found[0].kind), said)
    passed = Judged(late_s, partial(telling.corrected, now.x))
    if model.gravity.any():
        askew, gravity = telling.askew(rows)
        if askew.cost < now.cost - EVIDENCE and angle(gravity, model.gravity) > np.deg2rad(1.0):
            return replace(passed, gravity=gravity)
    return passed


def judged_rows(
    log: Log, model: SelfModel, smoothed: Sequence[Array], unit_known: bool = False
) -> tuple[Rows, Telling]:
    """The instants of a recording that are judged, and by what; see `judged`."""
    q, dq, ddq, tau = (x[EDGE:-EDGE] for x in smoothed)
    at = slice(None, None, max(EVERY, len(q) // ROWS))
    alive = np.ptp(log.tau, axis=0) > 0.0
    telling = Telling(model, alive, GRID_S * len(q), unit_known)
    return telling.rubbing(Rows(q[at], dq[at], ddq[at], tau[at]), q, at), telling


def smoothed_rows(log: Log) -> tuple[Array, Array, Array, Array]:
    """q, dq, ddq, tau (m, n) of `validation.smooth`, without what its filter makes of a pause.

    Instants at which a torque that is measured else was not are left out too.
    """
    stamps_s = 1e-9 * (log.stamp_ns - log.stamp_ns[0])
    behind = pauses(stamps_s)
    # a second is left of a longer pause: a clock may step on by hours
    stamps_s[1:] -= np.cumsum(np.maximum(np.diff(stamps_s) - 1.0, 0.0))
    signals = smooth(stamps_s, log.q, log.dq, log.tau)
    t, clear = GRID_S * np.arange(len(signals[0])), np.ones(len(signals[0]), dtype=bool)
    for k in behind:
        clear &= (t < stamps_s[k] - GRID_S * EDGE) | (t > stamps_s[k + 1] + GRID_S * EDGE)
    missing = stuck(stamps_s, log.dq, log.tau)
    held = np.flatnonzero(missing[:, ~missing.all(axis=0)].any(axis=1))
    heard = clear & ~np.isin(np.searchsorted(stamps_s, t), held)
    if clear.any() and not heard.any():
        told = f"{log.path}: at no instant is every torque measured: each keeps its value for long"
        raise RecordingRefused(RecordingFault.TORQUE, f"{told} while the arm moves (rounded?).")
    q, dq, ddq, tau = (x[heard] for x in signals)
    return q, dq, ddq, tau


def torque_verdict(log: Log, model: SelfModel) -> tuple[Judged | None, list[str]]:
    """What is found of a recording's torques, and notes; None where too little moves to tell.

    Args:
        log: joints in the model's order; model: of an arm whose base is fixed.

    Raises:
        Refusal: units, sign, order or meaning of the torques.
    """
    part = most_moved(log)
    rows = uniform(part.stamp_ns, part.q, part.dq, part.tau)
    if len(rows) < FEWEST or 1e-9 * np.ptp(part.stamp_ns[rows]) < SHORTEST_S:
        return None, []
    part = part.take(rows)
    smoothed = smoothed_rows(part)
    if len(smoothed[0]) < 1000 or not moving_joints(smoothed[0], smoothed[1]):  # ms
        return None, []
    said = silent(part, model.tree.joint_names)
    torque = judged(part, model, smoothed)
    return torque, [*said, *torque.notes]


def check_torque(log: Log, model: SelfModel) -> tuple[Log, SelfModel, list[str]]:
    """A recording as it is learned from, the arm as it stands, and notes; see `torque_verdict`.

    Torques are in time, and the model's where none were measured. Where too little moves to tell,
    it is as it was.
    """
    torque, said = torque_verdict(log, model)
    if torque is None:
        return log, model, said
    return torque.whole(torque.in_time(log)), torque.mounted(model), said


CUT_S, CUT_PERIODS = 0.15, 6.0  # without samples: what is longer, and of more periods, is a pause
# s, rad/s: a torque that stays so long while its joint moves is none, sooner at the end of its
# range; and longer than so many usual stays
STUCK_S, ENDS_S, STUCK_DQ, STUCK_TIMES = 0.3, 0.05, 0.05, 20.0


def pauses(t: Array) -> NDArray[np.int64]:
    """Rows of t (m,), s, behind which a recording pauses."""
    steps_s = np.diff(t)
    usual_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    return np.flatnonzero(steps_s > max(CUT_S, CUT_PERIODS * usual_s))


def stuck(t: Array, dq: Array, tau: Array) -> NDArray[np.bool_]:
    """(m, n) where a torque is not measured: it never changes, or not for long in a motion.

    A value at the end of its range that it stays at so long is where the sensor ends: no reading
    of that value is a measured one. A reading that is never twice the same elsewhere tells so at
    rest, too.

    Args:
        t: (m,) s; dq, tau: (m, n) rad/s, N m.
    """
    out = np.zeros(tau.shape, dtype=bool)
    if len(t) < 2 or t[-1] - t[0] < STUCK_S or not (np.abs(dq) > STUCK_DQ).any():
        return out
    out[:] = np.ptp(tau, axis=0) == 0.0
    steps_s = np.diff(t)  # nobody knows what a torque was in a pause
    t = np.append(0.0, np.cumsum(np.minimum(steps_s, CUT_PERIODS * np.median(steps_s))))
    for j in np.flatnonzero(~out.all(axis=0)):
        x, edges = tau[:, j], np.flatnonzero(np.diff(tau[:, j])) + 1
        first, last = np.r_[0, edges], np.r_[edges, len(t)] - 1
        stays_s, ends = t[last] - t[first], np.isin(x[first], (x.min(), x.max()))
        long_s = np.where(ends, ENDS_S, STUCK_S)
        noisy = stays_s[~ends].max(initial=0.0) < ENDS_S
        for k in np.flatnonzero(stays_s > np.maximum(long_s, STUCK_TIMES * np.median(stays_s))):
            rows = slice(first[k], last[k] + 1)
            if (ends[k] and noisy) or np.median(np.abs(dq[rows, j])) > STUCK_DQ:
                out[rows, j] = True
                out[:, j] |= ends[k] & (x == x[first[k]])
    return out
