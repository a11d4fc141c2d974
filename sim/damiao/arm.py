"""The simulated arm along a clock: whole ticks of 1 ms, and any instant inside the last one.

A tick is simulated as soon as the clock has reached its start, with the commands that came
before; so motion and torque of any instant up to its end are known and need no extrapolation.
A command acts from the next tick on, 0.5 ms later in the mean, and its feed-forward torque is
reached, linearly, at that tick's end: the torque is continuous, as in `sim.plant`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from drivers.interface import JointSample
from sim.engine import PERIOD_S, DriveLaw, Engine
from sim.noise import SensorNoise
from sim.noise_levels import NoiseLevels
from sim.truth import Array, Truth

PERIOD_NS = round(PERIOD_S * 1e9)
BEFORE_S = -1.0  # what the scenario's clock shows before it begins
MOST_TICKS_AT_ONCE = 100  # of a backlog; beyond it the simulated world slips


class World:
    """The arm, its clock and what its sensors add.

    As long as `held` is true the arm rests in a stand and its motors push against that.

    Attributes:
        held: the arm is in the stand.
        slipped_ns: how far the simulated world has fallen behind the clock.
        ticks: simulated, those in the stand included.
        limp_ticks: of these, with at least one motor without torque and the arm not in the stand.
        stop_ticks: of these, with a joint on its end stop.
        fastest: rad/s, the highest speed of any joint so far.
    """

    def __init__(
        self, truth: Truth, q0: Array | None, start_ns: int, levels: NoiseLevels, seed: int
    ) -> None:
        self._n = truth.n
        self._engine = Engine(truth, end_stops=True)
        self._end_ns = start_ns  # of the last tick
        self.held = True
        self.slipped_ns = self.ticks = self.limp_ticks = self.stop_ticks = 0
        self.fastest = 0.0
        self._noise: SensorNoise | None = None
        if any(np.any(value) for value in asdict(levels).values()):
            self._noise = SensorNoise(levels, truth.n, seed)
        zero = np.zeros(truth.n)
        self._quiet = JointSample(0, zero, zero, zero)
        q = np.array(truth.ready if q0 is None else q0, dtype=float)
        self._engine.place(q, zero)
        self._law = DriveLaw(q, zero, zero, zero, zero, zero, zero)
        self._engine.drive(self._law)  # whatever is set up on first use is set up before the clock
        self._engine.place(q, zero)
        self._from, self._to = (q, zero), (q, zero)
        self._lists()

    def advance(
        self, now_ns: int, law_at: Callable[[int, Array], DriveLaw], t0_ns: int | None
    ) -> None:
        """Simulate every tick that has begun by now.

        Args:
            now_ns: the clock.
            law_at: the motors' law for the tick that begins at an instant, from that instant
                and the feed-forward torques (n,) reached by then.
            t0_ns: when the scenario's time began; None if it has not.
        """
        due = (now_ns - self._end_ns) // PERIOD_NS + 1
        if due <= 0:
            return
        if due > MOST_TICKS_AT_ONCE:
            late_ns = (due - MOST_TICKS_AT_ONCE) * PERIOD_NS
            self._end_ns += late_ns
            self.slipped_ns += 0 if self.held else late_ns
            due = MOST_TICKS_AT_ONCE
        for _ in range(due):
            self._law = law_at(self._end_ns, self._law.ff1)
            self._engine.set_time(BEFORE_S if t0_ns is None else (self._end_ns - t0_ns) * 1e-9)
            self._tick()

    def at(self, now_ns: int, joint: int) -> tuple[float, float, float]:
        """q rad, dq rad/s and motor torque N m of a joint (from 0) at an instant of the last tick.

        Position is cubic in time, with the speeds of both ends; speed is its derivative.
        """
        x = min(max(1.0 + (now_ns - self._end_ns) / PERIOD_NS, 0.0), 1.0)
        q0, q1, v0, v1, q_des, dq_des, kp, kd, ff0, ff1, most, *extra = self._columns[joint]
        step, rest = v0 * PERIOD_S, (v0 + v1) * PERIOD_S - 2 * (q1 - q0)
        bend = q1 - q0 - step - rest
        q = q0 + x * (step + x * (bend + x * rest))
        dq = (step + x * (2 * bend + 3 * x * rest)) / PERIOD_S
        tau = kp * (q_des - q) + kd * (dq_des - dq) + ff0 + x * (ff1 - ff0)
        tau = min(max(tau, -most), most)
        return q + extra[0], dq + extra[1], tau + extra[2]

    def state(self) -> tuple[int, Array, Array]:
        """End of the last tick, ns, with q (n,) rad and dq (n,) rad/s there."""
        return self._end_ns, *self._to

    def next_ns(self) -> int:
        """When the next tick begins."""
        return self._end_ns

    def close(self) -> None:
        """Free the simulator; may be called more than once."""
        self._engine.close()

    def _tick(self) -> None:
        self._end_ns += PERIOD_NS
        self.ticks += 1
        self._from = self._to
        if not self.held:
            self._engine.drive(self._law)
            self._to = self._engine.state()
            self.fastest = max(self.fastest, float(np.abs(self._to[1]).max()))
            self.stop_ticks += self._engine.stopped
            self.limp_ticks += not self._law.most.all()
        self._lists()

    def _lists(self) -> None:
        """Each joint's numbers side by side: `at` works on single joints."""
        (q0, v0), (q1, v1) = self._from, self._to
        noise = self._quiet
        if self._noise is not None:
            noise = self._noise.measure(self.ticks, self._quiet) or noise
        rows = (q0, q1, v0, v1, *self._law, noise.q, noise.dq, noise.tau)
        self._columns = np.array(rows).T.tolist()
