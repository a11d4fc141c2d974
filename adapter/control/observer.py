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
where r leaves that by `sigmas` over all joints together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from adapter.control.feedforward import ModelFeedforward, not_learned
from adapter.effects.active import with_bodies
from adapter.errors import SettingsError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import Frames, axis_line, jit, momenta, place_frames
from drivers.interface import JointSample

LONGEST_S = 0.02  # a longer step of the stamps begins anew
SLOW_S, NOISE_S = 0.3, 5.0  # what is slower is no noise; over which noise is measured
WARM_UP_S = 1.0  # of noise before the first contact is believed
CLIP = 3.0  # standard deviations that count at most where noise is measured
TURN_DQ, TURN_SHARE = 0.03, 0.3  # rad/s; share of friction that is unknown at a slower joint
PROBE_DQ = 0.1  # rad/s, at which friction is asked for
# Of an arm that nobody learned: shares of the effort limit and of the torque that carries it.
UNLEARNED_EFFORT, UNLEARNED_WEIGHT = 0.02, 0.05
NOT_KNOWN = np.array([100.0, 100.0, 100.0, 30.0, 30.0, 30.0])  # std of a wrench, N, N m
MOST_CONTACTS = 1000
SEEN, SEEN_EVERY = 60, 5  # samples of a contact that are kept to tell what it is


