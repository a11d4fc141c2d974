"""Keeps an arm on a reference by feedback alone, with a model's feed-forward on request.

    tau = b + K (q_ref - q) + D (dq_ref - dq)

like a joint impedance controller. No model: the constant b is the torque that the arm was
measured to hold itself with before the start. With feed-forward, b fades out over a second while
the model's torque fades in. An arm that carries its own weight (`Driver.adds_gravity`) is given
no b, and the model's torque less the gravity in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adapter.control.excitation import RandomMotion
from adapter.control.feedforward import Feedforward
from adapter.control.limits import MotionLimits, need_same_robot
from adapter.control.observer import ContactObserver
from adapter.control.path_motion import PathMotion, smooth_step
from adapter.control.reading_gate import ReadingGate
from adapter.control.resting import CarriedWeight
from adapter.control.safety import ArmWatch, Now
from adapter.control.settings import ExcitationSettings, SafetySettings
from adapter.errors import ControlError, SettingsError
from adapter.model.spatial import Array
from drivers.interface import Driver, JointSample

FADE_S = 1.0  # from feedback alone to feed-forward


@dataclass(frozen=True)
class ControlSettings:
    """Gains of the feedback; where None, those of an arm that is known by name (`RobotFacts`), or
    by a rule from the effort limits.

    Attributes:
        stiffness: K (n), N m/rad.
        damping: D (n), N m s/rad.
        effort_share: of the effort limits that a command uses at most.
        safety: when the arm is stopped because it does not move as it should.
    """

    stiffness: Sequence[float] | None = None
    damping: Sequence[float] | None = None
    effort_share: float = 0.95
    safety: SafetySettings = field(default_factory=SafetySettings)

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping"):
            values = getattr(self, name)
            if values is not None and not all(value >= 0.0 for value in values):
                raise SettingsError(f"control.{name} must not be negative, got {values}")
        if not 0.0 < self.effort_share <= 1.0:
            raise SettingsError(f"control.effort_share must be in (0, 1], got {self.effort_share}")

    def gains(self, limits: MotionLimits) -> tuple[Array, Array]:
        """K and D (n,) of an arm. Raises SettingsError for a wrong number of gains."""
        n = len(limits.effort)
        known = limits.known
        effort = np.where(np.isfinite(limits.effort), limits.effort, 10.0)
        rule = 5.0 * effort if known is None else known.stiffness  # 1/rad
        damping_rule = 0.03 * rule if known is None else known.damping  # s
        chosen = []
        for name, own in (("stiffness", rule), ("damping", damping_rule)):
            given = getattr(self, name)
            gains = own if given is None else np.array(given, dtype=np.float64)
            if gains.shape != (n,):
                raise SettingsError(f"control.{name} has {len(gains)} values; the arm {n} joints")
            chosen.append(gains)
        return chosen[0], chosen[1]


class ErrorTally:
    """Square sum and maximum of the tracking error by joint."""

    def __init__(self, n: int) -> None:
        self.count, self._square, self._max = 0, np.zeros(n), np.zeros(n)

    def add(self, error: Array) -> None:
        """Count one error (n,), rad."""
        self.count += 1
        self._square += error * error
        np.maximum(self._max, np.abs(error), out=self._max)

    def as_dict(self) -> dict[str, Any]:
        """Samples, rms and max by joint in rad; None where nothing was counted."""
        if not self.count:
            return {"samples": 0, "rms_rad": None, "max_rad": None}
        rms = np.sqrt(self._square / self.count)
        return {"samples": self.count, "rms_rad": rms.tolist(), "max_rad": self._max.tolist()}


class ExcitationController:
    """Random motion, kept by feedback, started softly and stopped safely.

    A command differs from the last one by at most what the torque rate allows in one period (0.9
    of it where time goes on between two reads), however much time went by: an arm compares it
    with the last command that reached it.
    A reading that is no number, that comes again or late, that moved as no joint moves or that
    stands still while the arm should move is not acted upon; the last torque is repeated.

    Args:
        limits: of the arm.
        motion: settings of the reference.
        control: gains.
        feedforward: a model to help, used as soon as it is ready; feedback alone where None.
        draw: makes the motion from limits, the arm's position and settings.
        expected: a model of the arm, to tell what pushes it; nothing tells that where None.

    Attributes:
        observer: once it has learned, it says what pushes the arm, in place of `expected`; whoever
            sets it has it see each sample before `step` does.
        weight: what the arm may hold before it is moved, and be carried with when it is braked;
            None lets it be anything.
        reference: the motion; None before the first sample.
        start: the sample that it was drawn from.
    """

    def __init__(
        self,
        limits: MotionLimits,
        motion: ExcitationSettings | None = None,
        control: ControlSettings | None = None,
        feedforward: Feedforward | None = None,
        draw: Callable[[MotionLimits, Array, ExcitationSettings], PathMotion] = RandomMotion,
        expected: Feedforward | None = None,
    ) -> None:
        control = control or ControlSettings()
        n = len(limits.effort)
        self.limits, self.motion = limits, motion or ExcitationSettings()
        self.feedforward, self.draw = feedforward, draw
        self.observer: ContactObserver | None = None
        self.weight: CarriedWeight | None = None
        self._expected, self.safety = expected, control.safety
        self._K, self._full_D = control.gains(limits)
        self._D = self._full_D
        self._effort = limits.effort * control.effort_share
        self.reference: PathMotion | None = None
        self.start: JointSample | None = None
        self._tau, self._bias, self._still = np.zeros(n), np.zeros(n), np.zeros(n)
        self._fade_s, self._ticks, self._explained = 0.0, 0, np.zeros(n)
        self._carry: Callable[[Array], None] | None = None
        self._feedback_only, self._with_model = ErrorTally(n), ErrorTally(n)
        self._take_on(1_000_000, False)

    def attend(self, driver: Driver) -> None:
        """Learn the arm's period, whether it carries its own weight, and how late it acts.

        Where it acts later than the gains are made for, damping shrinks in that proportion.

        Raises SettingsError for an arm that says it is another than the limits are of.
        """
        need_same_robot(driver, self.limits)
        self._D = self._full_D * min(1.0, 1_000_000 / max(driver.delay_ns, 1))  # ns: made for it
        self._take_on(driver.period_ns, driver.adds_gravity)
        self._carry = getattr(driver, "carry", None)  # of arms without brakes

    def _take_on(self, period_ns: int, adds_gravity: bool) -> None:
        self._period_ns, self._adds_gravity = period_ns, adds_gravity
        self._most = self.limits.torque_rate * (1e-9 * period_ns)

    @property
    def at_rest(self) -> bool:
        """A stop was asked for and is done, or there never was a motion."""
        return self.reference is None or self.reference.at_rest

    def attach(self, snapshot_name: str) -> None:
        """Let the feed-forward follow an estimate. Raises SnapshotError."""
        if self.feedforward is not None:
            self.feedforward.attach(snapshot_name)

    def detach(self) -> None:
        """Let the feed-forward go on with what it has."""
        if self.feedforward is not None:
            self.feedforward.detach()

    def prepare(self, sample: JointSample) -> None:
        """Draw the motion from here on; the arm holds itself still now.

        Raises SettingsError where it stands outside its limits or says nothing usable.
        """
        held = self._still if self._adds_gravity and self.weight is None else sample.tau
        for name, values in (("position", sample.q), ("velocity", sample.dq), ("torque", held)):
            if not np.isfinite(values).all():
                raise SettingsError(
                    f"joint {int(np.argmin(np.isfinite(values))) + 1} gives no {name}; a motion "
                    "can only start where every joint is measured"
                )
        self.reference = ref = self.draw(self.limits, sample.q, self.motion)
        self.start = sample
        own = self._still if self._adds_gravity else sample.tau
        self._tau = self._bias = np.array(own, dtype=np.float64)
        if self.weight is not None:
            self.weight.begin(sample.q, sample.tau)
        limits = self.limits
        self._gate = ReadingGate(limits.velocity, limits.effort, self._K, self._period_ns)
        self._watch = ArmWatch(self.limits, self.safety, self._K, self._effort)
        self._started = False
        ref.advance(0.0)  # compiles, as do the next lines, before the clock runs
        if self.feedforward is not None:
            self.feedforward(ref.q, ref.dq, ref.ddq)
        if self._expected is not None:
            self._expected(ref.q, ref.dq, ref.ddq)
            if self._adds_gravity:
                self._watch.now[Now.CARRIED] = self._expected.unbent(ref.q)

    def begin_stop(self) -> None:
        """Slow down along the path, then hold."""
        if self.reference is not None:
            self.reference.begin_stop()

    def step(self, sample: JointSample, now_ns: int = 0) -> Array:
        """Torques (n,) N m. An unusable reading repeats the last; 20 ms of them are an error.

        Args:
            sample: the reading.
            now_ns: instant at which it is there, where time goes on between two reads: it tells
                a hole in the samples from a clock that was set. 0 goes by the stamps alone.

        Raises ControlError.
        """
        if self.reference is None:
            self.prepare(sample)
        ref, gate = self.reference, self._gate
        assert ref is not None
        step_ns = gate.look(sample, now_ns)
        if not self._started:
            self._start(sample)
        if step_ns:
            ref.advance(1e-9 * step_ns)
        usable = gate.usable(sample, ref.q)
        self._ticks += 1
        if not usable or not step_ns:
            return self._tau.copy()
        tau = self._wanted(sample, 1e-9 * step_ns)
        if not np.isfinite(tau).all():
            raise ControlError("the model's torque is not a finite number; the arm is stopped")
        return self._watched(tau, sample, (0.9 if now_ns else 1.0) * self._most, step_ns)

    def _watched(self, tau: Array, sample: JointSample, most: Array, step_ns: int) -> Array:
        """The command (n,) N m for a wanted torque, not further than `most` from the last one."""
        ref, model, watch = self.reference, self._expected, self._watch
        assert ref is not None
        now = watch.now
        now[0], now[1], now[2], now[3] = tau, self._tau, ref.q - sample.q, sample.dq
        if model is not None:
            now[4] = sample.tau
            if self.observer is not None and self.observer.learned:
                # Expect what the observer does; what its model has newly explained is no offset
                now[Now.EXPECTED], now[Now.STD] = self.observer.expected, self.observer.std
                if self.observer.explained is not self._explained:
                    now[Now.OFFSET] += self.observer.explained - self._explained
                    self._explained = self.observer.explained
            else:
                now[5] = model(ref.q, ref.dq, ref.ddq)
            if self._ticks % 20 == 0:  # between two looks at what carries the arm
                self._tell_weight(model.unbent(ref.q), ref.q)
        self._tau = watch.step(most, 1e-9 * min(step_ns, 2 * self._period_ns))
        return self._tau.copy()

    def _tell_weight(self, gravity: Array, q: Array) -> None:
        """What carries the arm (n,) N m: kept where the arm adds it, else told where asked for.

        It is documented weight, or learned weight, and what this is off by, a push for one; within
        what the arm may be carried with.
        """
        if self._adds_gravity:
            self._watch.now[Now.CARRIED] = gravity
        elif self._carry is not None:
            if self.observer is not None and self.observer.learned:
                gravity = self.observer.weight(q)
            carried = gravity + self._watch.now[Now.OFFSET]
            self._carry(carried if self.weight is None else self.weight.within(q, carried))

    def _start(self, sample: JointSample) -> None:
        """The first reading has to be where the motion was drawn from; it may be long ago."""
        assert self.reference is not None
        if self.weight is not None and self.weight.refusal is not None:
            raise ControlError(f"{self.weight.refusal}; the arm was not moved")
        self._started = True
        away = np.abs(sample.q - self.reference.q)
        if (away > 0.02).any():  # rad
            j = int(np.argmax(away))
            raise ControlError(
                f"joint {j + 1} moved by {away[j]:.3f} rad between the plan and the start; start "
                "again and leave the arm alone"
            )

    def _wanted(self, sample: JointSample, dt_s: float) -> Array:
        ref, model = self.reference, self.feedforward
        assert ref is not None
        error = ref.q - sample.q
        tau: Array = self._K * error + self._D * (ref.dq - sample.dq)
        share = 0.0
        if model is not None:
            if self._ticks % 50 == 0:
                model.refresh()
            if model.ready:
                self._fade_s = min(self._fade_s + dt_s, FADE_S)
                share = smooth_step(self._fade_s / FADE_S)[0]
                whole = model(ref.q, ref.dq, ref.ddq)
                tau += share * (whole - model.unbent(ref.q) if self._adds_gravity else whole)
        if share < 1.0:
            tau += (1.0 - share) * self._bias
        if ref.time_s >= self.motion.start_s and share in (0.0, 1.0):
            (self._with_model if share else self._feedback_only).add(error)
        return tau

    def tracking(self) -> dict[str, Any]:
        """Tracking error from the end of the soft start on, without and with feed-forward."""
        return {
            "feedback": self._feedback_only.as_dict(),
            "feedforward": self._with_model.as_dict(),
            "saturated": 0 if self.reference is None else self._watch.saturated,
            "rate_limited": 0 if self.reference is None else self._watch.rate_limited,
            "unusable": 0 if self.reference is None else self._gate.unusable,
            "notes": [] if self.feedforward is None else list(self.feedforward.notes),
        }
