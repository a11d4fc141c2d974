"""A simulated arm: torques in, samples of a sensor-bearing arm out, 1 ms apart."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from drivers.interface import DriverError, Intake, JointSample, LinkMotion, checked_torques
from sim.dynamics import link_motion
from sim.effects import ENCODER, TORQUE
from sim.engine import PERIOD_S, SUBSTEPS, Engine
from sim.noise import SensorNoise, levels_of
from sim.noise_levels import NoiseLevels
from sim.sensors import Imus, Sensors
from sim.truth import Array, Truth

PERIOD_NS = round(PERIOD_S * 1e9)
LOCK_RATE = 60.0  # 1/s, the critically damped hold


class Plant:
    """A simulated arm with sensors, brakes and a limit on its torques.

    The driving torque goes linearly from one command to the next over a tick, so that it is
    continuous and equals the command at the end of the tick. A sample holds q, dq, the driving
    torque and link motion of one and the same instant. Where the truth has
    effects in its sensors, q, dq and torque are what these make of it; brakes, limits and link
    motion go by the links themselves.

    Until the first command, after `stop`, 20 ms after the last command and after a fault the
    brakes act: full deceleration, then a hold. A brake is part of the drive, so its torque is
    what the sensor reads; it is not bound by the effort limits. A command opens the brakes
    unless there is a fault: a joint that left its range or exceeded its speed limit.

    Attributes:
        joint_names, link_names: in the order of every array; period_ns: between two samples.
        saturated: the last command asked for more than an effort limit and was cut.
        braked: the brakes act.
        fault: why the arm refuses commands, or None.
        compute_ns: time the last `read` took here; on a real arm it would pass in hardware.
    """

    def __init__(
        self,
        truth: Truth,
        seed: int = 0,
        noise: NoiseLevels | None = None,
        links: bool | tuple[str, ...] = False,
        q0: Array | None = None,
        substeps: int = SUBSTEPS,
    ) -> None:
        """Set up the arm at rest at t = 0.

        Args:
            truth: the arm.
            seed: of the noise.
            noise: what the sensors add; a real Panda's by default.
            links: whether the links' motion is measured; or names of links with a sensor glued
                on, anyhow (`sim.sensors`).
            q0: (n,) posture at the start, rad; the truth's by default.
            substeps: of a tick.
        """
        self.truth, self.period_ns = truth, PERIOD_NS
        self.joint_names, self.link_names = truth.joint_names, truth.link_names
        self.saturated, self.braked = False, True
        self.fault: str | None = None
        self.compute_ns = 0
        self._links = links is True
        self._imus = (
            None if isinstance(links, bool) else Imus(truth.link_names, links, seed, PERIOD_S)
        )
        self._engine = Engine(truth, substeps=substeps)
        sensing = any(effect.place in (ENCODER, TORQUE) for effect in truth.effects)
        self._sensors = Sensors(truth, PERIOD_S) if sensing else None
        self._noise = SensorNoise(noise or levels_of("real"), truth.n, seed)
        self._q = np.array(truth.ready if q0 is None else q0, dtype=float)
        self._dq = np.zeros(truth.n)
        self._engine.place(self._q, self._dq)
        self._drive = self._engine.drive_for(self._q, self._dq, np.zeros(truth.n))
        self._wanted = self._drive
        self._age = self._braked_ticks = 0
        self._lock, self._moving = self._q.copy(), np.zeros(truth.n, dtype=bool)
        self._k = -1
        self._seen = self._q, self._dq, self._drive
        self.clean()  # what is compiled on first use is compiled before the clock runs

    def read(self) -> JointSample:
        """Move on by one period and say what arrives; the first call is t = 0, before any motion.

        Where samples get lost the arm has moved on by more than a period.
        """
        begun = time.perf_counter_ns()
        sample = None
        while sample is None:
            self._advance()
            sample = self._noise.measure(self._k, self.clean())
            if self._imus is not None:
                heard = self._imus.read(self._link_motion())
                sample = None if sample is None else replace(sample, links=heard)
        self.compute_ns = time.perf_counter_ns() - begun
        return sample

    def link_state(self) -> tuple[Array, Array, Array]:
        """True q, dq of the links and true driving torque at the last sample, (n,) each."""
        return self._q, self._dq, self._drive

    def ddq(self) -> Array:
        """True joint acceleration (n,) at the last sample, rad/s²."""
        return self._engine.acceleration(self._q, self._dq, self._drive)

    def command(self, tau: Array) -> None:
        """Drive with these torques (n,) N m from here on, reached at the end of the next period.

        Raises:
            DriverError: not n finite numbers, or the arm has a fault.
        """
        wanted = checked_torques(tau, self.truth.n)
        if self.fault is not None:
            raise DriverError(f"the arm is braked: {self.fault}")
        effort = self.truth.limits.effort
        self._wanted = np.minimum(np.maximum(wanted, -effort), effort)
        self.saturated = bool((np.abs(wanted) > effort).any())
        self.braked, self._age = False, 0

    def stop(self) -> None:
        """Close the brakes."""
        if not self.braked:
            self.braked, self._moving = True, np.ones(self.truth.n, dtype=bool)
            self._braked_ticks = 0

    def close(self) -> None:
        """Free the simulator; may be called more than once."""
        self._engine.close()

    def _advance(self) -> None:
        """One tick, but for the first sample, which is the start itself; then the sensors."""
        self._k += 1
        if self._k > 0:
            self._age += 1
            if self._age > 20:  # 20 ms, then the brakes close
                self.stop()
            end = self._brake() if self.braked else self._wanted
            self._engine.tick(self._drive, end)
            self._drive = end
            self._q, self._dq = self._engine.state()
            # brakes for good when a joint leaves its range or is too fast
            limits, q, dq = self.truth.limits, self._q, self._dq
            outside = (q < limits.lower) | (q > limits.upper)
            wrong = outside | (np.abs(dq) > limits.velocity)
            if self.fault is None and wrong.any():
                j = int(np.argmax(wrong))
                what = "left its range" if outside[j] else "exceeded its speed limit"
                at = f"q {q[j]:.3f} rad, dq {dq[j]:.3f} rad/s"
                self.fault = f"{self.joint_names[j]} {what} ({at})"
                self.stop()
        if self._sensors is not None:
            now_s = self._k * PERIOD_S
            self._seen = self._sensors.read(now_s, self._q, self._dq, self._drive)

    def _brake(self) -> Array:
        """Driving torque (n,) at the end of the next tick that slows down and then holds."""
        self._braked_ticks += 1
        still = np.abs(self._dq) < 0.01  # rad/s, a slower joint is held where it is
        stopped = self._moving & still & (self._braked_ticks > 100)  # pushed back until then
        self._lock[stopped] = self._q[stopped]
        self._moving &= ~stopped
        most = self.truth.limits.acceleration
        slow = np.clip(-self._dq / 0.02, -most, most)  # s
        hold = LOCK_RATE**2 * (self._lock - self._q) - 2 * LOCK_RATE * self._dq
        return self._engine.drive_for(self._q, self._dq, np.where(self._moving, slow, hold))

    def clean(self) -> JointSample:
        """What the last `read` would have said without noise and with a perfect clock."""
        if self._sensors is None:
            self._seen = self._q, self._dq, self._drive
        q, dq, tau = self._seen
        links = None
        if self._links:
            both = self._link_motion().reshape(self.truth.n, 2, 6)  # [v; w] and [a; dw]
            links = LinkMotion(both[:, 0].copy(), both[:, 1].copy())
        return JointSample(max(self._k, 0) * PERIOD_NS, q, dq, tau, links)

    def _link_motion(self) -> Array:
        """True motion (n, 4, 3) of the links in their frames: v, w, a with gravity, dw."""
        arm = self._engine.truth
        return np.asarray(link_motion(arm.frames, arm.base, self._q, self._dq, self.ddq()))


class SimulatedArm:
    """Driver of a simulated arm.

    It does not pace itself: each `read` moves the arm on by one period with the last command and
    returns at once. Stamps count from 0 at the arm's start.

    Attributes:
        plant_time_ns: how long physics and sensors of the last `read` took. A real arm does
            this part in hardware, so a timing of the driver leaves it out.
    """

    paced = False
    can_move = True
    adds_gravity = False
    arrived_ns = 0
    delay_ns = 1_000_000

    def __init__(self, plant: Plant) -> None:
        self.joint_names = plant.joint_names
        self.link_names = plant.link_names
        self.period_ns = plant.period_ns
        self.plant_time_ns = 0
        self.intake = Intake()
        self._plant = plant
        self._open = False
        self._closed = False

    def connect(self) -> None:
        """Make the arm ready. Raises DriverError when it was closed before."""
        if self._closed:
            raise DriverError("the simulated arm was closed; build a new one")
        self._open = True

    def read(self) -> JointSample:
        """The next sample, one period after the last. Raises DriverError when not connected."""
        self._need_open()
        sample = self._plant.read()
        self.plant_time_ns = self._plant.compute_ns
        self.intake.received += 1
        self.intake.used += 1
        return sample

    def command(self, tau: Array) -> None:
        """Ask for (n,) N m, gravity included; reached one period after the last sample.

        Raises DriverError for anything but n finite numbers, when the arm has braked by itself
        because of a joint's range or speed, or when not connected.
        """
        self._need_open()
        self._plant.command(tau)

    def stop(self) -> None:
        """Close the arm's brakes; the next command opens them."""
        if self._open:
            self._plant.stop()

    def close(self) -> None:
        """Free the simulator; may be called more than once."""
        if not self._closed:
            self._plant.close()
        self._open, self._closed = False, True

    def _need_open(self) -> None:
        if not self._open:
            state = "closed; build a new one" if self._closed else "not connected; call connect()"
            raise DriverError(f"the simulated arm is {state}")
