"""The seven boards: motors at work on the arm, frames in, frames out."""

from __future__ import annotations

import argparse
import contextlib
import os
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any

import can
import numpy as np

from drivers.interface import JointSample
from sim.damiao import codec, motor
from sim.damiao.bus import address_of, check_alone, open_bus
from sim.damiao.codec import BUS_OFF, data_frame, error_frame, is_command
from sim.damiao.faults import HOT_C, JUMP_RAD, SPIKE_RAD, STATUS, Outbox, board_faults
from sim.damiao.motor import Motor, motor_set
from sim.effects import ENCODER, TORQUE
from sim.engine import PERIOD_S, DriveLaw, Engine
from sim.faults import Faults
from sim.noise import SensorNoise, levels_of
from sim.noise_levels import NoiseLevels
from sim.options import Ending, options_of, sum_up
from sim.scenarios import Scenario, build
from sim.truth import Array, Truth

IDLE_S = 5e-3  # longest wait without frames: the arm goes on in steps of this
WARM_UP_TICKS = 20  # temperatures are slow: they move on every 20 ms


class MotorBank:
    """Motors 1 to 7 with the arm between them; knows nothing of a bus.

    Attributes:
        motors: joint 1 first; by_id: places in there (from 0) by the id that frames are sent to.
        frames: what was asked of them, by what it was.
    """

    def __init__(self, motors: str, world: World, faults: Faults) -> None:
        """Motors of a set, disabled. Raises ValueError, naming the choices."""
        self.motors = [
            Motor(j, j + 0x10, kind, scale)  # as OpenArm sets it
            for j, (kind, scale) in enumerate(motor_set(motors), 1)
        ]
        self.frames: Counter[str] = Counter()
        self._world, self._faults = world, faults
        self._told: dict[int, tuple[float, float]] = {}
        self._index()

    def answer(
        self, j: int, identifier: int, data: bytes, now_ns: int, now_s: float
    ) -> bytes | None:
        """What motor j does with a frame and what it replies; None for nothing.

        Args:
            j: from 0.
            identifier, data: of the frame.
            now_ns: the clock.
            now_s: time that the faults go by.
        """
        unit = self.motors[j]
        unit.watch(now_ns)
        unit.feed(now_ns)
        if identifier == codec.SERVICE_ID:
            return self._serve_register(j, data, now_ns, now_s)
        return self._obey(j, data, now_ns, now_s)

    def law(self, start_ns: int, reached: Array) -> DriveLaw:
        """The motors' law in the tick that begins at an instant; (7,) torques reached by then."""
        rows = np.zeros((7, len(self.motors)))
        warm_up = self._world.ticks % WARM_UP_TICKS == 0
        for j, unit in enumerate(self.motors):
            unit.watch(start_ns)
            if warm_up:
                tau = self._world.at(start_ns, j)[2] if unit.drives else 0.0
                unit.warm_up(tau, WARM_UP_TICKS * 1e-3)
            if unit.drives:
                q_des, dq_des, kp, kd, ff = unit.command
                most = min(unit.scale.tmax, unit.kind.scale.tmax)  # its scale's, or its strength
                rows[:, j] = q_des + unit.zero, dq_des, kp, kd, reached[j], ff, most
        return DriveLaw(*rows)

    def _index(self) -> None:
        self.by_id = {unit.motor_id: j for j, unit in enumerate(self.motors)}

    def _obey(self, j: int, data: bytes, now_ns: int, now_s: float) -> bytes:
        """A special frame or a MIT command; every one is answered with feedback."""
        unit = self.motors[j]
        kind = data[7] if data[:7] == codec.SPECIAL else None
        if kind == codec.ENABLE:
            self.frames["enable"] += 1
            unit.enable()
        elif kind == codec.DISABLE:
            self.frames["disable"] += 1
            unit.disable()
        elif kind == codec.CLEAR_ERROR:
            self.frames["clear error"] += 1
            if unit.status != motor.ENABLED:
                unit.status = motor.DISABLED
        elif kind == codec.SET_ZERO:
            self.frames["set zero"] += 1
            unit.zero = self._world.at(now_ns, j)[0]
        else:
            self.frames["commands"] += 1
            reply = self._feedback(j, now_ns, now_s)
            unit.take(data)
            if self._world.held and all(m.commanded and m.drives for m in self.motors):
                self._world.held = False
            return reply
        return self._feedback(j, now_ns, now_s)

    def _serve_register(self, j: int, data: bytes, now_ns: int, now_s: float) -> bytes | None:
        """A frame on the service id."""
        unit, what, register = self.motors[j], data[2], data[3]
        if what == codec.REFRESH:
            self.frames["refresh"] += 1
            return self._feedback(j, now_ns, now_s)
        if what == codec.SAVE:
            self.frames["save"] += 1
            # The layout is this simulator's choice, no source describes it.
            return struct.pack("<HBBI", unit.motor_id, what, 1, 0)
        if what not in (codec.READ, codec.WRITE):
            self.frames["unknown service"] += 1
            return None
        self.frames["register reads" if what == codec.READ else "register writes"] += 1
        whole = register in codec.INTEGER_REGISTERS
        kind = "<I" if whole else "<f"
        if what == codec.WRITE:
            unit.write(register, struct.unpack(kind, data[4:])[0])
            self._index()
        value = unit.read(register, self._world.at(now_ns, j)[0])
        if value is None:
            return None
        head = struct.pack("<HBB", unit.motor_id, what, register)
        return head + struct.pack(kind, int(value) if whole else value)

    def _feedback(self, j: int, now_ns: int, now_s: float) -> bytes:
        """What motor j (from 0) says of this instant."""
        q, dq, tau = self._world.at(now_ns, j)
        unit, faults = self.motors[j], self._faults
        if faults:
            number = j + 1
            if faults.hits("stuck", number, now_s):
                q, dq = self._told.setdefault(j, (q, 0.0))
            if faults.hits("jump", number, now_s):
                q += JUMP_RAD
            if faults.strikes("spike", now_s):
                q += SPIKE_RAD if faults.pick(2) else -SPIKE_RAD
            if unit.status <= motor.ENABLED:
                if self._faults.hits("overtemp", number, now_s):
                    unit.rotor_c = HOT_C
                    unit.fail(motor.HOT_ROTOR)
                for name, status in STATUS.items():
                    if self._faults.hits(name, number, now_s):
                        unit.fail(status)
        return unit.feedback(q, dq, tau)


