"""Keeps an arm on a reference by feedback alone, with a model's feed-forward on request.

    tau = b + K (q_ref - q) + D (dq_ref - dq)

like a joint impedance controller. No model: the constant b is the torque that the arm was
measured to hold itself with before the start. With feed-forward, b fades out over a second while
the model's torque fades in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from adapter.errors import SettingsError
from adapter.excitation import ExcitationSettings, MotionLimits, RandomMotion, smooth_step
from adapter.feedforward import Feedforward
from adapter.records import Array
from drivers.interface import JointSample

# N m/rad and N m s/rad. Stiffness as of a Panda's joint impedance control; damping as high as
# the arm's smallest inertias allow at 1 kHz (D T / I < 0.5), without the help of the motors'.
PANDA_STIFFNESS = (600.0, 700.0, 400.0, 600.0, 40.0, 50.0, 10.0)
PANDA_DAMPING = (15.0, 25.0, 8.0, 15.0, 1.2, 1.6, 0.3)
STIFFNESS_PER_EFFORT = 5.0  # 1/rad, of another arm
DAMPING_TIME_S = 0.03  # damping over stiffness, of another arm

BLIND_S = 0.02  # without a usable reading for so long, the controller gives up
LONGEST_STEP_S = 0.02  # the reference goes on by at most this much per sample
FADE_S = 1.0  # from feedback alone to feed-forward
REFRESH_TICKS = 50


class ControlError(RuntimeError):
    """The controller cannot keep the arm; it has to be stopped by its driver."""


class Controller(Protocol):
    """What the loop asks of a controller."""

    @property
    def at_rest(self) -> bool:
        """A stop was asked for and is done."""

    def attach(self, snapshot_name: str) -> None:
        """Follow the estimate published under this name."""

    def detach(self) -> None:
        """Follow it no longer."""

    def prepare(self, sample: JointSample) -> None:
        """Get ready to start from where this sample finds the arm; may take its time."""

    def step(self, sample: JointSample) -> Array:
        """Torques (n,) N m for this sample. Raises ControlError."""

    def begin_stop(self) -> None:
        """Come to rest from now on; `step` goes on being called."""

    def tracking(self) -> dict[str, Any]:
        """How well the arm followed, JSON values only."""


@dataclass(frozen=True)
class ControlSettings:
    """Gains of the feedback; those of a Panda, or by a rule from the effort limits, where None.

    Attributes:
        stiffness: K (n), N m/rad.
        damping: D (n), N m s/rad.
        effort_share: of the effort limits that a command uses at most.
    """

    stiffness: Sequence[float] | None = None
    damping: Sequence[float] | None = None
    effort_share: float = 0.95

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
        panda = limits.is_panda
        effort = np.where(np.isfinite(limits.effort), limits.effort, 10.0)
        rule = np.array(PANDA_STIFFNESS) if panda else STIFFNESS_PER_EFFORT * effort
        damping_rule = np.array(PANDA_DAMPING) if panda else DAMPING_TIME_S * rule
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

    Args:
        limits: of the arm.
        motion: settings of the reference.
        control: gains.
        feedforward: a model to help, used as soon as it is ready; feedback alone where None.

    Attributes:
        reference: the motion; None before the first sample.
        saturated: commands that were cut at the effort limit.
        rate_limited: commands that were cut at the torque rate limit.
    """

    def __init__(
        self,
        limits: MotionLimits,
        motion: ExcitationSettings | None = None,
        control: ControlSettings | None = None,
        feedforward: Feedforward | None = None,
    ) -> None:
        control = control or ControlSettings()
        self.limits, self.motion = limits, motion or ExcitationSettings()
        self.feedforward = feedforward
        self._K, self._D = control.gains(limits)
        self._effort = limits.effort * control.effort_share
        self.reference: RandomMotion | None = None
        self.saturated = self.rate_limited = 0
        self._stamp_ns = self._blind_since_ns = 0
        self._tau = self._bias = np.zeros(len(limits.effort))
        self._fade_s, self._ticks = 0.0, 0
        self._feedback_only = ErrorTally(len(limits.effort))
        self._with_model = ErrorTally(len(limits.effort))

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

        Raises SettingsError where it stands outside its limits.
        """
        self.reference = RandomMotion(self.limits, sample.q, self.motion)
        self._tau = self._bias = np.array(sample.tau, dtype=np.float64)
        self._stamp_ns = self._blind_since_ns = sample.stamp_ns
        ref = self.reference
        ref.advance(0.0)  # compiles, as does the next line, before the clock runs
        if self.feedforward is not None:
            self.feedforward(ref.q, ref.dq, ref.ddq)

    def begin_stop(self) -> None:
        """Slow down along the path, then hold."""
        if self.reference is not None:
            self.reference.begin_stop()

    def step(self, sample: JointSample) -> Array:
        """Torques (n,) N m. An unusable reading repeats the last; 20 ms of them are an error.

        Raises ControlError.
        """
        if self.reference is None:
            self.prepare(sample)
        assert self.reference is not None
        usable = np.isfinite(sample.q).all() and np.isfinite(sample.dq).all()
        dt_s = 1e-9 * (sample.stamp_ns - self._stamp_ns)
        if dt_s > 0.0:
            self._stamp_ns = sample.stamp_ns
            self.reference.advance(min(dt_s, LONGEST_STEP_S))
        if not usable:
            self._ticks += 1
            if sample.stamp_ns - self._blind_since_ns > 1e9 * BLIND_S:
                raise ControlError(f"no usable joint reading for {BLIND_S} s; the arm is stopped")
            return self._tau.copy()
        self._blind_since_ns = sample.stamp_ns
        return self._limited(self._wanted(sample, max(dt_s, 0.0)), dt_s)

    def _wanted(self, sample: JointSample, dt_s: float) -> Array:
        ref, model = self.reference, self.feedforward
        assert ref is not None
        error = ref.q - sample.q
        tau: Array = self._K * error + self._D * (ref.dq - sample.dq)
        share = 0.0
        if model is not None:
            if self._ticks % REFRESH_TICKS == 0:
                model.refresh()
            if model.ready:
                self._fade_s = min(self._fade_s + dt_s, FADE_S)
                share = smooth_step(self._fade_s / FADE_S)[0]
                tau += share * model(ref.q, ref.dq, ref.ddq)
        self._ticks += 1
        if share < 1.0:
            tau += (1.0 - share) * self._bias
        if ref.time_s >= self.motion.start_s and share in (0.0, 1.0):
            (self._with_model if share else self._feedback_only).add(error)
        return tau

    def _limited(self, tau: Array, dt_s: float) -> Array:
        """Within effort and torque rate limits."""
        cut = np.minimum(np.maximum(tau, -self._effort), self._effort)
        self.saturated += bool((cut != tau).any())
        most = self.limits.torque_rate * min(max(dt_s, 0.0), LONGEST_STEP_S)
        step = np.minimum(np.maximum(cut - self._tau, -most), most)
        self.rate_limited += bool((np.abs(cut - self._tau) > most).any())
        self._tau = self._tau + step
        return self._tau.copy()

    def tracking(self) -> dict[str, Any]:
        """Tracking error from the end of the soft start on, without and with feed-forward."""
        return {
            "feedback": self._feedback_only.as_dict(),
            "feedforward": self._with_model.as_dict(),
            "saturated": self.saturated,
            "rate_limited": self.rate_limited,
        }
