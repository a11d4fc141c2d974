"""What pushes the arm from outside, at once: the momentum observer.

    d/dt p = tau + dT/dq - g - friction + r,   p = M(q) dq + B dq

where r is the torque that the surroundings put on the joints (De Luca, Mattone, "Actuator failure
detection and isolation using generalized momenta", ICRA 2003; Haddadin, De Luca, Albu-Schaeffer,
"Robot collisions", T-RO 2017). No acceleration is needed, so nothing waits for a filter. p and r
follow by two equal poles: with one pole alone r would carry the whole noise of dq, times the mass
and the corner, which is six times as much. Mass, friction and motor inertia are those of a
model: the documented one, or what is learned at the moment.

How far r may be off without a contact: what the model leaves unexplained, what friction may do
around a turn of a joint, and the observer's own noise, which it measures by itself. A contact is
where r leaves that by `SIGMAS` over all joints together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from adapter.control.feedforward import ModelFeedforward, Row, beside, not_learned, wind_table
from adapter.effects.active import with_bodies
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import Frames, axis_line, borrowed, jit, momenta, place_frames
from adapter.signals.bristles import LONGEST_S
from drivers.interface import JointSample

POLE = 2.0 * math.pi * 24.0  # rad/s, of each of the observer's two
# Standard deviations, over all joints together, beyond which it is a contact; s over which the mean
# has to fall below half of that until the contact is over.
SIGMAS, HOLD_S = 8.0, 0.1
SLOW_S, NOISE_S = 0.3, 5.0  # what is slower is no noise; over which noise is measured
WARM_UP_S = 1.0  # of noise before the first contact is believed
CLIP = 3.0  # standard deviations that count at most where noise is measured
TURN_DQ, TURN_SHARE = 0.03, 0.3  # rad/s; share of friction that is unknown at a slower joint
NOT_KNOWN = np.array([100.0, 100.0, 100.0, 30.0, 30.0, 30.0])  # std of a wrench, N, N m
MOST_CONTACTS = 1000
SEEN, SEEN_EVERY = 60, 5  # samples of a contact that are kept to tell what it is


class Of(IntEnum):
    """Rows of the observer's table, (n,) each; the last n are the covariance of its noise."""

    Q = 0  # rad, and the next two: the reading
    DQ = 1  # rad/s
    TAU = 2  # N m
    TORQUE = 3  # external, N m; followed
    STD = 4  # filled, without a contact, N m
    MOMENTUM = 5  # as it is believed, N m s
    RATE = 6  # of it at the instant before, but for the external torque, N m
    SLOW = 7  # mean of the external torque, N m
    NOW = 8  # momentum by the model
    DRIFT = 9  # dT/dq - g less friction, N m
    UNSURE = 10  # standard deviation of the model's torque, N m
    TURN = 11  # the same for friction around a turn of the joint
    INERTIA = 12  # of the motor, kg m²
    TURNING = 13  # what `TURN` is around a turn
    ERROR = 14  # what `UNSURE` is, but for
    WEIGHT = 15  # this share of the weight
    ODD = 16  # torque beside the bodies that the table of the joints does not hold, N m
    EXPECTED = 17  # filled: measured torque without the external one, N m
    SPIKE = 18  # by which the momentum is off at most in a step, N m s: no more is believed
    NOISE = 19


@jit
def ask(bodies, joints, table, winds, dt_s):
    """Fill what `balance` wants to know of the model.

    Args:
        bodies: their frames, θ and gravity; joints: table of the model's joints at q, dq.
        table: of the observer; winds: whether bristles follow now, dt_s after the last time.
    """
    frames, theta, gravity = bodies
    n = table.shape[1]
    q, dq = joints[Row.Q.value], joints[Row.DQ.value]
    if winds:
        wind_table(joints, dt_s)
    out = np.empty((3, n))
    momenta(frames, theta, q, dq, gravity, out)
    for j in range(n):
        table[Of.NOW.value, j] = out[0, j] + table[Of.INERTIA.value, j] * dq[j]
        more = beside(joints, j, True) + table[Of.ODD.value, j]
        table[Of.DRIFT.value, j] = out[1, j] - out[2, j] - more
        weight = abs(out[2, j])
        table[Of.UNSURE.value, j] = table[Of.ERROR.value, j] + table[Of.WEIGHT.value, j] * weight
        turns = abs(dq[j]) < TURN_DQ
        table[Of.TURN.value, j] = table[Of.TURNING.value, j] if turns else 0.0


