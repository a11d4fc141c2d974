"""A Damiao motor as its bus sees it; motor types, and sets of seven for a simulated arm.

The simulated Panda needs 87 N m on joints 1 to 4 and 12 N m on joints 5 to 7, which no type has
as its full scale. Set `panda` takes the next larger types and has 100 and 12.5 N m written into
register 23, as an integrator would: half the torque step of the type's own 200 N m. Set
`panda_fitted` also has PMAX and VMAX written to what a Panda needs (4 rad, 4 rad/s): a third of
the angle step, an eighth of the speed step. Set `openarm` has the types of an OpenArm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.errors import choices
from sim.damiao.codec import AT_REST, INTEGER_REGISTERS, FullScale, decode_command, encode_feedback

DISABLED, ENABLED = 0x0, 0x1
OVER_VOLTAGE, UNDER_VOLTAGE, OVER_CURRENT = 0x8, 0x9, 0xA
HOT_MOSFET, HOT_ROTOR, LOST_COMMUNICATION, OVERLOAD = 0xB, 0xC, 0xD, 0xE
# Registers that do something here.
MST_ID, ESC_ID, TIMEOUT, CTRL_MODE = 7, 8, 9, 10
OVER_TEMPERATURE, PMAX, VMAX, TMAX, CAN_BR = 2, 21, 22, 23, 35
# What the motor measures or what it is; a write is answered with the value as it was.
READ_ONLY = frozenset({13, 14, 15, 16, 17, 18, 19, 20, 36, 50, 51, 52, 53, 54, 55, 80, 81})
MIT_MODE = 1
# Thermal model, our choice: at its rated torque a motor gets so much hotter than the air.
AIR_C = 25.0
NEVER_NS = 1 << 62


@dataclass(frozen=True)
class MotorType:
    """Facts of a motor type (openarm_can's table; gear and rated torque: Seeed Studio wiki).

    Attributes:
        name: of the type.
        scale: full scales as delivered; the last one is also the most torque it can give.
        gear: ratio, register 20.
        rated: torque that it can give for good, N m. Seeed Studio for the types of an OpenArm;
            for the larger ones 0.4 of the full scale, our choice.
    """

    name: str
    scale: FullScale
    gear: float
    rated: float


DM4310 = MotorType("DM4310", FullScale(12.5, 30.0, 10.0), 10.0, 3.0)
DM4340 = MotorType("DM4340", FullScale(12.5, 10.0, 28.0), 40.0, 9.0)
DM6006 = MotorType("DM6006", FullScale(12.5, 45.0, 20.0), 6.0, 8.0)
DM8009 = MotorType("DM8009", FullScale(12.5, 45.0, 54.0), 9.0, 20.0)
DM10010L = MotorType("DM10010L", FullScale(12.5, 25.0, 200.0), 10.0, 80.0)

Fitting = tuple[MotorType, FullScale]  # a type and what is written into its registers 21 to 23

_WIDE, _WRIST = DM10010L.scale._replace(tmax=100.0), DM6006.scale._replace(tmax=12.5)
_OPENARM = (DM8009, DM8009, DM4340, DM4340, DM4310, DM4310, DM4310)

SETS: dict[str, tuple[Fitting, ...]] = {
    "panda": ((DM10010L, _WIDE),) * 4 + ((DM6006, _WRIST),) * 3,
    "panda_fitted": ((DM10010L, FullScale(4.0, 4.0, 100.0)),) * 4
    + ((DM6006, FullScale(4.0, 4.0, 12.5)),) * 3,
    "openarm": tuple((kind, kind.scale) for kind in _OPENARM),
}


def motor_set(name: str) -> tuple[Fitting, ...]:
    """The motors of a set, joint 1 first. Raises ValueError, naming the choices."""
    if name not in SETS:
        raise ValueError(f"no motors {name!r}; {choices(name, SETS)}")
    return SETS[name]


class Motor:
    """A motor as its bus sees it.

    Modelling choices where no source says anything: a motor with an error takes no enable frame
    until the error is cleared; any frame to a motor feeds its watchdog; modes other than MIT are
    accepted and give no torque.

    Attributes:
        kind: its type.
        scale: full scales now in force, registers 21 to 23.
        status: nibble that its feedback carries.
        command: the last MIT command; all zero from an enable on until the first one.
        commanded: there has been a command since it was enabled.
        zero: rad, joint angle at which it reads 0.
        deadline_ns: when its watchdog bites.
        rotor_c, mosfet_c: temperatures, deg C.
    """

    def __init__(self, motor_id: int, reply_id: int, kind: MotorType, scale: FullScale) -> None:
        self.kind, self.scale = kind, scale
        self.status = DISABLED
        self.command = AT_REST
        self.commanded = False
        self.zero = 0.0
        self.deadline_ns = NEVER_NS
        self.rotor_c = self.mosfet_c = AIR_C
        self._limit_ns = NEVER_NS
        self.registers: dict[int, float] = _delivered(motor_id, reply_id, kind, scale)

    @property
    def motor_id(self) -> int:
        """Id of its commands."""
        return int(self.registers[ESC_ID])

    @property
    def reply_id(self) -> int:
        """Id of its replies."""
        return int(self.registers[MST_ID])

    @property
    def drives(self) -> bool:
        """It gives torque."""
        return self.status == ENABLED and self.registers[CTRL_MODE] == MIT_MODE

    def feed(self, now_ns: int) -> None:
        """A frame came: the watchdog starts again."""
        if self._limit_ns != NEVER_NS:
            self.deadline_ns = now_ns + self._limit_ns

    def watch(self, now_ns: int) -> None:
        """Let the watchdog bite if it is due."""
        if now_ns >= self.deadline_ns and self.status == ENABLED:
            self.fail(LOST_COMMUNICATION)

    def enable(self) -> None:
        """Give torque from the next command on; an error forbids it."""
        if self.status == DISABLED:
            self.status, self.command, self.commanded = ENABLED, AT_REST, False

    def disable(self) -> None:
        """Give no torque; an error stays."""
        if self.status == ENABLED:
            self.status = DISABLED

    def fail(self, status: int) -> None:
        """Show an error and give no torque."""
        self.status = status

    def take(self, data: bytes) -> None:
        """A MIT command; without effect while the motor is not enabled."""
        if self.status == ENABLED:
            self.command, self.commanded = decode_command(data, self.scale), True

    def feedback(self, q: float, dq: float, tau: float) -> bytes:
        """The feedback frame's bytes for joint angle q rad, speed rad/s and torque N m."""
        motion, temperatures = (q - self.zero, dq, tau), (self.mosfet_c, self.rotor_c)
        return encode_feedback(self.motor_id, self.status, motion, temperatures, self.scale)

    def warm_up(self, tau: float, for_s: float) -> None:
        """Temperatures after a torque of tau N m for so long; too hot is an error."""
        load = (tau / self.kind.rated) ** 2
        rotor, mosfet = AIR_C + 60.0 * load, AIR_C + 30.0 * load
        self.rotor_c += (rotor - self.rotor_c) * min(for_s / 300.0, 1.0)
        self.mosfet_c += (mosfet - self.mosfet_c) * min(for_s / 60.0, 1.0)
        if self.rotor_c > self.registers[OVER_TEMPERATURE]:
            self.fail(HOT_ROTOR)
        elif self.mosfet_c > 120.0:
            self.fail(HOT_MOSFET)

    def read(self, register: int, q: float) -> float | None:
        """Value of a register at joint angle q; None where there is none."""
        if register == 81:  # of the output
            return q - self.zero
        if register == 80:  # of the motor
            return (q - self.zero) * self.kind.gear
        return self.registers.get(register)

    def write(self, register: int, value: float) -> None:
        """Set a register in RAM; what it cannot take leaves it as it was."""
        if register in READ_ONLY or register not in self.registers or not _fits(register, value):
            return
        self.registers[register] = value
        if register in (PMAX, VMAX, TMAX):
            self.scale = FullScale(*(self.registers[k] for k in (PMAX, VMAX, TMAX)))
        elif register == TIMEOUT:
            self._limit_ns = int(value) * 50_000 if value else NEVER_NS  # ns
            self.deadline_ns = NEVER_NS


def _fits(register: int, value: float) -> bool:
    if register in INTEGER_REGISTERS:
        if register in (MST_ID, ESC_ID):
            return 0 < value <= 0x7FF  # a standard id
        return register != CTRL_MODE or value in (1, 2, 3, 4)
    return math.isfinite(value) and (register not in (PMAX, VMAX, TMAX) or value > 0)


def _delivered(motor_id: int, reply_id: int, kind: MotorType, scale: FullScale) -> dict[int, float]:
    """Registers as a motor has them when it is switched on; plausible where nothing hangs on it."""
    values: dict[int, float] = dict.fromkeys([*range(37), *range(50, 56), 80, 81], 0.0)
    values.update(dict.fromkeys(INTEGER_REGISTERS, 0))
    values.update({0: 15.0, 1: 1.0, OVER_TEMPERATURE: 100.0, 3: 0.98, 29: 60.0, 30: 1.0})
    values.update({MST_ID: reply_id, ESC_ID: motor_id, TIMEOUT: 0, CTRL_MODE: MIT_MODE})
    values.update({14: 5015, 15: motor_id, 16: 14, 20: kind.gear})
    values[CAN_BR] = 9  # 5 Mbit/s
    values.update({PMAX: scale.pmax, VMAX: scale.vmax, TMAX: scale.tmax})
    return values
