"""Bytes of Damiao motors: MIT commands, state replies, special frames, registers. Pure, no bus.

Source of layouts and scales: openarm_can, LeRobot and DM_Control_Python, which agree here.
A state reply can look like a register reply (its angle may carry 0x33 or 0x55), so whoever waits
for a register says which one; nothing here guesses from the content.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

FRAME_BYTES = 8
SERVICE_ID = 0x7FF  # register access, refresh and save; the target is named in the data
REPLY_OFFSET = 0x10  # MST_ID minus ESC_ID, by convention
KP_MAX, KD_MAX = 500.0, 5.0  # N m/rad, N m s/rad: the same for all motor types
Q_CODES, CODES = (1 << 16) - 1, (1 << 12) - 1  # highest code of angles and of everything else

CLEAR_ERROR = b"\xff\xff\xff\xff\xff\xff\xff\xfb"
ENABLE = b"\xff\xff\xff\xff\xff\xff\xff\xfc"
DISABLE = b"\xff\xff\xff\xff\xff\xff\xff\xfd"

READ, WRITE, REFRESH = 0x33, 0x55, 0xCC
TIMEOUT, CTRL_MODE, PMAX, VMAX, TMAX = 9, 10, 21, 22, 23  # registers
MIT_MODE = 1  # of CTRL_MODE
TIMEOUT_UNIT_S = 50e-6  # as two of three sources say; the third says milliseconds
INTEGER_REGISTERS = frozenset((*range(7, 11), *range(13, 17), 35, 36))


class WireError(ValueError):
    """Bytes that are not what they should be, or values that cannot be put into bytes."""


@dataclass(frozen=True)
class Scales:
    """What full scale means, from the motor's registers 21, 22 and 23.

    Attributes:
        q_max: PMAX, rad.
        dq_max: VMAX, rad/s.
        tau_max: TMAX, N m.
    """

    q_max: float
    dq_max: float
    tau_max: float

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise WireError(f"{name} of a motor is {value}; it must be a number above zero")


@dataclass(frozen=True)
class State:
    """A motor's reply.

    Attributes:
        status: high nibble of byte 0, see `drivers.damiao.tables`.
        motor: low four bits of the motor's id.
        q, dq, tau: rad, rad/s, N m at the output shaft.
        mosfet_degc, rotor_degc: temperatures.
    """

    status: int
    motor: int
    q: float
    dq: float
    tau: float
    mosfet_degc: int
    rotor_degc: int


def code_of(value: float, low: float, high: float, top: int) -> int:
    """Code of a value in [low, high]: clamped, then truncated towards zero.

    Raises WireError for NaN.
    """
    if not low <= value <= high:
        if value != value:
            raise WireError("a value to be sent is not a number")
        value = low if value < low else high
    return int((value - low) / (high - low) * top)


def value_of(code: int, low: float, high: float, top: int) -> float:
    """Value of a code; inverse of `code_of` up to one step."""
    return low + code / top * (high - low)


def mit_command(
    limits: Scales,
    q: float = 0.0,
    dq: float = 0.0,
    kp: float = 0.0,
    kd: float = 0.0,
    tau: float = 0.0,
) -> bytes:
    """The motor then gives kp (q - its q) + kd (dq - its dq) + tau at the output shaft.

    A command whose first seven bytes would all be 0xFF asks for an angle one step lower: the
    motor would take it for "enable", "disable" or "set zero".

    Args:
        q, dq: wanted, rad, rad/s; kp: N m/rad; kd: N m s/rad; tau: N m. Clamped to what fits.

    Raises:
        WireError: a value is NaN.
    """
    a = code_of(q, -limits.q_max, limits.q_max, Q_CODES)
    b = code_of(dq, -limits.dq_max, limits.dq_max, CODES)
    c = code_of(kp, 0.0, KP_MAX, CODES)
    d = code_of(kd, 0.0, KD_MAX, CODES)
    e = code_of(tau, -limits.tau_max, limits.tau_max, CODES)
    word = a << 48 | b << 36 | c << 24 | d << 12 | e
    if word >> 8 == (1 << 56) - 1:
        word -= 1 << 48
    return word.to_bytes(FRAME_BYTES, "big")


def state(limits: Scales, data: bytes | bytearray) -> State:
    """What a motor replied. Raises WireError where there are not eight bytes."""
    _need_eight(data)
    word = int.from_bytes(data, "big")
    return State(
        status=word >> 60,
        motor=word >> 56 & 0xF,
        q=value_of(word >> 40 & Q_CODES, -limits.q_max, limits.q_max, Q_CODES),
        dq=value_of(word >> 28 & CODES, -limits.dq_max, limits.dq_max, CODES),
        tau=value_of(word >> 16 & CODES, -limits.tau_max, limits.tau_max, CODES),
        mosfet_degc=temperature(data[6]),
        rotor_degc=temperature(data[7]),
    )


def temperature(code: int) -> int:
    """deg C of a temperature byte."""
    return code - 256 if code >= 216 else code  # -40..-1 deg C, as one source has it


def refresh(motor_id: int) -> bytes:
    """Asks for a state without commanding anything; goes to `SERVICE_ID`."""
    return struct.pack("<HBBI", motor_id, REFRESH, 0, 0)


def read_register(motor_id: int, register: int) -> bytes:
    """Asks for a register; goes to `SERVICE_ID`."""
    return struct.pack("<HBBI", motor_id, READ, register, 0)


def write_register(motor_id: int, register: int, value: float) -> bytes:
    """Sets a register in the motor's memory, not in its flash; goes to `SERVICE_ID`.

    Raises WireError for a value that the register cannot hold.
    """
    head = struct.pack("<HBB", motor_id, WRITE, register)
    try:
        if register in INTEGER_REGISTERS:
            return head + struct.pack("<I", int(value))
        return head + struct.pack("<f", value)
    except (struct.error, OverflowError, ValueError) as error:
        raise WireError(f"register {register} cannot hold {value}") from error


def register_reply(
    data: bytes | bytearray, motor_id: int, operation: int, register: int
) -> float | int:
    """Value in the reply to an outstanding read or write request.

    Args:
        data: of a frame with the motor's reply id.
        motor_id, operation, register: what was asked.

    Raises:
        WireError: these bytes are not the reply to that.
    """
    _need_eight(data)
    if bytes(data[:4]) != struct.pack("<HBB", motor_id, operation, register):
        raise WireError(f"not the reply of motor {motor_id} for register {register}")
    if register in INTEGER_REGISTERS:
        return int.from_bytes(data[4:], "little")
    return float(struct.unpack("<f", data[4:])[0])


def _need_eight(data: bytes | bytearray) -> None:
    if len(data) != FRAME_BYTES:
        raise WireError(f"a motor's frame has {FRAME_BYTES} bytes, this one {len(data)}")