@jit
def balance(table, step):
    """Take one instant; the external torque follows, and the covariance of its noise.

    `step`: (dt_s, rate of both poles in 1/s, age of the noise in s, whether the external torque is
    noise alone).
    """
    dt_s, pole, age_s, quiet = step
    n = table.shape[1]
    r, slow, noise = table[Of.TORQUE.value], table[Of.SLOW.value], table[Of.NOISE.value :]
    memory = math.exp(-pole * dt_s)
    slowly, young = math.exp(-dt_s / SLOW_S), age_s < WARM_UP_S
    part = dt_s / min(max(age_s, dt_s), NOISE_S) if quiet else 0.0
    own, scale = np.empty(n), 0.0
    for j in range(n):
        rate = table[Of.TAU.value, j] + table[Of.DRIFT.value, j]
        before = table[Of.RATE.value, j]
        ahead = table[Of.MOMENTUM.value, j] + dt_s * (0.5 * (rate + before) + r[j])
        most = table[Of.SPIKE.value, j]
        error = min(max(table[Of.NOW.value, j] - ahead, -most), most)
        table[Of.MOMENTUM.value, j] = ahead + (1.0 - memory * memory) * error
        table[Of.RATE.value, j] = rate
        r[j] += (1.0 - memory) * (1.0 - memory) * error / dt_s
        slow[j] = slowly * slow[j] + (1.0 - slowly) * r[j]
        own[j] = r[j] - slow[j]
        scale = max(scale, own[j] ** 2 / (noise[j, j] + table[Of.UNSURE.value, j] ** 2))
    share = part if young or not scale > CLIP * CLIP else part * CLIP * CLIP / scale
    for i in range(n):
        for j in range(n):
            noise[i, j] += share * own[i] * own[j] - part * noise[i, j]


@jit
def distance_of(table):
    """Of the external torque from nothing, in standard deviations of all joints; fills `STD`."""
    n = table.shape[1]
    r, noise = table[Of.TORQUE.value], table[Of.NOISE.value :]
    L, x, total = np.zeros((n, n)), np.empty(n), 0.0
    for i in range(n):
        extra = table[Of.UNSURE.value, i] ** 2 + table[Of.TURN.value, i] ** 2
        table[Of.STD.value, i] = math.sqrt(noise[i, i] + extra)
        for j in range(i + 1):
            value = noise[i, j] + (extra if i == j else 0.0)
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(value) if i == j else value / L[j, j]
        x[i] = r[i]
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
        total += x[i] * x[i]
    return math.sqrt(total)


@jit
def observe(bodies, joints, table, step):
    """One reading, all of it; the distance of the external torque from nothing.

    Zero where it begins anew, NaN for a reading that is no number: then nothing changes.

    Args:
        bodies, joints, table: as for `ask`.
        step: as for `balance`, with an infinite dt_s where it begins anew; whether bristles follow.
    """
    dt_s, pole, age_s, quiet, winds = step
    n = table.shape[1]
    for j in range(n):
        if not math.isfinite(table[0, j] + table[1, j] + table[2, j]):
            return math.nan
    for j in range(n):
        joints[Row.Q.value, j], joints[Row.DQ.value, j] = table[0, j], table[1, j]
    ask(bodies, joints, table, winds, dt_s)
    if dt_s == math.inf:
        for j in range(n):
            table[Of.EXPECTED.value, j] = table[Of.TAU.value, j] + table[Of.TORQUE.value, j]
            table[Of.MOMENTUM.value, j] = table[Of.NOW.value, j]
            table[Of.RATE.value, j] = table[Of.TAU.value, j] + table[Of.DRIFT.value, j]
        return 0.0
    balance(table, (dt_s, pole, age_s, quiet))
    for j in range(n):
        table[Of.EXPECTED.value, j] = table[Of.TAU.value, j] + table[Of.TORQUE.value, j]
    return distance_of(table)