@dataclass(frozen=True)
class ObserverSettings:
    """How contacts are told from what the model does not know.

    Attributes:
        bandwidth_hz: of each of the observer's two poles.
        sigmas: standard deviations, over all joints together, beyond which it is a contact.
        hold_s: over which the mean has to fall below half of that until the contact is over.
    """

    bandwidth_hz: float = 24.0
    sigmas: float = 8.0
    hold_s: float = 0.1

    def __post_init__(self) -> None:
        for name in ("bandwidth_hz", "sigmas", "hold_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise SettingsError(f"observer.{name} must be above zero")


@jit
def ask(bodies, state, beside, own, errors, now):
    """Fill what `balance` wants to know of the model.

    Args:
        bodies: their frames, θ and gravity; state: q, dq (n,); beside: (n,) torques beside them.
        own: (2, n) motor inertia, kg m²; torque that is unknown around a turn, N m.
        errors: (2, n) standard deviation of the torque, N m, and its share of the weight.
        now: (4, n) p; dT/dq - g less friction; standard deviations of the model and of a turn.
    """
    frames, theta, gravity = bodies
    q, dq = state
    n = q.shape[0]
    out = np.empty((3, n))
    momenta(frames, theta, q, dq, gravity, out)
    for j in range(n):
        now[0, j] = out[0, j] + own[0, j] * dq[j]
        now[1, j] = out[1, j] - out[2, j] - beside[j]
        now[2, j] = errors[0, j] + errors[1, j] * abs(out[2, j])
        now[3, j] = own[1, j] if abs(dq[j]) < TURN_DQ else 0.0


@jit
def balance(r, kept, now, tau, step, noise):
    """Take one instant; the external torque r (n,) follows. False where it begins anew.

    Args:
        r: (n,) external torque, N m.
        kept: (3, n) p as it is believed; its rates of the instant before but for r; slow mean of r.
        now: (4, n) as `ask` fills it; tau: (n,) measured.
        step: (dt_s, rate of both poles in 1/s, age of the noise in s, whether r is noise alone);
            dt_s is infinite where it begins anew.
        noise: (n, n) covariance of r's noise, (N m)²; follows.
    """
    dt_s, pole, age_s, quiet = step
    n = r.shape[0]
    if dt_s == math.inf:
        for j in range(n):
            kept[0, j], kept[1, j] = now[0, j], tau[j] + now[1, j]
        return False
    memory = math.exp(-pole * dt_s)
    slow, young = math.exp(-dt_s / SLOW_S), age_s < WARM_UP_S
    part = dt_s / min(max(age_s, dt_s), NOISE_S) if quiet else 0.0
    own, scale = np.empty(n), 0.0
    for j in range(n):
        rate = tau[j] + now[1, j]
        ahead = kept[0, j] + dt_s * (0.5 * (rate + kept[1, j]) + r[j])
        error = now[0, j] - ahead
        kept[0, j], kept[1, j] = ahead + (1.0 - memory * memory) * error, rate
        r[j] += (1.0 - memory) * (1.0 - memory) * error / dt_s
        kept[2, j] = slow * kept[2, j] + (1.0 - slow) * r[j]
        own[j] = r[j] - kept[2, j]
        scale = max(scale, own[j] ** 2 / (noise[j, j] + now[2, j] ** 2))
    share = part if young or not scale > CLIP * CLIP else part * CLIP * CLIP / scale
    for i in range(n):
        for j in range(n):
            noise[i, j] += share * own[i] * own[j] - part * noise[i, j]
    return True


@jit
def distance_of(r, noise, now, std):
    """Of r (n,) from nothing, in standard deviations of all joints; std (n,) N m is filled."""
    n = r.shape[0]
    L, x, total = np.zeros((n, n)), np.empty(n), 0.0
    for i in range(n):
        extra = now[2, i] ** 2 + now[3, i] ** 2
        std[i] = math.sqrt(noise[i, i] + extra)
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
        line = axis_line(R[j], o[j])
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
        distance: of `torque` from nothing, in standard deviations over all joints.
        contact: the one that lasts; None where nothing pushes.
        contacts: all so far, at most `MOST_CONTACTS`.
    """

    def __init__(
        self,
        documented: SelfModel,
        effect_names: Sequence[str] = (),
        settings: ObserverSettings | None = None,
    ) -> None:
        self.settings, n = settings or ObserverSettings(), documented.tree.n
        effort = documented.limits.effort
        self._model = ModelFeedforward.of(documented)
        self._learned = ModelFeedforward(
            documented.tree,
            with_bodies(documented).gravity,
            effect_names,
            not_learned(documented, effect_names),
        )
        self._tool = documented.theta_with_tool() - documented.theta
        self._pole = 2.0 * math.pi * self.settings.bandwidth_hz
        self.torque, self.std, self.distance = np.zeros(n), np.full(n, np.inf), 0.0
        self.contact: Contact | None = None
        self.contacts: list[Contact] = []
        self._kept, self._now = np.zeros((3, n)), np.zeros((4, n))
        self._reading, self._wrench = np.zeros((3, n)), np.zeros((2, 6))
        self._noise, self._age_s = np.zeros((n, n)), 0.0
        self._anew, self._stamp_ns, self._since, self._recent = True, 0, 0, 0.0
        effort = np.where(np.isfinite(effort), effort, 0.0)
        self._errors = np.array([UNLEARNED_EFFORT * effort, np.full(n, UNLEARNED_WEIGHT)])
        self._take_over()
        self._compile()

    def _compile(self) -> None:
        """Compile what a step calls, on numbers of no meaning: the loop has no time for it."""
        n = len(self.std)
        none, one, now = np.zeros(n), np.ones(n), np.ones((4, n))
        bodies = self._model.frames, self._model.theta, self._model.gravity
        ask(bodies, (none, none), none, self._own, self._errors, now)
        step = 1e-3, self._pole, 1.0, True
        balance(none.copy(), np.zeros((3, n)), now, none, step, np.eye(n))
        distance_of(none, np.eye(n), now, one)
        hand_wrench(self.frames, none, none, one, np.zeros((2, 6)))

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
        self._learned.set(lam, theta + self._tool, np.nan_to_num(effects), shapes)
        self._model = self._learned
        self._errors = np.array([torque_std, np.zeros(len(torque_std))])
        self._take_over()
        return True

    def _take_over(self) -> None:
        """What was believed of the momentum changes with the parameters: a fresh start from one
        noisy reading would look like a push.
        """
        turn = TURN_SHARE * np.abs(self._model.friction(PROBE_DQ))
        self._own = np.array([self._model.motor_inertia(), turn])
        if not self._anew:
            before = self._now[:2].copy()
            self._ask_model(self._reading[0], self._reading[1], 0.0)
            self._kept[:2] += self._now[:2] - before

    def _ask_model(self, q: Array, dq: Array, dt_s: float) -> None:
        """Fill what `balance` wants to know of the model at (n,) q, dq."""
        model = self._model
        beside = model.beside_bodies(q, dq, dt_s)
        bodies = model.frames, model.theta, model.gravity
        ask(bodies, (q, dq), beside, self._own, self._errors, self._now)

    def step(self, sample: JointSample) -> Array:
        """External torque (n,) N m with this sample; one that is not finite leaves it as it was."""
        if not np.isfinite(sample.q + sample.dq + sample.tau).all():
            return self.torque
        q, dq, tau = self._reading  # of its own: other arrays may be of a kind to compile for
        q[:], dq[:], tau[:] = sample.q, sample.dq, sample.tau
        dt_s = 1e-9 * (sample.stamp_ns - self._stamp_ns)
        if self._anew or not 0.0 < dt_s <= LONGEST_S:
            dt_s = math.inf
        self._ask_model(q, dq, dt_s)
        self._anew, self._stamp_ns = False, sample.stamp_ns
        if dt_s < math.inf:
            self._age_s += dt_s
        step = dt_s, self._pole, self._age_s, self.contact is None
        if balance(self.torque, self._kept, self._now, tau, step, self._noise):
            self.distance = distance_of(self.torque, self._noise, self._now, self.std)
            if self._age_s > WARM_UP_S:
                self._judge(sample, dt_s)
        return self.torque

    def _judge(self, sample: JointSample, dt_s: float) -> None:
        """Begin, follow and end a contact."""
        contact, limit = self.contact, self.settings.sigmas
        if contact is None:
            if self.distance > limit:
                joint = int(np.argmax(np.abs(self.torque) / self.std))
                contact = Contact(sample.stamp_ns, joint, self.torque.copy(), self.std.copy())
                self.contact, self._since, self._recent = contact, 0, limit * limit
                if len(self.contacts) < MOST_CONTACTS:
                    self.contacts.append(contact)
            return
        keep = math.exp(-dt_s / self.settings.hold_s)
        self._recent = keep * self._recent + (1.0 - keep) * self.distance**2
        if self._recent < 0.25 * limit * limit:
            contact.end_ns, self.contact = sample.stamp_ns, None
        if self._since % SEEN_EVERY == 0 and len(contact.seen) < SEEN:
            since_s = np.full(len(self.std), 1e-9 * (sample.stamp_ns - contact.begin_ns))
            now = since_s, sample.q, sample.dq, self.torque, self.std
            contact.seen.append(np.array(now))
        if np.abs(self.torque).max() > np.abs(contact.torque).max():
            contact.torque, contact.std = self.torque.copy(), self.std.copy()
        self._since += 1

    @property
    def frames(self) -> Frames:
        """Where the joints are, by the model in use."""
        return self._model.frames

    def wrench(self) -> tuple[Array, Array]:
        """(6,) [f; m] on the last link at its origin, base axes, N and N m; (6,) its std.

        What the torques do not show has the standard deviation of not knowing.
        """
        hand_wrench(self.frames, self._reading[0], self.torque, self.std, self._wrench)
        return self._wrench[0].copy(), self._wrench[1].copy()
