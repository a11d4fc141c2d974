"""The seven motors at work on the arm: what they answer and what they do in a tick."""

from __future__ import annotations

from collections import Counter

import numpy as np

from sim.damiao import codec, motor
from sim.damiao.arm import World
from sim.damiao.faults import HOT_C, JUMP_RAD, STATUS, Faults, spiked
from sim.damiao.motor import Motor, in_joint_angles, motor_set
from sim.engine import DriveLaw
from sim.truth import Array

REPLY_OFFSET = 0x10  # reply id = command id + 0x10, as OpenArm sets it
WARM_UP_TICKS = 20  # temperatures are slow: they move on every 20 ms


class MotorBank:
    """Motors 1 to 7 with the arm between them; knows nothing of a bus.

    Attributes:
        motors: joint 1 first.
        frames: what was asked of them, by what it was.
    """

    def __init__(self, motors: str, world: World, faults: Faults) -> None:
        """Motors of a set, disabled. Raises ValueError, naming the choices."""
        self.motors = [
            Motor(j, j + REPLY_OFFSET, kind, scale)
            for j, (kind, scale) in enumerate(motor_set(motors), 1)
        ]
        self.frames: Counter[str] = Counter()
        self._world, self._faults = world, faults
        self._told: dict[int, tuple[float, float]] = {}
        self._index()

    def addressed(self, identifier: int, data: bytes) -> int | None:
        """Which motor (from 0) a frame is for; None for nobody here."""
        if identifier == codec.SERVICE_ID:
            identifier = data[0] | data[1] << 8
        return self._by_id.get(identifier)

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
                q_des, dq_des, kp, kd, ff = in_joint_angles(unit.command, unit.zero)
                rows[:, j] = q_des, dq_des, kp, kd, reached[j], ff, unit.most_torque
        return DriveLaw(*rows)

    def _index(self) -> None:
        self._by_id = {unit.motor_id: j for j, unit in enumerate(self.motors)}

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
            unit.clear_error()
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
            return codec.encode_save_reply(unit.motor_id)
        if what not in (codec.READ, codec.WRITE):
            self.frames["unknown service"] += 1
            return None
        self.frames["register reads" if what == codec.READ else "register writes"] += 1
        if what == codec.WRITE:
            unit.write(register, codec.register_value(register, data[4:]))
            self._index()
        value = unit.read(register, self._world.at(now_ns, j)[0])
        if value is None:
            return None
        return codec.encode_register_reply(unit.motor_id, what, register, value)

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
            q = spiked(q, faults, now_s)
            if unit.status <= motor.ENABLED:
                self._fail(unit, number, now_s)
        return unit.feedback(q, dq, tau)

    def _fail(self, unit: Motor, number: int, now_s: float) -> None:
        """Errors that the faults bring about."""
        if self._faults.hits("overtemp", number, now_s):
            unit.rotor_c = HOT_C
            unit.fail(motor.HOT_ROTOR)
        for name, status in STATUS.items():
            if self._faults.hits(name, number, now_s):
                unit.fail(status)