@dataclass(frozen=True, eq=False)
class BoardOptions:
    """How the boards are set up.

    Attributes:
        motors: a set of `sim.damiao.motor.SETS`.
        noise: what the sensors add before the frames quantise; nothing where None.
        q0: (7,) posture at the start, rad; the scenario's where None.
        stand: whether the arm rests in a stand at first.
    """

    motors: str = "panda"
    noise: NoiseLevels | None = None
    q0: Array | None = None
    stand: bool = True


class Boards:
    """A simulated arm whose joints are Damiao motors in MIT mode on a CAN bus.

    Until every motor has been enabled and has had a command the arm rests in a stand: an arm
    without brakes would lie on its end stops before anybody connects. From then on a motor
    without torque is limp. A reply has the format (classic or FD) of the frame it answers.

    Attributes:
        motors: joint 1 first.
        world: the arm.
        faults: what is broken, with counts.
        frames: what arrived, by what it was.
        compute_ns: time spent in `service` so far; on a real arm it would pass in the motors.
    """

    def __init__(
        self,
        bus: can.BusABC,
        scenario: Scenario,
        options: BoardOptions | None = None,
        faults: Iterable[str] | Faults = (),
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Switch the motors on, disabled.

        Args:
            bus: where the motors are; not closed here.
            scenario: the arm and the seed of noise and faults; its own noise is not used.
            options: motors, noise and start.
            faults: texts `NAME[=VALUE][@SECONDS]`, or faults that something else shares.
            now_ns: the clock.

        Raises:
            ValueError: no such motors or fault (names the choices), or an arm that has not seven
                joints or has effects in its sensors.
        """
        options, seed = options or BoardOptions(), scenario.seed
        fittings, truth = motor_set(options.motors), scenario.truth
        if truth.n != len(fittings):
            raise ValueError(f"the boards drive {len(fittings)} joints; this arm has {truth.n}")
        if have := sorted({e.name for e in truth.effects if e.place in (ENCODER, TORQUE)}):
            raise ValueError(
                f"joint boards simulate no effects in sensors, this arm has: {', '.join(have)}"
            )
        self.faults = faults if isinstance(faults, Faults) else board_faults(faults, seed)
        self._bus, self._now_ns = bus, now_ns
        levels = replace(
            options.noise or levels_of("none"), dropouts=0.0, repeats=0.0, stamp_jitter_s=0.0
        )
        self.world = World(truth, options.q0, now_ns(), levels, seed)
        self.world.held = options.stand
        self._bank = MotorBank(options.motors, self.world, self.faults)
        self.motors, self.frames = self._bank.motors, self._bank.frames
        self.compute_ns = 0
        self._outbox = Outbox(bus, self.faults)
        self._first_ns: int | None = None
        self._last_ns = 0
        self._off = False

    def service(self) -> int:
        """Handle every frame that has arrived, each at the clock's present instant.

        Returns:
            How many frames arrived.
        """
        begun, count = time.perf_counter_ns(), 0
        self._advance(self._now_ns())
        while (message := self._receive(0.0)) is not None:
            self._handle(message)
            count += 1
        self.compute_ns += time.perf_counter_ns() - begun
        return count

    def serve(self, stop: Callable[[], bool]) -> None:
        """Handle frames as they come until `stop()` is true; for a process of its own.

        Asks for SCHED_FIFO and goes on without where that is not permitted.
        """
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(40))
        while not stop():
            message = self._receive(self._patience_s())
            begun = time.perf_counter_ns()
            if message is not None:
                self._handle(message)
            self._advance(self._now_ns())
            self.compute_ns += time.perf_counter_ns() - begun

    def next_ns(self) -> int | None:
        """When the boards have something to send without being asked; None for never."""
        return None if self._off else self._outbox.next_ns()

    def report(self) -> dict[str, Any]:
        """What happened so far, as plain numbers."""
        world = self.world
        return {
            "frames": dict(self.frames),
            "replies": self._outbox.sent,
            "replies_not_sent": self._outbox.failed,
            "faults": dict(+self.faults.counts),
            "ticks": world.ticks,
            "slipped_ms": world.slipped_ns / 1e6,
            "limp_ticks": world.limp_ticks,
            "stop_ticks": world.stop_ticks,
            "fastest_rad_s": world.fastest,
            "in_stand": world.held,
            "status": [m.status for m in self.motors],
            "rotor_c": [round(m.rotor_c, 1) for m in self.motors],
            "compute_s": self.compute_ns / 1e9,
        }

    def close(self) -> None:
        """Free the simulator; the bus stays open."""
        self.world.close()

    def _receive(self, patience_s: float) -> can.Message | None:
        """The next frame; what cannot be read is counted and passed over.

        Raises can.CanError where the bus itself is gone.
        """
        for _ in range(1000):  # failures to receive in a row, then the bus counts as gone
            try:
                return self._bus.recv(patience_s)
            except can.CanError:
                self.frames["unreadable"] += 1
        return self._bus.recv(patience_s)

    def _patience_s(self) -> float:
        """How long to wait for a frame before the arm has to move on."""
        now = self._now_ns()
        until = self.world.end_ns if now - self._last_ns < 10_000_000 else now + IDLE_S * 1e9
        due = self._outbox.next_ns()
        until = until if due is None else min(until, due)
        return min(max((until - now) * 1e-9, 0.0), IDLE_S)

    def _advance(self, now_ns: int) -> None:
        """Bring everything that moves by itself to an instant."""
        self.world.advance(now_ns, self._bank.law, self._first_ns)
        if self.faults:
            off = self.faults.within("bus_off", self._seconds(now_ns))
            if off and not self._off:
                self._outbox.tell(error_frame(BUS_OFF))
                self.faults.counts["bus_off"] += 1
            self._off = off
            if not off:
                self._outbox.flush(now_ns)

    def _measured_ns(self) -> int:
        """The instant that a frame handled now measures, with the arm brought there.

        Bringing the arm there takes time of its own, which should not make the answer older.
        """
        self._advance(self._now_ns())
        self._last_ns = self._now_ns()
        if self._last_ns >= self.world.end_ns:
            self._advance(self._last_ns)
        if self._first_ns is None:
            self._first_ns = self._last_ns
        return self._last_ns

    def _seconds(self, now_ns: int) -> float:
        """Scenario time: since the first frame to a motor; before it, negative."""
        return -1.0 if self._first_ns is None else (now_ns - self._first_ns) * 1e-9

    def _handle(self, message: can.Message) -> None:
        """One frame from the bus, which may also be one of our own or somebody else's."""
        if self._off:
            self.frames["while bus off"] += 1
            return
        if not is_command(message):
            self.frames["not for motors"] += 1
            return
        identifier, data = message.arbitration_id, bytes(message.data)
        to = data[0] | data[1] << 8 if identifier == codec.SERVICE_ID else identifier
        j = self._bank.by_id.get(to)
        if j is None:
            self.frames["other ids"] += 1
            return
        now = self._measured_ns()
        now_s, faults = self._seconds(now), self.faults
        if faults and (faults.hits("silent", j + 1, now_s) or faults.strikes("deaf", now_s)):
            self.frames["unheard"] += 1
            return
        reply = self._bank.answer(j, identifier, data, now, now_s)
        if reply is not None:
            frame = data_frame(self.motors[j].reply_id, reply, message.is_fd)
            self._outbox.put(frame, now, now_s)


def run(args: argparse.Namespace) -> int:
    """`adapter sim can`: serve until a signal comes or the time is over. Raises ValueError."""
    options = options_of(args.set)
    scenario = build(args.scenario, args.seed, **options)
    noise = scenario.noise if options.keys() & {"noise", "levels"} else None
    fd = bool(args.fd)
    with Ending(args.duration) as ending, contextlib.ExitStack() as stack:
        bus = open_bus(args.interface, args.channel, args.port, fd)
        stack.callback(bus.shutdown)
        boards = Boards(bus, scenario, BoardOptions(args.motors, noise), args.fault)
        stack.callback(boards.close)
        check_alone(bus, boards.motors[0].motor_id, boards.motors[0].reply_id, fd)
        address = address_of(args.interface, args.channel, args.port, fd)
        print(f"ready: a simulated arm on {address}", flush=True)
        boards.serve(ending.is_set)
        report = boards.report()
    sum_up({"address": address, **report}, summary(report), args.json)
    return 0


def summary(report: dict[str, Any]) -> str:
    """What happened, in a few lines."""
    frames, faults = report["frames"], report["faults"]
    lines = [
        f"simulated {report['ticks'] / 1000:.1f} s, slipped {report['slipped_ms']:.0f} ms",
        f"frames: {_counts(frames)}; replies {report['replies']}",
        f"status of motors 1 to 7: {' '.join(f'{status:X}' for status in report['status'])}; "
        f"fastest joint {report['fastest_rad_s']:.2f} rad/s; limp {report['limp_ticks']} ms, "
        f"on an end stop {report['stop_ticks']} ms",
    ]
    if faults:
        lines.append(f"faults struck: {_counts(faults)}")
    return "\n".join(lines)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{key} {count}" for key, count in counts.items()) or "none"


PERIOD_NS = round(PERIOD_S * 1e9)
MOST_TICKS_AT_ONCE = 100  # of a backlog; beyond it the simulated world slips


class World:
    """The arm along a clock: whole ticks of 1 ms, and any instant inside the last one; its sensors.

    A tick is simulated as soon as the clock has reached its start, with the commands that came
    before; so motion and torque of any instant up to its end are known and need no extrapolation.
    A command acts from the next tick on, 0.5 ms later in the mean, and its feed-forward torque is
    reached, linearly, at that tick's end: the torque is continuous, as in `sim.plant`.

    As long as `held` is true the arm rests in a stand and its motors push against that.

    Attributes:
        held: the arm is in the stand.
        end_ns: of the last tick, where the next one begins.
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
        self.end_ns = start_ns  # of the last tick
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
        due = (now_ns - self.end_ns) // PERIOD_NS + 1
        if due <= 0:
            return
        if due > MOST_TICKS_AT_ONCE:
            late_ns = (due - MOST_TICKS_AT_ONCE) * PERIOD_NS
            self.end_ns += late_ns
            self.slipped_ns += 0 if self.held else late_ns
            due = MOST_TICKS_AT_ONCE
        for _ in range(due):
            self._law = law_at(self.end_ns, self._law.ff1)
            self._engine.set_time(-1.0 if t0_ns is None else (self.end_ns - t0_ns) * 1e-9)
            self.end_ns += PERIOD_NS
            self.ticks += 1
            self._from = self._to
            if not self.held:
                self._engine.drive(self._law)
                self._to = self._engine.state()
                self.fastest = max(self.fastest, float(np.abs(self._to[1]).max()))
                self.stop_ticks += self._engine.stopped
                self.limp_ticks += not self._law.most.all()
            self._lists()

    def at(self, now_ns: int, joint: int) -> tuple[float, float, float]:
        """q rad, dq rad/s and motor torque N m of a joint (from 0) at an instant of the last tick.

        Position is cubic in time, with the speeds of both ends; speed is its derivative.
        """
        x = min(max(1.0 + (now_ns - self.end_ns) / PERIOD_NS, 0.0), 1.0)
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
        return self.end_ns, *self._to

    def close(self) -> None:
        """Free the simulator; may be called more than once."""
        self._engine.close()

    def _lists(self) -> None:
        """Each joint's numbers side by side: `at` works on single joints."""
        (q0, v0), (q1, v1) = self._from, self._to
        noise = self._quiet
        if self._noise is not None:
            noise = self._noise.measure(self.ticks, self._quiet) or noise
        rows = (q0, q1, v0, v1, *self._law, noise.q, noise.dq, noise.tau)
        self._columns = np.array(rows).T.tolist()