@jit
def observe_each(bodies, joints, table, readings, step, past):
    """Take readings one after the other, up to the first that may be a contact.

    Args:
        bodies, joints, table: as for `ask`.
        readings: stamps (m,) int64 ns; q, dq, tau (m, 3, n).
        step: where it stands (stamp of the reading before, ns; age of the noise, s; whether it
            begins anew), and how it goes on (rate of both poles in 1/s; standard deviations of a
            contact; whether nothing pushes; whether bristles follow).
        past: stamps (2,) int64 ns and readings (2, 2, n) of a little before, older first; followed.

    Returns:
        How many were taken; where it stands behind them; distance of the external torque from
        nothing, NaN where none is known; and the step, s, of one that is to be judged, else 0.
    """
    bodies, joints, table, readings, past = borrowed((bodies, joints, table, readings, past))
    stamps, signals = readings
    (stamp, age_s, anew), (pole, limit, quiet, winds) = step
    past_ns, before = past
    n, last = table.shape[1], math.nan
    for i in range(signals.shape[0]):
        table[: Of.TORQUE.value] = signals[i]
        dt_s = 1e-9 * (stamps[i] - stamp)
        if anew or not 0.0 < dt_s <= LONGEST_S:
            dt_s = math.inf
        older_s = age_s + (dt_s if dt_s < math.inf else 0.0)
        distance = observe(bodies, joints, table, (dt_s, pole, older_s, quiet, winds))
        if math.isnan(distance):
            continue
        if anew:
            fastest = 0.0
            for j in range(n):
                fastest = max(fastest, abs(table[Of.DQ.value, j]))
            if fastest < TURN_DQ:  # what holds it is known at once
                for j in range(n):
                    table[Of.TORQUE.value, j] = table[Of.SLOW.value, j] = -table[Of.RATE.value, j]
                    known = table[Of.TAU.value, j] + table[Of.TORQUE.value, j]
                    table[Of.EXPECTED.value, j] = known
        anew, stamp, age_s = False, stamps[i], older_s
        if stamp - past_ns[1] > 15_000_000:  # between two a momentum's rate is taken
            past_ns[0], before[0] = past_ns[1], before[1]
            past_ns[1], before[1] = stamp, table[: Of.TAU.value]
        if dt_s < math.inf:
            last = distance
            if age_s > WARM_UP_S and (not quiet or distance > limit):
                return i + 1, (stamp, age_s, anew), last, dt_s
    return signals.shape[0], (stamp, age_s, anew), last, 0.0


@jit
def hand_wrench(frames, q, r, std, out):
    """Wrench on the last link that explains r best, at its origin in axes of the base.

    Args:
        frames: `Frames`; q, r, std: (n,).
        out: (2, 6), filled: wrench and standard deviation, N, N m.
    """
    n = q.shape[0]
    R, o = np.empty((n, 3, 3)), np.empty((n, 3))
    place_frames(frames, q, R, o)
    H, rhs = np.diag(1.0 / (NOT_KNOWN * NOT_KNOWN)), np.zeros(6)
    row = np.empty(6)
    j = n - 1
    while j >= 0:
        line = axis_line(R[j], o[j], frames.slides[j])
        # moment about the axis of [f; m + o_n x f]
        row[0] = line[0] + line[4] * o[n - 1, 2] - line[5] * o[n - 1, 1]
        row[1] = line[1] + line[5] * o[n - 1, 0] - line[3] * o[n - 1, 2]
        row[2] = line[2] + line[3] * o[n - 1, 1] - line[4] * o[n - 1, 0]
        row[3], row[4], row[5] = line[3], line[4], line[5]
        weight = 1.0 / (std[j] * std[j])
        for a in range(6):
            rhs[a] += weight * row[a] * r[j]
            for b in range(6):
                H[a, b] += weight * row[a] * row[b]
        j = frames.parent[j]
    covariance = np.linalg.inv(H)
    out[0] = covariance @ rhs
    for a in range(6):
        out[1, a] = math.sqrt(covariance[a, a])


@dataclass
class Contact:
    """One time in which something pushed the arm.

    Attributes:
        begin_ns, end_ns: stamps; the end is None while it lasts.
        joint: (from 0) where it stood out most.
        torque, std: (n,) external torque where it was largest, N m, and standard deviation.
        seen: (5, n) of its beginning, `SEEN_EVERY` samples apart: seconds since then, q, dq,
            torque, std.
    """

    begin_ns: int
    joint: int
    torque: Array
    std: Array
    end_ns: int | None = None
    seen: list[Array] = field(default_factory=list)


class ContactObserver:
    """External torque of every joint from raw samples, and when it is a contact.

    It begins with the documented arm, whose errors it takes to be large, and goes on with what is
    learned (`adopt`).

    Args:
        documented: the arm, with its tool; on a fixed base.
        effect_names: effects that are learned beside θ, in the order of their values.

    Attributes:
        torque: (n,) that the surroundings put on the joints, N m.
        std: (n,) its standard deviation without a contact, N m.
        learned: whether it goes by what was learned.
        explained: (n,) N m, sum of what new parameters took for the arm's own torque; a new array
            with each of them.
        expected: (n,) N m that the last reading would have had without a push.
        distance: of `torque` from nothing, in standard deviations over all joints.
        contact: the one that lasts; None where nothing pushes.
        contacts: all so far, at most `MOST_CONTACTS`.
    """

    def __init__(self, documented: SelfModel, effect_names: Sequence[str] = ()) -> None:
        n = documented.tree.n
        effort = documented.limits.effort
        self._model = ModelFeedforward.of(documented)
        self._learned = ModelFeedforward(
            documented.tree,
            with_bodies(documented).gravity,
            effect_names,
            not_learned(documented, effect_names),
        )
        self._tool = documented.theta_with_tool() - documented.theta
        self._table = table = np.zeros((Of.NOISE + n, n))
        self.torque, self.std, self.distance = table[Of.TORQUE], table[Of.STD], 0.0
        self.std[:], self.expected, self.explained = np.inf, table[Of.EXPECTED], np.zeros(n)
        self.contact: Contact | None = None
        self.contacts: list[Contact] = []
        self._age_s = 0.0
        self._anew, self._stamp_ns, self._since, self._recent = True, 0, 0, 0.0
        # stamps and readings (2, n) of a little before, older first
        self._past = np.zeros(2, dtype=np.int64), np.zeros((2, 2, n))
        self._stamps, self._signals = np.zeros(1, dtype=np.int64), np.zeros((1, 3, n))
        self._q, self._dq, self._tau = self._signals[0]
        table[Of.SPIKE] = 0.01 * effort  # s: the momentum that one reading may be off by
        effort = np.where(np.isfinite(effort), effort, 0.0)
        # not learned yet: shares of the effort limit and of the torque that carries it
        table[Of.ERROR], table[Of.WEIGHT] = 0.02 * effort, 0.05
        self._take_over()
        # Compile what a step calls, on numbers of no meaning: the loop has no time for it
        n = len(self.std)
        table, one = np.ones_like(self._table), np.ones(n)
        table[Of.NOISE :] = np.eye(n)
        joints = self._model.table.copy()
        ask(self._bodies, joints, table, True, 1e-3)
        past = np.zeros(2, dtype=np.int64), np.zeros((2, 2, n))
        how = POLE, SIGMAS, True, True
        readings = self._stamps, self._signals
        observe_each(self._bodies, joints, table, readings, ((0, 0.0, True), how), past)
        hand_wrench(self.frames, 0.0 * one, 0.0 * one, one, np.zeros((2, 6)))

    def adopt(
        self, lam: Array, theta: Array, effects: Array, shapes: Array, torque_std: Array
    ) -> bool:
        """Go on with what was learned, or say that it is not finite: then nothing changes.

        Args:
            lam, theta, effects, shapes: λ (n, 6), θ (n, 10), (e, n), as in a `Snapshot`.
            torque_std: (n,) what it leaves unexplained, N m.
        """
        if not all(np.isfinite(x).all() for x in (lam, theta, torque_std)):
            return False
        before = self._ask_twice()
        self._learned.set(lam, theta + self._tool, np.nan_to_num(effects), shapes)
        if not self.learned:
            self._learned.table[: Row.SHARES] = self._model.table[: Row.SHARES]
            self._model, self._age_s = self._learned, 0.0  # its noise is another
        self._table[Of.ERROR], self._table[Of.WEIGHT] = torque_std, 0.0
        self._take_over()
        if not self._anew:
            # Go on from the change of momentum and drift, now and a little before. A fresh start
            # from one noisy reading would look like a push, and so would a torque that is taken
            # for an external one only until the observer has followed.
            now, then = self._ask_twice() - before
            dt_s = 1e-9 * float(self._stamp_ns - self._past[0][0])
            gone = now[1] - ((now[0] - then[0]) / dt_s if 0.0 < dt_s < 0.1 else 0.0)
            self._table[[Of.MOMENTUM, Of.RATE]] += now
            self._table[[Of.TORQUE, Of.SLOW, Of.EXPECTED]] -= gone
            self.explained = self.explained + gone
        return True

    def _ask_twice(self) -> Array:
        """(2, 2, n) momentum and drift by the model in use, now and a little before."""
        model, said = self._model, []
        for q, dq in (model.table[: Row.DQ + 1].copy(), self._past[1][0]):
            joints, table = model.table.copy(), self._table.copy()
            joints[Row.Q], joints[Row.DQ] = q, dq
            if model.odd:
                table[Of.ODD] = model.odd_beside(q, dq, 0.0)
            ask(self._bodies, joints, table, False, 0.0)
            said.append(table[[Of.NOW, Of.DRIFT]])
        return np.array(said)

    @property
    def learned(self) -> bool:
        """See the class."""
        return self._model is self._learned

    def _take_over(self) -> None:
        """What stands still of the model in use."""
        model = self._model
        self._bodies = model.frames, model.theta, model.gravity
        self._table[Of.TURNING] = TURN_SHARE * np.abs(model.friction(0.1))  # rad/s
        self._table[Of.INERTIA] = model.motor_inertia()

    def step(self, sample: JointSample) -> Array:
        """External torque (n,) N m with this sample; one that is not finite leaves it as it was."""
        self._stamps[0] = sample.stamp_ns
        self._q[:], self._dq[:], self._tau[:] = sample.q, sample.dq, sample.tau
        self._take(self._stamps, self._signals)
        return self.torque

    def step_each(self, stamp_ns: NDArray[np.int64], signals: Array) -> Array:
        """`step` with samples in order: stamps (m,), and q, dq, tau (m, 3, n) of each."""
        at = 0
        while at < len(signals):
            at += self._take(stamp_ns[at:], signals[at:])
        return self.torque

    def _take(self, stamp_ns: NDArray[np.int64], signals: Array) -> int:
        """Take the first samples in one call; how many."""
        model = self._model
        if model.odd:
            stamp_ns, signals = stamp_ns[:1], signals[:1]
            if not np.isfinite(signals).all():
                return 1
            dt_s = 1e-9 * int(stamp_ns[0] - self._stamp_ns)
            known = not self._anew and 0.0 < dt_s <= LONGEST_S
            q, dq = signals[0, 0], signals[0, 1]
            self._table[Of.ODD] = model.odd_beside(q, dq, dt_s if known else math.inf)
        stands = self._stamp_ns, self._age_s, self._anew
        how = POLE, SIGMAS, self.contact is None, not model.odd
        now, readings = (stands, how), (stamp_ns, signals)
        count, stands, distance, dt_s = observe_each(
            self._bodies, model.table, self._table, readings, now, self._past
        )
        self._stamp_ns, self._age_s, self._anew = stands
        if not math.isnan(distance):
            self.distance = distance
        if dt_s:
            self._judge(self._stamp_ns, signals[count - 1], dt_s)
        return int(count)

    def _judge(self, stamp_ns: int, signals: Array, dt_s: float) -> None:
        """Begin, follow and end a contact, with a sample q, dq, tau (3, n)."""
        contact, limit = self.contact, SIGMAS
        if contact is None:
            if self.distance > limit:
                joint = int(np.argmax(np.abs(self.torque) / self.std))
                contact = Contact(stamp_ns, joint, self.torque.copy(), self.std.copy())
                self.contact, self._since, self._recent = contact, 0, limit * limit
                if len(self.contacts) < MOST_CONTACTS:
                    self.contacts.append(contact)
            return
        keep = math.exp(-dt_s / HOLD_S)
        self._recent = keep * self._recent + (1.0 - keep) * self.distance**2
        if self._recent < 0.25 * limit * limit:
            contact.end_ns, self.contact = stamp_ns, None
        if self._since % SEEN_EVERY == 0 and len(contact.seen) < SEEN:
            since_s = np.full(len(self.std), 1e-9 * (stamp_ns - contact.begin_ns))
            now = since_s, signals[0], signals[1], self.torque, self.std
            contact.seen.append(np.array(now))
        if np.abs(self.torque).max() > np.abs(contact.torque).max():
            contact.torque, contact.std = self.torque.copy(), self.std.copy()
        self._since += 1

    def weight(self, q: Array) -> Array:
        """(n,) N m of holding still at q (n,) rad, by the model in use."""
        rows = self._model.table[: Row.TAU + 1]  # they belong to the last reading
        kept = rows.copy()
        weight = self._model.unbent(q)
        rows[:] = kept
        return weight

    @property
    def frames(self) -> Frames:
        """Where the joints are, by the model in use."""
        return self._model.frames

    def wrench(self) -> tuple[Array, Array]:
        """(6,) [f; m] on the last link at its origin, base axes, N and N m; (6,) its std.

        What the torques do not show has the standard deviation of not knowing.
        """
        both = np.empty((2, 6))
        hand_wrench(self.frames, self._model.table[Row.Q], self.torque, self.std, both)
        return both[0], both[1]
